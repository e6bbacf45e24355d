"""Ant: a four-legged walker runs towards a far target. Numbers and their sources: docs/reference/zoo/ant-direct.md."""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Run with a four-legged walker (manager-based).")
DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Run with a four-legged walker (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.ant.task:AntTask",
)
