"""Tables that fit the width of a terminal.

A table that is too wide becomes one block of lines for each row.
"""

import sys
from collections.abc import Sequence
from typing import Any

from rlcli.cli.ui.terminal import rich_console

_GAP = 2
_MAX_UNBROKEN = 30
"""Cells longer than this [characters] may be broken at spaces."""
_MIN_BROKEN = 24
"""Smallest width of a column with broken cells [characters]."""


def fill(parts: Sequence[str], width: int, indent: int = 0) -> list[str]:
    """Arrange parts of text side by side, in lines of at most `width` characters; a longer part gets its own line.

    Each line starts with `indent` spaces.
    """
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
    """Format a value as a cell of a table, with a format such as `.3f` and a unit; `-` for None."""
    return "-" if value is None else f"{value:{form}}{unit}"


def draw_table(columns: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> None:
    """Print a table on the terminal at stdout; a table that is too wide becomes a block of lines for each row."""
    from rich.table import Table
    from rich.text import Text

    page = rich_console(sys.stdout)
    min_widths = [max(map(_min_width, cells)) for cells in zip(columns, *rows, strict=True)]
    if sum(min_widths) + _GAP * (len(columns) - 1) > page.width:
        if title:
            page.print(Text(title, "bold"))
        for row in rows:
            page.print(Text("\n").join(_block(columns, row, page.width)))
        return
    table = Table(title=title and Text(title), title_justify="left", box=None, pad_edge=False, padding=(0, _GAP, 0, 0))
    for name, min_width in zip(columns, min_widths, strict=True):
        table.add_column(Text(name), header_style="bold", min_width=min_width)
    for row in rows:
        table.add_row(*map(Text, row))
    page.print(table)


def draw_map(
    heading: Sequence[str], columns: Sequence[str], rows: Sequence[Sequence[str]], styles: Sequence[Sequence[str]]
) -> None:
    """Print a heat map on the terminal at stdout; columns that do not fit are printed below the others.

    Args:
        heading: parts of the title.
        columns: names of the columns.
        rows: name of each row, followed by the texts of its cells.
        styles: rich's style of each cell, without the names.
    """
    from rich.table import Table
    from rich.text import Text

    page = rich_console(sys.stdout)
    name_width = max((len(row[0]) for row in rows), default=0)
    texts = [*columns, *(text for row in rows for text in row[1:])]
    cell_width = max(map(len, texts)) + 2
    fit = max(1, (page.width - name_width) // (cell_width + 1))
    page.print(Text("\n".join(fill(heading, page.width)), "bold"))
    for begin in range(0, len(columns), fit):
        part = slice(begin, begin + fit)
        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
        table.add_column("")
        for name in columns[part]:
            table.add_column(Text(name), justify="center", min_width=cell_width)
        for row, shades in zip(rows, styles, strict=True):
            cells = zip(row[1:][part], shades[part], strict=True)
            table.add_row(Text(row[0]), *(Text(text.center(cell_width), shade) for text, shade in cells))
        page.print(table)


def _block(columns: Sequence[str], row: Sequence[str], width: int) -> list[Any]:
    """Return a row of a table as a block of lines for a narrow terminal.

    The first line is the first cell; below it, each other cell that has content follows the name of its column.
    """
    from rich.text import Text

    first, *others = (f"{name} {cell}".strip() for name, cell in zip(columns, row, strict=True))
    rest = [part for part, cell in zip(others, row[1:], strict=True) if cell not in ("", "-")]
    return [Text(first, "bold"), *map(Text, fill(rest, width, indent=2))]


def _min_width(cell: str) -> int:
    return len(cell) if len(cell) <= _MAX_UNBROKEN else max(_MIN_BROKEN, *map(len, cell.split()))
