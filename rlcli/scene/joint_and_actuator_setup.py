"""Write joint settings and actuators into the model of a scene, before the model is compiled.

The settings are those of the section `joints` of an entity. Actuators are added if terms need them and the MJCF does
not have them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from rlcli.config.schema import EntityConfig, JointConfig
from rlcli.scene.names import NameProblem, SceneProblem, match, search

_KNOWN_ACTUATORS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtGain.mjGAIN_FIXED))
"""Transmission, dynamics and gain types that rlcli's motor, position and velocity actuators can have."""


@dataclass(frozen=True, slots=True)
class ActuatorNeed:
    """Actuators that an action term needs: their kind, and the joints that they drive."""

    entity: str
    """Name of the entity."""
    joints: str | list[str]
    """Names or regular expressions of the joints."""
    kind: str
    """motor, position or velocity."""
    path: tuple[str, ...]
    """Key of the term in the configuration."""


class SceneJoints:
    """Writer of joint settings and actuators into the model of a scene, for the hinges and slides of its entities.

    Args:
        spec: specification of the scene.
        entities: configuration of each entity.
        problems: list to which problems of the configuration are added.
    """

    def __init__(self, spec: mujoco.MjSpec, entities: Mapping[str, EntityConfig], problems: list[SceneProblem]) -> None:
        self._spec = spec
        self._entities = entities
        self._problems = problems

    def add_actuators(self, needs: Iterable[ActuatorNeed]) -> None:
        """Add the actuators that action terms need and the MJCF does not have."""
        for need in needs:
            if need.entity not in self._entities:
                continue  # binding the term reports an unknown entity
            names = self._joint_names(need.entity)
            with contextlib.suppress(NameProblem):  # binding the term reports an unknown joint
                models = self._entities[need.entity].actuators.values()
                modelled = {names[p] for model in models for p in match(model.joints, names, "joint")}
                for position in match(need.joints, names, "joint"):
                    if names[position] not in modelled:
                        self._add_actuator(need.entity, names[position], need.kind)

    def add_motors(self) -> None:
        """Add a motor to every hinge and slide joint that has no actuator, so that a direct task can apply efforts."""
        driven = {actuator.target for actuator in self._spec.actuators}
        for entity in self._entities:
            for joint in self._joint_names(entity):
                if f"{entity}/{joint}" not in driven:
                    self._add_actuator(entity, joint, "motor")

    def override(self, name: str, entity: EntityConfig, *, degrees: bool) -> None:
        """Write the entity's settings `joints` into the model.

        Args:
            name: name of the entity.
            entity: configuration of the entity.
            degrees: whether the entity's MJCF has angles in degrees instead of radians.
        """
        if not entity.joints:
            return  # looking through the joints of the whole scene would take long in a scene of many entities
        joints, names = self._scalar_joints(name), self._joint_names(name)
        for pattern, change in entity.joints.items():
            for position in self._match(("scene", "entities", name, "joints", pattern), pattern, names):
                _override(joints[position], change, degrees=degrees)
                self._set_gains_and_limits(joints[position].name, change)
                if change.actuator is not None:
                    self._add_actuator(name, names[position], change.actuator)

    def add_motors_of_actuator_models(self, name: str, entity: EntityConfig) -> None:
        """Replace the actuators of every joint that an actuator model drives by one motor without limits."""
        if not entity.actuators:
            return
        names = self._joint_names(name)
        owner: dict[str, str] = {}
        for key, config in entity.actuators.items():
            path = ("scene", "entities", name, "actuators", key, "joints")
            for joint in [names[position] for position in self._match(path, config.joints, names)]:
                if joint in owner:
                    self._problems.append(
                        SceneProblem(path, f"joint '{joint}' belongs to '{owner[joint]}' already; remove it from one")
                    )
                    continue
                owner[joint] = key
                target = f"{name}/{joint}"
                for actuator in [a for a in self._spec.actuators if a.target == target]:
                    self._spec.delete(actuator)
                motor = self._spec.add_actuator(name=target, target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
                motor.set_to_motor()

    def _match(self, path: tuple[str, ...], patterns: str | list[str], names: list[str]) -> list[int]:
        """Return the indices of the names that match; for a wrong pattern, add a problem at `path` and return []."""
        try:
            return match(patterns, names, "joint")
        except NameProblem as problem:
            self._problems.append(SceneProblem(path, str(problem), problem.hint))
            return []

    def _set_gains_and_limits(self, joint: str, change: JointConfig) -> None:
        """Write the gains and the effort limit in `change` to the actuators of a joint."""
        for actuator in self._spec.actuators:
            if actuator.target != joint or actuator.trntype != mujoco.mjtTrn.mjTRN_JOINT:
                continue
            if change.effort_limit is not None:
                _limit_effort(actuator, change.effort_limit)
            kind = actuator_kind(actuator)
            if kind == "position" and change.kp is not None:
                actuator.gainprm[0], actuator.biasprm[1] = change.kp, -change.kp
            if kind == "velocity" and change.kv is not None:
                actuator.gainprm[0] = change.kv
            if kind in ("position", "velocity") and change.kv is not None:
                actuator.biasprm[2] = -change.kv

    def _add_actuator(self, entity: str, joint: str, kind: str) -> None:
        target = f"{entity}/{joint}"
        if any(a.target == target and actuator_kind(a) == kind for a in self._spec.actuators):
            return
        settings = joint_settings(self._entities[entity], joint)
        used_names = {actuator.name for actuator in self._spec.actuators}
        name = target if target not in used_names else f"{target}_{kind}"
        actuator = self._spec.add_actuator(name=name, target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if kind == "motor":
            actuator.set_to_motor()
        elif kind == "position":
            if settings.kp is None:
                message = f"joint '{joint}' needs a position actuator, but has no gain kp"
                hint = f"add joints: {{{joint}: {{kp: ..., kv: ...}}}}"
                self._problems.append(SceneProblem(("scene", "entities", entity, "joints"), message, hint))
                return
            actuator.set_to_position(kp=settings.kp, kv=settings.kv or 0.0)
        else:
            actuator.set_to_velocity(kv=settings.kv if settings.kv is not None else 1.0)
        if settings.effort_limit is not None:
            _limit_effort(actuator, settings.effort_limit)

    def _scalar_joints(self, entity: str) -> list[mujoco.MjsJoint]:
        scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        return [j for j in self._spec.joints if j.name.startswith(f"{entity}/") and j.type in scalar]

    def _joint_names(self, entity: str) -> list[str]:
        return [joint.name.removeprefix(f"{entity}/") for joint in self._scalar_joints(entity)]


def joint_settings(entity: EntityConfig, joint: str) -> JointConfig:
    """Return the settings of a joint from `joints` of its entity; if several patterns match, later ones win."""
    merged: dict[str, object] = {}
    for pattern, change in entity.joints.items():
        with contextlib.suppress(NameProblem):  # an invalid pattern: reported where the settings are applied
            if pattern == joint or search(pattern, [joint], "joint"):
                merged.update(change.model_dump(exclude_none=True))
    return JointConfig.model_validate(merged)


def model_actuator_kind(model: mujoco.MjModel, actuator: int) -> str:
    """Return the kind of an actuator of a compiled model: motor, position, velocity or other."""
    return actuator_kind(model.actuator(actuator))


def actuator_kind(actuator: Any) -> str:
    """Return the kind of an actuator of an MjSpec or of a compiled model: motor, position, velocity or other."""
    kinds = (actuator.trntype, actuator.dyntype, actuator.gaintype, actuator.biastype)
    # in a compiled model these are arrays of one element
    *known, bias = (int(np.asarray(kind).item()) for kind in kinds)
    gain, biases = actuator.gainprm[0], actuator.biasprm
    if tuple(known) != _KNOWN_ACTUATORS:
        return "other"
    if bias == int(mujoco.mjtBias.mjBIAS_NONE):
        return "motor"
    if bias == int(mujoco.mjtBias.mjBIAS_AFFINE):  # biasprm: 0, -kp, -kv (position); 0, 0, -kv (velocity)
        if biases[1] == -gain != 0:
            return "position"
        if biases[1] == 0 and biases[2] == -gain != 0:
            return "velocity"
    return "other"


def _override(joint: mujoco.MjsJoint, change: JointConfig, *, degrees: bool) -> None:
    for key in ("damping", "stiffness", "armature", "friction_loss"):
        value, attribute = getattr(change, key), key.replace("_", "")
        if value is not None:
            current = getattr(joint, attribute)
            # in MuJoCo 4 the value is a list of polynomial coefficients, the linear one first
            if isinstance(current, np.ndarray):
                current[:] = 0.0
                current[0] = value
            else:
                setattr(joint, attribute, value)
    if change.range is not None:
        # an MjSpec keeps angles in the unit of its MJCF; those of the configuration are in radians
        unit = 180.0 / np.pi if degrees and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
        joint.range = [unit * end for end in change.range]
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE


def _limit_effort(actuator: mujoco.MjsActuator, effort: float) -> None:
    force = effort / (abs(actuator.gear[0]) or 1.0)  # MuJoCo limits the force before the gear, `effort` after it
    actuator.forcerange = [-force, force]
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
