"""Example plugin with the task acrobot: an arm with a motor only at its elbow must balance upright."""

from rlcli.task import TaskSpec

ACROBOT = TaskSpec(
    package=__name__,
    summary="Balance a two-link arm that is driven at its elbow alone.",
    terms=("rlcli_example_acrobot.terms",),
)
