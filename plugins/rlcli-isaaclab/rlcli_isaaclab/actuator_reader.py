"""Reader of Isaac Lab's actuators, which become settings of rlcli's scene.

Implicit actuators, which the simulator computes, become joint settings; explicit ones, which Isaac Lab computes in
Python, become actuator models.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rlcli.errors import listing
from rlcli_isaaclab.settings import Node, Report, as_float, kind_of, to_plain
from rlcli_isaaclab.user_actuators import is_user_actuator

_EXPLICIT = ("IdealPDActuator", "DCMotor", "DelayedPDActuator", "RemotizedPDActuator")
_NETWORKS = ("ActuatorNetLSTM", "ActuatorNetMLP")

JointSettings = list[tuple[str, dict[str, Any], list[str]]]
"""List of (regular expression of joint names, settings, joints of the actuator group that it matches).

Later entries override earlier ones.
"""


def read_actuators(
    actuators: Node,
    order_joints: Callable[[list[str], Node], Any],
    joint_names: Sequence[str],
    entity: str,
    replaced: Mapping[str, Mapping[str, float]],
    own: dict[tuple[str, str], Mapping[str, Any]],
) -> tuple[JointSettings, dict[str, Any]]:
    """Return (settings of the joints, name of an actuator group -> its explicit actuator model).

    Args:
        actuators: the groups of actuators, `actuators` of an `ArticulationCfg`.
        order_joints: function that sorts the joints of a group (names or regular expressions) into the order of the
            model.
        joint_names: the joints of the entity's model.
        entity: name of the entity, for messages.
        replaced: group -> gains of the PD controller that replaces its actuator network.
        own: filled with (entity, group) -> settings, for each group whose actuator class is the user's own.
    """
    joints: JointSettings = []
    models: dict[str, Any] = {}
    for group, item in actuators.nodes():
        kind = kind_of(item.get("class_type"))
        if "thruster_names_expr" in item:
            item.mark_mapped(*item.data)
            continue
        patterns = item.require("joint_names_expr") or [".*"]
        patterns = [patterns] if isinstance(patterns, str) else list(patterns)
        in_group = item.report.matching(patterns, joint_names, item.key)
        passive = {
            "armature": item.get("armature"),
            "friction_loss": item.get("friction"),
            "viscous_friction": item.get("viscous_friction"),
        }
        if item.get("dynamic_friction") != item.get("friction"):
            item.note("ignored", "dynamic_friction", "MuJoCo's joints have a single dry friction; `friction` sets it")
        gains = {"stiffness": item.get("stiffness"), "damping": item.get("damping")}
        if kind == "ImplicitActuator":
            settings = {**gains, **passive, **_read_implicit_limits(item)}
        elif is_user_actuator(item.data.get("class_type")):
            own[entity, group] = item.data
            item.mark_mapped(*item.data)
            if item.data["class_type"].is_implicit_model:
                why = "rlcli computes efforts before each physics step; PhysX integrates the drive implicitly"
                item.note("approximated", "class_type", why)
            config = {"joints": order_joints(patterns, item), "kind": "pd"}
            models[group] = to_plain(config | {key: value for key, value in gains.items() if value is not None})
            settings = {**passive, "velocity_limit": item.get("velocity_limit")}
        elif kind in _NETWORKS and group not in replaced:
            what = f"the actuator network of '{kind}' is a TorchScript file, which rlcli does not load"
            gains_key = f"{group}: {{stiffness: S, damping: D}}"
            hint = (
                f"give gains: --model models.yaml with the line {entity}: {{model: FILE.xml, gains: {{{gains_key}}}}}"
            )
            item.report.problem(item.key, what, hint)
            continue
        elif kind in _EXPLICIT or kind in _NETWORKS:
            effort_limit = item.get("effort_limit")
            if kind in _NETWORKS:
                gains = {key: replaced[group].get(key, 0.0) for key in gains}
                item.note("approximated", "network_file", "replaced by a PD controller with the gains of models.yaml")
                item.mark_mapped("pos_scale", "vel_scale", "torque_scale", "input_order", "input_idx")
                kind = "DCMotor"
            elif kind == "RemotizedPDActuator":
                table = item.get("joint_parameter_lookup")
                effort_limit = max(row[2] for row in table) if table and effort_limit is None else effort_limit
                item.note("approximated", "joint_parameter_lookup", "the effort limit is the largest in the table")
                kind = "DelayedPDActuator"
            models[group] = _read_explicit_actuator(item, kind, order_joints(patterns, item), gains, effort_limit)
            speed = None if kind == "DCMotor" else _speed_limit(item)  # terms read a DC motor's own speed limit
            settings = {**passive, "velocity_limit": speed}
        else:
            item.report.problem(
                item.key,
                f"an actuator of kind '{kind}' has no counterpart in rlcli; use ImplicitActuator or IdealPDActuator",
            )
            continue
        for setting, value in settings.items():
            by_pattern = value if isinstance(value, Mapping) else dict.fromkeys(patterns, value)
            for pattern, number in by_pattern.items():
                if number is not None:
                    matched = item.report.matching([pattern], in_group, (*item.key, setting))
                    joints.append((pattern, {setting: as_float(number)}, matched))
    return joints, models


_NO_SPEED_LIMIT = "only terms read this value; MuJoCo's joints have no speed limit"


def _read_implicit_limits(item: Node) -> dict[str, Any]:
    """Return `effort_limit` and `velocity_limit` of an implicit actuator.

    As in Isaac Lab, only `velocity_limit_sim` sets the velocity limit; `velocity_limit` alone has no effect.
    """
    for key in ("effort_limit", "velocity_limit"):
        old, new = item.get(key), item.get(f"{key}_sim")
        if old is not None and new is not None and old != new:
            message = f"{key} and {key}_sim of an implicit actuator differ: {old} and {new}"
            item.report.problem(item.key, message, f"set {key}_sim only")
    if item.get("velocity_limit_sim") is None:
        item.note("ignored", "velocity_limit", "as in Isaac Lab, an implicit actuator has only velocity_limit_sim")
    item.note("approximated", "velocity_limit_sim", _NO_SPEED_LIMIT)
    effort = item.get("effort_limit_sim")
    return {
        "effort_limit": item.get("effort_limit") if effort is None else effort,
        "velocity_limit": item.get("velocity_limit_sim"),
    }


def _speed_limit(item: Node) -> Any:
    """Return the speed limit of an explicit actuator, a number or a mapping from joint patterns; None: no limit."""
    item.note("approximated", "velocity_limit_sim", _NO_SPEED_LIMIT)
    limit, of_solver = item.get("velocity_limit"), item.get("velocity_limit_sim")
    return of_solver if limit is None else limit


def _read_explicit_actuator(
    item: Node, kind: str, joints: Any, gains: Mapping[str, Any], effort_limit: Any
) -> dict[str, Any]:
    """Return the settings of an actuator model, whose effort rlcli computes before each physics step."""
    config = {"joints": joints, "kind": "dc_motor" if kind == "DCMotor" else "pd"}
    config |= {key: value for key, value in gains.items() if value is not None}
    of_solver = item.get("effort_limit_sim")
    for key, value in {**gains, "effort_limit": effort_limit}.items():
        if value is None:
            value = "no limit" if key == "effort_limit" else "0"
            item.report.entries[(*item.key, key)] = ("approximated", f"{value}: the value in the USD file is not known")
    if effort_limit is not None:
        config["effort_limit"] = effort_limit
    if of_solver is not None and of_solver != effort_limit:
        item.note("ignored", "effort_limit_sim", "rlcli limits an explicit actuator by effort_limit only")
    if kind == "DCMotor":
        config["saturation_effort"] = item.require("saturation_effort")
        config["velocity_limit"] = _speed_limit(item) or item.require("velocity_limit")
    if kind == "DelayedPDActuator":
        config["delay"] = [item.get("min_delay", 0), item.get("max_delay", 0)]
    plain: dict[str, Any] = to_plain(config)
    return plain


def settings_of(joint: str, settings: JointSettings) -> dict[str, Any]:
    """Return the settings of one joint; later entries override earlier ones."""
    found: dict[str, Any] = {}
    for _, values, joints in settings:
        if joint in joints:
            found |= values
    return found


def add_joint_settings(
    entity: dict[str, Any],
    settings: JointSettings,
    model: Mapping[str, Any],
    driven: Mapping[str, str],
    name: str,
    report: Report,
) -> None:
    """Add the keys `joints` and `actuators` of one entity in rlcli's scene; see `_merge` for the arguments."""
    joints = _merge(settings, model, driven, name, report)
    if joints:
        entity["joints"] = joints
    passive = _passive_joints(settings, model, driven)
    if passive:
        no_effort = {"joints": passive, "kind": "pd", "stiffness": 0.0, "damping": 0.0}
        entity.setdefault("actuators", {})["passive_joints"] = no_effort


