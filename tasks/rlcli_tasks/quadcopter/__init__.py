"""Quadcopter: fly to a point and hover, with tilting rotors.

Parameters and their sources: docs/reference/zoo/quadcopter.md.
"""

from rlcli.task import TaskSpec

DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Hover at a point with four tilting rotors (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.quadcopter.task:QuadcopterTask",
)
