"""Check that the conditions of success of a task can hold together with the length of its episodes."""

from collections.abc import Iterator

from rlcli.config.layers import Layers
from rlcli.config.messages import dotted
from rlcli.config.schema import TaskConfig
from rlcli.errors import Problem


def impossible_conditions(task: TaskConfig, layers: Layers, *, is_run: bool) -> Iterator[Problem]:
    """Yield a problem for each condition of success that no episode can meet.

    An episode that an override, a flag or a --config file has shortened, for a quick trial, may be shorter than
    `hold_s`, also in the run that records the trial. The default of `hold_s` is not checked.

    Args:
        task: the validated task.
        layers: the sources of its values.
        is_run: whether the configuration is the record of a run.
    """
    length_s = task.max_episode_length * task.step_dt
    origin = layers.origin(("episode_length_s",))
    is_trial = is_run or (origin is not None and origin.layer in ("override", "flag", "config"))
    for name, condition in task.success.items():
        if condition is None:
            continue
        at, low, high = ("success", name), condition.at_least, condition.at_most
        path = (*at, "hold_s")
        is_given = path in layers.origins
        if condition.hold_s > length_s * (1.0 + 1e-9) and is_given and not is_trial:
            message = f"expected at most the length of an episode, {length_s:g} s, found {condition.hold_s:g} s"
            hint = "no episode could succeed: lower hold_s, or raise episode_length_s"
            yield Problem(layers.place(path), dotted(path), message, hint)
        if low is not None and high is not None and low > high:
            path = (*at, "at_least")
            message = f"expected at most at_most, {high:g}, found {low:g}"
            yield Problem(layers.place(path), dotted(path), message, "no value could meet both: correct one of them")