def _merge(
    settings: JointSettings, model: Mapping[str, Any], driven: Mapping[str, str], name: str, report: Report
) -> dict[str, Any]:
    """Return the key `joints` of an entity in rlcli's scene, without values that its MJCF already has.

    Args:
        settings: settings of the joints, from `read_actuators`.
        model: names and values of the entity's MJCF, from `SceneReader`.
        driven: joint -> the quantity that an action sets: effort, motor, velocity or position.
        name: name of the entity.
        report: receives what is approximated.
    """
    by_joint: dict[str, dict[str, Any]] = {}
    kept: dict[str, float] = {}
    for joint in model["joint"]:
        values = settings_of(joint, settings)
        has_actuator = joint in driven or joint in model["driven"]
        key = ("scene", name, "actuators", joint)
        values = _joint_config(values, driven.get(joint, ""), has_actuator, key, report)
        if joint in driven and "damping" not in values:
            kept |= {joint: model["damping"][joint]} if model["damping"][joint] else {}
        for item in ("damping", "armature", "friction_loss"):
            if item in values and model[item][joint] == values[item]:
                del values[item]
        by_joint[joint] = {key: values[key] for key in sorted(values, key=_rank)}
    if kept:
        which = listing(sorted(kept), 6)
        why = f"the damping of the MJCF's joints, at most {max(kept.values()):g}, acts in addition: {which}"
        report.entries["scene", name, "actuators", f"damping of {which}"] = ("approximated", why)
    joints: dict[str, Any] = {}
    for pattern in dict.fromkeys([*(pattern for pattern, _, _ in settings), *map(re.escape, by_joint)]):
        matched = report.matching([pattern], model["joint"], ("scene", name, "actuators"))
        if matched and all(j in by_joint and by_joint[j] == by_joint[matched[0]] for j in matched):
            if by_joint[matched[0]]:
                joints[matched[0] if len(matched) == 1 else pattern] = by_joint[matched[0]]
            for joint in matched:
                del by_joint[joint]
    return joints


