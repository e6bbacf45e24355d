"""Command terms: goals for the policy, such as a target velocity. `command` is the present goal, (num_envs, k)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.term import EntityTerm, Term
from rlcli.mdp.term_helpers import distance_to_goal, goal_in_world, goal_quat_in_world
from rlcli.scene.entity_mirror import QUATERNION, VECTOR
from rlcli.scene.reachable_positions import reachable_positions
from rlcli.sim.env_selection import Selection, one_column
from rlcli.sim.markers import ACTUAL, COMMANDED, Arrow, Color, Frame, Marker, Sphere
from rlcli.sim.rotations import atan2, from_euler, heading, rotate, rotate_inverse, unique, wrap_to_pi, yaw_only
from rlcli.sim.saved_tensors import TensorState
from rlcli.task import Bodies, Joints, Range

_ARM = 0.5
"""Distance ahead of the root at which an arrow shows the yaw rate [m]."""


@dataclass(eq=False)
class NullCommand(Term):
    """No command. (num_envs, 0)  Isaac Lab: NullCommand."""

    mirror_signs = ()

    def __post_init__(self) -> None:
        self.command = torch.zeros(self.env.num_envs, 0, device=self.env.device)

    def resample(self, selection: Selection) -> None:
        """Do nothing: the command is not random."""

    def update(self) -> None:
        """Do nothing: the command is empty."""


@dataclass(kw_only=True, eq=False)
class _VelocityCommand(EntityTerm, TensorState):
    """Base class of velocity commands: random velocities, 0 where the robot is to stand still.

    rel_standing: fraction of the commands that are zero, so that the robot is to stand.
    """

    elements = ("vx", "vy", "wz")
    units = ("m/s", "m/s", "rad/s")
    mirror_signs = (1, -1, -1)

    rel_standing: float = 0.0

    def __post_init__(self) -> None:
        n, device = self.env.num_envs, self.env.device
        self.command = torch.zeros(n, 3, device=device)
        self._drawn = torch.zeros(n, 3, device=device)
        self._stands = torch.zeros(n, dtype=torch.bool, device=device)

    def _draw_standing(self, selection: Selection) -> None:
        selection.write(self._stands, selection.uniform(0.0, 1.0) < self.rel_standing)

    def update(self) -> None:
        """Compute the command of this step: the drawn velocity, or zero where the robot is to stand."""
        self.command.copy_(self._drawn)
        self._control_heading()
        self.command.mul_(~self._stands[:, None])

    def _control_heading(self) -> None:
        """Replace the yaw rate in the environments in which a heading is commanded."""

    def metrics(self) -> dict[str, Tensor]:
        """Return the errors of the root's velocity in its own frame [m/s, rad/s]. (num_envs,) each"""
        data = self.entity.data
        dx, dy = (self.command[:, :2] - data.root_lin_vel_b[:, :2]).unbind(1)
        return {
            "error_vel_xy": (dx.square() + dy.square()).sqrt(),
            "error_vel_yaw": (self.command[:, 2] - data.root_ang_vel_b[:, 2]).abs(),
        }

    def markers(self) -> list[Marker]:
        """Return arrows above the root: green for the command, blue for the actual velocity.

        An arrow above the root shows how far the root moves in one second. An arrow ahead of the root shows the yaw
        rate: how far the start point of the arrow moves sideways in one second.
        """
        data = self.entity.data
        actual = torch.cat([data.root_lin_vel_b[:, :2], data.root_ang_vel_b[:, 2:]], dim=1)
        commanded = self._arrows(self.command, COMMANDED, 0.5, "commanded")
        return [*commanded, *self._arrows(actual, ACTUAL, 0.45, "actual")]

    def _arrows(self, velocity: Tensor, color: Color, height: float, kind: str) -> list[Marker]:
        """Return the arrows of a commanded or actual velocity (vx, vy, wz), at a height above the root [m]."""
        data = self.entity.data
        vx, vy, wz = velocity.unbind(1)
        zero = torch.zeros_like(vx)

        def in_world(x: Tensor, y: Tensor) -> Tensor:
            return rotate(data.root_quat_w, torch.stack([x, y, zero], dim=1))

        above = data.root_pos_w + torch.tensor([0.0, 0.0, height], device=velocity.device)
        ahead = above + in_world(zero + _ARM, zero)
        ways = ((above, above + in_world(vx, vy)), (ahead, ahead + in_world(zero, wz * _ARM)))
        labels = (f"{kind} velocity", f"{kind} yaw rate (arrow ahead)")
        return [Arrow(start, end, color, label=label) for (start, end), label in zip(ways, labels, strict=True)]

    def tensors(self) -> dict[str, Tensor]:
        """Return the sampled velocities, and a mask of the environments in which the robot is to stand."""
        return {"drawn": self._drawn, "stands": self._stands}


