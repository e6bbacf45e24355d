"""Object with the interface of one physics engine, for environments whose engines run in several processes.

A shard is the part of the environments that one process steps; the main process steps the first shard.
Observers, recordings and reports use the object like the engine of a single process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.sim.divergence_report import HISTORY_MEMORY, Call, StateHistory, StateLayout

if TYPE_CHECKING:
    from rlcli.envs.vec_env import VecEnv

N = TypeVar("N", int, float)


class Shards(Protocol):
    """Interface of an environment in several processes: call a function in each process, or in one of them."""

    @property
    def local(self) -> VecEnv:
        """The environment of the first shard."""

    def call_all(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Return the results of `function(vec_env, *arguments)`, called in every shard, in order."""

    def call_one(self, env: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return `function(vec_env, row, *arguments)`, called in the shard of environment `env`.

        `row` is the index of the environment in that shard.
        """


class ShardedEngine:
    """Engine with the simulations (worlds) of all shards. Each call copies data from the worker processes.

    Args:
        shards: the shards.
        num_envs: number of worlds.
    """

    asynchronous = False

    def __init__(self, shards: Shards, num_envs: int) -> None:
        self._shards, self.num_envs = shards, num_envs
        local = shards.local.engine.replayable
        assert local is not None
        self._local = local
        self.device: torch.device = self._local.device
        self.model: mujoco.MjModel = self._local.model
        self.shared_streams: int = self._local.shared_streams
        self.state_layout: StateLayout = self._local.state_layout
        self.forces_after_reset: bool = self._local.forces_after_reset
        self.threads: int = sum(shards.call_all(attrgetter("engine.threads")))

    @property
    def replayable(self) -> ShardedEngine:
        """This engine: its steps can be repeated bit for bit."""
        return self

    @property
    def step_stage(self) -> int:
        """Stage (mjtStage) up to which `step` recomputes derived fields, such as xpos, after its last physics step."""
        return self._local.step_stage

    @property
    def history(self) -> StateHistory:
        """States before the last calls of `step`, but only those of the first shard's environments.

        All shards record the same number of calls; `recorded_calls` returns the recorded calls of any environment.
        """
        return self._local.history

    @property
    def own_constants(self) -> bool:
        """Whether each world has its own values of MuJoCo's derived constants (`Engine.set_constants`)."""
        return self._local.own_constants

    @property
    def warnings(self) -> dict[str, int]:
        """Number of MuJoCo's warnings that are not a divergence, by name."""
        return sums(self._shards.call_all(attrgetter("engine.warnings")))

    @property
    def divergence_causes(self) -> dict[str, int]:
        """Number of divergences since the start, by cause."""
        return sums(self._shards.call_all(attrgetter("engine.divergence_causes")))

    def field(self, name: str) -> Tensor:
        """Return a copy of an MjData field. (num_envs, ...)"""
        return torch.cat(self._shards.call_all(_field, name))

    def expanded_fields(self) -> list[str]:
        """Return the names of the model fields for which each world has its own values (see `Engine.expand`)."""
        return self._local.expanded_fields()

    def record_calls(self, calls: int, memory: int = HISTORY_MEMORY) -> None:
        """Record the states before the last `calls` calls of `step`; fewer calls if `memory` bytes are too little."""
        width = self.num_envs * self.history.width * 8
        self._shards.call_all(_record_calls, max(1, min(calls, memory // max(1, width))))

    def recorded_calls(self, env: int) -> list[Call]:
        """Return the recorded calls of `step` in a world's present episode, the oldest first."""
        return list(self._shards.call_one(env, _recorded_calls))

    def state_row(self, env: int) -> NDArray[np.float64]:
        """Return a copy of a world's integration state (mjSTATE_INTEGRATION). (nstate,)"""
        row: NDArray[np.float64] = self._shards.call_one(env, _state_row)
        return row

    def state_rows(self, envs: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return copies of the integration states (mjSTATE_INTEGRATION) of the worlds `envs`. (n, nstate)"""
        states: NDArray[np.float64] = np.concatenate(self._shards.call_all(_all_states))[envs]
        return states

    def own_model_fields(self, env: int) -> dict[str, NDArray[Any]]:
        """Return copies of one world's values of the model fields that differ between worlds, by name."""
        return dict(self._shards.call_one(env, _own_model_fields))


def sums(counts: Sequence[Mapping[str, N]]) -> dict[str, N]:
    """Return the sum of the counts of all shards for each name, in one mapping."""
    names = dict.fromkeys(name for count in counts for name in count)
    return {name: sum(count.get(name, 0) for count in counts) for name in names}


def _field(env: VecEnv, name: str) -> Tensor:
    return env.engine.field(name).clone()


def _record_calls(env: VecEnv, calls: int) -> None:
    assert env.engine.replayable is not None
    env.engine.replayable.record_calls(calls, 1 << 62)


def _recorded_calls(env: VecEnv, row: int) -> list[Call]:
    assert env.engine.replayable is not None
    return env.engine.replayable.recorded_calls(row)


def _state_row(env: VecEnv, row: int) -> NDArray[np.float64]:
    assert env.engine.replayable is not None
    return env.engine.replayable.state_row(row)


def _all_states(env: VecEnv) -> NDArray[np.float64]:
    assert env.engine.replayable is not None
    return env.engine.replayable.state_rows(np.arange(env.num_envs))


def _own_model_fields(env: VecEnv, row: int) -> dict[str, NDArray[Any]]:
    assert env.engine.replayable is not None
    return env.engine.replayable.own_model_fields(row)
