"""Lift: an arm takes a cube and holds it where it is asked to. Numbers and their sources: docs/reference/zoo/lift-cube.md."""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(
    package=__name__,
    summary="Take a cube and hold it in the air (manager-based, Isaac Lab's numbers).",
)
