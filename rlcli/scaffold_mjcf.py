"""Analysis of a robot's MJCF for `rlcli new --robot FILE.xml`: joints, efforts, default pose, height, asset files.

The class `Robot` also returns the settings of a new task that follow from the analysis. A kind of task is `velocity`,
`reach` or `balance`, see `rlcli.scaffold_robot`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.errors import listing
from rlcli.scaffold_mjcf_copy import (
    FREE,
    SCALAR,
    collect_assets,
    compile_copy,
    default_pose,
    put_robot_first,
    remove_scene_elements,
)
from rlcli.scene.joint_unit_check import LARGEST_LIMIT, doubtful_limits
from rlcli.scene.reachable_positions import coupled_joints, follow_coupled_joints, random_poses, reachable_positions

_CONTROL_DT = 0.02
"""Control period of the new task [s]."""
_USUAL_DT, _REACH_DT = 0.002, 0.005
"""MuJoCo's default time step, and the time step with which a reaching task replaces the default [s]."""
_MAX_DECIMATION = 20
"""Largest number of physics steps in a control period; see `Robot.tempo` for robots with a very short time step."""
_VIEW = np.array([4.0, 4.0, 3.0])
"""Direction from the robot to the camera, world frame. (x, y, z)"""
_NO_CONTACTS = int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
"""Flags of an MJCF that turn contacts off."""
_ROOT = 1
"""Id of the robot's root in the compiled model: the first body after the world."""


