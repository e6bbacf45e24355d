"""Table on three legs: catch a ball and hold it in the middle.

Parameters and their sources: docs/reference/zoo/ball-balance.md.
"""

from rlcli.task import TaskSpec

DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Catch a ball on a three-legged table and hold it in the middle (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.ball_balance.task:BallBalanceTask",
)
