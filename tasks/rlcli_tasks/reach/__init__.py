"""Reach: an arm brings its hand to poses. Parameters and their sources: docs/reference/zoo/reach.md."""

from rlcli.task import TaskSpec

JOINT = TaskSpec(
    package=__name__,
    config="joint.yaml",
    summary="Move an arm's hand to commanded poses with joint positions (manager-based, Isaac Lab's parameters).",
)
IK = TaskSpec(
    package=__name__,
    config="ik.yaml",
    summary="Move an arm's hand to commanded poses with inverse kinematics (manager-based, Isaac Lab's parameters).",
)
