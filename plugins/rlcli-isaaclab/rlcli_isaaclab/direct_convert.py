"""Conversion of a direct task to a task of rlcli, whose terms call the task's hooks such as `_get_rewards`."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.config.python_task import PythonTask
from rlcli.errors import ConfigError, Problem
from rlcli_isaaclab import convert
from rlcli_isaaclab.config_class import is_missing, to_dict
from rlcli_isaaclab.direct_env import DirectRLEnvCfg, record, shape_of
from rlcli_isaaclab.direct_terms import HookTerm
from rlcli_isaaclab.own_classes import warn_of_methods
from rlcli_isaaclab.reset_state import note_episode_lengths
from rlcli_isaaclab.scene_facade import Asset
from rlcli_isaaclab.scene_reader import SceneReader
from rlcli_isaaclab.sensor_facade import TerrainImporter
from rlcli_isaaclab.settings import Node, Report
from rlcli_isaaclab.task_fields import own_fields
from rlcli_isaaclab.term_reader import TermReader
from rlcli_isaaclab.user_actuators import actuator_events
from rlcli_isaaclab.user_files import reads_body_forces

_READ = (
    *("decimation", "episode_length_s", "observation_noise_model", "action_noise_model"),
    *("action_space", "observation_space", "state_space", "num_actions", "num_observations", "num_states"),
)
"""Settings that this module and the direct environment read."""
_KINDS = {"set_joint_effort_target": "motor", "set_joint_velocity_target": "velocity"}


def direct_task(cfg: Any, env_class: type, root: Path, models: Mapping[str, Any]) -> PythonTask:
    """Return a task of rlcli for a direct task of Isaac Lab.

    Args:
        cfg: configuration of the task.
        env_class: environment class of the task.
        root: folder of the task.
        models: values of the option `--model`, NAME -> FILE.

    Raises:
        ConfigError: if the task cannot be expressed in rlcli.
    """
    report = Report()
    original = cfg
    _rename_spaces(original)
    _require_values(original, "decimation", "episode_length_s", "scene")
    cfg = copy.deepcopy(original)
    setup, env = record(env_class, cfg)
    _require_values(cfg, "action_space", "observation_space")
    actions = shape_of(cfg.action_space, "action_space")
    observations = shape_of(cfg.observation_space, "observation_space")
    names = _names(setup, env)
    original.rlcli_names = names
    scene_data: dict[str, Any] = {"num_envs": cfg.scene.num_envs, "env_spacing": cfg.scene.env_spacing}
    for name, (_, settings) in zip(names, setup.created, strict=True):
        scene_data[name] = to_dict(settings)
    for index, (path, settings, pose) in enumerate(setup.spawned):
        scene_data[f"spawned_{index}"] = {"prim_path": path, "spawn": to_dict(settings), "init_state": pose}
    declared = to_dict(cfg.scene)
    scene_data |= {key: value for key, value in declared.items() if key not in scene_data}
    scene = SceneReader(Node(scene_data, ("scene",), report), root, models)
    data = to_dict(cfg)
    top = Node(data, (), report)
    config: dict[str, Any] = {
        "decimation": cfg.decimation,
        "episode_length_s": float(cfg.episode_length_s),
        "reward_dt_scaling": False,
        "keep_state_at_reset": True,
        "sim": convert.read_sim(top.node("sim")),
        "viewer": convert.read_viewer(top.node("viewer")),
        "scene": scene.read(),
    }
    source = _source_of(env_class)
    kind = next((kind for method, kind in _KINDS.items() if method in source), "position")
    assets = [name for name, (made, _) in zip(names, setup.created, strict=True) if isinstance(made, Asset)]
    driven = {name: dict.fromkeys(scene.names(name, "joint") or [], kind) for name in assets}
    scene.add_joint_settings(driven)
    config["sim"] |= scene.integrator()
    terms = TermReader(scene, report, cfg)
    events = {name: term for member in top.node("events").nodes() for name, term in terms.read_terms("events", *member)}
    events |= actuator_events(scene.user_actuators)
    hook = _Hooks(env_class, original, reads_body_forces(source))
    config |= {
        "actions": {"action": {"func": hook("action", actions)}},
        "observations": {"policy": {"observation": {"func": hook("policy", observations)}}},
        "rewards": {"reward": {"func": hook("reward"), "weight": 1.0}},
        "terminations": {
            "terminated": {"func": hook("terminated")},
            "time_out": {"func": hook("time_out"), "time_out": True},
        },
        "events": {
            **events,
            **actuator_events(scene.user_actuators),
            "reset": {"func": hook("reset"), "mode": "reset"},
        },
    }
    if cfg.state_space:
        states = hook("critic", shape_of(cfg.state_space, "state_space"))
        config["observations"]["critic"] = {"state": {"func": states}}
    convert.note_general_settings(top)
    note_episode_lengths(env_class, report)
    methods = warn_of_methods("the environment", env_class, ("step", "reset", "seed"))
    if methods:
        report.entries[("env_class",)] = ("ignored", methods)
    top.mark_mapped(*_READ)
    known = {field.name: data[field.name] for field in dataclasses.fields(DirectRLEnvCfg)}
    report.finish(known | {"scene": scene_data}, to_dict(DirectRLEnvCfg()))
    config["params"], params = own_fields(original, DirectRLEnvCfg)
    return PythonTask({key: v for key, v in config.items() if v is not None}, notes=report.user_notes(), params=params)


class _Hooks:
    """Factory of the terms of one direct task: calling it with a hook's name returns a term that calls the hook."""

    def __init__(self, env_class: type, cfg: Any, reads_body_forces: bool) -> None:
        self._env_class, self._cfg, self._forces = env_class, cfg, reads_body_forces

    def __call__(self, hook: str, shape: tuple[int, ...] = ()) -> HookTerm:
        return HookTerm(hook, self._env_class, self._cfg, shape, self._forces)


