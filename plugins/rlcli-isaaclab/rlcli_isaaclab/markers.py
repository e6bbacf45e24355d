"""Replacement for markers that a task creates, which rlcli does not draw.

A task of Isaac Lab that imports a name from `isaaclab.markers` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.missing_names import report_once


class VisualizationMarkers:
    """Markers that are never drawn, so that tasks which create them run."""

    def __init__(self, cfg: Any) -> None:
        self.cfg = cfg
        report_once("VisualizationMarkers are not drawn: viewers and videos show only bodies and built-in commands")

    def visualize(self, *poses: Any, **options: Any) -> None:
        """Do nothing: rlcli does not draw a task's own markers."""

    def set_visibility(self, visible: bool) -> None:
        """Do nothing: rlcli does not draw a task's own markers."""

    def is_visible(self) -> bool:
        """Return False."""
        return False
