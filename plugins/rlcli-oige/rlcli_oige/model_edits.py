"""Changes of a robot's MJCF model that follow from the task's YAML, and from USD attributes that the task sets.

In OmniIsaacGymEnvs an actor is a robot or an object. A USD schema is a group of attributes, such as `DriveAPI`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

if TYPE_CHECKING:
    from rlcli_oige.stage import Prim

FRAME, FORCE, TORQUE = ".frame", ".joint_force", ".joint_torque"
"""Suffixes of the sites and sensors that measure joint forces."""


_STIFF = 10.0
"""A drive is stiff if its implicit inertia (dt kd + dt^2 kp) is more than this many times the inertia of the joint."""


def apply_schemas(prim: Prim, dt: float) -> bool:
    """Write the attributes of USD schemas to a model. Return whether a joint got a drive.

    Args:
        prim: the model's prim.
        dt: physics step [s].
    """
    driven = False
    for part in [prim, *prim.stage.parts.get(prim.prim_path, {}).values()]:
        values = {key: attribute.value for key, attribute in part.attributes.items() if attribute.value is not None}
        if part.is_joint():
            driven |= _apply_to_joint(prim, part.element, values, dt)
            continue
        bodies = [part.element] if part.is_body() else list(prim.child.bodies[1:]) if prim.child is not None else []
        for (schema, _, name), value in values.items():
            for body in bodies:
                _apply_to_body(prim, body, schema, name, value)
    return driven


def _apply_to_body(prim: Prim, body: Any, schema: str, name: str, value: Any) -> None:
    if name == "DisableGravity":
        body.gravcomp = 1.0 if value else 0.0
    elif name == "KinematicEnabled" and value:
        prim.settings["make_kinematic"] = True
    elif name == "EnabledSelfCollisions":
        prim.settings["enable_self_collisions"] = bool(value)
    elif name == "CollisionEnabled" and not value:
        for geom in body.geoms:
            geom.contype = geom.conaffinity = 0
    elif schema == "MassAPI" and name in ("Mass", "Density") and float(value) > 0.0:
        model = prim.child.compile()  # type: ignore[union-attr]
        mass = float(model.body_mass[model.body(body.name).id])
        for geom in body.geoms:
            if name == "Density":
                geom.density, geom.mass = float(value), np.nan
            elif np.isnan(geom.mass):
                geom.density *= float(value) / mass
            else:
                geom.mass *= float(value) / mass
        if body.explicitinertial and name == "Mass":
            body.inertia = np.asarray(body.inertia) * float(value) / mass
            body.mass = float(value)


def _apply_to_joint(prim: Prim, joint: Any, values: dict[tuple[str, str, str], Any], dt: float) -> bool:
    """Write drives, limits and armature of a joint. USD's angles are in degrees.

    PhysX integrates drives implicitly: (M + A) dv = dt (kp (target - q - dt v) - kd v) with A = dt kd + dt^2 kp.
    MuJoCo's Euler step of an actuator with damping kd + dt kp at a joint with armature A is the same equation. PhysX
    limits the force at the end of the step. MuJoCo limits the force at the start of the step, where the force of a
    stiff drive is much larger; so stiff drives get no limit.
    """
    hinge = joint.type == mujoco.mjtJoint.mjJNT_HINGE
    per_unit = 180.0 / math.pi if hinge else 1.0
    in_spec = 1.0 if not hinge or prim.child.compiler.degree else 1.0 / per_unit  # type: ignore[union-attr]
    for (schema, _, name), value in values.items():
        if name == "Armature":
            joint.armature = float(value)
        elif schema in ("RevoluteJoint", "PrismaticJoint", "LimitAPI") and name in ("LowerLimit", "Low"):
            joint.range = [float(value) * in_spec, joint.range[1]]
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        elif schema in ("RevoluteJoint", "PrismaticJoint", "LimitAPI") and name in ("UpperLimit", "High"):
            joint.range = [joint.range[0], float(value) * in_spec]
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    drive = {
        name: float(value) for (schema, _, name), value in values.items() if schema == "DriveAPI" and name != "Type"
    }
    if not drive:
        return False
    assert prim.child is not None
    of_joint = [a for a in prim.child.actuators if a.target == joint.name]
    is_position = [a for a in of_joint if float(a.biasprm[1]) != 0.0]
    old = (is_position or [None])[0]
    stiffness = drive["Stiffness"] * per_unit if "Stiffness" in drive else -float(old.biasprm[1]) if old else 0.0
    damping = drive["Damping"] * per_unit if "Damping" in drive else -float(old.biasprm[2]) if old else 0.0
    for actuator in of_joint:
        if "MaxForce" not in drive and actuator is old and actuator.forcerange[1] > 0:
            drive["MaxForce"] = float(actuator.forcerange[1])
        prim.child.delete(actuator)
    if stiffness == 0.0 and damping == 0.0:
        return False  # a task that sets efforts turns the drive off; the joint gets a motor
    actuator = prim.child.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.gainprm[0] = stiffness or damping  # without stiffness the control is a velocity
    actuator.biasprm[1], actuator.biasprm[2] = -stiffness, -(damping + dt * stiffness)
    implicit_inertia = dt * damping + dt**2 * stiffness
    stiff = implicit_inertia > _STIFF * _inertia(prim.child, joint.name)
    if stiff and "MaxForce" in drive:
        reason = "MuJoCo would limit the force before its implicit step, PhysX limits it after the step"
        prim.stage.note_ignored("DriveAPI.MaxForce of stiff drives", reason, lost=True)
    elif math.isfinite(drive.get("MaxForce", math.inf)):
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = [-drive["MaxForce"], drive["MaxForce"]]
    joint.armature += implicit_inertia
    return True


def _inertia(child: mujoco.MjSpec, joint: str) -> float:
    """Return the inertia of a joint in the default pose [kg m^2 or kg]."""
    model = child.compile()
    return float(model.dof_M0[model.joint(joint).dofadr[0]])


def apply_settings(prim: Prim, child: mujoco.MjSpec) -> None:
    """Apply the settings of an actor to its model, such as mass, density and collisions.

    Args:
        prim: the actor's prim, with its `settings`.
        child: the model, which is changed.
    """
    settings = prim.settings
    for geom in child.geoms:
        if settings.get("collisions") is False:
            geom.contype = geom.conaffinity = 0
        if settings.get("density", -1) not in (-1, None):
            geom.density, geom.mass = float(settings["density"]), np.nan  # NaN: MuJoCo computes the mass
    if settings.get("make_kinematic") in (True, 1):
        for body in child.worldbody.bodies:
            for joint in [j for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]:
                child.delete(joint)
            body.mocap = True
    if settings.get("disable_gravity") is True:
        for body in child.bodies[1:]:
            body.gravcomp = 1.0
    if settings.get("enable_self_collisions") in (False, 0):
        _disable_self_collisions(child)
    if settings.get("mass", -1) not in (-1, None):
        model = child.compile()
        factor = float(settings["mass"]) / float(np.sum(model.body_mass))
        for geom in child.geoms:
            if np.isnan(geom.mass):
                geom.density *= factor
            else:
                geom.mass *= factor
        for body in child.bodies[1:]:
            if body.explicitinertial:
                body.mass *= factor
                body.inertia = factor * np.asarray(body.inertia)


def _disable_self_collisions(child: mujoco.MjSpec) -> None:
    """Exclude contacts between all bodies of the model."""
    for number, body in enumerate(child.bodies[1:]):
        if not body.name:
            body.name = f"body_{number}"  # the name that an entity gives to a body without one
    bodies = [b for b in child.bodies[1:] if any(g.contype or g.conaffinity for g in b.geoms)]
    for number, first in enumerate(bodies):
        for second in bodies[number + 1 :]:
            collide = any(
                (a.contype & b.conaffinity) or (b.contype & a.conaffinity) for a in first.geoms for b in second.geoms
            )
            if collide:
                child.add_exclude(bodyname1=first.name, bodyname2=second.name)


def add_force_sensors(child: mujoco.MjSpec) -> None:
    """Add sensors of the force and torque between each body and its parent, in the body's frame."""
    for number, body in enumerate(child.bodies[1:]):
        if not body.name:
            body.name = f"body_{number}"
        body.add_site(name=f"{body.name}{FRAME}", pos=[0.0, 0.0, 0.0], size=[1e-3] * 3, group=5)
    for body in child.bodies[1:]:
        for kind, suffix in ((mujoco.mjtSensor.mjSENS_FORCE, FORCE), (mujoco.mjtSensor.mjSENS_TORQUE, TORQUE)):
            child.add_sensor(
                name=f"{body.name}{suffix}",
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=f"{body.name}{FRAME}",
            )
