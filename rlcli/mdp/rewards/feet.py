"""Reward terms of contacts and gait. (num_envs,) each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.mdp.parameters import Command, ContactSensor, Entity
from rlcli.mdp.term import Term
from rlcli.mdp.term_helpers import asked_speed, every, is_moving, paired, strongest_force
from rlcli.sim.rotations import length
from rlcli.sim.selection import Selection
from rlcli.sim.tensor_state import TensorState
from rlcli.task import Bodies, Sites

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


def undesired_contacts(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """How many bodies of the sensor felt more than `threshold` [N] within its history. (num_envs,)"""
    return (strongest_force(sensor) > threshold).sum(dim=1).float()


def desired_contacts(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """1 where no body of the sensor felt more than `threshold` [N] within its history: a penalty. (num_envs,)"""
    return every(strongest_force(sensor) <= threshold)


def contact_forces(env: ManagedEnv, *, sensor: ContactSensor, threshold: float) -> Tensor:
    """How much more than `threshold` bodies of the sensor felt within its history, summed [N]. (num_envs,)"""
    return (strongest_force(sensor) - threshold).clamp_(min=0.0).sum(dim=1)


def self_collision_cost(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """How many bodies of the sensor are in contact. (num_envs,)  mjlab: `self_collision_cost`."""
    return sensor.found.sum(dim=1).float()


def feet_air_time(env: ManagedEnv, *, sensor: ContactSensor, command: Command, threshold: float) -> Tensor:
    """Time in the air less `threshold`, of feet that touch down in this step, summed [s]. (num_envs,)

    0 where a velocity command asks for less than 0.1 m/s.
    """
    paid = (sensor.last_air_time - threshold) * sensor.first_contact
    return paid.sum(dim=1) * (asked_speed(command) > 0.1)


def feet_air_time_positive_biped(
    env: ManagedEnv, *, sensor: ContactSensor, command: Command, threshold: float
) -> Tensor:
    """How long one foot alone has been down and the others up, at most `threshold` [s]. (num_envs,)

    0 where a velocity command asks for less than 0.1 m/s.
    """
    down = sensor.contact_time > 0.0
    lasted = torch.where(down, sensor.contact_time, sensor.air_time).amin(dim=1).clamp(max=threshold)
    return lasted * (down.sum(dim=1) == 1) * (asked_speed(command) > 0.1)


def feet_slide(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, sensor: ContactSensor) -> Tensor:
    """Speed in the plane of feet that felt more than 1 N within the sensor's history, summed [m/s]. (num_envs,)

    bodies: those of the sensor, in its order.
    """
    speed = length(paired(entity.data.body_lin_vel_w[:, bodies, :2], sensor))
    return (speed * (strongest_force(sensor) > 1.0)).sum(dim=1)


def foot_slip_penalty(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, sensor: ContactSensor, threshold: float = 1.0
) -> Tensor:
    """`feet_slide` with the force to call a contact, `threshold` [N]. (num_envs,)"""
    speed = length(paired(entity.data.body_lin_vel_w[:, bodies, :2], sensor))
    return (speed * (strongest_force(sensor) > threshold)).sum(dim=1)


def feet_slip(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    sites: Sites,
    sensor: ContactSensor,
    command: Command,
    command_threshold: float = 0.01,
) -> Tensor:
    """Squared speed in the plane of sites whose foot is in contact, summed [m^2/s^2]. (num_envs,)  mjlab: `feet_slip`.

    sites: one a body of the sensor, in its order. 0 where less than `command_threshold` [m/s] is asked for.
    """
    speed = paired(entity.data.site_lin_vel_w[:, sites, :2], sensor).square().sum(dim=-1)
    return (speed * sensor.found).sum(dim=1) * (asked_speed(command) > command_threshold)


def foot_clearance_reward(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, target_height: float, std: float, tanh_mult: float
) -> Tensor:
    """exp(-sum of (z - target)^2 tanh(tanh_mult |v_xy|) / std) over the feet. (num_envs,)

    z: above the environment's origin [m].
    """
    off = (entity.data.body_pos_w[:, bodies, 2] - env.origins[:, 2:3] - target_height).square_()
    moving = torch.tanh(tanh_mult * length(entity.data.body_lin_vel_w[:, bodies, :2]))
    return torch.exp(-(off * moving).sum(dim=1) / std)


def feet_clearance(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    sites: Sites,
    target_height: float,
    command: Command,
    command_threshold: float = 0.01,
) -> Tensor:
    """Sum of |z - target_height| |v_xy| over sites at the feet [m^2/s]. (num_envs,)  mjlab: `feet_clearance`.

    0 where less than `command_threshold` [m/s] is asked for; z: above the environment's origin.
    """
    off = (entity.data.site_pos_w[:, sites, 2] - env.origins[:, 2:3] - target_height).abs_()
    speed = length(entity.data.site_lin_vel_w[:, sites, :2])
    return (off * speed).sum(dim=1) * (asked_speed(command) > command_threshold)


@dataclass(kw_only=True, eq=False)
class FeetSwingHeight(Term, TensorState):
    """(highest z of the swing / target_height - 1)^2 of feet that touch down, summed. (num_envs,)

    mjlab: `feet_swing_height`. sites: one a body of the sensor, in its order; z: above the environment's origin.
    0 where a velocity command asks for less than `command_threshold` [m/s].
    """

    entity: Entity = "robot"
    sites: Sites
    sensor: ContactSensor
    command: Command
    target_height: float
    command_threshold: float = 0.01

    def __post_init__(self) -> None:
        self._peak = torch.zeros_like(self.sensor.air_time)

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        height = paired(self.entity.data.site_pos_w[:, self.sites, 2], self.sensor) - self.env.origins[:, 2:3]
        torch.maximum(self._peak, height, out=self._peak)
        error = (self._peak / self.target_height - 1.0).square_() * self.sensor.first_contact
        self._peak *= ~self.sensor.found
        return error.sum(dim=1) * (asked_speed(self.command) > self.command_threshold)

    def reset(self, selection: Selection) -> None:
        """New episodes begin with no swing."""
        selection.write(self._peak, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the highest points so far."""
        return {"peak": self._peak}


