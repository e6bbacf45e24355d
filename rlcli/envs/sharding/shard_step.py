"""Runner of one shard, the part of the environments that one process steps.

The runner reads actions from shared memory and writes the results there.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.envs.observers import Observers, StepObserver
from rlcli.envs.shard_range import Shard
from rlcli.envs.sharding.arrays import ArraySpec
from rlcli.envs.step_result import Episodes, StepRecord
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import RlcliError
from rlcli.sim.divergence_report import Divergence

SLOTS = 3
"""Number of shared buffers for results: the result of a step stays valid until the step after the next one."""
_FIXED_COLUMNS = 4
"""Number of values that every finished episode has: environment, return, length, truncated."""
_MAX_COLUMNS = 256
"""Largest number of values of a finished episode, without its reward terms."""


class Stage(enum.IntEnum):
    """Points of a step at which a shard can wait for the observers of the main process, in their order."""

    DIVERGED = 1
    """After physics: `on_divergence` of the observers runs, for simulations that diverged."""
    AFTER_PHYSICS = 2
    """After physics: `after_physics` of the observers runs."""
    ON_STEP = 3
    """After rewards and terminations: `on_step` of the observers runs."""
    QUARANTINED = 4
    """After resets: `on_divergence` runs, for environments that an event or a reset put out of bounds."""
    DONE = 5
    """The step, reset or load is complete."""


class Needs(enum.Flag):
    """Kinds of observers in the main process for which a shard must stop in the middle of its step."""

    AFTER_PHYSICS = enum.auto()
    ON_DIVERGENCE = enum.auto()
    ON_STEP = enum.auto()

    @staticmethod
    def of_observers(observers: Observers) -> Needs:
        """Return the kinds of methods that at least one registered observer overrides."""
        needs = Needs(0)
        needs |= Needs.AFTER_PHYSICS if observers.after_physics else needs
        needs |= Needs.ON_DIVERGENCE if observers.on_divergence else needs
        return needs | Needs.ON_STEP if observers.on_step else needs


@dataclass(frozen=True, slots=True)
class Columns:
    """Names of the values of a finished episode (reward terms, causes, ...), which are columns in shared memory."""

    terms: tuple[str, ...]
    causes: tuple[str, ...]
    metrics: tuple[str, ...]
    conditions: tuple[str, ...]
    condition_values: tuple[str, ...]

    @staticmethod
    def of_episodes(episodes: Episodes) -> Columns:
        """Return the columns for the values of these episodes."""
        named = (episodes.reward_terms, episodes.causes, episodes.metrics)
        return Columns(*(tuple(part) for part in (*named, episodes.conditions, episodes.condition_values)))

    @property
    def count(self) -> int:
        """Number of columns in shared memory, including the columns that every episode has (return, length, ...)."""
        named = (self.terms, self.causes, self.metrics, self.conditions, self.condition_values)
        return _FIXED_COLUMNS + sum(len(part) for part in named) + bool(self.conditions)


def counter_specs(total: int) -> dict[str, ArraySpec]:
    """Return the shape and type of the episode counters of all environments: lengths and indices, (2, total).

    `array_specs` needs a built environment, but the counters are needed before the environments are built.
    """
    return {"counters": ArraySpec((2, total), torch.int64)}


def array_specs(env: VecEnv, total: int, shards: int) -> dict[str, ArraySpec]:
    """Return shapes and types of the shared tensors for `total` environments in `shards` shards."""
    layout, terms = env.layout, len(env.reward_names)
    sizes = {group: layout.size(group) for group in layout.observations}
    floats, flags = torch.float32, torch.bool
    return {
        **counter_specs(total),
        # slot, Needs, whether final_obs_of is "truncated", whether an environment restarts; the rest is unused
        "command": ArraySpec((8,), torch.int64),
        "action": ArraySpec((total, layout.action_size), floats),
        "restart": ArraySpec((total,), flags),
        **{f"obs.{group}": ArraySpec((SLOTS, total, size), floats) for group, size in sizes.items()},
        **{f"final.{group}": ArraySpec((total, size), floats) for group, size in sizes.items()},
        "reward": ArraySpec((SLOTS, total), floats),
        "terminated": ArraySpec((SLOTS, total), flags),
        "truncated": ArraySpec((SLOTS, total), flags),
        "reward_terms": ArraySpec((terms, total), floats),
        "episodes": ArraySpec((_MAX_COLUMNS + terms, total), torch.float64),
        # number of finished episodes, whether final_obs is valid; the rest is unused
        "counts": ArraySpec((shards, 8), torch.int64),
        # duration of the physics and of the whole step [s]; the rest is unused
        "seconds": ArraySpec((shards, 8), torch.float64),
    }


class ShardRunner:
    """Runner of the steps of one shard.

    Args:
        env: the environments of the shard.
        number: index of the shard.
        arrays: the shared tensors.
        stop: called as `stop(stage, data)` at each stage that an observer of the main process needs, and at the end;
            `data` is for these observers. The call returns when the shard may continue.
        check: called before the end of each step and reset, to raise an error that makes the results invalid.
    """

    def __init__(
        self,
        env: VecEnv,
        number: int,
        arrays: Mapping[str, Tensor],
        stop: Callable[[Stage, Any], None],
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self.env, self.stop, self._check = env, stop, check
        rows, groups = env.shard.rows, list(env.layout.observations)
        self._action, self._restart = arrays["action"][rows], arrays["restart"][rows]
        self._obs = [{group: arrays[f"obs.{group}"][slot, rows] for group in groups} for slot in range(SLOTS)]
        self._final = {group: arrays[f"final.{group}"][rows] for group in groups}
        self._reward, self._terminated, self._truncated = (
            [arrays[name][slot, rows] for slot in range(SLOTS)] for name in ("reward", "terminated", "truncated")
        )
        self._reward_terms, self._episodes = arrays["reward_terms"][:, rows], arrays["episodes"][:, rows].numpy()
        self._command = arrays["command"].numpy()
        self._counts, self._seconds = arrays["counts"][number].numpy(), arrays["seconds"][number].numpy()
        self._stops = {
            Needs.AFTER_PHYSICS: _StopAfterPhysics(self),
            Needs.ON_DIVERGENCE: _StopOnDivergence(self),
            Needs.ON_STEP: _StopOnStep(self),
        }
        self._needs = Needs(0)
        self._columns: Columns | None = None
        self._new_columns: Columns | None = None
        self._slot = 0

    def step(self) -> None:
        """Step the shard with its actions, and write the result to shared memory."""
        self._slot, needs, only_truncated, restarts = self._command[:4].tolist()
        self._observe(Needs(needs))
        self.env.final_obs_of = "truncated" if only_truncated else "finished"
        result = self.env.step(self._action, self._restart if restarts else None)
        if Needs.ON_STEP not in self._needs:
            self._reward[self._slot].copy_(result.reward)
            self._publish_episodes(result.episodes)
        self._terminated[self._slot].copy_(result.terminated)
        self._truncated[self._slot].copy_(result.truncated)
        self._counts[1] = result.final_obs is not None
        if result.final_obs is not None:
            for group, values in result.final_obs.items():
                self._final[group].copy_(values)
        self._end(result.obs)

    def reset(self, seed: int | None, episode: int) -> None:
        """Start a new episode in every environment of the shard, and write the observations to shared memory."""
        self._slot, needs = self._command[:2].tolist()
        self._observe(Needs(needs))
        self._end(self.env.reset(seed, episode=episode))

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Restore a state of the shard, and write the observations to shared memory."""
        self._slot, needs = self._command[:2].tolist()
        self._observe(Needs(needs))
        self._end(self.env.load_state_dict(state))

    def publish_record(self, record: StepRecord) -> Columns | None:
        """Write reward, reward terms and finished episodes to shared memory, for the observers of the main process.

        Return the columns of finished episodes if they have changed, else None.
        """
        self._reward[self._slot].copy_(record.reward)
        self._reward_terms.copy_(record.reward_terms)
        self._publish_episodes(record.episodes)
        return self._pop_new_columns()

    def _end(self, obs: Mapping[str, Tensor]) -> None:
        self._check()
        for group, values in obs.items():
            self._obs[self._slot][group].copy_(values)
        self._seconds[0], self._seconds[1] = self.env.seconds["physics"], self.env.seconds["step"]
        self.stop(Stage.DONE, self._pop_new_columns())

    def _observe(self, needs: Needs) -> None:
        """Call `stop` from now on at the stages that observers of the main process need."""
        for need in needs ^ self._needs:
            change = self.env.observers.add if need in needs else self.env.observers.remove
            change(self._stops[need])
        self._needs = needs

    def _publish_episodes(self, episodes: Episodes | None) -> None:
        self._counts[0] = count = 0 if episodes is None else len(episodes.ids)
        if episodes is None:
            return
        columns = Columns.of_episodes(episodes)
        if columns != self._columns:
            if columns.count > len(self._episodes):
                raise RlcliError(
                    f"the task has {columns.count} values per episode (reward terms, causes, metrics, conditions of"
                    f" success); with several workers at most {len(self._episodes)} are allowed",
                    hint="set scene.workers: 1",
                )
            self._columns = self._new_columns = columns
        named = [*episodes.reward_terms.values(), *episodes.causes.values(), *episodes.metrics.values()]
        named += [*episodes.conditions.values(), *episodes.condition_values.values()]
        fixed = [episodes.ids, episodes.returns, episodes.lengths, episodes.truncated]
        values = [*fixed, *named, *([] if episodes.success is None else [episodes.success])]
        # in numpy, because its calls take a third of the time of torch's
        for row, value in zip(self._episodes, values, strict=False):
            row[:count] = value.numpy()

    def _pop_new_columns(self) -> Columns | None:
        columns, self._new_columns = self._new_columns, None
        return columns


