"""Humanoid: a humanoid robot runs towards a far target.

Parameters and their sources: docs/reference/zoo/humanoid.md.
"""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Run with a humanoid robot (manager-based).")
DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Run with a humanoid robot (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.humanoid.task:HumanoidTask",
)
