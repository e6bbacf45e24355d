"""Robot of an MJCF, for `rlcli new --robot`: joints, efforts, default pose, height above the ground, asset files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from rlcli.errors import listing

_CONTROL_DT = 0.02
"""Control period of the new task [s]."""
SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
"""Joint types with one position: hinge and slide."""


class Robot:
    """Compiled robot of an MJCF: its joints, their actuators, its default pose, and its height above the ground."""

    def __init__(self, spec: mujoco.MjSpec, file: Path) -> None:
        self.spec, self.file = spec, file
        self.found: dict[str, list[str]] = {
            "joints": [joint.name for joint in spec.joints],
            "actuators": [actuator.name for actuator in spec.actuators],
            "sensors": [sensor.name for sensor in spec.sensors],
            "keyframes": [key.name for key in spec.keys],
        }
        home = _home(spec)
        _clean(spec)
        self.model = model = spec.compile()
        self.xml, self.assets = _collect_assets(spec, file)
        self.dt = model.opt.timestep if model.opt.timestep <= 0.01 else 0.005
        self.decimation = max(1, round(_CONTROL_DT / self.dt))
        balls = [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_BALL)]
        if balls:
            raise ValueError(f"ball joints are not supported: {listing(balls)}; use three hinges")
        self.free = [j for j in range(model.njnt) if model.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_FREE)]
        self.joints = [j for j in range(model.njnt) if model.jnt_type[j] in SCALAR]
        joint_actuator = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        self.actuator = {int(model.actuator_trnid[a, 0]): a for a in range(model.nu) if joint_actuator[a]}
        # without any actuator in the file, the task drives every joint
        self.driven = [j for j in self.joints if j in self.actuator or not model.nu]
        self.passive = [j for j in self.joints if j not in self.driven]
        self.data = mujoco.MjData(model)
        if home is not None and len(home) == model.nq:
            self.data.qpos[:] = home
        for joint in self.joints:
            if model.jnt_limited[joint]:
                address = model.jnt_qposadr[joint]
                self.data.qpos[address] = np.clip(self.data.qpos[address], *model.jnt_range[joint])
        self.height = self._stand() if self.free else 0.0
        mujoco.mj_forward(model, self.data)
        self.inertia = self._inertia()

    def kind(self) -> str:
        """Return the kind of task that fits the robot: velocity, reach or balance."""
        if len(self.free) == 1 and len(self.driven) >= 4 and self.feet():
            return "velocity"
        return "reach" if not self.free and not self.passive and len(self.driven) >= 2 else "balance"

    def name(self, joint: int) -> str:
        """Return the name of a joint."""
        return str(self.model.joint(joint).name)

    def body(self, number: int) -> str:
        """Return the name of a body."""
        return str(self.model.body(number).name)

    @property
    def root(self) -> int:
        """The body with the free joint."""
        return int(self.model.jnt_bodyid[self.free[0]])

    def effort(self, joint: int) -> float:
        """Return the largest effort of a joint's actuator, else an estimate from the carried mass [N or N m]."""
        model, a = self.model, self.actuator.get(joint)
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        if a is not None and model.actuator_forcelimited[a]:
            return float(np.abs(model.actuator_forcerange[a]).max() * abs(model.actuator_gear[a, 0]))
        if a is not None and model.actuator_ctrllimited[a] and not model.actuator_biasprm[a, 1]:
            largest = np.abs(model.actuator_ctrlrange[a]).max()
            return float(largest * model.actuator_gainprm[a, 0] * model.actuator_gear[a, 0])
        mass = float(model.body_subtreemass[model.jnt_bodyid[joint]])
        # twice the weight; a hinge carries it at a lever of 0.3 m
        return max(0.05, 2.0 * 9.81 * mass * (1.0 if model.jnt_type[joint] == SCALAR[1] else 0.3))

    def settings(self) -> dict[str, dict[str, float]]:
        """Return gains for joints without a position actuator in the file, from their largest effort and inertia."""
        settings = {}
        for joint in self.driven:
            if joint in self.actuator and self.model.actuator_biasprm[self.actuator[joint], 1] < 0.0:
                continue  # a position actuator: the file has its gains
            effort = abs(self.effort(joint))
            kp = effort * (10.0 if self.model.jnt_type[joint] == SCALAR[1] else 1.0)  # full effort at 0.1 m or 1 rad
            kv = 2.0 * 0.5 * math.sqrt(kp * self.inertia[joint])  # damping ratio 0.5
            settings[self.name(joint)] = {"kp": short(kp), "kv": short(kv), "effort_limit": short(effort)}
        return settings

    def scene(self) -> dict[str, Any]:
        """Return the scene of the task as data of its YAML."""
        robot: dict[str, Any] = {"model": "model.xml"}
        if self.free:
            robot["pos"] = [0.0, 0.0, round(self.height + 0.005, 4)]
        if self.kind() != "balance" and (settings := self.settings()):
            robot["joints"] = settings
        pose = {self.name(j): round(float(self.data.qpos[self.model.jnt_qposadr[j]]), 4) for j in self.joints}
        if pose := {name: value for name, value in pose.items() if value}:
            robot["init"] = {"joint_pos": pose}
        envs = 1024 if self.kind() == "velocity" else 512
        return {"num_envs": envs, "env_spacing": 2.5, "entities": {"robot": robot}}

    def feet(self) -> list[str]:
        """Return the bodies that touch the ground in the default pose (with the robot 1 cm lower), without the root."""
        return [self.body(b) for b in self._touching(-0.01) if b != self.root]

    def _stand(self) -> float:
        """Lower the root until the robot touches the ground; return the height of the root [m]."""
        low, high = -5.0, 5.0
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._touching(middle, absolute=True) else (low, middle)
        self.data.qpos[self.model.jnt_qposadr[self.free[0]] + 2] = high
        return high

    def _touching(self, height: float, *, absolute: bool = False) -> list[int]:
        """Return the bodies with a colliding geom below z = 0 after the root is raised by a height [m].

        If `absolute` is true, the root is placed at this height instead.
        """
        model, data = self.model, mujoco.MjData(self.model)
        data.qpos[:] = self.data.qpos
        place = model.jnt_qposadr[self.free[0]] + 2
        data.qpos[place] = height if absolute else data.qpos[place] + height
        mujoco.mj_kinematics(model, data)
        found = []
        for geom in range(model.ngeom):
            solid = model.geom_contype[geom] or model.geom_conaffinity[geom]
            if solid and model.geom_bodyid[geom] and _lowest(model, data, geom) < 0.0:
                found.append(int(model.geom_bodyid[geom]))
        return list(dict.fromkeys(found))

    def _inertia(self) -> dict[int, float]:
        matrix = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, matrix)
        return {j: float(matrix[self.model.jnt_dofadr[j], self.model.jnt_dofadr[j]]) for j in self.joints}

    def workspace(self, body: int) -> list[list[float]]:
        """Return a box of positions that a body reaches near the default pose, relative to the root [m]. (3, 2)

        The box goes from the 20 % to the 80 % quantile of the positions in 300 random poses.
        """
        generator, model, data = np.random.default_rng(0), self.model, mujoco.MjData(self.model)
        places = []
        for _ in range(300):
            data.qpos[:] = self.data.qpos
            for joint in self.driven:
                address, spread = model.jnt_qposadr[joint], 0.6 if model.jnt_type[joint] == SCALAR[0] else 0.1
                value = data.qpos[address] + generator.uniform(-spread, spread)
                limits = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.inf, np.inf)
                data.qpos[address] = np.clip(value, *limits)
            mujoco.mj_kinematics(model, data)
            root = data.xpos[self._first_body()]
            places.append(data.xpos[body] - root)
        return [[round(float(x), 3) for x in ends] for ends in np.percentile(places, [20, 80], axis=0).T]

    def _first_body(self) -> int:
        """Return the root of the robot: the first body below the world."""
        return int(self.model.body_rootid[self.model.jnt_bodyid[self.joints[0]]])

    def last_body(self) -> int:
        """Return the body at the end of the longest chain of driven joints."""

        def length(body: int) -> int:
            count = 0
            while body:
                count += sum(int(self.model.jnt_bodyid[j]) == body for j in self.driven)
                body = int(self.model.body_parentid[body])
            return count

        return max(range(1, self.model.nbody), key=lambda body: (length(body), body))


