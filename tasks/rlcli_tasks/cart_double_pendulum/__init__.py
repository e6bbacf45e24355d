"""Cart with two links: balance both. Parameters and their sources: docs/reference/zoo/cart-double-pendulum.md."""

from rlcli.task import TaskSpec

DIRECT = TaskSpec(
    package=__name__,
    config="direct.yaml",
    summary="Balance two links on a cart with a motor between them (direct, Isaac Lab's parameters).",
    task="rlcli_tasks.cart_double_pendulum.task:CartDoublePendulumTask",
)
