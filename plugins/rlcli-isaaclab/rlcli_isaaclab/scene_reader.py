"""Reader of Isaac Lab's settings of a scene. It returns the section `scene:` of a task of rlcli."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.errors import ConfigError, TaskError, did_you_mean, listing
from rlcli_isaaclab.actuator_reader import JointSettings, add_joint_settings, read_actuators, settings_of
from rlcli_isaaclab.body_properties import read_body_properties
from rlcli_isaaclab.collection import entity_name
from rlcli_isaaclab.light_reader import read_light
from rlcli_isaaclab.missing_names import AbsentValue, reason_of
from rlcli_isaaclab.model_lookup import given_models, is_end_of, mjcf_of, model_hint
from rlcli_isaaclab.own_classes import note_own_class
from rlcli_isaaclab.sensor_reader import camera_kinds, filter_name, image_name, read_filters, read_sensor
from rlcli_isaaclab.settings import Key, Node, Report, as_float, base_kind, kind_of
from rlcli_isaaclab.shape_reader import SHAPES, read_root_velocity, read_shape
from rlcli_isaaclab.terrain_reader import read_ground, read_terrain


class SceneReader:
    """Reader of assets, lights, ground and sensors. It compiles the MJCF models to find names."""

    def __init__(self, node: Node, root: Path, models: Mapping[str, Any] | None = None) -> None:
        self.node, self.root, self.report = node, root, node.report
        self._asked = dict(models or {})
        self._given = given_models(root, self._asked)
        self._given_models = self._given.files
        self._paths: dict[str, str] = {}
        """Entity -> the path of its model in the task's files."""
        self.entities: dict[str, dict[str, Any]] = {}
        self.prims: dict[str, str] = {}
        """Entity -> the last part of its prim path."""
        self.sensors: dict[str, dict[str, Any]] = {}
        self.user_actuators: dict[tuple[str, str], Mapping[str, Any]] = {}
        """(entity, actuator group) -> settings of the groups whose actuator class is defined by the user."""
        self.has_terrain = False
        self.frames: dict[str, dict[str, Any] | None] = {}
        """Name -> settings of a frame transformer, or None for a light. Only the user's terms read them."""
        self._models: dict[str, Any] = {}
        self._joint_settings: dict[str, JointSettings] = {}
        self.driven_joints: dict[str, dict[str, str]] = {}
        """Entity -> joint -> the quantity that an action sets for the joint: effort, motor, velocity or position."""

    def read(self) -> dict[str, Any]:
        """Return the section `scene:` of the task.

        Raises:
            ConfigError: if the settings of an entity are missing.
        """
        self._require_assets()
        node = self.node
        config: dict[str, Any] = {
            "num_envs": node.get("num_envs", 1),
            "env_spacing": as_float(node.get("env_spacing", 4.0)),
        }
        node.mark_mapped("lazy_sensor_update", "replicate_physics", "filter_collisions", "clone_in_fabric")
        ground: Any = None
        lights: dict[str, Any] = {}
        sensors: list[tuple[str, Node]] = []
        own: list[tuple[str, Node]] = []
        for name, item in node.nodes():
            kind, is_own = base_kind(item.data)
            spawn = item.node("spawn") if "spawn" in item else None
            spawn_function = kind_of(spawn.data.get("func")) if spawn else ""
            if kind in ("Articulation", "RigidObject", "Multirotor"):
                self._read_entity(name, item, spawn)
            elif kind == "RigidObjectCollection":
                for part, content in item.node("rigid_objects").nodes():
                    self._read_entity(entity_name(name, part), content, content.node("spawn"))
            elif kind in ("DeformableObject", "SurfaceGripper"):
                reason, hint = reason_of(kind)
                self.report.problem(item.key, f"a {kind} cannot be used: {reason}", hint)
            elif kind == "TerrainImporter":
                ground = read_terrain(item, config)
            elif kind:
                sensors.append((kind, item))
            elif spawn_function == "spawn_ground_plane" and spawn:
                ground = read_ground(item, spawn)
            elif spawn_function == "spawn_light" and spawn:
                read_light(self.report, item, spawn, lights)
                self.frames[name] = None
            elif spawn:
                self._read_entity(name, item, spawn)
            else:
                self.report.entries[item.key] = ("ignored", "MuJoCo has no counterpart of this asset")
            own += [(kind, item)] * is_own
        # Sensors come last: their prim paths refer to entities that may be listed after them.
        for kind, item in sensors:
            sensor = read_sensor(kind, item, self.prims, self.frames)
            if sensor is not None:
                self.sensors[item.key[-1]] = sensor
            if sensor is not None and sensor["kind"] == "camera":
                for data in camera_kinds(item.data.get("data_types", ["rgb"]))[1:]:
                    self.sensors[image_name(item.key[-1], data)] = {**sensor, "data": data}
            if kind == "ContactSensor" and sensor is not None:
                for index, filtered in enumerate(read_filters(item, sensor, self.prims)):
                    self.sensors[filter_name(item.key[-1], index)] = filtered
        for kind, item in own:
            note_own_class(item, kind)
        config["ground"] = ground
        config["lights"] = lights
        if not self.entities and not self.report.problems:
            self.report.problem(
                node.key, "the scene has no robot or object; add an ArticulationCfg or a RigidObjectCfg"
            )
        config["entities"] = self.entities
        for name in self._asked.keys() - self.entities.keys() if not self.report.problems else ():
            if any(is_end_of(name, path) for path in self._paths.values()):
                continue
            if isinstance(self._asked[name], Mapping) and self._asked[name].get("optional"):  # of a mapping file
                self.report.entries[(f"--model {name}",)] = ("ignored", "the scene has no robot or object of this name")
                continue
            near = did_you_mean(name, self.entities) or f"robots and objects: {listing(self.entities)}"
            self.report.problem(node.key, f"--model {name}: the scene has no '{name}'", near)
        if self.sensors:
            config["sensors"] = self.sensors
        self.has_terrain = "terrain" in config
        return config

    def _require_assets(self) -> None:
        """Refuse entities whose settings are imported from `isaaclab_assets` if no folder has this package.

        Raises:
            ConfigError: with these mistakes only. Other settings refer to the missing entities, and would be reported
                as further mistakes.
        """
        missing = Report()
        for name, value in self.node.data.items():
            if isinstance(value, AbsentValue) and value.imported_at:
                file, asset = value.imported_at.rsplit(":", 2)[0], value.__name__
                message = f"no folder has isaaclab_assets, from which {file} imports {asset}"
                hint = "unzip it from Isaac Lab's wheel beside isaaclab_tasks, or set RLCLI_ISAACLAB to their folder"
                missing.problem((*self.node.key, str(name)), message, hint)
        if missing.problems:
            raise ConfigError(missing.problems)

    def add_joint_settings(self, driven: Mapping[str, Mapping[str, str]]) -> None:
        """Write `joints` of each entity, without the settings that its MJCF has already.

        Call this after the actions are read: the action that drives a joint decides how its stiffness is translated.

        Args:
            driven: entity -> joint -> the quantity that an action sets: effort, motor, velocity or position.
        """
        for name, entity in self.entities.items():
            model = self._models.get(name) or {"joint": []}
            settings = self._joint_settings.get(name, [])
            add_joint_settings(entity, settings, model, driven.get(name, {}), name, self.report)

    def integrator(self) -> dict[str, str]:
        """Return {"integrator": "implicitfast"} if a joint has a damping gain `kv`, otherwise {}.

        PhysX integrates the damping of joint drives implicitly. MuJoCo's Euler method diverges with large damping.
        """
        joints = [settings for entity in self.entities.values() for settings in entity.get("joints", {}).values()]
        return {"integrator": "implicitfast"} if any(settings.get("kv") for settings in joints) else {}

    def names(self, entity: str, kind: str) -> list[str] | None:
        """Return the names of an entity's joints or bodies, in the model's order; None if it has no model.

        `kind` is "joint" or "body".
        """
        model = self._models.get(entity)
        return None if model is None else model[kind]

    def is_fixed(self, entity: str) -> bool:
        """Return whether the model of an entity has a fixed base; False if the entity has no model."""
        return bool(self._models.get(entity, {}).get("fixed"))

    def order_names(self, entity: str, kind: str, wanted: Any, preserve: bool, key: Key) -> Any:
        """Return the names that `wanted` selects in the order that Isaac Lab gives them.

        This is the model's order, or the written order if `preserve`. `wanted` is returned unchanged if its order does
        not matter, or if a name matches nothing.
        """
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

    def geoms_of_bodies(self, entity: str, bodies: list[str], key: Key) -> list[str]:
        """Return the names of all geoms of the bodies whose names match `bodies`, names or regexes."""
        from rlcli.scene.names import NameProblem, match

        model = self._models.get(entity)
        if model is None:
            return [".*"]
        try:
            chosen = {model["body"][index] for index in match(bodies, model["body"], "body")}
        except NameProblem as problem:
            self.report.problem(key, str(problem), problem.hint)
            return []
        return [geom for geom, body in model["geoms"] if body in chosen]

    def gains_of_joints(self, entity: str, joints: list[str] | None) -> dict[str, Any]:
        """Return the elements of the model in which the stiffness and damping of joints are stored. None: all joints.

        Returns:
            kp: names of MuJoCo's actuators with a stiffness.
            kv: names of MuJoCo's actuators with a damping.
            damping: names of joints whose damping is a property of the joint, not of an actuator.
            explicit: names of joints whose efforts an actuator model of rlcli computes.
        """
        from rlcli.scene.names import NameProblem, match

        model = self._models.get(entity)
        if model is None:
            return {"kp": ".*", "kv": ".*"}
        names: list[str] = model["joint"]
        try:
            chosen = [names[index] for index in match(joints or ".*", names, "joint")]
            actuators = self.entities[entity].get("actuators", {}).values()
            explicit = [names[index] for actuator in actuators for index in match(actuator["joints"], names, "joint")]
        except NameProblem:
            return {"kp": ".*", "kv": ".*"}  # the environment reports wrong joint names of an actuator when it is built
        settings = self._joint_settings.get(entity, [])
        native = {n: settings_of(n, settings) for n in chosen if n not in explicit}
        damped = self.damped_joints(entity, self.driven_joints.get(entity, {}))
        kp = [model["actuators"].get(n, n) for n, values in native.items() if values.get("stiffness")]
        kv = [model["actuators"].get(n, n) for n, v in native.items() if v.get("stiffness") or v.get("damping")]
        return {
            "kp": kp,
            "kv": [n for n in kv if n not in damped],
            "damping": [n for n in native if n in damped],
            "explicit": [n for n in chosen if n in explicit],
        }

    def damped_joints(self, entity: str, driven: Mapping[str, str]) -> list[str]:
        """Return the joints for which an implicit actuator without stiffness is translated to joint damping.

        Args:
            entity: name of the entity.
            driven: joint -> the quantity that an action sets: effort, motor, velocity or position.
        """
        found = {n: settings_of(n, self._joint_settings.get(entity, [])) for n in self.names(entity, "joint") or []}
        passive = [n for n, values in found.items() if values.get("damping") and not values.get("stiffness")]
        return [n for n in passive if driven.get(n) != "velocity"]

    def sensor_of_bodies(self, name: str, bodies: Any, preserve: bool, key: Key) -> str:
        """Return the name of a contact sensor that measures only the given bodies of the sensor `name`.

        If `bodies` are all bodies of the sensor, return `name`; otherwise add a sensor if there is none with them.
        """
        sensor = self.sensors.get(name)
        if sensor is None or sensor["kind"] != "contact" or bodies is None:
            return name  # a missing sensor is reported when the environment is built
        from rlcli.scene.names import NameProblem, match

        names = self.names(sensor["entity"], "body")
        if names is None:
            return name
        try:
            covered = [names[index] for index in sorted(match(sensor["bodies"], names, "body"))]
            indices = match([bodies] if isinstance(bodies, str) else list(bodies), covered, "body")
        except NameProblem as problem:
            self.report.problem(key, str(problem), problem.hint)
            return name
        chosen = [covered[index] for index in (indices if preserve else sorted(indices))]
        if chosen == covered:
            return name
        part = {**sensor, "bodies": chosen}
        words = [bodies] if isinstance(bodies, str) else list(bodies)
        new_name = base = "_".join([name, *(re.sub(r"\W+", "_", word).strip("_") for word in words[:2])])
        number = 1
        while self.sensors.get(new_name, part) != part:
            number += 1
            new_name = f"{base}_{number}"
        self.sensors[new_name] = part
        return new_name

    def _read_entity(self, name: str, item: Node, spawn: Node | None) -> None:
        item.mark_mapped("class_type", "prim_path", "collision_group", "debug_vis", "articulation_root_prim_path")
        item.mark_mapped("actuator_value_resolution_debug_print", "allocation_matrix", "rotor_directions")
        item.mark_mapped("thruster_force_direction")  # Isaac Lab does not use it
        prim = str(item.data.get("prim_path") or "")
        self.prims[name] = prim.rstrip("/").rsplit("/", 1)[-1]
        path = spawn.get("usd_path", spawn.get("asset_path")) if spawn else None
        if isinstance(path, str):
            self._paths[name] = path
        path = self._given_models.get(name, path)
        shape = SHAPES.get(kind_of(spawn.data.get("func"))) if spawn and path is None else None  # a model overrides
        if spawn and shape:
            self.entities[name] = read_shape(item, spawn, shape)
            return
        several = spawn is not None and (
            bool(spawn.data.get("assets_cfg")) or isinstance(spawn.data.get("usd_path"), list)
        )
        if several and spawn and isinstance(path, str):
            item.report.entries[(*spawn.key, "assets_cfg")] = ("approximated", "one model in all environments")
        elif several:
            what = "the assets differ between environments, but MuJoCo has one model for all environments"
            self.report.problem(item.key, what, model_hint(name))
            return
        if not isinstance(path, str):
            found = f"`spawn` calls {kind_of(spawn.data.get('func'))}" if spawn else "`spawn` is not set"
            self.report.problem(item.key, f"no model: {found}", model_hint(name))
            return
        spawn = spawn or item.node("spawn")
        try:
            model = mjcf_of(path, self.root, self._given_models, name)
        except TaskError as error:
            self.report.problem((*spawn.key, "usd_path"), error.message, error.hint)
            return
        spawn.mark_mapped("func", "visible", "copy_from_source", "activate_contact_sensors", "semantic_tags")
        spawn.mark_mapped("visual_material_path", "variants")
        self._read_model(name, model)
        properties = read_body_properties(spawn, self._models.get(name, {}).get("fixed"))
        entity: dict[str, Any] = {"model": model, "velocity_point": "com", **properties}
        init = item.node("init_state")
        position = [as_float(v) for v in init.get("pos", (0.0, 0.0, 0.0))]
        rotation = [as_float(v) for v in init.get("rot", (1.0, 0.0, 0.0, 0.0))]
        root_position, root_rotation = self._models.get(name, {}).get("root") or (None, None)
        if position != root_position:
            entity["pos"] = position
        if rotation != root_rotation:
            entity["quat"] = rotation
        self._read_joint_state(name, entity, init)
        read_root_velocity(entity, init)
        factor = item.get("soft_joint_pos_limit_factor", 1.0)
        if factor != 1.0:
            entity["soft_joint_pos_limit_factor"] = as_float(factor)
        init.mark_mapped("rps")  # of a Multirotor, which reads it and its actuators when it is created
        self._joint_settings[name], explicit = read_actuators(
            item.node("actuators"),
            lambda patterns, group: self.order_names(name, "joint", patterns, False, group.key),
            self.names(name, "joint") or [],
            name,
            self._given.gains.get(name, {}),
            self.user_actuators,
        )
        if explicit:
            entity["actuators"] = explicit
        self.entities[name] = entity

    def _read_model(self, name: str, model: str) -> None:
        """Compile an entity's MJCF, and store the names and values that other settings refer to in `_models`."""
        import mujoco

        from rlcli.registry import model_file
        from rlcli.scene.name_elements import name_all
        from rlcli.scene.untrusted_mjcf import model_roots, read_mjcf

        try:
            spec = read_mjcf(model_file(self.root, model), model_roots(self.root, model))
            name_all(spec)
            compiled = spec.compile()
        except (ValueError, TaskError):
            return  # the check of the task's scene reports the mistake
        scalar_types = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        joints = [j for j in range(compiled.njnt) if compiled.jnt_type[j] in scalar_types]
        dofs = [int(compiled.jnt_dofadr[j]) for j in joints]
        names = [compiled.joint(j).name for j in joints]
        actuator_of_joint = {
            compiled.joint(int(compiled.actuator_trnid[a, 0])).name: compiled.actuator(a).name
            for a in range(compiled.nu)
            if compiled.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        }
        geoms = range(compiled.ngeom)
        self._models[name] = {
            "joint": names,
            "body": [compiled.body(b).name for b in range(1, compiled.nbody)],  # body 0 is the world
            "root": (compiled.body_pos[1].tolist(), compiled.body_quat[1].tolist()) if compiled.nbody > 1 else None,
            "fixed": not any(compiled.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_FREE) for j in range(compiled.njnt)),
            "damping": dict(zip(names, compiled.dof_damping[dofs].tolist(), strict=True)),
            "armature": dict(zip(names, compiled.dof_armature[dofs].tolist(), strict=True)),
            "friction_loss": dict(zip(names, compiled.dof_frictionloss[dofs].tolist(), strict=True)),
            "qpos": {n: float(compiled.qpos0[compiled.jnt_qposadr[j]]) for n, j in zip(names, joints, strict=True)},
            "driven": set(actuator_of_joint),
            "actuators": actuator_of_joint,
            "geoms": [(compiled.geom(g).name, compiled.body(int(compiled.geom_bodyid[g])).name) for g in geoms],
        }

    def _read_joint_state(self, name: str, entity: dict[str, Any], init: Node) -> None:
        """Write into `entity` the initial positions and velocities of joints that differ from those in the MJCF."""
        config: dict[str, Any] = {}
        model = self._models.get(name)
        for key in ("joint_pos", "joint_vel"):
            wanted = {str(k): as_float(v) for k, v in (init.get(key) or {}).items()}
            if model is not None and not model["joint"]:
                continue
            known = model["qpos"] if model is not None and key == "joint_pos" else {}
            same = [self._has_value(init, name, pattern, value, known) for pattern, value in wanted.items()]
            if model is not None and all(same):
                continue
            config[key] = wanted
        if config:
            entity["init"] = config

    def _has_value(self, init: Node, entity: str, pattern: str, value: float, known: Mapping[str, float]) -> bool:
        """Return whether all joints that a pattern matches have a value in `known` (joint name -> value, else 0)."""
        matched = self.report.matching([pattern], self.names(entity, "joint") or [], init.key)
        return bool(matched) and all(known.get(n, 0.0) == value for n in matched)
