"""Observations: groups of terms side by side, each run through its pipeline of noise, clip, scale, delay, history."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import ObservationGroupConfig
from rlcli.managers.observation_pipeline import Draws, Pipeline
from rlcli.managers.term import BoundTerm, check_shape, first_value
from rlcli.managers.tunable import TunableValues
from rlcli.sim.selection import Selection
from rlcli.sim.state_cache import is_finite
from rlcli.sim.tensor_state import TensorState


@dataclass(slots=True)
class _Group:
    pipelines: list[Pipeline]
    buffers: list[Tensor]
    views: list[list[Tensor]]
    next: int = 0


Watch = Callable[[Tensor, str], None]
"""Notes, without waiting for a device, if values are not finite: (values, what they are)."""

_FINAL = np.uint64(0x46494E414C)
"""The last observation of an episode draws apart, so that the first of the next one is not seen with its noise."""


class ObservationManager(TensorState):
    """Computes every group into one of three buffers in turn, so that consecutive observations share no memory.

    Args:
        groups: the bound terms of each group.
        configs: the groups' settings.
        step_dt: control period [s].
        now: gives all environments, drawing by the step's counter.
        tunable: what a curriculum moves.
        watch: notes what is not finite; None checks at once.
    """

    def __init__(
        self,
        groups: dict[str, list[BoundTerm]],
        configs: Mapping[str, ObservationGroupConfig],
        num_envs: int,
        step_dt: float,
        device: torch.device,
        now: Callable[[], Selection],
        tunable: TunableValues,
        watch: Watch | None = None,
    ) -> None:
        self.num_envs = num_envs
        self._device, self._step_dt, self._tunable, self._now, self._watch = device, step_dt, tunable, now, watch
        self.groups = {name: self._group(terms, configs[name]) for name, terms in groups.items()}
        self._final = {name: torch.zeros_like(group.buffers[0]) for name, group in self.groups.items()}
        self._final_views = {name: _split(self._final[name], group.pipelines) for name, group in self.groups.items()}
        self._fresh: Selection | None = None
        self._forget = [
            reset for group in self.groups.values() for pipeline in group.pipelines for reset in pipeline.resets
        ]

    def compute(self) -> dict[str, Tensor]:
        """Observations of the state as it is. (num_envs, d) each"""
        result, draws = {}, self._draws(np.uint64(0))
        for name, group in self.groups.items():
            group.next = (group.next + 1) % len(group.buffers)
            self._fill(group, group.views[group.next], draws, advance=True)
            result[name] = group.buffers[group.next]
            self._require_finite(name, group, result[name])
        self._fresh = None
        return result

    def compute_final(self) -> dict[str, Tensor]:
        """The same into a buffer of its own; nothing that has a memory moves on."""
        draws = self._draws(_FINAL)
        for name, group in self.groups.items():
            self._fill(group, self._final_views[name], draws, advance=False)
            self._require_finite(name, group, self._final[name])
        return self._final

    def again(self) -> dict[str, Tensor]:
        """The observations that `compute` gave last, after `load_state_dict`."""
        result, draws = {}, self._draws(np.uint64(0))
        for name, group in self.groups.items():
            if not _has_memory(group):
                self._fill(group, group.views[group.next], draws, advance=True)
            result[name] = group.buffers[group.next]
        return result

    def reset(self, selection: Selection) -> None:
        """New episodes begin: histories and delays start from their first value."""
        self._fresh = selection
        for reset in self._forget:
            reset(selection)

    def pipelines(self, group: str) -> list[Pipeline]:
        """The terms of a group with what is done to them."""
        return self.groups[group].pipelines

    def tensors(self) -> dict[str, Tensor]:
        """Return what pipelines carry from step to step, and the last observations of the groups that do."""
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
        everyone: list[Selection] = []  # made when somebody draws, once a step

        def draws(stream: np.uint64) -> Selection:
            if not everyone:
                everyone.append(self._now())
            return everyone[0].stream(stream ^ salt)

        return draws

    def _fill(self, group: _Group, views: list[Tensor], draws: Draws, *, advance: bool) -> None:
        for pipeline, view in zip(group.pipelines, views, strict=True):
            pipeline.write(view, draws, self._fresh, advance)

    def _group(self, terms: list[BoundTerm], config: ObservationGroupConfig) -> _Group:
        pipelines = []
        for term in terms:
            value = first_value(term)
            dims = value.dim() if isinstance(value, Tensor) else 0
            shape = tuple(value.shape[1:]) if dims in (2, 4) else (1,)  # columns, or a picture
            check_shape(term, value, (self.num_envs, *shape))
            pipelines.append(Pipeline(term, shape, config, self.num_envs, self._step_dt, self._device, self._tunable))
        size = sum(pipeline.size for pipeline in pipelines)
        buffers = [torch.zeros(self.num_envs, size, device=self._device) for _ in range(3)]
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
