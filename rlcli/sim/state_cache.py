"""Copy of the engine's state in float32, which the terms of a task read.

Positions and velocities are copied once per step, derived fields such as xpos when a term reads them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from rlcli.sim.engine import Engine
from rlcli.sim.env_selection import Columns, Selection, ids_of


def is_finite(values: Tensor) -> bool:
    """Return whether all values are finite; usually one pass is enough: a finite sum has only finite terms."""
    return math.isfinite(values.sum().item()) or bool(values.isfinite().all())


class SimData:
    """Copy of the engine's qpos and qvel in float32, made once per step; derived fields are copied when they are read.

    `qpos` (num_envs, nq) and `qvel` (num_envs, nv) never change their storage, so views of them stay valid. If the two
    are neighbours in the engine's memory, they are copied together. For an engine in float32, `qpos` and `qvel` are the
    engine's own tensors.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        qpos, qvel = engine.field("qpos"), engine.field("qvel")
        joined = _joined(qpos, qvel)
        self._sources = [qpos, qvel] if joined is None else [joined]
        self._copies = [source.to(torch.float32).contiguous() for source in self._sources]
        self._flat = [copy.view(-1) for copy in self._copies]
        own = self._copies[0] is self._sources[0]
        # an engine in float64 is on the CPU, where numpy copies small arrays in half the time of torch
        pairs = [] if own else zip(self._copies, self._sources, strict=True)
        self._copied = [(copy.numpy(), source.numpy()) for copy, source in pairs]
        self._saved = [copy.copy() for copy, _ in self._copied]
        self.qpos = self._copies[0][:, : qpos.shape[1]]
        self.qvel = self._copies[-1][:, -qvel.shape[1] :] if qvel.shape[1] else self._copies[-1][:, :0]
        self.stamp = 0
        """Number of updates of the state so far; a value that was cached at another number is out of date."""
        self.command_stamp = 0
        """Number of updates of the commands so far; an update makes the values cached by `once_per_goal` outdated."""
        self._goals: dict[tuple[object, ...], tuple[tuple[int, int, int], Tensor]] = {}
        self._saved_at, self._summed = -1, (-1, 0.0)
        self._moved: Selection | None = None
        self._derived: dict[str, tuple[int, Tensor]] = {}

    def on_moved(self, selection: Selection) -> None:
        """Update the copies and the derived fields of the selected worlds; call it after a write to their state.

        A GPU engine can only update all worlds at once; with it, derived fields are updated at their next read.
        """
        if not self.engine.asynchronous:
            self.engine.forward(selection)
        else:
            self._moved = selection if self._moved is None else self._moved.union(selection)
        self.refresh_rows(selection)

    def forward_moved(self) -> None:
        """Compute the derived fields of the worlds for which `on_moved` has postponed the computation."""
        if self._moved is not None:
            selection, self._moved = self._moved, None
            self.engine.forward(selection)

    def refresh(self) -> None:
        """Copy qpos and qvel of every world from the engine; values computed from the old state are outdated."""
        with np.errstate(over="ignore"):  # a value too large for float32 becomes infinity, which `is_finite` finds
            for copy, source in self._copied:
                copy[...] = source
        self.stamp += 1

    def refresh_rows(self, selection: Selection) -> None:
        """Copy qpos and qvel of the selected worlds from the engine; values computed from the old ones are outdated."""
        with np.errstate(over="ignore"):
            for copy, source in self._copied:
                rows = ids_of(selection)
                copy[rows] = source[rows]
        self.stamp += 1

    def save_good_state(self) -> None:
        """Save qpos and qvel of every world for `restore_rows`; call it only when all are finite and within bounds."""
        if self._saved_at == self.stamp:
            return
        self._saved_at = self.stamp
        for saved, (copy, _) in zip(self._saved, self._copied, strict=True):
            saved[...] = copy

    def restore_rows(self, selection: Selection) -> None:
        """Write qpos and qvel of the selected worlds, as `save_good_state` saved them last, back to the engine."""
        for saved, (_, source) in zip(self._saved, self._copied, strict=True):
            rows = ids_of(selection)
            source[rows] = saved[rows]

    def is_finite(self) -> bool:
        """Return whether all positions and velocities were finite at the last `refresh`."""
        return math.isfinite(self._squares()) or all(bool(flat.isfinite().all()) for flat in self._flat)

    def out_of_bounds(self, limit: float) -> Tensor | None:
        """Return whether each world has a position or velocity that is not finite or beyond `limit`, (num_envs,) bool.

        Return None if no world has such a value.
        """
        # the sum of all squares is an upper bound of each, and not finite if one is not; 0.5 covers its rounding
        if self._squares() <= 0.5 * limit * limit:
            return None
        bad = [~(copy.abs() <= limit).all(dim=1) for copy in self._copies]
        return torch.stack(bad).any(dim=0)

    def _squares(self) -> float:
        """Return the sum of the squares of all positions and velocities, computed once per step."""
        at, total = self._summed
        if at != self.stamp:
            total = 0.0
            for flat in self._flat:
                total += torch.dot(flat, flat).item()
            self._summed = self.stamp, total
        return total

    def derived_field(self, name: str) -> Tensor:
        """Return a derived MjData field, such as xpos, in float32, cast once per step. (num_envs, ...)"""
        self.forward_moved()
        stamp, value = self._derived.get(name, (-1, None))
        if stamp != self.stamp or value is None:
            value = self.engine.field(name).float()
            self._derived[name] = (self.stamp, value)
        return value

    def once_per_goal(self, key: tuple[object, ...], command: Tensor, compute: Callable[[], Tensor]) -> Tensor:
        """Return `compute()`, cached under `key` until the state or the command changes.

        Terms use this for quantities that several of them need in a step, such as the distance to a goal.

        Args:
            key: name of the quantity, and what it depends on.
            command: the command whose changes make the value outdated. (num_envs, ...)
            compute: function that computes the value.
        """
        # torch counts its own writes to a tensor; commands that managers write through numpy change `command_stamp`
        writes = 0 if command.is_inference() else command._version
        stamps = (self.stamp, self.command_stamp, writes)
        found, value = self._goals.get(key, (None, None))
        if value is None or found != stamps:
            value = compute()
            self._goals[key] = (stamps, value)
        return value

    def derived_columns(self, name: str, columns: Columns) -> Tensor:
        """Return `derived_field(name)[:, columns]`; only these columns are cast. (num_envs, k, ...)"""
        return self._of_columns(name, columns).float()

    def derived_vectors(self, name: str, columns: Columns) -> Tensor:
        """Return `derived_columns` with the environments as the last dimension, contiguous. (k, ..., num_envs)"""
        part = self._of_columns(name, columns).movedim(0, -1)
        return part.to(torch.float32, memory_format=torch.contiguous_format).contiguous()

    def _of_columns(self, name: str, columns: Columns) -> Tensor:
        self.forward_moved()
        stamp, value = self._derived.get(name, (-1, None))
        source = self.engine.field(name) if stamp != self.stamp or value is None else value
        return source[:, columns]


def _joined(left: Tensor, right: Tensor) -> Tensor | None:
    """Return one view of two 2-d views if they are neighbouring columns of the same memory; else None."""
    neighbours = (
        left.dtype == right.dtype
        and left.stride() == right.stride()
        and left.untyped_storage().data_ptr() == right.untyped_storage().data_ptr()
        and right.data_ptr() == left.data_ptr() + left.shape[1] * left.element_size()
    )
    if not neighbours:
        return None
    return left.as_strided((left.shape[0], left.shape[1] + right.shape[1]), left.stride())
