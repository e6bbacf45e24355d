"""Humanoid in the direct workflow: run on two legs towards a far target. See docs/reference/zoo/humanoid-direct.md."""

from __future__ import annotations

from pydantic import Field
from torch import Tensor

from rlcli_tasks.locomotion import LocomotionTask, observation_names, observation_units

LEG = {"hip_roll": 45.0, "hip_yaw": 45.0, "hip_pitch": 135.0, "knee": 90.0, "ankle_pitch": 22.5, "ankle_roll": 22.5}
ARM = {"shoulder_1": 67.5, "shoulder_2": 67.5, "elbow": 45.0}
EFFORTS = {
    **{"waist_yaw": 67.5, "waist_pitch": 67.5, "waist_roll": 67.5},
    **{f"{joint}_{side}": effort for side in "lr" for joint, effort in LEG.items()},
    **{f"{joint}_{side}": effort for side in "lr" for joint, effort in ARM.items()},
}
"""Torque of each motor at action 1 [N m]."""
JOINTS = tuple(EFFORTS)


class HumanoidTask(LocomotionTask):
    """Run towards the target on two legs. Observations: docs/reference/zoo/humanoid-direct.md lists the columns."""

    num_observations = 87
    num_actions = 21
    joints = JOINTS
    rate_scale, joint_vel_scale, force_scale = 0.25, 0.1, 0.01
    observation_names = observation_names(JOINTS, ("foot_l", "foot_r"))
    observation_units = observation_units(21, 2, rate="4 rad/s", joint_rate="10 rad/s", force="100")
    action_names = JOINTS

    class Params(LocomotionTask.Params):
        """Parameters of the task, set in the section `params:` of its YAML."""

        power: float = Field(1.0, gt=0, description="Factor on the torques of all motors.")
        termination_height: float = Field(0.8, description="An episode fails if the torso is lower than this [m].")
        death_reward: float = Field(
            -1.0, description="Reward of the step in which the episode fails, instead of all other terms."
        )
        alive_weight: float = Field(2.0, description="Reward per step in which the episode does not fail.")
        action_cost: float = Field(0.01, ge=0, description="Weight of the penalty on the sum of squared actions.")
        energy_cost: float = Field(
            0.05,
            ge=0,
            description=(
                "Weight of the penalty on |action x joint velocity / (10 rad/s)| x (torque of the joint's motor "
                "/ 135 N m), summed over the joints."
            ),
        )
        limit_cost: float = Field(
            0.25,
            ge=0,
            description=(
                "Penalty on a joint at its limit, times (torque of the joint's motor / 135 N m); it falls "
                "linearly to 0 at 98 % of half of the joint's range."
            ),
        )
        joint_pos_noise: float = Field(
            0.2,
            ge=0,
            description=(
                "Largest absolute initial offset of a joint from its default position, within the joint limits; "
                "the hip roll joints start outwards only [rad]."
            ),
        )

    params: Params

    def post_reset(self) -> None:
        """Create buffers as the base class does, and let the hips start outwards only.

        With hips turned inwards, the legs would overlap in a fifth of all initial states.
        """
        super().post_reset()
        self.start_high[[JOINTS.index("hip_roll_l"), JOINTS.index("hip_roll_r")]] = 0.0

    def efforts(self) -> tuple[float, ...]:
        """Return the torque of each joint at action 1 [N m]."""
        return tuple(self.params.power * effort for effort in EFFORTS.values())

    def at_limits(self, position: Tensor) -> Tensor:
        """Return the cost of each joint near a limit. (num_envs, joints)

        It rises from 0 at 98 % of half the joint's range to (torque of the joint's motor / 135 N m) at the limit.

        position: joint positions scaled so that -1 and 1 are the limits. (num_envs, joints)
        """
        return (position.abs() - 0.98).clamp_(min=0.0).mul_(self.share / 0.02)
