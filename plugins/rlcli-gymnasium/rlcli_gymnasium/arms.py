"""Gymnasium's reacher and pusher: an arm reaches a point, or pushes a puck to a point."""

from __future__ import annotations

import math

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import length

from .base import GymnasiumTask

_CANDIDATES = 32
"""Number of sampled positions of the puck. The first one outside of the excluded circle around the goal is used. The
circle has 38 % of the area, so all samples are inside of it once in 10^13 episodes."""


class _Arm(GymnasiumTask):
    """Base class of the reacher and the pusher; it finds the bodies of the model by name."""

    reads = ("xpos",)

    def body_position(self, body: str) -> Tensor:
        """Return a body's position; as in Gymnasium, it lags by one physics step. (num_envs, 3) [m]"""
        return self.field.xpos[:, self.bodies[body]]

    def post_reset(self) -> None:
        """Find the bodies that the task observes."""
        model = self.env.engine.model
        self.bodies = {model.body(b).name.removeprefix("robot/"): b for b in range(model.nbody)}
        super().post_reset()

    def velocities(self, selection: Selection, still: int) -> Tensor:
        """Sample initial joint velocities in +-0.005; the last `still` joints, without actuator, get 0. (rows, nv)"""
        noise = self.noise(selection, 0.005, self.model.nv)
        noise[:, -still:] = 0.0
        return noise


class Reacher(_Arm):
    """Reacher-v5: two links in a plane."""

    num_observations = 10
    num_actions = 2
    observation_names = (
        *("cos_1", "cos_2", "sin_1", "sin_2", "target_x", "target_y"),
        *("vel_1", "vel_2", "to_fingertip_x", "to_fingertip_y"),
    )
    observation_units = ("", "", "", "", "m", "m", "rad/s", "rad/s", "m", "m")

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        reward_dist_weight: float = Field(1.0, description="Penalty on the distance to the target [1/m].")
        reward_control_weight: float = Field(1.0, description="Penalty on the sum of squared actions.")

    params: Params

    def columns(self) -> list[Tensor]:
        """Return the observation: state of the arm, target, and vector from target to fingertip. (num_envs, k) each"""
        qpos, angles = self.field.qpos, self.field.qpos[:, :2]
        return [angles.cos(), angles.sin(), qpos[:, 2:], self.field.qvel[:, :2], self.gap()[:, :2]]

    def gap(self) -> Tensor:
        """Return the vector from the target to the fingertip. (num_envs, 3) [m]"""
        return self.body_position("fingertip") - self.body_position("target")

    def compute_reward(self) -> Tensor:
        """Return minus the weighted distance from fingertip to target, minus the cost of the actions. (num_envs,)"""
        params = self.params
        return -length(self.gap()) * params.reward_dist_weight - self.action_cost(params.reward_control_weight)

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample initial states: a nearly straight arm, a target within 0.2 m of its base. (rows, nq), (rows, nv)"""
        qpos = self.start_pos + self.noise(selection, 0.1, self.model.nq)
        radius, turn = 0.2 * selection.uniform(0.0, 1.0).sqrt(), selection.uniform(-math.pi, math.pi)
        qpos[:, -2:] = torch.stack([radius * turn.cos(), radius * turn.sin()], dim=1)
        return qpos, self.velocities(selection, 2)


class Pusher(_Arm):
    """Pusher-v5: an arm of seven joints pushes a puck."""

    num_observations = 23
    num_actions = 7
    observation_names = (
        *(f"qpos_{i}" for i in range(7)),
        *(f"qvel_{i}" for i in range(7)),
        *(f"{what}_{axis}" for what in ("tips", "object", "goal") for axis in "xyz"),
    )
    observation_units = (*("rad",) * 7, *("rad/s",) * 7, *("m",) * 9)

    class Params(StrictModel):
        """Parameters of the task, with Gymnasium's names."""

        reward_near_weight: float = Field(0.5, description="Penalty on the distance from the arm to the puck [1/m].")
        reward_dist_weight: float = Field(1.0, description="Penalty on the distance from the puck to the goal [1/m].")
        reward_control_weight: float = Field(0.1, description="Penalty on the sum of squared actions.")

    params: Params

    def columns(self) -> list[Tensor]:
        """Return the observation: state of the arm, positions of its tip, the puck and the goal. (num_envs, k) each"""
        places = [self.body_position(body) for body in ("tips_arm", "object", "goal")]
        return [self.field.qpos[:, :7], self.field.qvel[:, :7], *places]

    def compute_reward(self) -> Tensor:
        """Return minus the weighted distances arm-puck and puck-goal, minus the cost of the actions. (num_envs,)"""
        params, puck = self.params, self.body_position("object")
        near = -length(puck - self.body_position("tips_arm")) * params.reward_near_weight
        far = -length(puck - self.body_position("goal")) * params.reward_dist_weight
        return far - self.action_cost(params.reward_control_weight) + near

    def start(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """Sample initial states, with the puck in a box and over 0.17 m from the goal. (rows, nq), (rows, nv)"""
        x = selection.uniform(-0.3, 0.0, (_CANDIDATES,))
        y = selection.uniform(-0.2, 0.2, (_CANDIDATES,))
        off = (x * x + y * y).sqrt() > 0.17
        first = off.to(torch.int8).argmax(dim=1, keepdim=True)
        qpos = self.start_pos.repeat(len(x), 1)
        qpos[:, -4:-2] = torch.cat([x.gather(1, first), y.gather(1, first)], dim=1)
        qpos[:, -2:] = 0.0
        return qpos, self.velocities(selection, 4)


__all__ = ["Pusher", "Reacher"]
