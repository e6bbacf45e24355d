"""Heat maps of `rlcli stress`: a metric of the policy for each pair of values of two varied parameters.

All heat maps of a stress test, one for each policy, have the same colour scale.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rlcli.evaluation.stress_parameters import Point, Sweep, format_value
from rlcli.runs.atomic_io import write_atomic

FORMATS = (".png", ".svg")


class Axis(NamedTuple):
    """Parameter along one side of a heat map: its name, its values as text, and its unit."""

    name: str = ""
    values: tuple[str, ...] = ("",)
    unit: str = ""

    @property
    def label(self) -> str:
        """Name and unit; a long unit is on a second line."""
        return f"{self.name} [{self.unit}]" if len(self.unit) < 20 else f"{self.name}\n[{self.unit}]"


@dataclass(frozen=True, slots=True)
class HeatMap:
    """Heat map with a row for each value of the first varied parameter and a column for each value of the second.

    If further parameters are varied, a cell has the smallest metric over all their values.
    """

    title: str
    rows: Axis
    columns: Axis
    cells: tuple[tuple[float, ...], ...]
    """Values of the metric: one tuple for each row, with one value for each column."""
    low: float
    """Value at the lower end of the colour scale."""
    high: float
    """Value at the upper end of the colour scale."""

    def share(self, value: float) -> float:
        """Return the position of a value on the colour scale, from 0 (`low`) to 1 (`high`)."""
        return 1.0 if self.high <= self.low else min(1.0, max(0.0, (value - self.low) / (self.high - self.low)))


def heat_maps(
    sweeps: Sequence[Sweep], values: Sequence[tuple[str, Mapping[Point, float]]], metric: str
) -> list[HeatMap]:
    """Return one heat map for each policy, all with the same colour scale.

    Args:
        sweeps: the varied parameters, one or more, each with its values.
        values: (name of a policy, its metric at each combination of the parameters' values) for each policy.
        metric: name of the metric. The scale of `success` is 0 to 1, that of others the range of their values.
    """
    numbers = [number for _, points in values for number in points.values()]
    scale = (0.0, 1.0) if metric == "success" else (min(numbers), max(numbers))
    return [heat_map(f"{metric}, {name}", sweeps, points, scale) for name, points in values]


def heat_map(
    title: str, sweeps: Sequence[Sweep], values: Mapping[Point, float], scale: tuple[float, float] | None = None
) -> HeatMap:
    """Return the heat map of one metric.

    Args:
        title: metric and policy.
        sweeps: the varied parameters, one or more, each with its values; a single one gives a map with one row.
        values: the metric at each combination of the parameters' values.
        scale: values at the ends of the colour scale; None: the smallest and the largest value.
    """
    scale = scale or (min(values.values()), max(values.values()))
    *row_sweeps, column_sweep = sweeps[:2]
    cells = []
    for row in [(value,) for value in row_sweeps[0].values] if row_sweeps else [()]:
        points = [(*row, column) for column in column_sweep.values]
        cells.append(tuple(min(v for at, v in values.items() if at[: len(point)] == point) for point in points))
    if len(sweeps) > 2:
        title += f", the worst over {', '.join(sweep.name for sweep in sweeps[2:])}"
    rows, columns = (_axis(row_sweeps[0]) if row_sweeps else Axis()), _axis(column_sweep)
    return HeatMap(title, rows, columns, tuple(cells), *scale)


def _axis(sweep: Sweep) -> Axis:
    return Axis(sweep.name, tuple(map(format_value, sweep.values)), sweep.unit)


def draw(file: Path, maps: Sequence[HeatMap]) -> None:
    """Plot heat maps side by side into one file (.png or .svg).

    Raises:
        MachineError: if the file cannot be written.
    """
    import matplotlib
    from matplotlib.figure import Figure

    # a fixed salt makes the bytes of the SVG file reproducible
    settings: dict[str, Any] = {"svg.hashsalt": "rlcli", "text.parse_math": False}
    with matplotlib.rc_context(settings):
        width, height = max(len(m.columns.values) for m in maps), max(len(m.rows.values) for m in maps)
        size = (len(maps) * max(3.6, 0.75 * width + 2.0), max(2.2, 0.5 * height + 1.6))
        figure = Figure(figsize=size, layout="constrained")
        for axes, heat_map in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
            _draw_map(axes, heat_map)
        buffer = io.BytesIO()
        kind = file.suffix.lower().removeprefix(".")
        metadata = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(buffer, format=kind, metadata=metadata, dpi=150)
    write_atomic(file, buffer.getvalue())


def _draw_map(axes: Any, heat_map: HeatMap) -> None:
    shares = [[heat_map.share(value) for value in row] for row in heat_map.cells]
    axes.imshow(shares, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_title(heat_map.title, fontsize=10)
    axes.set_xlabel(heat_map.columns.label)
    axes.set_ylabel(heat_map.rows.label)
    axes.set_xticks(range(len(heat_map.columns.values)), heat_map.columns.values)
    axes.set_yticks(range(len(heat_map.rows.values)), heat_map.rows.values)
    for y, row in enumerate(heat_map.cells):
        for x, value in enumerate(row):
            # white on both ends of the colour map, which are dark
            colour = "black" if 0.15 < shares[y][x] < 0.85 else "white"
            axes.text(x, y, f"{value:.2f}", ha="center", va="center", fontsize=9, color=colour)
