"""Manager of the command terms: goals that each environment samples at the start of an episode and at intervals."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from rlcli.errors import UsageError, did_you_mean, listing
from rlcli.managers.term_binding import BoundTerm, EnvContext, resets
from rlcli.sim.env_selection import Selection
from rlcli.sim.markers import Arrow, Frame, Marker, Sphere
from rlcli.sim.saved_tensors import TensorState

Select = Callable[[Tensor], Selection | None]
"""Function from a mask (num_envs,) to a `Selection` of the environments where it is true; None if there are none."""
_COLUMNS = {"start": 3, "end": 3, "center": 3, "position": 3, "quat": 4}
"""Field of a marker -> number of its columns; these fields have one row for each environment."""


class CommandTerm(Protocol):
    """Interface of a command term: a class `Name(env, *, ...)` whose keyword arguments are the term's keys in the YAML.

    Optional members:

    - `compute(count)`, if it exists, is called each step instead of `update()`: it calls `count()`, which counts the
      step of the timers and resamples, and updates the command.
    - `metrics() -> dict[str, Tensor]` returns how far the robot is from the command, (num_envs,) each. The means over
      an episode are logged.
    - `reset(selection)`, `state_dict()` and `load_state_dict(state)` are for further state of the term.
    - `elements` has the names of the columns of `command` that a user may set ("" for other columns), `limits` their
      usual [low, high], and `units` their units.
    - `mirror_signs` has +1 or -1 for each column: the command times these signs is the command of the robot's mirror
      image about its x-z plane. The agent's key `symmetry` needs these signs.

    `markers() -> list[Marker]` returns the command as arrows, spheres and frames (`rlcli.sim.markers`): positions in
    the world frame (num_envs, 3) [m], like `entity.data.root_pos_w`, and quaternions (w, x, y, z), (num_envs, 4).
    `markers` is called once for each image, never in a step, and must change nothing. It may read the state of roots
    and joints, and the fields that `metrics` or `update` read: a first read of another field makes the engine compute
    that field in each step.
    """

    command: Tensor
    """The command, always the same tensor. (num_envs, k)"""

    def resample(self, selection: Selection) -> None:
        """Draw new commands for the selected environments."""

    def update(self) -> None:
        """Update what depends on the state, such as a yaw rate from a heading; called each step, after `resample`."""


@dataclass(frozen=True, slots=True)
class Knob:
    """Column of a command that a person may set: in a viewer, or with `--command`."""

    name: str
    """Name of the knob: `ELEMENT`, or `TERM.ELEMENT` if several terms have an element of this name."""
    term: str
    """Name of the command term."""
    column: int
    """Column of the term's command."""
    low: float
    """Usual smallest value, for the slider of a viewer."""
    high: float
    """Usual largest value, for the slider of a viewer."""
    unit: str = ""
    """Unit of the value; empty: unknown."""

    @property
    def label(self) -> str:
        """Name and unit, as in `vx [m/s]`."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


class CommandManager(TensorState):
    """Manager of the command terms, with their timers and the sums of their metrics over an episode."""

    def __init__(self, terms: list[BoundTerm], context: EnvContext) -> None:
        self.terms = terms
        self._term_resets = [resets([term]) for term in terms]
        self._by_name = {term.name: term for term in terms}
        self._step_dt = context.step_dt
        self._times = [
            context.tunable.get((*term.path, "resampling_time_s"), term.config.resampling_time_s)  # type: ignore[attr-defined]
            for term in terms
        ]
        # whole steps: repeated subtraction of step_dt would accumulate rounding errors
        self._steps_left = torch.zeros(len(terms), context.num_envs, dtype=torch.int64, device=context.device)
        self._measured = [
            (f"{term.name}/{name}", term, name)
            for term in terms
            if hasattr(term.instance, "metrics")
            for name in term.instance.metrics()
        ]
        self._sums = context.zeros(len(self._measured))
        self._steps = context.zeros()
        self.held: dict[str, float] = {}
        """Name of a knob -> value that a person has set; it replaces the drawn values in every environment."""
        self._held_knobs: dict[str, Knob] = {}

    def knobs(self) -> list[Knob]:
        """Return a `Knob`, with name and range, for each column of the commands that a user can set in the viewer."""
        found = []
        for term in self.terms:
            width = term.instance.command.shape[1]
            names = getattr(term.instance, "elements", None) or [f"{term.name}[{column}]" for column in range(width)]
            limits, units = list(getattr(term.instance, "limits", ())), getattr(term.instance, "units", ())
            for column, name in enumerate(names[:width]):
                low, high = limits[column] if column < len(limits) else (-1.0, 1.0)
                low, high = (float(low), float(high)) if float(high) > float(low) else (-1.0, 1.0)
                if name:
                    found.append(Knob(name, term.name, column, low, high, units[column] if column < len(units) else ""))
        counts = Counter(knob.name for knob in found)
        return [replace(knob, name=f"{knob.term}.{knob.name}") if counts[knob.name] > 1 else knob for knob in found]

    def hold(self, name: str, value: float | None) -> None:
        """Set a column of a command in every environment, from the next step on.

        Args:
            name: name of the column, as in the `name` of its `Knob`.
            value: the value to hold; None: return to the values that the term draws.

        Raises:
            UsageError: for an unknown name, or a value that is not finite.
        """
        knobs = {name: knob for knob in self.knobs() for name in (f"{knob.term}.{knob.name}", knob.name)}
        if name not in knobs:
            names = [knob.name for knob in self.knobs()]
            known = f"commands: {listing(names)}" if names else "leave out --command: the task has no commands"
            near = did_you_mean(name, names)
            raise UsageError(f"the task has no command '{name}'", hint=f"{near} {known}" if near else known)
        if value is not None and not math.isfinite(value):
            raise UsageError(f"command '{name}' cannot be {value}", hint="give a finite number")
        knob = knobs[name]
        if value is None:
            self.held.pop(knob.name, None)
            self._held_knobs.pop(knob.name, None)
        else:
            self.held[knob.name], self._held_knobs[knob.name] = value, knob

    def value(self, knob: Knob, env_id: int) -> float:
        """Return the present value of a knob in one environment."""
        return float(self._by_name[knob.term].instance.command[env_id, knob.column])

    def markers(self) -> list[Marker]:
        """Return the markers of all terms; a marker without a label gets the name of its term.

        Raises:
            ShapeError: for a value that is not a marker with one row for each environment.
        """
        found: list[Marker] = []
        for term in self.terms:
            markers = list(term.instance.markers()) if hasattr(term.instance, "markers") else []
            for marker in markers:
                _require_marker(term, marker, len(self._steps))
            found += [marker if marker.label else marker._replace(label=term.name) for marker in markers]
        return found

    def get_command(self, name: str) -> Tensor:
        """Return the present command of a term, by its name in `commands:`. (num_envs, k)"""
        return self.get_term(name).command

    def get_term(self, name: str) -> CommandTerm:
        """Return a command term by its name in `commands:`."""
        term: CommandTerm = self._by_name[name].instance
        return term

    def time_left(self, name: str) -> Tensor:
        """Return the time until a command is resampled; the end of the episode may come first. (num_envs,) [s]"""
        number = list(self._by_name).index(name)
        return self._steps_left[number] * self._step_dt

    def set_time_left(self, name: str, where: Tensor, time: Tensor) -> None:
        """Set the time until a command is resampled, `time` [s], in the environments `where`. (num_envs,) each"""
        left = self._steps_left[list(self._by_name).index(name)]
        left.copy_(torch.where(where, _whole_steps(time.double() / self._step_dt), left))

    def measure(self) -> None:
        """Add the terms' metrics of this step to their sums over the episode, before commands are resampled."""
        if not self._measured:
            return
        terms = {term.name: term for _, term, _ in self._measured}
        metrics = {name: term.instance.metrics() for name, term in terms.items()}
        self._sums += torch.stack([metrics[term.name][name] for _, term, name in self._measured], dim=1)
        self._steps += 1.0

    def episode(self, ended: Selection) -> dict[str, Tensor]:
        """Return the means of the metrics over the episodes that end, by `TERM/METRIC`. (n,) each"""
        if not self._measured:
            return {}
        means = ended.read_view(self._sums) / ended.read_view(self._steps).clamp(min=1.0)[:, None]
        return {name: column for (name, _, _), column in zip(self._measured, means.unbind(1), strict=True)}

    def running_mean(self, term: CommandTerm, metric: str) -> Tensor:
        """Return the mean of a metric over the running episode, 0 before its first step. (num_envs,)"""
        column = [(other.instance, name) for _, other, name in self._measured].index((term, metric))
        return self._sums[:, column] / self._steps.clamp(min=1.0)

    def reset(self, selection: Selection) -> None:
        """Reset the terms and draw the first commands of new episodes."""
        if self._measured:
            selection.write(self._sums, 0.0)
            selection.write(self._steps, 0.0)
        for number, term_resets in enumerate(self._term_resets):
            for reset in term_resets:
                reset(selection)
            self._resample(number, selection, _FIRST)

    def compute(self, select: Select, running: Tensor) -> None:
        """Advance the resampling timers a step, resample commands whose timer has ended, and update all commands.

        Args:
            select: function from a mask to a selection, whose random numbers depend on the current step.
            running: 0 where an episode has just begun, so that its timer does not count yet, else 1. (num_envs,)
        """
        for number, term in enumerate(self.terms):
            count = functools.partial(self._count_step, number, select, running)
            if hasattr(term.instance, "compute"):
                term.instance.compute(count)
            else:
                count()
                term.instance.update()
        for name, knob in self._held_knobs.items():
            self._by_name[knob.term].instance.command[:, knob.column] = self.held[name]

    def _count_step(self, number: int, select: Select, running: Tensor) -> None:
        left = self._steps_left[number]
        left -= running
        due = select(left <= 0)
        if due is not None:
            self._resample(number, due, _NEXT)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors to save: resampling timers, sums of metrics, and commands, by name."""
        commands = {f"command.{term.name}": term.instance.command for term in self.terms}
        return {"steps_left": self._steps_left, "sums": self._sums, "steps": self._steps, **commands}

    def _resample(self, number: int, selection: Selection, when: np.uint64) -> None:
        term, (low, high) = self.terms[number], self._times[number]
        drawn = selection.stream(term.stream ^ when)
        steps = drawn.uniform(low, high).double() / self._step_dt
        selection.write(self._steps_left[number], _whole_steps(steps).clamp_(min=1))
        term.instance.resample(drawn)


def _whole_steps(steps: Tensor) -> Tensor:
    """Return a number of steps, rounded up; the slack absorbs rounding: 0.1 s at 0.02 s are 5 steps."""
    return (steps * (1.0 - 1e-6)).ceil_().long()


def _require_marker(term: BoundTerm, marker: Marker, num_envs: int) -> None:
    if not isinstance(marker, Arrow | Sphere | Frame):
        raise term.error(f"markers() returned a value of type {type(marker).__name__}; return Arrow, Sphere or Frame")
    for name, value in marker._asdict().items():
        expected = (num_envs, _COLUMNS.get(name, 0))
        if name in _COLUMNS and (not isinstance(value, Tensor) or value.shape != expected):
            found = f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"of type {type(value).__name__}"
            field = f"{type(marker).__name__}.{name}"
            raise term.error(f"markers() returned {field} {found}; return a tensor of shape {expected}")


# Two random streams: the first command of an episode depends on the episode's index, later ones on the step's.
_FIRST, _NEXT = np.uint64(0x434D_4446_5253), np.uint64(0x434D_444E_5854)
