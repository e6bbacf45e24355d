"""Lift: an arm grasps a cube and holds it at a commanded position.

Parameters and their sources: docs/reference/zoo/lift-cube.md.
"""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(
    package=__name__,
    summary="Take a cube and hold it in the air (manager-based, Isaac Lab's parameters).",
)
