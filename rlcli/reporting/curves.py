"""Learning curves of runs; runs that differ in their seed only are one curve.

A curve of several seeds is their interquartile mean with a 95 % interval from a stratified percentile bootstrap, as
Agarwal et al. recommend (Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021,
arXiv:2108.13264). The stratum is the task, of which a curve has one, so whole runs are drawn with replacement. The
draws have a fixed seed: the same runs give the same curves.
"""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlcli.config.layers import leaves
from rlcli.config.messages import dotted
from rlcli.errors import CheckpointError
from rlcli.runs.metric_rows import is_number, read_rows
from rlcli.runs.run import Run
from rlcli.safe_text import shorten

Array = NDArray[np.float64]

AXES = {"steps": "environment steps", "iterations": "iterations", "time": "training time [s]"}
"""Name of an x axis -> its label. Time is that of rollouts and updates, added up."""

RESAMPLES = 2000
_LEVEL = 95.0
_TRIM = 0.25
_POINTS = 1000
"""Of a curve over several runs, at most."""
_MOST_METRICS = 1000
_DIFFERENCES = 3
"""Settings that a label names, at most."""


@dataclass(frozen=True, slots=True)
class History:
    """Metrics of one run, an entry an iteration."""

    run: Run
    axes: dict[str, Array]
    """Name of an axis -> its values, rising. (n,)"""
    metrics: dict[str, Array]
    """Metric -> its values, NaN where an iteration has none. (n,)"""


@dataclass(frozen=True, slots=True)
class Line:
    """A metric over an axis."""

    x: Array
    middle: Array
    low: Array | None = None
    """Lower end of the 95 % interval; None for a single run."""
    high: Array | None = None


@dataclass(frozen=True, slots=True)
class Curve:
    """Runs that differ in their seed only."""

    label: str
    histories: list[History]

    @property
    def seeds(self) -> list[int]:
        """The seeds of its runs."""
        return [history.run.record["seed"] for history in self.histories]

    def names(self) -> list[str]:
        """Return the metrics that all of its runs have."""
        first, *others = self.histories
        return [name for name in first.metrics if all(name in other.metrics for other in others)]

    def line(self, metric: str, axis: str = "steps") -> Line | None:
        """A metric over an axis; None where the runs have no range in common.

        Of several runs it is the interquartile mean, with its interval.
        """
        aligned = self._aligned(metric, axis)
        if aligned is None or len(aligned[1]) == 1:
            return None if aligned is None else Line(aligned[0], aligned[1][0])
        x, values = aligned
        return Line(x, iqm(values), *interval(values))

    def mean(self, metric: str, axis: str = "steps") -> Line | None:
        """The same with the mean of the runs, whose parts add up, and without an interval."""
        aligned = self._aligned(metric, axis)
        return None if aligned is None else Line(aligned[0], aligned[1].mean(axis=0))

    def _aligned(self, metric: str, axis: str) -> tuple[Array, Array] | None:
        """An x (p,) and values (runs, p)."""
        lines = [_finite_part(history, metric, axis) for history in self.histories]
        if any(not len(x) for x, _ in lines):
            return None
        return align(lines)


def read_history(run: Run) -> History:
    """Read the metrics of a run, up to the first line that is corrupt: a kill may have cut the last one short.

    Raises:
        CheckpointError: if there are none yet, or they cannot be read.
    """
    columns: dict[str, array[float]] = {}
    axes: dict[str, array[float]] = {name: array("d") for name in AXES}
    elapsed, last = 0.0, (0, 0)
    for row in read_rows(run):
        here = (row["iteration"], row["step"])
        if not all(before < now < 2**62 for before, now in zip(last, here, strict=True)):
            break
        last = here
        numbers = {name: float(value) for name, value in row.items() if is_number(value)}
        elapsed += sum(max(0.0, numbers.get(f"Perf/{part}_time", 0.0)) for part in ("collection", "learning"))
        for name, value in zip(AXES, (here[1], here[0], elapsed), strict=True):
            axes[name].append(value)
        count = len(axes["steps"])
        for name, value in numbers.items():
            if name in ("iteration", "step") or (name not in columns and len(columns) >= _MOST_METRICS):
                continue
            column = columns.setdefault(name, array("d"))
            column.extend([math.nan] * (count - 1 - len(column)))
            column.append(value)
    count = len(axes["steps"])
    if not count:
        raise CheckpointError(f"{run.folder} has no metrics yet", hint="its first iteration writes some")
    for column in columns.values():
        column.extend([math.nan] * (count - len(column)))
    as_array: Callable[[array[float]], Array] = np.asarray
    return History(
        run,
        {name: as_array(values) for name, values in axes.items()},
        {name: as_array(values) for name, values in columns.items()},
    )


