"""Short texts for values of a task's configuration, such as noise and ranges, in the tables of a task card.

A task card describes the observations, actions, rewards and other parts of a task (`rlcli.reporting.task_card`).
"""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from rlcli.config.schema import ConstantNoiseConfig, EventConfig, GaussianNoiseConfig, UniformNoiseConfig


def number(value: float) -> str:
    """Return a number with up to six significant digits."""
    return f"{value:.6g}"


def columns_text(count: int) -> str:
    """Return the size of an observation or an action as text, such as `3 numbers`."""
    return f"{count} number{'s' * (count != 1)}"


def text_of(value: object) -> str:
    """Return a value of a configuration as text: `yes`, `0.5`, `[1, 2]`, `key: value`; `-` for None."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, int | float):
        return number(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(text_of(item) for item in value)}]"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {text_of(item)}" for key, item in value.items())
    if isinstance(value, BaseModel):
        return text_of(value.model_dump(exclude_none=True))
    return " ".join(str(value).split())


def noise_text(config: UniformNoiseConfig | GaussianNoiseConfig | ConstantNoiseConfig | None) -> str:
    """Return the operation and the distribution of a noise model as text, such as `+ uniform [-0.1, 0.1]`.

    The text is empty if there is no noise model (None).
    """
    if config is None:
        return ""
    verb = {"add": "+", "scale": "x", "set": "="}[config.operation]
    if isinstance(config, UniformNoiseConfig):
        return f"{verb} uniform [{text_of(config.low)}, {text_of(config.high)}]"
    if isinstance(config, GaussianNoiseConfig):
        return f"{verb} normal, mean {text_of(config.mean)}, std {text_of(config.std)}"
    return f"{verb} {text_of(config.value)}"


def modifier_text(settings: Mapping[str, Any]) -> str:
    """Return the kind and the settings of an observation modifier as text, such as `digital filter a: [0.9], ...`."""
    rest = {key: value for key, value in settings.items() if key != "kind"}
    return f"{settings['kind'].replace('_', ' ')} {text_of(rest)}".strip()


def when_text(config: EventConfig) -> str:
    """Return when an event of a task happens as text, such as `at every reset`."""
    if config.mode == "interval" and config.interval_range_s is not None:
        timer = ", all together" if config.global_time else ""
        return f"every {span(config.interval_range_s)} s{timer}"
    if config.mode == "reset" and config.min_steps_between:
        return f"at resets, at least {config.min_steps_between} steps apart"
    return {"startup": "once, at the start", "reset": "at every reset"}.get(config.mode, config.mode)


def span(pair: tuple[float, float]) -> str:
    """Return a range as text, such as `0 to 1`; one number if both ends are equal."""
    low, high = number(pair[0]), number(pair[1])
    return low if low == high else f"{low} to {high}"
