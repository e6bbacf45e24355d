"""Reader of Isaac Lab's settings of terms. It returns the terms of a task of rlcli, section by section."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping
from typing import Any

from rlcli.config.term_signatures import Signature, SignatureError, builtin_terms, snake_case
from rlcli.errors import ConfigError, Problem, did_you_mean, listing
from rlcli_isaaclab import command_terms
from rlcli_isaaclab.changed_setting_reader import read_changed_setting
from rlcli_isaaclab.config_class import is_missing
from rlcli_isaaclab.curricula import modify_env_param
from rlcli_isaaclab.lab_terms import LAB_TERMS, command_resample
from rlcli_isaaclab.managers import CommandTerm
from rlcli_isaaclab.mdp import MdpFunction
from rlcli_isaaclab.missing_names import AbsentValue, reason_of
from rlcli_isaaclab.object_reader import OBJECT_KEYS, ObjectReader
from rlcli_isaaclab.observation_reader import read_processing
from rlcli_isaaclab.own_processing import ProcessedTerm, take_own_processing
from rlcli_isaaclab.randomization import EVENTS, translate_event
from rlcli_isaaclab.scene_reader import SceneReader
from rlcli_isaaclab.sensor_reader import choose_image
from rlcli_isaaclab.settings import Key, Node, Report, as_float, equals_default, kind_of, to_plain
from rlcli_isaaclab.term_counterparts import (
    COMMANDS,
    EFFORT_TERMS,
    HEIGHT_TERMS,
    TERMS,
    Entry,
    finite_times,
)
from rlcli_isaaclab.term_values import builtin_name, is_entity, is_plain, order_ranges, triple

_READS_COMMAND = "command_manager.get_term("
_ISAAC_LAB_MODULES = ("isaaclab", "omni.isaac.lab", "mdp.")
"""Prefixes of modules of Isaac Lab, whose functions are translated by `term_counterparts.py`, not run."""


def _functions(data: Any) -> Iterator[Any]:
    """Yield all functions and classes in nested dicts of settings."""
    for value in data.values() if isinstance(data, Mapping) else ():
        if inspect.isfunction(value) or inspect.isclass(value):
            yield value
        yield from _functions(value)


class TermReader(ObjectReader):
    """Reader of the terms of all sections: observations, rewards, terminations, events, commands and curriculum."""

    def __init__(self, scene: SceneReader, report: Report, cfg: Any = None, data: Mapping[str, Any] = {}) -> None:
        from rlcli_isaaclab.terms import TermContext
        from rlcli_isaaclab.user_files import file_text

        super().__init__(scene, report, TermContext(cfg, scene.frames))
        self.data = data
        self._user_terms: dict[Any, Any] = {}
        self.reads_commands = any(
            function is command_resample or _READS_COMMAND in file_text(function) for function in _functions(data)
        )
        """Whether the user's code reads or changes a command term, which then needs Isaac Lab's attributes."""
        self.stubs: dict[str, tuple[str, dict[str, Any]]] = {}
        """Functions of which the imported YAML only has the name: name -> (section of the term, its parameters)."""

    def read_command(self, node: Node) -> dict[str, Any]:
        """Return the settings of rlcli's command term for Isaac Lab's settings of a command."""
        class_type = node.get("class_type")
        kind = kind_of(class_type)
        entry = COMMANDS.get(kind)
        own = isinstance(class_type, type) and not class_type.__module__.startswith("rlcli_isaaclab")
        if self.reads_commands and hasattr(command_terms, kind):
            node = Node({**node.data, "class_type": getattr(command_terms, kind)}, node.key, node.report)
            own = True
        if entry is None or entry.name is None or own:
            return self._read_user_command(kind, node)
        times = finite_times(node.require("resampling_time_range"))
        config: dict[str, Any] = {"func": entry.name, "resampling_time_s": times}
        signature = _find_signature(builtin_terms("commands"), entry.name)
        known = {p.name: p for p in signature.parameters}
        ranges = node.node("ranges")
        for source in (node, ranges):
            for key, value in source.data.items():
                ours = str(entry.params.get(key, key))
                if key == "asset_name":
                    config["entity"] = source.get(key)
                elif ours in known and value is not None and not is_missing(value):
                    setting = source.get(key)
                    if known[ours].required or not equals_default(setting, known[ours].default):
                        config[ours] = to_plain(setting)
        node.mark_mapped("debug_vis", "heading_command", "goal_pose_visualizer_cfg", "current_pose_visualizer_cfg")
        node.mark_mapped("goal_vel_visualizer_cfg", "current_vel_visualizer_cfg", "ranges")
        if node.data.get("heading_command") is False:
            for key in ("heading", "heading_stiffness", "rel_heading"):
                config.pop(key, None)
        order_ranges(signature, config)
        if kind == "NormalVelocityCommand":
            config |= {"mean": triple(ranges, "mean_vel"), "std": triple(ranges, "std_vel")}
            config["zero_prob"] = triple(ranges, "zero_prob")
        return config

    def _read_user_command(self, kind: str, node: Node) -> dict[str, Any]:
        """Return the settings of a command term that runs the user's class `kind`.

        If the settings come from a YAML file, the class is only a name: record a stub that the user fills in.
        """
        config: dict[str, Any] = {"resampling_time_s": finite_times(node.require("resampling_time_range"))}
        class_type = node.data.get("class_type")
        node.mark_mapped("debug_vis")
        if isinstance(class_type, str) and not class_type.startswith(_ISAAC_LAB_MODULES) and ":" in class_type:
            settings = {key: node.get(key) for key in node.data if key not in OBJECT_KEYS}
            named = {("entity" if key == "asset_name" else key): value for key, value in settings.items()}
            params = {key: to_plain(value) for key, value in named.items() if is_plain(value)}
            self.stubs[kind] = ("commands", params)
            self.report.entries[(*node.key, "class_type")] = ("to do", f"write '{kind}' in terms.py")
            return {"func": snake_case(kind), **config, **params}
        if not (isinstance(class_type, type) and issubclass(class_type, CommandTerm)):
            near = did_you_mean(kind, COMMANDS) or f"use {listing(COMMANDS)}, or write your own CommandTerm"
            self.report.problem(node.key, f"the command '{kind}' has no counterpart in rlcli", near)
            return {"func": "null_command"}
        return config | self._read_user_object(class_type, node)

    def read_group(self, node: Node) -> dict[str, Any]:
        """Return the settings of an observation group in rlcli: its terms, and settings such as `history`."""
        config: dict[str, Any] = {}
        noisy = any("noise" in item for _, item in node.nodes())
        corrupt = node.get("enable_corruption", False)
        for name, item in node.nodes():
            own = take_own_processing(item)
            config[name] = self.read_term("observations", item)
            if any(own):
                config[name]["func"] = ProcessedTerm(config[name]["func"], item.key, *own, self.context)
        if noisy and not corrupt:
            config["enable_corruption"] = False
        history = node.get("history_length")
        if history:
            config["history"] = history
        if not node.get("concatenate_terms", True):
            node.note("approximated", "concatenate_terms", "the terms of a group are always concatenated")
        node.mark_mapped("concatenate_dim", "flatten_history_dim")
        return config

    def read_terms(self, section: str, name: str, node: Node) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield (name, settings) of the terms of rlcli that replace the term `name` of Isaac Lab.

        Usually this is one term with the same name. The names of several terms get a suffix.
        """
        function = builtin_name(node.data.get("func"))
        if section == "events" and function in _LOOKS:
            self.report.entries[node.key] = ("ignored", "rlcli does not randomise colours and textures")
            return
        if section == "events" and function == "reset_root_state_uniform" and self._moves_nothing(node):
            node.mark_mapped(*node.data)
            return
        if section == "events" and function in EVENTS:
            node.get("func")
            parts = translate_event(function, node.node("params"), self.scene)
            common = self._read_common(section, node)
        else:
            parts, common = {"": self.read_term(section, node)}, {}
        for suffix, config in parts.items():
            yield name if len(parts) == 1 else f"{name}_{suffix}", {"func": config["func"], **common, **config}

    def _moves_nothing(self, node: Node) -> bool:
        """Return whether a `reset_root_state_uniform` event does nothing: a fixed base, and all ranges zero."""
        params = node.data.get("params") or {}
        asset = params.get("asset_cfg") or {"name": "robot"}
        name = asset["name"] if isinstance(asset, Mapping) else asset.name
        ranges = [params.get(key) or {} for key in ("pose_range", "velocity_range")]
        return self.scene.is_fixed(name) and not any(any(pair) for values in ranges for pair in values.values())

    def read_term(self, section: str, node: Node) -> dict[str, Any]:
        """Return the settings of a term of rlcli: `func` and its parameters. Mistakes are added to the report."""
        function, params = node.require("func"), node.node("params")
        if isinstance(function, AbsentValue) or (isinstance(function, type) and hasattr(function, "absent_name")):
            reason, hint = reason_of(function.absent_name)
            self.report.problem((*node.key, "func"), f"{function.absent_name} cannot be used: {reason}", hint)
            return {"func": "missing"}
        if not callable(function) and not isinstance(function, str):
            if function is not None:
                hint = "rename the member of the class that has the same name as the function"
                kind = type(function).__name__
                self.report.problem((*node.key, "func"), f"expected a function, found a {kind}", hint)
            return {"func": "missing"}
        name = builtin_name(function)
        if name == "modify_reward_weight":
            return self._read_reward_stage(params)
        if isinstance(function, type) and issubclass(function, modify_env_param):
            return read_changed_setting(self, function, node, params)
        special = LAB_TERMS.get(name or "")
        if special is not None and not isinstance(function, str) and special.needed(params.data):
            return self._read_user_term(section, special.function, None, node, params)
        ours, entry = self._find_builtin(section, name)
        config: dict[str, Any]
        if ours is not None and name is not None:
            if isinstance(function, str) and not function.startswith(_ISAAC_LAB_MODULES):
                why = f"replaced by the built-in '{ours}', which has the same name"
                self.report.entries[(*node.key, "func")] = ("approximated", why)
            signature = builtin_terms(section)[ours]
            config = {"func": ours} | self._read_common(section, node)
            config |= self._read_params(signature, entry, params)
            order_ranges(signature, config)
            if ours == "image":
                choose_image(params, config, self.scene.sensors)
            if entry.note:
                self.report.entries[(*node.key, "func")] = ("approximated", entry.note)
            if name in HEIGHT_TERMS and self.scene.has_terrain:
                why = "heights are relative to the environment's origin, not to z = 0"
                self.report.entries[(*node.key, "func")] = ("approximated", why)
            entity = config.get("entity", "robot")
            if name in EFFORT_TERMS and self.scene.damped_joints(entity, self.driven_joints.get(entity, {})):
                why = "efforts lack the damping of implicit actuators with zero stiffness, which is joint damping here"
                self.report.entries[(*node.key, "func")] = ("approximated", why)
        else:
            config = self._read_user_term(section, function, name, node, params)
        return config

    def _find_builtin(self, section: str, name: str | None) -> tuple[str | None, Entry]:
        """Return rlcli's name of one of Isaac Lab's terms, and its entry in `term_counterparts.py`.

        The name is None if rlcli has no such term. For a term without an entry, the returned entry is empty.
        """
        if name is None:
            return None, Entry()
        entry = TERMS.get(section, {}).get(name, Entry())
        ours = entry.name or name
        return (ours if ours in builtin_terms(section) else None), entry

    def _read_reward_stage(self, params: Node) -> dict[str, Any]:
        reward = params.require("term_name")
        weight, steps = params.require("weight"), params.require("num_steps")
        return {"func": "stages", "address": f"rewards.{reward}.weight", "steps": [steps], "values": [as_float(weight)]}

    def _read_common(self, section: str, node: Node) -> dict[str, Any]:
        """Return the settings that every term of a section may have, such as `weight` of a reward."""
        config: dict[str, Any] = {}
        if section == "rewards":
            config["weight"] = as_float(node.require("weight"))
        elif section == "terminations":
            if node.get("time_out", False):
                config["time_out"] = True
        elif section == "events":
            config["mode"] = node.require("mode")
            if config["mode"] == "prestartup":
                config["mode"] = "startup"
                node.note("approximated", "mode", "the event runs at startup, after the model is compiled")
            if "interval_range_s" in node and config["mode"] == "interval":
                config["interval_range_s"] = [as_float(v) for v in node.get("interval_range_s")]
            if node.get("is_global_time", False):
                config["global_time"] = True
            min_steps = node.get("min_step_count_between_reset", 0)
            if min_steps:
                config["min_steps_between"] = min_steps
            node.mark_mapped("interval_range_s")
        elif section == "observations":
            config |= read_processing(node)
        return config

    def _read_params(self, signature: Signature, entry: Entry, params: Node) -> dict[str, Any]:
        """Return the parameters of a built-in term of rlcli, translated from Isaac Lab's `params`.

        Args:
            signature: the built-in term.
            entry: names and forms of parameters that differ from Isaac Lab's.
            params: Isaac Lab's parameters.
        """
        config = {key: value for key, value in entry.fixed.items() if key != "entity" or "asset_cfg" not in params}
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
                config |= self._read_selection(key, value, by_alias, known, (*params.key, key))
            elif key == "gear_ratio" and isinstance(value, Mapping):
                config["gear_ratio"] = self._read_gear_ratios(params, value)
            elif callable(target):
                config |= to_plain(target(value))
            elif value is not None or (target in known and known[target].required):
                config[target] = to_plain(value)
        if command is not None and command.required and command.name not in config:
            config[command.name] = "base_velocity"  # Isaac Lab's terms use this command if command_name is not set
        return config

    def _read_gear_ratios(self, params: Node, ratios: Mapping[str, float]) -> Any:
        """Return the gear ratio of each joint of the robot, divided by the largest one.

        `ratios` maps names or regexes of joints to gear ratios; a joint that none matches has the ratio 1.
        """
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

    def _read_selection(
        self, key: str, value: Any, by_alias: Mapping[str, Any], known: Mapping[str, Any], at: Key
    ) -> dict[str, Any]:
        """Return the parameters of a built-in term for the entity, joints and bodies that a `SceneEntityCfg` selects.

        Args:
            key: name of Isaac Lab's parameter, such as `asset_cfg`.
            value: the `SceneEntityCfg`, or a dict of its members.
            by_alias: kind of selection, such as Joints -> the parameter of rlcli's term.
            known: the term's parameters by name.
            at: place of the parameter in the configuration, for the report.
        """
        settings = value if isinstance(value, Mapping) else vars(value)
        stem = key.removesuffix("_cfg")
        config: dict[str, Any] = {}
        name = settings["name"]
        missing = [member for member in ("name", "joint_names", "body_names") if is_missing(settings.get(member))]
        for member in missing:
            self.report.problem((*at, member), f"missing '{member}'; give it a value")
        if missing:
            return config
        sensor = next((by_alias[a] for a in ("ContactSensor", "RaySensor", "CameraSensor") if a in by_alias), None)
        preserve = bool(settings.get("preserve_order"))
        if sensor is not None and (name in self.scene.sensors or key == "sensor_cfg"):
            config[sensor.name] = self.scene.sensor_of_bodies(name, settings.get("body_names"), preserve, at)
            return config
        entity = known[stem] if stem in known and known[stem].alias == "Entity" else by_alias.get("Entity")
        if entity is not None and (entity.required or entity.default != name):
            config[entity.name] = name
        elif entity is None:
            self.report.entries[at] = ("ignored", "the term has no parameter for an entity")
        for kind, alias in (("joint", "Joints"), ("body", "Bodies")):
            names = settings.get(f"{kind}_names")
            if names is not None and alias in by_alias:
                config[by_alias[alias].name] = self.scene.order_names(name, kind, names, preserve, at)
            elif names is not None:
                why = f"the term has no parameter for {alias.lower()}"
                self.report.entries[(*at, f"{kind}_names")] = ("ignored", why)
        for kind, alias in (("site", "Sites"), ("sensor", "Sensors")):
            if settings.get(f"{kind}_names") is not None and alias in by_alias:
                config[by_alias[alias].name] = settings[f"{kind}_names"]
        return config

    def _read_user_term(
        self, section: str, function: Any, name: str | None, node: Node, params: Node
    ) -> dict[str, Any]:
        """Return the settings of a term that runs the user's function.

        If the settings come from a YAML file, the function is only a name: record a stub that the user fills in.
        """
        from rlcli_isaaclab.terms import entity_data, key_of

        common = self._read_common(section, node)
        if isinstance(function, MdpFunction) or (name is not None and name.split(".")[0] == "isaaclab"):
            near = did_you_mean(str(name), builtin_terms(section))
            self.report.problem((*node.key, "func"), f"rlcli has no {section.rstrip('s')} term '{name}'", near)
            return {"func": str(name), **common}
        values = {key: params.get(key) for key in params.data}
        objects = {key: value for key, value in values.items() if not is_entity(value) and not is_plain(value)}
        if isinstance(function, str):
            stub = self._write_stub(section, function, values, node)
            return {"func": stub} | common | self.stubs[stub][1]
        entities = frozenset(key for key, value in values.items() if is_entity(value))
        try:
            values = {key: value for key, value in values.items() if key not in objects}
            term = self._user_term(function, section, entities, tuple(values), objects)
        except SignatureError as error:
            self.report.problem((*node.key, "func"), f"'{function.__name__}': {error}")
            return {"func": "missing", **common}
        known = [term.original[parameter.name] for parameter in term.parameters]
        for key in [key for key in values if key not in known]:
            hint = did_you_mean(key, known) or f"'{term.__name__}' takes {listing(known)}"
            self.report.problem((*params.key, key), f"unknown key '{key}'", hint)
            del values[key]
        config: dict[str, Any] = {}
        for key, value in values.items():
            if key in entities:
                try:
                    config[key_of(key)] = entity_data(value if isinstance(value, Mapping) else vars(value))
                except ValueError as error:
                    self.report.problem((*params.key, key), str(error))
            else:
                config[key_of(key)] = to_plain(value)
        return {"func": term, **common, **config}

    def _user_term(
        self, function: Any, section: str, entities: frozenset[str], names: tuple[str, ...], objects: dict[str, Any]
    ) -> Any:
        """Return the `UserTerm` that runs a function. Without `objects`, equal arguments give the same `UserTerm`.

        `names` is the argument `extra` of `UserTerm`; the others have the same names.
        """
        from rlcli_isaaclab.terms import UserTerm

        key = (function, section, entities, names)
        if objects:
            return UserTerm(function, section, entities, names, objects, self.context)
        if key not in self._user_terms:
            self._user_terms[key] = UserTerm(function, section, entities, names, None, self.context)
        return self._user_terms[key]

    def _write_stub(self, section: str, function: str, values: Mapping[str, Any], node: Node) -> str:
        """Record a stub for a function of which only the name is known. Return the name without its module.

        The stub has the parameters `values` in rlcli's form: `entity`, `joints` and `bodies` for a `SceneEntityCfg`.
        """
        config: dict[str, Any] = {}
        for key, value in values.items():
            if not is_entity(value):
                config[key] = to_plain(value)
            elif "entity" in config:
                config[key.removesuffix("_cfg")] = value["name"]
            else:
                config["entity"] = value["name"]
                for kind, parameter in (("joint", "joints"), ("body", "bodies")):
                    names = value.get(f"{kind}_names")
                    if names is not None:
                        preserve = bool(value.get("preserve_order"))
                        config[parameter] = self.scene.order_names(value["name"], kind, names, preserve, node.key)
        name = kind_of(function)
        self.stubs[name] = (section, config)
        self.report.entries[(*node.key, "func")] = ("to do", f"write '{name}' in terms.py")
        return name


_LOOKS = ("randomize_visual_color", "randomize_visual_texture_material")
"""Isaac Lab's events that only change colours and textures."""


def _find_signature(terms: Mapping[str, Signature], name: str) -> Signature:
    if name not in terms:
        raise ConfigError(
            [Problem("configuration", "commands", f"rlcli has no command term '{name}'", f"terms: {listing(terms)}")]
        )
    return terms[name]
