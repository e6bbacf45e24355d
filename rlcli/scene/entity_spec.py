"""Create the model (MjSpec) of one robot or object, before it is attached to the scene.

The model comes from an MJCF file, which is checked before MuJoCo opens the file, or consists of a single shape.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.config.schema import EntityConfig
from rlcli.errors import MissingModelError, TaskError, one_line
from rlcli.registry.models import existing_model_file
from rlcli.scene.mjcf_safety_check import BadModel
from rlcli.scene.names import SceneProblem
from rlcli.scene.untrusted_mjcf import CheckedModel, ModelsTogether, check_mjcf, model_roots, open_mjcf

FloatArray = NDArray[np.float64]


def checked_models(
    entities: Mapping[str, EntityConfig], root: Path, *, installed: bool
) -> tuple[dict[str, CheckedModel], list[SceneProblem]]:
    """Check the MJCFs of a scene's entities, each by itself and all together, before MuJoCo opens any of them.

    Args:
        entities: the configurations of the entities.
        root: the task's folder.
        installed: whether the task is installed: the files of an installed task are trusted.

    Returns:
        The checked models by the name of the entity, and the problems. Shapes, and entities with a problem, have no
        model.

    Raises:
        MissingModelError: if the user has to provide a model.
    """
    found: dict[str, CheckedModel] = {}
    problems: list[SceneProblem] = []
    of_model: dict[str, CheckedModel] = {}
    together = ModelsTogether()
    for name, entity in entities.items():
        if (model := entity.model) is None:
            continue
        path = ("scene", "entities", name, "model")
        try:
            if model not in of_model:
                of_model[model] = _check_model(model, path, root, installed)
            together.add(of_model[model])
        except SceneProblem as problem:
            problems.append(problem)
        except BadModel as error:
            return {}, [*problems, _not_valid(path, model, error)]
        else:
            found[name] = of_model[model]
    try:
        together.compile_expensive()
    except BadModel as error:
        name = max(found, key=lambda name: found[name].cost.total)
        return {}, [*problems, _not_valid(("scene", "entities", name, "model"), entities[name].model, error)]
    return found, problems


def entity_spec(
    name: str, entity: EntityConfig, checked: CheckedModel | None, *, compiled: bool = False
) -> mujoco.MjSpec:
    """Return the model of an entity: its MJCF, or a body with one geom.

    Args:
        name: name of the entity.
        entity: configuration of the entity.
        checked: the checked MJCF of the entity; None for a shape.
        compiled: whether to compile the model as well, to check that MuJoCo accepts it.

    Raises:
        SceneProblem: if the MJCF cannot be read.
    """
    if checked is None:
        return _shape_model(entity)
    try:
        return open_mjcf(checked, compiled=compiled)
    except BadModel as error:
        raise _not_valid(("scene", "entities", name, "model"), entity.model, error) from None


def frame_of_start_pose(child: mujoco.MjSpec, entity: EntityConfig) -> tuple[FloatArray, FloatArray]:
    """Return the position [m] and quaternion (w, x, y, z) of the frame in the scene to which a model is attached.

    In this frame, the root of the model has the start pose of the configuration (`pos`, `quat`).
    """
    pos, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    element: Any = child.worldbody.first_body()
    while element is not None:  # `element` is the root, then each <frame> element around it
        pos, quat = _product(element.pos, _orientation(element), pos, quat)
        element = element.frame
    start_pos = pos if entity.pos is None else np.array(entity.pos)
    start_quat = quat if entity.quat is None else np.array(entity.quat) / np.linalg.norm(entity.quat)
    inverse_pos, inverse_quat = np.empty(3), np.empty(4)
    mujoco.mju_negPose(inverse_pos, inverse_quat, pos, quat)
    return _product(start_pos, start_quat, inverse_pos, inverse_quat)


def write_masses(child: mujoco.MjSpec) -> None:
    """Compile a model, and write the computed mass and inertia of every body into its MjSpec.

    The MJCF's setting `settotalmass` would be lost when the model is attached to a scene.
    """
    with warnings.catch_warnings(action="ignore"):  # MuJoCo has deprecated the attribute, but models still use it
        model = child.compile()
    for body in child.bodies[1:]:
        compiled = model.body(body.name)
        body.explicitinertial = True
        body.fullinertia[:] = np.nan
        body.mass, body.inertia = float(compiled.mass[0]), compiled.inertia
        body.ipos, body.iquat = compiled.ipos, compiled.iquat
    child.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    child.compiler.settotalmass = -1.0


def _orientation(element: Any) -> FloatArray:
    """Return the orientation of a body or frame of an MjSpec as a quaternion; the MJCF may have Euler angles."""
    quat = np.array(element.quat)
    if element.alt.type != mujoco.mjtOrientation.mjORIENTATION_QUAT:
        compiler = element.compiler
        quat = np.array(mujoco.MjSpec.resolve_orientation(compiler.degree, compiler.eulerseq, element.alt))
    unit: FloatArray = quat / np.linalg.norm(quat)
    return unit


def _product(pos: FloatArray, quat: FloatArray, pos2: FloatArray, quat2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the product of two poses: pose 2, which is given in the frame of pose 1, in the frame of pose 1's parent.

    Positions are (3,) [m], quaternions (4,) w, x, y, z.
    """
    product = np.empty(3), np.empty(4)
    mujoco.mju_mulPose(*product, pos, quat, pos2, quat2)
    return product