def _rename_spaces(cfg: Any) -> None:
    """Set `action_space` and so on from the names of older versions of Isaac Lab, such as `num_actions`."""
    for space, number in (
        ("action_space", "num_actions"),
        ("observation_space", "num_observations"),
        ("state_space", "num_states"),
    ):
        if getattr(cfg, number, None) and (is_missing(getattr(cfg, space)) or getattr(cfg, space) is None):
            setattr(cfg, space, getattr(cfg, number))


def _require_values(cfg: Any, *names: str) -> None:
    """Raise ConfigError if one of the settings `names`, which have no default, is not set."""
    missing = [name for name in names if is_missing(getattr(cfg, name))]
    if missing:
        raise ConfigError([Problem("configuration", name, "missing; give it a value") for name in missing])


def _names(setup: Any, env: Any) -> list[str]:
    """Return a name for each object of `_setup_scene`: its key in the scene, or the last part of its prim path."""
    keys = {
        id(made): key
        for table in (env.scene.articulations, env.scene.rigid_objects, env.scene.sensors, env.scene.extras)
        for key, made in table.items()
    }
    names: list[str] = []
    for made, settings in setup.created:
        name = keys.get(id(made)) or str(settings.prim_path).rstrip("/").rsplit("/", 1)[-1].lower()
        if isinstance(made, TerrainImporter):
            name = "terrain"
        names.append(name if name not in names else f"{name}_{len(names)}")
    return names


def _source_of(env_class: type) -> str:
    """Return the source code of a class and of its bases that belong to the task.

    Bases of the standard library are left out: some are written in C (`typing.Generic` from Python 3.12 on) and have
    no source.
    """
    foreign = {"rlcli_isaaclab", "gymnasium", *sys.stdlib_module_names}
    bases = [base for base in env_class.__mro__ if base.__module__.partition(".")[0] not in foreign]
    return "\n".join(inspect.getsource(base) for base in bases)