@dataclass(kw_only=True, eq=False)
class UniformVelocity(_VelocityCommand):
    """Uniformly drawn velocity of the root in its own frame: forward, sideways [m/s], yaw rate [rad/s]. (num_envs, 3)

    heading: range of target headings [rad]. Where a heading is commanded, the yaw rate is `heading_stiffness` [1/s] x
    the heading error, clipped to `ang_vel_z`.
    rel_heading, rel_standing: fractions of the commands that have a target heading, and that are zero.
    Isaac Lab: UniformVelocityCommand.
    """

    lin_vel_x: Range
    lin_vel_y: Range = (0.0, 0.0)
    ang_vel_z: Range = (0.0, 0.0)
    heading: Range | None = None
    heading_stiffness: float = 1.0
    rel_heading: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._ranges = (self.lin_vel_x, self.lin_vel_y, self.ang_vel_z)
        self._target = torch.zeros(self.env.num_envs, device=self.env.device)
        self._heads = torch.zeros(self.env.num_envs, dtype=torch.bool, device=self.env.device)

    def resample(self, selection: Selection) -> None:
        """Draw velocities, headings, and the environments in which the robot is to stand."""
        for column, bounds in enumerate(self._ranges):
            selection.write(self._drawn[:, column], selection.uniform(*bounds))
        if self.heading is not None:
            selection.write(self._target, selection.uniform(*self.heading))
            selection.write(self._heads, selection.uniform(0.0, 1.0) < self.rel_heading)
        self._draw_standing(selection)

    def _control_heading(self) -> None:
        if self.heading is not None:
            error = wrap_to_pi(self._target - heading(self.entity.data.root_quat_w))
            low, high = self.ang_vel_z
            turn = (self.heading_stiffness * error).clamp(low, high)
            self.command[:, 2].copy_(torch.where(self._heads, turn, self._drawn[:, 2]))

    @property
    def limits(self) -> list[Range]:
        """Ranges of the sampled velocities. [m/s, m/s, rad/s]"""
        return [(low, high) for low, high in self._ranges]

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors to save: sampled velocities and headings, and masks of standing and of headings."""
        return {**super().tensors(), "target": self._target, "heads": self._heads}


@dataclass(kw_only=True, eq=False)
class NormalVelocity(_VelocityCommand):
    """Normally drawn velocity of the root in its own frame: forward, sideways [m/s], yaw rate [rad/s]. (num_envs, 3)

    mean, std, zero_prob: of each of the three velocities; zero_prob is the probability that this velocity is zero.
    rel_standing: fraction of the commands in which all three are zero. Isaac Lab: NormalVelocityCommand.
    """

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    zero_prob: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def resample(self, selection: Selection) -> None:
        """Draw the velocities, which of them are set to zero, and in which environments the robot is to stand."""
        for column, (mean, std, zero) in enumerate(zip(self.mean, self.std, self.zero_prob, strict=True)):
            value = selection.normal(mean, std)
            selection.write(self._drawn[:, column], value * (selection.uniform(0.0, 1.0) >= zero))
        self._draw_standing(selection)

    @property
    def limits(self) -> list[Range]:
        """Range of 95 % of the samples: two standard deviations about the mean. [m/s, m/s, rad/s]"""
        return [(mean - 2.0 * std, mean + 2.0 * std) for mean, std in zip(self.mean, self.std, strict=True)]


@dataclass(kw_only=True, eq=False)
class UniformPose(EntityTerm):
    """Uniformly drawn pose of a body in the root's frame: position [m], quaternion (w, x, y, z). (num_envs, 7)

    x, y, z [m], roll, pitch, yaw [rad]: ranges. make_quat_unique: use the quaternion with w >= 0. Isaac Lab:
    UniformPoseCommand.
    """

    elements = ("x", "y", "z", "", "", "", "")
    units = ("m", "m", "m")
    mirror_signs = (*VECTOR, *QUATERNION)

    bodies: Bodies
    x: Range
    y: Range
    z: Range
    roll: Range = (0.0, 0.0)
    pitch: Range = (0.0, 0.0)
    yaw: Range = (0.0, 0.0)
    make_quat_unique: bool = False

    def __post_init__(self) -> None:
        self._body = one_column(self.bodies, len(self.entity.body_ids), "bodies")
        self._ranges = (self.x, self.y, self.z, self.roll, self.pitch, self.yaw)
        self.command = torch.zeros(self.env.num_envs, 7, device=self.env.device)
        self.command[:, 3] = 1.0

    def resample(self, selection: Selection) -> None:
        """Draw goal poses for the selected environments."""
        x, y, z, roll, pitch, yaw = (selection.uniform(*bounds) for bounds in self._ranges)
        quat = from_euler(roll, pitch, yaw)
        quat = unique(quat) if self.make_quat_unique else quat
        selection.write(self.command, torch.cat([torch.stack([x, y, z], dim=1), quat], dim=1))

    def update(self) -> None:
        """Do nothing: the goal is fixed in the root's frame."""

    @property
    def limits(self) -> list[Range]:
        """Ranges of the commanded position: x, y and z [m]."""
        return [(low, high) for low, high in self._ranges[:3]]

    @property
    def pose_w(self) -> tuple[Tensor, Tensor]:
        """Goal pose in the world frame: position [m], quaternion (w, x, y, z). (num_envs, 3), (num_envs, 4)"""
        return goal_in_world(self.entity, self), goal_quat_in_world(self.entity, self)

    @property
    def body_pose_w(self) -> tuple[Tensor, Tensor]:
        """The body's pose in the world frame: position [m], quaternion. (num_envs, 3), (num_envs, 4)"""
        data = self.entity.data
        return data.body_pos_w[:, self._body], data.body_quat_w[:, self._body]

    def metrics(self) -> dict[str, Tensor]:
        """Return the distance [m] and the angle [rad] between the body and its goal. (num_envs,) each"""
        w, x, y, z = (goal_quat_in_world(self.entity, self) * self.body_pose_w[1]).unbind(1)
        cosine = (w + x).add_(y).add_(z).abs_().clamp_(max=1.0)
        return {
            "position_error": distance_to_goal(self.entity, self.bodies, self),  # rewards read the same distance
            "orientation_error": cosine.acos_().mul_(2.0),
        }

    def markers(self) -> list[Marker]:
        """Return a green sphere at the goal, and the axes of the goal pose."""
        position, quat = self.pose_w
        return [Sphere(position, label="goal"), Frame(position, quat, label="goal")]


