"""Tables with the results of evaluations, comparisons and stress tests, for `rlcli eval`, `play` and `stress`.

Means and rates have 95 % confidence intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.ui.console import console
from rlcli.config.schema import bound_text
from rlcli.evaluation.limits import mean_or_rate

if TYPE_CHECKING:
    from rlcli.evaluation.comparison import Comparison
    from rlcli.evaluation.stress import StressResult, Summary
    from rlcli.evaluation.stress_parameters import Point

INTERVAL = "95 % INTERVAL"


def show_summary(summary: Mapping[str, Any]) -> None:
    """Print the metrics of an evaluation, each with its 95 % confidence interval.

    Args:
        summary: the result of an evaluation (`Evaluation.summary`): metric -> mean or rate with `low` and `high`.
    """
    entries = [("success rate", summary["success"])] if "success" in summary else []
    for name, condition in summary.get("conditions", {}).items():
        entries.append((f"success: {name} held", condition["held"]))
        if "value" in condition:
            entries.append((f"success: {name}, {bound_text(condition)}", condition["value"]))
    entries += [("return", summary["return"]), ("length [steps]", summary["length"])]
    groups = {"reward": "reward_terms", "value": "values", "ended by": "terminations"}
    entries += [(f"{word} {name}", entry) for word, key in groups.items() for name, entry in summary[key].items()]
    rows = [["episodes", str(summary["episodes"]), ""], *([label, *_cells(entry)] for label, entry in entries)]
    if summary["diverged"]:
        causes = ", ".join(f"{cause} {count}" for cause, count in summary["diverged_by"].items())
        rows.append(["diverged", str(summary["diverged"]), causes])
    console.table(["", "MEAN", INTERVAL], rows)


def show_comparison(comparison: Comparison) -> None:
    """Print the metrics of all policies, and the paired differences between the first and each other policy."""
    from rlcli.evaluation.comparison import METRICS

    labels = _labels(comparison.names)
    rows = [
        [metric, label, *_cells(summary[metric])]
        for metric in METRICS
        if metric in comparison.summaries[0]
        for label, summary in zip(labels, comparison.summaries, strict=True)
    ]
    console.table(["", "POLICY", "MEAN", INTERVAL], rows)
    console.data("")
    rows = []
    for label, pair in zip(labels[1:], comparison.pairs, strict=True):
        for metric, entry in pair.items():
            gap, better = entry["difference"], entry["improvement"]
            numbers = [f"{gap['mean']:+.4f}", interval(gap), f"{better['probability']:.3f}", interval(better)]
            rows.append([f"{metric}: {labels[0]} - {label}", *numbers])
    console.table(["PAIRED", "DIFFERENCE", INTERVAL, "P(IMPROVEMENT)", INTERVAL], rows)


def show_stress(result: StressResult, against: str | None) -> None:
    """Print a table with a row for each variant of the task: values of the varied parameters, metrics, intervals.

    Args:
        result: the evaluations of all variants.
        against: name of the policy of --against, which gets a column; None: there is no other policy.
    """
    from rlcli.evaluation.stress_parameters import format_value

    metric = result.metric
    columns = [*(sweep.name for sweep in result.sweeps), metric.upper(), INTERVAL]
    columns += ["RETURN"] if metric != "return" else []
    columns += [f"{against} {metric}".upper(), INTERVAL] if result.reference else []
    rows = []
    variants: list[tuple[Point | None, Summary]] = [(None, result.nominal), *result.grid.items()]
    for point, summary in variants:
        row = ["nominal"] * len(result.sweeps) if point is None else [format_value(value) for value in point]
        row += _cells(summary[metric])
        row += [f"{summary['return']['mean']:.4f}"] if metric != "return" else []
        row += _cells(result.reference[point][metric]) if result.reference else []
        rows.append(row)
    console.table(columns, rows)


def interval(entry: Mapping[str, Any]) -> str:
    """Return the 95 % confidence interval of one result of an evaluation (a mean or a rate) as text."""
    return "unknown" if entry["low"] is None else f"{entry['low']:.4f} .. {entry['high']:.4f}"


def _cells(entry: Mapping[str, Any]) -> list[str]:
    """Return the cells of a table for a mean or a rate: the value, and its 95 % interval."""
    value = mean_or_rate(entry)
    return ["not finite" if value is None else f"{value:.4f}", interval(entry)]


def _labels(names: Sequence[str]) -> Sequence[str]:
    """Return short names of the compared policies.

    The short names are the last parts of the paths if all last parts differ, else the whole paths.
    """
    short = [Path(name).name or name for name in names]
    return short if len(set(short)) == len(set(names)) else names
