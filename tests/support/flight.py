"""Helpers for tests of flight tasks: set the state of a craft, and hover at the target."""

import torch

from support.direct_states import set_floating_state

LEVEL = (1.0, 0.0, 0.0, 0.0)


def put(env, row=0, position=(0.0, 0.0, 1.0), quat=LEVEL, linear=(0, 0, 0), angular=(0, 0, 0), joints=0.0):
    """Set the state of one environment's craft; angular velocity is in its own frame. [m, m/s, rad/s, rad]"""
    set_floating_state(env, row, position, quat, linear, angular, joints, 0.0)


def weight(env, entity="robot"):
    """Return the weight of the craft [N]."""
    model = env.engine.model
    return float(model.body_mass[env.entities[entity].body_ids].sum()) * -float(model.opt.gravity[2])


def hover_for_a_second(env, offset=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)):
    """Hold the craft near the target for an episode of one second. Return the success of each environment."""
    env.reset()
    for _ in range(env.max_episode_length):
        for row in range(env.num_envs):
            position = env.task.goal.data.root_pos_w[row] + torch.tensor(offset)
            put(env, row, position=tuple(position.tolist()), linear=velocity)
        result = env.step(torch.zeros(env.num_envs, env.task.num_actions))
    assert result.truncated.all()
    return result.episodes.success.tolist()