class _StopAfterPhysics(StepObserver):
    def __init__(self, runner: ShardRunner) -> None:
        self._runner = runner

    def after_physics(self) -> None:
        self._runner.stop(Stage.AFTER_PHYSICS, None)


class _StopOnDivergence(StepObserver):
    def __init__(self, runner: ShardRunner) -> None:
        self._runner = runner

    def on_divergence(self, found: list[Divergence], pending: bool) -> None:
        first = self._runner.env.shard.first
        renumbered = [replace(divergence, env=divergence.env + first) for divergence in found]
        self._runner.stop(Stage.QUARANTINED if pending else Stage.DIVERGED, renumbered)


class _StopOnStep(StepObserver):
    def __init__(self, runner: ShardRunner) -> None:
        self._runner = runner

    def on_step(self, record: StepRecord) -> None:
        self._runner.stop(Stage.ON_STEP, self._runner.publish_record(record))


def read_episodes(
    arrays: Mapping[str, Tensor], shards: Sequence[Shard], columns: Sequence[Columns | None]
) -> Episodes | None:
    """Return the finished episodes of all shards in the order of their environments; None if there are none.

    Args:
        arrays: the shared tensors.
        shards: the shards.
        columns: names of the columns of each shard.
    """
    counts = arrays["counts"][:, 0].tolist()
    ended = [(shard, names, n) for shard, names, n in zip(shards, columns, counts, strict=True) if n and names]
    if not ended:
        return None
    # a simulation that diverged adds a cause in its shard alone
    widest = max((names for _, names, _ in ended), key=lambda names: len(names.causes))
    parts = []
    for shard, names, n in ended:
        part = arrays["episodes"][: names.count, shard.first : shard.first + n].numpy()
        parts.append(part if names.causes == widest.causes else _with_causes(part, names, widest))
    table = torch.from_numpy(np.concatenate(parts, axis=1))
    values, flags = table.float().unbind(), (table != 0.0).unbind()
    first = _FIXED_COLUMNS

    def take(names: Sequence[str], columns: Sequence[Tensor]) -> dict[str, Tensor]:
        nonlocal first
        first += len(names)
        return dict(zip(names, columns[first - len(names) : first], strict=True))

    terms, causes, metrics = take(widest.terms, values), take(widest.causes, flags), take(widest.metrics, values)
    conditions, condition_values = take(widest.conditions, flags), take(widest.condition_values, values)
    success = flags[first] if widest.conditions else None
    fixed = (table[0].long(), values[1], table[2].long(), terms, causes, flags[3])
    return Episodes(*fixed, success, conditions, condition_values, metrics)


def _with_causes(part: NDArray[np.float64], names: Columns, widest: Columns) -> NDArray[np.float64]:
    """Return a shard's values of finished episodes, with a column for every cause in `widest`.

    A shard has a column for a cause of an episode's end, such as a divergence, only if this cause has occurred in it.
    A missing column is filled with zeros.

    Args:
        part: values of the shard's finished episodes, one row for each column.
        names: columns of this shard.
        widest: columns with the causes of all shards.
    """
    begin = _FIXED_COLUMNS + len(names.terms)
    own = dict(zip(names.causes, part[begin:], strict=False))
    none = np.zeros_like(part[0])
    causes = [own.get(name, none) for name in widest.causes]
    return np.stack([*part[:begin], *causes, *part[begin + len(names.causes) :]])
