"""Cartpole: balance a pole on a cart, in both workflows and from images.

Parameters and their sources: docs/reference/zoo/cartpole.md.
"""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Balance a pole on a cart (manager-based, Isaac Lab's parameters).")
CAMERA = TaskSpec(
    package=__name__,
    config="camera.yaml",
    summary="Balance a pole on a cart from depth images alone (manager-based, based on Isaac Lab's task).",
)
DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Balance a pole on a cart (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.cartpole.task:CartpoleTask",
)
