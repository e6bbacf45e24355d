"""Tensor views of frames and bodies, with OmniIsaacGymEnvs' names, orders and conventions.

Joints and bodies are in breadth-first order. World positions include the environment's position on the grid.
Quaternions are (w, x, y, z). In shapes, n is the number of rows that the argument `indices` selects (None: all).
Every getter returns a new tensor. A setter may be called any number of times per step. Getters of a robot's root and
joints return the new values immediately.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import torch
from torch import Tensor

from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.sim.rotations import rotate, rotate_inverse
from rlcli_oige.prim_paths import ZERO, path_pattern
from rlcli_oige.stage import note_ignored
from rlcli_oige.user_code import Counterpart

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv


class XFormPrimView(Counterpart):
    """View of the frames or bodies that a path expression matches in each environment. Rows are ordered by environment.

    Args:
        prim_paths_expr: a path whose parts may be regular expressions: `/World/envs/.*/Ant/torso`.
        name: name of the view.
    """

    def __init__(self, prim_paths_expr: str, name: str = "view", reset_xform_properties: bool = True, **kwargs: Any):
        self.prim_paths_expr = prim_paths_expr
        self.name = name
        for option, value in kwargs.items():
            if value is not None:
                note_ignored(f"{type(self).__name__}({option}=...)", "set it with the view's methods", lost=True)
        self._non_root_link = False
        self._env: OigeEnv | None = None

    def bind(self, env: OigeEnv) -> None:
        """Connect the view to the running simulation. The environment calls this method.

        Raises:
            TaskError: if the path matches nothing.
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
        found = [body for path, body in known.items() if pattern.fullmatch(path)]
        if not found:
            near = did_you_mean(self.prim_paths_expr.replace("/.*/", "/env_0/"), known)
            raise TaskError(
                f"view '{self.name}': no prim path matches '{self.prim_paths_expr}'",
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
        """Look up what a subclass needs from the simulation, such as joints; `bind` calls it at its end."""

    def initialize(self, physics_sim_view: Any = None) -> None:
        """Do nothing: the environment connects every view to the simulation by `bind`."""

    def post_reset(self) -> None:
        """Do nothing."""

    def is_valid(self, indices: Tensor | None = None) -> bool:
        """Return whether the view is connected to a simulation."""
        return self._env is not None

    def is_physics_handle_valid(self) -> bool:
        """Return whether the view is connected to a simulation."""
        return self._env is not None

    @property
    def count(self) -> int:
        """Number of rows: environments times matches in each environment."""
        return self.env.num_envs * self._per_env

    @property
    def prim_paths(self) -> list[str]:
        """Path of each row."""
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
            hint = "call scene.add(view) in set_up_scene; views can be read from post_reset on"
            raise TaskError(f"view '{self.name}' is not connected to a simulation", hint=hint)
        return self._env

    def get_world_poses(self, indices: Any = None, clone: bool = True, usd: bool = True) -> tuple[Tensor, Tensor]:
        """Return positions [m], relative to the grid's origin, and orientations (w, x, y, z). (n, 3), (n, 4)"""
        position, quat = self.get_local_poses(indices)
        return position + select_rows(self._origins, self._index(indices)), quat

    def get_local_poses(self, indices: Any = None) -> tuple[Tensor, Tensor]:
        """Return positions [m] relative to the environment, and orientations (w, x, y, z). (n, 3), (n, 4)"""
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
        return select_rows(_interleave(positions), index), select_rows(_interleave(quats), index)

    def set_world_poses(
        self, positions: Any = None, orientations: Any = None, indices: Any = None, usd: bool = True
    ) -> None:
        """Set positions with the environment's grid position, and orientations. (n, 3) [m], (n, 4); None: unchanged

        Only roots of floating robots, free bodies and kinematic bodies move. For other bodies this method does nothing,
        as in OmniIsaacGymEnvs.
        """
        index = self._index(indices)
        if positions is not None:
            positions = self._tensor(positions) - select_rows(self._origins, index)
        self.set_local_poses(positions, orientations, indices)

    def set_local_poses(self, translations: Any = None, orientations: Any = None, indices: Any = None) -> None:
        """Set positions relative to the environment, and orientations. (n, 3) [m], (n, 4); None: unchanged"""
        for which, (entity, root, mocap) in enumerate(zip(self._entities, self._roots, self._mocap, strict=True)):
            rows, selected = self._rows_of(which, indices)
            for values, size, start in ((translations, 3, 0), (orientations, 4, 3)):
                if values is None:
                    continue
                new = self._tensor(values).reshape(-1, size)[selected]
                if mocap >= 0:
                    field = self.env.engine.field("mocap_pos" if size == 3 else "mocap_quat")
                    field[rows, mocap] = new.to(field.dtype)
                elif root and entity.root_qpos is not None:
                    self._write("qpos", rows, slice(entity.root_qpos + start, entity.root_qpos + start + size), new)

    def get_velocities(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Return linear velocities of the centres of mass and angular velocities, world frame. (n, 6) [m/s, rad/s]"""
        found = []
        for entity, body, root in zip(self._entities, self._bodies, self._roots, strict=True):
            if root and entity.root_dof is not None and entity.root_qpos is not None:
                qvel = self.env.sim.qvel[:, entity.root_dof : entity.root_dof + 6]
                quat = self.env.sim.qpos[:, entity.root_qpos + 3 : entity.root_qpos + 7]
                angular = rotate(quat, qvel[:, 3:])
                linear = qvel[:, :3] + torch.linalg.cross(angular, self._to_center(body, quat))
                found.append(torch.cat([linear, angular], dim=1))
            else:
                found.append(self._spatial(body))
        return select_rows(_interleave(found), self._index(indices))

    def get_linear_velocities(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Return linear velocities of the centres of mass, world frame. (n, 3) [m/s]"""
        return self.get_velocities(indices)[:, :3]

    def get_angular_velocities(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Return angular velocities, world frame. (n, 3) [rad/s]"""
        return self.get_velocities(indices)[:, 3:]

    def set_velocities(self, velocities: Any, indices: Any = None) -> None:
        """Set velocities of the centres of mass of free bodies and roots. (n, 6) [m/s, rad/s], world frame"""
        velocities = self._tensor(velocities).reshape(-1, 6)
        for which, (entity, root) in enumerate(zip(self._entities, self._roots, strict=True)):
            if not root or entity.root_qpos is None or entity.root_dof is None:
                continue
            rows, selected = self._rows_of(which, indices)
            new = velocities[selected]
            quat = self.env.sim.qpos[rows, entity.root_qpos + 3 : entity.root_qpos + 7]
            # qvel of a free joint: linear velocity in the world frame, angular velocity in the body frame
            arm = self._to_center(self._bodies[which], quat, rows)
            linear = new[:, :3] - torch.linalg.cross(new[:, 3:], arm)
            local = torch.cat([linear, rotate_inverse(quat, new[:, 3:])], dim=1)
            self._write("qvel", rows, slice(entity.root_dof, entity.root_dof + 6), local)

    def set_linear_velocities(self, velocities: Any, indices: Any = None) -> None:
        """Set linear velocities, world frame, and keep the angular ones. (n, 3) [m/s]"""
        kept = self.get_velocities(indices)[:, 3:]
        self.set_velocities(torch.cat([self._tensor(velocities), kept], dim=1), indices)

    def set_angular_velocities(self, velocities: Any, indices: Any = None) -> None:
        """Set angular velocities, world frame, and keep the linear ones. (n, 3) [rad/s]"""
        kept = self.get_velocities(indices)[:, :3]
        self.set_velocities(torch.cat([kept, self._tensor(velocities)], dim=1), indices)

    def get_default_state(self) -> Any:
        """Return the current poses as `positions` and `orientations`; rlcli stores no other default state."""
        return self.get_world_poses()

    def set_visibilities(self, visibilities: Any, indices: Any = None) -> None:
        """Do nothing: the model decides what is visible."""

    # --- helpers of the subclasses ---

    def _spatial(self, body: int) -> Tensor:
        """Return the velocity of a body's centre of mass, and its angular velocity, world frame. (num_envs, 6)"""
        sim, model = self.env.sim, self.env.engine.model
        # MuJoCo's cvel is (angular, linear), and linear at the centre of mass of the whole kinematic tree
        angular, linear = sim.derived_field("cvel")[:, body].split(3, dim=1)
        arm = sim.derived_field("xipos")[:, body] - sim.derived_field("subtree_com")[:, int(model.body_rootid[body])]
        return torch.cat([linear + torch.linalg.cross(angular, arm), angular], dim=1)

    def _to_center(self, body: int, quat: Tensor, rows: Any = slice(None)) -> Tensor:
        """Return the vector from a body's origin to its centre of mass, world frame. quat (n, 4) -> (n, 3) [m]"""
        expanded = self.env.engine.expanded("body_ipos")
        if expanded is not None:
            return rotate(quat, expanded[rows, body].to(quat.dtype))
        offset = torch.tensor(self.env.engine.model.body_ipos[body], dtype=quat.dtype, device=quat.device)
        return rotate(quat, offset.expand(len(quat), 3))

    def _tensor(self, values: Any) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self.env.device)

    def _index(self, indices: Any) -> Tensor | None:
        if indices is None:
            return None
        return torch.as_tensor(indices, device=self.env.device).long().reshape(-1)

    def _rows_of(self, which: int, indices: Any) -> tuple[Tensor, Any]:
        """Return the rows of one body among the view's row numbers `indices` (None: all).

        `which` is the number of the body among the view's bodies in an environment.

        Returns:
            The environment of each picked row, and an index that picks these rows from `indices`.
        """
        index = self._index(indices)
        if index is None:
            return torch.arange(self.env.num_envs, device=self.env.device), slice(which, None, self._per_env)
        if self._per_env == 1:
            return index, slice(None)
        of_body = index % self._per_env == which
        return index[of_body] // self._per_env, of_body

    def _write(self, name: str, rows: Tensor, columns: slice | Tensor, values: Tensor) -> None:
        sim = self.env.sim
        # the engine's field, and the copy that getters read
        for field in (self.env.engine.field(name), getattr(sim, name)):
            if isinstance(columns, slice):
                field[rows, columns] = values.to(field.dtype)
            else:
                field[rows[:, None], columns] = values.to(field.dtype)
        sim.stamp += 1


class RigidPrimView(XFormPrimView):
    """View of bodies: links of robots, or single bodies."""

    def __init__(
        self, prim_paths_expr: str, name: str = "rigid_prim_view", reset_xform_properties: bool = True,
        track_contact_forces: bool = False, prepare_contact_sensors: bool = False, **kwargs: Any,
    ):  # fmt: skip
        self._initial_masses = kwargs.pop("masses", None)
        super().__init__(prim_paths_expr, name, reset_xform_properties, **kwargs)
        self._track_contact_forces = track_contact_forces

    def _bind(self) -> None:
        if self._initial_masses is not None:
            self.set_masses(self._initial_masses)

    def apply_forces(self, forces: Any, indices: Any = None, is_global: bool = True) -> None:
        """Apply forces at the centres of mass until the end of this step, as `apply_forces_and_torques_at_pos` does.

        Args:
            forces: (n, 3) [N].
            indices: rows of the view; None: all.
            is_global: whether `forces` are in the world frame; otherwise they are in the frame of each body.
        """
        self.apply_forces_and_torques_at_pos(forces, None, None, indices, is_global)

    def apply_forces_and_torques_at_pos(
        self,
        forces: Any = None,
        torques: Any = None,
        positions: Any = None,
        indices: Any = None,
        is_global: bool = True,
    ) -> None:
        """Apply forces and torques until the end of this step. (n, 3) each: [N], [N m], [m]

        Args:
            forces: forces at `positions`, or at the centres of mass.
            torques: torques around the centres of mass.
            positions: points where the forces act; in the world frame they include the environment's grid position.
            indices: rows; None: all.
            is_global: whether all values are in the world frame; otherwise they are in the frame of each body.
        """
        field = self.env.engine.field("xfrc_applied")
        inputs = [None if v is None else self._tensor(v).reshape(-1, 3) for v in (forces, torques, positions)]
        for which, body in enumerate(self._bodies):
            rows, selected = self._rows_of(which, indices)
            force, torque, point = (None if v is None else v[selected] for v in inputs)
            wrench = self._wrench(body, rows, force, torque, point, is_global)
            field[rows, body] = field[rows, body] * 0.0 + wrench.to(field.dtype)
        self.env.forces_applied = True

    def get_masses(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Return masses. (n,) [kg]"""
        return select_rows(self._model_field("body_mass").reshape(-1), self._index(indices))

    def set_masses(self, masses: Any, indices: Any = None) -> None:
        """Set masses. (n,) [kg] The inertia of a body is scaled by the same factor as its mass."""
        masses = self._tensor(masses).reshape(-1)
        mass, inertia = self.env.engine.expand("body_mass"), self.env.engine.expand("body_inertia")
        for which, body in enumerate(self._bodies):
            rows, selected = self._rows_of(which, indices)
            new = masses[selected].to(mass.dtype)
            inertia[rows, body] *= (new / mass[rows, body])[:, None]
            mass[rows, body] = new
        self.env.engine.set_constants()

    def get_inertias(self, indices: Any = None, clone: bool = True) -> Tensor:
        """Return inertias as flattened diagonal 3 x 3 matrices. (n, 9) [kg m^2]"""
        diagonal = self._model_field("body_inertia").reshape(-1, 3)
        return select_rows(torch.diag_embed(diagonal).reshape(-1, 9), self._index(indices))

    def get_net_contact_forces(self, indices: Any = None, clone: bool = True, dt: float = 1.0) -> Tensor:
        """Return the sum of the contact forces on each body in the last physics step, world frame. (n, 3) [N]

        `dt` has no effect.
        """
        forces = torch.stack([self.env.contact_force(body) for body in self._bodies], dim=1).reshape(-1, 3)
        return select_rows(forces, self._index(indices))

    def enable_gravities(self, indices: Any = None) -> None:
        """Turn gravity on for the bodies of some rows (indices); None: all rows."""
        if self.env.engine.model.ngravcomp:  # otherwise the model has no gravity compensation, so gravity is on already
            self._set_gravity_compensation(0.0, indices)

    def disable_gravities(self, indices: Any = None) -> None:
        """Turn gravity off for the bodies of some rows (indices); None: all rows."""
        self._set_gravity_compensation(1.0, indices)

    def _set_gravity_compensation(self, compensation: float, indices: Any) -> None:
        if not self.env.engine.model.ngravcomp:  # MuJoCo skips it if no body of the compiled model has it
            why = "the model was built without gravity compensation, because the task's file does not mention"
            hint = "move this call into the file of the task's class"
            raise TaskError(f"view '{self.name}': {why} disable_gravities", hint=hint)
        field = self.env.engine.expand("body_gravcomp")
        for which, body in enumerate(self._bodies):
            rows, _ = self._rows_of(which, indices)
            field[rows, body] = compensation

    def _model_field(self, name: str) -> Tensor:
        return self.env.engine.expand(name)[:, self._bodies].float()

    def _wrench(
        self,
        body: int,
        rows: Tensor,
        force: Tensor | None,
        torque: Tensor | None,
        point: Tensor | None,
        is_global: bool,
    ) -> Tensor:
        """Return force and torque at a body's centre of mass, world frame. (rows, 6)"""
        sim = self.env.sim
        zero = torch.zeros(len(rows), 3, device=self.env.device)
        force, torque = zero if force is None else force, zero if torque is None else torque
        if not is_global:
            quat = sim.derived_field("xquat")[rows, body]
            force, torque = rotate(quat, force), rotate(quat, torque)
            if point is not None:
                point = rotate(quat, point) + sim.derived_field("xpos")[rows, body]
        elif point is not None:
            point = point - self.env.env_origins[rows]
        if point is not None:
            torque = torque + torch.linalg.cross(point - sim.derived_field("xipos")[rows, body], force)
        return torch.cat([force, torque], dim=1)


def _interleave(rows: list[Tensor]) -> Tensor:
    """Return one row per environment and body. (num_envs, k) of each body -> (num_envs * bodies, k)"""
    return rows[0] if len(rows) == 1 else torch.stack(rows, dim=1).reshape(-1, rows[0].shape[-1])


def select_rows(values: Tensor, index: Tensor | None) -> Tensor:
    """Return the rows `index` of values as a new tensor; None: all rows."""
    return values.clone() if index is None else values[index]
