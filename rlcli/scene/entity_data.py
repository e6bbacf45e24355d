"""Class `EntityData`, the state of a robot or object as terms read it: joints, root, gravity, bodies, sites."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rlcli.scene.efforts_before_limits import JointEfforts
from rlcli.scene.initial_state import default_joint_state, default_root_state, joint_speed_limits
from rlcli.sim.acceleration_fields import computes_body_forces
from rlcli.sim.column_views import MAX_CACHED_VIEWS, CachedViews, as_index, evenly_spaced, id_tensor
from rlcli.sim.env_selection import ALL, Columns, Field, Selection
from rlcli.sim.rotations import atan2, axis_x, cross, length, multiply, rotate, rotate_inverse, wrap_to_pi
from rlcli.sim.state_cache import SimData

if TYPE_CHECKING:
    from rlcli.scene.entity import Entity


class EntityData:
    """State of an entity in every environment, in float32; k is the number of its joints.

    Each environment has a world frame of its own. Do not write to the attributes: most are views of the state, which is
    set with the methods of `Entity`.
    """

    def __init__(self, entity: Entity, sim: SimData) -> None:
        self._entity = entity
        self._sim = sim
        self._at_com = entity.config.velocity_point == "com"
        self._cache: dict[str, tuple[int, Tensor]] = {}
        self._pos, self._vel = CachedViews(), CachedViews()
        self._default_pos, self._default_vel = CachedViews(), CachedViews()
        self._limit_views = {soft: (CachedViews(), CachedViews()) for soft in (False, True)}
        self._angles: dict[int, tuple[Columns, int, Tensor]] = {}
        self._defaults: dict[tuple[Any, ...], tuple[Tensor, Tensor, Field, Field]] = {}
        model, num_envs = entity.engine.model, entity.engine.num_envs
        device = entity.engine.device
        self._qpos_index = as_index(entity.qpos_columns.tolist(), device)
        self._dof_index = as_index(entity.dof_columns.tolist(), device)
        self._body_index = as_index(entity.body_ids.tolist(), device)
        # joints in consecutive columns: a view of the copied state, made once
        self._joint_pos = sim.qpos[:, self._qpos_index] if isinstance(self._qpos_index, slice) else None
        self._joint_vel = sim.qvel[:, self._dof_index] if isinstance(self._dof_index, slice) else None
        q, d = entity.root_qpos, entity.root_dof
        self._free_root: tuple[Tensor, ...] | None = None
        """Position, orientation, linear and angular velocity of a free root: views of the copied state, made once."""
        if q is not None and d is not None:
            pose, velocity = sim.qpos[:, q : q + 7], sim.qvel[:, d : d + 6]
            self._free_root = (pose[:, :3], pose[:, 3:], velocity[:, :3], velocity[:, 3:])
        ranges = torch.tensor(model.jnt_range[entity.joint_ids], dtype=torch.float32, device=device)
        limited = torch.tensor(model.jnt_limited[entity.joint_ids], dtype=torch.bool, device=device)
        infinite = torch.tensor([-torch.inf, torch.inf], device=device)
        self.joint_pos_limits = torch.where(limited[:, None], ranges, infinite)
        """Lower and upper limit of each joint, infinite for a joint without limits. (k, 2) [m or rad]"""
        soft = torch.stack(self._soft_limits(*ranges.unbind(dim=1)), dim=1)
        self.soft_joint_pos_limits = torch.where(limited[:, None], soft, infinite)
        """The limits, narrowed about their middle by `soft_joint_pos_limit_factor`. (k, 2) [m or rad]"""
        self._limits = {
            soft: tuple(end[None] for end in limits.unbind(dim=1))
            for soft, limits in ((False, self.joint_pos_limits), (True, self.soft_joint_pos_limits))
        }
        self._limited = limited
        self._joint_index = as_index(entity.joint_ids.tolist(), device)
        self._infinite = infinite
        position, velocity = (values.to(device) for values in default_joint_state(entity))
        self.default_joint_pos = position.expand(num_envs, -1).clone()
        """Default joint positions. (num_envs, k) [m or rad]"""
        self.default_joint_vel = velocity.expand(num_envs, -1).clone()
        """Default joint velocities. (num_envs, k) [m/s or rad/s]"""
        self.default_root_state = default_root_state(entity).to(device).expand(num_envs, -1).clone()
        """Default root pose and velocity, world frame: position, quat (w, x, y, z), linear, angular. (num_envs, 13)"""
        self.joint_vel_limits = joint_speed_limits(entity).to(device)
        """Speed limit of each joint, `velocity_limit`; infinite for a joint without one. (k,) [m/s or rad/s]"""
        self.has_speed_limits = bool(self.joint_vel_limits.isfinite().any())
        self._gravity = torch.tensor(model.opt.gravity, dtype=torch.float32, device=device).expand(num_envs, -1)
        self._down = _direction(self._gravity)
        self._body_columns: dict[int, tuple[Columns, Columns, Columns]] = {}
        self._site_index = as_index(entity.site_ids.tolist(), device)
        site_bodies = model.site_bodyid[entity.site_ids]
        self._site_body = id_tensor(site_bodies, device)
        self._site_quat = torch.tensor(model.site_quat[entity.site_ids], dtype=torch.float32, device=device)
        self._tree_root_of_sites = evenly_spaced(model.body_rootid[site_bodies].tolist(), device)
        self._computes_body_forces = computes_body_forces(model)
        self._efforts = JointEfforts(entity)

    @property
    def joint_pos(self) -> Tensor:
        """Joint positions. (num_envs, k) [m or rad]"""
        if self._joint_pos is not None:
            return self._joint_pos
        return self._once("joint_pos", lambda: self._sim.qpos[:, self._qpos_index])

    @property
    def joint_vel(self) -> Tensor:
        """Joint velocities. (num_envs, k) [m/s or rad/s]"""
        if self._joint_vel is not None:
            return self._joint_vel
        return self._once("joint_vel", lambda: self._sim.qvel[:, self._dof_index])

    def joint_pos_of(self, joints: Columns) -> Tensor:
        """Return `joint_pos[:, joints]`; the view is made once. (num_envs, k) [m or rad]"""
        return self._pos.of(self.joint_pos, joints)

    def joint_vel_of(self, joints: Columns) -> Tensor:
        """Return `joint_vel[:, joints]`; the view is made once. (num_envs, k) [m/s or rad/s]"""
        return self._vel.of(self.joint_vel, joints)

    def default_joint_pos_of(self, joints: Columns) -> Tensor:
        """Return `default_joint_pos[:, joints]`; the view is made once. (num_envs, k) [m or rad]"""
        return self._default_pos.of(self.default_joint_pos, joints)

    def default_joint_vel_of(self, joints: Columns) -> Tensor:
        """Return `default_joint_vel[:, joints]`; the view is made once. (num_envs, k) [m/s or rad/s]"""
        return self._default_vel.of(self.default_joint_vel, joints)

    def read_default_joints(self, selection: Selection, joints: Columns = ALL) -> tuple[Tensor, Tensor]:
        """Return the default positions and velocities of some joints in the selected environments. (rows, k) each"""
        position, velocity = self.default_joint_pos, self.default_joint_vel
        if not isinstance(joints, slice):
            return selection.read_view(position, joints), selection.read_view(velocity, joints)
        key = (joints.start, joints.stop, joints.step)
        cached = self._defaults.get(key)
        if cached is None or cached[0] is not position or cached[1] is not velocity:
            as_field = self._entity.engine.as_field
            cached = position, velocity, as_field(position[:, joints]), as_field(velocity[:, joints])
            self._defaults[key] = cached
        return selection.read_view(cached[2]), selection.read_view(cached[3])

    def joint_limits_of(self, joints: Columns, soft: bool = False) -> tuple[Tensor, Tensor]:
        """Return `joint_limits` of some joints; the views are made once. (num_envs or 1, k) each"""
        low, high = self.joint_limits(soft)
        lows, highs = self._limit_views[soft]
        return lows.of(low, joints), highs.of(high, joints)

    def joint_angle_of(self, joints: Columns) -> Tensor:
        """Return `joint_pos[:, joints]` wrapped to [-pi, pi], computed once per step. (num_envs, k) [rad]"""
        stamp, cached = self._sim.stamp, self._angles.get(id(joints))
        if cached is not None and cached[0] is joints and cached[1] == stamp:
            return cached[2]
        angle = wrap_to_pi(self.joint_pos_of(joints))
        if len(self._angles) >= MAX_CACHED_VIEWS:
            self._angles.clear()
        self._angles[id(joints)] = joints, stamp, angle
        return angle

    @property
    def joint_acc(self) -> Tensor:
        """Joint accelerations over the last physics step. (num_envs, k) [m/s^2 or rad/s^2]"""
        return self._sim.derived_field("qacc")[:, self._dof_index]

    @property
    def applied_effort(self) -> Tensor:
        """Forces of the actuators on the joints, after their limits. (num_envs, k) [N or N m]"""
        return self._sim.derived_field("qfrc_actuator")[:, self._dof_index]

    @property
    def root_pos_w(self) -> Tensor:
        """Root position, world frame. (num_envs, 3) [m]"""
        if self._entity.mocap >= 0:
            return self._sim.derived_field("mocap_pos")[:, self._entity.mocap]
        return self.default_root_state[:, :3] if self._free_root is None else self._free_root[0]

    @property
    def root_quat_w(self) -> Tensor:
        """Root orientation (w, x, y, z), world frame. (num_envs, 4)"""
        if self._entity.mocap >= 0:
            return self._sim.derived_field("mocap_quat")[:, self._entity.mocap]
        return self.default_root_state[:, 3:7] if self._free_root is None else self._free_root[1]

    @property
    def root_lin_vel_w(self) -> Tensor:
        """Linear velocity of the root's origin or centre of mass: `velocity_point`, world frame. (num_envs, 3) [m/s]"""
        return self.root_com_lin_vel_w if self._at_com else self.root_origin_lin_vel_w

    @property
    def root_origin_lin_vel_w(self) -> Tensor:
        """Velocity of the origin of the root's frame, world frame. (num_envs, 3) [m/s]"""
        return self.default_root_state[:, 7:10] if self._free_root is None else self._free_root[2]

    @property
    def root_ang_vel_b(self) -> Tensor:
        """Root angular velocity, body frame. (num_envs, 3) [rad/s]"""
        return self.default_root_state[:, 10:13] if self._free_root is None else self._free_root[3]

    @property
    def root_lin_vel_b(self) -> Tensor:
        """`root_lin_vel_w` in the body frame. (num_envs, 3) [m/s]"""
        return self._once("root_lin_vel_b", lambda: rotate_inverse(self.root_quat_w, self.root_lin_vel_w))

    @property
    def root_ang_vel_w(self) -> Tensor:
        """Root angular velocity, world frame. (num_envs, 3) [rad/s]"""
        return self._once("root_ang_vel_w", lambda: rotate(self.root_quat_w, self.root_ang_vel_b))

    @property
    def root_com_lin_vel_w(self) -> Tensor:
        """Velocity of the root's centre of mass, world frame. (num_envs, 3) [m/s]"""
        return self._once(
            "root_com_lin_vel_w",
            lambda: self.root_origin_lin_vel_w + self._entity.com_velocity(self.root_quat_w, self.root_ang_vel_b),
        )

    @property
    def forward_w(self) -> Tensor:
        """The root's x axis, world frame. (num_envs, 3)"""
        return self._once("forward_w", lambda: axis_x(self.root_quat_w))

    @property
    def heading_w(self) -> Tensor:
        """Angle of the root's x axis about the world's z axis, from the world's x axis. (num_envs,) [rad]"""
        return self._once("heading_w", lambda: atan2(self.forward_w[:, 1], self.forward_w[:, 0]))

    @property
    def gravity_w(self) -> Tensor:
        """Gravity, with its randomisation, world frame. (num_envs, 3) [m/s^2]"""
        own = self._entity.engine.expanded("opt.gravity")
        return self._gravity if own is None else self._once("gravity_w", lambda: own.float().view(-1, 3))

    @property
    def down_w(self) -> Tensor:
        """Direction of gravity, world frame, length 1; -z where gravity is 0. (num_envs, 3)"""
        if self._entity.engine.expanded("opt.gravity") is None:
            return self._down
        return self._once("down_w", lambda: _direction(self.gravity_w))

    @property
    def projected_gravity_b(self) -> Tensor:
        """Direction of gravity in the root's frame, length 1. (num_envs, 3)"""
        return self._once("projected_gravity_b", lambda: rotate_inverse(self.root_quat_w, self.down_w))

    @property
    def computed_effort(self) -> Tensor:
        """Efforts that actuators would have on the joints if no force limit applied. (num_envs, k) [N or N m]

        Actuator models: efforts of the last physics step. Motor, position and velocity actuators of MuJoCo (fixed gain,
        no bias or an affine one, no dynamics): efforts in the present state with the present controls. Others: 0.
        """
        return self._once("computed_effort", self._efforts.without_limits)

    @property
    def joint_effort_limits(self) -> Tensor:
        """Largest effort of the actuators on each joint; infinite without a limit. (1 or num_envs, k) [N or N m]

        It follows from the force limits of actuators and joints, and from the control limits of motors.
        """
        return self._once("joint_effort_limits", self._efforts.limits)

    @property
    def withheld_effort(self) -> Tensor:
        """Magnitude of the effort that the limits remove from `computed_effort`, >= 0. (num_envs, k) [N or N m]"""
        return self._once("withheld_effort", self._efforts.removed_by_limits)

    def joint_limits(self, soft: bool = False) -> tuple[Tensor, Tensor]:
        """Return the lower and upper position limits, with their randomisation. (num_envs or 1, k) each [m or rad]

        Limits are infinite for a joint without limits. `joint_pos_limits` has the limits without randomisation.
        """
        ranges = self._entity.engine.expanded("jnt_range")
        if ranges is None:
            low, high = self._limits[soft]
            return low, high
        own = self._once("joint_ranges", lambda: ranges.view(len(ranges), -1, 2)[:, self._joint_index].float())
        low, high = own.unbind(dim=2)
        if soft:
            low, high = self._soft_limits(low, high)
        return torch.where(self._limited, low, self._infinite[0]), torch.where(self._limited, high, self._infinite[1])

    @property
    def body_pos_w(self) -> Tensor:
        """Body positions, world frame. (num_envs, bodies, 3) [m]"""
        return self._sim.derived_field("xpos")[:, self._body_index]

    @property
    def body_quat_w(self) -> Tensor:
        """Body orientations (w, x, y, z), world frame. (num_envs, bodies, 4)"""
        return self._sim.derived_field("xquat")[:, self._body_index]

    @property
    def body_com_pos_w(self) -> Tensor:
        """Centres of mass of the bodies, world frame. (num_envs, bodies, 3) [m]"""
        return self._sim.derived_field("xipos")[:, self._body_index]

    @property
    def body_ang_vel_w(self) -> Tensor:
        """Angular velocities of the bodies, world frame. (num_envs, bodies, 3) [rad/s]"""
        return self._sim.derived_field("cvel")[:, self._body_index, :3]

    @property
    def body_lin_vel_w(self) -> Tensor:
        """Velocities of the bodies' `velocity_point` (origin or centre of mass), world frame. (num_envs, bodies, 3)"""
        return self._once("body_lin_vel_w", lambda: self.body_lin_vel_of(ALL))

    def body_lin_vel_of(self, bodies: Columns, point: str | None = None) -> Tensor:
        """Return `body_lin_vel_w[:, bodies]`, computed for these bodies only. (num_envs, bodies, 3) [m/s]

        point: `origin` or `com` (centre of mass); None: the entity's `velocity_point`.
        """
        columns, roots = self._columns_of(bodies)
        at_com = self._at_com if point is None else point == "com"
        return self._velocity_at(self._sim.derived_columns("xipos" if at_com else "xpos", columns), columns, roots)

    def body_states_of(self, bodies: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return `body_pos_w`, `body_quat_w`, `body_lin_vel_w` and `body_ang_vel_w` of some bodies.

        Only these bodies are copied from the engine. bodies (k,) int64 -> (num_envs, k, 3 or 4) each
        """
        columns, roots = self._columns_of(bodies)
        derived = self._sim.derived_columns
        position, velocity = derived("xpos", columns), derived("cvel", columns)
        point = derived("xipos", columns) if self._at_com else position
        linear = velocity[..., 3:] + cross(velocity[..., :3], self._from_tree_com(point, roots))
        return position, derived("xquat", columns), linear, velocity[..., :3]

    @property
    def body_lin_vel_b(self) -> Tensor:
        """Linear velocities of the bodies (`body_lin_vel_w`), each in its body's frame. (num_envs, bodies, 3) [m/s]"""
        return self._once("body_lin_vel_b", lambda: rotate_inverse(self.body_quat_w, self.body_lin_vel_w))

    @property
    def body_ang_vel_b(self) -> Tensor:
        """Angular velocities of the bodies, each in its body's frame. (num_envs, bodies, 3) [rad/s]"""
        return self._once("body_ang_vel_b", lambda: rotate_inverse(self.body_quat_w, self.body_ang_vel_w))

    @property
    def body_ang_acc_w(self) -> Tensor:
        """Angular accelerations over the last physics step, world frame. (num_envs, bodies, 3) [rad/s^2]"""
        return self._body_force("cacc")[:, self._body_index, :3]

    @property
    def body_lin_acc_w(self) -> Tensor:
        """Accelerations of each body's `velocity_point` over the last physics step, world frame.

        (num_envs, bodies, 3) [m/s^2]. The acceleration is 0 at rest and equals gravity in free fall.
        """

        def compute() -> Tensor:
            acceleration = self._body_force("cacc")[:, self._body_index]
            angular, linear = acceleration[..., :3], acceleration[..., 3:]
            point = self.body_com_pos_w if self._at_com else self.body_pos_w
            at_point = linear + cross(angular, self._from_tree_com(point, self._columns_of(ALL)[1]))
            turning = cross(self.body_ang_vel_w, self.body_lin_vel_w)
            # MuJoCo's cacc contains -gravity, as an accelerometer measures it
            return at_point + turning + self.gravity_w[:, None]

        return self._once("body_lin_acc_w", compute)

    @property
    def body_incoming_wrench_b(self) -> Tensor:
        """Force and torque that each body's parent exerts on the body, body frame. (num_envs, bodies, 6) [N, N m]

        Values of the last physics step; the torque is about the origin of the body's frame.
        """

        def compute() -> Tensor:
            wrench = self._body_force("cfrc_int")[:, self._body_index]
            force = wrench[..., 3:]
            torque = wrench[..., :3] - cross(self._from_tree_com(self.body_pos_w, self._columns_of(ALL)[1]), force)
            quat = self.body_quat_w
            return torch.cat([rotate_inverse(quat, force), rotate_inverse(quat, torque)], dim=-1)

        return self._once("body_incoming_wrench_b", compute)

    @property
    def site_pos_w(self) -> Tensor:
        """Site positions, world frame. (num_envs, sites, 3) [m]"""
        return self._sim.derived_field("site_xpos")[:, self._site_index]

    @property
    def site_quat_w(self) -> Tensor:
        """Site orientations (w, x, y, z), world frame. (num_envs, sites, 4)"""
        return self._once(
            "site_quat_w",
            lambda: multiply(self._sim.derived_field("xquat")[:, self._site_body], self._site_quat),
        )

    @property
    def site_ang_vel_w(self) -> Tensor:
        """Angular velocities of the sites, world frame. (num_envs, sites, 3) [rad/s]"""
        return self._sim.derived_field("cvel")[:, self._site_body, :3]

    @property
    def site_lin_vel_w(self) -> Tensor:
        """Linear velocities of the sites, world frame. (num_envs, sites, 3) [m/s]"""
        bodies, roots = self._site_body, self._tree_root_of_sites
        return self._once("site_lin_vel_w", lambda: self._velocity_at(self.site_pos_w, bodies, roots))

    @property
    def sensordata(self) -> Tensor:
        """All sensor readings of the model, in the units of each sensor. (num_envs, nsensordata)"""
        return self._sim.derived_field("sensordata")

    def _soft_limits(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Return lower and upper limits, narrowed about their middle by `soft_joint_pos_limit_factor`. (..., k) each"""
        middle, half = 0.5 * (low + high), 0.5 * self._entity.config.soft_joint_pos_limit_factor * (high - low)
        return middle - half, middle + half

    def _columns_of(self, bodies: Columns) -> tuple[Columns, Columns]:
        """Return the model ids of some bodies of the entity, and of the roots of their kinematic trees; cached."""
        found = self._body_columns.get(id(bodies))
        if found is None:
            model, device = self._entity.engine.model, self._entity.engine.device
            ids = self._entity.body_ids[bodies if isinstance(bodies, slice) else bodies.cpu().numpy()]
            index = (ids, model.body_rootid[ids])
            columns, roots = (evenly_spaced(part.tolist(), device) for part in index)
            # the cache keeps the index alive: Python may give the id of a deleted object to a new one
            found = self._body_columns[id(bodies)] = bodies, columns, roots
        return found[1:]

    def _velocity_at(self, points: Tensor, bodies: Columns, roots: Columns) -> Tensor:
        """Return the linear velocities of points (num_envs, n, 3) of n bodies, world frame. (num_envs, n, 3) [m/s]

        `bodies` are the ids of the bodies, `roots` those of the root bodies of their kinematic trees.
        """
        # MuJoCo's cvel is the velocity at the centre of mass of the body's kinematic tree
        velocity = self._sim.derived_columns("cvel", bodies)
        return velocity[..., 3:] + cross(velocity[..., :3], self._from_tree_com(points, roots))

    def _from_tree_com(self, points: Tensor, roots: Columns) -> Tensor:
        """Return the vectors from the centres of mass of kinematic trees (ids of their roots: `roots`) to points."""
        return points - self._sim.derived_columns("subtree_com", roots)

    def _body_force(self, name: str) -> Tensor:
        if not self._computes_body_forces:
            raise ValueError(
                "the term reads accelerations or forces of bodies, which MuJoCo computes only if a sensor needs them;"
                " mark it with rlcli.task.reads_body_forces, or add an accelerometer, force or torque sensor to the"
                " MJCF"
            )
        return self._sim.derived_field(name)

    def _once(self, name: str, compute: Callable[[], Tensor]) -> Tensor:
        """Return `compute()`, cached under `name` until the state changes."""
        stamp, value = self._cache.get(name, (-1, None))
        if stamp != self._sim.stamp or value is None:
            value = compute()
            self._cache[name] = (self._sim.stamp, value)
        return value


def _direction(gravity: Tensor) -> Tensor:
    """Return the direction of gravity, length 1; -z where gravity is 0. (n, 3)"""
    size = length(gravity)[:, None]
    down = torch.zeros_like(gravity)
    down[:, 2].fill_(-1.0)
    return torch.where(size > 0.0, gravity / size, down)
