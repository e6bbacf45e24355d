"""Ant in the direct workflow: run on four legs towards a far target. See docs/reference/zoo/ant-direct.md."""

from __future__ import annotations

from pydantic import Field
from torch import Tensor

from rlcli_tasks.locomotion import LocomotionTask, observation_names, observation_units

LEGS = ("fl", "bl", "br", "fr")
JOINTS = tuple(f"{joint}_{leg}" for leg in LEGS for joint in ("hip", "ankle"))


class AntTask(LocomotionTask):
    """Run towards the target on four legs. Observations: docs/reference/zoo/ant-direct.md lists the 60 columns."""

    num_observations = 60
    num_actions = 8
    joints = JOINTS
    rate_scale, joint_vel_scale, force_scale = 1.0, 0.2, 0.1
    observation_names = observation_names(JOINTS, LEGS)
    observation_units = observation_units(8, 4, rate="rad/s", joint_rate="5 rad/s", force="10")
    action_names = JOINTS

    class Params(LocomotionTask.Params):
        """Parameters of the task, set in the section `params:` of its YAML."""

        effort: float = Field(7.5, gt=0, description="Torque of each joint at action 1 [N m].")
        termination_height: float = Field(0.31, description="An episode fails if the torso is lower than this [m].")
        death_reward: float = Field(
            -2.0, description="Reward of the step in which the episode fails, instead of all other terms."
        )
        alive_weight: float = Field(0.5, description="Reward per step in which the episode does not fail.")
        action_cost: float = Field(0.005, ge=0, description="Weight of the penalty on the sum of squared actions.")
        energy_cost: float = Field(
            0.05,
            ge=0,
            description="Weight of the penalty on |action x joint velocity / (5 rad/s)|, summed over the joints.",
        )
        limit_cost: float = Field(
            0.1, ge=0, description="Penalty per joint that is nearer to a limit than 1 % of half of the joint's range."
        )
        joint_pos_noise: float = Field(
            0.2,
            ge=0,
            description=(
                "Largest absolute initial offset of a joint from its default position, within the joint limits [rad]."
            ),
        )

    params: Params

    def efforts(self) -> tuple[float, ...]:
        """Return the torque of each joint at action 1, which is the same for all joints [N m]."""
        return (self.params.effort,) * len(JOINTS)

    def at_limits(self, position: Tensor) -> Tensor:
        """Return whether each joint is within 1 % of half its range of a limit. (num_envs, joints) bool

        position: joint positions scaled so that -1 and 1 are the limits. (num_envs, joints)
        """
        return position.abs() > 0.99
