"""One episode of an evaluation again, from its seed: what `rlcli eval` lived as environment E's episode K.

A draw depends on the seed, the term, the environment and the number of its episode. So where nothing else connects the
episodes of a task, the K-th is begun at once. Where something does (commands and intervals that are drawn by the clock
of all episodes, noise, curricula, objects that may remember), the ones before it are lived first, all environments
beside each other as in the evaluation, and what connects them is named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError
from rlcli.rl.rng import load_rng_state, rng_state
from rlcli.rl.rollout import PATIENCE, Act


@dataclass(frozen=True, slots=True)
class Begun:
    """An episode at its beginning."""

    obs: Tensor
    """What the policy sees. (num_envs, d)"""
    lived: int
    """Episodes of the environment that were lived before it."""
    carried: list[str]
    """What made that necessary."""
    generators: dict[str, Tensor]
    """The states of the generators that all environments share, before anything was lived."""

    def shared_draws(self) -> bool:
        """Whether the task has drawn from them by now: then the episode is that of exactly so many environments."""
        return _drawn(self.generators)


def begin_episode(env: VecEnv, act: Act, who: int, episode: int, *, drawn_actions: bool = False) -> Begun:
    """Bring an environment to the beginning of one of its episodes.

    Args:
        env: a new environment.
        act: what acts in it.
        who: the environment whose episode it is.
        episode: its number, from 0.
        drawn_actions: whether `act` draws.

    Raises:
        ConfigError: if an episode goes on and on because the task has no time-out.
    """
    carried = [*env.carried(), *(["actions that are drawn"] if drawn_actions else [])]
    before, start = rng_state(), env.state_dict()
    if episode > 0 and not carried:
        _live(env, act, env.reset(seed=env.seed, episode=episode)["policy"], who, 1)
        if not _drawn(before):
            return Begun(env.reset(seed=env.seed, episode=episode)["policy"], 0, [], before)
        carried = ["generators of torch, numpy or Python that some term draws from"]
        load_rng_state(before)
        env.load_state_dict(start)
    obs = _live(env, act, env.reset(seed=env.seed)["policy"], who, episode)
    return Begun(obs, episode, carried if episode else [], before)


def live_episode(
    env: VecEnv, act: Act, obs: Tensor, who: int, on_step: Callable[[StepResult], None] = lambda _: None
) -> StepResult:
    """Step until the running episode of an environment ends; the last step.

    Raises:
        ConfigError: if it goes on and on because the task has no time-out.
    """
    with torch.no_grad():
        while True:
            if int(env.episode_length_buf[who]) > PATIENCE * env.max_episode_length:
                message = f"an episode has lasted {int(env.episode_length_buf[who])} steps and has not ended"
                hint = "add a termination with time_out: true"
                raise ConfigError([env.resolved.problem(("terminations",), message, hint)])
            step = env.step(act(obs))
            obs = step.obs["policy"]
            on_step(step)
            if bool(step.terminated[who] | step.truncated[who]):
                return step


def _live(env: VecEnv, act: Act, obs: Tensor, who: int, episodes: int) -> Tensor:
    for _ in range(episodes):
        obs = live_episode(env, act, obs, who).obs["policy"]
    return obs


def _drawn(before: dict[str, Tensor]) -> bool:
    """Whether anybody has drawn from a generator since."""
    after = rng_state()
    return any(not torch.equal(before[name].nan_to_num(-1.0), after[name].nan_to_num(-1.0)) for name in before)
