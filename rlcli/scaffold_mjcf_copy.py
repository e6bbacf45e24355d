"""Functions that change a copy of a robot's MJCF for a new task: remove elements, add names, collect asset files.

Ground, lights and keyframes are removed, because the task defines its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from rlcli.scene.joint_and_actuator_setup import actuator_kind

SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
"""Joint types with one position: hinge and slide."""
FREE = int(mujoco.mjtJoint.mjJNT_FREE)
"""Joint type of a floating base."""
_NO_GRAVITY = int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
"""Flag of an MJCF that turns gravity off."""


def default_pose(spec: mujoco.MjSpec) -> np.ndarray | None:
    """Return the robot's default pose as `qpos`, or None if the MJCF has no default pose. (nq,)

    The default pose is that of the keyframe `home`, `stand` or `standing`, else of the first keyframe, else the value
    of the element `numeric` with the name `init_qpos`.
    """
    keys = sorted(spec.keys, key=lambda key: key.name not in ("home", "stand", "standing"))
    # Gymnasium's MJCFs store the start pose here
    start = next((numeric for numeric in spec.numerics if numeric.name == "init_qpos"), None)
    if keys:
        return np.array(keys[0].qpos)
    return None if start is None else np.array(start.data)


def remove_scene_elements(spec: mujoco.MjSpec) -> list[str]:
    """Remove ground, lights and keyframes, which the task defines itself; name all bodies, joints and actuators.

    Equalities (weld, connect) with mocap bodies are removed, too: a task does not move mocap bodies, so the equalities
    would hold the robot. If as many joints are pulled by tendons as have an actuator of their own, the actuators of
    tendons and their sensors are removed. So are servos with dynamics of their own, such as a filter. The task drives
    these joints directly. If a flag turns gravity off, gravity 0 replaces the flag: the flag would override the gravity
    of the task. The solver PGS, which the GPU engine does not support, is replaced by Newton. `spec` is changed in
    place.

    Returns:
        Names of the joints that have lost their actuators. The list is empty if the robot has no other actuator: then
        the task drives all joints.
    """
    if spec.option.disableflags & _NO_GRAVITY:
        spec.option.disableflags &= ~_NO_GRAVITY
        spec.option.gravity = [0.0, 0.0, 0.0]
    if spec.option.solver == mujoco.mjtSolver.mjSOL_PGS:
        spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    lost = [*_remove_tendon_actuators(spec), *_remove_unknown_servos(spec)]
    for key in list(spec.keys):
        spec.delete(key)
    mocap = {body.name for body in spec.bodies if body.mocap}
    mocap |= {site.name for site in spec.sites if site.parent.mocap}
    for tie in list(spec.equalities):
        if tie.type in (mujoco.mjtEq.mjEQ_WELD, mujoco.mjtEq.mjEQ_CONNECT) and {tie.name1, tie.name2} & mocap:
            spec.delete(tie)
    world = spec.worldbody
    for geom in list(world.geoms):
        if geom.type in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):
            spec.delete(geom)
    for light in list(spec.lights):
        spec.delete(light)
    for kind, elements in (("body", spec.bodies[1:]), ("joint", spec.joints), ("actuator", spec.actuators)):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements):
            if not element.name:
                element.name = next(n for i in range(number, 10**6) if (n := f"{kind}{i}") not in taken)
                taken.add(element.name)
    return [joint.name for joint in lost] if len(spec.actuators) else []


def _remove_tendon_actuators(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    """Remove the actuators of tendons if these pull at many joints; return the joints."""
    own = {a.target for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_JOINT}
    tendons = [a for a in spec.actuators if a.trntype == mujoco.mjtTrn.mjTRN_TENDON]
    wraps = [wrap for actuator in tendons for wrap in spec.tendon(actuator.target).path]
    found = {wrap.target.name: wrap.target for wrap in wraps if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT}
    pulled = [joint for name, joint in found.items() if name not in own]
    if len(pulled) < len(own):
        return []
    _remove_actuators(spec, tendons)
    return pulled


def _remove_unknown_servos(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    """Remove servos of joints whose kind the actions do not know; return the joints.

    An action would drive the joint by a further actuator, against the servo, which holds the joint at zero.
    """
    joints = {joint.name: joint for joint in spec.joints}
    servos = [
        actuator
        for actuator in spec.actuators
        if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT
        and actuator.biasprm[1] != 0.0
        and actuator_kind(actuator) == "other"
    ]
    lost = [joints[actuator.target] for actuator in servos]
    _remove_actuators(spec, servos)
    return lost


def _remove_actuators(spec: mujoco.MjSpec, actuators: list[mujoco.MjsActuator]) -> None:
    """Remove actuators, and the sensors that measure them."""
    removed = {actuator.name for actuator in actuators}
    for sensor in list(spec.sensors):
        if sensor.objtype == mujoco.mjtObj.mjOBJ_ACTUATOR and sensor.objname in removed:
            spec.delete(sensor)
    for actuator in actuators:
        spec.delete(actuator)


def put_robot_first(tree: ElementTree.Element, model: mujoco.MjModel) -> None:
    """Move the top-level body with most driven joints to the front, because rlcli takes the first body as the root.

    If the body has a free joint, the body is placed at the origin, and other bodies are moved by the same vector. If
    the z axis of a body with a free joint does not point up, `_insert_level_root` gives the body a new parent.

    Args:
        tree: the MJCF, which is changed.
        model: the compiled MJCF.
    """
    joint_actuator = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = model.actuator_trnid[joint_actuator, 0] if model.nu else np.flatnonzero(np.isin(model.jnt_type, SCALAR))
    world, bodies = tree.find("worldbody"), tree.findall("worldbody/body")
    if world is None or not len(driven):
        return
    root = int(np.bincount(model.body_rootid[model.jnt_bodyid[driven]]).argmax())
    robot = next(body for body in bodies if body.get("name") == model.body(root).name)
    begin = list(world).index(bodies[0])
    world.remove(robot)
    world.insert(begin, robot)
    if model.body_dofnum[root] < 6 or model.jnt_type[model.body_jntadr[root]] != FREE:
        return
    for body in bodies:  # other bodies keep their place relative to the robot
        place = model.body(body.get("name")).pos - model.body_pos[root]
        body.set("pos", " ".join(f"{value:.6g}" for value in place))
    if 1.0 - 2.0 * float(np.square(model.body_quat[root, 1:3]).sum()) < 0.95:  # the z axis of the body is not up
        _insert_level_root(robot)


def _insert_level_root(body: ElementTree.Element) -> None:
    """Give a body with a free joint a new parent whose z axis points up, because terms read the tilt of the root.

    The free joint moves to the new parent. The element `body` becomes the new parent, and a copy of the body its child.
    """
    child = ElementTree.Element("body", body.attrib | {"pos": "0 0 0"})
    joints = [part for part in body if part.tag == "freejoint" or part.get("type") == "free"]
    child.extend([part for part in body if part not in joints])
    kept = {key: value for key, value in body.attrib.items() if key in ("childclass", "pos")}
    body.clear()
    body.attrib.update(kept, name=f"{child.attrib['name']}_level")
    body.extend([*joints, child])


def collect_assets(tree: ElementTree.Element, spec: mujoco.MjSpec, file: Path) -> dict[str, Path]:
    """Change the paths of all files that an MJCF loads to the folder `assets`; return new path -> present file.

    Args:
        tree: the MJCF, which is changed.
        spec: the MJCF as read by MuJoCo, with the folders of its meshes and textures.
        file: file of the MJCF.

    Raises:
        ValueError: if a file does not exist.
    """
    found: dict[str, Path] = {}
    home = Path(spec.modelfiledir or file.parent)
    for element in tree.iter():
        for key in [key for key in element.attrib if key.startswith("file") and element.tag != "text"]:
            name = element.attrib[key]
            folder = spec.texturedir if element.tag == "texture" else spec.meshdir
            origin = next((path for path in (home / folder / name, home / name) if path.is_file()), None)
            if origin is None:
                raise ValueError(f"a {element.tag} loads {home / folder / name}, which does not exist; move it there")
            place = f"assets/{origin.name}"
            for number in range(len(found)):  # another file may have the same name
                if found.get(place, origin).resolve() == origin.resolve():
                    break
                place = f"assets/{number}_{origin.name}"
            found[place] = origin
            element.set(key, Path(place).name)
    compiler = tree.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(tree, "compiler")
    for key in ("assetdir", "strippath"):
        compiler.attrib.pop(key, None)
    compiler.attrib.update(meshdir="assets", texturedir="assets")
    return found


def compile_copy(xml: str, assets: Mapping[str, Path]) -> mujoco.MjModel:
    """Compile an MJCF from text, with the files `assets` (path in the MJCF -> file), which are read into memory.

    Raises:
        ValueError: if MuJoCo cannot compile the MJCF, for example because a file is missing in `assets`.
    """
    return mujoco.MjModel.from_xml_string(xml, {place: origin.read_bytes() for place, origin in assets.items()})
