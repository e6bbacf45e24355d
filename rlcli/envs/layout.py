"""Description of each column of observations and actions (term, scale, limits), which a checkpoint stores.

A policy fits an environment only if both have the same layout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class TermLayout:
    """Columns of one term in an observation group or in the action."""

    name: str
    size: int
    elements: tuple[str, ...] = ()
    """Name of each column, such as a joint; empty: the columns have no names."""
    unit: str = ""
    """Unit of the values; empty: unknown or none."""
    scale: tuple[float, ...] | None = None
    """Factor of each column; None: no scale, or the task's own code scales the action."""
    clip: tuple[float, float] | tuple[tuple[float, float], ...] | None = None
    """Limits of the columns; None: no limits.

    Observation: one pair for all columns, before the scale. Action: a pair for each column, after scale and offset.
    """
    offset: tuple[float, ...] | None = None
    """Number that is added to each column of an action after scaling."""
    limits: tuple[tuple[float, float], ...] | None = None
    """Limits of each action column's actuator, infinite for an actuator without a limit."""
    history: int = 1
    """Number of steps that an observation contains; the columns of the oldest step come first."""
    shape: tuple[int, ...] = ()
    """Shape of one step of an observation, whose columns are in row-major order; (): a plain row.

    An image has (channels, rows, columns).
    """
    modifiers: tuple[dict[str, Any], ...] = ()
    """Modifiers of an observation before it is clipped, with their keys of the YAML."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the observation and action columns for which a policy is trained; a checkpoint contains it."""

    observations: dict[str, tuple[TermLayout, ...]]
    actions: tuple[TermLayout, ...]
    step_dt: float
    """Control period [s]."""
    dt: float
    """Period of a physics step [s]."""
    decimation: int

    def size(self, group: str = "policy") -> int:
        """Return the number of columns of an observation group."""
        return sum(term.size for term in self.observations[group])

    @property
    def action_size(self) -> int:
        """Number of columns of the action."""
        return sum(term.size for term in self.actions)

    def action_columns(self) -> list[str]:
        """Return a name for each column of the action: `term.element`, or `term[3]` where elements have no names."""
        return [
            f"{term.name}.{term.elements[i]}" if i < len(term.elements) else f"{term.name}[{i}]"
            for term in self.actions
            for i in range(term.size)
        ]

    def record(self) -> dict[str, Any]:
        """Return the layout as data for JSON."""

        def term(t: TermLayout) -> dict[str, Any]:
            return {
                "name": t.name,
                "size": t.size,
                "elements": list(t.elements),
                "unit": t.unit,
                "scale": None if t.scale is None else list(t.scale),
            }

        def observation(t: TermLayout) -> dict[str, Any]:
            clip = None if t.clip is None else list(t.clip)
            shape = {"shape": list(t.shape)} if t.shape else {}
            return {**term(t), "clip": clip, "history": t.history, **shape, "modifiers": list(t.modifiers)}

        def action(t: TermLayout) -> dict[str, Any]:
            bounds = {"clip": _finite_pairs(t.clip), "limits": _finite_pairs(t.limits)}  # type: ignore[arg-type]
            return {**term(t), "offset": None if t.offset is None else list(t.offset), **bounds}

        return {
            "observations": {group: [observation(t) for t in items] for group, items in self.observations.items()},
            "actions": [action(t) for t in self.actions],
            "step_dt": self.step_dt,
            "dt": self.dt,
            "decimation": self.decimation,
        }


def _finite_pairs(pairs: tuple[tuple[float, float], ...] | None) -> list[list[float | None]] | None:
    """Return (low, high) pairs as lists, with None for infinity, which JSON does not have; None without pairs."""
    return [[x if math.isfinite(x) else None for x in pair] for pair in pairs or ()] or None
