"""Class `Scene`, which builds a task's MuJoCo model from the configuration.

It attaches robots and objects, adds ground, lights, sensors and terrain, and compiles the model.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import mujoco

from rlcli.config.schema import EntityConfig, SceneConfig, SimConfig, TerrainConfig
from rlcli.errors import ConfigError, Problem, one_line
from rlcli.machine.memory import memory_error
from rlcli.scene.avoid_sparse_newton import avoid_sparse_newton
from rlcli.scene.entity_spec import checked_models, entity_spec, frame_of_start_pose, write_masses
from rlcli.scene.ground_and_lights import add_ground_plane, add_lights, add_materials
from rlcli.scene.joint_and_actuator_setup import SceneJoints
from rlcli.scene.name_elements import name_all
from rlcli.scene.names import SceneProblem
from rlcli.scene.sensor_builder import SensorBuilder, SensorSpec
from rlcli.scene.terrain import Ground, add_ground, make_ground, terrain_problems
from rlcli.scene.untrusted_mjcf import MUJOCO_ERRORS
from rlcli.sim.quiet_mujoco import quiet_mujoco

_OPTIONS = (
    "integrator", "cone", "jacobian", "solver", "tolerance", "ls_tolerance", "noslip_tolerance", "iterations",
    "ls_iterations", "noslip_iterations", "ccd_iterations", "ccd_tolerance", "impratio", "density", "viscosity",
    "wind", "magnetic", "disableflags", "enableflags", "disableactuator",
)  # fmt: skip
"""Physics options that the scene takes from the first MJCF."""

_log = logging.getLogger(__name__)

View = TypeVar("View")


class Scene:
    """Scene of a task while its MuJoCo model is built from the configuration.

    `spec` is the MjSpec of the model, which a direct task may change in `set_up_scene`, before `compile` is called.
    `problems` collects the mistakes in the configuration.

    Args:
        config: the section `scene` of the task.
        sim: the section `sim` of the task.
        root: the task's folder, which has its models.
        installed: whether the task is installed: the files of an installed task are trusted.
    """

    def __init__(self, config: SceneConfig, sim: SimConfig, root: Path, *, installed: bool = False) -> None:
        quiet_mujoco()  # when a model is attached, MuJoCo logs each option that differs from the scene's
        self.config = config.model_copy(update={"entities": dict(config.entities)})
        self.sim = sim
        self.root = root.resolve()
        self.installed = installed
        self.spec = mujoco.MjSpec()
        self.spec.copy_during_attach = True
        self.problems: list[SceneProblem] = []
        self.views: list[object] = []
        self.sensors: dict[str, SensorSpec] = {}
        self.ground: Ground | None = None
        self.joints = SceneJoints(self.spec, self.config.entities, self.problems)
        self._models, problems = checked_models(config.entities, self.root, installed=installed)
        self.problems += problems
        for name, entity in config.entities.items():
            if entity.model is None or name in self._models:
                self._attach(name, entity)
        self._set_options()
        if config.terrain is not None:
            self._add_terrain(config.terrain)
        elif config.ground is not None:
            add_ground_plane(self.spec, config.ground)
        add_lights(self.spec, config.lights)
        self._add_sensors()

    def add(self, view: View) -> View:
        """Register a view such as an `ArticulationView`; the environment connects the view after compilation."""
        self.views.append(view)
        return view

    def compile(self, *, on_cpu: bool = True) -> mujoco.MjModel:
        """Compile the scene to an MjModel, for the CPU engine or (`on_cpu` false) for MuJoCo Warp.

        Raises:
            ConfigError: if MuJoCo cannot compile the model.
            MachineError: if memory is too small.
        """
        try:
            # MuJoCo warns about options of the MJCF that `sim` overrides
            with warnings.catch_warnings(action="ignore"):
                model = self.spec.compile()
        except MUJOCO_ERRORS as error:
            if too_little := memory_error(error):
                raise too_little from None
            message = f"MuJoCo cannot compile the model: {one_line(error)}"
            raise ConfigError([Problem("scene", "", message)]) from None
        if on_cpu:
            avoid_sparse_newton(self.spec, model)
        return model

    def broken_models(self) -> Iterator[SceneProblem]:
        """Compile the model of each entity by itself, and yield a problem, with the file, for each model that fails.

        After a failed `compile`, this shows which model is the cause.
        """
        for name, checked in self._models.items():
            try:
                entity_spec(name, self.config.entities[name], checked, compiled=True)
            except SceneProblem as problem:
                yield problem

    def _attach(self, name: str, entity: EntityConfig) -> None:
        try:
            self.attach(name, entity, entity_spec(name, entity, self._models.get(name)))
        except SceneProblem as problem:
            self.problems.append(problem)

    def attach(self, name: str, entity: EntityConfig, child: mujoco.MjSpec) -> None:
        """Add an entity with the model `child` to the scene; `entity.model` is not read.

        Raises:
            SceneProblem: if MuJoCo cannot attach the model.
        """
        self.config.entities[name] = entity
        name_all(child)
        for body in [] if entity.gravity else child.bodies[1:]:
            body.gravcomp = 1.0
        if child.compiler.settotalmass > 0:
            write_masses(child)
        models = [other for other, config in self.config.entities.items() if config.model is not None]
        if name == next(iter(models), None):
            for option in _OPTIONS:
                if hasattr(child.option, option):
                    setattr(self.spec.option, option, getattr(child.option, option))
        # MuJoCo keeps the options of the scene, and would warn of each that differs in the model
        for option in dir(child.option):
            if not option.startswith("_"):
                setattr(child.option, option, getattr(self.spec.option, option))
        for key in list(child.keys):
            child.delete(key)  # a keyframe of one entity has a wrong size in a scene with several entities
        self.spec.memory = max(self.spec.memory, child.memory)
        pos, quat = frame_of_start_pose(child, entity)
        frame = self.spec.worldbody.add_frame(pos=pos, quat=quat)
        try:
            with warnings.catch_warnings(action="ignore"):
                self.spec.attach(child, prefix=f"{name}/", frame=frame)
        except MUJOCO_ERRORS as error:
            if too_little := memory_error(error):
                raise too_little from None
            message = f"MuJoCo cannot attach the model: {one_line(error)}"
            raise SceneProblem(("scene", "entities", name, "model"), message) from None
        self.joints.override(name, entity, degrees=bool(child.compiler.degree))
        self.joints.add_motors_of_actuator_models(name, entity)

    def _set_options(self) -> None:
        """Set the physics options of the task's section `sim`; they override the options of the MJCF."""
        option = self.spec.option
        option.timestep = self.sim.dt
        option.gravity = self.sim.gravity
        if option.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY) and any(self.sim.gravity):
            _log.warning(
                'scene: <flag gravity="disable"/> of the MJCF turns gravity off, so that sim.gravity has no effect;'
                " remove the flag, or set sim.gravity to [0, 0, 0]"
            )
        if self.sim.integrator is not None:
            option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{self.sim.integrator.upper()}")
        if self.sim.iterations is not None:
            option.iterations = self.sim.iterations
        if self.sim.ls_iterations is not None:
            option.ls_iterations = self.sim.ls_iterations

    def _add_terrain(self, config: TerrainConfig) -> None:
        found = list(terrain_problems(config, self.root))
        self.problems += [SceneProblem(("scene", "terrain", *path), text, hint) for path, text, hint in found]
        if not found:
            add_materials(self.spec)
            self.ground = make_ground(config, self.root)
            add_ground(self.spec, self.ground, "ground")

    def _add_sensors(self) -> None:
        builder = SensorBuilder(self.spec, self.config.entities, self.ground)
        for name, config in self.config.sensors.items():
            try:
                self.sensors[name] = builder.add(name, config)
            except SceneProblem as problem:
                self.problems.append(problem)
