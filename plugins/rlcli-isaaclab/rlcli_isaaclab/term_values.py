"""Helpers that classify and convert values in Isaac Lab's term settings."""

from __future__ import annotations

import copy
import typing
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, get_args

from rlcli.config.schema.base import Range
from rlcli.config.term_signatures import Signature
from rlcli_isaaclab.config_class import to_dict
from rlcli_isaaclab.managers import SceneEntityCfg
from rlcli_isaaclab.mdp import MdpFunction
from rlcli_isaaclab.settings import Node, as_float, to_plain


def is_plain(value: Any) -> bool:
    """Return whether a setting only has dicts, lists, strings, numbers and None, which a YAML file can hold."""
    if isinstance(value, Mapping):
        return all(map(is_plain, value.values()))
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    return isinstance(value, str | float | int | None)


def is_entity(value: Any) -> bool:
    """Return whether a parameter is a `SceneEntityCfg`, or a dict with its members."""
    if isinstance(value, SceneEntityCfg):
        return True
    return isinstance(value, Mapping) and "name" in value and ("joint_names" in value or "body_names" in value)


def resolved(value: Any, scene: Any) -> Any:
    """Return a parameter in which every `SceneEntityCfg` has the indices of its joints and bodies in `scene`."""
    if isinstance(value, list | tuple):
        return type(value)(resolved(item, scene) for item in value)
    if isinstance(value, Mapping) and {"name", "joint_names", "body_names"} <= set(value):
        value = SceneEntityCfg(**value)
    elif isinstance(value, Mapping):
        return {key: resolved(item, scene) for key, item in value.items()}
    if isinstance(value, SceneEntityCfg):
        value = copy.deepcopy(value)
        scene.resolve(value)
    return value


def builtin_name(function: Any) -> str | None:
    """Return the name of a function that is Isaac Lab's or only known by name; None for the user's own function."""
    if isinstance(function, MdpFunction):
        return function.__name__
    if isinstance(function, str):
        return function.rpartition(":")[2]
    return None


def order_ranges(signature: Signature, config: dict[str, Any]) -> None:
    """Swap the ends of ranges in `config` that are written as (high, low), which Isaac Lab accepts.

    The types of the term's parameters in `signature` tell which of them are ranges.
    """
    for parameter in signature.parameters:
        if parameter.name in config and _has_range(parameter.type):
            config[parameter.name] = _in_order(config[parameter.name])


def _has_range(annotation: Any) -> bool:
    return annotation == Range or any(map(_has_range, get_args(annotation)))


def _in_order(value: Any) -> Any:
    if isinstance(value, list) and len(value) == 2 and all(isinstance(end, int | float) for end in value):
        return sorted(value)
    return [_in_order(item) for item in value] if isinstance(value, list) else value


def triple(ranges: Node, name: str) -> list[float]:
    """Return the setting `name` of `ranges` as three floats; zeros if it is not set."""
    return [as_float(v) for v in ranges.get(name, (0.0, 0.0, 0.0))]


def has_no_effect(key: str, value: Any) -> bool:
    """Return whether a setting that rlcli lacks has a value without effect, such as `scale` = 1."""
    return {"scale": 1.0, "offset": 0.0}.get(key) == value or value is False or value == "" or key == "use_zero_offset"


def type_hints(call: Any) -> dict[str, Any]:
    """Return the annotations of a function's parameters, as far as they are known when it runs."""
    try:
        return typing.get_type_hints(call)
    except Exception:  # an annotation refers to a name imported under TYPE_CHECKING
        known_types = {"float": float, "int": int, "bool": bool, "str": str, "SceneEntityCfg": SceneEntityCfg}
        annotations: Mapping[str, Any] = getattr(call, "__annotations__", {})
        return {name: known_types.get(a) if isinstance(a, str) else a for name, a in annotations.items()}


def set_members(target: Any, values: Mapping[str, Any]) -> None:
    """Set the members of a configuration object to `values`. A member with an equal value keeps its type and object."""
    for name, value in values.items():
        now = getattr(target, name, None)
        if isinstance(value, Mapping) and hasattr(now, "__dataclass_fields__"):
            set_members(now, value)
        elif to_plain(to_dict(now)) != value:
            setattr(target, name, tuple(value) if isinstance(now, tuple) and isinstance(value, list) else value)


def to_namespace(value: Any) -> Any:
    """Return a dict as an object with its keys as attributes, nested dicts too; return other values unchanged."""
    if isinstance(value, dict) and all(str(key).isidentifier() for key in value):
        return SimpleNamespace(**{key: to_namespace(item) for key, item in value.items()})
    return value