def soft_landing(
    env: ManagedEnv, *, sensor: ContactSensor, command: Command, command_threshold: float = 0.05
) -> Tensor:
    """Contact forces of feet that touch down in this step, summed [N]. (num_envs,)  mjlab: `soft_landing`.

    0 where a velocity command asks for less than `command_threshold` [m/s].
    """
    landing = (length(sensor.force) * sensor.first_contact).sum(dim=1)
    return landing * (asked_speed(command) > command_threshold)


def air_time_reward(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    sensor: ContactSensor,
    command: Command,
    mode_time: float,
    velocity_threshold: float,
) -> Tensor:
    """Rewards steps of up to `mode_time` on the move, and standing at a stand, summed over feet [s]. (num_envs,)

    On the move each foot gives the time since it last touched down or lifted off, and nothing once that is above
    `mode_time`; at a stand its time on the ground less that in the air, within +-`mode_time`. On the move: something is
    asked, or the root is faster than `velocity_threshold` [m/s].
    """
    longest = torch.maximum(sensor.air_time, sensor.contact_time)
    stepping = torch.where(longest < mode_time, longest, 0.0)
    standing = (sensor.contact_time - sensor.air_time).clamp(-mode_time, mode_time)
    moving = is_moving(entity, command, velocity_threshold)[:, None]
    return torch.where(moving, stepping, standing).sum(dim=1)


def air_time_variance_penalty(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """Variance over feet of their last times in the air and in contact, each at most 0.5 s [s^2]. (num_envs,)"""
    return sensor.last_air_time.clamp(max=0.5).var(dim=1) + sensor.last_contact_time.clamp(max=0.5).var(dim=1)


@dataclass(kw_only=True, eq=False)
class GaitReward(Term):
    """Rewards a gait in which the feet of each pair move together and the pairs in turn: a trot. (num_envs,)

    The product of exp(-(difference of air times^2 + difference of contact times^2) / std) within each of the two pairs,
    and of the same with the air time of one and the contact time of the other across them; each square is at most
    max_err^2. 0 at a stand: nothing is asked, and the root is slower than `velocity_threshold` [m/s].

    synced_feet_pairs: names of bodies of the sensor.
    """

    entity: Entity = "robot"
    sensor: ContactSensor
    command: Command
    std: float
    max_err: float
    velocity_threshold: float
    synced_feet_pairs: tuple[tuple[str, str], tuple[str, str]]

    def __post_init__(self) -> None:
        known = [name.removeprefix(f"{self.entity.name}/") for name in self.sensor.names]
        for name in [name for pair in self.synced_feet_pairs for name in pair]:
            if name not in known:
                raise ValueError(f"the sensor has no body '{name}'; its bodies: {', '.join(known)}")
        (a, b), (c, d) = [[known.index(name) for name in pair] for pair in self.synced_feet_pairs]
        self._together = ((a, b), (c, d))
        self._in_turn = ((a, c), (b, d), (a, d), (c, b))

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        air, contact = self.sensor.air_time, self.sensor.contact_time
        error = torch.zeros_like(air[:, 0])
        for one, other in self._together:
            error += self._capped(air[:, one] - air[:, other]) + self._capped(contact[:, one] - contact[:, other])
        for one, other in self._in_turn:
            error += self._capped(air[:, one] - contact[:, other]) + self._capped(contact[:, one] - air[:, other])
        return torch.exp(-error / self.std) * is_moving(self.entity, self.command, self.velocity_threshold)

    def _capped(self, difference: Tensor) -> Tensor:
        return difference.square_().clamp(max=self.max_err * self.max_err)
