"""The flying tasks' hooks as a GPU sees them."""

from types import SimpleNamespace

import pytest
import torch
from support.worlds import actions, build
from torch.utils._python_dispatch import TorchDispatchMode

FLYERS = ("quadcopter", "crazyflie", "ingenuity")


class Operations(TorchDispatchMode):
    """Notes what torch runs."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


ON_THE_HOST = {"_local_scalar_dense", "nonzero", "masked_select", "lift_fresh", "scalar_tensor", "index", "index_put_"}
"""Operations that wait for the device, bring numbers to it, or search."""


@pytest.mark.parametrize("task", FLYERS)
def test_no_hook_of_a_step_waits_for_the_device(task):
    env = build(task, 4)
    env.reset()
    action = torch.rand(4, env.task.num_actions)
    env.step(action)
    if task == "crazyflie":  # a GPU draws by itself, a CPU in numpy
        noise = torch.zeros(4, 4)
        env.task.selection = lambda mask, name: SimpleNamespace(normal=lambda mean, std, shape: noise)
    with Operations() as step:
        env.task.pre_physics_step(action)
        env.task.get_observations()
        env.task.calculate_metrics()
        env.task.is_done()
    assert "cat" in step.names
    assert not ON_THE_HOST & set(step.names)


@pytest.mark.parametrize("task", FLYERS)
def test_buffers_keep_their_place_from_step_to_step_and_over_resets(task):
    env = build(task, 4)
    env.reset()

    def places():
        return {k: v.data_ptr() for k, v in vars(env.task).items() if isinstance(v, torch.Tensor)}

    before = places()
    assert len(before) > 5
    for action in actions(3, 4, env.task.num_actions):
        env.step(action)
    env.episode_length_buf[1] = env.max_episode_length - 1
    env.step(action)
    env.reset()
    assert places() == before
