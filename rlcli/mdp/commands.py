"""Command terms: each keeps what is asked of the policy in `command`, (num_envs, k)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.mdp.parameters import Entity
from rlcli.mdp.term import Term
from rlcli.sim.markers import ACTUAL, COMMANDED, Arrow, Color, Frame, Marker, Sphere
from rlcli.sim.rotations import atan2, from_euler, heading, multiply, rotate, unique, wrap_to_pi, yaw_only
from rlcli.sim.selection import Selection, one_column
from rlcli.sim.tensor_state import TensorState
from rlcli.task import Bodies, Range

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv

_ARM = 0.5
"""How far ahead of the root the point is that shows how it turns [m]."""


class NullCommand:
    """Nothing is asked. (num_envs, 0)  Isaac Lab: NullCommand."""

    def __init__(self, env: ManagedEnv) -> None:
        self.command = torch.zeros(env.num_envs, 0, device=env.device)

    def resample(self, selection: Selection) -> None:
        """Nothing to draw."""

    def update(self) -> None:
        """Nothing to do."""


class _VelocityCommand(TensorState):
    """`drawn` (num_envs, 3) is what was asked; `command` is that after heading control and standing."""

    elements = ("vx", "vy", "wz")

    def __init__(
        self, env: ManagedEnv, entity: Entity, toward: Range | None, rel_standing: float, rel_heading: float, kp: float
    ) -> None:
        n, device = env.num_envs, env.device
        self._entity = entity
        self._heading, self._rel_standing, self._rel_heading, self._kp = toward, rel_standing, rel_heading, kp
        self.command = torch.zeros(n, 3, device=device)
        self._drawn = torch.zeros(n, 3, device=device)
        self._target = torch.zeros(n, device=device)
        self._heads = torch.zeros(n, dtype=torch.bool, device=device)
        self._stands = torch.zeros(n, dtype=torch.bool, device=device)

    def _turn_rate(self) -> Range:
        raise NotImplementedError

    def _draw_modes(self, selection: Selection) -> None:
        if self._heading is not None:
            selection.write(self._target, selection.uniform(*self._heading))
            selection.write(self._heads, selection.uniform(0.0, 1.0) < self._rel_heading)
        selection.write(self._stands, selection.uniform(0.0, 1.0) < self._rel_standing)

    def update(self) -> None:
        """Turn towards the heading where one is asked, and stand where that is asked."""
        self.command.copy_(self._drawn)
        if self._heading is not None:
            error = wrap_to_pi(self._target - heading(self._entity.data.root_quat_w))
            low, high = self._turn_rate()
            turn = (self._kp * error).clamp(low, high)
            self.command[:, 2].copy_(torch.where(self._heads, turn, self._drawn[:, 2]))
        self.command.mul_(~self._stands[:, None])

    def metrics(self) -> dict[str, Tensor]:
        """Errors of the root's velocity in its own frame [m/s, rad/s]. (num_envs,) each"""
        data = self._entity.data
        dx, dy = (self.command[:, :2] - data.root_lin_vel_b[:, :2]).unbind(1)
        return {
            "error_vel_xy": (dx.square() + dy.square()).sqrt(),
            "error_vel_yaw": (self.command[:, 2] - data.root_ang_vel_b[:, 2]).abs(),
        }

    def markers(self) -> list[Marker]:
        """Above the root, green what is asked, blue what is: its way in a second, and that of its nose in turning."""
        data = self._entity.data
        actual = torch.cat([data.root_lin_vel_b[:, :2], data.root_ang_vel_b[:, 2:]], dim=1)
        return [*self._arrows(self.command, COMMANDED, 0.5), *self._arrows(actual, ACTUAL, 0.45)]

    def _arrows(self, velocity: Tensor, color: Color, height: float) -> list[Marker]:
        """Arrows of a velocity (vx, vy, wz), so much above the root [m]."""
        data = self._entity.data
        vx, vy, wz = velocity.unbind(1)
        zero = torch.zeros_like(vx)

        def in_world(x: Tensor, y: Tensor) -> Tensor:
            return rotate(data.root_quat_w, torch.stack([x, y, zero], dim=1))

        above = data.root_pos_w + torch.tensor([0.0, 0.0, height], device=velocity.device)
        ahead = above + in_world(zero + _ARM, zero)
        return [Arrow(above, above + in_world(vx, vy), color), Arrow(ahead, ahead + in_world(zero, wz * _ARM), color)]

    def tensors(self) -> dict[str, Tensor]:
        """Return what was drawn."""
        return {"drawn": self._drawn, "target": self._target, "heads": self._heads, "stands": self._stands}


