"""Read the metrics of runs, and compute learning curves; runs that differ only in their seed share one curve.

A curve of several seeds is their interquartile mean with a 95 % interval from a stratified percentile bootstrap, as
Agarwal et al. recommend (Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS 2021,
arXiv:2108.13264). The strata are tasks. A curve has one task, so whole runs are drawn with replacement. The draws have
a fixed seed: the same runs give the same curves.
"""

import json
import logging
import math
import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlcli.config.layers import leaves
from rlcli.config.messages import dotted
from rlcli.errors import CheckpointError
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.run import STUDY, Run
from rlcli.safe_text import shorten

_log = logging.getLogger(__name__)
Array = NDArray[np.float64]

AXES = {"steps": "environment steps", "iterations": "iterations", "time": "training time [s]"}
"""Name of an x axis -> its label. Time is the sum of the times of rollouts and updates."""

RESAMPLES = 2000
"""Number of bootstrap draws."""
_LEVEL = 95.0
"""Level of the bootstrap interval [%]."""
_TRIM = 0.25
"""Fraction of the values that the interquartile mean leaves out at each end."""
FEWEST_FOR_IQM = 4
"""Smallest number of runs for which the interquartile mean leaves values out; of fewer runs the mean is taken."""
_MAX_POINTS = 1000
"""Largest number of points of a curve over several runs."""
_MAX_METRICS = 1000
_NAMED = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-((?!\d+$).+)")
"""Folder name of a run with a `--name`; group 1 is that name."""
_MAX_DIFFERENCES = 3
"""Largest number of settings that the label of a curve shows to distinguish it from other curves."""


@dataclass(frozen=True, slots=True)
class History:
    """Metrics of one run, each with one value for each of the run's n iterations."""

    run: Run
    axes: dict[str, Array]
    """Name of an x axis (steps, iterations or time) -> its values, ascending. (n,)"""
    metrics: dict[str, Array]
    """Metric -> its values; NaN for an iteration without the metric. (n,)"""


@dataclass(frozen=True, slots=True)
class Line:
    """Metric over an x axis, ready to plot: its values at p points, and the ends of their 95 % interval."""

    x: Array
    """Values of the x axis, ascending. (p,)"""
    middle: Array
    """Values of the metric, for several runs their mean. (p,)"""
    low: Array | None = None
    """Lower end of the 95 % interval; None without an interval, as for a single run. (p,)"""
    high: Array | None = None
    """Upper end of the 95 % interval; None without an interval. (p,)"""

    def last(self) -> tuple[float | None, ...]:
        """Return the last x, the last value, and both ends of its interval (None, None without an interval)."""
        return tuple(None if end is None else float(end[-1]) for end in (self.x, self.middle, self.low, self.high))


@dataclass(frozen=True, slots=True)
class Curve:
    """Group of runs that differ only in their seed, and whose metrics are plotted as one curve."""

    label: str
    histories: list[History]
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings that the runs of the curve have in common: key -> value."""

    @property
    def seeds(self) -> list[int]:
        """The seeds of the curve's runs."""
        return [history.run.record["seed"] for history in self.histories]

    def names(self) -> list[str]:
        """Return the names of the metrics that all runs of the curve have."""
        first, *others = self.histories
        return [name for name in first.metrics if all(name in other.metrics for other in others)]

    def line(self, metric: str, axis: str = "steps") -> Line | None:
        """Return a metric over an x axis; for several runs, their interquartile mean with its 95 % interval.

        Return None if a run does not have the metric, or if the runs have no common range of the axis.

        Args:
            metric: name of the metric in metrics.jsonl.
            axis: name of the x axis, a key of `AXES`.
        """
        aligned = self._aligned(metric, axis)
        if aligned is None:
            return None
        x, values = aligned
        return Line(x, values[0]) if len(values) == 1 else Line(x, iqm(values), *interval(values))

    def mean(self, metric: str, axis: str = "steps") -> Line | None:
        """Return the mean of a metric over the runs, without an interval, or None as `line` does.

        Unlike interquartile means, the means of shares still add up to 1.
        """
        aligned = self._aligned(metric, axis)
        return None if aligned is None else Line(aligned[0], aligned[1].mean(axis=0))

    def _aligned(self, metric: str, axis: str) -> tuple[Array, Array] | None:
        """Interpolate a metric of all runs to p common points of the x axis.

        Return x (p,) and values (runs, p); None if a run does not have the metric, or there is no common range of x.
        """
        if any(metric not in history.metrics for history in self.histories):
            return None
        lines = []
        for history in self.histories:
            values = history.metrics[metric]
            finite = np.isfinite(values)
            lines.append((history.axes[axis][finite], values[finite]))
        return align(lines) if all(len(x) for x, _ in lines) else None


