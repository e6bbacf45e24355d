"""Which column of an observation or of an action is what: the contract between a policy and its environment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class TermLayout:
    """Some columns of an observation group or of the action: where they come from."""

    name: str
    size: int
    elements: tuple[str, ...] = ()
    unit: str = ""
    scale: tuple[float, ...] | None = None
    """Factor of each column; None: not scaled, or (an action) in the task's own way."""
    clip: tuple[float, float] | tuple[tuple[float, float], ...] | None = None
    """Limits: of an observation's columns before they are scaled; of an action's, each its own, after scale and
    offset."""
    offset: tuple[float, ...] | None = None
    """What is added to each column of an action after scaling."""
    limits: tuple[tuple[float, float], ...] | None = None
    """What the actuator of each column of an action can take, infinite where it has no limit."""
    history: int = 1
    """Steps that an observation holds, columns of the oldest first."""
    shape: tuple[int, ...] = ()
    """What the columns of one step of an observation are row by row, as (channels, rows, columns) of a picture; (): a
    plain row."""
    modifiers: tuple[dict[str, Any], ...] = ()
    """What is done to an observation's value before it is clipped, as the YAML says it."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The contract between a policy and its environment; a checkpoint keeps it."""

    observations: dict[str, tuple[TermLayout, ...]]
    actions: tuple[TermLayout, ...]
    step_dt: float
    dt: float
    decimation: int

    def size(self, group: str = "policy") -> int:
        """Columns of an observation group."""
        return sum(term.size for term in self.observations[group])

    @property
    def action_size(self) -> int:
        """Columns of the action."""
        return sum(term.size for term in self.actions)

    def action_columns(self) -> list[str]:
        """Return a name for each column of the action: `term.element`, or `term[3]` where elements have no names."""
        return [
            f"{term.name}.{term.elements[i]}" if i < len(term.elements) else f"{term.name}[{i}]"
            for term in self.actions
            for i in range(term.size)
        ]

    def record(self) -> dict[str, Any]:
        """Return the layout as plain JSON."""

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
    """As JSON, which has no infinity."""
    return [[x if math.isfinite(x) else None for x in pair] for pair in pairs or ()] or None
