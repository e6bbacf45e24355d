"""Adapters for what a task writes to a robot or object: joint targets, forces, and values of `root_physx_view`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.scene.jacobian import Jacobian
from rlcli.scene.joint_command import JointCommand
from rlcli.scene.model_fields import DERIVED_FROM
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import rotate
from rlcli_isaaclab.missing_names import report_once, user_place
from rlcli_isaaclab.substeps import Substeps, update_state
from rlcli_isaaclab.utils.math import skew_symmetric_matrix


class JointDrive:
    """Writer of targets of one kind (motor, position or velocity) to the joints that have such an actuator."""

    def __init__(self, env: VecEnv, entity: Entity, kind: str) -> None:
        count = len(entity.joint_names)
        modelled = {joint for actuator in entity.actuators for joint in actuator.joints}
        self._columns = [c for c in range(count) if c in modelled or c in dict(entity.actuators_of(kind))]
        self._undriven = [c for c in range(count) if c not in self._columns] if kind != "position" else []
        self._name, self._kind, self._joints = entity.name, kind, list(entity.joint_names)
        self._command = JointCommand(entity, kind, self._columns) if self._columns else None
        self._env, self._entity, self._knows_actions = env, entity, False
        self._driven: set[int] = set()
        self._checked: set[int] = set()
        self.target = torch.zeros(env.num_envs, count, device=env.device)
        if kind == "position":
            self.target.copy_(entity.data.default_joint_pos)

    def set(self, target: Tensor, joint_ids: Any, env_ids: Any) -> None:
        """Set targets of joints in some environments. (rows, joints) [m or rad, m/s or rad/s, N or N m]

        A joint without an actuator of the drive's kind ignores position targets.

        Args:
            target: values of the kind of this drive.
            joint_ids: indices or slice of the joints; None: all joints.
            env_ids: indices of the environments, one for each row; None: all environments.

        Raises:
            TaskError: for a velocity or effort target other than 0 of a joint without such an actuator.
        """
        rows = torch.arange(len(self.target)) if env_ids is None else torch.as_tensor(env_ids)
        if joint_ids is None:
            self.target[rows] = target
        elif isinstance(joint_ids, slice):
            self.target[rows, joint_ids] = target
        else:
            self.target[rows[:, None], torch.as_tensor(joint_ids)] = target
        if self._undriven and bool(self.target[:, self._undriven].any()):
            wrong = self.target[:, self._undriven].any(dim=0).nonzero()[:, 0].tolist()
            raise TaskError(
                f"the task sets {self._kind} targets of joints of '{self._name}' that have no {self._kind} actuator:"
                f" {listing(self._joints[self._undriven[i]] for i in wrong)}",
                hint=f"add {self._kind} actuators to the MJCF",
            )
        if not self._knows_actions and isinstance(self._env, ManagedEnv) and hasattr(self._env, "action_manager"):
            self._leave_out_driven(self._env)
        if self._driven and isinstance(joint_ids, list | Tensor) and id(joint_ids) not in self._checked:
            self._checked.add(id(joint_ids))
            both = self._driven & set(torch.as_tensor(joint_ids).tolist())
            if both:
                names = listing(self._joints[c] for c in sorted(both))
                report_once(f"{user_place()}the task's {self._kind} targets of {names} have no effect: an action of"
                            " Isaac Lab drives these joints")  # fmt: skip
        if self._command is not None:
            self._command.write(self.target[:, self._columns])

    def _leave_out_driven(self, env: ManagedEnv) -> None:
        """Leave the joints out that a built-in action of rlcli drives: it writes the targets of its joints itself."""
        self._knows_actions = True
        driven = {sink for term in env.action_manager.terms for sink in getattr(term.instance, "sinks", ())}
        sinks = [] if self._command is None else self._command.sinks
        free = [column for column, sink in zip(self._columns, sinks, strict=True) if sink not in driven]
        if free != self._columns:
            self._driven, self._columns = set(self._columns) - set(free), free
            self._command = JointCommand(self._entity, self._kind, free) if free else None


class BodyWrench:
    """Forces and torques that a task applies to an entity's bodies, in the body frames or the world frame."""

    def __init__(self, env: VecEnv, entity: Entity) -> None:
        self._env, self._entity = env, entity
        self._local: Tensor | None = None
        self._is_global = False
        self.is_applied = False
        """Whether `apply` is called before each physics step: by the task's code, or after `start`."""

    @property
    def local(self) -> Tensor:
        """Force and torque on each body, which act until they change. (num_envs, bodies, 6) [N, N m]"""
        if self._local is None:
            shape = (self._env.num_envs, len(self._entity.names["Bodies"]), 6)
            self._local = torch.zeros(shape, device=self._env.device)
            self.start()
        return self._local

    def start(self) -> None:
        """Make the environment call `apply` before each physics step, unless the task's own code calls it."""
        if not self.is_applied:
            self.is_applied = True
            _WrenchSteps(self._env, f"forces on {self._entity.name}", self)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the forces, for a checkpoint."""
        return {} if self._local is None else {"wrench": self._local.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the forces."""
        if "wrench" in state:
            self.local.copy_(state["wrench"])

    def set_forces_and_torques(
        self,
        forces: Any = None,
        torques: Any = None,
        *,
        body_ids: Any = None,
        env_ids: Any = None,
        is_global: bool = False,
        **other: Any,
    ) -> None:
        """Replace the forces [N] and torques [N m] on bodies. (rows, bodies, 3) each; None: unchanged

        Args:
            forces: new forces.
            torques: new torques.
            body_ids: indices of the bodies; None: all bodies.
            env_ids: indices of the environments, one for each row; None: all environments.
            is_global: whether the vectors are in the world frame, else in the frames of the bodies.
            other: further arguments of Isaac Lab's method, which have no effect.
        """
        local = self.local
        count = local.shape[1]
        rows = torch.arange(self._env.num_envs) if env_ids is None else torch.as_tensor(env_ids)
        bodies = torch.arange(count) if body_ids is None or isinstance(body_ids, slice) else torch.as_tensor(body_ids)
        for part, values in ((slice(0, 3), forces), (slice(3, 6), torques)):
            if values is not None:
                local[rows[:, None], bodies.reshape(1, -1), part] = values
        self._is_global = is_global

    def reset(self, env_ids: Any) -> None:
        """Remove the forces in the environments `env_ids`; None: in all environments."""
        if self._local is not None:
            self._local[slice(None) if env_ids is None else env_ids] = 0.0

    def apply(self) -> None:
        """Write the forces of the next physics step to the engine, in the world frame."""
        if self._local is None:
            return
        world = self._local
        update_state(self._env)
        if not self._is_global:
            quat = self._entity.data.body_quat_w
            world = torch.cat([rotate(quat, world[..., :3]), rotate(quat, world[..., 3:])], dim=-1)
        self._env.engine.field("xfrc_applied")[:, self._entity.body_ids] = world.to(torch.float64)


