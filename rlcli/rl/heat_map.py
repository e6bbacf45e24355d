"""What a stress test found, as a map: one number for each pair of values of two sweeps."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError, UsageError
from rlcli.rl.files import write_atomic
from rlcli.rl.sweeps import Point, Sweep

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


def heat_map(
    title: str, sweeps: Sequence[Sweep], values: dict[Point, float], scale: tuple[float, float] | None = None
) -> HeatMap:
    """The map of a number that each point of the grid has.

    Args:
        title: what the number is, and whose.
        sweeps: at least one.
        values: the number of each point.
        scale: numbers at the ends of the scale; None: the smallest and the largest.
    """
    down = sweeps[0] if len(sweeps) > 1 else None
    across = sweeps[min(1, len(sweeps) - 1)]
    cells = [
        tuple(min(v for at, v in values.items() if at[: len(sweeps[:2])] == (*y, x)) for x in across.values)
        for y in ([()] if down is None else [(y,) for y in down.values])
    ]
    rows = ("",) if down is None else tuple(map(number, down.values))
    if len(sweeps) > 2:
        title += f", the worst over {', '.join(sweep.name for sweep in sweeps[2:])}"
    low, high = scale or (min(values.values()), max(values.values()))
    columns = tuple(map(number, across.values))
    return HeatMap(
        title,
        "" if down is None else down.name,
        rows,
        across.name,
        columns,
        tuple(cells),
        low,
        high,
        "" if down is None else down.unit,
        across.unit,
    )


def number(value: float) -> str:
    """A value of a sweep, in few digits."""
    return f"{value:.4g}"


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
    from rlcli.rl.figures import check_drawing

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
        for place, drawn in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True):
            _panel(place, drawn)
        buffer = io.BytesIO()
        kind = file.suffix.lower().removeprefix(".")
        when = {"Date": None} if kind == "svg" else {"Software": None}
        figure.savefig(buffer, format=kind, metadata=when, dpi=150)
    write_atomic(file, buffer.getvalue())


def _panel(place: Any, drawn: HeatMap) -> None:
    shares = [[drawn.share(value) for value in row] for row in drawn.cells]
    place.imshow(shares, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto")
    place.set_title(drawn.title, fontsize=10)
    place.set_xlabel(_axis(drawn.column_name, drawn.column_unit))
    place.set_ylabel(_axis(drawn.row_name, drawn.row_unit))
    place.set_xticks(range(len(drawn.columns)), drawn.columns)
    place.set_yticks(range(len(drawn.rows)), drawn.rows)
    for y, row in enumerate(drawn.cells):
        for x, value in enumerate(row):
            dark = not 0.15 < shares[y][x] < 0.85
            colour = "white" if dark else "black"
            place.text(x, y, f"{value:.2f}", ha="center", va="center", fontsize=9, color=colour)


def _axis(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if len(unit) < 20 else f"{name}\n[{unit}]"
