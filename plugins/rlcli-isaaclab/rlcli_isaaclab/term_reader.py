"""Isaac Lab's term settings as a task's terms, section by section."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from rlcli.config.term_signatures import Signature, SignatureError, builtin_terms, snake_case
from rlcli.errors import ConfigError, Problem, did_you_mean, listing
from rlcli_isaaclab.config_class import is_missing
from rlcli_isaaclab.managers import CommandTerm, SceneEntityCfg
from rlcli_isaaclab.mdp import MdpFunction
from rlcli_isaaclab.randomization import EVENTS, translated
from rlcli_isaaclab.scene_reader import SceneReader
from rlcli_isaaclab.settings import Key, Node, Report, alike, as_float, kind_of, numbers
from rlcli_isaaclab.table import ACTIONS, COMMANDS, TERMS, Entry, seconds

_THEIRS = ("isaaclab", "omni.isaac.lab", "mdp.")
"""How the modules begin whose functions the table knows."""


class Terms:
    """Terms of all sections."""

    def __init__(self, scene: SceneReader, report: Report) -> None:
        self.scene, self.report = scene, report
        self.joints_driven: dict[str, dict[str, str]] = {}
        """Entity -> joint -> effort, velocity or position."""
        self.stubs: dict[str, tuple[str, dict[str, Any]]] = {}
        """Functions that are known by name alone: name -> section and parameters."""

    def driven(self, actions: Node) -> None:
        """Note which joints the actions drive."""
        for _, item in actions.nodes():
            wanted = item.data.get("joint_names")
            entity = str(item.data.get("asset_name"))
            kind = kind_of(item.data.get("class_type"))
            what = next((word for word in ("effort", "velocity") if word in kind.lower()), "position")
            patterns = [wanted] if isinstance(wanted, str) else wanted
            for pattern in patterns if isinstance(patterns, list | tuple) else ():
                for joint in self.scene.names(entity, "joint") or []:
                    if re.fullmatch(pattern, joint):
                        self.joints_driven.setdefault(entity, {})[joint] = what

    def action(self, node: Node) -> dict[str, Any]:
        """An action term."""
        kind = kind_of(node.get("class_type"))
        name = ACTIONS.get(kind)
        signature = builtin_terms("actions").get(name or "")
        if name is None or signature is None:
            near = did_you_mean(kind, ACTIONS) or f"there are {listing(ACTIONS)}"
            self.report.problem(node.key, f"no action is known for '{kind}'", near)
            return {"func": "joint_effort"}
        node.skip("debug_vis")
        entity = node.get("asset_name", "robot")
        made: dict[str, Any] = {"func": name, "entity": entity}
        preserve = bool(node.get("preserve_order", False))
        known = {p.name: p for p in signature.parameters}
        for key in node.data:
            if key in ("class_type", "debug_vis", "asset_name", "preserve_order"):
                continue
            value = node.get(key)
            if key == "joint_names":
                made["joints"] = self.scene.ordered(entity, "joint", value, preserve, (*node.key, key))
            elif key == "body_name":
                made["bodies"] = value
            elif key in ("open_command_expr", "close_command_expr"):
                made[key.removesuffix("_expr")] = {str(k): as_float(v) for k, v in dict(value).items()}
            elif key == "controller" and isinstance(value, Mapping):
                made |= self._controller(node.node(key))
            elif key == "body_offset":
                offset = node.node(key)
                made["offset_pos"] = [as_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
                made["offset_quat"] = [as_float(v) for v in offset.get("rot", (1.0, 0.0, 0.0, 0.0))]
            elif value is None or (key in known and not known[key].required and alike(value, known[key].default)):
                continue  # as it is without it
            elif key in known:
                made[key] = self._affine(key, value, made.get("joints"))
            elif _neutral(key, value):
                continue
            else:
                node.say("ignored", key, f"'{name}' has no such setting")
        return made

    def _controller(self, node: Node) -> dict[str, Any]:
        """The settings of differential inverse kinematics."""
        node.skip("class_type")
        made = {"mode": node.get("command_type", "pose"), "relative": bool(node.get("use_relative_mode", False))}
        if node.get("ik_method", "dls") != "dls":
            node.say("approximated", "ik_method", "damped least squares")
        given = node.get("ik_params") or {}
        return made | ({"damping": as_float(given["lambda_val"])} if "lambda_val" in given else {})

    def _affine(self, key: str, value: Any, joints: Any) -> Any:
        if key == "clip" and isinstance(value, Mapping) and len(value) == 1:
            (pattern, bounds), *_ = value.items()
            if pattern == ".*" or [pattern] == joints:
                return [as_float(v) for v in bounds]
        return numbers(value)

    def command(self, node: Node) -> dict[str, Any]:
        """A command term."""
        kind = kind_of(node.get("class_type"))
        entry = COMMANDS.get(kind)
        if entry is None or entry.name is None:
            return self._own_command(kind, node)
        made: dict[str, Any] = {"func": entry.name, "resampling_time_s": seconds(node.need("resampling_time_range"))}
        signature = _required(builtin_terms("commands"), entry.name)
        known = {p.name: p for p in signature.parameters}
        ranges = node.node("ranges")
        for source in (node, ranges):
            for key, value in source.data.items():
                ours = str(entry.params.get(key, key))
                if key == "asset_name":
                    made["entity"] = source.get(key)
                elif ours in known and value is not None and not is_missing(value):
                    given = source.get(key)
                    if known[ours].required or not alike(given, known[ours].default):
                        made[ours] = numbers(given)
        node.skip("debug_vis", "heading_command", "goal_pose_visualizer_cfg", "current_pose_visualizer_cfg")
        node.skip("goal_vel_visualizer_cfg", "current_vel_visualizer_cfg", "ranges")
        if node.data.get("heading_command") is False:
            for key in ("heading", "heading_stiffness", "rel_heading"):
                made.pop(key, None)
        if kind == "NormalVelocityCommand":
            made |= {"mean": _triple(ranges, "mean_vel"), "std": _triple(ranges, "std_vel")}
            made["zero_prob"] = _triple(ranges, "zero_prob")
        return made

    def _own_command(self, kind: str, node: Node) -> dict[str, Any]:
        """A command of the user's own: its class, or in a file of settings its name."""
        from rlcli_isaaclab.terms import OwnCommand, key_of

        made: dict[str, Any] = {"resampling_time_s": seconds(node.need("resampling_time_range"))}
        given = node.data.get("class_type")
        settings = {key: node.get(key) for key in node.data if key not in _COMMAND_KEYS}
        node.skip("debug_vis")
        if isinstance(given, str) and not given.startswith(_THEIRS) and ":" in given:
            named = {("entity" if key == "asset_name" else key): value for key, value in settings.items()}
            params = {key: numbers(value) for key, value in named.items() if _is_plain(value)}
            self.stubs[kind] = ("commands", params)
            self.report.entries[(*node.key, "class_type")] = ("to do", f"write '{kind}' in terms.py")
            return {"func": snake_case(kind), **made, **params}
        if not (isinstance(given, type) and issubclass(given, CommandTerm)):
            near = did_you_mean(kind, COMMANDS) or f"there are {listing(COMMANDS)}, or a CommandTerm of your own"
            self.report.problem(node.key, f"no command is known for '{kind}'", near)
            return {"func": "null_command"}
        self._need_all(node.data, node.key)
        plain = {key: value for key, value in settings.items() if _is_plain(value)}
        for key in settings.keys() - plain.keys():
            node.say("ignored", key, "only numbers, text, lists and mappings can be written to a file")
        own = OwnCommand(given, node.key[-1], tuple(plain))
        return {"func": own, **made, **{key_of(key): numbers(value) for key, value in plain.items()}}

    def _need_all(self, value: Mapping[str, Any], key: Key) -> None:
        for name, item in value.items():
            if is_missing(item):
                self.report.problem(key, f"missing '{name}'")
            elif isinstance(item, Mapping):
                self._need_all(item, (*key, str(name)))

    def group(self, node: Node) -> dict[str, Any]:
        """A group of observations."""
        made: dict[str, Any] = {}
        noisy = any("noise" in item for _, item in node.nodes())
        corrupt = node.get("enable_corruption", False)
        for name, item in node.nodes():
            made[name] = self.term("observations", item)
        if noisy and not corrupt:
            made["enable_corruption"] = False
        history = node.get("history_length")
        if history:
            made["history"] = history
        if not node.get("concatenate_terms", True):
            node.say("approximated", "concatenate_terms", "a group is one vector")
        node.skip("concatenate_dim", "flatten_history_dim")
        return made

    def terms(self, section: str, name: str, node: Node) -> Iterator[tuple[str, dict[str, Any]]]:
        """The terms that one becomes, mostly one; several get an addition to its name."""
        theirs = _builtin_name(node.data.get("func"))
        if section == "events" and theirs in EVENTS:
            node.get("func")
            parts = translated(theirs, node.node("params"), self.scene)
            common = self._common(section, node)
        else:
            parts, common = {"": self.term(section, node)}, {}
        for addition, made in parts.items():
            yield name if len(parts) == 1 else f"{name}_{addition}", {"func": made["func"], **common, **made}

    def term(self, section: str, node: Node) -> dict[str, Any]:
        """A term with a function and parameters."""
        function, params = node.need("func"), node.node("params")
        if not callable(function) and not isinstance(function, str):
            if function is not None:
                hint = "a member of the same name hides the function"
                self.report.problem((*node.key, "func"), f"a {type(function).__name__} is no function", hint)
            return {"func": "missing"}
        name = _builtin_name(function)
        if name == "modify_reward_weight":
            return self._reward_stage(params)
        if name in ("modify_env_param", "modify_term_cfg", "initial_final_interpolate_fn"):
            hint = "the terms 'stages' and 'interpolate' change a value by its address, on the device"
            self.report.problem(node.key, f"'{name}' calls a function of its own on the configuration", hint)
            return {"func": "stages", "address": "", "steps": [], "values": []}
        ours, entry = self._find(section, name)
        made: dict[str, Any]
        if ours is not None and name is not None:
            if isinstance(function, str) and not function.startswith(_THEIRS):
                self.report.entries[(*node.key, "func")] = ("approximated", f"taken for the built-in '{ours}'")
            signature = builtin_terms(section)[ours]
            made = {"func": ours} | self._common(section, node)
            made |= self._params(signature, entry, params)
            if entry.note:
                self.report.entries[(*node.key, "func")] = ("approximated", entry.note)
        else:
            made = self._own(section, function, name, node, params)
        return made

    def _find(self, section: str, name: str | None) -> tuple[str | None, Entry]:
        if name is None:
            return None, Entry()
        entry = TERMS.get(section, {}).get(name, Entry())
        ours = entry.name or name
        return (ours if ours in builtin_terms(section) else None), entry

    def _reward_stage(self, params: Node) -> dict[str, Any]:
        reward = params.need("term_name")
        weight, steps = params.need("weight"), params.need("num_steps")
        return {"func": "stages", "address": f"rewards.{reward}.weight", "steps": [steps], "values": [as_float(weight)]}

    def _common(self, section: str, node: Node) -> dict[str, Any]:
        """What all terms of a section have."""
        made: dict[str, Any] = {}
        if section == "rewards":
            made["weight"] = as_float(node.need("weight"))
        elif section == "terminations":
            if node.get("time_out", False):
                made["time_out"] = True
        elif section == "events":
            made["mode"] = node.need("mode")
            if made["mode"] == "prestartup":
                made["mode"] = "startup"
                node.say("approximated", "mode", "startup")
            if "interval_range_s" in node and made["mode"] == "interval":
                made["interval_range_s"] = [as_float(v) for v in node.get("interval_range_s")]
            if node.get("is_global_time", False):
                made["global_time"] = True
            throttle = node.get("min_step_count_between_reset", 0)
            if throttle:
                made["min_steps_between"] = throttle
            node.skip("interval_range_s")
        elif section == "observations":
            made |= self._pipeline(node)
        return made

    def _pipeline(self, node: Node) -> dict[str, Any]:
        made: dict[str, Any] = {}
        modifiers = node.get("modifiers")
        if modifiers:
            made["modifiers"] = [_modifier(Node(m, (*node.key, "modifiers"), self.report)) for m in modifiers]
        if "noise" in node:
            noise = node.node("noise")
            kind = kind_of(noise.get("class_type"))
            if kind:
                noise.skip("sample_bias_per_component", "func")
                made["noise"] = _noise(noise.node("noise_cfg"))
                if "bias_noise_cfg" in noise:
                    made["bias"] = _noise(noise.node("bias_noise_cfg"))
            else:
                made["noise"] = _noise(noise)
        node.skip("noise") if "noise" not in node else None
        clip, scale = node.get("clip"), node.get("scale")
        if clip is not None:
            made["clip"] = [as_float(v) for v in clip]
        if scale is not None:
            made["scale"] = numbers(scale)
        history = node.get("history_length", 0)
        if history:
            made["history"] = history
        node.skip("flatten_history_dim")
        return made

    def _params(self, signature: Signature, entry: Entry, params: Node) -> dict[str, Any]:
        made: dict[str, Any] = dict(entry.fixed)
        by_alias: dict[str, Any] = {}
        for parameter in signature.parameters:
            by_alias.setdefault(parameter.alias or "", parameter)
        known = {p.name: p for p in signature.parameters}
        command = by_alias.get("Command")
        for key in params.data:
            value = params.get(key)
            target = entry.params.get(key, key)
            if key == "command_name" and command is not None:
                target = command.name
            if is_entity(value):
                made |= self._selected(key, value, by_alias, known, (*params.key, key))
            elif key == "gear_ratio" and isinstance(value, Mapping):
                made["gear_ratio"] = self._ratios(params, value)
            elif callable(target):
                made |= numbers(target(value))
            elif value is not None or (target in known and known[target].required):
                made[target] = numbers(value)
        if command is not None and command.required and command.name not in made:
            made[command.name] = "base_velocity"  # some of Isaac Lab's terms know it by that name alone
        return made

    def _ratios(self, params: Node, ratios: Mapping[str, float]) -> Any:
        """Gear ratios as shares of the largest one, a joint each; 1 for a joint that is not named."""
        from rlcli.scene.names import NameProblem, match_values

        names = self.scene.names("robot", "joint")
        largest = max([*ratios.values(), 1.0 if ".*" not in ratios else 0.0])
        if names is None or set(ratios) == {".*"}:
            return 1.0
        try:
            found = match_values(ratios, names, "joint")
        except NameProblem as problem:
            self.report.problem((*params.key, "gear_ratio"), str(problem), problem.hint)
            return 1.0
        return [as_float((1.0 if ratio is None else ratio) / largest) for ratio in found]

    def _selected(
        self, key: str, value: Any, by_alias: Mapping[str, Any], known: Mapping[str, Any], at: Key
    ) -> dict[str, Any]:
        """A `SceneEntityCfg` as the parameters that pick elements."""
        given = value if isinstance(value, Mapping) else vars(value)
        stem = key.removesuffix("_cfg")
        made: dict[str, Any] = {}
        name = given["name"]
        sensor = next((by_alias[a] for a in ("ContactSensor", "RaySensor") if a in by_alias), None)
        preserve = bool(given.get("preserve_order"))
        if sensor is not None and (name in self.scene.sensors or key == "sensor_cfg"):
            made[sensor.name] = self.scene.sensor_part(name, given.get("body_names"), preserve, at)
            return made
        entity = known[stem] if stem in known and known[stem].alias == "Entity" else by_alias.get("Entity")
        if entity is not None and (entity.required or entity.default != name):
            made[entity.name] = name
        elif entity is None:
            self.report.entries[at] = ("ignored", "the term has no entity")
        for kind, alias in (("joint", "Joints"), ("body", "Bodies")):
            names = given.get(f"{kind}_names")
            if names is not None and alias in by_alias:
                made[by_alias[alias].name] = self.scene.ordered(name, kind, names, preserve, at)
            elif names is not None:
                self.report.entries[(*at, f"{kind}_names")] = ("ignored", f"the term selects no {alias.lower()}")
        for kind, alias in (("site", "Sites"), ("sensor", "Sensors")):
            if given.get(f"{kind}_names") is not None and alias in by_alias:
                made[by_alias[alias].name] = given[f"{kind}_names"]
        return made

    def _own(self, section: str, function: Any, name: str | None, node: Node, params: Node) -> dict[str, Any]:
        """A term of the user's own."""
        from rlcli_isaaclab.terms import entity_data, key_of, own_term

        common = self._common(section, node)
        if isinstance(function, MdpFunction) or (name is not None and name.split(".")[0] == "isaaclab"):
            near = did_you_mean(str(name), builtin_terms(section))
            self.report.problem((*node.key, "func"), f"no {section.rstrip('s')} term '{name}'", near)
            return {"func": str(name), **common}
        values = {key: params.get(key) for key in params.data}
        if isinstance(function, str):
            return {"func": self._stub(section, function, values, node)} | common | self.stubs[_short(function)][1]
        entities = frozenset(key for key, value in values.items() if is_entity(value))
        try:
            own = own_term(function, section, entities, tuple(values))
        except SignatureError as error:
            self.report.problem((*node.key, "func"), f"'{function.__name__}': {error}")
            return {"func": "missing", **common}
        known = [own.original[parameter.name] for parameter in own.parameters]
        for key in [key for key in values if key not in known]:
            takes = did_you_mean(key, known) or f"'{own.__name__}' takes {listing(known)}"
            self.report.problem((*params.key, key), f"unknown key '{key}'", takes)
            del values[key]
        made: dict[str, Any] = {}
        for key, value in values.items():
            if key in entities:
                try:
                    made[key_of(key)] = entity_data(value if isinstance(value, Mapping) else vars(value))
                except ValueError as error:
                    self.report.problem((*params.key, key), str(error))
            else:
                made[key_of(key)] = numbers(value)
        return {"func": own, **common, **made}

    def _stub(self, section: str, function: str, values: Mapping[str, Any], node: Node) -> str:
        """Note a function whose code is not here, with parameters in rlcli's form."""
        made: dict[str, Any] = {}
        for key, value in values.items():
            if not is_entity(value):
                made[key] = numbers(value)
            elif "entity" in made:
                made[key.removesuffix("_cfg")] = value["name"]
            else:
                made["entity"] = value["name"]
                for kind, name in (("joint", "joints"), ("body", "bodies")):
                    names = value.get(f"{kind}_names")
                    if names is not None:
                        preserve = bool(value.get("preserve_order"))
                        made[name] = self.scene.ordered(value["name"], kind, names, preserve, node.key)
        short = _short(function)
        self.stubs[short] = (section, made)
        self.report.entries[(*node.key, "func")] = ("to do", f"write '{short}' in terms.py")
        return short


