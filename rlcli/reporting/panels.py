"""What a picture of learning curves shows: one panel a metric, all terminations in one."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass

from rlcli.errors import UsageError, did_you_mean, listing
from rlcli.reporting.curves import Curve, Line

REWARDS, TERMINATIONS = "Episode_Reward/", "Episode_Termination/"
METRICS = {
    "return": "Train/mean_reward",
    "success": "Train/success_rate",
    "length": "Train/mean_episode_length",
}
"""Short name -> metric."""
GROUPS = {"rewards": REWARDS, "terminations": TERMINATIONS}
"""Short name -> what the names of its metrics begin with."""
DEFAULT = (*METRICS, *GROUPS)

_TITLES = {
    "Train/mean_reward": ("Return", "reward an episode"),
    "Train/success_rate": ("Success", "share of episodes"),
    "Train/mean_episode_length": ("Episode length", "environment steps"),
}
_REWARD_UNIT = "mean, reward a second"
_ENDS_UNIT = "share of episodes"
_SHARES = ("success_rate",)


@dataclass(frozen=True, slots=True)
class Item:
    """One line or band of a panel; `index` chooses its colour."""

    label: str
    line: Line
    index: int


@dataclass(frozen=True, slots=True)
class Panel:
    """One coordinate system."""

    title: str
    unit: str
    items: list[Item]
    stacked: bool = False
    """Bands on top of each other, from 0 to 1."""
    share: bool = False
    """From 0 to 1."""
    by_curve: bool = False
    """Its lines are the picture's curves: one legend serves all such panels."""
    subtitle: str = ""


def choose(curves: Sequence[Curve], names: Sequence[str] | None = None, axis: str = "steps") -> list[Panel]:
    """The panels of a picture.

    Args:
        curves: what is drawn.
        names: metrics, short names of them, or what stands before the slash of some; None: the usual ones, as far as
            the runs have them.
        axis: the x axis, a key of `AXES`.

    Raises:
        UsageError: for a name that none of the runs knows, with those that they do.
    """
    known = list(dict.fromkeys(name for curve in curves for name in curve.names()))
    panels: list[Panel] = []
    for name in names or DEFAULT:
        metrics = _metrics(name, known)
        if not metrics:
            if names is None:
                continue
            raise _unknown(name, known)
        if name == "terminations":
            panels += _stacks(curves, metrics, axis)
        elif name == "rewards" and len(curves) == 1:
            panels.append(_terms(curves[0], metrics, axis))
        else:
            panels += [_panel(curves, metric, axis) for metric in metrics]
    return [panel for panel in panels if panel.items]


def available(known: Sequence[str]) -> list[str]:
    """Every name that `choose` takes of runs with these metrics."""
    short = [name for name in DEFAULT if _metrics(name, known)]
    return [*short, *known]


def _metrics(name: str, known: Sequence[str]) -> list[str]:
    if name in GROUPS:
        return [metric for metric in known if metric.startswith(GROUPS[name])]
    metric = METRICS.get(name, name)
    return [metric] if metric in known else [other for other in known if other.partition("/")[0] == metric]


def _unknown(name: str, known: Sequence[str]) -> UsageError:
    names = available(known)
    tails = {each.rpartition("/")[2]: each for each in reversed(names)}
    tail = next(iter(difflib.get_close_matches(name, list(tails), n=1)), None)
    near = did_you_mean(name, names) or (f"did you mean '{tails[tail]}'?" if tail else None)
    return UsageError(f"no metric '{name}'", hint=f"{near} " * bool(near) + f"there are {listing(names, 60)}")


def _panel(curves: Sequence[Curve], metric: str, axis: str) -> Panel:
    title, unit = _TITLES.get(metric, (metric, ""))
    if metric.startswith(REWARDS):
        title, unit = f"Reward: {metric.removeprefix(REWARDS)}", _REWARD_UNIT
    elif metric.startswith(TERMINATIONS):
        title, unit = f"Ended by {metric.removeprefix(TERMINATIONS)}", _ENDS_UNIT
    items = [
        Item(curve.label, line, index)
        for index, curve in enumerate(curves)
        if metric in curve.names() and (line := curve.line(metric, axis)) is not None
    ]
    share = metric.rpartition("/")[2] in _SHARES or metric.startswith(TERMINATIONS)
    return Panel(title, unit, items, share=share, by_curve=True)


def _terms(curve: Curve, metrics: Sequence[str], axis: str) -> Panel:
    """All reward terms of one curve."""
    items = [
        Item(metric.removeprefix(REWARDS), line, index)
        for index, metric in enumerate(metrics)
        if metric in curve.names() and (line := curve.line(metric, axis)) is not None
    ]
    return Panel("Reward terms", _REWARD_UNIT, items)


def _stacks(curves: Sequence[Curve], metrics: Sequence[str], axis: str) -> list[Panel]:
    """Terminations, a panel a curve: means over seeds, which add up."""
    panels = []
    for curve in curves:
        items = [
            Item(metric.removeprefix(TERMINATIONS), line, index)
            for index, metric in enumerate(metrics)
            if metric in curve.names() and (line := curve.mean(metric, axis)) is not None
        ]
        subtitle = curve.label if len(curves) > 1 else ""
        panels.append(Panel("Why episodes ended", _ENDS_UNIT, items, stacked=True, share=True, subtitle=subtitle))
    return panels