def _home(spec: mujoco.MjSpec) -> np.ndarray | None:
    """Return `qpos` of the keyframe home, stand or standing, else of the first one; None without a keyframe."""
    keys = sorted(spec.keys, key=lambda key: key.name not in ("home", "stand", "standing"))
    return np.array(keys[0].qpos) if keys else None


def _clean(spec: mujoco.MjSpec) -> None:
    """Remove floor, lights and keyframes, which the task's scene replaces; centre a free root; name every element."""
    for key in list(spec.keys):
        spec.delete(key)
    world = spec.worldbody
    for geom in list(world.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            spec.delete(geom)
    for light in list(spec.lights):
        spec.delete(light)
    for kind, elements in (("body", spec.bodies[1:]), ("joint", spec.joints), ("actuator", spec.actuators)):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements):
            if not element.name:
                element.name = next(n for i in range(number, 10**6) if (n := f"{kind}{i}") not in taken)
                taken.add(element.name)
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            joint.parent.pos = [0.0, 0.0, 0.0]


def _collect_assets(spec: mujoco.MjSpec, file: Path) -> tuple[str, dict[str, Path]]:
    """Return the MJCF with references to the folder `assets`, and the files to copy: new path -> original file."""
    tree = ElementTree.fromstring(spec.to_xml())
    found: dict[str, Path] = {}
    home = Path(spec.modelfiledir or file.parent)
    for element in tree.iterfind("asset//*[@file]"):
        name = element.get("file", "")
        folder = spec.texturedir if element.tag == "texture" else spec.meshdir
        origin, place = home / folder / name, f"assets/{Path(name).name}"
        if found.setdefault(place, origin).resolve() != origin.resolve():
            raise ValueError(f"two files have the name {Path(name).name}; rename one")
        element.set("file", Path(name).name)
    compiler = tree.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(tree, "compiler")
    compiler.attrib.pop("assetdir", None)
    compiler.attrib.update(meshdir="assets", texturedir="assets")
    return ElementTree.tostring(tree, encoding="unicode"), found


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Return the lowest z of a geom [m]: exact for spheres, capsules, boxes and meshes, a lower bound for others."""
    kind, size, turn = int(model.geom_type[geom]), model.geom_size[geom], data.geom_xmat[geom].reshape(3, 3)
    z, kinds = float(data.geom_xpos[geom, 2]), mujoco.mjtGeom
    if kind == int(kinds.mjGEOM_SPHERE):
        return z - float(size[0])
    if kind in (int(kinds.mjGEOM_CAPSULE), int(kinds.mjGEOM_CYLINDER)):
        return z - abs(float(turn[2, 2])) * float(size[1]) - float(size[0])
    if kind == int(kinds.mjGEOM_MESH):
        mesh = model.geom_dataid[geom]
        begin, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        return z + float((model.mesh_vert[begin : begin + count] @ turn[2]).min())
    if kind == int(kinds.mjGEOM_PLANE):
        return math.inf
    return z - float(np.abs(turn[2]) @ size)


def short(value: float) -> float:
    """Return a number rounded to three significant digits."""
    return float(f"{value:.3g}")