def read_history(run: Run) -> History:
    """Read the metrics of a run up to the first corrupt line.

    An incomplete last line, as a killed process leaves one, is skipped. Rows from the first one on whose iteration or
    step does not increase are left out, with a warning.

    Raises:
        CheckpointError: if the run has no metrics yet, or the file metrics.jsonl cannot be read.
    """
    columns: dict[str, array[float]] = {}
    axes: dict[str, array[float]] = {name: array("d") for name in AXES}
    elapsed, last = 0.0, (0, 0)
    for row in read_rows(run.metrics):
        current = (row["iteration"], row["step"])
        if not all(before < now < 2**62 for before, now in zip(last, current, strict=True)):
            what = f"iteration {current[0]}, step {current[1]} after iteration {last[0]}, step {last[1]}"
            _log.warning("%s: %s: numbers must increase; the rows from there on are left out", run.metrics, what)
            break
        last = current
        numbers = {name: float(value) for name, value in row.items()}
        elapsed += sum(max(0.0, numbers.get(f"Perf/{part}_time", 0.0)) for part in ("collection", "learning"))
        for name, value in zip(AXES, (current[1], current[0], elapsed), strict=True):
            axes[name].append(value)
        count = len(axes["steps"])
        for name, value in numbers.items():
            if name in ("iteration", "step") or (name not in columns and len(columns) >= _MAX_METRICS):
                continue
            column = columns.setdefault(name, array("d"))
            column.extend([math.nan] * (count - 1 - len(column)))
            column.append(value)
    count = len(axes["steps"])
    if not count:
        raise CheckpointError(f"{run.folder} has no metrics yet", hint="wait for the end of its first iteration")
    for column in columns.values():
        column.extend([math.nan] * (count - len(column)))
    arrays = ({name: np.asarray(values, np.float64) for name, values in each.items()} for each in (axes, columns))
    return History(run, *arrays)


def gather(runs: Sequence[Run]) -> tuple[list[Curve], list[str]]:
    """Return the curves of runs, in the order of the runs. Runs that differ only in their seed become one curve.

    Runs that cannot be read are left out; of runs that are equal even in their seed, all but the newest.

    Returns:
        The curves, and notes for the user: a sentence for each run that is left out, and for each curve whose runs have
        different lengths, and which therefore ends at the last step of the shortest one.

    Raises:
        CheckpointError: if no run has readable metrics and a readable configuration.
    """
    groups: dict[str, Curve] = {}
    notes: list[str] = []
    for run in {run.folder.resolve(): run for run in runs}.values():
        try:
            settings, history = _settings(run), read_history(run)
        except CheckpointError as error:
            if len(runs) == 1:
                raise
            notes.append(f"left out: {error.message}")
            continue
        group = groups.setdefault(json.dumps(settings, sort_keys=True), Curve("", [], settings))
        twin = next((other for other in group.histories if other.run.record["seed"] == run.record["seed"]), None)
        if twin is None:
            group.histories.append(history)
            continue
        newer, older = sorted((history, twin), key=lambda each: str(each.run.record.get("started", "")), reverse=True)
        group.histories[group.histories.index(twin)] = newer
        notes.append(f"{older.run.folder} is left out: {newer.run.folder} has the same settings and seed, and is newer")
    if not groups:
        first = notes[0].removeprefix("left out: ")
        raise CheckpointError(f"none of the {len(runs)} runs can be plotted; the first: {first}")
    labels = zip(groups.values(), _labels(list(groups.values())), strict=True)
    curves = [replace(group, label=label) for group, label in labels]
    for curve in curves:
        ends = [history.axes["steps"][-1] for history in curve.histories]
        if min(ends) < max(ends):
            shortest = curve.histories[ends.index(min(ends))].run.folder
            notes.append(
                f"'{curve.label}' ends at step {min(ends):,.0f}, the last step of its shortest run: {shortest}"
            )
    return curves, notes


def iqm(values: Array) -> Array:
    """Return the interquartile mean over n runs. (n, p) -> (p,)

    At each point, the lowest and the highest quarter of the n values (rounded down) are left out; of fewer than four
    values none is left out.
    """
    count = len(values)
    cut = int(_TRIM * count)
    middle: Array = np.sort(values, axis=0)[cut : count - cut].mean(axis=0)
    return middle


