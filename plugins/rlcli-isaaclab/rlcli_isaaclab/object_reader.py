"""Reader of Isaac Lab's actions, and of the user's own actions and commands, which are classes `Name(cfg, env)`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlcli.config.term_signatures import builtin_terms
from rlcli_isaaclab.action_terms import driven_by, find_action
from rlcli_isaaclab.config_class import is_missing
from rlcli_isaaclab.missing_names import reason_of
from rlcli_isaaclab.scene_reader import SceneReader
from rlcli_isaaclab.settings import Key, Node, Report, as_float, equals_default, kind_of, to_plain
from rlcli_isaaclab.term_counterparts import ACTIONS, ONCE_PER_STEP
from rlcli_isaaclab.term_values import has_no_effect, is_plain

OBJECT_KEYS = ("class_type", "resampling_time_range", "debug_vis")
"""Settings that Isaac Lab's base classes of action and command configurations have; the user's class does not get
them."""


class ObjectReader:
    """Reader of actions, and of terms that are objects of the user's classes."""

    def __init__(self, scene: SceneReader, report: Report, context: Any) -> None:
        self.scene, self.report, self.context = scene, report, context
        self.driven_joints = scene.driven_joints

    def record_driven_joints(self, actions: Node) -> None:
        """Record, for each joint, the kind of command that an action sends to it.

        The kind is position, velocity or effort for an action of Isaac Lab, and motor for efforts that the user's own
        action class sets.
        """
        for _, item in actions.nodes():
            wanted = item.data.get("joint_names")
            entity = str(item.data.get("asset_name"))
            kind = kind_of(item.data.get("class_type"))
            action = find_action(item.data.get("class_type"))
            command = driven_by(action) or next((w for w in ("effort", "velocity") if w in kind.lower()), "position")
            patterns = [".*"] if wanted is None and action else [wanted] if isinstance(wanted, str) else wanted
            for pattern in patterns if isinstance(patterns, list | tuple) else ():
                for joint in self.report.matching([pattern], self.scene.names(entity, "joint") or [], item.key):
                    self.driven_joints.setdefault(entity, {})[joint] = command

    def read_action(self, node: Node) -> dict[str, Any]:
        """Return the settings of rlcli's action term for the settings of Isaac Lab's (`node`)."""
        kind = kind_of(node.get("class_type"))
        action = find_action(node.data.get("class_type"))
        name = ACTIONS.get(kind)
        if action is not None and self.context.cfg is None and name is None:
            hint = "run the task's own files: rlcli train FILE.py:CLASS"
            self.report.problem(node.key, f"the action '{kind}' is code, which task.yaml cannot hold", hint)
            return {"func": "joint_effort"}
        if action is not None and self.context.cfg is not None:
            return self._read_user_object(action, node)
        if kind in ONCE_PER_STEP:
            what = "targets are computed once per environment step, not in each physics step"
            node.note("approximated", "class_type", what)
        signature = builtin_terms("actions").get(name or "")
        if name is None or signature is None:
            reason, hint = reason_of(kind)
            self.report.problem(node.key, f"the action '{kind}' cannot be used: {reason}", hint)
            return {"func": "joint_effort"}
        node.mark_mapped("debug_vis")
        entity = node.get("asset_name", "robot")
        config: dict[str, Any] = {"func": name, "entity": entity}
        preserve = bool(node.get("preserve_order", False))
        known = {p.name: p for p in signature.parameters}
        for key in node.data:
            if key in ("class_type", "debug_vis", "asset_name", "preserve_order"):
                continue
            value = node.get(key)
            if key == "joint_names":
                config["joints"] = self.scene.order_names(entity, "joint", value, preserve, (*node.key, key))
            elif key == "body_name":
                config["bodies"] = value
            elif key in ("open_command_expr", "close_command_expr"):
                config[key.removesuffix("_expr")] = {str(k): as_float(v) for k, v in dict(value).items()}
            elif key == "controller" and isinstance(value, Mapping):
                config |= self._read_ik_controller(node.node(key))
            elif key == "body_offset":
                offset = node.node(key)
                config["offset_pos"] = [as_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
                config["offset_quat"] = [as_float(v) for v in offset.get("rot", (1.0, 0.0, 0.0, 0.0))]
            elif value is None:
                continue
            elif key in known and not known[key].required and equals_default(value, known[key].default):
                continue  # rlcli's term has this default
            elif key in known:
                config[key] = self._read_action_value(key, value, config.get("joints"))
            elif has_no_effect(key, value):
                continue
            else:
                node.note("ignored", key, f"rlcli's action '{name}' has no such setting")
        return config

    def _read_ik_controller(self, node: Node) -> dict[str, Any]:
        """Return the settings of differential inverse kinematics."""
        node.mark_mapped("class_type")
        config = {"mode": node.get("command_type", "pose"), "relative": bool(node.get("use_relative_mode", False))}
        if node.get("ik_method", "dls") != "dls":
            node.note("approximated", "ik_method", "replaced by damped least squares")
        params = node.get("ik_params") or {}
        return config | ({"damping": as_float(params["lambda_val"])} if "lambda_val" in params else {})

    def _read_action_value(self, key: str, value: Any, joints: Any) -> Any:
        """Return a value of an action term. A clip for all joints is written as one pair of bounds."""
        if key == "clip" and isinstance(value, Mapping) and len(value) == 1:
            (pattern, bounds), *_ = value.items()
            if pattern == ".*" or [pattern] == joints:
                return [as_float(v) for v in bounds]
        return to_plain(value)

    def _read_user_object(self, class_type: type, node: Node) -> dict[str, Any]:
        """Return the term for a class `Name(cfg, env)`, which is the user's or one of this package."""
        from rlcli_isaaclab.terms import UserObject, key_of

        section, name = node.key
        self._report_missing(node.data, node.key)
        settings = {key: node.get(key) for key in node.data if key not in OBJECT_KEYS}
        plain = {key: value for key, value in settings.items() if is_plain(value)}
        for key in settings.keys() - plain.keys() if self.context.cfg is None else ():
            node.note("ignored", key, "only numbers, strings, lists and mappings can be written to a file")
        term = UserObject(class_type, section, name, tuple(plain), self.context)
        return {"func": term, **{key_of(key): to_plain(value) for key, value in plain.items()}}

    def _report_missing(self, value: Mapping[str, Any], key: Key) -> None:
        for name, item in value.items():
            if is_missing(item):
                self.report.problem(key, f"missing '{name}'; give it a value")
            elif isinstance(item, Mapping):
                self._report_missing(item, (*key, str(name)))
