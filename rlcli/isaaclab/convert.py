"""Isaac Lab's settings, as nested dicts, to the data of a task. What has no counterpart is reported by name.

Both front ends come through here: configuration classes in Python, and the YAML files that Isaac Lab writes into runs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rlcli.config.notes import Note, Status
from rlcli.config.terms import Signature, builtin_terms
from rlcli.errors import ConfigError, Problem, TaskError, did_you_mean, listing
from rlcli.isaaclab import assets
from rlcli.isaaclab.configclass import is_missing
from rlcli.isaaclab.managers import SceneEntityCfg
from rlcli.isaaclab.mdp import MdpFunction
from rlcli.isaaclab.randomization import EVENTS, translated
from rlcli.isaaclab.table import ACTIONS, COMMANDS, TERMS, Entry, seconds

Key = tuple[str, ...]


@dataclass(slots=True)
class Report:
    """What became of each key."""

    entries: dict[Key, tuple[Status, str]] = field(default_factory=dict)
    """Key -> mapped, approximated or ignored, and why."""
    problems: list[Problem] = field(default_factory=list)
    stubs: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)
    """Functions that only their author has: name -> section and parameters."""

    def notes(self, prefix: str = "", where: str = "") -> list[Note]:
        """What became of each key."""
        start = f"{prefix}." if prefix else ""
        return [Note(where, start + ".".join(key), *what) for key, what in self.entries.items()]

    def news(self, prefix: str = "") -> list[Note]:
        """What a user should know: everything that is not simply mapped."""
        return [note for note in self.notes(prefix) if note.status not in ("mapped", "default")]

    def problem(self, key: Key, message: str, hint: str | None = None) -> None:
        """Note a mistake."""
        self.problems.append(Problem("configuration", ".".join(key), message, hint))

    def finish(self, data: Any, defaults: Any = None) -> None:
        """Whatever nobody asked for is ignored; what is not set, or as it always is, is a default."""
        self._finish(data, (), defaults)
        if self.problems:
            raise ConfigError(self.problems)

    def _finish(self, value: Any, key: Key, default: Any) -> None:
        if key in self.entries:
            return
        if isinstance(value, Mapping) and value and any(known[: len(key)] == key for known in self.entries):
            for name, item in value.items():
                self._finish(item, (*key, str(name)), default.get(name) if isinstance(default, Mapping) else None)
        elif _empty(value) or (default is not None and _same(value, default)):
            self.entries[key] = ("default", "")
        else:
            self.entries[key] = ("ignored", "")


class Node:
    """A mapping of settings; what is asked for counts as mapped."""

    def __init__(self, data: Mapping[str, Any], key: Key, report: Report) -> None:
        self.data, self.key, self.report = data, key, report

    def __contains__(self, name: str) -> bool:
        value = self.data.get(name)
        return value is not None and not is_missing(value)

    def get(self, name: str, default: Any = None) -> Any:
        """A value, taken over."""
        if name in self.data:
            self.report.entries.setdefault((*self.key, name), ("mapped", ""))
        value = self.data.get(name)
        return default if value is None or is_missing(value) else value

    def need(self, name: str) -> Any:
        """A value that must be there."""
        value = self.get(name)
        if value is None:
            self.report.problem(self.key, f"missing '{name}'")
        return value

    def node(self, name: str) -> Node:
        """What stands under a name; empty if nothing does."""
        value = self.data.get(name)
        if value is None or is_missing(value):
            self.get(name)
            value = {}
        if not isinstance(value, Mapping):
            self.report.problem((*self.key, name), f"expected settings, found a {type(value).__name__}")
            value = {}
        return Node(value, (*self.key, name), self.report)

    def nodes(self) -> Iterator[tuple[str, Node]]:
        """Every member that has settings."""
        for name, value in self.data.items():
            if isinstance(value, Mapping):
                yield name, Node(value, (*self.key, name), self.report)

    def say(self, status: Status, name: str, why: str = "") -> None:
        """Report a member, if it is set to something."""
        if name in self and not _empty(self.data[name]):
            self.report.entries[(*self.key, name)] = (status, why)

    def skip(self, *names: str) -> None:
        """Members that mean nothing outside Isaac Sim, and change nothing that matters here."""
        for name in names:
            if name in self.data:
                self.report.entries[(*self.key, name)] = ("mapped", "")


def task(
    data: Mapping[str, Any],
    report: Report,
    root: Path,
    defaults: Any = None,
    models: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """The task that settings of a `ManagerBasedRLEnvCfg` describe; `models` name an MJCF for entities."""
    top = Node(data, (), report)
    made: dict[str, Any] = {
        "decimation": top.need("decimation"),
        "episode_length_s": _float(top.need("episode_length_s")),
        "sim": _sim(top.node("sim")),
        "viewer": _viewer(top.node("viewer")),
    }
    scene = SceneReader(top.node("scene"), root, models)
    made["scene"] = scene.read()
    convert = Terms(scene, report)
    convert.driven(top.node("actions"))
    made["actions"] = {name: convert.action(node) for name, node in top.node("actions").nodes()}
    made["observations"] = {name: convert.group(node) for name, node in top.node("observations").nodes()}
    for section in ("events", "rewards", "terminations", "curriculum"):
        made[section] = {
            name: term for node in top.node(section).nodes() for name, term in convert.terms(section, *node)
        }
    made["commands"] = {name: convert.command(node) for name, node in top.node("commands").nodes()}
    scene.finish(convert.joints_driven)
    for section in ("events", "curriculum", "commands"):
        if not made[section]:
            del made[section]
    if top.data.get("is_finite_horizon"):
        top.say("ignored", "is_finite_horizon", "a time-out is bootstrapped")
    top.skip("ui_window_class_type", "wait_for_textures", "rerender_on_reset", "export_io_descriptors", "log_dir")
    top.skip("recorders", "teleop_devices", "xr", "is_finite_horizon")
    if "seed" in top:
        top.say("ignored", "seed", "--seed says it")
    report.stubs = convert.stubs
    report.finish(data, defaults)
    return {key: value for key, value in made.items() if value is not None}


def agent(data: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The `ppo` agent that settings of a `RslRlOnPolicyRunnerCfg` describe."""
    top = Node(data, (), report)
    policy, algorithm = top.node("policy"), top.node("algorithm")
    bound = top.get("clip_actions")
    made: dict[str, Any] = {
        "trainer": "ppo",
        "algorithm": "ppo",
        "dialect": "rsl_rl",
        "max_iterations": top.need("max_iterations"),
        "save_interval": top.need("save_interval"),
        "num_steps": top.need("num_steps_per_env"),
        "action_bound": None if bound is None else _float(bound),
        "actor": _network(policy, "actor_hidden_dims"),
        "critic": _network(policy, "critic_hidden_dims"),
        "init_std": _float(policy.get("init_noise_std", 1.0)),
        "std": policy.get("noise_std_type", "scalar"),
    }
    normalized = policy.get("actor_obs_normalization", top.get("empirical_normalization", False))
    if bool(policy.get("critic_obs_normalization", normalized)) != bool(normalized):
        policy.say("approximated", "critic_obs_normalization", "actor and critic share one normaliser")
    made["normalize_observations"] = bool(normalized)
    if policy.get("class_name", "ActorCritic") == "ActorCriticRecurrent":
        made["rnn"] = {
            "type": policy.need("rnn_type"),
            "hidden": policy.get("rnn_hidden_dim", 256),
            "layers": policy.get("rnn_num_layers", 1),
        }
    groups = top.get("obs_groups")
    if isinstance(groups, Mapping):
        if list(groups.get("policy", ["policy"])) != ["policy"]:
            top.say("ignored", "obs_groups", "the policy sees the group 'policy'")
        if groups.get("critic"):
            made["critic_obs"] = list(groups["critic"])
    adaptive = algorithm.get("schedule", "adaptive") == "adaptive"
    made |= {
        "num_epochs": algorithm.need("num_learning_epochs"),
        "num_minibatches": algorithm.need("num_mini_batches"),
        "learning_rate": _float(algorithm.need("learning_rate")),
        "schedule": "adaptive" if adaptive else "constant",
        "desired_kl": algorithm.get("desired_kl") if adaptive else None,
        "gamma": algorithm.need("gamma"),
        "lam": algorithm.need("lam"),
        "entropy_coef": algorithm.need("entropy_coef"),
        "max_grad_norm": algorithm.need("max_grad_norm"),
        "value_coef": algorithm.need("value_loss_coef"),
        "clip_value": "larger" if algorithm.get("use_clipped_value_loss", True) else None,
        "clip_range": algorithm.need("clip_param"),
        "normalize_advantage": "minibatch" if algorithm.get("normalize_advantage_per_mini_batch") else "batch",
    }
    algorithm.skip("class_name", "desired_kl")
    top.skip("class_name", "logger", "neptune_project", "wandb_project", "resume", "load_run", "load_checkpoint")
    for name, why in (
        ("seed", "--seed"),
        ("device", "--device"),
        ("experiment_name", "--name"),
        ("run_name", "--name"),
    ):
        default = {"seed": 42, "device": "cuda:0"}.get(name)
        if top.data.get(name) == default:
            top.skip(name)
        elif top.data.get(name):
            top.say("ignored", name, f"{why} says it")
    report.finish(data)
    return made


