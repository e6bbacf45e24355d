"""What the tests of flying tasks share: putting a craft into a state, and asking the task what it makes of it."""

import math

import torch

LEVEL = (1.0, 0.0, 0.0, 0.0)


def put(env, row=0, position=(0.0, 0.0, 1.0), quat=LEVEL, linear=(0, 0, 0), angular=(0, 0, 0), joints=0.0):
    """Put one environment's craft into a state; angular is in its own frame. [m, m/s, rad/s, rad]"""
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    qpos[row, :3], qpos[row, 3:7] = torch.tensor(position).double(), torch.tensor(quat).double()
    qpos[row, 7:] = joints
    qvel[row, :3], qvel[row, 3:6] = torch.tensor(linear).double(), torch.tensor(angular).double()
    qvel[row, 6:] = 0.0
    env.sim.refresh()


def look(env, row=0):
    """Column name -> value of the observation."""
    env.task.get_observations()
    return dict(zip(env.task.observation_names, env.task.obs_buf[row].tolist(), strict=True))


def pay(env, row=0):
    """Reward of the state as it is, and whether it ends the episode."""
    env.task.get_observations()
    env.task.calculate_metrics()
    env.task.is_done()
    return float(env.task.rew_buf[row]), bool(env.task.reset_buf[row])


def about(axis, angle):
    """Quaternion of a turn about x, y or z: axis 1, 2 or 3."""
    return tuple(math.cos(angle / 2) if i == 0 else math.sin(angle / 2) * (i == axis) for i in range(4))


def weight(env, entity="robot"):
    """Of the craft alone. [N]"""
    model = env.engine.model
    return float(model.body_mass[env.entities[entity].body_ids].sum()) * -float(model.opt.gravity[2])


def hover_for_a_second(env, offset=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)):
    """Hold the craft where it is told to be, up to the end of an episode of one second; its success."""
    env.reset()
    for _ in range(env.max_episode_length):
        for row in range(env.num_envs):
            place = env.task.goal.data.root_pos_w[row] + torch.tensor(offset)
            put(env, row, position=tuple(place.tolist()), linear=velocity)
        result = env.step(torch.zeros(env.num_envs, env.task.num_actions))
    assert result.truncated.all()
    return result.episodes.success.tolist()
