"""Reach: an arm brings its hand to poses. Numbers and their sources: docs/reference/zoo/reach.md."""

from rlcli.task import TaskSpec

JOINT = TaskSpec(
    package=__name__,
    config="joint.yaml",
    summary="Bring an arm's hand to poses by joint positions (manager-based, Isaac Lab's parameters).",
)
IK = TaskSpec(
    package=__name__,
    config="ik.yaml",
    summary="Bring an arm's hand to poses by inverse kinematics (manager-based, Isaac Lab's parameters).",
)
