"""Version of rich's `Live` display that is drawn correctly after the terminal has been made narrower.

The live views of commands and trainings use this version.
"""

from __future__ import annotations

from typing import Any

from rich.live import Live
from rich.segment import Segment


class ResizableLive(Live):
    """rich's `Live`, which also erases the rows into which a narrower terminal has wrapped lines of the last block."""

    _drawn: tuple[Any, Any] | None = None
    """Console options and content with which the block was drawn last; None: the block was not drawn yet."""

    def process_renderables(self, renderables: list[Any]) -> list[Any]:
        """Move the cursor to the start of the last block, and draw the block again."""
        with self._lock:
            width, block = self.console.width, self._live_render
            if self._drawn is not None and width < self._drawn[0].max_width:
                lines = self.console.render_lines(self._drawn[1], self._drawn[0], pad=False)
                lengths = [Segment.get_line_length(line) for line in lines[: block.last_render_height]]
                block._shape = width, sum(max(1, -(-length // width)) for length in lengths)
            self._drawn = self.console.options, block.renderable
            return super().process_renderables(renderables)
