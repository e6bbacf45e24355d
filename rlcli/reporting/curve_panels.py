"""Choose the panels of a picture of learning curves: the metrics of each panel, its title, and its lines or bands.

`rlcli plot` and the HTML report of a run plot these panels.
"""

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rlcli.errors import UsageError, did_you_mean, listing
from rlcli.reporting.curves import Curve, Line

REWARDS, TERMINATIONS = "Episode_Reward/", "Episode_Termination/"
METRICS = {"return": "Train/mean_reward", "success": "Train/success_rate", "length": "Train/mean_episode_length"}
"""Short name of a metric, for the option `--metrics` of `rlcli plot` -> its name in the run's metrics.jsonl."""
GROUPS = {"rewards": REWARDS, "terminations": TERMINATIONS}
"""Name of a group of metrics, for `--metrics` -> the prefix of the names of these metrics in metrics.jsonl."""
DEFAULT = (*METRICS, *GROUPS)

_EVALUATED = "Eval/success_rate"
_TITLES = {
    "Train/mean_reward": ("Return", "reward per episode"),
    "Train/success_rate": ("Success", "share of episodes"),
    _EVALUATED: ("Success in evaluations", "share of episodes, no exploration noise"),
    "Train/mean_episode_length": ("Episode length", "environment steps"),
}
_REWARD_UNIT = "sum over an episode / full episode length [s]"
_ENDS_UNIT = "share of episodes"
_SHARES = ("success_rate",)


@dataclass(frozen=True, slots=True)
class Item:
    """Line or stacked band in a panel, such as the return of one run.

    `label` is its text in the legend; `index` selects its colour and line style.
    """

    label: str
    line: Line
    index: int


@dataclass(frozen=True, slots=True)
class Panel:
    """Panel of a picture: one pair of axes with lines of a metric, or with stacked bands of shares."""

    title: str
    unit: str
    """Label of the y axis."""
    items: list[Item]
    stacked: bool = False
    """Whether the items are bands stacked from 0 to 1."""
    share: bool = False
    """Whether the y axis is a share from 0 to 1."""
    by_curve: bool = False
    """Whether the panel has one line for each `Curve` of the picture. All such panels share one legend."""
    subtitle: str = ""
    """Label of the curve that the panel belongs to; empty if it belongs to all."""


def choose(curves: Sequence[Curve], names: Sequence[str] | None = None, axis: str = "steps") -> list[Panel]:
    """Return the panels of a picture of learning curves.

    A metric has one panel with a line for each curve. `terminations` has a panel for each curve. `rewards` has one
    panel for all reward terms if there is one curve, else one for each reward term. Empty panels are left out.

    Args:
        curves: the curves, each of one run or of runs that differ only in their seed.
        names: keys of `METRICS` or `GROUPS`, or names in metrics.jsonl, or the part of these names before the slash;
            None: those of `METRICS` and `GROUPS` that the runs have.
        axis: the x axis, a key of `rlcli.reporting.curves.AXES`.

    Raises:
        UsageError: for a metric that no run has, with the list of valid names.
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
            items = _items((metric.removeprefix(REWARDS), curves[0].line(metric, axis)) for metric in metrics)
            panels.append(Panel("Reward terms", _REWARD_UNIT, items))
        else:
            panels += [_panel(curves, metric, axis) for metric in metrics]
    return [panel for panel in panels if panel.items]


def _metrics(name: str, known: Sequence[str]) -> list[str]:
    if name in GROUPS:
        return [metric for metric in known if metric.startswith(GROUPS[name])]
    metric = METRICS.get(name, name)
    if name == "success":  # of training episodes, and of evaluations if the training had any
        return [each for each in (metric, _EVALUATED) if each in known]
    return [metric] if metric in known else [other for other in known if other.partition("/")[0] == metric]


def _unknown(name: str, known: Sequence[str]) -> UsageError:
    names = [*(short for short in DEFAULT if _metrics(short, known)), *known]
    tails = {each.rpartition("/")[2]: each for each in reversed(names)}
    tail = next(iter(difflib.get_close_matches(name, list(tails), n=1)), None)
    near = did_you_mean(name, names) or (f"did you mean '{tails[tail]}'?" if tail else None)
    message = f"no metric '{name}' in metrics.jsonl of the runs"
    return UsageError(message, hint=f"{near} " * bool(near) + f"metrics: {listing(names, 60)}")


def _panel(curves: Sequence[Curve], metric: str, axis: str) -> Panel:
    title, unit = _TITLES.get(metric, (metric, ""))
    if metric.startswith(REWARDS):
        title, unit = f"Reward: {metric.removeprefix(REWARDS)}", _REWARD_UNIT
    elif metric.startswith(TERMINATIONS):
        title, unit = f"Ended by {metric.removeprefix(TERMINATIONS)}", _ENDS_UNIT
    items = _items((curve.label, curve.line(metric, axis)) for curve in curves)
    share = metric.rpartition("/")[2] in _SHARES or metric.startswith(TERMINATIONS)
    return Panel(title, unit, items, share=share, by_curve=True)


def _stacks(curves: Sequence[Curve], metrics: Sequence[str], axis: str) -> list[Panel]:
    """Return a panel for each curve with stacked bands: the share of episodes that each termination ended.

    A band of several seeds is their mean, not their interquartile mean, so that the shares still add up to 1.
    """
    panels = []
    for curve in curves:
        items = _items((metric.removeprefix(TERMINATIONS), curve.mean(metric, axis)) for metric in metrics)
        subtitle = curve.label if len(curves) > 1 else ""
        panels.append(Panel("Why episodes ended", _ENDS_UNIT, items, stacked=True, share=True, subtitle=subtitle))
    return panels


def _items(lines: Iterable[tuple[str, Line | None]]) -> list[Item]:
    """Return an item for each line that is not None; the position of a line in `lines` sets the item's colour.

    So a curve has the same colour in every panel, even if some panels lack other curves.
    """
    return [Item(label, line, index) for index, (label, line) in enumerate(lines) if line is not None]
