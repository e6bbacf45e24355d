"""Event terms. Each term changes the environments of a `Selection`, which also draws the random numbers.

The random numbers depend only on the seed, the term, the environment and the index of its episode. The random numbers
of interval events depend on the training step instead of the episode.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Entity, ManagedEnv
from rlcli.mdp.randomization_base import Pair, Ranges, element_names, require_supported
from rlcli.mdp.term import BodyTerm, JointTerm, Term
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import from_euler, multiply, random_quaternion
from rlcli.sim.saved_tensors import TensorState
from rlcli.task import Bodies, Joints, Range


def reset_joints_by_offset(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    position: Range = (0.0, 0.0),
    velocity: Range = (0.0, 0.0),
) -> None:
    """Reset joints to their default state plus uniform offsets [m or rad, m/s or rad/s].

    Positions are clipped to the joints' soft limits, velocities to their `velocity_limit`.
    """
    default_pos, default_vel = entity.data.read_default_joints(selection, joints)
    offset = selection.uniform(*_bounds(env, position, velocity), (2, default_pos.shape[1]))
    _write_joints(entity, selection, joints, default_pos + offset[:, 0], default_vel + offset[:, 1])


def reset_joints_by_scale(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    position: Range = (1.0, 1.0),
    velocity: Range = (1.0, 1.0),
) -> None:
    """Reset joints to their default state times uniform factors.

    Positions are clipped to the joints' soft limits, velocities to their `velocity_limit`.
    """
    default_pos, default_vel = entity.data.read_default_joints(selection, joints)
    factor = selection.uniform(*_bounds(env, position, velocity), (2, default_pos.shape[1]))
    _write_joints(entity, selection, joints, default_pos * factor[:, 0], default_vel * factor[:, 1])


def reset_joints_by_gaussian(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    position: tuple[float, float] = (0.0, 0.0),
    velocity: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Reset joints to their default state plus gaussian offsets [m or rad, m/s or rad/s].

    position, velocity: [mean, std]. Positions are clipped to the soft limits, velocities to the speed
    limits.
    """
    default_pos, default_vel = entity.data.read_default_joints(selection, joints)
    offset = selection.normal(*_bounds(env, position, velocity), (2, default_pos.shape[1]))
    _write_joints(entity, selection, joints, default_pos + offset[:, 0], default_vel + offset[:, 1])


@dataclass(kw_only=True, eq=False)
class ResetJointsWithinLimits(JointTerm):
    """Reset of joints to uniform positions between their soft limits, and to uniform velocities [m/s or rad/s].

    position: range of the position as a fraction of the way from the lower limit (0) to the upper limit (1).
    """

    position: Range = (0.0, 1.0)
    velocity: Range = (0.0, 0.0)

    def __post_init__(self) -> None:
        finite = self.entity.data.joint_limits()[0][0].isfinite().tolist()
        require_supported(
            self.entity, "Joints", self.joints, finite, "without limits", "choose joints that have a range"
        )
        self._count = len(element_names(self.entity, "Joints", self.joints))

    def __call__(self, selection: Selection) -> None:
        """Draw the joint state of the selected environments."""
        low, high = (_rows(selection, limit)[:, self.joints] for limit in self.entity.data.joint_limits(soft=True))
        drawn = selection.uniform(*_bounds(self.env, self.position, self.velocity), (2, self._count))
        position = low + (high - low) * drawn[:, 0]
        _write_joints(self.entity, selection, self.joints, position, drawn[:, 1])


def reset_root_state_uniform(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    x: Range = (0.0, 0.0),
    y: Range = (0.0, 0.0),
    z: Range = (0.0, 0.0),
    roll: Range = (0.0, 0.0),
    pitch: Range = (0.0, 0.0),
    yaw: Range = (0.0, 0.0),
    linear_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006 (read, never written)
    angular_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
) -> None:
    """Reset the root to its default state plus uniform offsets.

    x, y, z [m] are ranges along the axes of the world; linear_velocity [m/s] and angular_velocity [rad/s] have one
    range for each axis of the world. roll, pitch, yaw [rad] are ranges of a rotation in the root's default frame. The
    position is relative to the environment's origin.
    """
    default = selection.read(entity.data.default_root_state)
    offset = selection.uniform(*_bounds(env, x, y, z), (3, 1)).squeeze(2)
    turn = from_euler(*selection.uniform(*_bounds(env, roll, pitch, yaw), (3, 1)).squeeze(2).unbind(1))
    velocity = selection.uniform(*_bounds(env, *linear_velocity, *angular_velocity), (6, 1)).squeeze(2)
    position = default[:, :3] + selection.read_view(env.origins) + offset
    entity.write_root_pose(selection, position, multiply(default[:, 3:7], turn))
    entity.write_root_velocity(selection, default[:, 7:10] + velocity[:, :3], default[:, 10:] + velocity[:, 3:])


