"""Cart with two links in the direct workflow: a force on the cart and a torque between the links balance both.

The original is a task for two agents, the cart and the pendulum. Here one policy controls both: it has the observations
and actions of both, and its reward is the sum of theirs.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import wrap_to_pi

CART, POLE, PENDULUM = JOINTS = ("slider_to_cart", "cart_to_pole", "pole_to_pendulum")


class CartDoublePendulumTask(DirectTask):
    """Balance both links. Observations: docs/reference/zoo/cart-double-pendulum.md lists the 7 columns."""

    num_observations = 7
    num_actions = 2
    observation_names = (
        *("cart_pos", "cart_vel", "pole_pos", "pole_vel"),
        *("pendulum_tilt", "pendulum_pos", "pendulum_vel"),
    )
    observation_units = ("m", "m/s", "rad", "rad/s", "rad", "rad", "rad/s")
    action_names = (CART, PENDULUM)

    class Params(StrictModel):
        """Parameters of the task, set in the section `params:` of its YAML."""

        cart_effort: float = Field(100.0, gt=0, description="Force on the cart at action 1 [N].")
        pendulum_effort: float = Field(
            50.0, gt=0, description="Torque between the pole and the pendulum at action 1 [N m]."
        )
        max_cart_pos: float = Field(
            3.0, gt=0, description="An episode fails if the cart is farther than this from the middle of the rail [m]."
        )
        pole_start: float = Field(0.7853982, ge=0, description="Largest absolute initial angle of the pole [rad].")
        pendulum_start: float = Field(
            0.7853982, ge=0, description="Largest absolute initial angle between the pole and the pendulum [rad]."
        )
        alive_weight: float = Field(2.0, description="Reward per step in which the episode does not fail.")
        failure_reward: float = Field(
            -4.0, description="Reward of the step in which the episode fails, instead of alive_weight."
        )
        tilt_weight: float = Field(
            1.0, ge=0, description="Weight of the penalty on the squared tilt of each link from the vertical [1/rad^2]."
        )
        speed_weight: float = Field(
            0.01, ge=0, description="Weight of the penalty on the absolute velocity of each joint [s/m or s/rad]."
        )

    params: Params

    def set_up_scene(self, scene) -> None:
        """Register a view of the robots: their state in all environments, as tensors."""
        self.carts = scene.add(ArticulationView("robot", name="cart_view"))

    def post_reset(self) -> None:
        """Create the ranges of initial states and the efforts, one column per joint."""
        self.robot = self.env.entities["robot"]
        assert tuple(self.robot.joint_names) == JOINTS
        params = self.params
        self.start = torch.tensor([0.0, params.pole_start, params.pendulum_start], device=self.device)
        self.efforts = torch.zeros(self.num_envs, len(JOINTS), device=self.device)
        self.scale = torch.tensor([params.cart_effort, params.pendulum_effort], device=self.device)

    def reset(self, selection: Selection) -> None:
        """Put the cart in the middle and the links at random angles, all at rest."""
        self.robot.write_joint_positions(selection, selection.uniform(-self.start, self.start, (len(JOINTS),)))

    def pre_physics_step(self, actions: Tensor) -> None:
        """Push the cart, and apply a torque between the links."""
        torch.mul(actions, self.scale, out=self.efforts[:, ::2])
        self.carts.set_joint_efforts(self.efforts)

    def get_observations(self) -> None:
        """Write the observations to `obs_buf`: first the observations of the cart, then those of the pendulum."""
        position, velocity = self.robot.data.joint_pos, self.robot.data.joint_vel
        pole, between = position[:, 1], wrap_to_pi(position[:, 2])
        torch.stack(
            [
                *(position[:, 0], velocity[:, 0], pole, velocity[:, 1]),
                *(wrap_to_pi(position[:, 1] + position[:, 2]), between, velocity[:, 2]),
            ],
            dim=1,
            out=self.obs_buf,
        )

    def in_terms(self) -> dict[str, list[dict[str, Any]]]:
        """Return the observations and actions as terms of a manager-based task, by section.

        rlcli uses them where it needs terms, for example to export the policy for a robot.
        """
        params = self.params
        return {
            "observations": [
                *({"func": func, "joints": [joint]} for joint in (CART, POLE) for func in ("joint_pos", "joint_vel")),
                {"func": "joint_angle_sum", "joints": [POLE, PENDULUM]},
                {"func": "joint_angle", "joints": [PENDULUM]},
                {"func": "joint_vel", "joints": [PENDULUM]},
            ],
            "actions": [
                {"func": "joint_effort", "joints": [CART], "scale": params.cart_effort},
                {"func": "joint_effort", "joints": [PENDULUM], "scale": params.pendulum_effort},
            ],
        }

    def calculate_metrics(self) -> None:
        """Reward survival, upright links and slow joints; a failure has a cost."""
        params = self.params
        _, cart_vel, pole, pole_vel, tilt, _, pendulum_vel = self.obs_buf.unbind(dim=1)
        self.rew_buf.fill_(params.alive_weight).masked_fill_(self._failed(), params.failure_reward)
        self.rew_buf.sub_(pole.square().addcmul_(tilt, tilt), alpha=params.tilt_weight)
        self.rew_buf.sub_(cart_vel.abs() + pole_vel.abs() + pendulum_vel.abs(), alpha=params.speed_weight)

    def is_done(self) -> None:
        """Terminate where the cart left the rail or the pole fell. The environment adds time-outs."""
        self.reset_buf.copy_(self._failed())

    def _failed(self) -> Tensor:
        return (self.obs_buf[:, 0].abs() > self.params.max_cart_pos) | (self.obs_buf[:, 2].abs() > 0.5 * math.pi)
