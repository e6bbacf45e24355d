"""Cartpole in the direct workflow: one class with the methods of a task of OmniIsaacGymEnvs."""

from __future__ import annotations

import math
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask


class CartpoleTask(DirectTask):
    """Balance a pole on a cart. Observations: cart position [m], velocity [m/s], pole angle [rad], rate [rad/s]."""

    num_observations = 4
    num_actions = 1
    observation_names = ("cart_pos", "cart_vel", "pole_pos", "pole_vel")
    observation_units = ("m", "m/s", "rad", "rad/s")
    action_names = ("slider_to_cart",)

    class Params(StrictModel):
        """Parameters of the task, set in the section `params:` of its YAML."""

        reset_dist: float = Field(
            3.0, gt=0, description="An episode fails if the cart is farther than this from the middle of the rail [m]."
        )
        max_effort: float = Field(400.0, gt=0, description="Force on the cart at action 1 [N].")
        cart_vel_weight: float = Field(
            0.01, ge=0, description="Weight of the penalty on the absolute cart velocity [s/m]."
        )
        pole_vel_weight: float = Field(
            0.005, ge=0, description="Weight of the penalty on the absolute angular velocity of the pole [s/rad]."
        )

    params: Params

    def set_up_scene(self, scene) -> None:
        """Register a view of the robots: their state in all environments, as tensors."""
        self.cartpoles = scene.add(ArticulationView("robot", name="cartpole_view"))

    def post_reset(self) -> None:
        """Find the indices of the joints, and create the ranges of initial states."""
        self.cart = self.cartpoles.get_dof_index("slider_to_cart")
        self.pole = self.cartpoles.get_dof_index("cart_to_pole")
        self.position_span, self.velocity_span = torch.empty(2, self.cartpoles.num_dof, device=self.device)
        self.position_span[self.cart], self.position_span[self.pole] = 1.0, 0.125 * math.pi
        self.velocity_span[self.cart], self.velocity_span[self.pole] = 0.5, 0.25 * math.pi

    def reset_idx(self, env_ids: Tensor) -> None:
        """Sample initial states: the cart in +-1 m and +-0.5 m/s, the pole in +-pi/8 rad and +-pi/4 rad/s."""
        draws = self.draws(env_ids)
        position = self.position_span * draws.uniform(-1.0, 1.0, (self.cartpoles.num_dof,))
        velocity = self.velocity_span * draws.uniform(-1.0, 1.0, (self.cartpoles.num_dof,))
        self.cartpoles.set_joint_positions(position, indices=env_ids)
        self.cartpoles.set_joint_velocities(velocity, indices=env_ids)

    def pre_physics_step(self, actions: Tensor) -> None:
        """Apply the action as a force on the cart."""
        efforts = torch.zeros(self.num_envs, self.cartpoles.num_dof, device=self.device)
        efforts[:, self.cart] = self.params.max_effort * actions[:, 0]
        self.cartpoles.set_joint_efforts(efforts)

    def get_observations(self) -> dict[str, dict[str, Tensor]]:
        """Write the observations to `obs_buf`; return them as {view's name: {"obs_buf": observations}}."""
        position = self.cartpoles.get_joint_positions(clone=False)
        velocity = self.cartpoles.get_joint_velocities(clone=False)
        self.obs_buf[:, 0] = position[:, self.cart]
        self.obs_buf[:, 1] = velocity[:, self.cart]
        self.obs_buf[:, 2] = position[:, self.pole]
        self.obs_buf[:, 3] = velocity[:, self.pole]
        return {self.cartpoles.name: {"obs_buf": self.obs_buf}}

    def in_terms(self) -> dict[str, list[dict[str, Any]]]:
        """Return the observations and actions as terms of a manager-based task, by section.

        rlcli uses them where it needs terms, for example to export the policy for a robot.
        """
        cart, pole = ["slider_to_cart"], ["cart_to_pole"]
        observed = [{"func": func, "joints": joints} for joints in (cart, pole) for func in ("joint_pos", "joint_vel")]
        return {
            "observations": observed,
            "actions": [{"func": "joint_effort", "joints": cart, "scale": self.params.max_effort}],
        }

    def calculate_metrics(self) -> None:
        """Reward an upright pole and slow joints; a failure costs 2."""
        _, cart_vel, pole_pos, pole_vel = self.obs_buf.unbind(dim=1)
        reward = 1.0 - pole_pos.square()
        reward -= self.params.cart_vel_weight * cart_vel.abs()
        reward -= self.params.pole_vel_weight * pole_vel.abs()
        self.rew_buf[:] = torch.where(self._failed(), -2.0, reward)

    def is_done(self) -> None:
        """Terminate where the cart left the rail or the pole fell. The environment adds time-outs."""
        self.reset_buf[:] = self._failed()

    def _failed(self) -> Tensor:
        cart_pos, pole_pos = self.obs_buf[:, 0], self.obs_buf[:, 2]
        return (cart_pos.abs() > self.params.reset_dist) | (pole_pos.abs() > math.pi / 2)
