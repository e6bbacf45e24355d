"""OmniIsaacGymEnvs' own task YAML, read as it is: what becomes of each of its keys.

The file keeps its form. What the framework does (time step, number of environments, ground, ...) goes to the keys of
`TaskConfig`; the rest goes to `oige:`, where the task's class reads it; and of every key a note says whether it is
mapped, approximated or ignored. One key is added to the form, `mjcf:`, which says what file stands for which robot.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

from rlcli.config.layers import Origin, document_origins, read
from rlcli.config.strict_yaml import Document, Path
from rlcli.errors import ConfigError, Problem, did_you_mean, listing
from rlcli.formats import Note, Status, Translation
from rlcli_oige import agent_yaml, randomization_yaml
from rlcli_oige.hydra import evaluate

ROOT: Mapping[str, Any] = {
    "task_name": "", "experiment": "", "num_envs": "", "seed": 42, "torch_deterministic": False,
    "max_iterations": "", "physics_engine": "physx", "pipeline": "cpu", "sim_device": "cpu", "device_id": 0,
    "rl_device": "cpu", "multi_gpu": False, "num_threads": 4, "solver_type": 1, "test": False, "checkpoint": "",
    "evaluation": False, "headless": True, "enable_livestream": False, "mt_timeout": 300, "enable_recording": False,
    "recording_interval": 2000, "recording_length": 100, "recording_fps": 30, "recording_dir": "",
    "wandb_activate": False, "wandb_group": "", "wandb_name": "", "wandb_entity": "", "wandb_project": "",
    "kit_app": "", "extras": [], "warp": False,
}  # fmt: skip
"""What interpolations find above the task: the settings of OmniIsaacGymEnvs' command line."""

EPISODE = ("episodeLength", "maxEpisodeLength")
MOVED: Mapping[Path, str] = {
    ("env", "numEnvs"): "scene.num_envs",
    ("env", "envSpacing"): "scene.env_spacing",
    ("env", "controlFrequencyInv"): "decimation",
    ("env", "clipObservations"): "clip_observations",
    ("env", "clipActions"): "clip_actions",
    ("env", "episodeLength"): "episode_length_s",
    ("env", "maxEpisodeLength"): "episode_length_s",
    ("sim", "dt"): "sim.dt",
    ("sim", "gravity"): "sim.gravity",
    ("sim", "add_ground_plane"): "scene.ground",
    ("sim", "add_distant_light"): "scene.lights.distant",
    ("viewport", "camera_position"): "viewer.eye",
    ("viewport", "camera_target"): "viewer.lookat",
    ("viewport", "viewport_camera_width"): "viewer.width",
    ("viewport", "viewport_camera_height"): "viewer.height",
}
"""Keys of the form that are keys of `TaskConfig` here. The class still finds them in `_task_cfg`."""

