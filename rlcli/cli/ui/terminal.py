"""Properties of an output stream: whether it is a terminal, its colours and its width.

The console and the tables decide by these properties whether to print colours and to redraw lines.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TextIO

from rlcli.settings import setting

if TYPE_CHECKING:
    from rich.console import Console

_ANY_WIDTH = 10_000
"""Line width [characters] for output into a pipe or file, wide enough that no line is wrapped."""


def is_terminal(stream: TextIO | None) -> bool:
    """Return whether a stream is a terminal that can move its cursor."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")


def supports_styles(stream: TextIO | None) -> bool:
    """Return whether to print styled tables on a stream: it is a terminal, or colours are forced."""
    return stream is not None and (stream.isatty() or color_mode() == "always")


def color_mode() -> str:
    """Return when to print colours: never, always or auto (only on a terminal).

    The environment variable NO_COLOR comes first, then FORCE_COLOR, then the user's settings.
    """
    if os.environ.get("NO_COLOR"):
        return "never"
    if os.environ.get("FORCE_COLOR"):
        return "always"
    return str(setting("color") or "auto")


def rich_console(stream: TextIO) -> Console:
    """Return rich's console for a stream, with colours if the stream supports them and the user wants them."""
    from rich.console import Console

    chosen, width = color_mode(), None if stream.isatty() or os.environ.get("COLUMNS") else _ANY_WIDTH
    if chosen == "never":
        return Console(file=stream, highlight=False, width=width, color_system=None)
    return Console(file=stream, highlight=False, width=width, force_terminal=True if chosen == "always" else None)
