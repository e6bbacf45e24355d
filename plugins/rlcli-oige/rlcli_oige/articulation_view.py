"""`ArticulationView`: joints, drives and measured forces of the robots of all environments, as tensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.errors import TaskError, did_you_mean, listing
from rlcli_oige.model_edits import FORCE, TORQUE
from rlcli_oige.stage import note_ignored
from rlcli_oige.views import XFormPrimView, select_rows


class ArticulationView(XFormPrimView):
    """View of a robot in all environments. Columns are the hinge and slide joints, in breadth-first order.

    In shapes, n is the number of environments that `indices` selects, and k the number of columns that `joint_indices`
    selects (None: all).
    """

    def __init__(
        self, prim_paths_expr: str, name: str = "articulation_prim_view", reset_xform_properties: bool = True,
        enable_dof_force_sensors: bool = False, **kwargs: Any,
    ):  # fmt: skip
        super().__init__(prim_paths_expr, name, reset_xform_properties, **kwargs)

    def _bind(self) -> None:
        entity = self._entities[0]
        if any(other is not entity for other in self._entities):
            names = listing(other.name for other in self._entities)
            raise TaskError(f"view '{self.name}': '{self.prim_paths_expr}' matches several robots; name one: {names}")
        model, device = self.env.engine.model, self.env.device
        # a view of a robot is a view of its root, also if the path names one of its links
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
        without_motor = [column for column in range(len(joints)) if column not in driven]
        self._without_motor = torch.tensor(without_motor, dtype=torch.int64, device=device)
        zeros = torch.zeros(self.env.num_envs, len(joints), device=device)
        self._efforts, self._position_targets, self._velocity_targets = zeros.clone(), zeros.clone(), zeros.clone()
        self._wrench_columns: Tensor | None = None
        self._max_efforts: Tensor | None = None

    @property
    def num_dof(self) -> int:
        """Number of hinge and slide joints."""
        return len(self._dof_names)

    @property
    def num_bodies(self) -> int:
        """Number of bodies."""
        return len(self._body_names)

    @property
    def dof_names(self) -> list[str]:
        """Joint names, in column order."""
        return list(self._dof_names)

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in breadth-first order."""
        return list(self._body_names)

    @property
    def num_joints(self) -> int:
        """Number of joints, counting fixed ones: one for each body but the root."""
        return self.num_bodies - 1

    def get_dof_index(self, dof_name: str) -> int:
        """Return the index of a joint among the columns of the view."""
        return _look_up(self, dof_name, self._dof_indices, "joint")

    def get_body_index(self, body_name: str) -> int:
        """Return the index of a body in breadth-first order; the root has the index 0."""
        return _look_up(self, body_name, self._body_indices, "body")

    def get_joint_positions(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Return joint positions. (n, k) [m or rad]"""
        return self._select(self.entity.data.joint_pos[:, self._order], indices, joint_indices)

    def get_joint_velocities(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Return joint velocities. (n, k) [m/s or rad/s]"""
        return self._select(self.entity.data.joint_vel[:, self._order], indices, joint_indices)

    def set_joint_positions(self, positions: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Set joint positions, and the targets of position drives to the same values. (n, k) [m or rad]"""
        rows, columns, values = self._broadcast(positions, indices, joint_indices)
        self._write("qpos", rows, self._qpos_columns[columns], values)
        self._target("position", self._position_targets, rows, columns, values)

    def set_joint_velocities(self, velocities: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Set joint velocities, and the targets of velocity drives to the same values. (n, k) [m/s or rad/s]"""
        rows, columns, values = self._broadcast(velocities, indices, joint_indices)
        self._write("qvel", rows, self._dof_columns[columns], values)
        self._target("velocity", self._velocity_targets, rows, columns, values)

    def set_joint_position_targets(self, positions: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Set the targets of position drives, which act until the next call. (n, k) [m or rad]

        Raises:
            TaskError: if no joint of the model has a position actuator.
        """
        self._require("position")
        self._target("position", self._position_targets, *self._broadcast(positions, indices, joint_indices))

    def set_joint_velocity_targets(self, velocities: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Set the targets of velocity drives, which act until the next call. (n, k) [m/s or rad/s]

        Raises:
            TaskError: if no joint of the model has a velocity actuator.
        """
        self._require("velocity")
        self._target("velocity", self._velocity_targets, *self._broadcast(velocities, indices, joint_indices))

    def set_joint_efforts(self, efforts: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Set efforts on the joints, which act until the next call, within the motors' limits. (n, k) [N or N m]"""
        rows, columns, values = self._broadcast(efforts, indices, joint_indices)
        self._target("motor", self._efforts, rows, columns, values)
        if len(self._without_motor):  # these joints have drives, not motors: the effort is added to that of the drive
            field = self.env.engine.field("qfrc_applied")
            dofs = self._dof_columns[self._without_motor]
            efforts = self._efforts[rows[:, None], self._without_motor]
            if self._max_efforts is not None:
                limit = self._max_efforts[rows[:, None], self._without_motor]
                efforts = torch.maximum(torch.minimum(efforts, limit), -limit)
            field[rows[:, None], dofs] = efforts.to(field.dtype)

    def apply_action(self, control_actions: Any, indices: Any = None) -> None:
        """Set targets and efforts from an `ArticulationAction`; a value that is None there is not changed."""
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
        """Return the efforts that the task has set, before limits. (n, k) [N or N m]"""
        return self._select(self._efforts, indices, joint_indices)

    def get_joint_position_targets(self, indices: Any = None, joint_indices: Any = None) -> Tensor:
        """Return the position targets that the task has set; 0 before the first call. (n, k) [m or rad]"""
        return self._select(self._position_targets, indices, joint_indices)

    def get_measured_joint_efforts(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Return the efforts of the actuators in the last physics step, after limits. (n, k) [N or N m]"""
        return self._select(self.entity.data.applied_effort[:, self._order], indices, joint_indices)

    def get_measured_joint_forces(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Return force and torque between each body and its parent, body frame. (n, bodies, 6) [N, N m]

        The second dimension has the bodies in breadth-first order, as `body_names`. All values are 0 before the first
        step of an episode.
        """
        if self._wrench_columns is None:
            self._wrench_columns = self._find_force_sensors()
        wrench = self.env.sim.derived_field("sensordata")[:, self._wrench_columns]
        columns = self._index(joint_indices)
        return select_rows(wrench if columns is None else wrench[:, columns], self._index(indices))

    def get_force_sensor_forces(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> Tensor:
        """Return the result of `get_measured_joint_forces` for the same arguments. (n, bodies, 6) [N, N m]"""
        return self.get_measured_joint_forces(indices, joint_indices)

    def get_dof_limits(self) -> Tensor:
        """Return lower and upper limits; infinite for joints without limits. (num_envs, k, 2) [m or rad]"""
        return self._limits.expand(self.count, -1, -1).clone()

    def get_max_efforts(self, indices: Any = None, joint_indices: Any = None) -> Tensor:
        """Return the effort limits of the actuators; infinite for those without limits. (n, k) [N or N m]"""
        return self._select(self._effort_limits(), indices, joint_indices)

    def set_max_efforts(self, values: Any, indices: Any = None, joint_indices: Any = None) -> None:
        """Limit the efforts that `set_joint_efforts` applies from now on. (n, k) [N or N m]"""
        rows, columns, values = self._broadcast(values, indices, joint_indices)
        limits = self._effort_limits()
        limits[rows[:, None], columns] = values.abs()

    def get_gains(self, indices: Any = None, joint_indices: Any = None, clone: bool = True) -> tuple[Tensor, Tensor]:
        """Return stiffness and damping of the position drives; 0 for joints without a drive. (n, k) each"""
        stiffness, damping = torch.zeros_like(self._efforts), torch.zeros_like(self._efforts)
        joints, actuators, _ = self._drives["position"]
        bias = self.env.engine.expand("actuator_biasprm")[:, actuators].float()
        stiffness[:, joints], damping[:, joints] = -bias[..., 1], -bias[..., 2]
        return self._select(stiffness, indices, joint_indices), self._select(damping, indices, joint_indices)

    def set_gains(self, kps: Any = None, kds: Any = None, indices: Any = None, joint_indices: Any = None, save_to_usd: bool = False) -> None:  # fmt: skip  # noqa: E501
        """Set stiffness and damping of the position drives. (n, k) each"""
        joints, actuators, _ = self._drives["position"]
        gain, bias = self.env.engine.expand("actuator_gainprm"), self.env.engine.expand("actuator_biasprm")
        stiffness, damping = self.get_gains()
        for table, new in ((stiffness, kps), (damping, kds)):
            if new is not None:
                rows, columns, values = self._broadcast(new, indices, joint_indices)
                table[rows[:, None], columns] = values
        gain[:, actuators, 0] = stiffness[:, joints].to(gain.dtype)
        bias[:, actuators, 1] = -stiffness[:, joints].to(bias.dtype)
        bias[:, actuators, 2] = -damping[:, joints].to(bias.dtype)

    def get_body_masses(self, indices: Any = None, body_indices: Any = None, clone: bool = True) -> Tensor:
        """Return the masses of the bodies, in the order of `body_names`. (n, bodies) [kg]"""
        masses = self.env.engine.expand("body_mass")[:, self._body_ids].float()
        columns = self._index(body_indices)
        return select_rows(masses if columns is None else masses[:, columns], self._index(indices))

    def set_body_masses(self, values: Any, indices: Any = None, body_indices: Any = None) -> None:
        """Set the masses of bodies, and scale their inertias by the same factors. (n, bodies) [kg]"""
        engine = self.env.engine
        mass, inertia = engine.expand("body_mass"), engine.expand("body_inertia")
        ids = torch.tensor(self._body_ids, device=self.env.device)
        ids = ids if body_indices is None else ids[self._index(body_indices)]
        rows = self._env_rows(indices)[:, None]
        new = self._tensor(values).reshape(len(rows), len(ids)).to(mass.dtype)
        inertia[rows, ids] *= (new / mass[rows, ids].clamp(min=1e-12))[..., None]
        mass[rows, ids] = new
        engine.set_constants()

    @property
    def num_fixed_tendons(self) -> int:
        """Number of tendons of the robot."""
        return len(self._tendons())

    def set_fixed_tendon_properties(
        self, stiffnesses: Any = None, dampings: Any = None, limit_stiffnesses: Any = None, limits: Any = None,
        rest_lengths: Any = None, offsets: Any = None, indices: Any = None,
    ) -> None:  # fmt: skip
        """Set stiffness and damping of the tendons. (tendons,) or (n, tendons) [N/m, N s/m]

        The other properties have no effect, because the MJCF sets them; they are logged as not simulated.
        """
        tendons, rows = self._tendons(), self._env_rows(indices)[:, None]
        for name, values in (("tendon_stiffness", stiffnesses), ("tendon_damping", dampings)):
            if values is not None and tendons:
                field = self.env.engine.expand(name)
                field[rows, tendons] = self._tensor(values).to(field.dtype).expand(len(rows), len(tendons))
        others = {
            "limit_stiffnesses": limit_stiffnesses,
            "limits": limits,
            "rest_lengths": rest_lengths,
            "offsets": offsets,
        }
        for name, values in others.items():
            if values is not None and tendons:
                note_ignored(f"set_fixed_tendon_properties({name}=...)", "the MJCF's tendons set it", lost=True)

    def _tendons(self) -> list[int]:
        model = self.env.engine.model
        prefix = f"{self.entity.name}/"
        return [number for number in range(model.ntendon) if model.tendon(number).name.startswith(prefix)]

    def set_effort_modes(self, mode: str, indices: Any = None, joint_indices: Any = None) -> None:
        """Do nothing: efforts are always forces or torques."""

    def switch_control_mode(self, mode: str, indices: Any = None, joint_indices: Any = None) -> None:
        """Do nothing: the model's actuators decide the control mode."""

    # --- called by the environment ---

    def clear_targets(self, ids: Tensor) -> None:
        """Set efforts and targets to 0 for environments whose episode ended."""
        for table in self.tables().values():
            table[ids] = 0.0

    def tables(self) -> dict[str, Tensor]:
        """Return the tensors that keep their values between steps, by name."""
        return {"efforts": self._efforts, "positions": self._position_targets, "velocities": self._velocity_targets}

    # --- helpers ---

    def _actuators(self, kind: str, joints: list[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Find the actuators of one kind.

        Args:
            kind: motor, position or velocity.
            joints: index of the joint in the entity for each column of the view.

        Returns:
            Columns of the joints that have such an actuator; ids of these actuators in the model; factors by which a
            force or target of the joint becomes the actuator's control. (k,) each
        """
        model, device = self.env.engine.model, self.env.device
        found = {joint: actuator for joint, actuator in self.entity.actuators_of(kind)}
        columns = [column for column, joint in enumerate(joints) if joint in found]
        actuators = [found[joints[column]] for column in columns]
        gear = np.array([model.actuator_gear[a, 0] for a in actuators], dtype=float)
        # motor: joint force = gear * ctrl; drive: ctrl is a target in actuator space, which is gear * joint position
        factor = 1.0 / gear if kind == "motor" else gear
        return (
            torch.tensor(columns, dtype=torch.int64, device=device),
            torch.tensor(actuators, dtype=torch.int64, device=device),
            torch.tensor(factor, dtype=torch.float32, device=device),
        )

    def _effort_limits(self) -> Tensor:
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

    def _find_force_sensors(self) -> Tensor:
        model = self.env.engine.model
        columns = []
        for name in self._body_names:
            for suffix in (FORCE, TORQUE):
                sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, f"{self.entity.name}/{name}{suffix}")
                if sensor < 0:
                    raise TaskError(
                        f"view '{self.name}': the model has no sensors of joint forces. rlcli adds them only if the"
                        " file of the task's class or of the view names get_measured_joint_forces",
                        hint="move the call to that file, or name the method there in a comment",
                    )
                columns.append(list(range(model.sensor_adr[sensor], model.sensor_adr[sensor] + 3)))
        return torch.tensor(columns, device=self.env.device).reshape(len(self._body_names), 6)

    def _require(self, kind: str) -> None:
        if not len(self._drives[kind][0]):
            hint = f'add <{kind} joint="..." .../> for the joints to the MJCF: the gains were in the USD file'
            raise TaskError(f"view '{self.name}': no joint of '{self.entity.name}' has a {kind} actuator", hint=hint)

    def _target(self, kind: str, table: Tensor, rows: Tensor, columns: Tensor, values: Tensor) -> None:
        table[rows[:, None], columns] = values
        joints, controls, factor = self._drives[kind]
        if len(joints):
            values_to_apply = table[rows[:, None], joints]
            if kind == "motor" and self._max_efforts is not None:
                limit = self._max_efforts[rows[:, None], joints]
                values_to_apply = torch.maximum(torch.minimum(values_to_apply, limit), -limit)
            field = self.env.engine.field("ctrl")
            field[rows[:, None], controls] = (values_to_apply * factor).to(field.dtype)

    def _env_rows(self, indices: Any) -> Tensor:
        index = self._index(indices)
        return torch.arange(self.env.num_envs, device=self.env.device) if index is None else index

    def _broadcast(self, values: Any, indices: Any, joint_indices: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Convert the arguments of a setter to tensors.

        Args:
            values: one number, one for each joint, or one for each environment and joint.
            indices: indices of the environments; None: all.
            joint_indices: columns of the joints; None: all.

        Returns:
            Indices of the environments (n,), columns of the joints (k,), and the values (n, k).

        Raises:
            TaskError: if the number of values fits neither.
        """
        rows = self._env_rows(indices)
        columns = self._index(joint_indices)
        columns = torch.arange(self.num_dof, device=self.env.device) if columns is None else columns
        table = self._tensor(values)
        if table.numel() not in (1, len(columns)) and table.numel() != len(rows) * len(columns):
            raise TaskError(
                f"view '{self.name}': values of shape {tuple(table.shape)} for {len(rows)} environments and"
                f" {len(columns)} joints",
                hint="expected one row for each of `indices` and one column for each of `joint_indices`",
            )
        if table.numel() == len(rows) * len(columns):
            table = table.reshape(len(rows), len(columns))
        return rows, columns, table.expand(len(rows), len(columns))

    def _select(self, table: Tensor, indices: Any, joint_indices: Any) -> Tensor:
        columns = self._index(joint_indices)
        return select_rows(table if columns is None else table[:, columns], self._index(indices))


def _look_up(view: ArticulationView, name: str, known: Mapping[str, int], kind: str) -> int:
    """Return the index of a name, or raise TaskError with the valid names."""
    if name not in known:
        near = did_you_mean(name, known) or f"names: {listing(known)}"
        raise TaskError(f"view '{view.name}' has no {kind} '{name}'", hint=near)
    return known[name]


def _breadth_first(model: mujoco.MjModel, bodies: list[int]) -> list[int]:
    """Return bodies ordered by depth; bodies of equal depth keep the order of their parents."""
    depth: dict[int, int] = {}
    for body in bodies:  # a parent comes before its children
        depth[body] = depth.get(int(model.body_parentid[body]), -1) + 1
    return sorted(bodies, key=lambda body: depth[body])  # a stable sort keeps the order within a level
