"""Translation of OmniIsaacGymEnvs' task YAML to a task of rlcli.

The user's file stays unchanged. Settings of the simulation and the environment (time step, number of environments,
ground, ...) become keys of `TaskConfig`. All other settings go to `oige:`, where the task's class reads them. A note
records for every key whether it is mapped, approximated or ignored. One key is added to the format: `mjcf:` names the
model of each robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

from rlcli.config.layers import Origin, read
from rlcli.config.strict_yaml import Document, Path
from rlcli.errors import ConfigError, did_you_mean, listing
from rlcli.formats import Status, Translation
from rlcli_oige import agent_yaml, randomization_yaml
from rlcli_oige.hydra_defaults import compose
from rlcli_oige.hydra_interpolation import evaluate
from rlcli_oige.task_class import class_constant
from rlcli_oige.task_keys import (
    ACTOR_KEYS,
    EPISODE_KEYS,
    MATERIAL_KEYS,
    MOVED_KEYS,
    PHYSX_KEYS,
    ROOT_SETTINGS,
    SIM_KEYS,
    TOP_KEYS,
)
from rlcli_oige.yaml_translator import YamlTranslator


def is_oige(data: Mapping[str, Any]) -> bool:
    """Return whether a YAML document has OmniIsaacGymEnvs' format."""
    if "decimation" in data or "scene" in data:
        return False
    return isinstance(data.get("env"), dict) and ("physics_engine" in data or isinstance(data.get("sim"), dict))


def is_oige_file(file: FilePath) -> bool:
    """Return whether a file can be read and has OmniIsaacGymEnvs' format."""
    try:
        return is_oige(_composed_data(file))
    except ConfigError:
        return False


def task_name(file: FilePath) -> str | None:
    """Return the name of a task from a YAML of OmniIsaacGymEnvs, imported or not; None for another file."""
    try:
        data = _composed_data(file)
    except ConfigError:
        return None
    imported = _mapping(data.get("oige"))
    if not imported and not is_oige(data):
        return None
    return str((imported or data).get("name") or file.stem)


def translate(
    document: Document, label: str, *, class_file: FilePath | None, class_name: str | None, agent_file: FilePath | None
) -> Translation:
    """Translate a task YAML, and the rl_games YAML of its agent if there is one.

    Args:
        document: the task YAML.
        label: name of the file in messages.
        class_file: source file of the task's class; if the YAML has no episode length, the length is read here.
        class_name: name of the task's class.
        agent_file: the rl_games YAML of the agent.

    Raises:
        ConfigError: with every unknown key, and every interpolation that cannot be evaluated.
    """
    return _Translator(document, label, class_file=class_file, class_name=class_name).run(agent_file)


def agent_file(config: FilePath) -> FilePath | None:
    """Return the rl_games YAML that belongs to a task YAML: `AntPPO.yaml` beside `Ant.yaml`, or in `../train`."""
    name = f"{config.stem}PPO.yaml"
    return next((f for f in (config.with_name(name), config.parent.parent / "train" / name) if f.is_file()), None)