class Robot:
    """Robot of an MJCF, compiled: its joints, their actuators, its default pose, and its height above the ground.

    Args:
        spec: the robot's MJCF; the elements that a task defines itself are removed from it.
        file: file of the MJCF.

    Raises:
        ValueError: if the MJCF has ball joints or cannot be compiled, or an asset file is missing.
    """

    def __init__(self, spec: mujoco.MjSpec, file: Path) -> None:
        self.spec, self.file = spec, file
        self.found: dict[str, list[str]] = {
            "joints": [joint.name for joint in spec.joints],
            "actuators": [actuator.name for actuator in spec.actuators],
            "sensors": [sensor.name for sensor in spec.sensors],
            "keyframes": [key.name for key in spec.keys],
        }
        home = default_pose(spec)
        self.has_pose = home is not None
        """Whether the file has a default pose. If not, joints are at zero, or beside zero where a limit is near it."""
        has_pgs = spec.option.solver == mujoco.mjtSolver.mjSOL_PGS
        without_actuator = remove_scene_elements(spec)
        original = spec.compile()
        tree = ElementTree.fromstring(spec.to_xml())
        put_robot_first(tree, original)
        self.assets = collect_assets(tree, spec, file)
        self.xml = ElementTree.tostring(tree, encoding="unicode")
        self.model = model = compile_copy(self.xml, self.assets)
        self.dt = model.opt.timestep if model.opt.timestep <= 0.01 else 0.005
        self.decimation = min(max(1, round(_CONTROL_DT / self.dt)), _MAX_DECIMATION)
        self.tempo = round3(min(1.0, _MAX_DECIMATION * self.dt / _CONTROL_DT))
        """Factor of all durations of the task, such as the episode length. The factor is below 1 for a small, fast
        robot: one whose time step is so short that the decimation would exceed `_MAX_DECIMATION`."""
        self.gravity = float(np.linalg.norm(model.opt.gravity))
        """Magnitude of gravity in the MJCF, in the unit of length of the file per s^2."""
        own = model.body_rootid[model.geom_bodyid] == _ROOT
        colliding = own & ((model.geom_contype | model.geom_conaffinity) & 1 != 0)  # the ground has the bits 1 and 1
        self._collides = bool(colliding.any() and not model.opt.disableflags & _NO_CONTACTS)
        self._solid = np.flatnonzero(colliding if colliding.any() else own)
        """Ids of the robot's geoms that collide with the ground; of all its geoms if none collides."""
        balls = [model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_BALL)]
        if balls:
            raise ValueError(f"ball joints are not supported: {listing(balls)}; use three hinges for each")
        self.free = bool(model.njnt and model.body_jntnum[_ROOT] and model.jnt_type[0] == FREE)
        """Whether the base of the robot floats."""
        self.joints = [j for j in range(model.njnt) if model.jnt_type[j] in SCALAR]
        joint_actuator = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        self.actuator = {int(model.actuator_trnid[a, 0]): a for a in range(model.nu) if joint_actuator[a]}
        names = [self.name(j) for j in self.joints]
        self.doubts = [(message, hint) for message, hint, _ in doubtful_limits(model, self.joints, names)]
        """(message, hint) for each property of the file that is probably an error, or that the copy replaces."""
        if has_pgs:
            hint = 'for the file\'s solver, which runs on a CPU only, write solver="PGS" into its <option>'
            self.doubts.append(("the copy of the model has the solver Newton instead of PGS", hint))
        self.data = mujoco.MjData(model)
        for joint in self.joints:
            if home is not None and len(home) == model.nq:
                self.data.qpos[model.jnt_qposadr[joint]] = home[original.joint(self.name(joint)).qposadr[0]]
            if (
                model.jnt_type[joint] == SCALAR[0]
                and abs(value := self.data.qpos[model.jnt_qposadr[joint]]) > LARGEST_LIMIT
            ):
                found = f"the default pose has joint '{self.name(joint)}' at {value:.4g} rad"
                self.doubts.append((found, "keyframes are in radians, in every file"))
            if model.jnt_limited[joint]:
                address = model.jnt_qposadr[joint]
                self.data.qpos[address] = np.clip(self.data.qpos[address], *model.jnt_range[joint])
        self.height = self._lower_to_ground() if self.free else 0.0
        """Height of a floating root above the ground in the default pose; 0 for a fixed root [m]."""
        locked = {j for j in self.joints if j not in self.actuator and self._is_locked(j)}
        for pair in coupled_joints(model):  # coupled joints, such as two fingers: only one of the two is driven
            locked.add(next((j for j in pair[:2] if j not in self.actuator), -1))
        # without any actuator in the file, the task drives every joint that can move
        drivable = {j for j in self.joints if j not in locked and (not model.nu or self.name(j) in without_actuator)}
        self.driven = [j for j in self.joints if j in self.actuator or j in drivable]
        # joints of other bodies, such as objects that the robot moves, are not passive joints of the robot
        own = {j for j in self.joints if model.body_rootid[model.jnt_bodyid[j]] == _ROOT}
        self.passive = [j for j in self.joints if j in own and j not in locked.union(self.driven)]
        mujoco.mj_forward(model, self.data)
        self.com_height = float(self.data.subtree_com[_ROOT, 2]) if self.free else 0.0
        """Height of a floating robot's centre of mass above the ground in the default pose; 0 for a fixed root [m]."""
        self.inertia = self._inertia(self.data)

    def fitting_kind(self) -> tuple[str, str]:
        """Return the kind of task that fits the robot, and the reason.

        The kinds are `velocity` (follow velocity commands), `reach` (move the last body to a goal) and `balance` (keep
        the default pose).
        """
        driven, undriven = len(self.driven), [self.name(j) for j in self.passive]
        joints = _count(driven, "driven joint")
        has = "has no actuator of its own" if len(undriven) == 1 else "have no actuator of their own"
        without = f"{len(undriven)} of its joints {has} ({listing(undriven, 3)})"
        if self.free:
            if obstacle := self.obstacle_to("velocity"):
                return "balance", obstacle
            if driven < 4:
                return "balance", f"the robot's base floats, but it has only {joints}, and walking needs 4"
            if driven <= len(undriven):
                return "balance", f"the robot's base floats, but {without}, and only {driven} have an actuator"
            feet = _count(len(self.feet()), "foot", "feet")
            return "velocity", f"the robot's base floats, and it has {feet} and {joints}"
        if undriven:
            return "balance", f"the robot's base is fixed (no free joint), but {without}"
        if driven < 2:
            return (
                "balance",
                "the robot's base is fixed (no free joint), and only one joint is driven, but reaching needs 2",
            )
        if obstacle := self.obstacle_to("reach"):
            return "balance", obstacle
        return "reach", f"the robot's base is fixed (no free joint), and all {driven} joints are driven"

    def obstacle_to(self, kind: str) -> str:
        """Return why a kind of task (`velocity`, `reach`, `balance`) is impossible for the robot; empty if possible."""
        if kind == "velocity":
            if not self.free:
                return "the robot's base is fixed"
            if not self.gravity:
                return "the file sets gravity to 0, so the robot cannot walk"
            if not self._collides:
                return "the file turns contacts with the ground off, so the robot cannot walk"
            if not self.feet():
                return "no body besides the root touches the ground, so the robot has no feet"
            lies = any(self.model.body_weldid[body] == _ROOT for body in self._touching(-0.01))
            return "the trunk touches the ground in the default pose; walking needs a pose that stands" if lies else ""
        if kind == "reach":
            if self.free:
                return "the robot's base floats"
            hand = self.body_name(self.last_body())
            moves = np.ptp(self.workspace(), axis=0).max() > 0.01
            return "" if moves else f"the joints do not move the last body '{hand}' by more than 1 cm"
        return ""

    def name(self, joint: int) -> str:
        """Return the name of the joint with the id `joint` in the compiled model."""
        return str(self.model.joint(joint).name)

    def body_name(self, body: int) -> str:
        """Return the name of the body with the id `body` in the compiled model."""
        return str(self.model.body(body).name)

    def is_wheel(self, joint: int) -> bool:
        """Return whether a joint turns a wheel or flywheel: a hinge without limits that carries balanced bodies.

        Bodies are balanced if their centre of mass is nearer to the axis than a tenth of their radius of gyration.
        """
        model, data = self.model, self.data
        if model.jnt_type[joint] != SCALAR[0] or model.jnt_limited[joint]:
            return False
        body = model.jnt_bodyid[joint]
        offset = np.cross(data.xaxis[joint], data.subtree_com[body] - data.xanchor[joint])
        return bool(np.square(offset).sum() < 0.01 * self.inertia[joint] / model.body_subtreemass[body])

    def max_effort(self, joint: int) -> float:
        """Return the largest effort of a joint [N or N m]: the limit in the file, else an estimate from carried weight.

        The estimate for a slide is twice the weight of the bodies that the joint carries; for a hinge, their weight at
        a lever arm of 0.6 m. In a robot with a floating base, every joint carries the whole robot, and the lever arm of
        a hinge is half the height of the root.
        """
        model, a = self.model, self.actuator.get(joint)
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        if a is not None and model.actuator_forcelimited[a]:
            return float(np.abs(model.actuator_forcerange[a]).max() * abs(model.actuator_gear[a, 0]))
        if a is not None and model.actuator_ctrllimited[a] and not model.actuator_biasprm[a, 1]:
            largest = np.abs(model.actuator_ctrlrange[a]).max()
            return float(largest * model.actuator_gainprm[a, 0] * model.actuator_gear[a, 0])
        carried, lever = model.jnt_bodyid[joint], 0.6
        if self.free and model.body_rootid[carried] == _ROOT:
            carried, lever = _ROOT, 0.5 * max(self.height, 0.05)
        weight = (self.gravity or 9.81) * float(model.body_subtreemass[carried])
        return max(0.05, weight * (2.0 if model.jnt_type[joint] == SCALAR[1] else lever))

    def _is_locked(self, joint: int) -> bool:
        """Return whether friction and damping hold a joint in place; some files lock joints with a damping of 1e11.

        At its largest effort, such a joint moves at less than 1 cm/s or 0.01 rad/s.
        """
        dof = self.model.jnt_dofadr[joint]
        resistance = 0.01 * self.model.dof_damping[dof] + self.model.dof_frictionloss[dof]
        return bool(resistance > abs(self.max_effort(joint)))

    def joint_settings(self, kind: str) -> dict[str, dict[str, float]]:
        """Return {kp, kv, effort_limit} by joint name, for the driven joints without a position actuator in the file.

        In a velocity task the joints are compliant: the largest effort is reached at an error of 0.1 m or 1 rad. In a
        reaching task the joints are stiff, see `_stiff_gains`.
        """
        settings = {}
        stiff = self._stiff_gains() if kind == "reach" else {}
        for joint in self.driven:
            if self.has_gains(joint):
                continue
            effort = abs(self.max_effort(joint))
            if joint in stiff:
                kp, kv = stiff[joint]
            else:
                kp = effort * (10.0 if self.model.jnt_type[joint] == SCALAR[1] else 1.0)
                kv = 2.0 * 0.5 * math.sqrt(kp * self.inertia[joint])  # damping ratio 0.5
            settings[self.name(joint)] = {"kp": round3(kp), "kv": round3(kv), "effort_limit": round3(effort)}
        return settings

    def has_gains(self, joint: int) -> bool:
        """Return whether the file has a position actuator for a joint."""
        return joint in self.actuator and bool(self.model.actuator_biasprm[self.actuator[joint], 1] < 0.0)

    def _stiff_gains(self) -> dict[int, tuple[float, float]]:
        """Return the gains (kp, kv) of stiff, overdamped position servos, by joint id.

        The servos follow their targets with a lag of 0.1 s. Gravity displaces the last body by about 0.5 % of the size
        of its workspace: it turns a point mass at the distance r by g / (r w^2), where w is the servo's natural
        frequency, so w^2 = g / d gives the displacement d at any r.
        """
        sag = 0.005 * float(np.ptp(self.workspace(), axis=0).max())
        frequency = min(max(math.sqrt((self.gravity or 9.81) / sag), 20.0 / self.tempo), 0.3 / self.dt)
        largest = dict.fromkeys(self.driven, 0.0)
        data = mujoco.MjData(self.model)
        for qpos in random_poses(self.model, self.data.qpos, self.driven, self.offsets(), 64):
            data.qpos[:] = qpos
            mujoco.mj_forward(self.model, data)
            inertia = self._inertia(data)
            largest = {j: max(largest[j], inertia[j]) for j in self.driven}
        gains, lag = {}, 0.1 * self.tempo
        for joint, inertia_of_joint in largest.items():
            damping = float(self.model.dof_damping[self.model.jnt_dofadr[joint]])
            kp = inertia_of_joint * frequency**2 + damping / lag
            gains[joint] = kp, lag * kp
        return gains

    def sim_settings(self) -> dict[str, Any]:
        """Return the section `sim` (physics settings) of a task for the robot, as data of its YAML."""
        settings: dict[str, Any] = {"dt": self.dt, "integrator": "implicitfast"}  # stable with the damping of servos
        gravity = [float(value) for value in self.model.opt.gravity]
        return settings if gravity == [0.0, 0.0, -9.81] else settings | {"gravity": gravity}

    def scene_settings(self, kind: str) -> dict[str, Any]:
        """Return the section `scene` of a task of a kind (`velocity`, `reach`, `balance`), as data of its YAML."""
        robot: dict[str, Any] = {"model": "model.xml"}
        if self.free:
            robot["pos"] = [0.0, 0.0, round(self.height + 0.0005, 4)]  # 0.5 mm: touching, but never inside the ground
        if kind != "balance" and (settings := self.joint_settings(kind)):
            robot["joints"] = settings
        pose = {self.name(j): round(float(self.data.qpos[self.model.jnt_qposadr[j]]), 4) for j in self.joints}
        if pose := {name: value for name, value in pose.items() if value}:
            robot["init"] = {"joint_pos": pose}
        envs = 256 if kind == "velocity" else 512
        return {"num_envs": envs, "env_spacing": 2.5, "entities": {"robot": robot}}

    def viewer_settings(self, kind: str) -> dict[str, Any]:
        """Return the section `viewer` of a task of a kind: a camera that sees the whole robot in its default pose."""
        model, data = self.model, self.data
        solid = [g for g in range(model.ngeom) if model.geom_bodyid[g]]
        points, radii = np.vstack([data.xpos[1:], data.geom_xpos[solid]]), np.zeros((model.nbody - 1 + len(solid), 1))
        radii[model.nbody - 1 :, 0] = model.geom_rbound[solid]
        low, high = (points - radii).min(axis=0), (points + radii).max(axis=0)
        lookat = 0.5 * (low + high)
        eye = lookat + 1.5 * max(float(np.linalg.norm(high - low)), 0.1) * _VIEW / np.linalg.norm(_VIEW)
        place = {name: [round(float(x), 3) + 0.0 for x in point] for name, point in (("eye", eye), ("lookat", lookat))}
        return place | ({"follow": "robot"} if kind == "velocity" else {})

    def feet(self) -> list[str]:
        """Return the names of the bodies that are at most 1 cm above the ground in the default pose, without the root.

        Bodies that are fixed to the root count as the root.
        """
        return [self.body_name(b) for b in self._touching(-0.01) if self.model.body_weldid[b] != _ROOT]

    def trunk(self) -> list[str]:
        """Return the names of the bodies with geoms that are the root or fixed to the root."""
        return [self.body_name(b) for b in dict.fromkeys(self.model.geom_bodyid) if self.model.body_weldid[b] == _ROOT]

    def _lower_to_ground(self) -> float:
        """Lower the root until the robot touches the ground; return the height of the root [m]."""
        low, high = -5.0, 5.0
        for _ in range(30):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._touching(middle, absolute=True) else (low, middle)
        self.data.qpos[2] = high
        return high

    def _touching(self, height: float, *, absolute: bool = False) -> list[int]:
        """Return the ids of the robot's bodies with a geom of `_solid` below z = 0, after the root is moved vertically.

        Args:
            height: change of the root's z coordinate from the default pose [m].
            absolute: whether `height` is the z coordinate itself instead of its change.
        """
        model, data = self.model, mujoco.MjData(self.model)
        data.qpos[:] = self.data.qpos
        data.qpos[2] = height if absolute else data.qpos[2] + height
        mujoco.mj_kinematics(model, data)
        found = [int(model.geom_bodyid[geom]) for geom in self._solid if _lowest_z(model, data, int(geom)) < 0.0]
        return list(dict.fromkeys(found))

    def _inertia(self, data: mujoco.MjData) -> dict[int, float]:
        """Return the diagonal elements of the mass matrix in the pose of `data`, by joint id [kg or kg m^2]."""
        matrix = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, matrix)
        return {j: float(matrix[self.model.jnt_dofadr[j], self.model.jnt_dofadr[j]]) for j in self.joints}

    def prepare_for_reaching(self) -> None:
        """Choose the default pose and the physics step of a reaching task, in place.

        Without a default pose in the file, a joint starts in the middle of its range if 0 is far from the middle. If
        the file has MuJoCo's default time step, which is short because of contacts, reaching uses a longer time step.
        """
        model, ranges = self.model, self.model.jnt_range
        for joint in [] if self.has_pose else self.driven:
            address, middle = model.jnt_qposadr[joint], 0.5 * ranges[joint].sum()
            if model.jnt_limited[joint] and abs(self.data.qpos[address] - middle) > 0.25 * np.ptp(ranges[joint]):
                self.data.qpos[address] = float(f"{middle:.3g}")
        follow_coupled_joints(model, self.data.qpos[None], self.driven)
        mujoco.mj_forward(model, self.data)
        fastest = max((self._servo_frequency(j) for j in self.driven if self.has_gains(j)), default=0.0)
        if self.dt == _USUAL_DT and fastest * _REACH_DT < 0.5:
            self.dt, self.decimation = _REACH_DT, round(_CONTROL_DT / _REACH_DT)

    def _servo_frequency(self, joint: int) -> float:
        """Return the natural frequency, in the default pose, of a joint with a position actuator [rad/s]."""
        actuator = self.actuator[joint]
        stiffness = -self.model.actuator_biasprm[actuator, 1] * self.model.actuator_gear[actuator, 0] ** 2
        return math.sqrt(stiffness / max(self.inertia[joint], 1e-9))

    def workspace(self) -> NDArray[np.float64]:
        """Return sampled positions that the last body can reach, in the frame of the fixed root. (n, 3) [m]"""
        model, turn = self.model, np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_quat[_ROOT])
        found = reachable_positions(model, self.data.qpos, self.driven, self.last_body(), self.offsets())
        places: NDArray[np.float64] = (found - model.body_pos[_ROOT]) @ turn.reshape(3, 3)
        return places

    def offsets(self) -> tuple[float, float]:
        """Return the range of joint positions, relative to the default pose, from which goals are sampled [m or rad].

        The range is +-pi, a full turn of a hinge, or +-0.5 if the robot has a driven slide without limits. A position
        outside a joint's limits is not used.
        """
        endless = any(self.model.jnt_type[j] != SCALAR[0] and not self.model.jnt_limited[j] for j in self.driven)
        largest = 0.5 if endless else round3(math.pi)
        return -largest, largest

    def action_scales(self) -> dict[str, float]:
        """Return the scale of each driven joint's action, by joint name [m or rad].

        The scale is a quarter of the joint's limits or else of the range of `offsets`, and at most 1.
        """
        scales = {}
        for joint in self.driven:
            low, high = self.model.jnt_range[joint] if self.model.jnt_limited[joint] else self.offsets()
            scales[self.name(joint)] = round3(min(1.0, 0.25 * float(high - low)))
        return scales

    def last_body(self) -> int:
        """Return the id of the body at the end of the longest chain of driven joints, such as a gripper."""

        def length(body: int) -> int:
            """Return the number of driven joints between a body and the world."""
            count = 0
            while body:
                count += sum(int(self.model.jnt_bodyid[j]) == body for j in self.driven)
                body = int(self.model.body_parentid[body])
            return count

        return max(range(1, self.model.nbody), key=lambda body: (length(body), body))


def _lowest_z(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Return the lowest world z coordinate of a geom [m].

    The result is inf for a plane, a lower bound for cylinders and ellipsoids, and exact for other geoms.
    """
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


def _count(number: int, one: str, several: str = "") -> str:
    """Return a number with its noun; `several` is the plural, by default the singular with an s."""
    return f"{number} {one if number == 1 else several or f'{one}s'}"


def round3(value: float) -> float:
    """Return a number rounded to three significant digits."""
    return float(f"{value:.3g}")