def _check_model(model: str, path: tuple[str, ...], root: Path, installed: bool) -> CheckedModel:
    """Find and check the MJCF of an entity. `path` is the key of the model in the configuration, for messages."""
    try:
        file = existing_model_file(root, model)
    except MissingModelError:
        raise
    except TaskError as error:
        raise SceneProblem(path, error.message, error.hint) from None
    try:
        return check_mjcf(file, model_roots(root, model), installed=installed or ":" in model)
    except BadModel as error:
        raise _not_valid(path, model, error) from None


def _not_valid(path: tuple[str, ...], model: str | None, error: BadModel) -> SceneProblem:
    return SceneProblem(path, f"'{model}' is not a valid MJCF: {one_line(error)}")


def _shape_model(entity: EntityConfig) -> mujoco.MjSpec:
    """Return the model of an entity with `shape`: one body with one geom."""
    assert entity.shape is not None
    assert entity.size is not None
    child = mujoco.MjSpec()
    body = child.worldbody.add_body(name="body", mocap=entity.mocap)
    if entity.free:
        body.add_freejoint(name="root")
    kind = getattr(mujoco.mjtGeom, "mjGEOM_MESH" if entity.shape == "cone" else f"mjGEOM_{entity.shape.upper()}")
    half = [edge / 2 for edge in entity.size]  # MuJoCo's sizes are half lengths
    sizes = {
        "box": half,
        "sphere": entity.size,
        "cylinder": [entity.size[0], half[-1]],
        "capsule": [entity.size[0], half[-1]],
        "cone": [],
        "plane": [*half, 1.0],
    }
    size = sizes[entity.shape]
    if entity.shape == "cone":
        child.add_mesh(name="cone", uservert=_cone(entity.size[0], entity.size[1]).ravel().tolist())
    body.add_geom(
        name="geom", type=kind, size=[*size, *[0.0] * (3 - len(size))], rgba=[*entity.color, 1.0],
        friction=[entity.friction, 0.005, 0.0001], density=entity.density or 1000.0,
        mass=np.nan if entity.mass is None else entity.mass, quat=_FROM_Z[entity.axis],
        contype=int(entity.collides), conaffinity=int(entity.collides),
        meshname="cone" if entity.shape == "cone" else "",
    )  # fmt: skip
    return child


_FROM_Z = {"x": (0.5**0.5, 0.0, 0.5**0.5, 0.0), "y": (0.5**0.5, -(0.5**0.5), 0.0, 0.0), "z": (1.0, 0.0, 0.0, 0.0)}
"""Axis -> quaternion (w, x, y, z) that turns the z axis onto it."""


def _cone(radius: float, length: float, edges: int = 32) -> FloatArray:
    """Return the corners of a pyramid with the volume of a cone, whose tip is at z = length / 2. (edges + 1, 3) [m]"""
    angles = 2.0 * np.pi * np.arange(edges) / edges
    outer = radius * np.sqrt(angles[1] / np.sin(angles[1]))  # a polygon of this radius has the area of the circle
    ring = np.stack([outer * np.cos(angles), outer * np.sin(angles), np.full(edges, -length / 2.0)], axis=1)
    return np.concatenate([ring, [[0.0, 0.0, length / 2.0]]])