def _network(policy: Node, name: str) -> dict[str, Any]:
    return {"hidden": list(policy.need(name) or []), "activation": policy.get("activation", "elu")}


def _sim(node: Node) -> dict[str, Any]:
    made: dict[str, Any] = {"dt": _float(node.get("dt", 1.0 / 60.0))}
    interval = node.get("render_interval", 1)
    if interval != 1:
        made["render_interval"] = interval
    gravity = [_float(g) for g in node.get("gravity", (0.0, 0.0, -9.81))]
    if gravity != [0.0, 0.0, -9.81]:
        made["gravity"] = gravity
    node.skip("physics_prim_path", "use_fabric", "enable_scene_query_support", "render", "create_stage_in_memory")
    if "device" in node:
        node.skip("device")
    material = node.data.get("physics_material")
    if isinstance(material, Mapping) and material:
        plain = material.get("static_friction", 0.5) == 0.5 and material.get("dynamic_friction", 0.5) == 0.5
        if plain:
            node.skip("physics_material")
        else:
            node.say("ignored", "physics_material", "friction is the MJCF's; scene.ground.friction for the ground")
    if node.data.get("physx"):
        node.say("ignored", "physx", "MuJoCo's solver has its own settings: sim.integrator, sim.iterations")
    return made


def _viewer(node: Node) -> dict[str, Any]:
    made = {
        "eye": [_float(v) for v in node.get("eye", (7.5, 7.5, 7.5))],
        "lookat": [_float(v) for v in node.get("lookat", (0.0, 0.0, 0.0))],
    }
    resolution = node.get("resolution", (1280, 720))
    if tuple(resolution) != (1280, 720):
        made["width"], made["height"] = resolution
    node.skip("cam_prim_path", "env_index", "asset_name", "body_name")
    if node.get("origin_type", "world") not in ("world", "env"):
        node.say("ignored", "origin_type", "the camera stands still")
    return made


# --- the scene ---