class UniformVelocity(_VelocityCommand):
    """Forward, sideways [m/s] and turning [rad/s] velocity of the root in its own frame, drawn uniformly. (num_envs, 3)

    Where a heading is asked, the turning rate is `heading_stiffness` x the error of the heading, within the range of
    the turning rate. Isaac Lab: UniformVelocityCommand.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        lin_vel_x: Range,
        lin_vel_y: Range = (0.0, 0.0),
        ang_vel_z: Range = (0.0, 0.0),
        heading: Range | None = None,
        heading_stiffness: float = 1.0,
        rel_standing: float = 0.0,
        rel_heading: float = 1.0,
    ) -> None:
        super().__init__(env, entity, heading, rel_standing, rel_heading, heading_stiffness)
        self._ranges = (lin_vel_x, lin_vel_y, ang_vel_z)

    def resample(self, selection: Selection) -> None:
        """Draw velocities, headings, and who stands."""
        for column, bounds in enumerate(self._ranges):
            selection.write(self._drawn[:, column], selection.uniform(*bounds))
        self._draw_modes(selection)

    def _turn_rate(self) -> Range:
        low, high = self._ranges[2]
        return low, high

    @property
    def limits(self) -> list[Range]:
        """What is drawn. [m/s, m/s, rad/s]"""
        return [(low, high) for low, high in self._ranges]


class NormalVelocity(_VelocityCommand):
    """The same drawn from normal distributions, each velocity zero with a chance of its own. (num_envs, 3)

    Isaac Lab: NormalVelocityCommand.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        mean: tuple[float, float, float],
        std: tuple[float, float, float],
        zero_prob: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rel_standing: float = 0.0,
    ) -> None:
        super().__init__(env, entity, None, rel_standing, 0.0, 0.0)
        self._mean, self._std, self._zero_prob = mean, std, zero_prob

    def resample(self, selection: Selection) -> None:
        """Draw velocities, which of them are zero, and who stands."""
        for column, (mean, std, zero) in enumerate(zip(self._mean, self._std, self._zero_prob, strict=True)):
            value = selection.normal(mean, std)
            selection.write(self._drawn[:, column], value * (selection.uniform(0.0, 1.0) >= zero))
        self._draw_modes(selection)

    @property
    def limits(self) -> list[Range]:
        """Nearly all of what is drawn: two deviations about the means. [m/s, m/s, rad/s]"""
        return [(mean - 2.0 * std, mean + 2.0 * std) for mean, std in zip(self._mean, self._std, strict=True)]


