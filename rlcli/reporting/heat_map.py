"""What a stress test found, as a map: one number for each pair of values of two sweeps."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError, UsageError
from rlcli.evaluation.stress_params import Point, Sweep, format_value
from rlcli.runs.atomic_io import write_atomic

FORMATS = (".png", ".svg")


@dataclass(frozen=True, slots=True)
class HeatMap:
    """Rows are the first sweep's values, columns the second's; of further sweeps each cell is the worst."""

    title: str
    row_name: str
    rows: tuple[str, ...]
    column_name: str
    columns: tuple[str, ...]
    cells: tuple[tuple[float, ...], ...]
    low: float
    high: float
    """The numbers at the ends of the scale of colours."""

    row_unit: str = ""
    column_unit: str = ""

    def share(self, value: float) -> float:
        """Where a number lies on the scale, from 0 to 1."""
        return 1.0 if self.high <= self.low else min(1.0, max(0.0, (value - self.low) / (self.high - self.low)))


def heat_maps(
    sweeps: Sequence[Sweep], values: Sequence[tuple[str, Mapping[Point, float]]], metric: str
) -> list[HeatMap]:
    """Return maps of one number of several policies, on one scale of colours.

    Args:
        sweeps: at least one.
        values: (name of a policy, its number at each point of the grid) each.
        metric: name of the number. Success has the scale from 0 to 1, others that from the smallest to the largest.
    """
    numbers = [number for _, points in values for number in points.values()]
    scale = (0.0, 1.0) if metric == "success" else (min(numbers), max(numbers))
    return [heat_map(f"{metric}, {name}", sweeps, points, scale) for name, points in values]


def heat_map(
    title: str, sweeps: Sequence[Sweep], values: Mapping[Point, float], scale: tuple[float, float] | None = None
) -> HeatMap:
    """Return the map of one number at each point of the grid.

    Args:
        title: what the number is, and whose.
        sweeps: at least one.
        values: the number at each point.
        scale: numbers at the ends of the scale of colours; None: the smallest and the largest.
    """
    low, high = scale or (min(values.values()), max(values.values()))
    down = sweeps[0] if len(sweeps) > 1 else None
    across = sweeps[min(1, len(sweeps) - 1)]
    cells = [
        tuple(min(v for at, v in values.items() if at[: len(sweeps[:2])] == (*y, x)) for x in across.values)
        for y in ([()] if down is None else [(y,) for y in down.values])
    ]
    if len(sweeps) > 2:
        title += f", the worst over {', '.join(sweep.name for sweep in sweeps[2:])}"
    return HeatMap(
        title,
        "" if down is None else down.name,
        ("",) if down is None else tuple(map(format_value, down.values)),
        across.name,
        tuple(map(format_value, across.values)),
        tuple(cells),
        low,
        high,
        "" if down is None else down.unit,
        across.unit,
    )


def check_picture(file: Path) -> None:
    """Refuse, before anything is run, a picture that could not be drawn.

    Raises:
        UsageError: for another kind of file.
        MachineError: if its folder is not there.
        DependencyError: if matplotlib is not installed.
    """
    if file.suffix.lower() not in FORMATS:
        raise UsageError(f"--output {file} is no picture", hint=f"a name that ends in {' or '.join(FORMATS)}")
    if not file.absolute().parent.is_dir():
        raise MachineError(f"--output: there is no folder {file.absolute().parent}")
    from rlcli.reporting.figures import check_drawing

    check_drawing()


def draw(file: Path, maps: Sequence[HeatMap]) -> None:
    """Draw maps side by side, in one scale of colours.

    Raises:
        MachineError: if the file cannot be written.
    """
    import matplotlib
    from matplotlib.figure import Figure

    settings: dict[str, Any] = {"svg.hashsalt": "rlcli", "text.parse_math": False}  # the same bytes again
    with matplotlib.rc_context(settings):
        wide, tall = max(len(m.columns) for m in maps), max(len(m.rows) for m in maps)
        size = (len(maps) * max(3.6, 0.75 * wide + 2.0), max(2.2, 0.5 * tall + 1.6))
        figure = Figure(figsize=size, layout="constrained")
        for axes, heat_map in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
            _panel(axes, heat_map)
        buffer = io.BytesIO()
        kind = file.suffix.lower().removeprefix(".")
        when = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(buffer, format=kind, metadata=when, dpi=150)
    write_atomic(file, buffer.getvalue())


def _panel(axes: Any, heat_map: HeatMap) -> None:
    shares = [[heat_map.share(value) for value in row] for row in heat_map.cells]
    axes.imshow(shares, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_title(heat_map.title, fontsize=10)
    axes.set_xlabel(_axis(heat_map.column_name, heat_map.column_unit))
    axes.set_ylabel(_axis(heat_map.row_name, heat_map.row_unit))
    axes.set_xticks(range(len(heat_map.columns)), heat_map.columns)
    axes.set_yticks(range(len(heat_map.rows)), heat_map.rows)
    for y, row in enumerate(heat_map.cells):
        for x, value in enumerate(row):
            dark = not 0.15 < shares[y][x] < 0.85
            colour = "white" if dark else "black"
            axes.text(x, y, f"{value:.2f}", ha="center", va="center", fontsize=9, color=colour)


def _axis(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if len(unit) < 20 else f"{name}\n[{unit}]"
