"""Acting in an environment: a trained policy with its hidden state, the zero policy, a random policy."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.rl.policy import Policy

Act = Callable[[Tensor], Tensor]
PATIENCE = 10
"""Episode lengths after which an evaluation gives an episode up."""


def acting(env: VecEnv, policy: Policy, *, stochastic: bool = False, generator: torch.Generator | None = None) -> Act:
    """Return a policy's action function; its hidden state is reset with each episode, equal streams get equal noise."""
    memory: Tensor | None = None
    groups = env.num_envs // (env.engine.shared_streams or env.num_envs) if stochastic and generator is not None else 1

    def act(obs: Tensor) -> Tensor:
        nonlocal memory
        if memory is not None:
            memory = memory * (env.episode_length_buf > 0)[:, None]
        if groups == 1:
            action, memory = policy.step(obs, memory, stochastic=stochastic, generator=generator)
            return action
        assert generator is not None
        state = generator.get_state()
        actions: list[Tensor] = []
        memories: list[Tensor] = []
        for number, seen in enumerate(obs.chunk(groups)):
            generator.set_state(state)
            before = None if memory is None else memory.chunk(groups)[number]
            action, after = policy.step(seen, before, stochastic=True, generator=generator)
            actions.append(action)
            memories += [] if after is None else [after]
        memory = torch.cat(memories) if memories else None
        return torch.cat(actions)

    return act


def zero_policy(env: VecEnv) -> Act:
    """Return a function that always returns the zero action."""
    action = torch.zeros(env.num_envs, env.layout.action_size, device=env.device)
    return lambda obs: action


def random_policy(env: VecEnv, bound: float | None, seed: int) -> Act:
    """Return uniform actions within the bound, else standard Gaussian ones; environments of one stream get the same."""
    generator = torch.Generator().manual_seed(seed)
    streams = env.engine.shared_streams or env.num_envs
    shape, groups = (streams, env.layout.action_size), env.num_envs // streams
    if bound is None:
        return lambda obs: torch.randn(shape, generator=generator).repeat(groups, 1)
    return lambda obs: ((torch.rand(shape, generator=generator) * 2.0 - 1.0) * bound).repeat(groups, 1)