class SceneReader:
    """Assets, lights, ground and sensors; models are opened to know the names in them."""

    def __init__(self, node: Node, root: Path, models: Mapping[str, str] | None = None) -> None:
        self.node, self.root, self.report = node, root, node.report
        self._given = dict(models or {})
        self.entities: dict[str, dict[str, Any]] = {}
        self.prims: dict[str, str] = {}
        """Entity -> the last part of its prim path."""
        self.sensors: dict[str, dict[str, Any]] = {}
        self._models: dict[str, Any] = {}
        self._drives: dict[str, list[tuple[str, dict[str, Any]]]] = {}
        self._inits: dict[str, dict[str, Any]] = {}

    def read(self) -> dict[str, Any]:
        """`scene:` of the task."""
        node = self.node
        made: dict[str, Any] = {
            "num_envs": node.get("num_envs", 1),
            "env_spacing": _float(node.get("env_spacing", 4.0)),
        }
        node.skip("lazy_sensor_update", "replicate_physics", "filter_collisions", "clone_in_fabric")
        ground: Any = None
        lights: dict[str, Any] = {}
        later: list[tuple[str, Node]] = []
        for name, item in node.nodes():
            kind, spawn = _kind(item.data.get("class_type")), item.node("spawn") if "spawn" in item else None
            shape = _kind(spawn.data.get("func")) if spawn else ""
            if kind in ("Articulation", "RigidObject"):
                self._entity(name, item, spawn)
            elif kind == "TerrainImporter":
                ground = self._terrain(item, made)
            elif kind:
                later.append((kind, item))
            elif shape == "spawn_ground_plane" and spawn:
                ground = self._ground(item, spawn)
            elif shape == "spawn_light" and spawn:
                self._light(item, spawn, lights)
            elif spawn:
                self._entity(name, item, spawn)
            else:
                self.report.entries[item.key] = ("ignored", "there is nothing like it")
        for kind, item in later:
            self._sensor(kind, item)
        made["ground"] = ground
        made["lights"] = lights
        if not self.entities:
            self.report.problem(node.key, "has no robot or object")
        made["entities"] = self.entities
        if self.sensors:
            made["sensors"] = self.sensors
        return made

    def finish(self, driven: Mapping[str, Mapping[str, str]]) -> None:
        """Joint settings, once it is known which joints the actions drive. What the MJCF says already is left out."""
        for name, entity in self.entities.items():
            joints = self._joint_settings(name, driven.get(name, {}))
            if joints:
                entity["joints"] = joints

    def names(self, entity: str, kind: str) -> list[str] | None:
        """Joints or bodies of an entity in its model's order; None if there is no model."""
        model = self._models.get(entity)
        return None if model is None else model[kind]

    def ordered(self, entity: str, kind: str, wanted: Any, preserve: bool, key: Key) -> Any:
        """Names or regexes in the order that they are meant in: the model's, unless that written is to be kept."""
        if isinstance(wanted, str):
            return wanted
        wanted = list(wanted)
        names = self.names(entity, kind)
        if names is None or len(wanted) < 2 or preserve:
            return wanted
        from rlcli.sim.names import NameProblem, match

        try:
            return [names[p] for p in sorted(match(wanted, names, kind))]
        except NameProblem as problem:
            self.report.problem(key, str(problem), problem.hint)
            return wanted

    def geoms_of(self, entity: str, bodies: list[str], key: Key) -> list[str]:
        """The geoms of bodies, by names or regexes of the bodies."""
        from rlcli.sim.names import NameProblem, match

        model = self._models.get(entity)
        if model is None:
            return [".*"]
        try:
            chosen = {model["body"][place] for place in match(bodies, model["body"], "body")}
        except NameProblem as problem:
            self.report.problem(key, str(problem), problem.hint)
            return []
        return [geom for geom, body in model["geoms"] if body in chosen]

    def drives_of(self, entity: str, joints: list[str] | None) -> tuple[Any, Any]:
        """Of joints (None: all), the actuators of MuJoCo's own, and the joints that actuator models drive."""
        from rlcli.sim.names import NameProblem, match

        model = self._models.get(entity)
        if model is None:
            return ".*", None
        names: list[str] = model["joint"]
        try:
            chosen = [names[place] for place in match(joints or ".*", names, "joint")]
            models = self.entities[entity].get("actuators", {}).values()
            explicit = [names[place] for one in models for place in match(one["joints"], names, "joint")]
        except NameProblem:
            return ".*", None  # the actuator's own joints are told elsewhere
        moved = [p for p, values in self._drives.get(entity, []) if values.get("stiffness") or values.get("damping")]
        native = [n for n in chosen if n not in explicit and any(re.fullmatch(p, n) for p in moved)]
        return [model["actuators"].get(n, n) for n in native], [n for n in chosen if n in explicit]

    def sensor_part(self, name: str, bodies: Any, preserve: bool, key: Key) -> str:
        """The sensor of some of a contact sensor's bodies: one of its own, unless those are all of them."""
        sensor = self.sensors.get(name)
        if sensor is None or sensor["kind"] != "contact" or bodies is None:
            return name  # what is not there, is told when the environment is built
        from rlcli.sim.names import NameProblem, match

        names = self.names(sensor["entity"], "body")
        if names is None:
            return name
        try:
            seen = [names[place] for place in sorted(match(sensor["bodies"], names, "body"))]
            places = match([bodies] if isinstance(bodies, str) else list(bodies), seen, "body")
        except NameProblem as problem:
            self.report.problem(key, str(problem), problem.hint)
            return name
        chosen = [seen[place] for place in (places if preserve else sorted(places))]
        if chosen == seen:
            return name
        part = {**sensor, "bodies": chosen}
        words = [bodies] if isinstance(bodies, str) else list(bodies)
        wanted = base = "_".join([name, *(re.sub(r"\W+", "_", word).strip("_") for word in words[:2])])
        number = 1
        while self.sensors.get(wanted, part) != part:
            number += 1
            wanted = f"{base}_{number}"
        self.sensors[wanted] = part
        return wanted

    # --- parts ---

    def _entity(self, name: str, item: Node, spawn: Node | None) -> None:
        item.skip("class_type", "prim_path", "collision_group", "debug_vis", "articulation_root_prim_path")
        item.skip("actuator_value_resolution_debug_print")
        prim = str(item.data.get("prim_path") or "")
        self.prims[name] = prim.rstrip("/").rsplit("/", 1)[-1]
        path = spawn.get("usd_path", spawn.get("asset_path")) if spawn else None
        path = self._given.get(name, path)
        shape = _SHAPES.get(_kind(spawn.data.get("func"))) if spawn and path is None else None
        if spawn and shape:
            self.entities[name] = self._shape(item, spawn, shape)
            return
        if not isinstance(path, str):
            shape = _kind(spawn.data.get("func")) if spawn else "nothing"
            what = f"is made of {shape}; give it a model: spawn=UsdFileCfg(usd_path='{name}.xml')"
            self.report.problem(item.key, what)
            return
        spawn = spawn or item.node("spawn")
        try:
            model = assets.mjcf_of(path)
        except TaskError as error:
            self.report.problem((*spawn.key, "usd_path"), error.message, error.hint)
            return
        spawn.skip("func", "visible", "copy_from_source", "activate_contact_sensors", "semantic_tags")
        spawn.skip("visual_material_path", "variants")
        self._open(name, model, (*spawn.key, "usd_path"))
        entity: dict[str, Any] = {"model": model}
        init = item.node("init_state")
        position = [_float(v) for v in init.get("pos", (0.0, 0.0, 0.0))]
        rotation = [_float(v) for v in init.get("rot", (1.0, 0.0, 0.0, 0.0))]
        if any(position):
            entity["pos"] = position
        if rotation != [1.0, 0.0, 0.0, 0.0]:
            entity["quat"] = rotation
        self._init_joints(name, entity, init)
        self._init_velocity(entity, init)
        factor = item.get("soft_joint_pos_limit_factor", 1.0)
        if factor != 1.0:
            entity["soft_joint_pos_limit_factor"] = _float(factor)
        self._actuators(name, entity, item.node("actuators"))
        self.entities[name] = entity

    def _shape(self, item: Node, spawn: Node, shape: str) -> dict[str, Any]:
        """A single geom; a rigid object moves freely, an asset stands."""
        size = spawn.get("size") or [spawn.get(key) for key in ("radius", "height") if spawn.get(key) is not None]
        made: dict[str, Any] = {"shape": shape, "size": [_float(v) for v in size]}
        rigid, mass = spawn.data.get("rigid_props") or {}, spawn.node("mass_props")
        if rigid.get("kinematic_enabled"):
            made["mocap"] = True
        elif _kind(item.data.get("class_type")) == "RigidObject" or rigid:
            made["free"] = True
        for key in ("mass", "density"):
            if mass.get(key):
                made[key] = _float(mass.get(key))
        if "physics_material" in spawn:
            friction = self._friction(spawn.node("physics_material"))
            made |= {} if friction is None else {"friction": friction}
        look = spawn.node("visual_material")
        if look.get("diffuse_color") is not None:
            made["color"] = [_float(v) for v in look.get("diffuse_color")]
        init = item.node("init_state")
        made["pos"] = [_float(v) for v in init.get("pos", (0.0, 0.0, 0.0))]
        made["quat"] = [_float(v) for v in init.get("rot", (1.0, 0.0, 0.0, 0.0))]
        self._init_velocity(made, init)
        spawn.skip("func", "visible", "semantic_tags", "copy_from_source", "activate_contact_sensors", "axis")
        spawn.skip("visual_material_path", "physics_material_path", "visual_material", "collision_props")
        return made

    def _open(self, name: str, model: str, key: Key) -> None:
        import mujoco

        from rlcli.registry import model_file
        from rlcli.sim.scene import name_all

        try:
            spec = mujoco.MjSpec.from_file(str(model_file(self.root, model)))
            name_all(spec)
            compiled = spec.compile()
        except (ValueError, TaskError):
            return  # the scene says what is wrong with it
        scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        joints = [j for j in range(compiled.njnt) if compiled.jnt_type[j] in scalar]
        dofs = [int(compiled.jnt_dofadr[j]) for j in joints]
        names = [compiled.joint(j).name for j in joints]
        driven = {
            compiled.joint(int(compiled.actuator_trnid[a, 0])).name: compiled.actuator(a).name
            for a in range(compiled.nu)
            if compiled.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        }
        self._models[name] = {
            "joint": names,
            "body": [compiled.body(b).name for b in range(1, compiled.nbody)],
            "damping": dict(zip(names, compiled.dof_damping[dofs].tolist(), strict=True)),
            "armature": dict(zip(names, compiled.dof_armature[dofs].tolist(), strict=True)),
            "friction_loss": dict(zip(names, compiled.dof_frictionloss[dofs].tolist(), strict=True)),
            "qpos": {n: float(compiled.qpos0[compiled.jnt_qposadr[j]]) for n, j in zip(names, joints, strict=True)},
            "driven": set(driven),
            "actuators": driven,
            "geoms": [
                (compiled.geom(g).name, compiled.body(int(compiled.geom_bodyid[g])).name) for g in range(compiled.ngeom)
            ],
        }

    def _init_joints(self, name: str, entity: dict[str, Any], init: Node) -> None:
        made: dict[str, Any] = {}
        model = self._models.get(name)
        for key in ("joint_pos", "joint_vel"):
            wanted = {str(k): _float(v) for k, v in (init.get(key) or {}).items()}
            if model is not None and not model["joint"]:
                continue
            rest = model["qpos"] if model is not None and key == "joint_pos" else {}
            if model is not None and all(self._says(name, pattern, value, rest) for pattern, value in wanted.items()):
                continue
            made[key] = wanted
        if made:
            entity["init"] = made

    def _init_velocity(self, entity: dict[str, Any], init: Node) -> None:
        for key in ("lin_vel", "ang_vel"):
            value = [_float(v) for v in init.get(key, (0.0, 0.0, 0.0))]
            if any(value):
                entity.setdefault("init", {})[key] = value

    def _says(self, entity: str, pattern: str, value: float, known: Mapping[str, float]) -> bool:
        """Whether the joints that a pattern matches have this value already."""
        matched = [n for n in self.names(entity, "joint") or [] if re.fullmatch(pattern, n)]
        return bool(matched) and all(known.get(n, 0.0) == value for n in matched)

    def _actuators(self, name: str, entity: dict[str, Any], actuators: Node) -> None:
        """Implicit actuators become settings of joints, explicit ones actuator models."""
        drives: list[tuple[str, dict[str, Any]]] = []
        models: dict[str, Any] = {}
        for group, item in actuators.nodes():
            kind = _kind(item.get("class_type"))
            patterns = item.need("joint_names_expr") or [".*"]
            patterns = [patterns] if isinstance(patterns, str) else list(patterns)
            limit = item.get("effort_limit_sim")
            limit = item.get("effort_limit") if limit is None else limit
            item.skip("effort_limit")
            for key in ("velocity_limit", "velocity_limit_sim"):
                if kind != "DCMotor" or key != "velocity_limit":
                    item.say("ignored", key, "MuJoCo's joints have no speed limit")
            for key in ("dynamic_friction", "viscous_friction"):
                item.say("ignored", key, "friction and damping say it")
            common = {"armature": item.get("armature"), "friction_loss": item.get("friction")}
            gains = {"stiffness": item.get("stiffness"), "damping": item.get("damping")}
            if kind == "ImplicitActuator":
                values = {**gains, **common, "effort_limit": limit}
            elif kind in ("IdealPDActuator", "DCMotor", "DelayedPDActuator"):
                own = {"joints": self.ordered(name, "joint", patterns, False, item.key)}
                own["kind"] = "dc_motor" if kind == "DCMotor" else "pd"
                own |= {k: v for k, v in gains.items() if v is not None}
                limits = item.get("effort_limit")
                if limits is not None:
                    own["effort_limit"] = limits
                if kind == "DCMotor":
                    own["saturation_effort"] = item.need("saturation_effort")
                    own["velocity_limit"] = item.need("velocity_limit")
                if kind == "DelayedPDActuator":
                    own["delay"] = [item.get("min_delay", 0), item.get("max_delay", 0)]
                models[group] = _numbers(own)
                values = common
            else:
                self.report.problem(item.key, f"an actuator of kind '{kind}' has no counterpart")
                continue
            for setting, value in values.items():
                if isinstance(value, Mapping):
                    drives += [(str(pattern), {setting: _float(number)}) for pattern, number in value.items()]
                elif value is not None:
                    drives += [(pattern, {setting: _float(value)}) for pattern in patterns]
        if models:
            entity["actuators"] = models
        self._drives[name] = drives

    def _joint_settings(self, name: str, driven: Mapping[str, str]) -> dict[str, Any]:
        model: dict[str, Any] = self._models.get(name) or {"joint": []}
        joints: dict[str, dict[str, Any]] = {}
        for pattern, values in self._drives.get(name, []):
            joints.setdefault(pattern, {}).update(values)
        made: dict[str, Any] = {}
        for pattern, values in joints.items():
            matched = [n for n in model["joint"] if re.fullmatch(pattern, n)]
            stiffness = values.pop("stiffness", 0.0)
            kinds = {driven.get(n, "") for n in matched}
            if stiffness and kinds == {"effort"}:
                values = {"stiffness": stiffness, **values}
                why = "a spring about the MJCF's rest position, beside the effort"
                self.report.entries[("scene", name, "actuators", pattern, "stiffness")] = ("approximated", why)
            elif stiffness:
                values = {"actuator": "position", "kp": stiffness, "kv": values.pop("damping", 0.0), **values}
            elif kinds == {"velocity"} and values.get("damping"):
                values = {"actuator": "velocity", "kv": values.pop("damping"), **values}
            if matched:
                for key in ("damping", "armature", "friction_loss"):
                    if key in values and all(model[key][n] == values[key] for n in matched):
                        del values[key]
                if not stiffness and not any(n in driven or n in model["driven"] for n in matched):
                    values.pop("effort_limit", None)  # nothing drives them
            if values:
                order = ("damping", "armature", "friction_loss", "effort_limit")
                made[pattern] = {
                    k: values[k] for k in sorted(values, key=lambda k: order.index(k) if k in order else -1)
                }
        return made

    def _ground(self, item: Node, spawn: Node) -> dict[str, Any]:
        item.skip("prim_path", "collision_group", "debug_vis", "class_type", "init_state")
        spawn.skip("func", "visible", "color", "usd_path", "semantic_tags", "copy_from_source")
        size = spawn.get("size", (100.0, 100.0))
        made = {"size": _float(max(size))}
        material = spawn.node("physics_material")
        friction = self._friction(material)
        return made if friction is None else made | {"friction": friction}

    def _friction(self, material: Node) -> float | None:
        """Sliding friction, if it is not Isaac Lab's default."""
        material.skip("func", "restitution_combine_mode", "friction_combine_mode", "improve_patch_friction")
        material.skip("compliant_contact_stiffness", "compliant_contact_damping")
        static = material.get("static_friction", 0.5)
        dynamic = material.get("dynamic_friction", 0.5)
        if static != dynamic:
            material.say("approximated", "static_friction", "MuJoCo has one friction, the dynamic one")
        if not material.data.get("restitution"):
            material.skip("restitution")
        else:
            material.say("ignored", "restitution", "MuJoCo's contacts have solref")
        return None if dynamic == 0.5 else _float(dynamic)

    def _light(self, item: Node, spawn: Node, lights: dict[str, Any]) -> None:
        item.skip("prim_path", "collision_group", "debug_vis", "class_type")
        spawn.skip("func", "prim_type", "visible", "semantic_tags", "copy_from_source", "normalize", "exposure")
        spawn.skip("enable_color_temperature", "color_temperature", "texture_format", "visible_in_primary_ray", "angle")
        kind = {"DomeLight": "dome", "DistantLight": "distant"}.get(str(spawn.data.get("prim_type")))
        if kind is None:
            self.report.entries[item.key] = ("ignored", "lights are dome and distant")
            return
        made = {
            "color": [_float(v) for v in spawn.get("color", (1.0, 1.0, 1.0))],
            "intensity": _float(spawn.get("intensity", 1000.0)),
        }
        rotation = [_float(v) for v in item.node("init_state").get("rot", (1.0, 0.0, 0.0, 0.0))]
        if kind == "distant":
            made["direction"] = _turned(rotation)
        item.node("init_state").skip("pos", "rot")
        if kind in lights:
            self.report.entries[item.key] = ("ignored", f"there is one {kind} light")
            return
        lights[kind] = made

    def _terrain(self, item: Node, made: dict[str, Any]) -> Any:
        item.skip("class_type", "prim_path", "collision_group", "debug_vis", "num_envs", "env_spacing", "usd_path")
        item.skip("visual_material", "use_terrain_origins")
        kind = item.get("terrain_type", "generator")
        friction = self._friction(item.node("physics_material"))
        extra = {} if friction is None else {"friction": friction}
        if kind == "plane":
            item.skip("terrain_generator", "max_init_terrain_level")
            return {"size": 100.0, **extra}
        generator = item.node("terrain_generator")
        if kind != "generator" or not generator.data:
            item.say("approximated", "terrain_type", "a plane")
            return {"size": 100.0, **extra}
        made["terrain"] = self._generated(generator) | extra
        start = item.get("max_init_terrain_level")
        if start is not None:
            made["terrain"]["max_start_level"] = start
        return None

    def _generated(self, node: Node) -> dict[str, Any]:
        """A generator of patches, as height fields."""
        made: dict[str, Any] = {
            "kind": "generator",
            "rows": node.get("num_rows", 1),
            "columns": node.get("num_cols", 1),
            "patch": [_float(v) for v in node.get("size", (8.0, 8.0))],
            "border": _float(node.get("border_width", 0.0)),
            "resolution": _float(node.get("horizontal_scale", 0.1)),
            "difficulty": [_float(v) for v in node.get("difficulty_range", (0.0, 1.0))],
            "curriculum": bool(node.get("curriculum", False)),
            "sub_terrains": {},
        }
        if node.get("seed") is not None:
            made["seed"] = node.get("seed")
        node.skip("class_type", "color_scheme", "use_cache", "cache_dir", "vertical_scale", "slope_threshold")
        node.skip("border_height")
        for name, patch in node.node("sub_terrains").nodes():
            made["sub_terrains"][name] = self._patch(patch)
        return made

    def _patch(self, node: Node) -> dict[str, Any]:
        """One kind of ground, by the name of the function that makes it."""
        name = _kind(node.get("function"))
        made: dict[str, Any] = {"proportion": _float(node.get("proportion", 1.0))}
        node.skip(
            "size", "horizontal_scale", "vertical_scale", "slope_threshold", "border_width", "flat_patch_sampling"
        )
        kind = _PATCHES.get(name)
        if kind is None:
            known = f"known are {listing(_PATCHES)}"
            self.report.entries[node.key] = ("approximated", f"flat: '{name}' has no counterpart; {known}")
            return {"kind": "flat", **made}
        inverted = "inverted" in name or bool(node.data.get("inverted"))
        node.skip("inverted")
        made["kind"] = kind
        if kind != "flat" and kind not in ("noise", "waves") and "platform_width" in node:
            made["platform"] = _float(node.get("platform_width"))
        ranges = {"slope": "slope_range", "waves": "amplitude_range", "stairs": "step_height_range"}
        ranges |= {"obstacles": "obstacle_height_range", "grid": "grid_height_range", "noise": "noise_range"}
        ours = {"slope": "slope", "waves": "amplitude", "stairs": "step_height"}.get(kind, "height")
        if kind in ranges and ranges[kind] in node:
            made[ours] = [_float(v) for v in node.get(ranges[kind])]
        for theirs, key in _PATCH_KEYS.get(kind, {}).items():
            if theirs in node:
                made[key] = _numbers(node.get(theirs))
        if kind in ("slope", "stairs") and inverted:
            made["inverted"] = True
        return made

    def _sensor(self, kind: str, item: Node) -> None:
        item.skip("class_type", "debug_vis", "visualizer_cfg", "track_pose", "max_contact_data_count_per_prim")
        prim = str(item.get("prim_path") or "")
        parts = [part for part in prim.split("/") if part]
        entity = next((e for e, last in self.prims.items() if last in parts), None)
        if entity is None:
            self.report.problem(
                (*item.key, "prim_path"), f"'{prim}' lies in no entity", f"there are {listing(self.prims)}"
            )
            return
        inside = parts[parts.index(self.prims[entity]) + 1 :]
        body = inside[-1] if inside else None
        item.say("ignored", "update_period", "sensors are updated in every step") if item.data.get(
            "update_period"
        ) else item.skip("update_period")
        if kind == "ContactSensor":
            self.sensors[item.key[-1]] = self._contact(item, entity, body)
        elif kind == "RayCaster":
            self.sensors[item.key[-1]] = self._rays(item, entity, body)
        else:
            self.report.entries[item.key] = ("ignored", "an MJCF's own sensors are read with `sensor_data`")

    def _contact(self, item: Node, entity: str, body: str | None) -> dict[str, Any]:
        item.skip("track_air_time", "track_contact_points", "track_friction_forces")
        made: dict[str, Any] = {"kind": "contact", "entity": entity, "bodies": body or ".*"}
        history = item.get("history_length", 0)
        if history > 1:
            made["history"] = history
        threshold = item.get("force_threshold", 1.0)
        made["force_threshold"] = _float(threshold)
        if item.data.get("filter_prim_paths_expr"):
            item.say("ignored", "filter_prim_paths_expr", "write `against` of the contact sensor")
        else:
            item.skip("filter_prim_paths_expr")
        return made

    def _rays(self, item: Node, entity: str, body: str | None) -> dict[str, Any]:
        item.skip("mesh_prim_paths", "history_length", "attach_yaw_only", "drift_range", "ray_cast_drift_range")
        pattern, offset = item.node("pattern_cfg"), item.node("offset")
        made: dict[str, Any] = {"kind": "rays", "entity": entity}
        if body is not None:
            made["body"] = body
        if _kind(pattern.get("func")) != "grid_pattern":
            self.report.problem(pattern.key, "only patterns.GridPatternCfg has a counterpart")
        pattern.skip("ordering")
        made["pattern"] = _numbers(
            {
                "size": list(pattern.get("size", (1.0, 1.0))),
                "resolution": pattern.get("resolution", 0.1),
                "direction": list(pattern.get("direction", (0.0, 0.0, -1.0))),
            }
        )
        made["offset"] = [_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
        if list(offset.data.get("rot", (1, 0, 0, 0))) != [1, 0, 0, 0]:
            offset.say("ignored", "rot", "give the pattern's direction")
        else:
            offset.skip("rot")
        yaw = item.data.get("attach_yaw_only")
        made["alignment"] = "yaw" if yaw else item.get("ray_alignment", "base")
        item.skip("ray_alignment")
        distance = item.get("max_distance", 1e6)
        made["max_distance"] = _float(distance)
        return made


# --- terms ---


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
            kind = _kind(item.data.get("class_type"))
            what = next((word for word in ("effort", "velocity") if word in kind.lower()), "position")
            for pattern in [wanted] if isinstance(wanted, str) else wanted or []:
                for joint in self.scene.names(entity, "joint") or []:
                    if re.fullmatch(pattern, joint):
                        self.joints_driven.setdefault(entity, {})[joint] = what

    def action(self, node: Node) -> dict[str, Any]:
        """An action term."""
        kind = _kind(node.get("class_type"))
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
                made[key.removesuffix("_expr")] = {str(k): _float(v) for k, v in dict(value).items()}
            elif key == "controller" and isinstance(value, Mapping):
                made |= self._controller(node.node(key))
            elif key == "body_offset":
                offset = node.node(key)
                made["offset_pos"] = [_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
                made["offset_quat"] = [_float(v) for v in offset.get("rot", (1.0, 0.0, 0.0, 0.0))]
            elif value is None or (key in known and not known[key].required and _same(value, known[key].default)):
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
        return made | ({"damping": _float(given["lambda_val"])} if "lambda_val" in given else {})

    def _affine(self, key: str, value: Any, joints: Any) -> Any:
        if key == "clip" and isinstance(value, Mapping) and len(value) == 1:
            (pattern, bounds), *_ = value.items()
            if pattern == ".*" or [pattern] == joints:
                return [_float(v) for v in bounds]
        return _numbers(value)

    def command(self, node: Node) -> dict[str, Any]:
        """A command term."""
        kind = _kind(node.get("class_type"))
        entry = COMMANDS.get(kind)
        if entry is None or entry.name is None:
            near = did_you_mean(kind, COMMANDS) or f"there are {listing(COMMANDS)}"
            self.report.problem(node.key, f"no command is known for '{kind}'", near)
            return {"func": "null_command"}
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
                    if known[ours].required or not _same(given, known[ours].default):
                        made[ours] = _numbers(given)
        node.skip("debug_vis", "heading_command", "goal_pose_visualizer_cfg", "current_pose_visualizer_cfg")
        node.skip("goal_vel_visualizer_cfg", "current_vel_visualizer_cfg", "ranges")
        if node.data.get("heading_command") is False:
            for key in ("heading", "heading_stiffness", "rel_heading"):
                made.pop(key, None)
        if kind == "NormalVelocityCommand":
            made |= {"mean": _triple(ranges, "mean_vel"), "std": _triple(ranges, "std_vel")}
            made["zero_prob"] = _triple(ranges, "zero_prob")
        return made

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
        return {"func": "stages", "address": f"rewards.{reward}.weight", "steps": [steps], "values": [_float(weight)]}

    def _common(self, section: str, node: Node) -> dict[str, Any]:
        """What all terms of a section have."""
        made: dict[str, Any] = {}
        if section == "rewards":
            made["weight"] = _float(node.need("weight"))
        elif section == "terminations":
            if node.get("time_out", False):
                made["time_out"] = True
        elif section == "events":
            made["mode"] = node.need("mode")
            if made["mode"] == "prestartup":
                made["mode"] = "startup"
                node.say("approximated", "mode", "startup")
            if "interval_range_s" in node and made["mode"] == "interval":
                made["interval_range_s"] = [_float(v) for v in node.get("interval_range_s")]
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
            kind = _kind(noise.get("class_type"))
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
            made["clip"] = [_float(v) for v in clip]
        if scale is not None:
            made["scale"] = _numbers(scale)
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
                made |= _numbers(target(value))
            elif value is not None or (target in known and known[target].required):
                made[target] = _numbers(value)
        if command is not None and command.required and command.name not in made:
            made[command.name] = "base_velocity"  # some of Isaac Lab's terms know it by that name alone
        return made

    def _ratios(self, params: Node, ratios: Mapping[str, float]) -> Any:
        """Gear ratios as shares of the largest one, a joint each; 1 for a joint that is not named."""
        from rlcli.sim.names import NameProblem, match_values

        names = self.scene.names("robot", "joint")
        largest = max([*ratios.values(), 1.0 if ".*" not in ratios else 0.0])
        if names is None or set(ratios) == {".*"}:
            return 1.0
        try:
            found = match_values(ratios, names, "joint")
        except NameProblem as problem:
            self.report.problem((*params.key, "gear_ratio"), str(problem), problem.hint)
            return 1.0
        return [_float((1.0 if ratio is None else ratio) / largest) for ratio in found]

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
        from rlcli.isaaclab.terms import entity_data, key_of, own_term

        common = self._common(section, node)
        if isinstance(function, MdpFunction) or (name is not None and name.split(".")[0] == "isaaclab"):
            near = did_you_mean(str(name), builtin_terms(section))
            self.report.problem((*node.key, "func"), f"no {section.rstrip('s')} term '{name}'", near)
            return {"func": str(name), **common}
        values = {key: params.get(key) for key in params.data}
        if isinstance(function, str):
            return {"func": self._stub(section, function, values, node)} | common | self.stubs[_short(function)][1]
        entities = frozenset(key for key, value in values.items() if is_entity(value))
        made: dict[str, Any] = {}
        for key, value in values.items():
            if key in entities:
                try:
                    made[key_of(key)] = entity_data(value if isinstance(value, Mapping) else vars(value))
                except ValueError as error:
                    self.report.problem((*params.key, key), str(error))
            else:
                made[key_of(key)] = _numbers(value)
        return {"func": own_term(function, section, entities, tuple(values)), **common, **made}

    def _stub(self, section: str, function: str, values: Mapping[str, Any], node: Node) -> str:
        """Note a function whose code is not here, with parameters in rlcli's form."""
        made: dict[str, Any] = {}
        for key, value in values.items():
            if not is_entity(value):
                made[key] = _numbers(value)
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


def _short(function: str) -> str:
    return function.rpartition(":")[2].rpartition(".")[2] or function.rpartition(":")[2]


_SHAPES = {
    "spawn_cuboid": "box",
    "spawn_sphere": "sphere",
    "spawn_cylinder": "cylinder",
    "spawn_capsule": "capsule",
}
_PATCHES = {
    "flat_terrain": "flat",
    "random_uniform_terrain": "noise",
    "pyramid_sloped_terrain": "slope",
    "wave_terrain": "waves",
    "discrete_obstacles_terrain": "obstacles",
    "stepping_stones_terrain": "stones",
    "pyramid_stairs_terrain": "stairs",
    "inverted_pyramid_stairs_terrain": "stairs",
    "random_grid_terrain": "grid",
}
_PATCH_KEYS = {
    "noise": {"downsampled_scale": "spacing"},
    "waves": {"num_waves": "count"},
    "obstacles": {"obstacle_width_range": "width", "num_obstacles": "count"},
    "stones": {"stone_width_range": "width", "stone_distance_range": "gap"},
    "stairs": {"step_width": "step_width"},
    "grid": {"grid_width": "cell"},
}
_THEIRS = ("isaaclab", "omni.isaac.lab", "mdp.")
"""How the modules begin whose functions the table knows."""


def is_entity(value: Any) -> bool:
    """Whether a parameter is a `SceneEntityCfg`, or one as a dict."""
    if isinstance(value, SceneEntityCfg):
        return True
    return isinstance(value, Mapping) and "name" in value and ("joint_names" in value or "body_names" in value)


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


def _kind(value: Any) -> str:
    """The last word of a class or function, given as such or as `module:Name`."""
    if value is None or is_missing(value):
        return ""
    name = value if isinstance(value, str) else getattr(value, "__name__", type(value).__name__)
    return name.rpartition(":")[2].rpartition(".")[2] or name.rpartition(":")[2]


def _noise(node: Node) -> dict[str, Any]:
    operation = node.get("operation", "add")
    made: dict[str, Any] = {} if operation == "add" else {"operation": "set" if operation == "abs" else operation}
    node.skip("func")
    if "n_min" in node.data:
        return {"kind": "uniform", "low": _numbers(node.get("n_min")), "high": _numbers(node.get("n_max")), **made}
    if "std" in node.data:
        return {"kind": "gaussian", "mean": _numbers(node.get("mean", 0.0)), "std": _numbers(node.get("std")), **made}
    return {"kind": "constant", "value": _numbers(node.get("bias", node.get("value", 0.0))), **made}


def _modifier(node: Node) -> dict[str, Any]:
    kind, params = _kind(node.get("func")), node.node("params")
    if kind == "scale":
        return {"kind": "scale", "factor": _numbers(params.get("multiplier"))}
    if kind == "bias":
        return {"kind": "bias", "offset": _numbers(params.get("value"))}
    if kind == "clip":
        return {"kind": "clip", "bounds": _numbers(params.get("bounds"))}
    if kind == "DigitalFilter":
        return {"kind": "digital_filter", "a": _numbers(node.get("A")), "b": _numbers(node.get("B"))}
    if kind == "Integrator":
        return {"kind": "integrator"}
    node.report.problem(node.key, f"no modifier is known for '{kind}'")
    return {"kind": "integrator"}


def _triple(ranges: Node, name: str) -> list[float]:
    return [_float(v) for v in ranges.get(name, (0.0, 0.0, 0.0))]


def _turned(quat: list[float]) -> list[float]:
    """Straight down, rotated. -> direction"""
    w, x, y, z = quat
    return [-2.0 * (x * z + w * y), -2.0 * (y * z - w * x), -(1.0 - 2.0 * (x * x + y * y))]


def _neutral(key: str, value: Any) -> bool:
    """Whether a setting that has no counterpart changes nothing."""
    return {"scale": 1.0, "offset": 0.0}.get(key) == value or value is False or value == "" or key == "use_zero_offset"


def _numbers(value: Any) -> Any:
    """Tuples as lists, without infinities."""
    if isinstance(value, Mapping):
        return {str(key): _numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_numbers(item) for item in value]
    if isinstance(value, float) and math.isinf(value):
        return math.copysign(1e9, value)
    return value


def _float(value: Any) -> Any:
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _empty(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(_empty(item) for item in value.values())
    return (
        value is None or is_missing(value) or value is False or value in ("", slice(None)) or value == [] or value == ()
    )


def _same(value: Any, default: Any) -> bool:
    if isinstance(value, list | tuple) and isinstance(default, list | tuple):
        return len(value) == len(default) and all(_same(a, b) for a, b in zip(value, default, strict=True))
    return bool(value == default)


__all__ = ["Node", "Report", "SceneReader", "Terms", "agent", "task"]
