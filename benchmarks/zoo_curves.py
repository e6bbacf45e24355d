"""Learning curves of the built-in tasks: a small CSV, and an SVG with selectable text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

ROWS = 120
"""Number of points for each seed."""
RETURN, SUCCESS = "Train/mean_reward", "Train/success_rate"
_VALUES = ("Task/", "Metrics/")
_MOST_VALUES = 6
_PANEL, _HEIGHT, _LEFT, _TOP, _BOTTOM = 330, 220, 52, 34, 40
_THIN, _THICK = "#9db8d2", "#0b5394"


def columns(histories: Sequence[Any]) -> list[str]:
    """Return success, return and the task's values that all runs have."""
    first, *others = histories
    names = [name for name in first.metrics if all(name in other.metrics for other in others)]
    values = [name for name in names if name.startswith(_VALUES)][:_MOST_VALUES]
    return [name for name in (SUCCESS, RETURN) if name in names] + values


def table(histories: Sequence[Any]) -> str:
    """Return a CSV: seed, steps, seconds, and a column for each metric."""
    names = columns(histories)
    lines = [",".join(["seed", "steps", "seconds", *(short(name) for name in names)])]
    for history in sorted(histories, key=lambda one: one.run.record["seed"]):
        for row in _thinned(len(history.axes["steps"])):
            numbers = [f"{history.metrics[name][row]:.5g}" for name in names]
            axes = [f"{history.axes['steps'][row]:.0f}", f"{history.axes['time'][row]:.1f}"]
            texts = ["" if number == "nan" else number for number in numbers]
            lines.append(",".join([str(history.run.record["seed"]), *axes, *texts]))
    return "\n".join(lines) + "\n"


def short(name: str) -> str:
    """Return a metric's name for the head of a column."""
    return {RETURN: "return", SUCCESS: "success"}.get(name, name.partition("/")[2].replace(",", " "))


def drawing(task: str, histories: Sequence[Any]) -> str:
    """Return an SVG with a panel for each of at most three metrics: thin lines for seeds, a thick line for medians."""
    names = columns(histories)[:3]
    width = _PANEL * len(names)
    seeds = ", ".join(str(seed) for seed in sorted(history.run.record["seed"] for history in histories))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {_HEIGHT}" font-family="sans-serif"'
        f' role="img" aria-label="learning curves of {task}">',
        f'<rect width="{width}" height="{_HEIGHT}" fill="white"/>',
    ]
    for number, name in enumerate(names):
        parts += [f'<g transform="translate({number * _PANEL},0)">', *_panel(name, histories), "</g>"]
    about = f"{task}: seed{'s' * (len(histories) > 1)} {seeds}" + (
        "; thick: their median" if len(histories) > 1 else ""
    )
    parts.append(f'<text x="{_LEFT}" y="{_HEIGHT - 4}" font-size="10" fill="#555">{about}</text>')
    return "\n".join([*parts, "</svg>", ""])


def _panel(name: str, histories: Sequence[Any]) -> list[str]:
    curves = [_points(history, name) for history in histories]
    curves = [(x, y) for x, y in curves if len(x)]
    if not curves:
        return []
    last = max(float(x[-1]) for x, _ in curves)
    low, high = _span(name, [y for _, y in curves])
    right, bottom = _PANEL - 14, _HEIGHT - _BOTTOM

    def place(step: float, value: float) -> str:
        return (
            f"{_LEFT + (right - _LEFT) * step / last:.1f},{bottom - (bottom - _TOP) * (value - low) / (high - low):.1f}"
        )

    parts = [f'<text x="{_LEFT}" y="18" font-size="12" font-weight="bold">{short(name)}, in training</text>']
    for tick in _ticks(low, high):
        y = place(0, tick).partition(",")[2]
        parts.append(f'<line x1="{_LEFT}" x2="{right}" y1="{y}" y2="{y}" stroke="#ddd"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y}" font-size="10" text-anchor="end" dy="3">{_number(tick)}</text>')
    for share in (0.0, 0.5, 1.0):
        x = _LEFT + (right - _LEFT) * share
        anchor = "end" if share == 1.0 else "middle"
        parts.append(f'<text x="{x:.0f}" y="{bottom + 14}" font-size="10" text-anchor="{anchor}">'
                     f"{_number(last * share)}{' steps' if share == 1.0 else ''}</text>")  # fmt: skip
    one = len(curves) == 1
    for x, y in curves:
        path = " ".join(place(float(a), float(b)) for a, b in zip(x, y, strict=True))
        style = f'stroke="{_THICK if one else _THIN}" stroke-width="{2 if one else 1}"'
        parts.append(f'<polyline points="{path}" fill="none" {style}/>')
    if not one:
        grid = np.linspace(max(float(x[0]) for x, _ in curves), min(float(x[-1]) for x, _ in curves), ROWS)
        middle = np.median([np.interp(grid, x, y) for x, y in curves], axis=0)
        path = " ".join(place(float(a), float(b)) for a, b in zip(grid, middle, strict=True))
        parts.append(f'<polyline points="{path}" fill="none" stroke="{_THICK}" stroke-width="2.2"/>')
    return parts


def _points(history: Any, name: str) -> tuple[Any, Any]:
    values = history.metrics[name]
    rows = np.flatnonzero(np.isfinite(values))
    rows = rows[_thinned(len(rows))]
    return history.axes["steps"][rows], values[rows]


def _thinned(count: int) -> list[int]:
    """Return evenly spaced rows, including the last one."""
    return sorted({round(number) for number in np.linspace(0, count - 1, min(count, ROWS))}) if count else []


def _span(name: str, series: list[Any]) -> tuple[float, float]:
    if name == SUCCESS:
        return 0.0, 1.0
    low, high = min(float(y.min()) for y in series), max(float(y.max()) for y in series)
    low = min(low, 0.0) if low < 0.25 * high else low
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 6
    size = 10.0 ** math.floor(math.log10(rough))
    step = size * next(factor for factor in (1, 2, 5, 10) if size * factor >= rough)
    first = math.ceil(low / step - 1e-9)
    return [number * step for number in range(first, math.floor(high / step + 1e-9) + 1)]


def _number(value: float) -> str:
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.3g}{letter}"
    return f"{value:.3g}"
