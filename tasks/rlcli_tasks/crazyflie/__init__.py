"""Crazyflie: rise to a point with four slow motors and hover.

Parameters and their sources: docs/reference/zoo/crazyflie.md.
"""

from rlcli.task import TaskSpec

DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Hover at a point with a 28 g quadcopter (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.crazyflie.task:CrazyflieTask",
)