@dataclass(slots=True)
class _Translator(YamlTranslator):
    class_file: FilePath | None = None
    class_name: str | None = None

    def run(self, agents: FilePath | None) -> Translation:
        tree = {**ROOT_SETTINGS, "task": self.document.data}
        tree["task_name"] = self.document.data.get("name", "")
        task, errors = evaluate(tree, ("task",))
        for error in errors:
            self.problem(error.path[1:], str(error), error.hint)
        self._top(task)
        block = {key: dict(task[key]) if isinstance(task[key], dict) else task[key] for key in task}
        self._env(_mapping(block.get("env")))
        self._sim(_mapping(block.get("sim")))
        self._viewport(_mapping(block.get("viewport")))
        self._randomization(block.get("domain_randomization"))
        block["mjcf"] = self._models(block.get("mjcf"))
        if self.problems:
            raise ConfigError(self.problems)
        for path in MOVED_KEYS:
            section = block.get(path[0])
            if isinstance(section, dict):
                section.pop(path[1], None)
        self.put(("oige",), block, ())
        self.put(("summary",), f"{task.get('name', 'A task')}, a task written for OmniIsaacGymEnvs", ("name",))
        self.data["scene"].setdefault("entities", {})

        def origin_of(path: Path) -> Origin:
            for length in range(len(path), -1, -1):
                if path[:length] in self.sources:
                    return self.origin(self.sources[path[:length]] + path[length:])
            return self.origin(())

        found = Translation(self.data, origin_of, self.notes)
        if agents is not None:
            found.agents, found.agents_origin = self._agents(agents, task)
        return found

    def _top(self, task: Mapping[str, Any]) -> None:
        for key in task:
            if key not in TOP_KEYS:
                near = did_you_mean(key, TOP_KEYS) or f"keys: {listing(TOP_KEYS)}"
                self.problem((key,), f"unknown key '{key}'", near)
        for key in ("rl", "ctrl", "randomize"):
            if key in task:
                self.note((key,), "task")
        if "physics_engine" in task:
            self.note(("physics_engine",), "ignored", "MuJoCo is the physics engine")
        if "name" in task:
            self.note(("name",), "mapped", "the task's name")

    def _env(self, env: dict[str, Any]) -> None:
        step_dt = float(_number(self.document.data.get("sim", {}), "dt", 1.0 / 60.0))
        decimation = env.get("controlFrequencyInv", 1)
        if not isinstance(decimation, int) or isinstance(decimation, bool) or decimation < 1:
            self.problem(("env", "controlFrequencyInv"), f"expected a whole number >= 1, found {decimation!r}")
            decimation = 1
        step_dt *= decimation
        self.put(("decimation",), decimation, ("env", "controlFrequencyInv"))
        self.put(("episode_length_s",), *self._episode(env, step_dt))
        for key, target in (
            ("numEnvs", ("scene", "num_envs")),
            ("envSpacing", ("scene", "env_spacing")),
            ("clipActions", ("clip_actions",)),
            ("clipObservations", ("clip_observations",)),
        ):
            if key in env and not isinstance(env[key], dict):
                self.put(target, env[key], ("env", key))
        for key in env:
            moved = MOVED_KEYS.get(("env", key))
            if moved:
                self.note(("env", key), "mapped", moved)
            else:
                self.note(("env", key), "task")

    def _episode(self, env: Mapping[str, Any], step_dt: float) -> tuple[float, Path]:
        """Return the length of an episode [s], and the key that sets it."""
        for key in EPISODE_KEYS:
            if isinstance(env.get(key), int | float):
                return env[key] * step_dt, ("env", key)
        learn = _mapping(env.get("learn"))
        if isinstance(learn.get("episodeLength_s"), int | float):
            return float(learn["episodeLength_s"]), ("env", "learn", "episodeLength_s")
        if isinstance(env.get("episodeLength_s"), int | float):
            return float(env["episodeLength_s"]), ("env", "episodeLength_s")
        steps = class_constant(self.class_file, self.class_name, "_max_episode_length")
        return (1000 if steps is None else steps) * step_dt, ("env",)

    def _sim(self, sim: dict[str, Any]) -> None:
        if "dt" not in sim:
            self.put(("sim", "dt"), 1.0 / 60.0, ("sim",))
        # OmniIsaacGymEnvs' first observation of an episode follows a step; here forces of an initial state are 0
        self.put(("sim", "forces_after_reset"), False, ("sim",))
        for key, value in sim.items():
            at = ("sim", key)
            if key in ("dt", "gravity"):
                self.put(at, value, at)
                self.note(at, "mapped", MOVED_KEYS[at])
            elif key in ("add_ground_plane", "add_distant_light"):
                self.note(at, "mapped", MOVED_KEYS[at])
            elif key == "default_physics_material":
                self._section(at, value, MATERIAL_KEYS)
            elif key == "physx":
                self._section(at, value, PHYSX_KEYS)
            elif key in SIM_KEYS:
                self.note(at, *SIM_KEYS[key])
            elif isinstance(value, dict):
                self._section(at, value, ACTOR_KEYS)
            else:
                near = did_you_mean(key, [*SIM_KEYS, "dt", "gravity", "add_ground_plane", "add_distant_light", "physx"])
                self.problem(at, f"unknown key '{key}'", near)
        self._ground(sim)

    def _ground(self, sim: Mapping[str, Any]) -> None:
        if sim.get("add_ground_plane", True):
            friction = _mapping(sim.get("default_physics_material")).get("dynamic_friction", 1.0)
            self.put(
                ("scene", "ground"), {"friction": friction}, ("sim", "default_physics_material", "dynamic_friction")
            )
        else:
            self.put(("scene", "ground"), None, ("sim", "add_ground_plane"))
        lights: dict[str, Any] = {"dome": {}}
        if sim.get("add_distant_light", True):
            lights["distant"] = {}
        self.put(("scene", "lights"), lights, ("sim", "add_distant_light"))

    def _viewport(self, viewport: Mapping[str, Any]) -> None:
        for key, value in viewport.items():
            target = MOVED_KEYS.get(("viewport", key))
            if target is None:
                self.problem(("viewport", key), f"unknown key '{key}'; remove it")
                continue
            self.put(tuple(target.split(".")), value, ("viewport", key))
            self.note(("viewport", key), "mapped", target)
        if "viewport" not in self.document.data:
            self.put(("viewer",), {"eye": [10.0, 10.0, 3.0], "lookat": [0.0, 0.0, 0.0]}, ())

    def _randomization(self, block: Any) -> None:
        if block is None:
            return
        randomization_yaml.check(block, self.problem, self.note)

    def _models(self, block: Any) -> dict[str, Any]:
        """Return the content of the key `mjcf`: path of a robot in an environment -> its model. Report mistakes."""
        models: dict[str, Any] = {}
        for path, value in _mapping(block).items():
            at = ("mjcf", path)
            entry = {"model": value} if isinstance(value, str) else value
            if not isinstance(entry, dict) or not isinstance(entry.get("model"), str):
                self.problem(at, f"expected an MJCF file, or {{model: FILE}}, found {value!r}")
                continue
            for key, names in entry.items():
                if key not in ("model", "joints", "bodies"):
                    near = did_you_mean(key, ("model", "joints", "bodies")) or "keys: model, joints, bodies"
                    self.problem((*at, key), f"unknown key '{key}'", near)
                elif key != "model" and not (
                    isinstance(names, dict) and all(isinstance(name, str) for name in names.values())
                ):
                    self.problem((*at, key), "not a mapping; write {NAME IN THE TASK: NAME IN THE MODEL}")
            models[relative(path)] = entry
            self.note(at, "mapped", str(entry["model"]))
        if block is not None and not isinstance(block, dict):
            self.problem(("mjcf",), "expected a mapping from robots to MJCF files, {ROBOT: FILE.xml}")
        return models

    def _agents(self, file: FilePath, task: Any) -> tuple[dict[str, Any], Callable[[Path], Origin]]:
        document = read(file)
        found = agent_yaml.translate(document, str(file), {**ROOT_SETTINGS, "task": task})
        self.notes += found.notes
        return {"agents": {"default": "ppo", "ppo": found.data}}, found.origin_at(("agents", "ppo"))

    def _section(self, at: Path, block: Any, known: Mapping[str, tuple[Status, str]]) -> None:
        if not isinstance(block, dict):
            self.problem(at, f"expected a mapping, found {block!r}; write `key: value`")
            return
        for key in block:
            if key in known:
                self.note((*at, key), *known[key])
            else:
                self.problem((*at, key), f"unknown key '{key}'", did_you_mean(key, known) or f"keys: {listing(known)}")


def relative(prim_path: str) -> str:
    """Return a path relative to its environment: `/World/envs/.*/Ant` or `Ant` -> `Ant`."""
    parts = [part for part in prim_path.split("/") if part]
    if parts[:2] == ["World", "envs"]:
        parts = parts[3:]
    return "/".join(parts)


def home(config: FilePath) -> FilePath:
    """Return the folder of a task's files: the folder of its YAML; for PACKAGE/cfg/task/NAME.yaml it is PACKAGE."""
    inside = config.parent.parts[-2:] == ("cfg", "task")
    return config.parent.parent.parent if inside else config.parent


def _composed_data(file: FilePath) -> dict[str, Any]:
    """Return the data of a YAML file. A wrong `defaults:` list is not an error here: reading the task reports it."""
    document = read(file)
    try:
        return compose(document, file, str(file)).data
    except ConfigError:
        return {"sim": {}, **document.data}


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _number(block: Any, key: str, default: float) -> float:
    value = block.get(key, default) if isinstance(block, dict) else default
    return value if isinstance(value, int | float) else default
