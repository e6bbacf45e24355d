"""Hand: fingers turn a cube. Parameters and their sources: docs/reference/zoo/hand-reorient.md."""

from rlcli.task import TaskSpec

DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary=(
        "Turn a cube in a hand with three fingers and a thumb to one orientation after another "
        "(direct, OmniIsaacGymEnvs' rewards)."
    ),
    task="rlcli_tasks.hand_reorient.task:HandTask",
    terms=("rlcli_tasks.hand_reorient.terms",),
)