def _passive_joints(settings: JointSettings, model: Mapping[str, Any], driven: Mapping[str, str]) -> list[str]:
    """Return the joints whose position action has no effect, because their drive has no stiffness.

    If no joint has a drive, the list is empty: then the actions are a mistake, which the environment reports.
    """
    commanded = [joint for joint, command in driven.items() if command == "position"]
    values = {joint: settings_of(joint, settings) for joint in commanded if joint not in model["driven"]}
    passive = [n for n, v in values.items() if 0.0 in (v.get("stiffness"), v.get("effort_limit"))]
    return passive if len(passive) < len(commanded) else []


def _joint_config(
    values: dict[str, Any], command: str, has_actuator: bool, key: tuple[str, ...], report: Report
) -> dict[str, Any]:
    """Return rlcli's settings of a joint.

    Args:
        values: settings of the joint's implicit actuator; for an explicit actuator only armature and friction.
        command: kind of an action's commands: effort, motor (efforts from the task's own code), velocity or position;
            empty: no action drives the joint.
        has_actuator: whether an action or an actuator of the MJCF drives the joint.
        key: key of the joint in the report.
        report: receives what is approximated.
    """
    if values.get("effort_limit") == 0.0:  # the drive of a passive joint has no effort
        values = {name: value for name, value in values.items() if name not in ("effort_limit", "stiffness", "damping")}
    stiffness, viscous = values.pop("stiffness", 0.0), values.pop("viscous_friction", 0.0)
    if stiffness and command in ("effort", "motor"):
        values = {"stiffness": stiffness, **values}
        why = "a spring around the MJCF's rest position, in addition to the effort"
        report.entries[(*key, "stiffness")] = ("approximated", why)
    elif stiffness:
        values = {"actuator": "position", "kp": stiffness, "kv": values.pop("damping", 0.0), **values}
    elif command == "velocity" and values.get("damping"):
        values = {"actuator": "velocity", "kv": values.pop("damping"), **values}
    if command == "motor":
        values["actuator"] = "motor"
    if viscous:
        values["damping"] = values.get("damping", 0.0) + viscous
    if not stiffness and not has_actuator:
        values.pop("effort_limit", None)
    return values


_LAST_KEYS = ("damping", "armature", "friction_loss", "effort_limit", "velocity_limit")
"""Keys that are written after the other keys of a joint."""


def _rank(key: str) -> int:
    return _LAST_KEYS.index(key) if key in _LAST_KEYS else -1
