"""Cartpole: balance a pole on a cart, in both workflows and from images. Numbers: docs/reference/zoo/cartpole.md."""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Balance a pole on a cart (manager-based, Isaac Lab's parameters).")
CAMERA = TaskSpec(
    package=__name__,
    config="camera.yaml",
    summary="Balance a pole on a cart from depth pictures alone (manager-based, after Isaac Lab's).",
)
DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Balance a pole on a cart (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.cartpole.task:CartpoleTask",
)
