"""Hooks of flight and locomotion tasks on a GPU: no host synchronisation, and fixed buffers."""

from types import SimpleNamespace

import pytest
import torch
from support.direct_states import HOST_OPERATIONS, OperationRecorder, buffer_addresses
from support.worlds import actions, build

TASKS = ("quadcopter", "crazyflie", "ingenuity", "ant-direct", "humanoid-direct")


@pytest.mark.parametrize("task", TASKS)
def test_hooks_do_not_wait_for_device(task):
    env = build(task, 4)
    env.reset()
    action = torch.rand(4, env.task.num_actions)
    env.step(action)
    if task == "crazyflie":  # a GPU samples on the device, a CPU in numpy
        noise = torch.zeros(4, 4)
        env.task.selection = lambda mask, name: SimpleNamespace(normal=lambda mean, std, shape: noise)
    with OperationRecorder() as step:
        env.task.pre_physics_step(action)
        env.task.get_observations()
        env.task.calculate_metrics()
        env.task.is_done()
    assert "cat" in step.names
    assert not HOST_OPERATIONS & set(step.names)


@pytest.mark.parametrize("task", TASKS)
def test_buffers_keep_addresses_over_steps_and_resets(task):
    env = build(task, 4)
    env.reset()
    before = buffer_addresses(env.task)
    assert len(before) > 5
    for action in actions(3, 4, env.task.num_actions):
        env.step(action)
    env.episode_length_buf[1] = env.max_episode_length - 1
    env.step(action)
    env.reset()
    assert buffer_addresses(env.task) == before
