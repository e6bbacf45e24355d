"""Construction of an environment's simulation: engine, entities, actuators, sensors, terrain, start state.

The constructor of `VecEnv` calls `build_simulation`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.config.schema import InitialStateConfig
from rlcli.errors import ConfigError
from rlcli.managers.term_binding import Binder
from rlcli.scene.actuators import ActuatorModel
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem
from rlcli.scene.scene import Scene
from rlcli.scene.sensors import Sensor, make_sensors
from rlcli.scene.terrain import Terrain
from rlcli.sim.engine import Engine, open_engine
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import rotate_inverse
from rlcli.sim.state_cache import SimData

__all__ = ["grid"]
"""Names of this module for use by plugins and other code; the other names are used by `VecEnv` alone."""


@dataclass(frozen=True, slots=True)
class Simulation:
    """Parts of an environment that are built from its compiled scene; `VecEnv` has attributes of the same names."""

    engine: Engine
    data: SimData
    entities: dict[str, Entity]
    actuators: dict[str, ActuatorModel]
    sensors: dict[str, Sensor]
    default_state: dict[str, Tensor]
    origins: Tensor
    terrain: Terrain | None


def open_scene(resolved: Resolved) -> Scene:
    """Return the scene of a task, before it is compiled."""
    config, source = resolved.task, resolved.source
    return Scene(config.scene, config.sim, source.root, installed=source.distribution is not None)


def build_simulation(scene: Scene, binder: Binder, device: torch.device, seed: int, streams: Tensor) -> Simulation:
    """Compile a scene and build its simulation, in the default state.

    Args:
        scene: the scene, with all parts that the task adds to the MJCF.
        binder: resolver of names in the task's configuration; it collects a problem for each name that the model does
            not have.
        device: device of the engine.
        seed: seed of the terrain's random numbers.
        streams: index of the random stream of each environment. (num_envs,) int64

    Raises:
        ConfigError: if a model file is missing or does not compile; names cannot be looked up then.
    """
    task = binder.resolved.task
    for problem in scene.problems:
        binder.add_problem(problem.path, str(problem), problem.hint)
    if any(problem.path[-1] == "model" for problem in scene.problems):
        binder.raise_problems()
    scene.spec.visual.global_.offwidth = task.viewer.width
    scene.spec.visual.global_.offheight = task.viewer.height
    try:
        model = scene.compile(on_cpu=device.type == "cpu")
    except ConfigError:
        # the cause comes first: without the entity's model, names of joints are not found either
        found, binder.problems = binder.problems, []
        for problem in scene.broken_models():
            binder.add_problem(problem.path, str(problem), problem.hint)
        binder.problems += found
        binder.raise_problems()
        raise
    engine = open_engine(model, task.scene.num_envs, task.sim, device=str(device))
    data = SimData(engine)
    entities = _make_entities(scene, binder, engine, data)
    actuators = _make_actuators(entities, binder)
    sensors = make_sensors(scene.sensors, data, entities)
    default_state = _default_state(engine, entities)
    engine.set_default_state(**default_state)
    engine.reset(_select_all(engine))
    data.refresh()
    origins = torch.zeros(task.scene.num_envs, 3, device=device)
    terrain = None
    if task.scene.terrain is not None and scene.ground is not None:
        terrain = Terrain(scene.ground, task.scene.terrain, origins, seed, streams.numpy(force=True))
    return Simulation(engine, data, entities, actuators, sensors, default_state, origins, terrain)


def grid(num_envs: int, spacing: float) -> Tensor:
    """Return the origins of environments on a square grid around the world's origin. (num_envs, 3) [m]"""
    rows = math.ceil(math.sqrt(num_envs))
    index = torch.arange(num_envs)
    xy = torch.stack([index // rows, index % rows], dim=1).float() - (rows - 1) / 2
    return torch.cat([xy * spacing, torch.zeros(num_envs, 1)], dim=1)


def _make_entities(scene: Scene, binder: Binder, engine: Engine, data: SimData) -> dict[str, Entity]:
    entities = {}
    for name, config in scene.config.entities.items():  # including entities that a direct task has added
        try:
            entities[name] = Entity(name, config, engine, data)
        except NameProblem as problem:
            binder.add_problem(("scene", "entities", name, "init"), str(problem), problem.hint)
            default = config.model_copy(update={"init": InitialStateConfig()})  # continue, to find further problems
            entities[name] = Entity(name, default, engine, data)
    return entities


def _make_actuators(entities: dict[str, Entity], binder: Binder) -> dict[str, ActuatorModel]:
    actuators = {}
    for entity in entities.values():
        for name, config in entity.config.actuators.items():
            try:
                model = ActuatorModel(name, config, entity)
            except NameProblem as problem:
                path = ("scene", "entities", entity.name, "actuators", name)
                binder.add_problem(path, str(problem), problem.hint)
                continue
            entity.actuators.append(model)
            actuators[f"{entity.name}.{name}"] = model
    return actuators


def _default_state(engine: Engine, entities: dict[str, Entity]) -> dict[str, Tensor]:
    qpos, qvel = torch.tensor(engine.model.qpos0), torch.zeros(engine.model.nv, dtype=torch.float64)
    for entity in entities.values():
        qpos[entity.qpos_columns.cpu()] = entity.data.default_joint_pos[0].double().cpu()
        qvel[entity.dof_columns.cpu()] = entity.data.default_joint_vel[0].double().cpu()
        if entity.is_floating:
            _, dof = entity.floating()
            root = entity.data.default_root_state[:1].double().cpu()
            local = rotate_inverse(root[:, 3:7], root[:, 10:])  # a free joint's angular velocity is in the body frame
            linear = root[:, 7:10]
            if entity.config.velocity_point == "com":
                state = entity.data.default_root_state[:1]
                linear = linear - entity.com_velocity(state[:, 3:7], local.to(state)).double().cpu()
            qvel[dof : dof + 6] = torch.cat([linear, local], dim=1)[0]
    return {"qpos": qpos, "qvel": qvel}


def _select_all(engine: Engine) -> Selection:
    """Return a selection of all environments; its seed and counters are 0: do not draw random numbers from it."""
    mask = torch.ones(engine.num_envs, dtype=torch.bool, device=engine.device)
    counters = torch.zeros(engine.num_envs, dtype=torch.int64, device=engine.device)
    selection = engine.select(mask, 0, engine.as_field(counters))
    assert selection is not None
    return selection
