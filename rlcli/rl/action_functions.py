"""Functions from observations to actions, for evaluations and viewers: a trained policy, zero or random actions.

The function of a trained policy also keeps the hidden state of a recurrent network.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.rl.policy import Policy

Act = Callable[[Tensor], Tensor]
"""Action function: observations of the policy (num_envs, d) -> actions (num_envs, a)."""
PATIENCE = 10
"""An evaluation ends an episode that is longer than this number times the task's `episode_length_s`."""


def trained_policy(
    env: Environment, policy: Policy, *, stochastic: bool = False, generator: torch.Generator | None = None
) -> Act:
    """Return a policy as a function from observations (num_envs, d) to actions (num_envs, a).

    The function keeps the hidden state of a recurrent policy, and sets it to zero where an episode begins.

    Args:
        env: the environment.
        policy: the policy.
        stochastic: sample actions instead of taking the mean.
        generator: random generator of the noise; environments that share a random stream
            (`engine.shared_streams`) then get the same noise. None: torch's global generator, with different noise in
            every environment.
    """
    hidden: Tensor | None = None
    repeats = env.num_envs // (env.engine.shared_streams or env.num_envs) if generator is not None else 1

    def act(obs: Tensor) -> Tensor:
        nonlocal hidden
        if hidden is not None:
            hidden = hidden * (env.episode_length_buf > 0)[:, None]
        action, hidden = policy.step(obs, hidden, stochastic=stochastic, generator=generator, noise_repeats=repeats)
        return action

    return act


def zero_policy(env: Environment) -> Act:
    """Return a function that returns zero actions (num_envs, a) for all observations."""
    action = torch.zeros(env.num_envs, env.layout.action_size, device=env.device)
    return lambda obs: action


def random_policy(env: Environment, bound: float | None, seed: int) -> Act:
    """Return a function that samples uniform actions in [-bound, bound]; standard Gaussian actions if `bound` is None.

    Environments that share a random stream (`engine.shared_streams`) get the same actions.
    """
    generator = torch.Generator().manual_seed(seed)
    streams = env.engine.shared_streams or env.num_envs
    shape, repeats = (streams, env.layout.action_size), env.num_envs // streams
    if bound is None:
        return lambda obs: torch.randn(shape, generator=generator).repeat(repeats, 1)
    return lambda obs: ((torch.rand(shape, generator=generator) * 2.0 - 1.0) * bound).repeat(repeats, 1)
