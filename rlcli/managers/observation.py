"""Observations: groups of terms, each term clipped, then scaled, then written to its columns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.errors import ConfigError, DivergedError, Problem
from rlcli.managers.term import BoundTerm, check_shape, first_value
from rlcli.sim.entity import is_finite
from rlcli.sim.selection import Selection


@dataclass(slots=True)
class _Group:
    terms: list[BoundTerm]
    sizes: list[int]
    buffers: list[Tensor]
    views: list[list[Tensor]]
    adjust: list[Callable[[Tensor], None] | None]
    next: int = 0


Watch = Callable[[Tensor, str], None]
"""Notes, without waiting for a device, if values are not finite: (values, what they are)."""


class ObservationManager:
    """Computes every group into one of three buffers in turn, so that consecutive observations share no memory."""

    def __init__(
        self,
        groups: dict[str, list[BoundTerm]],
        num_envs: int,
        device: torch.device,
        watch: Watch | None = None,
    ) -> None:
        self.num_envs = num_envs
        self._watch = watch
        self.groups = {name: self._group(terms, device) for name, terms in groups.items()}
        self._final = {name: torch.zeros_like(group.buffers[0]) for name, group in self.groups.items()}
        self._final_views = {name: _split(self._final[name], group.sizes) for name, group in self.groups.items()}

    def compute(self) -> dict[str, Tensor]:
        """Observations of the state as it is. (num_envs, d) each"""
        result = {}
        for name, group in self.groups.items():
            group.next = (group.next + 1) % len(group.buffers)
            self._fill(group, group.views[group.next])
            result[name] = group.buffers[group.next]
            self._require_finite(name, group, result[name])
        return result

    def compute_final(self) -> dict[str, Tensor]:
        """The same into a buffer of its own; nothing that has a memory moves on."""
        for name, group in self.groups.items():
            self._fill(group, self._final_views[name])
            self._require_finite(name, group, self._final[name])
        return self._final

    def reset(self, selection: Selection) -> None:
        """Tell terms with memory."""
        for group in self.groups.values():
            for term in group.terms:
                term.reset(selection)

    def sizes(self, group: str) -> list[tuple[BoundTerm, int]]:
        """The terms of a group with their columns."""
        return list(zip(self.groups[group].terms, self.groups[group].sizes, strict=True))

    def _fill(self, group: _Group, views: list[Tensor]) -> None:
        for term, view, adjust in zip(group.terms, views, group.adjust, strict=True):
            view.copy_(term.call())
            if adjust is not None:
                adjust(view)

    def _group(self, terms: list[BoundTerm], device: torch.device) -> _Group:
        sizes = []
        for term in terms:
            value = first_value(term)
            width = value.shape[1] if isinstance(value, Tensor) and value.dim() == 2 else 1
            check_shape(term, value, (self.num_envs, width), "observations")
            sizes.append(width)
        buffers = [torch.zeros(self.num_envs, sum(sizes), device=device) for _ in range(3)]
        adjust = [_adjustment(term, size, device) for term, size in zip(terms, sizes, strict=True)]
        return _Group(terms, sizes, buffers, [_split(buffer, sizes) for buffer in buffers], adjust)

    def _require_finite(self, name: str, group: _Group, values: Tensor) -> None:
        if self._watch is not None:
            self._watch(values, f"observation group '{name}'")
            return
        if is_finite(values):
            return
        for term, view in zip(group.terms, _split(values, group.sizes), strict=True):
            bad = ~view.isfinite().all(dim=1)
            if bool(bad.any()):
                first = int(bad.nonzero()[0, 0])
                raise DivergedError(
                    f"observation '{name}.{term.name}' ({term.config.func}) is not finite in {int(bad.sum())}"
                    f" environments, first in environment {first}"
                )


def _split(buffer: Tensor, sizes: list[int]) -> list[Tensor]:
    return list(buffer.split(sizes, dim=1))


def _adjustment(term: BoundTerm, size: int, device: torch.device) -> Callable[[Tensor], None] | None:
    clip, scale = term.config.clip, term.config.scale  # type: ignore[attr-defined]
    if clip is None and scale is None:
        return None
    factor = torch.tensor(1.0 if scale is None else scale, device=device)
    if factor.dim() == 1 and len(factor) != size:
        path = ".".join(map(str, (*term.path, "scale")))
        raise ConfigError([Problem("observations", path, f"has {len(factor)} values for {size} columns")])

    def adjust(view: Tensor) -> None:
        if clip is not None:
            view.clamp_(*clip)
        if scale is not None:
            view.mul_(factor)

    return adjust