_COMMAND_KEYS = ("class_type", "resampling_time_range", "debug_vis")


def _is_plain(value: Any) -> bool:
    """Whether a setting can be written to a file."""
    if isinstance(value, Mapping):
        return all(map(_is_plain, value.values()))
    return (
        all(map(_is_plain, value)) if isinstance(value, list | tuple) else isinstance(value, str | float | int | None)
    )


def is_entity(value: Any) -> bool:
    """Whether a parameter is a `SceneEntityCfg`, or one as a dict."""
    if isinstance(value, SceneEntityCfg):
        return True
    return isinstance(value, Mapping) and "name" in value and ("joint_names" in value or "body_names" in value)


def _short(function: str) -> str:
    return function.rpartition(":")[2].rpartition(".")[2] or function.rpartition(":")[2]


def _builtin_name(function: Any) -> str | None:
    """The name of a function of Isaac Lab's; None for one of the user's own."""
    if isinstance(function, MdpFunction):
        return function.__name__
    if isinstance(function, str):
        return function.rpartition(":")[2]
    return None


def _required(terms: Mapping[str, Signature], name: str) -> Signature:
    if name not in terms:
        raise ConfigError([Problem("configuration", "commands", f"no term '{name}'", f"there are {listing(terms)}")])
    return terms[name]


