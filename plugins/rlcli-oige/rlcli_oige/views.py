"""Tensor views of robots and bodies, with OmniIsaacGymEnvs' names, orders and conventions.

Joints and bodies are in breadth-first order, positions include the environment's place on the grid, quaternions are
(w, x, y, z). Every getter gives a tensor of its own; a setter may be called any number of times a step, and getters
of a robot's root and joints see at once what was set.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.sim.rotations import rotate, rotate_inverse
from rlcli_oige.stage import FORCE, TORQUE, ZERO, path_pattern

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv


class XFormPrimView:
    """Frames or bodies that a path expression names, in every environment; rows are environment by environment.

    Args:
        prim_paths_expr: a path whose steps may be regular expressions: `/World/envs/.*/Ant/torso`.
        name: the view's own name.
    """

    def __init__(self, prim_paths_expr: str, name: str = "view", reset_xform_properties: bool = True, **kwargs: Any):
        self.prim_paths_expr = prim_paths_expr
        self.name = name
        self._non_root_link = False
        self._env: OigeEnv | None = None

    def bind(self, env: OigeEnv) -> None:
        """Connect to the running simulation; the framework calls it.

        Raises:
            TaskError: if the path leads to nothing.
        """
        self._env = env
        pattern = path_pattern(self.prim_paths_expr)
        known: dict[str, tuple[Entity, int]] = {}
        for prim in env.stage.prims.values():
            if prim.child is None:
                continue
            entity = env.entities[prim.entity]
            known[prim.prim_path] = (entity, entity.root_body)
            for body, name in zip(entity.body_ids.tolist(), entity.names["Bodies"], strict=True):
                known[f"{prim.prim_path}/{name}"] = (entity, body)
        found = [place for path, place in known.items() if pattern.fullmatch(path)]
        if not found:
            near = did_you_mean(self.prim_paths_expr.replace("/.*/", "/env_0/"), known)
            raise TaskError(
                f"view '{self.name}': nothing matches '{self.prim_paths_expr}'",
                hint=near or f"paths: {listing(known)}",
            )
        self._entities = [entity for entity, _ in found]
        self._bodies = [body for _, body in found]
        self._per_env = len(found)
        self._device = str(env.device)
        self._dtype = torch.float32
        self._origins = env.env_origins.repeat_interleave(self._per_env, dim=0)
        self._roots = [body == entity.root_body for entity, body in found]
        model = env.engine.model
        self._mocap = [int(model.body_mocapid[body]) for body in self._bodies]
        self._bind()

    def _bind(self) -> None:
        """What a kind of view looks up."""

    def initialize(self, physics_sim_view: Any = None) -> None:
        """Nothing: the framework binds views."""

    def post_reset(self) -> None:
        """Nothing."""

    def is_valid(self, indices: Tensor | None = None) -> bool:
        """Whether the simulation runs."""
        return self._env is not None

    def is_physics_handle_valid(self) -> bool:
        """Whether the simulation runs."""
        return self._env is not None

    @property
    def count(self) -> int:
        """Rows: environments times what the path matches in one."""
        return self.env.num_envs * self._per_env

    @property
    def prim_paths(self) -> list[str]:
        """A path a row."""
        model = self.env.engine.model
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body) for body in self._bodies]
        return [ZERO.replace("env_0", f"env_{env}") + f"/{name}" for env in range(self.env.num_envs) for name in names]

    @property
    def env(self) -> OigeEnv:
        """The environment.

        Raises:
            TaskError: before the simulation runs.
        """
        if self._env is None:
            hint = "scene.add(view) in set_up_scene; views answer from post_reset on"
            raise TaskError(f"view '{self.name}' is not connected to a simulation", hint=hint)
        return self._env

    def get_world_poses(self, indices: Any = None, clone: bool = True, usd: bool = True) -> tuple[Tensor, Tensor]:
        """Positions [m], the environment's place on the grid included, and orientations. (n, 3), (n, 4)"""
        position, quat = self.get_local_poses(indices)
        return position + _rows(self._origins, self._index(indices)), quat

    def get_local_poses(self, indices: Any = None) -> tuple[Tensor, Tensor]:
        """Positions [m] in their environments, and orientations. (n, 3), (n, 4)"""
        sim = self.env.sim
        positions, quats = [], []
        for entity, body, root, mocap in zip(self._entities, self._bodies, self._roots, self._mocap, strict=True):
            if mocap >= 0:
                positions.append(self.env.engine.field("mocap_pos")[:, mocap].float())
                quats.append(self.env.engine.field("mocap_quat")[:, mocap].float())
            elif root and entity.root_qpos is not None:
                positions.append(sim.qpos[:, entity.root_qpos : entity.root_qpos + 3])
                quats.append(sim.qpos[:, entity.root_qpos + 3 : entity.root_qpos + 7])
            else:
                positions.append(sim.derived_field("xpos")[:, body])
                quats.append(sim.derived_field("xquat")[:, body])
        index = self._index(indices)
        return _rows(_joined(positions), index), _rows(_joined(quats), index)

    def set_world_poses(
        self, positions: Any = None, orientations: Any = None, indices: Any = None, usd: bool = True
    ) -> None:
        """Put them somewhere, the grid included in positions. (n, 3) [m], (n, 4); None keeps what is.

        Only what can move by itself moves: the root of a robot that is not fixed to the world, a free or kinematic
        body; for the others this does nothing, as it does for OmniIsaacGymEnvs' links.
        """
        index = self._index(indices)
        if positions is not None:
            positions = self._tensor(positions) - _rows(self._origins, index)
        self.set_local_poses(positions, orientations, indices)

    def set_local_poses(self, translations: Any = None, orientations: Any = None, indices: Any = None) -> None:
        """The same, positions in their environments."""
        for which, (entity, root, mocap) in enumerate(zip(self._entities, self._roots, self._mocap, strict=True)):
            rows, pick = self._rows_of(which, indices)
            for values, size, start in ((translations, 3, 0), (orientations, 4, 3)):
                if values is None:
                    continue
                given = self._tensor(values).reshape(-1, size)[pick]
                if mocap >= 0:
                    field = self.env.engine.field("mocap_pos" if size == 3 else "mocap_quat")
                    field[rows, mocap] = given.to(field.dtype)
                elif root and entity.root_qpos is not None:
                    self._write("qpos", rows, slice(entity.root_qpos + start, entity.root_qpos + start + size), given)

    def get_velocities(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Linear [m/s] and angular [rad/s] velocities of the bodies' frames, world frame. (n, 6)"""
        found = []
        for entity, body, root in zip(self._entities, self._bodies, self._roots, strict=True):
            if root and entity.root_dof is not None:
                found.append(torch.cat([entity.data.root_lin_vel_w, entity.data.root_ang_vel_w], dim=1))
            else:
                found.append(self._spatial(body))
        return _rows(_joined(found), self._index(indices))

    def get_linear_velocities(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Linear velocities, world frame. (n, 3) [m/s]"""
        return self.get_velocities(indices)[:, :3]

    def get_angular_velocities(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Angular velocities, world frame. (n, 3) [rad/s]"""
        return self.get_velocities(indices)[:, 3:]

    def set_velocities(self, velocities: Any, indices: Any = None) -> None:
        """Set velocities of what is free to move, world frame. (n, 6) [m/s, rad/s]"""
        velocities = self._tensor(velocities).reshape(-1, 6)
        for which, (entity, root) in enumerate(zip(self._entities, self._roots, strict=True)):
            if not root or entity.root_qpos is None or entity.root_dof is None:
                continue
            rows, pick = self._rows_of(which, indices)
            given = velocities[pick]
            quat = self.env.sim.qpos[rows, entity.root_qpos + 3 : entity.root_qpos + 7]
            local = torch.cat([given[:, :3], rotate_inverse(quat, given[:, 3:])], dim=1)
            self._write("qvel", rows, slice(entity.root_dof, entity.root_dof + 6), local)

    def set_linear_velocities(self, velocities: Any, indices: Any = None) -> None:
        """Set linear velocities, world frame. (n, 3) [m/s]"""
        kept = self.get_velocities(indices)[:, 3:]
        self.set_velocities(torch.cat([self._tensor(velocities), kept], dim=1), indices)

    def set_angular_velocities(self, velocities: Any, indices: Any = None) -> None:
        """Set angular velocities, world frame. (n, 3) [rad/s]"""
        kept = self.get_velocities(indices)[:, :3]
        self.set_velocities(torch.cat([kept, self._tensor(velocities)], dim=1), indices)

    def get_default_state(self) -> Any:
        """Poses as they are."""
        return self.get_world_poses()

    def set_visibilities(self, visibilities: Any, indices: Any = None) -> None:
        """Nothing: what is seen follows the model."""

    # --- shared ---

    def _spatial(self, body: int) -> Tensor:
        """Linear and angular velocity of a body's frame, world frame. (num_envs, 6)"""
        sim, model = self.env.sim, self.env.engine.model
        turning, moving = sim.derived_field("cvel")[:, body].split(3, dim=1)
        arm = sim.derived_field("xpos")[:, body] - sim.derived_field("subtree_com")[:, int(model.body_rootid[body])]
        return torch.cat([moving + torch.linalg.cross(turning, arm), turning], dim=1)

    def _tensor(self, values: Any) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self.env.device)

    def _index(self, indices: Any) -> Tensor | None:
        if indices is None:
            return None
        return torch.as_tensor(indices, device=self.env.device).long().reshape(-1)

    def _rows_of(self, which: int, indices: Any) -> tuple[Tensor, Any]:
        """Environments of the picked rows of one of the bodies, and which of the given values are theirs."""
        index = self._index(indices)
        if index is None:
            return torch.arange(self.env.num_envs, device=self.env.device), slice(which, None, self._per_env)
        if self._per_env == 1:
            return index, slice(None)
        mine = index % self._per_env == which
        return index[mine] // self._per_env, mine

    def _write(self, name: str, rows: Tensor, columns: slice | Tensor, values: Tensor) -> None:
        sim = self.env.sim
        for field in (self.env.engine.field(name), getattr(sim, name)):  # what getters read follows at once
            if isinstance(columns, slice):
                field[rows, columns] = values.to(field.dtype)
            else:
                field[rows[:, None], columns] = values.to(field.dtype)
        sim.stamp += 1


class RigidPrimView(XFormPrimView):
    """Bodies: links of robots, or things of their own."""

    def __init__(
        self, prim_paths_expr: str, name: str = "rigid_prim_view", reset_xform_properties: bool = True,
        track_contact_forces: bool = False, prepare_contact_sensors: bool = False, **kwargs: Any,
    ):  # fmt: skip
        super().__init__(prim_paths_expr, name, reset_xform_properties)
        self._track_contact_forces = track_contact_forces

    def apply_forces(self, forces: Any, indices: Any = None, is_global: bool = True) -> None:
        """Push at the centres of mass until the end of this step. (n, 3) [N], world frame or the bodies' own"""
        self.apply_forces_and_torques_at_pos(forces, None, None, indices, is_global)

    def apply_forces_and_torques_at_pos(
        self,
        forces: Any = None,
        torques: Any = None,
        positions: Any = None,
        indices: Any = None,
        is_global: bool = True,
    ) -> None:
        """Push and turn until the end of this step. (n, 3) each: [N], [N m], [m]

        Args:
            forces: at the positions, or at the centres of mass.
            torques: about the bodies' centres of mass.
            positions: where forces act, in the same frame: of the world (the grid included), or of the body.
            indices: rows; None: all.
            is_global: in the world's frame, or in each body's.
        """
        field = self.env.engine.field("xfrc_applied")
        given = [None if v is None else self._tensor(v).reshape(-1, 3) for v in (forces, torques, positions)]
        for which, body in enumerate(self._bodies):
            rows, pick = self._rows_of(which, indices)
            force, turn, place = (None if v is None else v[pick] for v in given)
            wrench = self._wrench(body, rows, force, turn, place, is_global)
            field[rows, body] = field[rows, body] * 0.0 + wrench.to(field.dtype)
        self.env.pushed = True

    def get_masses(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Masses. (n,) [kg]"""
        return _rows(self._model_field("body_mass").reshape(-1), self._index(indices))

    def set_masses(self, masses: Any, indices: Any = None) -> None:
        """Set masses; inertias follow in proportion. (n,) [kg]"""
        masses = self._tensor(masses).reshape(-1)
        mass, inertia = self.env.engine.expand("body_mass"), self.env.engine.expand("body_inertia")
        for which, body in enumerate(self._bodies):
            rows, pick = self._rows_of(which, indices)
            new = masses[pick].to(mass.dtype)
            inertia[rows, body] *= (new / mass[rows, body])[:, None]
            mass[rows, body] = new
        self.env.engine.set_constants()

    def get_inertias(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Diagonals of the inertias, as 3 x 3 matrices. (n, 9) [kg m^2]"""
        diagonal = self._model_field("body_inertia").reshape(-1, 3)
        return _rows(torch.diag_embed(diagonal).reshape(-1, 9), self._index(indices))

    def get_net_contact_forces(self, indices: Any = None, clone: bool = True, dt: float = 1.0) -> Tensor:
        """Sum of the contact forces on each body in the last substep, world frame. (n, 3) [N]"""
        forces = torch.stack([self.env.contact_force(body) for body in self._bodies], dim=1).reshape(-1, 3)
        return _rows(forces, self._index(indices))

    def enable_gravities(self, indices: Any = None) -> None:
        """Let gravity act."""
        self._gravity(0.0, indices)

    def disable_gravities(self, indices: Any = None) -> None:
        """Let no gravity act."""
        self._gravity(1.0, indices)

    def _gravity(self, compensation: float, indices: Any) -> None:
        if not self.env.engine.model.ngravcomp:  # MuJoCo compensates in no body then
            hint = "call disable_gravities in the file of the task's class"
            raise TaskError(f"view '{self.name}': gravity cannot be lifted", hint=hint)
        field = self.env.engine.expand("body_gravcomp")
        for which, body in enumerate(self._bodies):
            rows, _ = self._rows_of(which, indices)
            field[rows, body] = compensation

    def _model_field(self, name: str) -> Tensor:
        return self.env.engine.expand(name)[:, self._bodies].float()

    def _wrench(
        self, body: int, rows: Tensor, force: Tensor | None, turn: Tensor | None, place: Tensor | None, is_global: bool
    ) -> Tensor:
        sim = self.env.sim
        zero = torch.zeros(len(rows), 3, device=self.env.device)
        force, turn = zero if force is None else force, zero if turn is None else turn
        if not is_global:
            quat = sim.derived_field("xquat")[rows, body]
            force, turn = rotate(quat, force), rotate(quat, turn)
            if place is not None:
                place = rotate(quat, place) + sim.derived_field("xpos")[rows, body]
        elif place is not None:
            place = place - self.env.env_origins[rows]
        if place is not None:
            turn = turn + torch.linalg.cross(place - sim.derived_field("xipos")[rows, body], force)
        return torch.cat([force, turn], dim=1)


class ArticulationView(XFormPrimView):
    """Robots: one an environment. Columns are its hinge and slide joints, breadth first."""

    def __init__(
        self, prim_paths_expr: str, name: str = "articulation_prim_view", reset_xform_properties: bool = True,
        enable_dof_force_sensors: bool = False, **kwargs: Any,
    ):  # fmt: skip
        super().__init__(prim_paths_expr, name, reset_xform_properties)

    def _bind(self) -> None:
        entity = self._entities[0]
        if any(other is not entity for other in self._entities):
            names = listing(other.name for other in self._entities)
            raise TaskError(f"view '{self.name}': '{self.prim_paths_expr}' matches several robots: {names}")
        model, device = self.env.engine.model, self.env.device
        # a view of a robot is a view of its root, whichever of its links the path names
        self._entities, self._bodies, self._per_env = [entity], [entity.root_body], 1
        self._roots, self._mocap = [True], [int(model.body_mocapid[entity.root_body])]
        self._origins = self.env.env_origins
        self.entity = entity
        bodies = _breadth_first(model, entity.body_ids.tolist())
        by_id = dict(zip(entity.body_ids.tolist(), entity.names["Bodies"], strict=True))
        self._body_ids = bodies
        self._body_names = [by_id[body] for body in bodies]
        self._body_indices = {name: index for index, name in enumerate(self._body_names)}
        joints = sorted(range(len(entity.joint_ids)), key=lambda j: bodies.index(model.jnt_bodyid[entity.joint_ids[j]]))
        self._order = torch.tensor(joints, dtype=torch.int64, device=device)
        self._dof_names = [entity.joint_names[j] for j in joints]
        self._dof_indices = {name: index for index, name in enumerate(self._dof_names)}
        self._qpos_columns, self._dof_columns = entity.qpos_columns[self._order], entity.dof_columns[self._order]
        self._limits = entity.data.joint_pos_limits[self._order]
        self._drives = {kind: self._actuators(kind, joints) for kind in ("motor", "position", "velocity")}
        driven = set(self._drives["motor"][0].tolist())
        self._bare = torch.tensor([j for j in range(len(joints)) if j not in driven], dtype=torch.int64, device=device)
        zeros = torch.zeros(self.env.num_envs, len(joints), device=device)
        self._efforts, self._position_targets, self._velocity_targets = zeros.clone(), zeros.clone(), zeros.clone()
        self._wrench_columns: Tensor | None = None
        self._max_efforts: Tensor | None = None

    @property
    def num_dof(self) -> int:
        """Hinge and slide joints."""
        return len(self._dof_names)

    @property
    def num_bodies(self) -> int:
        """Bodies."""
        return len(self._body_names)

    @property
    def dof_names(self) -> list[str]:
        """Joint names, in column order."""
        return list(self._dof_names)

    @property
    def body_names(self) -> list[str]:
        """Body names, breadth first."""
        return list(self._body_names)

    @property
    def num_joints(self) -> int:
        """Joints between bodies."""
        return self.num_bodies - 1

    def get_dof_index(self, dof_name: str) -> int:
        """Column of a joint."""
        return _look_up(self, dof_name, self._dof_indices, "joint")

    def get_body_index(self, body_name: str) -> int:
        """Number of a body, breadth first; the root is 0."""
        return _look_up(self, body_name, self._body_indices, "body")

    def get_joint_positions(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Joint positions. (n, k) [m or rad]"""
        return self._pick(self.entity.data.joint_pos[:, self._order], indices, joint_indices)

    def get_joint_velocities(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Joint velocities. (n, k) [m/s or rad/s]"""
        return self._pick(self.entity.data.joint_vel[:, self._order], indices, joint_indices)

    def set_joint_positions(self, positions: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Set joint positions, and with them the targets of position drives. (n, k) [m or rad]"""
        rows, columns, values = self._given(positions, indices, joint_indices)
        self._write("qpos", rows, self._qpos_columns[columns], values)
        self._target("position", self._position_targets, rows, columns, values)

    def set_joint_velocities(self, velocities: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Set joint velocities, and with them the targets of velocity drives. (n, k) [m/s or rad/s]"""
        rows, columns, values = self._given(velocities, indices, joint_indices)
        self._write("qvel", rows, self._dof_columns[columns], values)
        self._target("velocity", self._velocity_targets, rows, columns, values)

    def set_joint_position_targets(self, positions: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Targets of position drives until set again. (n, k) [m or rad]

        Raises:
            TaskError: if no joint of the model has a position actuator.
        """
        self._require("position")
        self._target("position", self._position_targets, *self._given(positions, indices, joint_indices))

    def set_joint_velocity_targets(self, velocities: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Targets of velocity drives until set again. (n, k) [m/s or rad/s]

        Raises:
            TaskError: if no joint of the model has a velocity actuator.
        """
        self._require("velocity")
        self._target("velocity", self._velocity_targets, *self._given(velocities, indices, joint_indices))

    def set_joint_efforts(self, efforts: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Efforts on the joints until set again, within the limits of their motors. (n, k) [N or N m]"""
        rows, columns, values = self._given(efforts, indices, joint_indices)
        self._target("motor", self._efforts, rows, columns, values)
        if len(self._bare):  # a drive holds the joint: an effort acts beside it
            field = self.env.engine.field("qfrc_applied")
            bare = self._dof_columns[self._bare]
            efforts = self._efforts[rows[:, None], self._bare]
            if self._max_efforts is not None:
                limit = self._max_efforts[rows[:, None], self._bare]
                efforts = torch.maximum(torch.minimum(efforts, limit), -limit)
            field[rows[:, None], bare] = efforts.to(field.dtype)

    def apply_action(self, control_actions: Any, indices: Any = None) -> None:
        """An `ArticulationAction`: targets and efforts at once."""
        joints = getattr(control_actions, "joint_indices", None)
        for name, setter in (
            ("joint_positions", self.set_joint_position_targets),
            ("joint_velocities", self.set_joint_velocity_targets),
            ("joint_efforts", self.set_joint_efforts),
        ):
            values = getattr(control_actions, name, None)
            if values is not None:
                setter(values, indices, joints)

    def get_applied_joint_efforts(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Efforts as set. (n, k) [N or N m]"""
        return self._pick(self._efforts, indices, joint_indices)

    def get_joint_position_targets(self, indices: Any = None, joint_indices: Any = None) -> Tensor:
        """Targets as set. (n, k) [m or rad]"""
        return self._pick(self._position_targets, indices, joint_indices)

    def get_measured_joint_efforts(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Efforts of the actuators in the last substep, after their limits. (n, k) [N or N m]"""
        return self._pick(self.entity.data.applied_effort[:, self._order], indices, joint_indices)

    def get_measured_joint_forces(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Force and torque between each body and its parent, in the body's frame. (n, bodies, 6) [N, N m]

        Rows of the second dimension are bodies, breadth first: `_body_indices` numbers them. Zero in a start state.
        """
        if self._wrench_columns is None:
            self._wrench_columns = self._find_wrenches()
        wrench = self.env.sim.derived_field("sensordata")[:, self._wrench_columns]
        columns = self._index(joint_indices)
        return _rows(wrench if columns is None else wrench[:, columns], self._index(indices))

    def get_force_sensor_forces(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """`get_measured_joint_forces`."""
        return self.get_measured_joint_forces(indices, joint_indices)

    def get_dof_limits(self) -> Tensor:
        """Lower and upper limits, infinite where a joint has none. (num_envs, k, 2) [m or rad]"""
        return self._limits.expand(self.count, -1, -1).clone()

    def get_max_efforts(self, indices: Any = None, joint_indices: Any = None) -> Tensor:
        """Limits of the actuators, infinite where they have none. (n, k) [N or N m]"""
        return self._pick(self._limits_of_efforts(), indices, joint_indices)

    def set_max_efforts(self, values: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Limit what `set_joint_efforts` does from now on. (n, k) [N or N m]"""
        rows, columns, values = self._given(values, indices, joint_indices)
        limits = self._limits_of_efforts()
        limits[rows[:, None], columns] = values.abs()

    def get_gains(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> tuple[Tensor, Tensor]:
        """Stiffness and damping of the position drives, 0 where there is none. (n, k) each"""
        stiffness, damping = torch.zeros_like(self._efforts), torch.zeros_like(self._efforts)
        joints, actuators, _ = self._drives["position"]
        bias = self.env.engine.expand("actuator_biasprm")[:, actuators].float()
        stiffness[:, joints], damping[:, joints] = -bias[..., 1], -bias[..., 2]
        return self._pick(stiffness, indices, joint_indices), self._pick(damping, indices, joint_indices)

    def set_gains(self, kps: Any = None, kds: Any = None, indices: Any = None, joint_indices: Any = None, save_to_usd: bool = False) -> None:  # fmt: skip  # noqa: E501
        """Set stiffness and damping of the position drives. (n, k) each"""
        joints, actuators, _ = self._drives["position"]
        gain, bias = self.env.engine.expand("actuator_gainprm"), self.env.engine.expand("actuator_biasprm")
        stiffness, damping = self.get_gains()
        for table, given in ((stiffness, kps), (damping, kds)):
            if given is not None:
                rows, columns, values = self._given(given, indices, joint_indices)
                table[rows[:, None], columns] = values
        gain[:, actuators, 0] = stiffness[:, joints].to(gain.dtype)
        bias[:, actuators, 1] = -stiffness[:, joints].to(bias.dtype)
        bias[:, actuators, 2] = -damping[:, joints].to(bias.dtype)

    def get_body_masses(self, indices: Any = None, body_indices: Any = None, clone: bool = True) -> Tensor:
        """Masses, breadth first. (n, bodies) [kg]"""
        masses = self.env.engine.expand("body_mass")[:, self._body_ids].float()
        columns = self._index(body_indices)
        return _rows(masses if columns is None else masses[:, columns], self._index(indices))

    def set_body_masses(self, values: Any, indices: Any = None, body_indices: Any = None) -> None:
        """Set masses; inertias follow in proportion. (n, bodies) [kg]"""
        engine = self.env.engine
        mass, inertia = engine.expand("body_mass"), engine.expand("body_inertia")
        ids = torch.tensor(self._body_ids, device=self.env.device)
        ids = ids if body_indices is None else ids[self._index(body_indices)]
        rows = self._env_rows(indices)[:, None]
        new = self._tensor(values).reshape(len(rows), len(ids)).to(mass.dtype)
        inertia[rows, ids] *= (new / mass[rows, ids].clamp(min=1e-12))[..., None]
        mass[rows, ids] = new
        engine.set_constants()

    def set_effort_modes(self, mode: str, indices: Any = None, joint_indices: Any = None) -> None:
        """Nothing: an effort is a force."""

    def switch_control_mode(self, mode: str, indices: Any = None, joint_indices: Any = None) -> None:
        """Nothing: the model's actuators decide."""

    # --- the framework's ---

    def forget(self, ids: Tensor) -> None:
        """What was set for an ended episode does not hold in the next."""
        for table in self.tables().values():
            table[ids] = 0.0

    def tables(self) -> dict[str, Tensor]:
        """What the view carries from step to step."""
        return {"efforts": self._efforts, "positions": self._position_targets, "velocities": self._velocity_targets}

    # --- helpers ---

    def _actuators(self, kind: str, joints: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Columns that have an actuator of the kind, those actuators, and the factor that makes controls of values."""
        model, device = self.env.engine.model, self.env.device
        found = {joint: actuator for joint, actuator in self.entity.actuators_of(kind)}
        columns = [column for column, joint in enumerate(joints) if joint in found]
        actuators = [found[joints[column]] for column in columns]
        gear = np.array([model.actuator_gear[a, 0] for a in actuators], dtype=float)
        factor = 1.0 / gear if kind == "motor" else gear
        return (
            torch.tensor(columns, dtype=torch.int64, device=device),
            torch.tensor(actuators, dtype=torch.int64, device=device),
            torch.tensor(factor, dtype=torch.float32, device=device),
        )

    def _limits_of_efforts(self) -> Tensor:
        if self._max_efforts is None:
            model = self.env.engine.model
            limits = torch.full_like(self._efforts, torch.inf)
            for kind in ("motor", "position"):
                for joint, actuator in zip(*(t.tolist() for t in self._drives[kind][:2]), strict=True):
                    gear = abs(float(model.actuator_gear[actuator, 0]))
                    for limited, range_ in (
                        (model.actuator_forcelimited, model.actuator_forcerange),
                        (
                            model.actuator_ctrllimited if kind == "motor" else np.zeros(model.nu),
                            model.actuator_ctrlrange,
                        ),
                    ):
                        if limited[actuator]:
                            limits[:, joint] = limits[:, joint].clamp(max=gear * float(range_[actuator, 1]))
            self._max_efforts = limits
        return self._max_efforts

    def _find_wrenches(self) -> Tensor:
        model = self.env.engine.model
        columns = []
        for name in self._body_names:
            for suffix in (FORCE, TORQUE):
                sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, f"{self.entity.name}/{name}{suffix}")
                if sensor < 0:
                    raise TaskError(
                        f"view '{self.name}': joint forces are not measured",
                        hint="call get_measured_joint_forces in the file of the task's class",
                    )
                columns.append(list(range(model.sensor_adr[sensor], model.sensor_adr[sensor] + 3)))
        return torch.tensor(columns, device=self.env.device).reshape(len(self._body_names), 6)

    def _require(self, kind: str) -> None:
        if not len(self._drives[kind][0]):
            hint = f'give the joints <{kind} joint="..." .../> in the MJCF: USD had their gains'
            raise TaskError(f"view '{self.name}': no joint of '{self.entity.name}' has a {kind} actuator", hint=hint)

    def _target(self, kind: str, table: Tensor, rows: Tensor, columns: Tensor, values: Tensor) -> None:
        table[rows[:, None], columns] = values
        joints, controls, factor = self._drives[kind]
        if len(joints):
            chosen = table[rows[:, None], joints]
            if kind == "motor" and self._max_efforts is not None:
                limit = self._max_efforts[rows[:, None], joints]
                chosen = torch.maximum(torch.minimum(chosen, limit), -limit)
            field = self.env.engine.field("ctrl")
            field[rows[:, None], controls] = (chosen * factor).to(field.dtype)

    def _env_rows(self, indices: Any) -> Tensor:
        index = self._index(indices)
        return torch.arange(self.env.num_envs, device=self.env.device) if index is None else index

    def _given(self, values: Any, indices: Any, joint_indices: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Environments, joint columns, and the values as a table of the two."""
        rows = self._env_rows(indices)
        columns = self._index(joint_indices)
        columns = torch.arange(self.num_dof, device=self.env.device) if columns is None else columns
        table = self._tensor(values)
        if table.numel() not in (1, len(columns)) and table.numel() != len(rows) * len(columns):
            raise TaskError(
                f"view '{self.name}': values of shape {tuple(table.shape)} for {len(rows)} environments and"
                f" {len(columns)} joints",
                hint="one row for each of `indices`, one column for each of `joint_indices`",
            )
        if table.numel() == len(rows) * len(columns):
            table = table.reshape(len(rows), len(columns))
        return rows, columns, table.expand(len(rows), len(columns))

    def _pick(self, table: Tensor, indices: Any, joint_indices: Any) -> Tensor:
        columns = self._index(joint_indices)
        return _rows(table if columns is None else table[:, columns], self._index(indices))


def _look_up(view: ArticulationView, name: str, known: Mapping[str, int], what: str) -> int:
    if name not in known:
        near = did_you_mean(name, known) or f"names: {listing(known)}"
        raise TaskError(f"view '{view.name}' has no {what} '{name}'", hint=near)
    return known[name]


def _breadth_first(model: mujoco.MjModel, bodies: list[int]) -> list[int]:
    """Bodies level by level, each level in the order of its parents."""
    depth: dict[int, int] = {}
    for body in bodies:  # a parent comes before its children
        depth[body] = depth.get(int(model.body_parentid[body]), -1) + 1
    return sorted(bodies, key=lambda body: depth[body])  # stable: depth first within a level


def _joined(rows: list[Tensor]) -> Tensor:
    return rows[0] if len(rows) == 1 else torch.stack(rows, dim=1).reshape(-1, rows[0].shape[-1])


def _rows(values: Tensor, index: Tensor | None) -> Tensor:
    """Rows of a table, as a tensor of their own."""
    return values.clone() if index is None else values[index]