def reset_root_state_with_random_orientation(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    x: Range = (0.0, 0.0),
    y: Range = (0.0, 0.0),
    z: Range = (0.0, 0.0),
    linear_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
    angular_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
) -> None:
    """Reset the root to a uniformly random orientation, with uniform offsets of position and velocity, world frame.

    The position is relative to the environment's origin. x, y, z [m] are ranges; linear_velocity [m/s] and
    angular_velocity [rad/s] have one range for each axis.
    """
    default = selection.read(entity.data.default_root_state)
    offset = selection.uniform(*_bounds(env, x, y, z), (3, 1)).squeeze(2)
    velocity = selection.uniform(*_bounds(env, *linear_velocity, *angular_velocity), (6, 1)).squeeze(2)
    quat = random_quaternion(*selection.uniform(0.0, 1.0, (3,)).unbind(1))
    entity.write_root_pose(selection, default[:, :3] + selection.read_view(env.origins) + offset, quat)
    entity.write_root_velocity(selection, default[:, 7:10] + velocity[:, :3], default[:, 10:] + velocity[:, 3:])


def reset_scene_to_default(env: ManagedEnv, selection: Selection) -> None:
    """Reset every entity to its default state, relative to its environment's origin."""
    for entity in env.entities.values():
        data = entity.data
        if entity.joint_names:
            entity.write_joint_positions(selection, selection.read(data.default_joint_pos))
            entity.write_joint_velocities(selection, selection.read(data.default_joint_vel))
        root = selection.read(data.default_root_state)
        if entity.is_floating or entity.mocap >= 0:
            entity.write_root_pose(selection, root[:, :3] + selection.read_view(env.origins), root[:, 3:7])
            entity.write_root_velocity(selection, root[:, 7:10], root[:, 10:])


@dataclass(eq=False)
class RandomizeTerrainLevel(Term):
    """Random terrain level (difficulty) for each episode; the terrain type of the environment stays the same.

    Declare it before the event that places the robot. mjlab: `randomize_terrain`, which draws the terrain type, too.
    """

    def __post_init__(self) -> None:
        if self.env.terrain is None:
            raise ValueError("the scene has no terrain; add scene.terrain")
        self._terrain = self.env.terrain

    def __call__(self, selection: Selection) -> None:
        """Draw the levels of the selected environments."""
        self._terrain.scatter(selection)


def push_by_setting_velocity(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    linear_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
    angular_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
) -> None:
    """Add uniform samples to the root's velocity, world frame [m/s, rad/s]: one range for each axis."""
    push = selection.uniform(*_bounds(env, *linear_velocity, *angular_velocity), (6, 1)).squeeze(2)
    linear, angular = entity.read_root_velocity(selection)
    entity.write_root_velocity(selection, linear + push[:, :3], angular + push[:, 3:])


