"""Cartpole, in both workflows: balance a pole on a cart. Numbers and their sources: docs/zoo/cartpole.md."""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Balance a pole on a cart (manager-based, Isaac Lab's numbers).")
DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Balance a pole on a cart (direct, OmniIsaacGymEnvs' numbers).",
    task="rlcli_tasks.cartpole.task:CartpoleTask",
)