@dataclass(kw_only=True, eq=False)
class UniformPose(Term):
    """Pose of a body in the root's frame: position [m] and quaternion (w, x, y, z), drawn uniformly. (num_envs, 7)

    Angles are roll, pitch, yaw [rad]. Isaac Lab: UniformPoseCommand.
    """

    elements = ("x", "y", "z", "", "", "", "")

    entity: Entity = "robot"
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
        """Draw poses."""
        x, y, z, roll, pitch, yaw = (selection.uniform(*bounds) for bounds in self._ranges)
        quat = from_euler(roll, pitch, yaw)
        quat = unique(quat) if self.make_quat_unique else quat
        selection.write(self.command, torch.cat([torch.stack([x, y, z], dim=1), quat], dim=1))

    def update(self) -> None:
        """It stays where it is in the root's frame."""

    @property
    def limits(self) -> list[Range]:
        """Of the position [m]."""
        return [(low, high) for low, high in self._ranges[:3]]

    @property
    def pose_w(self) -> tuple[Tensor, Tensor]:
        """The asked pose in the world: position [m], quaternion. (num_envs, 3), (num_envs, 4)"""
        root = self.entity.data
        position = root.root_pos_w + rotate(root.root_quat_w, self.command[:, :3])
        return position, multiply(root.root_quat_w, self.command[:, 3:])

    @property
    def body_pose_w(self) -> tuple[Tensor, Tensor]:
        """The body's pose in the world: position [m], quaternion. (num_envs, 3), (num_envs, 4)"""
        data = self.entity.data
        return data.body_pos_w[:, self._body], data.body_quat_w[:, self._body]

    def metrics(self) -> dict[str, Tensor]:
        """Distance [m] and angle [rad] between the body and what is asked. (num_envs,) each"""
        (target, target_quat), (position, quat) = self.pose_w, self.body_pose_w
        dx, dy, dz = (target - position).unbind(1)
        alike = (target_quat * quat).unbind(1)
        cosine = (alike[0] + alike[1] + alike[2] + alike[3]).abs().clamp(max=1.0)
        return {
            "position_error": (dx.square() + dy.square() + dz.square()).sqrt(),
            "orientation_error": 2.0 * torch.acos(cosine),
        }

    def markers(self) -> list[Marker]:
        """A green sphere with the axes of the pose."""
        position, quat = self.pose_w
        return [Sphere(position), Frame(position, quat)]


@dataclass(kw_only=True, eq=False)
class UniformPose2d(Term, TensorState):
    """A place and a heading on the ground, relative to where an environment starts. (num_envs, 4)

    `command` is that seen from the root: x, y, z in its yaw frame [m], and the turn to the heading [rad]. With
    `simple_heading` the heading is the direction in which the place lies. Isaac Lab: UniformPose2dCommand.
    """

    elements = ("ahead", "left", "", "turn")

    entity: Entity = "robot"
    x: Range
    y: Range
    heading: Range = (-3.1415927, 3.1415927)
    simple_heading: bool = False

    def __post_init__(self) -> None:
        self._ranges = (self.x, self.y, self.heading)
        self.command = torch.zeros(self.env.num_envs, 4, device=self.env.device)
        self._target = torch.zeros(self.env.num_envs, 4, device=self.env.device)

    def resample(self, selection: Selection) -> None:
        """Draw places and headings."""
        data = self.entity.data
        x, y, turn = (selection.uniform(*bounds) for bounds in self._ranges)
        height = selection.read_view(data.default_root_state)[:, 2]
        selection.write(self._target, torch.stack([x, y, height, turn], dim=1))

    def update(self) -> None:
        """See it from where the root is."""
        data = self.entity.data
        dx, dy, dz = (self._target[:, :3] + self.env.origins - data.root_pos_w).unbind(1)
        yaw = heading(data.root_quat_w)
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        turn = atan2(left, ahead) if self.simple_heading else wrap_to_pi(self._target[:, 3] - yaw)
        self.command.copy_(torch.stack([ahead, left, dz, turn], dim=1))

    def metrics(self) -> dict[str, Tensor]:
        """Horizontal distance [m] and turn [rad] that are left. (num_envs,) each"""
        x, y, _, turn = self.command.unbind(1)
        return {"error_pos_2d": (x.square() + y.square()).sqrt(), "error_heading": turn.abs()}

    def markers(self) -> list[Marker]:
        """A green sphere at the place, with an arrow towards the heading."""
        upright = yaw_only(self.entity.data.root_quat_w)
        place = self.entity.data.root_pos_w + rotate(upright, self.command[:, :3])
        turn = self.command[:, 3]
        towards = torch.stack([torch.cos(turn), torch.sin(turn), torch.zeros_like(turn)], dim=1)
        return [Sphere(place, radius=0.05), Arrow(place, place + rotate(upright, 0.5 * towards))]

    def tensors(self) -> dict[str, Tensor]:
        """Return the place and the heading."""
        return {"target": self._target}
