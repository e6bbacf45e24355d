"""Questions about the values in Isaac Lab's term settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlcli_isaaclab.managers import SceneEntityCfg
from rlcli_isaaclab.mdp import MdpFunction
from rlcli_isaaclab.settings import Node, as_float


def is_plain(value: Any) -> bool:
    """Return whether a setting can be written to a YAML file."""
    if isinstance(value, Mapping):
        return all(map(is_plain, value.values()))
    if isinstance(value, list | tuple):
        return all(map(is_plain, value))
    return isinstance(value, str | float | int | None)


def is_entity(value: Any) -> bool:
    """Return whether a parameter is a `SceneEntityCfg`, or the dict of one."""
    if isinstance(value, SceneEntityCfg):
        return True
    return isinstance(value, Mapping) and "name" in value and ("joint_names" in value or "body_names" in value)


def builtin_name(function: Any) -> str | None:
    """Return the name of one of Isaac Lab's functions; None for the user's own function."""
    if isinstance(function, MdpFunction):
        return function.__name__
    if isinstance(function, str):
        return function.rpartition(":")[2]
    return None


def triple(ranges: Node, name: str) -> list[float]:
    """Return three numbers, by default zeros."""
    return [as_float(v) for v in ranges.get(name, (0.0, 0.0, 0.0))]


def has_no_effect(key: str, value: Any) -> bool:
    """Return whether a setting without a counterpart has a value that changes nothing."""
    return {"scale": 1.0, "offset": 0.0}.get(key) == value or value is False or value == "" or key == "use_zero_offset"