_TOP = ("name", "physics_engine", "env", "sim", "domain_randomization", "viewport", "mjcf", "rl", "ctrl", "randomize")
_DEVICE = "--device decides"
_SIM: Mapping[str, tuple[Status, str]] = {
    "use_gpu_pipeline": ("ignored", _DEVICE),
    "use_fabric": ("ignored", "there is no USD stage"),
    "use_flatcache": ("ignored", "there is no USD stage"),
    "enable_scene_query_support": ("ignored", "rays need no switch"),
    "disable_contact_processing": ("ignored", "contacts are always known"),
    "enable_cameras": ("ignored", "a policy sees no pictures"),
    "replicate_physics": ("ignored", "every environment is a world of its own"),
    "rendering_dt": ("approximated", "videos take one frame a step, or fewer by sim.render_interval"),
    "substeps": ("approximated", "write a smaller sim.dt and a larger decimation for more than 1"),
    "gravity_mag": ("task", ""),
    "disable_gravity": ("task", ""),
    "add_damping": ("task", ""),
    "disable_franka_collisions": ("task", ""),
    "disable_nut_collisions": ("task", ""),
    "disable_bolt_collisions": ("task", ""),
}
_MATERIAL: Mapping[str, tuple[Status, str]] = {
    "dynamic_friction": ("mapped", "sliding friction of contacts with the ground"),
    "static_friction": ("approximated", "MuJoCo has one sliding friction; dynamic_friction is taken"),
    "restitution": ("approximated", "the ground's contact damping is set for this bounce"),
}
_SOLVER = "MuJoCo's solver iterates until it has converged; its limits are the MJCF's <option>"
_OFFSET = "contacts are as soft as the MJCF's solref and solimp, and begin at its margin"
_SLEEP = "nothing falls asleep"
_BUFFER = "room for contacts is estimated; sim.contacts_per_env sets it"
_PHYSX: Mapping[str, tuple[Status, str]] = {
    "use_gpu": ("ignored", _DEVICE),
    "worker_thread_count": ("ignored", "sim.engine_threads sets it"),
    "num_threads": ("ignored", "sim.engine_threads sets it"),
    "solver_type": ("ignored", _SOLVER),
    "solver_position_iteration_count": ("ignored", _SOLVER),
    "solver_velocity_iteration_count": ("ignored", _SOLVER),
    "contact_offset": ("ignored", _OFFSET),
    "rest_offset": ("ignored", _OFFSET),
    "bounce_threshold_velocity": ("ignored", _OFFSET),
    "max_depenetration_velocity": ("ignored", _OFFSET),
    "friction_offset_threshold": ("ignored", _OFFSET),
    "friction_correlation_distance": ("ignored", _OFFSET),
    "enable_sleeping": ("ignored", _SLEEP),
    "enable_stabilization": ("ignored", _SLEEP),
    "sleep_threshold": ("ignored", _SLEEP),
    "stabilization_threshold": ("ignored", _SLEEP),
    "enable_gyroscopic_forces": ("ignored", "MuJoCo always has them"),
    "density": ("ignored", "the MJCF's masses and densities hold"),
    **dict.fromkeys(
        (
            "gpu_max_rigid_contact_count", "gpu_max_rigid_patch_count", "gpu_found_lost_pairs_capacity",
            "gpu_found_lost_aggregate_pairs_capacity", "gpu_total_aggregate_pairs_capacity",
            "gpu_max_soft_body_contacts", "gpu_max_particle_contacts", "gpu_heap_capacity",
            "gpu_temp_buffer_capacity", "gpu_max_num_partitions", "gpu_collision_stack_size",
        ),
        ("ignored", _BUFFER),
    ),
}  # fmt: skip
_ACTOR: Mapping[str, tuple[Status, str]] = {
    **{
        key: _PHYSX[key]
        for key in (
            "solver_position_iteration_count", "solver_velocity_iteration_count", "sleep_threshold",
            "stabilization_threshold", "max_depenetration_velocity", "contact_offset", "rest_offset",
            "enable_gyroscopic_forces",
        )
    },
    "override_usd_defaults": ("ignored", "there is no USD"),
    "make_kinematic": ("mapped", "a body that moves only where it is put"),
    "enable_self_collisions": ("approximated", "false: the actor's bodies pass through each other; else the MJCF's"),
    "density": ("mapped", "of all the actor's geoms; -1: the MJCF's"),
    "mass": ("mapped", "the actor's whole mass; -1: the MJCF's"),
    "static_friction": _MATERIAL["static_friction"],
    "dynamic_friction": ("approximated", "contacts take the larger friction of the two geoms"),
    "restitution": ("ignored", _OFFSET),
}  # fmt: skip


def is_oige(data: Mapping[str, Any]) -> bool:
    """Whether a YAML document has OmniIsaacGymEnvs' form."""
    if "decimation" in data or "scene" in data:
        return False
    return isinstance(data.get("env"), dict) and ("physics_engine" in data or isinstance(data.get("sim"), dict))


def is_oige_file(file: FilePath) -> bool:
    """Whether a file can be read and has that form."""
    try:
        return is_oige(read(file).data)
    except ConfigError:
        return False


def task_name(file: FilePath) -> str | None:
    """The name of a task of OmniIsaacGymEnvs, in its own form or imported; None for another task's file."""
    try:
        data = read(file).data
    except ConfigError:
        return None
    imported = _mapping(data.get("oige"))
    if not imported and not is_oige(data):
        return None
    return str((imported or data).get("name") or file.stem)


def translate(
    document: Document, label: str, *, class_file: FilePath | None, class_name: str | None, agent_file: FilePath | None
) -> Translation:
    """A task YAML, and the rl_games YAML of its agent where there is one.

    Args:
        document: the task YAML.
        label: how messages name it.
        class_file: source of the task's class; a length of episodes that only the class knows is read from it.
        class_name: the class.
        agent_file: the agent's YAML.

    Raises:
        ConfigError: with every key that is not known, and every interpolation that leads nowhere.
    """
    return _Translator(document, label, class_file, class_name).run(agent_file)