def gather(runs: Sequence[Run]) -> tuple[list[Curve], list[str]]:
    """Return runs as curves, in the order given, and notes about how they were combined.

    Raises:
        CheckpointError: if none has metrics and a configuration that can be read.
    """
    groups: dict[str, _Group] = {}
    notes: list[str] = []
    for run in {run.folder.resolve(): run for run in runs}.values():
        try:
            settings, history = _settings(run), read_history(run)
        except CheckpointError as error:
            if len(runs) == 1:
                raise
            notes.append(f"left out: {error.message}")
            continue
        group = groups.setdefault(json.dumps(settings, sort_keys=True), _Group(settings))
        twin = next((other for other in group.histories if other.run.record["seed"] == run.record["seed"]), None)
        if twin is None:
            group.histories.append(history)
            continue
        newer, older = sorted((history, twin), key=lambda each: str(each.run.record.get("started", "")), reverse=True)
        group.histories[group.histories.index(twin)] = newer
        place = older.run.folder
        notes.append(f"{place} is left out: {newer.run.folder} has its seed, and two of a seed tell no more than one")
    if not groups:
        raise CheckpointError(f"none of {len(runs)} runs has metrics: {notes[0].removeprefix('left out: ')}")
    labels = _labels(list(groups.values()))
    curves = [Curve(label, group.histories) for label, group in zip(labels, groups.values(), strict=True)]
    for curve in curves:
        ends = [history.axes["steps"][-1] for history in curve.histories]
        if min(ends) < max(ends):
            short = curve.histories[ends.index(min(ends))].run.folder
            notes.append(f"'{curve.label}' ends at step {min(ends):,.0f}, where its shortest run does: {short}")
    return curves, notes


def iqm(values: Array) -> Array:
    """Interquartile mean over the first axis: a quarter is cut off at either end, rounded down. (n, p) -> (p,)

    Of fewer than four values it is their mean.
    """
    count = len(values)
    cut = int(_TRIM * count)
    middle: Array = np.sort(values, axis=0)[cut : count - cut].mean(axis=0)
    return middle


def interval(values: Array, resamples: int = RESAMPLES) -> tuple[Array, Array]:
    """Ends of the interquartile mean's 95 % interval, by percentile bootstrap over runs. (n, p) -> (p,), (p,)"""
    count = len(values)
    picks = np.random.Generator(np.random.PCG64(0)).integers(0, count, (resamples, count))
    cut = int(_TRIM * count)
    low, high = np.empty(values.shape[1]), np.empty(values.shape[1])
    few = max(1, 4_000_000 // (resamples * count))
    for start in range(0, values.shape[1], few):
        part = slice(start, start + few)
        drawn = np.sort(values[:, part][picks], axis=1)[:, cut : count - cut].mean(axis=1)
        low[part], high[part] = np.percentile(drawn, [50.0 - _LEVEL / 2, 50.0 + _LEVEL / 2], axis=0)
    return low, high


def align(lines: Sequence[tuple[Array, Array]]) -> tuple[Array, Array] | None:
    """Interpolate several lines (x, y) to one x, within their common range: x (p,), values (runs, p)."""
    first = lines[0][0]
    if all(np.array_equal(x, first) for x, _ in lines):
        return first, np.stack([y for _, y in lines])
    begin, end = max(x[0] for x, _ in lines), min(x[-1] for x, _ in lines)
    if begin > end:
        return None
    grid = np.unique(np.concatenate([x for x, _ in lines]))
    grid = grid[(grid >= begin) & (grid <= end)]
    if len(grid) > _POINTS:
        grid = grid[np.linspace(0, len(grid) - 1, _POINTS).round().astype(int)]
    return grid, np.stack([np.interp(grid, x, y) for x, y in lines])


@dataclass(slots=True)
class _Group:
    settings: dict[str, Any]
    histories: list[History] = field(default_factory=list)


def _finite_part(history: History, metric: str, axis: str) -> tuple[Array, Array]:
    values = history.metrics[metric]
    known = np.isfinite(values)
    return history.axes[axis][known], values[known]


def _settings(run: Run) -> dict[str, Any]:
    """All that a run was made with but its seed, flat: key -> value."""
    task, record = run.record["task"], run.record
    data = run.read_config().data
    apart = {
        "task": task["name"],
        "agent": record.get("agent"),
        "distribution": task.get("distribution") or task.get("folder"),
        "device": str(record.get("device", "cpu")).partition(":")[0],
        "init_from": record.get("init_from_sha256") or record.get("init_from"),
        **{
            f"source of {name}": str(digest)[:8]
            for name, digest in record.get("sources", {}).items()
            if name != "rlcli"
        },
    }
    return {**{dotted(path): value for path, value in leaves(data)}, **apart}


def _labels(groups: Sequence[_Group]) -> list[str]:
    """What tells the groups apart: task, agent, settings that differ within a task, an agent's within the agent."""

    def differ(key: str, among: Sequence[_Group]) -> bool:
        return len({json.dumps(group.settings.get(key, "-")) for group in among}) > 1

    names = []
    for group in groups:
        parts = [str(group.settings[key]) for key in ("task", "agent") if differ(key, groups)]
        same_task = [g for g in groups if g.settings["task"] == group.settings["task"]]
        same_agent = [g for g in same_task if g.settings["agent"] == group.settings["agent"]]
        keys = dict.fromkeys(key for other in same_task for key in other.settings if key not in ("task", "agent"))
        differing = [key for key in keys if differ(key, same_agent if key.startswith("agents.") else same_task)]
        parts += [f"{key}={_short(group.settings.get(key))}" for key in differing[:_DIFFERENCES]]
        if len(differing) > _DIFFERENCES:
            parts.append(f"and {len(differing) - _DIFFERENCES} more")
        names.append(", ".join(parts))
    if len(groups) == 1:
        names = [f"{groups[0].settings['task']}, {groups[0].settings['agent']}"]
    twice = {name for name in names if names.count(name) > 1}
    names = [
        f"{name} ({group.histories[-1].run.folder.name})" if name in twice else name
        for name, group in zip(names, groups, strict=True)
    ]
    return [
        f"{name} ({len(group.histories)} seeds)" if len(group.histories) > 1 else name
        for name, group in zip(names, groups, strict=True)
    ]


def _short(value: object) -> str:
    return shorten("-" if value is None else value if isinstance(value, str) else json.dumps(value), 24, "…")
