"""Ant: a four-legged walker runs towards a far target.

Parameters and their sources: docs/reference/zoo/ant-direct.md.
"""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Run with a four-legged robot (manager-based).")
DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Run with a four-legged robot (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.ant.task:AntTask",
)