def agent_file(config: FilePath) -> FilePath | None:
    """The rl_games YAML that belongs to a task YAML: `AntPPO.yaml` beside `Ant.yaml`, or in `../train`."""
    name = f"{config.stem}PPO.yaml"
    return next((f for f in (config.with_name(name), config.parent.parent / "train" / name) if f.is_file()), None)


@dataclass(slots=True)
class _Translator:
    document: Document
    label: str
    class_file: FilePath | None
    class_name: str | None
    notes: list[Note] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    data: dict[str, Any] = field(default_factory=dict)
    sources: dict[Path, Path] = field(default_factory=dict)

    def run(self, agents: FilePath | None) -> Translation:
        tree = {**ROOT, "task": self.document.data}
        tree["task_name"] = self.document.data.get("name", "")
        task, errors = evaluate(tree, ("task",))
        for error in errors:
            self._problem(error.path[1:], str(error), error.hint)
        self._top(task)
        own = {key: dict(task[key]) if isinstance(task[key], dict) else task[key] for key in task}
        self._env(_mapping(own.get("env")))
        self._sim(_mapping(own.get("sim")))
        self._viewport(_mapping(own.get("viewport")))
        self._randomization(own.get("domain_randomization"))
        own["mjcf"] = self._models(own.get("mjcf"))
        if self.problems:
            raise ConfigError(self.problems)
        for path in MOVED:
            section = own.get(path[0])
            if isinstance(section, dict):
                section.pop(path[1], None)
        self._put(("oige",), own, ())
        self._put(("summary",), f"{task.get('name', 'A task')}, a task written for OmniIsaacGymEnvs", ("name",))
        self.data["scene"].setdefault("entities", {})
        origin = document_origins(self.document, self.label, "task")

        def written(path: Path) -> Origin:
            for length in range(len(path), -1, -1):
                if path[:length] in self.sources:
                    return origin(self.sources[path[:length]] + path[length:])
            return origin(())

        found = Translation(self.data, written, self.notes)
        if agents is not None:
            found.agents, found.agents_origin = self._agents(agents, task)
        return found

    def _top(self, task: Mapping[str, Any]) -> None:
        for key in task:
            if key == "defaults":
                self._problem((key,), "Hydra's defaults list is not followed", "write the task as one file")
            elif key not in _TOP:
                near = did_you_mean(key, _TOP) or f"keys: {listing(_TOP)}"
                self._problem((key,), f"unknown key '{key}'", near)
        for key in ("rl", "ctrl", "randomize"):
            if key in task:
                self._note((key,), "task")
        if "physics_engine" in task:
            self._note(("physics_engine",), "ignored", "physics runs in MuJoCo")
        if "name" in task:
            self._note(("name",), "mapped", "the task's name")

    def _env(self, env: dict[str, Any]) -> None:
        step_dt = float(_number(self.document.data.get("sim", {}), "dt", 1.0 / 60.0))
        decimation = env.get("controlFrequencyInv", 1)
        if not isinstance(decimation, int) or isinstance(decimation, bool) or decimation < 1:
            self._problem(("env", "controlFrequencyInv"), f"expected a whole number >= 1, found {decimation!r}")
            decimation = 1
        step_dt *= decimation
        self._put(("decimation",), decimation, ("env", "controlFrequencyInv"))
        self._put(("episode_length_s",), *self._episode(env, step_dt))
        for key, target in (
            ("numEnvs", ("scene", "num_envs")),
            ("envSpacing", ("scene", "env_spacing")),
            ("clipActions", ("clip_actions",)),
            ("clipObservations", ("clip_observations",)),
        ):
            if key in env and not isinstance(env[key], dict):
                self._put(target, env[key], ("env", key))
        for key in env:
            moved = MOVED.get(("env", key))
            if moved:
                self._note(("env", key), "mapped", moved)
            else:
                self._note(("env", key), "task")

    def _episode(self, env: Mapping[str, Any], step_dt: float) -> tuple[float, Path]:
        """Length of an episode [s], and the key that says it."""
        for key in EPISODE:
            if isinstance(env.get(key), int | float):
                return env[key] * step_dt, ("env", key)
        learn = _mapping(env.get("learn"))
        if isinstance(learn.get("episodeLength_s"), int | float):
            return float(learn["episodeLength_s"]), ("env", "learn", "episodeLength_s")
        if isinstance(env.get("episodeLength_s"), int | float):
            return float(env["episodeLength_s"]), ("env", "episodeLength_s")
        steps = _class_constant(self.class_file, self.class_name, "_max_episode_length")
        return (1000 if steps is None else steps) * step_dt, ("env",)

    def _sim(self, sim: dict[str, Any]) -> None:
        if "dt" not in sim:
            self._put(("sim", "dt"), 1.0 / 60.0, ("sim",))
        # OmniIsaacGymEnvs' first observation of an episode comes after a step; forces of a start state are 0 here
        self._put(("sim", "forces_after_reset"), False, ("sim",))
        for key, value in sim.items():
            at = ("sim", key)
            if key in ("dt", "gravity"):
                self._put(at, value, at)
                self._note(at, "mapped", MOVED[at])
            elif key in ("add_ground_plane", "add_distant_light"):
                self._note(at, "mapped", MOVED[at])
            elif key == "default_physics_material":
                self._section(at, value, _MATERIAL)
            elif key == "physx":
                self._section(at, value, _PHYSX)
            elif key in _SIM:
                self._note(at, *_SIM[key])
            elif isinstance(value, dict):
                self._section(at, value, _ACTOR)
            else:
                near = did_you_mean(key, [*_SIM, "dt", "gravity", "add_ground_plane", "add_distant_light", "physx"])
                self._problem(at, f"unknown key '{key}'", near)
        self._ground(sim)

    def _ground(self, sim: Mapping[str, Any]) -> None:
        if sim.get("add_ground_plane", True):
            friction = _mapping(sim.get("default_physics_material")).get("dynamic_friction", 1.0)
            self._put(
                ("scene", "ground"), {"friction": friction}, ("sim", "default_physics_material", "dynamic_friction")
            )
        else:
            self._put(("scene", "ground"), None, ("sim", "add_ground_plane"))
        lights: dict[str, Any] = {"dome": {}}
        if sim.get("add_distant_light", True):
            lights["distant"] = {}
        self._put(("scene", "lights"), lights, ("sim", "add_distant_light"))

    def _viewport(self, viewport: Mapping[str, Any]) -> None:
        for key, value in viewport.items():
            target = MOVED.get(("viewport", key))
            if target is None:
                self._problem(("viewport", key), f"unknown key '{key}'")
                continue
            self._put(tuple(target.split(".")), value, ("viewport", key))
            self._note(("viewport", key), "mapped", target)
        if "viewport" not in self.document.data:
            self._put(("viewer",), {"eye": [10.0, 10.0, 3.0], "lookat": [0.0, 0.0, 0.0]}, ())

    def _randomization(self, block: Any) -> None:
        if block is None:
            return
        randomization_yaml.check(block, self._problem, self._note)

    def _models(self, block: Any) -> dict[str, Any]:
        """Robot, by its path in an environment -> model file, and the model's names for the task's."""
        models: dict[str, Any] = {}
        for path, value in _mapping(block).items():
            at = ("mjcf", path)
            entry = {"model": value} if isinstance(value, str) else value
            if not isinstance(entry, dict) or not isinstance(entry.get("model"), str):
                self._problem(at, f"expected an MJCF file, or {{model: FILE}}, found {value!r}")
                continue
            for key, names in entry.items():
                if key not in ("model", "joints", "bodies"):
                    near = did_you_mean(key, ("model", "joints", "bodies")) or "keys: model, joints, bodies"
                    self._problem((*at, key), f"unknown key '{key}'", near)
                elif key != "model" and not (
                    isinstance(names, dict) and all(isinstance(name, str) for name in names.values())
                ):
                    self._problem((*at, key), "expected a mapping of the task's names to the model's")
            models[relative(path)] = entry
            self._note(at, "mapped", str(entry["model"]))
        if block is not None and not isinstance(block, dict):
            self._problem(("mjcf",), "expected a mapping of robots to MJCF files")
        return models

    def _agents(self, file: FilePath, task: Any) -> tuple[dict[str, Any], Callable[[Path], Origin]]:
        document = read(file)
        found = agent_yaml.translate(document, str(file), {**ROOT, "task": task})
        self.notes += found.notes
        return {"agents": {"default": "ppo", "ppo": found.data}}, found.origin_at(("agents", "ppo"))

    def _section(self, at: Path, block: Any, known: Mapping[str, tuple[Status, str]]) -> None:
        if not isinstance(block, dict):
            self._problem(at, f"expected a mapping, found {block!r}")
            return
        for key in block:
            if key in known:
                self._note((*at, key), *known[key])
            else:
                self._problem((*at, key), f"unknown key '{key}'", did_you_mean(key, known) or f"keys: {listing(known)}")

    def _put(self, target: Path, value: Any, source: Path) -> None:
        node = self.data
        for step in target[:-1]:
            node = node.setdefault(str(step), {})
        node[str(target[-1])] = value
        self.sources[target] = source

    def _where(self, path: Path) -> str:
        return document_origins(self.document, self.label, "task")(path).where

    def _note(self, path: Path, status: Status, text: str = "") -> None:
        self.notes.append(Note(self._where(path), ".".join(str(step) for step in path), status, text))

    def _problem(self, path: Path, message: str, hint: str | None = None) -> None:
        self.problems.append(Problem(self._where(path), ".".join(str(step) for step in path), message, hint))


