"""Comparison of an environment in several processes with the same environment in one."""

from __future__ import annotations

import contextlib
from dataclasses import fields

import torch

from rlcli.envs.make import make_env
from rlcli.envs.sharding.env import ShardedEnv
from rlcli.envs.step_result import Episodes


def same(a, b):
    """Return whether two values have the same bits; tensors, dictionaries of tensors, or None."""
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[name], b[name]) for name in a)
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and bool(((a == b) | (a.isnan() & b.isnan())).all())
    return a == b


@contextlib.contextmanager
def both(resolved, workers, seed=3):
    """Yield the environment in one process, and the same in several."""
    sharded = ShardedEnv(resolved, workers=workers, seed=seed)
    alone = make_env(resolved, seed=seed)
    try:
        yield alone, sharded
    finally:
        alone.close()
        sharded.close()


def step_differences(a, b):
    """Return the names of the parts of two step results that differ."""
    names = ("obs", "reward", "terminated", "truncated")
    found = [name for name in names if not same(getattr(a, name), getattr(b, name))]
    if (a.episodes is None) != (b.episodes is None):
        return [*found, "episodes"]
    if a.episodes is not None:
        parts = [part.name for part in fields(Episodes)]
        found += [name for name in parts if not same(getattr(a.episodes, name), getattr(b.episodes, name))]
    if a.final_obs is not None:
        rows = a.episodes.ids
        found += [f"final {group}" for group, v in a.final_obs.items() if not same(v[rows], b.final_obs[group][rows])]
    return found


def differences(resolved, workers, steps, check_state_every=50):
    """Step both environments with random actions, and return what differs; and the number of episodes that ended."""
    with both(resolved, workers) as (alone, sharded):
        found, ended = [], 0
        if not same(alone.reset(seed=5), sharded.reset(seed=5)):
            found.append("reset")
        generator = torch.Generator().manual_seed(0)
        for number in range(1, steps + 1):
            action = torch.rand(alone.num_envs, alone.layout.action_size, generator=generator) * 2.0 - 1.0
            one, several = alone.step(action), sharded.step(action)
            found += [f"{name} in step {number}" for name in step_differences(one, several)]
            ended += 0 if one.episodes is None else len(one.episodes.ids)
            if number % check_state_every == 0 or number == steps:
                if not same(alone.state_dict(), sharded.state_dict()):
                    found.append(f"state after step {number}")
                if repr(alone.extras()) != repr(sharded.extras()):
                    found.append(f"extras after step {number}")
        for name in ("episode_length_buf", "episode_index", "common_step", "causes"):
            if not same(getattr(alone, name), getattr(sharded, name)):
                found.append(name)
        return found[:10], ended
