"""Reward terms of contacts and of feet: air time, slip, clearance, gait. (num_envs,) each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Command, ContactSensor, Entity, ManagedEnv
from rlcli.mdp.term import EntityTerm
from rlcli.mdp.term_helpers import all_columns, commanded_speed, is_moving, require_one_per_body, strongest_force
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import length
from rlcli.sim.saved_tensors import TensorState
from rlcli.task import Bodies, Sites


def undesired_contacts(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """Count of the sensor's bodies with a contact force above `threshold` [N] within its history. (num_envs,)"""
    return (strongest_force(sensor) > threshold).sum(dim=1).float()


def desired_contacts(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """1 where no body of the sensor has a contact force above `threshold` [N] within its history. (num_envs,)

    The term marks missing contacts: use it as a penalty, with a negative weight.
    """
    return all_columns(strongest_force(sensor) <= threshold)


def contact_forces(env: ManagedEnv, *, sensor: ContactSensor, threshold: float) -> Tensor:
    """Sum of max(force - threshold, 0) over the sensor's bodies [N]. (num_envs,)

    force: largest contact force of the body in the sensor's history.
    """
    return (strongest_force(sensor) - threshold).clamp_(min=0.0).sum(dim=1)


def self_collision_cost(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """Count of the sensor's bodies that are in contact. (num_envs,)  mjlab: `self_collision_cost`."""
    return sensor.found.sum(dim=1).float()


def feet_air_time(env: ManagedEnv, *, sensor: ContactSensor, command: Command, threshold: float) -> Tensor:
    """Sum of (time in the air - threshold) of the feet that touch down in this step [s]. (num_envs,)

    0 where the commanded speed is at most 0.1 m/s.
    """
    excess = (sensor.last_air_time - threshold) * sensor.first_contact
    return excess.sum(dim=1) * (commanded_speed(command) > 0.1)


def feet_air_time_positive_biped(
    env: ManagedEnv, *, sensor: ContactSensor, command: Command, threshold: float
) -> Tensor:
    """Duration for which exactly one of two feet has been in contact, clipped to `threshold` [s]. (num_envs,)

    0 where both or no feet are in contact, or the commanded speed is at most 0.1 m/s.
    """
    down = sensor.contact_time > 0.0
    lasted = torch.where(down, sensor.contact_time, sensor.air_time).amin(dim=1).clamp(max=threshold)
    return lasted * (down.sum(dim=1) == 1) * (commanded_speed(command) > 0.1)


def feet_slide(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, sensor: ContactSensor) -> Tensor:
    """Sum of the horizontal speeds of feet with more than 1 N within the sensor's history [m/s]. (num_envs,)

    bodies: the bodies of the sensor, in the same order.
    """
    return foot_slip_penalty(env, entity=entity, bodies=bodies, sensor=sensor)


def foot_slip_penalty(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, sensor: ContactSensor, threshold: float = 1.0
) -> Tensor:
    """Sum of the horizontal speeds of feet with more than `threshold` [N] in the sensor's history [m/s]. (num_envs,)

    bodies: the bodies of the sensor, in the same order.
    """
    speed = length(require_one_per_body(entity.data.body_lin_vel_of(bodies)[..., :2], sensor, "bodies"))
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
    """Sum of the squared horizontal speeds of sites whose foot is in contact [m^2/s^2]. (num_envs,)

    sites: one for each body of the sensor, in its order. 0 where the commanded speed is at most `command_threshold`
    [m/s]. mjlab: `feet_slip`.
    """
    speed = require_one_per_body(entity.data.site_lin_vel_w[:, sites, :2], sensor, "sites").square().sum(dim=-1)
    return (speed * sensor.found).sum(dim=1) * (commanded_speed(command) > command_threshold)


def foot_clearance_reward(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, target_height: float, std: float, tanh_mult: float
) -> Tensor:
    """exp(-sum of (z - target_height)^2 tanh(tanh_mult |v_xy|) / std) over the feet. (num_envs,)

    z: height of the body above the environment's origin [m]. tanh_mult [s/m], std [m^2].
    """
    off = (entity.data.body_pos_w[:, bodies, 2] - env.origins[:, 2:3] - target_height).square_()
    moving = torch.tanh(tanh_mult * length(entity.data.body_lin_vel_of(bodies)[..., :2]))
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

    z: height above the environment's origin [m]. 0 where the commanded speed is at most `command_threshold` [m/s].
    """
    off = (entity.data.site_pos_w[:, sites, 2] - env.origins[:, 2:3] - target_height).abs_()
    speed = length(entity.data.site_lin_vel_w[:, sites, :2])
    return (off * speed).sum(dim=1) * (commanded_speed(command) > command_threshold)


@dataclass(kw_only=True, eq=False)
class FeetSwingHeight(EntityTerm, TensorState):
    """Sum of (largest z of the swing / target_height - 1)^2 of the feet that touch down in this step. (num_envs,)

    sites: one for each body of the sensor, in its order. z: height above the environment's origin [m]. 0 where the
    commanded speed is at most `command_threshold` [m/s]. mjlab: `feet_swing_height`.
    """

    sites: Sites
    sensor: ContactSensor
    command: Command
    target_height: float
    command_threshold: float = 0.01

    def __post_init__(self) -> None:
        self._peak = torch.zeros_like(self.sensor.air_time)

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        z = require_one_per_body(self.entity.data.site_pos_w[:, self.sites, 2], self.sensor, "sites")
        height = z - self.env.origins[:, 2:3]
        torch.maximum(self._peak, height, out=self._peak)
        error = (self._peak / self.target_height - 1.0).square_() * self.sensor.first_contact
        self._peak *= ~self.sensor.found
        return error.sum(dim=1) * (commanded_speed(self.command) > self.command_threshold)

    def reset(self, selection: Selection) -> None:
        """Set the largest heights of the swings to 0 in new episodes."""
        selection.write(self._peak, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the largest height of each swing so far."""
        return {"peak": self._peak}


def soft_landing(
    env: ManagedEnv, *, sensor: ContactSensor, command: Command, command_threshold: float = 0.05
) -> Tensor:
    """Sum of the contact forces of feet that touch down in this step [N]. (num_envs,)  mjlab: `soft_landing`.

    0 where the commanded speed is at most `command_threshold` [m/s].
    """
    landing = (length(sensor.force) * sensor.first_contact).sum(dim=1)
    return landing * (commanded_speed(command) > command_threshold)


def air_time_reward(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    sensor: ContactSensor,
    command: Command,
    mode_time: float,
    velocity_threshold: float,
) -> Tensor:
    """Reward for steps of up to `mode_time` while moving and for contact while standing, summed over feet [s].

    (num_envs,)

    Moving: each foot gives the time since it last touched down or lifted off, and 0 once that time is `mode_time`.
    Standing: each foot gives its time in contact minus its time in the air, clipped to +-`mode_time`. A robot is moving
    if the command is not zero or the root is faster than `velocity_threshold` [m/s].
    """
    longest = torch.maximum(sensor.air_time, sensor.contact_time)
    stepping = torch.where(longest < mode_time, longest, 0.0)
    standing = (sensor.contact_time - sensor.air_time).clamp(-mode_time, mode_time)
    moving = is_moving(entity, command, velocity_threshold)[:, None]
    return torch.where(moving, stepping, standing).sum(dim=1)


def air_time_variance_penalty(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """Variance over feet of the last air time, plus the variance of the last contact time [s^2]. (num_envs,)

    Each time is clipped to at most 0.5 s.
    """
    return sensor.last_air_time.clamp(max=0.5).var(dim=1) + sensor.last_contact_time.clamp(max=0.5).var(dim=1)


@dataclass(kw_only=True, eq=False)
class GaitReward(EntityTerm):
    """Reward for a trot: the feet of a pair move together, the two pairs alternate. (num_envs,)

    Product of exp(-error / std) over pairs of feet. Two feet of the same pair: error = (difference of air times)^2 +
    (difference of contact times)^2. Two feet of different pairs: the air time of one is compared with the contact time
    of the other. Each square is at most max_err^2 [s^2]. 0 while standing: the command is zero, and the root is slower
    than `velocity_threshold` [m/s].

    synced_feet_pairs: names of bodies of the sensor.
    """

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
        self._in_phase = ((a, b), (c, d))
        self._out_of_phase = ((a, c), (b, d), (a, d), (c, b))

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        air, contact = self.sensor.air_time, self.sensor.contact_time
        error = torch.zeros_like(air[:, 0])
        for one, other in self._in_phase:
            error += self._capped(air[:, one] - air[:, other]) + self._capped(contact[:, one] - contact[:, other])
        for one, other in self._out_of_phase:
            error += self._capped(air[:, one] - contact[:, other]) + self._capped(contact[:, one] - air[:, other])
        return torch.exp(-error / self.std) * is_moving(self.entity, self.command, self.velocity_threshold)

    def _capped(self, difference: Tensor) -> Tensor:
        return difference.square_().clamp(max=self.max_err * self.max_err)
