"""Class `Entity`: a robot or object of the scene, with its elements by name and methods that set its state.

Terms and direct tasks receive entities; `entity.data` has their state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.schema import EntityConfig
from rlcli.errors import TaskError
from rlcli.scene.entity_data import EntityData
from rlcli.scene.joint_and_actuator_setup import model_actuator_kind
from rlcli.scene.names import match
from rlcli.sim.acceleration_fields import sensor_columns
from rlcli.sim.column_views import as_index, id_tensor
from rlcli.sim.engine import Engine
from rlcli.sim.env_selection import ALL, Columns, Field, Selection
from rlcli.sim.rotations import cross, rotate, rotate_inverse
from rlcli.sim.state_cache import SimData

if TYPE_CHECKING:
    from rlcli.scene.actuators import ActuatorModel

KINDS = {
    "Joints": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "Bodies": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "Sites": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "Sensors": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
    "Actuators": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
    "Geoms": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "Tendons": (mujoco.mjtObj.mjOBJ_TENDON, "ntendon"),
    "Pairs": (mujoco.mjtObj.mjOBJ_PAIR, "npair"),
}
"""Kind of element, such as Joints -> (its type in MuJoCo, name of the MjModel field with the number of elements)."""
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


class Entity:
    """Robot or object of the scene, in all environments.

    Its joints are the hinges and slides in the model's order, without a free root. Methods that write or read a state
    take the environments as a `selection`; their tensors have one row for each selected environment.
    """

    def __init__(self, name: str, config: EntityConfig, engine: Engine, sim: SimData) -> None:
        self.name = name
        self.config = config
        self.engine = engine
        self.sim = sim
        model = engine.model
        self.ids = {alias: _ids(model, name, kind, getattr(model, count)) for alias, (kind, count) in KINDS.items()}
        """Ids of the entity's elements in the model, by kind: Joints, Bodies, ..."""
        self.ids["Joints"] = self.ids["Joints"][np.isin(model.jnt_type[self.ids["Joints"]], _SCALAR)]
        self.joint_ids, self.body_ids, self.site_ids = self.ids["Joints"], self.ids["Bodies"], self.ids["Sites"]
        self.actuator_ids, self.geom_ids = self.ids["Actuators"], self.ids["Geoms"]
        self.names = {alias: _names(model, name, kind, self.ids[alias]) for alias, (kind, _) in KINDS.items()}
        """Names of the entity's elements, without the prefix `ENTITY/`, by kind."""
        self.joint_names = self.names["Joints"]
        self.qpos_columns = id_tensor(model.jnt_qposadr[self.joint_ids], engine.device)
        self.dof_columns = id_tensor(model.jnt_dofadr[self.joint_ids], engine.device)
        self.root_body = int(self.body_ids[0]) if len(self.body_ids) else 0
        self.root_qpos, self.root_dof = self._root(model)
        self.mocap = int(model.body_mocapid[self.root_body])
        """Index of the root among MuJoCo's mocap bodies; -1 if the root is not a mocap body."""
        self._com = torch.tensor(model.body_ipos[self.root_body], dtype=torch.float32, device=engine.device)[None]
        self._qpos, self._qvel = engine.field("qpos"), engine.field("qvel")
        self._targets: dict[tuple[int, ...], tuple[Columns, Field, Columns]] = {}
        self.data = EntityData(self, sim)
        self.actuators: list[ActuatorModel] = []
        """Actuator models of the entity's joints; they are added after the entity is made."""

    @property
    def is_floating(self) -> bool:
        """Whether the root body has a free joint."""
        return self.root_qpos is not None

    def select(self, alias: str, patterns: str | Sequence[str]) -> tuple[Columns, list[str]]:
        """Find elements (joints, bodies, ...) of this entity by their names.

        Return an index that selects the elements in the entity's tensors, such as `data.joint_pos`, and the names of
        the elements.

        Args:
            alias: the kind of element, as a type alias of `rlcli.task`: Joints, Bodies, ...
            patterns: names or regular expressions.

        Raises:
            NameProblem: if a pattern matches no element or is not a regular expression, or an element is matched twice.
        """
        names = self.names[alias]
        singular = {"Bodies": "body"}.get(alias, alias[:-1].lower())
        positions = match(patterns, names, singular)
        if alias == "Sensors":
            columns = sensor_columns(self.engine.model, self.ids[alias][positions].tolist())
            return self._index(columns), [names[p] for p in positions]
        return self._index(positions), [names[p] for p in positions]

    def actuators_of(self, kind: str) -> list[tuple[int, int]]:
        """Return (index of the driven joint in the entity, id of the actuator) for MuJoCo's actuators of one kind.

        `kind` is motor, position, velocity or other. The motors through which actuator models
        (`scene.entities.*.actuators`) act are included as motors.
        """
        model = self.engine.model
        columns = {joint: column for column, joint in enumerate(self.joint_ids.tolist())}
        found = []
        for actuator in self.actuator_ids.tolist():
            joint = int(model.actuator_trnid[actuator, 0])
            if joint in columns and model_actuator_kind(model, actuator) == kind:
                found.append((columns[joint], actuator))
        return sorted(found)

    def write_joint_positions(self, selection: Selection, values: Tensor, joints: Columns = ALL) -> None:
        """Set joint positions of the selected environments. values (rows, k) [m or rad]"""
        field, columns = self._target(self._qpos, self.qpos_columns, joints)
        selection.write(field, values, columns)

    def write_joint_velocities(self, selection: Selection, values: Tensor, joints: Columns = ALL) -> None:
        """Set joint velocities of the selected environments. values (rows, k) [m/s or rad/s]"""
        field, columns = self._target(self._qvel, self.dof_columns, joints)
        selection.write(field, values, columns)

    def write_root_pose(self, selection: Selection, position: Tensor, quat: Tensor) -> None:
        """Set the pose of a free or mocap root, world frame. position (rows, 3) [m], quat (rows, 4) w, x, y, z"""
        if self.mocap >= 0:
            selection.write(self.engine.field("mocap_pos")[:, self.mocap], position)
            selection.write(self.engine.field("mocap_quat")[:, self.mocap], quat)
            return
        root, _ = self.floating()
        selection.write(self._qpos, torch.cat([position, quat], dim=1), slice(root, root + 7))

    def write_root_velocity(self, selection: Selection, linear_w: Tensor, angular_w: Tensor) -> None:
        """Set the root's velocity, world frame; set the pose first. For a mocap root the call does nothing.

        Args:
            selection: the environments.
            linear_w: linear velocity of the root's `velocity_point` (origin or centre of mass). (rows, 3) [m/s]
            angular_w: angular velocity. (rows, 3) [rad/s]
        """
        if self.mocap >= 0:
            return
        root, dof = self.floating()
        quat = selection.read(self._qpos, slice(root + 3, root + 7)).float()
        local = rotate_inverse(quat, angular_w)  # a free joint's angular velocity is in the body's frame
        if self.config.velocity_point == "com":
            linear_w = linear_w - self.com_velocity(quat, local, selection)
        selection.write(self._qvel, torch.cat([linear_w, local], dim=1), slice(dof, dof + 6))

    def read_root_velocity(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Return the velocity of the root's `velocity_point` and the angular velocity, world frame. (rows, 3) each

        The values are those of the engine: unlike `data.root_lin_vel_w`, they include a velocity just set.
        """
        qpos, dof = self.floating()
        velocity = selection.read(self._qvel, slice(dof, dof + 6)).float()
        quat = selection.read(self._qpos, slice(qpos + 3, qpos + 7)).float()
        linear, local = velocity[:, :3], velocity[:, 3:]
        if self.config.velocity_point == "com":
            linear = linear + self.com_velocity(quat, local, selection)
        return linear, rotate(quat, local)

    def com_velocity(self, quat: Tensor, angular_b: Tensor, selection: Selection | None = None) -> Tensor:
        """Return the velocity of the root's centre of mass relative to the root's origin, world frame. (rows, 3) [m/s]

        Args:
            quat: orientation of the root. (rows, 4)
            angular_b: angular velocity of the root, body frame. (rows, 3) [rad/s]
            selection: the environments of the rows; None: all.
        """
        com, own = self._com, self.engine.expanded("body_ipos")
        if own is not None:  # an event has randomised the masses
            com = own.view(len(own), -1, 3)[:, self.root_body].float()
            com = com if selection is None else selection.read_view(com)
        return rotate(quat, cross(angular_b, com.expand_as(angular_b)))

    def floating(self) -> tuple[int, int]:
        """Return the index of the root's free joint in qpos, and its index in qvel.

        Raises:
            TaskError: if the root is fixed to the world.
        """
        if self.root_qpos is None or self.root_dof is None:
            raise TaskError(
                f"entity '{self.name}' is fixed to the world: its root has no position or velocity to set or to read",
                hint="remove the term that does this, or let the root move: add <freejoint/> to its body (with `shape`,"
                ' set `free: true`); mocap="true" is enough if only resets move it',
            )
        return self.root_qpos, self.root_dof

    def _index(self, positions: Sequence[int]) -> Columns:
        return as_index(positions, self.engine.device)

    def _target(self, field: Tensor, field_columns: Tensor, joints: Columns) -> tuple[Field, Columns]:
        """Return (tensor, columns of the tensor) to which the values of some joints are written.

        Args:
            field: qpos or qvel of all environments.
            field_columns: the column of each joint of the entity in `field`.
            joints: which joints, as an index into the entity's joints.

        Returns:
            For joints in consecutive columns: a view of these columns, and the index of all columns of the view. For
            other joints: `field`, and the joints' columns.
        """
        index = (joints.start, joints.stop, joints.step) if isinstance(joints, slice) else (id(joints),)
        key = (id(field_columns), *index)
        if key not in self._targets:
            columns = self._index(field_columns[joints].tolist())
            if isinstance(columns, slice):
                field, columns = field[:, columns], ALL
            # the cache keeps the index alive: Python may give the id of a deleted tensor to a new one
            self._targets[key] = (joints, self.engine.as_field(field), columns)
        return self._targets[key][1:]

    def _root(self, model: mujoco.MjModel) -> tuple[int | None, int | None]:
        joint = int(model.body_jntadr[self.root_body])
        if joint < 0 or model.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_FREE):
            return None, None
        return int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])


def _ids(model: mujoco.MjModel, entity: str, kind: mujoco.mjtObj, count: int) -> NDArray[np.int64]:
    """Return the ids of the model's elements of a kind that belong to an entity, by the prefix of their names.

    `count` is the number of elements of this kind in the model.
    """
    names = [mujoco.mj_id2name(model, kind, i) or "" for i in range(count)]
    return np.array([i for i, name in enumerate(names) if name.startswith(f"{entity}/")], dtype=np.int64)


def _names(model: mujoco.MjModel, entity: str, kind: mujoco.mjtObj, ids: NDArray[np.int64]) -> list[str]:
    return [(mujoco.mj_id2name(model, kind, int(i)) or "").removeprefix(f"{entity}/") for i in ids]
