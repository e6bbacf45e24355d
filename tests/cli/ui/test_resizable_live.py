"""Live block on a terminal whose width changes."""

import io

import pytest
from rich.console import Console
from rich.text import Text

from rlcli.cli.ui.resizable_live import ResizableLive

UP = "\x1b[1A"


@pytest.mark.parametrize(
    ("widths", "rows"),
    [
        ((60, 60), 3),
        ((60, 30), 2 + 1 + 2),  # 50, 20 and 31 columns
        ((60, 10), 5 + 2 + 4),
        ((60, 100), 3),
        ((60, 30, 20), (2 + 1) + 1 + (2 + 1)),  # of the rows that were drawn with 30 columns
    ],
)
def test_all_rows_of_the_last_block_are_erased(widths, rows):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, color_system=None, width=widths[0], height=50)
    with ResizableLive(console=console, auto_refresh=False) as live:
        for width in widths:
            console.width = width
            out.truncate(0)
            live.update(Text("\n".join(("x" * 50, "y" * 20, "z" * 31))), refresh=True)
        assert out.getvalue().count(UP) == rows - 1
