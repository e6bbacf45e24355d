"""Tables on a terminal: as wide as it is, and where a table would be wider, one block of lines for each row."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from rlcli.cli.ui.terminal import screen

_GAP = 2
_SHORT = 30
"""Longer cells are sentences, which may be broken; shorter ones are read at a glance and stay whole."""
_NARROWEST = 24
"""Of a column of sentences."""


def flow(parts: Sequence[str], width: int, indent: int = 0) -> list[str]:
    """Parts side by side, in as many lines as they need; none is broken unless it is wider than a line."""
    lines: list[str] = []
    line = ""
    for part in parts:
        joined = f"{line}{' ' * _GAP}{part}" if line else " " * indent + part
        if line and len(joined) > width:
            lines.append(line)
            joined = " " * indent + part
        line = joined
    return [*lines, line] if line else lines


def cell(value: Any, form: str = "", unit: str = "") -> str:
    """Return a value as a cell, in a format; `-` for None."""
    return "-" if value is None else f"{value:{form}}{unit}"


def draw_table(columns: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> None:
    """A table on the terminal that stdout is."""
    from rich.table import Table
    from rich.text import Text

    page = screen(sys.stdout)
    least = [max(map(_least, cells)) for cells in zip(columns, *rows, strict=True)]
    if sum(least) + _GAP * (len(columns) - 1) > page.width:
        if title:
            page.print(Text(title, "bold"))
        for row in rows:
            page.print(Text("\n").join(_block(columns, row, page.width)))
        return
    table = Table(title=title and Text(title), title_justify="left", box=None, pad_edge=False, padding=(0, _GAP, 0, 0))
    for name, narrowest in zip(columns, least, strict=True):
        table.add_column(Text(name), header_style="bold", min_width=narrowest)
    for row in rows:
        table.add_row(*map(Text, row))
    page.print(table)


def draw_map(
    heading: Sequence[str], columns: Sequence[str], rows: Sequence[Sequence[str]], styles: Sequence[Sequence[str]]
) -> None:
    """Coloured numbers on the terminal that stdout is; columns for which there is no room stand below."""
    from rich.table import Table
    from rich.text import Text

    page = screen(sys.stdout)
    first = max((len(row[0]) for row in rows), default=0)
    each = max(len(text) for texts in [columns, *(row[1:] for row in rows)] for text in texts) + 2
    fit = max(1, (page.width - first) // (each + 1))
    page.print(Text("\n".join(flow(heading, page.width)), "bold"))
    for begin in range(0, len(columns), fit):
        part = slice(begin, begin + fit)
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
        table.add_column("")
        for name in columns[part]:
            table.add_column(Text(name), justify="center", min_width=each)
        for row, shades in zip(rows, styles, strict=True):
            cells = zip(row[1:][part], shades[part], strict=True)
            table.add_row(Text(row[0]), *(Text(text.center(each), shade) for text, shade in cells))
        page.print(table)


def _block(columns: Sequence[str], row: Sequence[str], width: int) -> list[Any]:
    """One row: its first cell, and below it the others with the names of their columns, empty ones left out."""
    from rich.text import Text

    first, *others = (f"{name} {cell}".strip() for name, cell in zip(columns, row, strict=True))
    rest = [part for part, cell in zip(others, row[1:], strict=True) if cell not in ("", "-")]
    return [Text(first, "bold"), *map(Text, flow(rest, width, indent=2))]


def _least(cell: str) -> int:
    return len(cell) if len(cell) <= _SHORT else max(_NARROWEST, *map(len, cell.split()))