def _noise(node: Node) -> dict[str, Any]:
    operation = node.get("operation", "add")
    made: dict[str, Any] = {} if operation == "add" else {"operation": "set" if operation == "abs" else operation}
    node.skip("func")
    if "n_min" in node.data:
        return {"kind": "uniform", "low": numbers(node.get("n_min")), "high": numbers(node.get("n_max")), **made}
    if "std" in node.data:
        return {"kind": "gaussian", "mean": numbers(node.get("mean", 0.0)), "std": numbers(node.get("std")), **made}
    return {"kind": "constant", "value": numbers(node.get("bias", node.get("value", 0.0))), **made}


def _modifier(node: Node) -> dict[str, Any]:
    kind, params = kind_of(node.get("func")), node.node("params")
    if kind == "scale":
        return {"kind": "scale", "factor": numbers(params.get("multiplier"))}
    if kind == "bias":
        return {"kind": "bias", "offset": numbers(params.get("value"))}
    if kind == "clip":
        return {"kind": "clip", "bounds": numbers(params.get("bounds"))}
    if kind == "DigitalFilter":
        return {"kind": "digital_filter", "a": numbers(node.get("A")), "b": numbers(node.get("B"))}
    if kind == "Integrator":
        return {"kind": "integrator"}
    node.report.problem(node.key, f"no modifier is known for '{kind}'")
    return {"kind": "integrator"}


def _triple(ranges: Node, name: str) -> list[float]:
    return [as_float(v) for v in ranges.get(name, (0.0, 0.0, 0.0))]


def _neutral(key: str, value: Any) -> bool:
    """Whether a setting that has no counterpart changes nothing."""
    return {"scale": 1.0, "offset": 0.0}.get(key) == value or value is False or value == "" or key == "use_zero_offset"
