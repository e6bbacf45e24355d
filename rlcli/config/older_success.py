"""Conversion of `success` in runs of earlier versions, where it was one function, to named conditions."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.config.strict_yaml import Document

_CONDITIONS = {
    "joints_near": {"joint": ("joint_error", "at_most", "tolerance")},
    "root_moves": {
        "velocity": ("root_velocity", "at_least", "speed"),
        "tilt": ("root_tilt", "at_most", "limit_angle"),
    },
    "root_upright": {
        "tilt": ("root_tilt", "at_most", "limit_angle"),
        "height": ("root_height", "at_least", "minimum_height"),
    },
    "root_near": {"position": ("root_distance", "at_most", "tolerance")},
    "root_hovers": {
        "position": ("root_distance_to", "at_most", "tolerance"),
        "speed": ("root_speed", "at_most", "speed"),
    },
    "velocity_tracked": {
        "velocity": ("velocity_error", "at_most", "linear_tolerance"),
        "yaw_rate": ("yaw_rate_error", "at_most", "angular_tolerance"),
    },
    "velocity_tracked_on_average": {
        "velocity": ("mean_velocity_error", "at_most", "linear_tolerance"),
        "yaw_rate": ("mean_yaw_rate_error", "at_most", "angular_tolerance"),
    },
    "body_at_goal": {
        "position": ("body_goal_distance", "at_most", "tolerance"),
        "angle": ("body_goal_angle", "at_most", "angle_tolerance"),
    },
    "site_at_goal": {"position": ("site_goal_distance", "at_most", "tolerance")},
    "object_at_goal": {"position": ("object_goal_distance", "at_most", "tolerance")},
}
"""Earlier condition -> name of each new condition -> its term, its bound, and the earlier key of the bound."""
_OWN_KEYS = {
    "root_velocity": ("entity", "direction"),
    "root_tilt": ("entity",),
    "root_height": ("entity",),
    "root_distance_to": ("entity", "goal"),
    "root_speed": ("entity",),
}
"""Term -> its keys, for terms that do not take all keys of the earlier condition."""


def upgraded(document: Document, file: Path) -> Document:
    """Return a parsed file; if it is the `config.yaml` of a run, convert its `success` to the present form."""
    success = document.data.get("success")
    if file.name == "config.yaml" and isinstance(success, dict) and isinstance(success.get("func"), str):
        document.data["success"] = _named_conditions(success)
    return document


def _named_conditions(success: Mapping[str, Any]) -> dict[str, Any]:
    """Return the named conditions, `{NAME: {func: ...}}`, that equal `success` in its earlier form, `{func: ...}`."""
    bounds = _CONDITIONS.get(str(success["func"]), {})
    if not bounds:
        return {"success": dict(success)}  # a function of the task, which returns a truth value
    old_keys = {"func", "hold_s", *(key for _, _, key in bounds.values())}
    others = {key: value for key, value in success.items() if key not in old_keys}
    hold = {"hold_s": success["hold_s"]} if "hold_s" in success else {}
    conditions = {}
    for name, (term, bound, key) in bounds.items():
        if success.get(key) is not None:
            own = {k: v for k, v in others.items() if k in _OWN_KEYS.get(term, others)}
            conditions[name] = {"func": term, **own, bound: success[key], **hold}
    return conditions
