"""Check that the bounds of each condition of success can be met."""

from collections.abc import Iterator

from rlcli.config.layers import Layers
from rlcli.config.messages import dotted
from rlcli.config.schema import TaskConfig
from rlcli.errors import Problem


def impossible_conditions(task: TaskConfig, layers: Layers) -> Iterator[Problem]:
    """Yield a problem for each condition of success whose `at_least` is above its `at_most`.

    Args:
        task: the validated task.
        layers: the sources of its values.
    """
    for name, condition in task.success.items():
        if condition is None:
            continue
        low, high = condition.at_least, condition.at_most
        if low is not None and high is not None and low > high:
            path = ("success", name, "at_least")
            message = f"at_least is {low:g} and above at_most, which is {high:g}: no value meets both bounds"
            yield Problem(layers.place(path), dotted(path), message, "correct one of the two bounds")