@dataclass(kw_only=True, eq=False)
class ReachablePosition(EntityTerm):
    """Position that a body of a robot with a fixed base can reach, in the root's frame [m]. (num_envs, 3)

    The positions are positions of the body at 2,048 random positions of `joints`, without poses in which links touch
    each other or the scene. position: range of the offset from the default joint position [m or rad]; joint limits
    apply.
    """

    elements = ("x", "y", "z")
    units = ("m", "m", "m")
    mirror_signs = VECTOR

    bodies: Bodies
    joints: Joints = ".*"
    position: Range = (-3.1415927, 3.1415927)

    def __post_init__(self) -> None:
        entity, data = self.entity, self.entity.data
        body = int(entity.body_ids[one_column(self.bodies, len(entity.body_ids), "bodies")])
        qpos = entity.engine.model.qpos0.copy()
        qpos[entity.qpos_columns.cpu()] = data.default_joint_pos[0].cpu()
        joints = entity.joint_ids[self.joints if isinstance(self.joints, slice) else self.joints.cpu()]
        found = reachable_positions(entity.engine.model, qpos, joints.tolist(), body, self.position)
        places = torch.tensor(found, dtype=torch.float32, device=self.env.device)
        root, turn = data.default_root_state[:1, :3], data.default_root_state[:1, 3:7]
        self._positions = rotate_inverse(turn.expand(len(places), 4), places - root)
        low, high = self._positions.amin(dim=0).tolist(), self._positions.amax(dim=0).tolist()
        self.limits = list(zip(low, high, strict=True))
        """Smallest and largest position along each axis [m]."""
        self.command = torch.zeros(self.env.num_envs, 3, device=self.env.device)

    def resample(self, selection: Selection) -> None:
        """Draw goal positions for the selected environments."""
        selection.write(self.command, self._positions[selection.choice(len(self._positions))])

    def update(self) -> None:
        """Do nothing: the goal is fixed in the root's frame."""

    def metrics(self) -> dict[str, Tensor]:
        """Return the distance between the body and its goal [m]. (num_envs,)"""
        return {"position_error": distance_to_goal(self.entity, self.bodies, self)}

    def markers(self) -> list[Marker]:
        """Return a green sphere at the goal."""
        return [Sphere(goal_in_world(self.entity, self), label="goal")]


