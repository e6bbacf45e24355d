"""Isaac Lab's scene settings as a task's `scene:`; models are opened to know the names in them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.errors import TaskError, listing
from rlcli_isaaclab import assets
from rlcli_isaaclab.settings import Key, Node, as_float, kind_of, numbers


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
            "env_spacing": as_float(node.get("env_spacing", 4.0)),
        }
        node.skip("lazy_sensor_update", "replicate_physics", "filter_collisions", "clone_in_fabric")
        ground: Any = None
        lights: dict[str, Any] = {}
        later: list[tuple[str, Node]] = []
        for name, item in node.nodes():
            kind, spawn = kind_of(item.data.get("class_type")), item.node("spawn") if "spawn" in item else None
            shape = kind_of(spawn.data.get("func")) if spawn else ""
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
        if not self.entities and not self.report.problems:
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
        if wanted is None or isinstance(wanted, str):
            return wanted
        wanted = list(wanted)
        names = self.names(entity, kind)
        if names is None or len(wanted) < 2 or preserve:
            return wanted
        from rlcli.scene.names import NameProblem, match

        try:
            return [names[p] for p in sorted(match(wanted, names, kind))]
        except NameProblem as problem:
            self.report.problem(key, str(problem), problem.hint)
            return wanted

    def geoms_of(self, entity: str, bodies: list[str], key: Key) -> list[str]:
        """The geoms of bodies, by names or regexes of the bodies."""
        from rlcli.scene.names import NameProblem, match

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
        from rlcli.scene.names import NameProblem, match

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
        from rlcli.scene.names import NameProblem, match

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
        shape = _SHAPES.get(kind_of(spawn.data.get("func"))) if spawn and path is None else None
        if spawn and shape:
            self.entities[name] = self._shape(item, spawn, shape)
            return
        if not isinstance(path, str):
            shape = kind_of(spawn.data.get("func")) if spawn else "nothing"
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
        position = [as_float(v) for v in init.get("pos", (0.0, 0.0, 0.0))]
        rotation = [as_float(v) for v in init.get("rot", (1.0, 0.0, 0.0, 0.0))]
        if any(position):
            entity["pos"] = position
        if rotation != [1.0, 0.0, 0.0, 0.0]:
            entity["quat"] = rotation
        self._init_joints(name, entity, init)
        self._init_velocity(entity, init)
        factor = item.get("soft_joint_pos_limit_factor", 1.0)
        if factor != 1.0:
            entity["soft_joint_pos_limit_factor"] = as_float(factor)
        self._actuators(name, entity, item.node("actuators"))
        self.entities[name] = entity

    def _shape(self, item: Node, spawn: Node, shape: str) -> dict[str, Any]:
        """A single geom; a rigid object moves freely, an asset stands."""
        size = spawn.get("size") or [spawn.get(key) for key in ("radius", "height") if spawn.get(key) is not None]
        made: dict[str, Any] = {"shape": shape, "size": [as_float(v) for v in size]}
        rigid, mass = spawn.data.get("rigid_props") or {}, spawn.node("mass_props")
        if rigid.get("kinematic_enabled"):
            made["mocap"] = True
        elif kind_of(item.data.get("class_type")) == "RigidObject" or rigid:
            made["free"] = True
        for key in ("mass", "density"):
            if mass.get(key):
                made[key] = as_float(mass.get(key))
        if "physics_material" in spawn:
            friction = self._friction(spawn.node("physics_material"))
            made |= {} if friction is None else {"friction": friction}
        look = spawn.node("visual_material")
        if look.get("diffuse_color") is not None:
            made["color"] = [as_float(v) for v in look.get("diffuse_color")]
        init = item.node("init_state")
        made["pos"] = [as_float(v) for v in init.get("pos", (0.0, 0.0, 0.0))]
        made["quat"] = [as_float(v) for v in init.get("rot", (1.0, 0.0, 0.0, 0.0))]
        self._init_velocity(made, init)
        spawn.skip("func", "visible", "semantic_tags", "copy_from_source", "activate_contact_sensors", "axis")
        spawn.skip("visual_material_path", "physics_material_path", "visual_material", "collision_props")
        return made

    def _open(self, name: str, model: str, key: Key) -> None:
        import mujoco

        from rlcli.registry import model_file
        from rlcli.scene.entity_model import name_all
        from rlcli.scene.untrusted_mjcf import model_roots, read_mjcf

        try:
            spec = read_mjcf(model_file(self.root, model), model_roots(self.root, model))
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
            wanted = {str(k): as_float(v) for k, v in (init.get(key) or {}).items()}
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
            value = [as_float(v) for v in init.get(key, (0.0, 0.0, 0.0))]
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
            kind = kind_of(item.get("class_type"))
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
                models[group] = numbers(own)
                values = common
            else:
                self.report.problem(item.key, f"an actuator of kind '{kind}' has no counterpart")
                continue
            for setting, value in values.items():
                if isinstance(value, Mapping):
                    drives += [(str(pattern), {setting: as_float(number)}) for pattern, number in value.items()]
                elif value is not None:
                    drives += [(pattern, {setting: as_float(value)}) for pattern in patterns]
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
        made = {"size": as_float(max(size))}
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
        return None if dynamic == 0.5 else as_float(dynamic)

    def _light(self, item: Node, spawn: Node, lights: dict[str, Any]) -> None:
        item.skip("prim_path", "collision_group", "debug_vis", "class_type")
        spawn.skip("func", "prim_type", "visible", "semantic_tags", "copy_from_source", "normalize", "exposure")
        spawn.skip("enable_color_temperature", "color_temperature", "texture_format", "visible_in_primary_ray", "angle")
        kind = {"DomeLight": "dome", "DistantLight": "distant"}.get(str(spawn.data.get("prim_type")))
        if kind is None:
            self.report.entries[item.key] = ("ignored", "lights are dome and distant")
            return
        made = {
            "color": [as_float(v) for v in spawn.get("color", (1.0, 1.0, 1.0))],
            "intensity": as_float(spawn.get("intensity", 1000.0)),
        }
        rotation = [as_float(v) for v in item.node("init_state").get("rot", (1.0, 0.0, 0.0, 0.0))]
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
            "patch": [as_float(v) for v in node.get("size", (8.0, 8.0))],
            "border": as_float(node.get("border_width", 0.0)),
            "resolution": as_float(node.get("horizontal_scale", 0.1)),
            "difficulty": [as_float(v) for v in node.get("difficulty_range", (0.0, 1.0))],
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
        name = kind_of(node.get("function"))
        made: dict[str, Any] = {"proportion": as_float(node.get("proportion", 1.0))}
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
            made["platform"] = as_float(node.get("platform_width"))
        ranges = {"slope": "slope_range", "waves": "amplitude_range", "stairs": "step_height_range"}
        ranges |= {"obstacles": "obstacle_height_range", "grid": "grid_height_range", "noise": "noise_range"}
        ours = {"slope": "slope", "waves": "amplitude", "stairs": "step_height"}.get(kind, "height")
        if kind in ranges and ranges[kind] in node:
            made[ours] = [as_float(v) for v in node.get(ranges[kind])]
        for theirs, key in _PATCH_KEYS.get(kind, {}).items():
            if theirs in node:
                made[key] = numbers(node.get(theirs))
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
        made["force_threshold"] = as_float(threshold)
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
        if kind_of(pattern.get("func")) != "grid_pattern":
            self.report.problem(pattern.key, "only patterns.GridPatternCfg has a counterpart")
        pattern.skip("ordering")
        made["pattern"] = numbers(
            {
                "size": list(pattern.get("size", (1.0, 1.0))),
                "resolution": pattern.get("resolution", 0.1),
                "direction": list(pattern.get("direction", (0.0, 0.0, -1.0))),
            }
        )
        made["offset"] = [as_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
        if list(offset.data.get("rot", (1, 0, 0, 0))) != [1, 0, 0, 0]:
            offset.say("ignored", "rot", "give the pattern's direction")
        else:
            offset.skip("rot")
        yaw = item.data.get("attach_yaw_only")
        made["alignment"] = "yaw" if yaw else item.get("ray_alignment", "base")
        item.skip("ray_alignment")
        distance = item.get("max_distance", 1e6)
        made["max_distance"] = as_float(distance)
        return made


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


def _turned(quat: list[float]) -> list[float]:
    """Straight down, rotated. -> direction"""
    w, x, y, z = quat
    return [-2.0 * (x * z + w * y), -2.0 * (y * z - w * x), -(1.0 - 2.0 * (x * x + y * y))]
