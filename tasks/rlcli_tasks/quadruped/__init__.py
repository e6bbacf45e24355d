"""Quadruped: a four-legged robot follows velocity commands.

Parameters and their sources: docs/reference/zoo/quadruped-flat.md.
"""

from rlcli.task import TaskSpec

FLAT = TaskSpec(
    package=__name__,
    config="flat.yaml",
    summary="Follow velocity commands on flat ground with a four-legged robot (manager-based, Isaac Lab's parameters).",
)
ROUGH = TaskSpec(
    package=__name__,
    config="rough.yaml",
    summary="Follow velocity commands over slopes, stairs and rubble with a four-legged robot (manager-based).",
)