def relative(prim_path: str) -> str:
    """`/World/envs/.*/Ant` or `Ant` -> `Ant`: a path below its environment."""
    parts = [part for part in prim_path.split("/") if part]
    if parts[:2] == ["World", "envs"]:
        parts = parts[3:]
    return "/".join(parts)


def home(config: FilePath) -> FilePath:
    """The folder that the files of a task lie below: that of its YAML, or the package whose `cfg/task` holds it."""
    inside = config.parent.parts[-2:] == ("cfg", "task")
    return config.parent.parent.parent if inside else config.parent


def find_class(folder: FilePath, name: str) -> tuple[FilePath, str]:
    """The file and the class of a task in a folder: in `task.py`, else in any Python file below.

    Raises:
        LookupError: with what was found instead.
    """
    own = folder / "task.py"
    files = [own] if own.is_file() else sorted(folder.rglob("*.py"))
    classes: list[tuple[FilePath, str, list[str]]] = []
    for file in files[:500]:
        classes += [(file, *found) for found in _classes(file)]
    for wanted in ("Task", f"{name}Task", f"{name}LocomotionTask", name):
        exact = [(file, cls) for file, cls, _ in classes if cls == wanted]
        outer = min((len(file.parts) for file, _ in exact), default=0)
        exact = [found for found in exact if len(found[0].parts) == outer]  # variants lie further below
        if len(exact) == 1:
            return exact[0]
    bases = {base for _, _, all_bases in classes for base in all_bases}
    tasks = [(file, cls) for file, cls, of in classes if cls not in bases and any(base.endswith("Task") for base in of)]
    near = [found for found in tasks if found[1].lower().startswith(name.lower())]
    for choice in (near, tasks):
        if len(choice) == 1:
            return choice[0]
    where = "task.py" if own.is_file() else "any Python file there"
    if not tasks:
        raise LookupError(f"no task class in {where}; '{name}Task' was looked for")
    raise LookupError(f"several task classes, and none is '{name}Task': {listing(cls for _, cls in tasks)}")


def _classes(file: FilePath) -> list[tuple[str, list[str]]]:
    try:
        tree = ast.parse(file.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, UnicodeDecodeError):
        return []
    return [
        (node.name, [ast.unparse(base).rpartition(".")[2] for base in node.bases])
        for node in tree.body
        if isinstance(node, ast.ClassDef)
    ]


def _class_constant(file: FilePath | None, name: str | None, attribute: str) -> float | None:
    """What a class assigns to `self.<attribute>`, if that is a number."""
    if file is None:
        return None
    try:
        tree = ast.parse(file.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, UnicodeDecodeError):
        return None
    for owner in [n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name]:
        for node in ast.walk(owner):
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
                named = any(isinstance(t, ast.Attribute) and t.attr == attribute for t in node.targets)
                if named and isinstance(node.value.value, int | float):
                    return float(node.value.value)
    return None


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _number(block: Any, key: str, default: float) -> float:
    value = block.get(key, default) if isinstance(block, dict) else default
    return value if isinstance(value, int | float) else default
