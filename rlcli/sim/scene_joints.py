"""The joints of a scene's entities: what the configuration changes of them, and the actuators that they get."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from rlcli.config.schema import EntityConfig, JointConfig
from rlcli.sim.names import NameProblem, match
from rlcli.sim.scene_problem import SceneProblem


@dataclass(frozen=True, slots=True)
class ActuatorNeed:
    """An action term needs an actuator of a kind on some joints of an entity."""

    entity: str
    joints: str | list[str]
    kind: str
    path: tuple[str, ...]


class SceneJoints:
    """Hinges and slides of the entities that are attached so far.

    Args:
        spec: the scene.
        entities: the configuration of each entity.
        problems: what they do not fit is added here.
    """

    def __init__(self, spec: mujoco.MjSpec, entities: Mapping[str, EntityConfig], problems: list[SceneProblem]) -> None:
        self._spec = spec
        self._entities = entities
        self._problems = problems

    def add_actuators(self, needs: Iterable[ActuatorNeed]) -> None:
        """Add the actuators that are asked for and that the MJCF does not have."""
        for need in needs:
            if need.entity not in self._entities:
                continue  # the term's own binding says so
            names = [joint.name.removeprefix(f"{need.entity}/") for joint in self._of(need.entity)]
            try:
                models = self._entities[need.entity].actuators.values()
                modelled = {names[p] for model in models for p in match(model.joints, names, "joint")}
                for position in match(need.joints, names, "joint"):
                    if names[position] not in modelled:
                        self._actuate(need.entity, names[position], need.kind)
            except NameProblem:
                continue  # likewise

    def add_motors(self) -> None:
        """Give every hinge and slide joint without an actuator a motor: a direct task may set any effort."""
        driven = {actuator.target for actuator in self._spec.actuators}
        for entity in self._entities:
            for joint in self._of(entity):
                if joint.name not in driven:
                    self._actuate(entity, joint.name.removeprefix(f"{entity}/"), "motor")

    def override(self, name: str, entity: EntityConfig, *, degrees: bool) -> None:
        """Write what the entity's `joints` say into the model; `degrees`: the unit that its MJCF has angles in."""
        joints = self._of(name)
        names = [joint.name.removeprefix(f"{name}/") for joint in joints]
        for pattern, change in entity.joints.items():
            try:
                positions = match(pattern, names, "joint")
            except NameProblem as problem:
                self._problems.append(
                    SceneProblem(("scene", "entities", name, "joints", pattern), str(problem), problem.hint)
                )
                continue
            for position in positions:
                _override(joints[position], change, degrees=degrees)
                self._tune(joints[position].name, change)
                if change.actuator is not None:
                    self._actuate(name, names[position], change.actuator)

    def add_models(self, name: str, entity: EntityConfig) -> None:
        """Give the joints of actuator models a motor each, without limits of its own, in place of what they have."""
        names = [joint.name.removeprefix(f"{name}/") for joint in self._of(name)]
        owner: dict[str, str] = {}
        for key, config in entity.actuators.items():
            path = ("scene", "entities", name, "actuators", key)
            try:
                joints = [names[position] for position in match(config.joints, names, "joint")]
            except NameProblem as problem:
                self._problems.append(SceneProblem((*path, "joints"), str(problem), problem.hint))
                continue
            for joint in joints:
                if joint in owner:
                    message = f"joint '{joint}' is driven by '{owner[joint]}' already"
                    self._problems.append(SceneProblem((*path, "joints"), message))
                    continue
                owner[joint] = key
                target = f"{name}/{joint}"
                for actuator in [a for a in self._spec.actuators if a.target == target]:
                    self._spec.delete(actuator)
                motor = self._spec.add_actuator(name=target, target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
                motor.set_to_motor()

    def _tune(self, joint: str, change: JointConfig) -> None:
        """Gains and limits of the actuators that the joint has."""
        for actuator in self._spec.actuators:
            if actuator.target != joint or actuator.trntype != mujoco.mjtTrn.mjTRN_JOINT:
                continue
            if change.effort_limit is not None:
                _limit(actuator, change.effort_limit)
            kind = _spec_kind(actuator)
            if kind == "position" and change.kp is not None:
                actuator.gainprm[0], actuator.biasprm[1] = change.kp, -change.kp
            if kind == "velocity" and change.kv is not None:
                actuator.gainprm[0] = change.kv
            if kind in ("position", "velocity") and change.kv is not None:
                actuator.biasprm[2] = -change.kv

    def _actuate(self, entity: str, joint: str, kind: str) -> None:
        target = f"{entity}/{joint}"
        if any(a.target == target and _spec_kind(a) == kind for a in self._spec.actuators):
            return
        settings = joint_settings(self._entities[entity], joint)
        taken = {actuator.name for actuator in self._spec.actuators}
        name = target if target not in taken else f"{target}_{kind}"
        actuator = self._spec.add_actuator(name=name, target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if kind == "motor":
            actuator.set_to_motor()
        elif kind == "position":
            if settings.kp is None:
                self._problems.append(
                    SceneProblem(
                        ("scene", "entities", entity, "joints"),
                        f"joint '{joint}' needs a position actuator and no gain is given",
                        f"add joints: {{{joint}: {{kp: ..., kv: ...}}}}",
                    )
                )
                return
            actuator.set_to_position(kp=settings.kp, kv=settings.kv or 0.0)
        else:
            actuator.set_to_velocity(kv=settings.kv if settings.kv is not None else 1.0)
        if settings.effort_limit is not None:
            _limit(actuator, settings.effort_limit)

    def _of(self, entity: str) -> list[mujoco.MjsJoint]:
        scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        return [j for j in self._spec.joints if j.name.startswith(f"{entity}/") and j.type in scalar]


def joint_settings(entity: EntityConfig, joint: str) -> JointConfig:
    """What an entity's configuration says of a joint, later matches over earlier ones."""
    merged: dict[str, object] = {}
    for pattern, change in entity.joints.items():
        try:
            matched = bool(match(pattern, [joint], "joint"))
        except NameProblem:
            matched = False
        if matched:
            merged.update(change.model_dump(exclude_none=True))
    return JointConfig.model_validate(merged)


def actuator_kind(
    transmission: int, dynamics: int, gain: int, bias: int, gainprm: np.ndarray, biasprm: np.ndarray
) -> str:
    """motor, position, velocity or other, from an actuator's transmission, dynamics, gain and bias."""
    if transmission != int(mujoco.mjtTrn.mjTRN_JOINT) or gain != int(mujoco.mjtGain.mjGAIN_FIXED):
        return "other"
    if dynamics != int(mujoco.mjtDyn.mjDYN_NONE):
        return "other"
    if bias == int(mujoco.mjtBias.mjBIAS_NONE):
        return "motor"
    if bias == int(mujoco.mjtBias.mjBIAS_AFFINE):
        if biasprm[1] == -gainprm[0] != 0:
            return "position"
        if biasprm[1] == 0 and biasprm[2] == -gainprm[0] != 0:
            return "velocity"
    return "other"


def _spec_kind(a: mujoco.MjsActuator) -> str:
    return actuator_kind(int(a.trntype), int(a.dyntype), int(a.gaintype), int(a.biastype), a.gainprm, a.biasprm)


def _override(joint: mujoco.MjsJoint, change: JointConfig, *, degrees: bool) -> None:
    for key, attribute in (
        ("damping", "damping"),
        ("stiffness", "stiffness"),
        ("armature", "armature"),
        ("friction_loss", "frictionloss"),
    ):
        value = getattr(change, key)
        if value is not None:
            current = getattr(joint, attribute)
            if isinstance(current, np.ndarray):  # MuJoCo 4 has polynomial damping and stiffness: the linear term
                current[:] = 0.0
                current[0] = value
            else:
                setattr(joint, attribute, value)
    if change.range is not None:
        # a spec keeps angles in the unit of the MJCF it came from
        turn = 180.0 / np.pi if degrees and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
        joint.range = [turn * end for end in change.range]
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE


def _limit(actuator: mujoco.MjsActuator, effort: float) -> None:
    force = effort / (abs(actuator.gear[0]) or 1.0)  # MuJoCo's limit is before the gear, ours is on the joint
    actuator.forcerange = [-force, force]
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
