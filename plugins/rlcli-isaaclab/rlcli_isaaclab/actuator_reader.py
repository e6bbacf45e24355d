"""Reader of Isaac Lab's actuators: implicit ones become joint settings, explicit ones actuator models."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from rlcli_isaaclab.settings import Node, Report, as_float, kind_of, to_plain

_EXPLICIT = ("IdealPDActuator", "DCMotor", "DelayedPDActuator", "RemotizedPDActuator")
_NETWORKS = ("ActuatorNetLSTM", "ActuatorNetMLP")

JointSettings = list[tuple[str, dict[str, Any]]]
"""(regex of joints, settings); later entries override earlier ones."""


def read_actuators(
    actuators: Node,
    order_joints: Callable[[list[str], Node], Any],
    entity: str,
    replaced: Mapping[str, Mapping[str, float]],
) -> tuple[JointSettings, dict[str, Any]]:
    """Return the settings of the joints, and the explicit actuator models by group.

    Args:
        actuators: groups of actuators.
        order_joints: returns the names or regexes of a group's joints in the model's order.
        entity: name of the entity, for messages.
        replaced: group -> gains that replace its actuator network.
    """
    joints: JointSettings = []
    models: dict[str, Any] = {}
    for group, item in actuators.nodes():
        kind = kind_of(item.get("class_type"))
        patterns = item.require("joint_names_expr") or [".*"]
        patterns = [patterns] if isinstance(patterns, str) else list(patterns)
        effort_limit = item.get("effort_limit_sim")
        effort_limit = item.get("effort_limit") if effort_limit is None else effort_limit
        item.skip("effort_limit")
        for key in ("velocity_limit", "velocity_limit_sim"):
            if kind != "DCMotor" or key != "velocity_limit":
                item.note("ignored", key, "MuJoCo's joints have no speed limit")
        for key in ("dynamic_friction", "viscous_friction"):
            item.note("ignored", key, "MuJoCo has no such setting; set friction and damping instead")
        passive = {"armature": item.get("armature"), "friction_loss": item.get("friction")}
        gains = {"stiffness": item.get("stiffness"), "damping": item.get("damping")}
        if kind == "ImplicitActuator":
            settings = {**gains, **passive, "effort_limit": effort_limit}
        elif kind in _NETWORKS and group not in replaced:
            what = f"the actuator network of '{kind}' is a TorchScript file, which rlcli does not load"
            gains_key = f"{group}: {{stiffness: S, damping: D}}"
            hint = f"give gains in models.yaml: {entity}: {{model: FILE.xml, gains: {{{gains_key}}}}}"
            item.report.problem(item.key, what, hint)
            continue
        elif kind in _EXPLICIT or kind in _NETWORKS:
            if kind in _NETWORKS:
                gains = dict(replaced[group])
                item.note("approximated", "network_file", "replaced by the gains of models.yaml")
                item.skip("pos_scale", "vel_scale", "torque_scale", "input_order", "input_idx")
                kind = "DCMotor"
            elif kind == "RemotizedPDActuator":
                limits = [row[2] for row in item.get("joint_parameter_lookup") or [[0, 0, 0]]]
                effort_limit = max(limits) if item.get("effort_limit") is None else effort_limit
                item.note("approximated", "joint_parameter_lookup", "the effort limit is the largest of the table")
                kind = "DelayedPDActuator"
            models[group] = _read_explicit_actuator(item, kind, order_joints(patterns, item), gains)
            settings = passive
        else:
            item.report.problem(
                item.key,
                f"an actuator of kind '{kind}' has no counterpart in rlcli; use ImplicitActuator or IdealPDActuator",
            )
            continue
        for setting, value in settings.items():
            if isinstance(value, Mapping):
                joints += [(str(pattern), {setting: as_float(number)}) for pattern, number in value.items()]
            elif value is not None:
                joints += [(pattern, {setting: as_float(value)}) for pattern in patterns]
    return joints, models


def _read_explicit_actuator(item: Node, kind: str, joints: Any, gains: Mapping[str, Any]) -> dict[str, Any]:
    """Return an actuator model; rlcli computes its effort before each physics step."""
    config = {"joints": joints, "kind": "dc_motor" if kind == "DCMotor" else "pd"}
    config |= {key: value for key, value in gains.items() if value is not None}
    effort_limit = item.get("effort_limit")
    if effort_limit is not None:
        config["effort_limit"] = effort_limit
    if kind == "DCMotor":
        config["saturation_effort"] = item.require("saturation_effort")
        config["velocity_limit"] = item.require("velocity_limit")
    if kind == "DelayedPDActuator":
        config["delay"] = [item.get("min_delay", 0), item.get("max_delay", 0)]
    plain: dict[str, Any] = to_plain(config)
    return plain


def merge_joint_settings(
    settings: JointSettings, model: Mapping[str, Any], driven: Mapping[str, str], name: str, report: Report
) -> dict[str, Any]:
    """Return `joints` of one entity, without the settings that the MJCF has already.

    Args:
        settings: settings of the joints, from `read_actuators`.
        model: names and values of the entity's MJCF, from `SceneReader`.
        driven: joint -> what an action commands: effort, velocity or position.
        name: name of the entity.
        report: receives what is approximated.
    """
    by_pattern: dict[str, dict[str, Any]] = {}
    for pattern, values in settings:
        by_pattern.setdefault(pattern, {}).update(values)
    joints: dict[str, Any] = {}
    for pattern, values in by_pattern.items():
        matched = [joint for joint in model["joint"] if re.fullmatch(pattern, joint)]
        stiffness = values.pop("stiffness", 0.0)
        kinds = {driven.get(joint, "") for joint in matched}
        if stiffness and kinds == {"effort"}:
            values = {"stiffness": stiffness, **values}
            why = "a spring around the MJCF's rest position, in addition to the effort"
            report.entries[("scene", name, "actuators", pattern, "stiffness")] = ("approximated", why)
        elif stiffness:
            values = {"actuator": "position", "kp": stiffness, "kv": values.pop("damping", 0.0), **values}
        elif kinds == {"velocity"} and values.get("damping"):
            values = {"actuator": "velocity", "kv": values.pop("damping"), **values}
        if matched:
            for key in ("damping", "armature", "friction_loss"):
                if key in values and all(model[key][joint] == values[key] for joint in matched):
                    del values[key]
            if not stiffness and not any(joint in driven or joint in model["driven"] for joint in matched):
                values.pop("effort_limit", None)  # no action and no actuator of the MJCF drives these joints
        if values:
            joints[pattern] = {key: values[key] for key in sorted(values, key=_rank)}
    return joints


_LAST_KEYS = ("damping", "armature", "friction_loss", "effort_limit")
"""Keys that follow the actuator's own keys in the file."""


def _rank(key: str) -> int:
    return _LAST_KEYS.index(key) if key in _LAST_KEYS else -1
