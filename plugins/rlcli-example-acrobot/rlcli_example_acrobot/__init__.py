"""An arm of two links with a motor only at its elbow, which must balance upright."""

from rlcli.task import TaskSpec

ACROBOT = TaskSpec(
    package=__name__,
    summary="Balance a two-link arm that is driven at its elbow alone.",
    terms=("rlcli_example_acrobot.terms",),
)
