"""Helpers for tests of direct tasks: set a state, read the observation and the reward, record torch's operations."""

import math

import torch
from torch.utils._python_dispatch import TorchDispatchMode

HOST_OPERATIONS = {
    "_local_scalar_dense", "nonzero", "masked_select", "lift_fresh", "scalar_tensor", "index", "index_put_",
}  # fmt: skip
"""Operations that wait for the device, copy numbers to it, or search: an index of booleans is a search."""


class OperationRecorder(TorchDispatchMode):
    """Recorder of the names of torch's operations."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


def quat_around(axis, angle):
    """Return the quaternion of a rotation around x, y or z (axis 1, 2 or 3) by an angle [rad]."""
    return tuple(math.cos(angle / 2) if i == 0 else math.sin(angle / 2) * (i == axis) for i in range(4))


def set_floating_state(env, row, position, quat, linear, angular, joints, rates):
    """Set a floating robot of one environment. Angular velocity is in the body frame. [m, m/s, rad/s, rad]"""
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    qpos[row, :3], qpos[row, 3:7] = torch.tensor(position).double(), torch.tensor(quat).double()
    qvel[row, :3], qvel[row, 3:6] = torch.tensor(linear).double(), torch.tensor(angular).double()
    qpos[row, 7:], qvel[row, 6:] = joints, rates
    env.sim.refresh()


def observe(env, row=0):
    """Return the observation of the current state: column name -> value."""
    env.task.get_observations()
    return dict(zip(env.task.observation_names, env.task.obs_buf[row].tolist(), strict=True))


def reward_and_done(env, row=0):
    """Return the reward of the current state, and whether the task terminates the episode in it."""
    env.task.get_observations()
    env.task.calculate_metrics()
    env.task.is_done()
    return float(env.task.rew_buf[row]), bool(env.task.reset_buf[row])


def buffer_addresses(task):
    """Return the memory address of each tensor of a task."""
    return {name: value.data_ptr() for name, value in vars(task).items() if isinstance(value, torch.Tensor)}