def apply_external_force_torque(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    bodies: Bodies = ".*",
    force: Range = (0.0, 0.0),
    torque: Range = (0.0, 0.0),
) -> None:
    """Apply a constant force [N] and torque [N m] to bodies, world frame.

    Each component is drawn from the range. The wrench lasts until the next sample or reset.
    """
    wrench = entity.engine.field("xfrc_applied").view(env.num_envs, -1)
    columns = _wrench_columns(entity, bodies)
    selection.write(wrench, _drawn_wrench(env, selection, len(columns) // 6, force, torque), columns)


@dataclass(kw_only=True, eq=False)
class ApplyBodyImpulse(BodyTerm, TensorState):
    """Force [N] and torque [N m] on bodies for a limited time, world frame.

    Each component is drawn from its range, and the duration from `duration_s` [s].
    """

    force: Range = (0.0, 0.0)
    torque: Range = (0.0, 0.0)
    duration_s: Range = (0.1, 0.1)

    def __post_init__(self) -> None:
        self._wrench = self.entity.engine.field("xfrc_applied").view(self.env.num_envs, -1)
        self._columns = _wrench_columns(self.entity, self.bodies)
        self._steps_left = torch.zeros(self.env.num_envs, dtype=torch.int64, device=self.env.device)

    def __call__(self, selection: Selection) -> None:
        """Apply a sampled wrench in the selected environments, and start its timer."""
        drawn = _drawn_wrench(self.env, selection, len(self._columns) // 6, self.force, self.torque)
        selection.write(self._wrench, drawn, self._columns)
        low, high = _bounds(self.env, self.duration_s)
        steps = selection.uniform(low[0], high[0], (1,))[:, 0].double() / self.env.step_dt
        steps.clamp_(max=2.0**62)  # a larger number would be negative as an integer
        selection.write(self._steps_left, (steps * (1.0 - 1e-6)).ceil_().long())

    def update(self, select: Callable[[Tensor], Selection | None], running: Tensor) -> None:
        """Count a step where an episode is running, and remove the wrenches whose time is over.

        Args:
            select: returns the environments where a mask is true.
            running: 1 where an episode is running, 0 where it has just begun. (num_envs,)
        """
        acting = self._steps_left > 0
        self._steps_left -= running * acting
        over = select(acting & (self._steps_left <= 0))
        if over is not None:
            over.write(self._wrench, 0.0, self._columns)

    def reset(self, selection: Selection) -> None:
        """Clear the timers of new episodes; the engine has cleared the wrenches."""
        selection.write(self._steps_left, 0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the remaining steps of the wrenches."""
        return {"steps_left": self._steps_left}


def _drawn_wrench(env: ManagedEnv, selection: Selection, bodies: int, force: Pair, torque: Pair) -> Tensor:
    low, high = _bounds(env, *[force] * 3, *[torque] * 3)
    return selection.uniform(low[:, 0], high[:, 0], (bodies, 6)).flatten(1)


def _bounds(env: ManagedEnv, *pairs: Pair) -> tuple[Tensor, Tensor]:
    """Return the lower and upper ends of ranges, for samples of shape (rows, ranges, k). (ranges, 1) each"""
    for pair in pairs:
        if isinstance(pair, Tensor):
            low, high = Ranges(env.device, *pairs).now()
            return low[:, None], high[:, None]
    return _fixed_bounds(env.device, *map(tuple, pairs))


@functools.lru_cache(maxsize=1024)
def _fixed_bounds(device: torch.device, *pairs: tuple[float, float]) -> tuple[Tensor, Tensor]:
    low, high = Ranges(device, *pairs).now()
    return low[:, None], high[:, None]


def _wrench_columns(entity: Entity, bodies: Bodies) -> Tensor:
    """Return the columns of k bodies' wrenches (force, torque) in a flattened row of `xfrc_applied`. (6 k,)"""
    cache: dict[int, tuple[Bodies, Tensor]] = entity.__dict__.setdefault("_wrench_columns", {})
    if id(bodies) not in cache:
        device = entity.engine.device
        ids = torch.as_tensor(entity.body_ids, device=device)[bodies]
        cache[id(bodies)] = bodies, (ids[:, None] * 6 + torch.arange(6, device=device)).flatten()
    return cache[id(bodies)][1]


def _write_joints(entity: Entity, selection: Selection, joints: Joints, position: Tensor, velocity: Tensor) -> None:
    low, high = (_rows(selection, limit) for limit in entity.data.joint_limits_of(joints, soft=True))
    entity.write_joint_positions(selection, position.clamp_(low, high), joints)
    if entity.data.has_speed_limits:
        fastest = entity.data.joint_vel_limits[joints]
        velocity = velocity.clamp(-fastest, fastest)
    entity.write_joint_velocities(selection, velocity, joints)


def _rows(selection: Selection, values: Tensor) -> Tensor:
    """Return the rows of the selected environments; a single row, which all environments share, is returned itself.

    (num_envs or 1, k) -> (n or 1, k)
    """
    return values if values.shape[0] == 1 else selection.read_view(values)