def interval(values: Array, resamples: int = RESAMPLES) -> tuple[Array, Array]:
    """Return the lower and the upper end of the interquartile mean's 95 % bootstrap interval over n runs.

    Args:
        values: the values of each run at p points. (n, p)
        resamples: number of bootstrap draws.

    Returns:
        Lower ends and upper ends, (p,) each.
    """
    count = len(values)
    picks = np.random.Generator(np.random.PCG64(0)).integers(0, count, (resamples, count))
    cut = int(_TRIM * count)
    low, high = np.empty(values.shape[1]), np.empty(values.shape[1])
    chunk = max(1, 4_000_000 // (resamples * count))  # at most 32 MB at once
    for start in range(0, values.shape[1], chunk):
        part = slice(start, start + chunk)
        means = np.sort(values[:, part][picks], axis=1)[:, cut : count - cut].mean(axis=1)
        low[part], high[part] = np.percentile(means, [50.0 - _LEVEL / 2, 50.0 + _LEVEL / 2], axis=0)
    return low, high


def align(lines: Sequence[tuple[Array, Array]]) -> tuple[Array, Array] | None:
    """Interpolate the lines of several runs to p common points.

    Args:
        lines: x and y of each run; x is ascending.

    Returns:
        x (p,) and the values of all runs (runs, p); None if the lines have no common range of x.
    """
    first = lines[0][0]
    if all(np.array_equal(x, first) for x, _ in lines):
        return first, np.stack([y for _, y in lines])
    begin, end = max(x[0] for x, _ in lines), min(x[-1] for x, _ in lines)
    if begin > end:
        return None
    grid = np.unique(np.concatenate([x for x, _ in lines]))
    grid = grid[(grid >= begin) & (grid <= end)]
    if len(grid) > _MAX_POINTS:
        grid = grid[np.linspace(0, len(grid) - 1, _MAX_POINTS).round().astype(int)]
    return grid, np.stack([np.interp(grid, x, y) for x, y in lines])


def _settings(run: Run) -> dict[str, Any]:
    """Return the values of all settings of a run except its seed, by dotted key.

    Runs with equal settings differ only in their seed, and become one curve.
    """
    task, record = run.record["task"], run.record
    values = {dotted(path): value for path, value in leaves(run.read_config().data)}
    sources = record.get("sources", {}).items()
    return {
        **values,
        "task": task["name"],
        "agent": record.get("agent"),
        "distribution": task.get("distribution") or task.get("folder"),
        "device": str(record.get("device", "cpu")).partition(":")[0],
        "init_from": record.get("init_from_sha256") or record.get("init_from"),
        **{f"source of {name}": str(digest)[:8] for name, digest in sources if name != "rlcli"},
    }


def _labels(groups: Sequence[Curve]) -> list[str]:
    """Return a label for each curve, which distinguishes its group of runs from the other groups.

    The label is the group's `--name`, or task, agent and settings as far as these differ between the groups. Settings
    are compared only between groups of the same task, an agent's settings only between groups of the same agent.
    """

    def differ(key: str, compared: Sequence[Curve]) -> bool:
        return len({json.dumps(group.settings.get(key, "-")) for group in compared}) > 1

    chosen = [_chosen_name(group) for group in groups]
    names = []
    for group, own in zip(groups, chosen, strict=True):
        if own and chosen.count(own) == 1:  # the user's names distinguish the runs
            names.append(own)
            continue
        parts = [str(group.settings[key]) for key in ("task", "agent") if differ(key, groups)]
        same_task = [g for g in groups if g.settings["task"] == group.settings["task"]]
        same_agent = [g for g in same_task if g.settings["agent"] == group.settings["agent"]]
        keys = dict.fromkeys(key for other in same_task for key in other.settings if key not in ("task", "agent"))
        differing = [key for key in keys if differ(key, same_agent if key.startswith("agents.") else same_task)]
        given = group.histories[0].run.record.get("given") or {}
        differing.sort(key=lambda key: key not in given)  # settings that the user has set for this run come first
        parts += [
            f"{_short_key(key, differing)}={_short(group.settings.get(key))}" for key in differing[:_MAX_DIFFERENCES]
        ]
        if len(differing) > _MAX_DIFFERENCES:
            parts.append(f"and {len(differing) - _MAX_DIFFERENCES} more")
        names.append(", ".join(parts))
    if len(groups) == 1:
        names = [f"{groups[0].settings['task']}, {groups[0].settings['agent']}"]
    labels = []
    for name, group in zip(names, groups, strict=True):
        count = len(group.histories)
        folder = f" ({group.histories[-1].run.folder.name})" if names.count(name) > 1 else ""
        labels.append(name + folder + (f" ({count} seeds)" if count > 1 else ""))
    return labels


def _chosen_name(group: Curve) -> str:
    """Return the `--name` with which a group's runs were trained; an empty text if they have none, or different ones.

    The name is the end of the name of a run's folder, or of the folder of its study.
    """
    folders = (history.run.folder for history in group.histories)
    homes = (folder.parent if (folder.parent / STUDY).is_file() else folder for folder in folders)
    names = {match[1] if (match := _NAMED.fullmatch(home.name)) else "" for home in homes}
    return names.pop() if len(names) == 1 else ""


def _short_key(key: str, keys: Sequence[str]) -> str:
    """Return the last two parts of a dotted key if no other of the keys ends with them, else the whole key."""
    end = ".".join(key.split(".")[-2:])
    return end if sum(other == end or other.endswith(f".{end}") for other in keys) == 1 else key


def _short(value: object) -> str:
    if not isinstance(value, str):
        value = "-" if value is None else json.dumps(value)
    return shorten(value, 24, "…")