class _WrenchSteps(Substeps):
    """Caller of `BodyWrench.apply`. A new episode starts without forces, as in Isaac Lab."""

    def reset(self, selection: Selection) -> None:
        """Remove the forces of new episodes."""
        self._code.reset(selection.env_ids())  # type: ignore[attr-defined]


class PhysxView:
    """`root_physx_view` of an asset: those methods of PhysX's view that have a counterpart in MuJoCo."""

    def __init__(self, env: VecEnv, entity: Entity) -> None:
        self._env, self._entity = env, entity
        self._jacobians: list[Jacobian] | None = None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        known = [n for n in dir(type(self)) if not n.startswith("_")]
        hint = did_you_mean(name, known) or f"rlcli has {listing(known)}; for others use `data`"
        raise TaskError(f"root_physx_view.{name} cannot be used: rlcli has no PhysX", hint=hint)

    def _model_values(self, field: str, kind: str = "Bodies") -> Tensor:
        """Return a model field of the entity's Bodies or Geoms (`kind`), on the CPU. (num_envs, elements, ...)"""
        return self._env.engine.expand(field)[:, self._entity.ids[kind]].float().cpu()

    def _write_model(self, field: str, values: Tensor, indices: Any, kind: str = "Bodies") -> None:
        """Write values to a model field in the environments `indices` only. values (num_envs, elements, ...)"""
        target = self._env.engine.expand(field)
        rows = torch.as_tensor(indices, dtype=torch.int64, device=target.device)
        ids = torch.as_tensor(self._entity.ids[kind], dtype=torch.int64, device=target.device)
        target[rows[:, None], ids] = values.to(target)[rows]
        if field in DERIVED_FROM:
            self._env.engine.set_constants()

    def get_masses(self) -> Tensor:
        """Return masses of the bodies. (num_envs, bodies) [kg]"""
        return self._model_values("body_mass")

    def set_masses(self, masses: Tensor, indices: Any) -> None:
        """Set the masses in the environments `indices`; inertias stay. masses (num_envs, bodies) [kg]"""
        self._write_model("body_mass", masses, indices)

    def get_inertias(self) -> Tensor:
        """Return moments of inertia along the axes of `get_coms`, as matrices row by row. (num_envs, bodies, 9)"""
        return torch.diag_embed(self._model_values("body_inertia")).flatten(2)

    def set_inertias(self, inertias: Tensor, indices: Any) -> None:
        """Set the moments of inertia in the environments `indices`. inertias (num_envs, bodies, 9) [kg m^2]

        Raises:
            TaskError: for a product of inertia: MuJoCo stores the principal moments.
        """
        matrices = inertias.unflatten(-1, (3, 3))
        moments = matrices.diagonal(dim1=-2, dim2=-1)
        if not torch.equal(torch.diag_embed(moments), matrices):
            what = "root_physx_view.set_inertias: rlcli sets only xx, yy and zz; found a product of inertia"
            raise TaskError(what, hint="leave the products xy, xz and yz at 0")
        self._write_model("body_inertia", moments, indices)

    def get_coms(self) -> Tensor:
        """Return centres of mass [m] and principal axes (x, y, z, w) in the bodies' frames. (num_envs, bodies, 7)"""
        quat = self._model_values("body_iquat").roll(-1, dims=-1)
        return torch.cat([self._model_values("body_ipos"), quat], dim=-1)

    def set_coms(self, coms: Tensor, indices: Any) -> None:
        """Set centres of mass [m] and principal axes (x, y, z, w) in the environments `indices`.

        coms (num_envs, bodies, 7), in the frames of the bodies

        Raises:
            TaskError: if the model was compiled for centres of mass that do not move.
        """
        if self._env.engine.model.body_simple[self._entity.body_ids].any():
            hint = "call it in the file of an event's function: rlcli prepares the model if it finds the call there"
            what = "root_physx_view.set_coms cannot be used here: the model was compiled for fixed centres of mass"
            raise TaskError(what, hint=hint)
        self._write_model("body_ipos", coms[..., :3], indices)
        self._write_model("body_iquat", coms[..., 3:].roll(1, dims=-1), indices)

    @property
    def link_paths(self) -> list[list[str]]:
        """Paths of the bodies of each environment, for `create_rigid_body_view`."""
        names = self._entity.names["Bodies"]
        start = [f"/World/envs/env_{env}/{self._entity.name}" for env in range(self._env.num_envs)]
        return [[f"{path}/{name}" for name in names] for path in start]

    def create_rigid_body_view(self, path: str) -> SimpleNamespace:
        """Return an object with the attribute `max_shapes`: number of geoms of the body at the end of a path."""
        names = list(self._entity.names["Bodies"])
        body = self._entity.body_ids[names.index(path.rpartition("/")[2])]
        return SimpleNamespace(max_shapes=int(self._env.engine.model.body_geomnum[int(body)]))

    @property
    def max_shapes(self) -> int:
        """Number of collision shapes (geoms) of the asset."""
        return len(self._entity.ids["Geoms"])

    def get_material_properties(self) -> Tensor:
        """Return static friction, dynamic friction (equal) and restitution (0) of each geom. (num_envs, geoms, 3)"""
        friction = self._model_values("geom_friction", "Geoms")[..., 0]
        return torch.stack([friction, friction, torch.zeros_like(friction)], dim=-1)

    def set_material_properties(self, materials: Tensor, indices: Any) -> None:
        """Set the dynamic friction (column 1) of geoms in the environments `indices`. materials (num_envs, geoms, 3)"""
        if bool(materials[..., 2].any()) or not torch.equal(materials[..., 0], materials[..., 1]):
            report_once("root_physx_view.set_material_properties: only the dynamic friction is set; MuJoCo has no"
                        " static friction and no restitution")  # fmt: skip
        friction = self._model_values("geom_friction", "Geoms")
        friction[..., 0] = materials[..., 1].cpu()
        self._write_model("geom_friction", friction, indices, "Geoms")

    def get_dof_limits(self) -> Tensor:
        """Return lower and upper position limits of the joints. (num_envs, joints, 2) [m or rad]"""
        limits = self._entity.data.joint_pos_limits
        return limits.expand(self._env.num_envs, *limits.shape[-2:]).clone()

    def get_jacobians(self) -> Tensor:
        """Return the Jacobians of the origins of all bodies but the first one, which is fixed, world frame.

        (num_envs, bodies - 1, 6, joints); of the six rows the first three are linear, the others angular
        """
        if self._entity.is_floating:
            raise TaskError(
                f"root_physx_view.get_jacobians: '{self._entity.name}' has a floating base; only fixed"
                " bases are supported",
                hint="remove the free joint of its model",
            )
        count = len(self._entity.names["Bodies"])
        update_state(self._env)
        if self._jacobians is None:
            columns = list(range(len(self._entity.joint_names)))
            self._jacobians = [Jacobian(self._entity, columns, body) for body in range(1, count)]
        positions = self._entity.data.body_pos_w
        return torch.stack([jacobian(positions[:, i + 1]) for i, jacobian in enumerate(self._jacobians)], dim=1)

    def get_generalized_mass_matrices(self) -> Tensor:
        """Return the mass matrix of the asset in joint coordinates. (num_envs, joints, joints) [kg or kg m^2]"""
        inertia, motion = self._composite_inertia(), self._motion()
        forces = (inertia @ motion[..., None])[..., 0]
        matrix = torch.einsum("eid,ejd->eij", forces, motion) * self._is_below
        lower = matrix.tril()
        armature = torch.as_tensor(self._env.engine.model.dof_armature[self._dofs], dtype=torch.float32)
        return lower + lower.mT - torch.diag_embed(lower.diagonal(dim1=1, dim2=2) - armature.to(lower.device))

    def get_gravity_compensation_forces(self) -> Tensor:
        """Return the efforts that hold the joints against gravity. (num_envs, joints) [N or N m]"""
        inertia, motion = self._composite_inertia(), self._motion()
        up = torch.zeros(6, device=self._env.device)
        up[3:] = -torch.as_tensor(self._env.engine.model.opt.gravity, dtype=torch.float32)
        return (motion * (inertia @ up)).sum(dim=-1)

    def _motion(self) -> Tensor:
        """Return MuJoCo's motion axes of the joints (`cdof`), angular before linear. (num_envs, joints, 6)"""
        if self._entity.is_floating:
            raise TaskError(
                f"root_physx_view: joint inertias: '{self._entity.name}' has a floating base; only fixed"
                " bases are supported",
                hint="remove the free joint of its model",
            )
        update_state(self._env)
        self._dofs = self._entity.dof_columns.cpu().numpy()
        return self._env.sim.derived_field("cdof")[:, self._dofs]

    def _composite_inertia(self) -> Tensor:
        """Return the spatial inertia of all bodies that each joint moves. (num_envs, joints, 6, 6)"""
        model = self._env.engine.model
        bodies = model.jnt_bodyid[self._entity.joint_ids]
        parents = [_ancestors(model, int(body)) for body in bodies]
        rows = [[float(int(other) in above) for other in bodies] for above in parents]
        self._is_below = torch.tensor(rows, device=self._env.device)
        update_state(self._env)
        ten = self._env.sim.derived_field("crb")[:, bodies]
        offset = skew_symmetric_matrix(ten[..., 6:9])
        xx, yy, zz, xy, xz, yz = ten[..., :6].unbind(-1)
        turning = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).unflatten(-1, (3, 3))
        moving = ten[..., 9, None, None] * torch.eye(3, device=self._env.device)
        return torch.cat([torch.cat([turning, offset], dim=-1), torch.cat([-offset, moving], dim=-1)], dim=-2)

    def get_link_incoming_joint_force(self) -> Tensor:
        """Return force and torque of each body's parent on the body, body frame. (num_envs, bodies, 6) [N, N m]"""
        return self._entity.data.body_incoming_wrench_b


def _ancestors(model: Any, body: int) -> set[int]:
    """Return a body and the bodies between it and the world."""
    found = set()
    while body:
        found.add(body)
        body = int(model.body_parentid[body])
    return found
