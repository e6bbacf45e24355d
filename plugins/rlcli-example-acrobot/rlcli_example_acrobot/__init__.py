"""An arm of two links that is driven at its elbow alone, and learns to balance upright."""

from rlcli.task import TaskSpec

ACROBOT = TaskSpec(
    package=__name__,
    summary="Balance a two-link arm that is driven at its elbow alone.",
    terms=("rlcli_example_acrobot.terms",),
)
