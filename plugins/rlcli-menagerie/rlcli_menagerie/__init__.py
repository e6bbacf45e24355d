"""Velocity tracking on Unitree's Go1 and G1. The user provides the robots' MJCF models.

rlcli reads the `TaskSpec`s of this module when it lists tasks, so the module imports nothing heavy.
"""

from rlcli.task import TaskSpec

GO1 = TaskSpec(
    package=__name__,
    config="go1.yaml",
    summary="Follow velocity commands with a Unitree Go1 (you provide the model).",
)
G1 = TaskSpec(
    package=__name__,
    config="g1.yaml",
    summary="Follow velocity commands with a Unitree G1 (you provide the model).",
)