@dataclass(kw_only=True, eq=False)
class UniformPose2d(EntityTerm, TensorState):
    """Uniformly drawn goal position and heading on the ground, relative to the root. (num_envs, 4)

    The columns are the goal's x, y, z in the root's yaw frame (the world frame turned by the root's heading) [m], and
    the angle from the root's heading to the goal heading [rad]. x, y: ranges from the environment's origin [m].
    heading: range in the world frame [rad]. With `simple_heading` the goal heading is the direction from the root to
    the goal position. Isaac Lab: UniformPose2dCommand.
    """

    elements = ("ahead", "left", "", "turn")
    units = ("m", "m", "m", "rad")
    mirror_signs = (1, -1, 1, -1)

    x: Range
    y: Range
    heading: Range = (-3.1415927, 3.1415927)
    simple_heading: bool = False

    def __post_init__(self) -> None:
        self._ranges = (self.x, self.y, self.heading)
        self.command = torch.zeros(self.env.num_envs, 4, device=self.env.device)
        self._target = torch.zeros(self.env.num_envs, 4, device=self.env.device)

    def resample(self, selection: Selection) -> None:
        """Draw goal positions and headings for the selected environments."""
        data = self.entity.data
        x, y, turn = (selection.uniform(*bounds) for bounds in self._ranges)
        height = selection.read_view(data.default_root_state)[:, 2]
        selection.write(self._target, torch.stack([x, y, height, turn], dim=1))

    def update(self) -> None:
        """Compute the goal relative to the root's present position and heading."""
        data = self.entity.data
        dx, dy, dz = (self._target[:, :3] + self.env.origins - data.root_pos_w).unbind(1)
        yaw = heading(data.root_quat_w)
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        turn = atan2(left, ahead) if self.simple_heading else wrap_to_pi(self._target[:, 3] - yaw)
        self.command.copy_(torch.stack([ahead, left, dz, turn], dim=1))

    def metrics(self) -> dict[str, Tensor]:
        """Return the remaining horizontal distance [m] and angle [rad]. (num_envs,) each"""
        x, y, _, turn = self.command.unbind(1)
        return {"error_pos_2d": (x.square() + y.square()).sqrt(), "error_heading": turn.abs()}

    def markers(self) -> list[Marker]:
        """Return a green sphere at the goal, with an arrow in the direction of the heading."""
        upright = yaw_only(self.entity.data.root_quat_w)
        goal = self.entity.data.root_pos_w + rotate(upright, self.command[:, :3])
        turn = self.command[:, 3]
        towards = torch.stack([torch.cos(turn), torch.sin(turn), torch.zeros_like(turn)], dim=1)
        tip = goal + rotate(upright, 0.5 * towards)
        return [Sphere(goal, radius=0.05, label="goal"), Arrow(goal, tip, label="goal")]

    def tensors(self) -> dict[str, Tensor]:
        """Return the goal position and heading."""
        return {"target": self._target}
