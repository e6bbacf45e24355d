"""Repeat one episode of `rlcli eval` from the seed: episode K of environment E, for `rlcli play`.

A random number depends on the seed, the term, the environment and the index of its episode. If nothing else connects
the episodes of a task, episode K starts at once. In other tasks an episode also depends on the earlier ones, because of
noise, curricula, terms with a state, or timers that a reset does not restart. Then the episodes before K are run first,
in all environments as in the evaluation, and the reasons are returned.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.step_result import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError
from rlcli.rl.action_functions import PATIENCE, Act
from rlcli.rl.rng import load_rng_state, rng_state


@dataclass(frozen=True, slots=True)
class EpisodeStart:
    """Result of `start_episode`: the first observations of the episode, and how the environment got there."""

    obs: Tensor
    """Observations of the policy. (num_envs, d)"""
    episodes_before: int
    """Number of earlier episodes of this environment that had to be run first; 0 if the episode started at once."""
    reasons: list[str]
    """Reasons why earlier episodes had to be run first; empty if the episode started at once."""
    generators: dict[str, Tensor]
    """States of the global random generators (of torch, numpy and Python) before any step, by name."""

    def shared_draws(self) -> bool:
        """Return whether the task has drawn random numbers from the global generators of torch, numpy or Python.

        All environments share these generators; an episode then also depends on the number of environments.
        """
        return _has_drawn(self.generators)


def start_episode(env: VecEnv, act: Act, env_id: int, episode: int, *, drawn_actions: bool = False) -> EpisodeStart:
    """Reset an environment to the beginning of one episode of an evaluation; run earlier episodes if they affect it.

    Args:
        env: the environments, newly created.
        act: the policy, a function from observations (num_envs, d) to actions (num_envs, a).
        env_id: index of the episode's environment.
        episode: index of the episode in this environment, from 0.
        drawn_actions: whether the policy draws random numbers (a stochastic policy, or random actions).

    Returns:
        The first observations of the episode, and which earlier episodes were run, and why.

    Raises:
        ConfigError: if an earlier episode does not end, because the task has no time-out.
    """
    reasons = [*env.episode_dependencies(), *(["randomly sampled actions"] if drawn_actions else [])]
    generators, start = rng_state(), env.state_dict()
    if episode > 0 and not reasons:
        run_episode(env, act, env.reset(seed=env.seed, episode=episode)["policy"], env_id)
        if not _has_drawn(generators):
            return EpisodeStart(env.reset(seed=env.seed, episode=episode)["policy"], 0, [], generators)
        reasons = ["random numbers of torch, numpy or Python in a term"]
        load_rng_state(generators)
        env.load_state_dict(start)
    obs = env.reset(seed=env.seed)["policy"]
    for _ in range(episode):
        obs = run_episode(env, act, obs, env_id).obs["policy"]
    return EpisodeStart(obs, episode, reasons if episode else [], generators)


def run_episode(env: VecEnv, act: Act, obs: Tensor, env_id: int) -> StepResult:
    """Run the policy until the current episode of environment `env_id` ends, and return the result of the last step.

    Args:
        env: the environments; all of them step.
        act: the policy, a function from observations (num_envs, d) to actions (num_envs, a).
        obs: the current observations of the policy. (num_envs, d)
        env_id: index of the environment.

    Raises:
        ConfigError: if the episode does not end, because the task has no time-out.
    """
    with torch.no_grad():
        while True:
            require_end(env, int(env.episode_length_buf[env_id]))
            step = env.step(act(obs))
            obs = step.obs["policy"]
            if bool(step.terminated[env_id] | step.truncated[env_id]):
                return step


def require_end(env: Environment, length: int) -> None:
    """Check that a running episode of `length` steps is not longer than `PATIENCE` times `episode_length_s`.

    Raises:
        ConfigError: if the episode is longer; the task then has no time-out.
    """
    if length > PATIENCE * env.max_episode_length:
        message = f"an episode has lasted {length} steps, {PATIENCE} times episode_length_s, and has not ended"
        hint = "add a termination with `func: time_out` and `time_out: true`"
        raise ConfigError([env.resolved.problem(("terminations",), message, hint)])


def _has_drawn(before: dict[str, Tensor]) -> bool:
    """Return whether random numbers were drawn from the global generators since their states were `before`."""
    after = rng_state()
    return any(not torch.equal(before[name].nan_to_num(-1.0), after[name].nan_to_num(-1.0)) for name in before)
