"""Ingenuity: fly from point to point on Mars with two coaxial rotors.

Parameters and their sources: docs/reference/zoo/ingenuity.md.
"""

from rlcli.task import TaskSpec

DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Fly from point to point with the Mars helicopter (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.ingenuity.task:IngenuityTask",
)
