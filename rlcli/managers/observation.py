"""Manager of the observation groups (vectors of term values for the policy, the critic and so on).

A pipeline of operations (noise, scale, delay, ...) changes the value of each term.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import ObservationGroupConfig
from rlcli.managers.observation_pipeline import Pipeline
from rlcli.managers.observation_stages import Draws
from rlcli.managers.term_binding import BoundTerm, EnvContext, first_value
from rlcli.sim.env_selection import Selection
from rlcli.sim.saved_tensors import TensorState
from rlcli.sim.state_cache import is_finite


@dataclass(slots=True)
class _Group:
    """Observation group: pipelines of its terms, its buffers, and the columns of each term in each buffer."""

    pipelines: list[Pipeline]
    buffers: list[Tensor]
    views: list[list[Tensor]]
    next: int = 0
    """Index of the buffer with the last observations."""


_FINAL = np.uint64(0x46494E414C)
"""Number that changes the random streams for final observations: their noise differs from that of other observations.

It is combined with the index of a stream by xor.
"""


class ObservationManager(TensorState):
    """Manager of the observation terms: it computes the observations of each group.

    Each group has three buffers, which are used in turn, so observations stay valid during the next two steps.

    Args:
        groups: the bound terms of each group.
        configs: the settings of the groups.
        context: parts of the environment. A GPU engine records values that are not finite, and the environment raises
            the error later (`check`); on a CPU the error is raised at once.
    """

    def __init__(
        self, groups: dict[str, list[BoundTerm]], configs: Mapping[str, ObservationGroupConfig], context: EnvContext
    ) -> None:
        self._context, engine = context, context.engine
        self._watch = engine.check_finite if engine.asynchronous else None
        self.groups = {name: self._group(terms, configs[name]) for name, terms in groups.items()}
        self._final = {name: torch.zeros_like(group.buffers[0]) for name, group in self.groups.items()}
        self._final_views = {name: _split(self._final[name], group.pipelines) for name, group in self.groups.items()}
        self._fresh: Selection | None = None
        self.repeats_calls = False
        """Whether terms are called once more for a step: a term with a state must not advance then."""
        self._term_resets = [
            reset for group in self.groups.values() for pipeline in group.pipelines for reset in pipeline.resets
        ]

    def compute(self) -> dict[str, Tensor]:
        """Return the observations of the current state by group. (num_envs, d) each"""
        result, draws = {}, self._draws(np.uint64(0))
        for name, group in self.groups.items():
            group.next = (group.next + 1) % len(group.buffers)
            self._fill(group, group.views[group.next], draws, advance=True)
            result[name] = group.buffers[group.next]
            self._require_finite(name, group, result[name])
        self._fresh = None
        return result

    def compute_final(self, rows: Selection | None = None) -> dict[str, Tensor]:
        """Return the observations of the last states of episodes, by group, in separate buffers. (num_envs, d) each

        Histories, delays and filters do not advance.

        Args:
            rows: the environments to compute, with random numbers that depend on the current step; other rows of the
                result are not valid. None: all environments.
        """
        draws = self._draws(_FINAL)
        self.repeats_calls = True
        for name, group in self.groups.items():
            for pipeline, view in zip(group.pipelines, self._final_views[name], strict=True):
                if rows is None or pipeline.has_memory or pipeline.is_plain:
                    pipeline.write(view, draws, self._fresh, False)
                else:
                    pipeline.write_rows(view, rows, _FINAL)
            self._require_finite(name, group, self._final[name])
        self.repeats_calls = False
        return self._final

    def recompute_last(self) -> dict[str, Tensor]:
        """Return the observations of the last `compute` again; used after `load_state_dict`."""
        result, draws = {}, self._draws(np.uint64(0))
        self.repeats_calls = True
        for name, group in self.groups.items():
            if not _has_memory(group):
                self._fill(group, group.views[group.next], draws, advance=True)
            result[name] = group.buffers[group.next]
        self.repeats_calls = False
        return result

    def reset(self, selection: Selection) -> None:
        """Start new episodes: histories and delays begin with the first value of the new episode."""
        self._fresh = selection
        for reset in self._term_resets:
            reset(selection)

    def pipelines(self, group: str) -> list[Pipeline]:
        """Return the pipelines of the terms of a group."""
        return self.groups[group].pipelines

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors to save: the tensors of the pipelines, and last observations of groups with a history."""
        tensors = {
            f"{name}.{pipeline.term.name}.{key}": tensor
            for name, group in self.groups.items()
            for pipeline in group.pipelines
            for key, tensor in pipeline.tensors().items()
        }
        last = {f"last.{name}": g.buffers[g.next] for name, g in self.groups.items() if _has_memory(g)}
        return {**tensors, **last}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""
        super().load_state_dict(state)
        self._fresh = None

    def _draws(self, salt: np.uint64) -> Draws:
        all_envs = functools.cache(self._context.select_all)  # made when a step first needs random numbers
        return lambda stream: all_envs().stream(stream ^ salt)

    def _fill(self, group: _Group, views: list[Tensor], draws: Draws, *, advance: bool) -> None:
        for pipeline, view in zip(group.pipelines, views, strict=True):
            pipeline.write(view, draws, self._fresh, advance)

    def _group(self, terms: list[BoundTerm], config: ObservationGroupConfig) -> _Group:
        pipelines = []
        for term in terms:
            value = first_value(term)
            dims = value.dim() if isinstance(value, Tensor) and not value.is_nested else 0
            shape = tuple(value.shape[1:]) if dims in (2, 4) else (1,)  # columns, or an image
            pipelines.append(Pipeline(term, value, shape, config, self._context))
        size = sum(pipeline.size for pipeline in pipelines)
        buffers = [self._context.zeros(size) for _ in range(3)]
        return _Group(pipelines, buffers, [_split(buffer, pipelines) for buffer in buffers])

    def _require_finite(self, name: str, group: _Group, values: Tensor) -> None:
        if self._watch is not None:
            self._watch(values, f"observation group '{name}'")
            return
        if is_finite(values):
            return
        for pipeline, view in zip(group.pipelines, _split(values, group.pipelines), strict=True):
            pipeline.term.require_finite(view, f"observation '{name}.{pipeline.term.name}'")


def _has_memory(group: _Group) -> bool:
    return any(pipeline.has_memory for pipeline in group.pipelines)


def _split(buffer: Tensor, pipelines: list[Pipeline]) -> list[Tensor]:
    return list(torch.split(buffer, [pipeline.size for pipeline in pipelines], dim=1))
