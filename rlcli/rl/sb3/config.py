"""Settings (agent keys) of the trainer `sb3` (Stable-Baselines3), as pydantic models.

The module does not import Stable-Baselines3, so that a task's YAML file is checked fast.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel, Widths
from rlcli.trainers import TrainerSpec

Discount = Annotated[float, Field(ge=0, le=1)]


class NetworkConfig(StrictModel):
    """Networks of actor and critic, which have the same shape."""

    hidden: Widths = (64, 64)
    """Widths of the hidden layers."""
    activation: Literal["elu", "relu", "tanh", "silu"] = "tanh"
    """Activation between layers."""
    init_std: Positive = 1.0
    """On-policy: initial standard deviation of the actions; it is learned and does not depend on the state."""
    ortho_init: bool = False
    """On-policy: whether initial weights are orthogonal, as by default in SB3; else they are torch's."""


class OffPolicyNetworkConfig(NetworkConfig):
    """Networks of actor and critics of an off-policy algorithm."""

    hidden: Widths = (256, 256)
    """Widths of the hidden layers."""
    activation: Literal["elu", "relu", "tanh", "silu"] = "relu"
    """Activation between layers."""


class Sb3Config(AgentConfig):
    """Settings of all algorithms, with SB3's names."""

    learning_rate: Positive = 3e-4
    """Learning rate of the optimiser."""
    schedule: Literal["constant", "linear", "adaptive"] = "constant"
    """Schedule of the learning rate: linear decreases to 0 over the budget; adaptive (PPO only) follows desired_kl."""
    gamma: Discount = 0.99
    """Discount factor."""
    reward_scale: Positive = 1.0
    """Factor on rewards in training; reported returns do not include it."""
    normalize_observations: bool = False
    """Normalise observations by their running mean and standard deviation, which are part of the policy."""
    policy: NetworkConfig = NetworkConfig()
    """Networks of actor and critic."""


class OnPolicyConfig(Sb3Config):
    """Settings of PPO and A2C."""

    n_steps: Count = 16
    """Steps of each environment per iteration."""
    gae_lambda: Discount = 0.95
    """Lambda of generalised advantage estimation."""
    normalize_advantage: bool = True
    """Normalise advantages in each minibatch."""
    ent_coef: NotNegative = 0.0
    """Weight of the entropy bonus."""
    vf_coef: NotNegative = 0.5
    """Weight of the value loss."""
    max_grad_norm: Positive = 0.5
    """Largest norm of the gradient."""


class PpoConfig(OnPolicyConfig):
    """Proximal policy optimisation (SB3's `PPO`)."""

    algorithm: Literal["ppo"] = "ppo"
    """Algorithm: ppo."""
    n_epochs: Count = 5
    """Passes over the rollout per iteration."""
    num_minibatches: Count = 4
    """Number of minibatches of a rollout; the number of environments need not be a multiple."""
    desired_kl: Positive | None = None
    """For schedule adaptive: after an iteration the learning rate is divided by 1.5 if the KL divergence is above twice
    this value, and multiplied by 1.5 if the divergence is below half of this value."""
    clip_range: Positive = 0.2
    """Clipping range of the probability ratio: 1 +- clip_range."""
    clip_range_vf: Positive | None = None
    """Clipping range of the change of the value; null: no clipping."""

    @model_validator(mode="after")
    def _schedule(self) -> PpoConfig:
        if (self.schedule == "adaptive") != (self.desired_kl is not None):
            raise ValueError("desired_kl and schedule: adaptive are only used together: set both or neither")
        return self


class A2cConfig(OnPolicyConfig):
    """Advantage actor-critic (SB3's `A2C`): one update with the whole rollout per iteration, by RMSprop."""

    algorithm: Literal["a2c"] = "a2c"
    """Algorithm: a2c."""
    n_steps: Count = 5
    """Steps of each environment per iteration."""
    learning_rate: Positive = 7e-4
    """Learning rate of the optimiser."""
    schedule: Literal["constant", "linear"] = "constant"
    """Schedule of the learning rate: linear decreases to 0 over the budget."""
    gae_lambda: Discount = 1.0
    """Lambda of generalised advantage estimation."""
    normalize_advantage: bool = False
    """Normalise advantages in each minibatch."""


class OffPolicyConfig(Sb3Config):
    """Settings of SAC, TD3 and DDPG.

    An iteration is `train_freq` steps of every environment, then `gradient_steps` updates.
    """

    schedule: Literal["constant", "linear"] = "constant"
    """Schedule of the learning rate: linear decreases to 0 over the budget."""
    action_bound: Positive = 1.0
    """Actions are tanh times this bound; an off-policy algorithm needs a bound."""
    train_freq: Count = 16
    """Steps of each environment per iteration."""
    gradient_steps: Count = 32
    """Updates per iteration."""
    batch_size: Count = 256
    """Transitions of an update."""
    buffer_size: Count = 1_000_000
    """Transitions in the replay buffer, over all environments."""
    learning_starts: Annotated[int, Field(ge=0)] = 4096
    """Environment steps with random actions before the first update."""
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Weight of the new network in each update of a target network: target = tau new + (1 - tau) target."""
    policy: OffPolicyNetworkConfig = OffPolicyNetworkConfig()
    """Networks of actor and critic."""

    @model_validator(mode="after")
    def _sizes(self) -> OffPolicyConfig:
        if self.buffer_size < self.batch_size:
            raise ValueError(
                f"buffer_size ({self.buffer_size}) is below batch_size ({self.batch_size}); raise buffer_size"
            )
        return self


class SacConfig(OffPolicyConfig):
    """Soft actor-critic (SB3's `SAC`)."""

    algorithm: Literal["sac"] = "sac"
    """Algorithm: sac."""
    ent_coef: Positive | Literal["auto"] = "auto"
    """Entropy temperature; auto: it is learned."""


class Td3Config(OffPolicyConfig):
    """Twin delayed deterministic policy gradient (SB3's `TD3`)."""

    algorithm: Literal["td3"] = "td3"
    """Algorithm: td3."""
    exploration_noise: NotNegative = 0.1
    """Standard deviation of the Gaussian exploration noise on actions in [-1, 1]."""
    policy_delay: Count = 2
    """Number of updates of the critics per update of the actor."""
    target_policy_noise: NotNegative = 0.2
    """Standard deviation of the noise on the target's actions."""
    target_noise_clip: NotNegative = 0.5
    """Largest absolute value of the noise on the target's actions."""


class DdpgConfig(OffPolicyConfig):
    """Deep deterministic policy gradient (SB3's `DDPG`)."""

    algorithm: Literal["ddpg"] = "ddpg"
    """Algorithm: ddpg."""
    exploration_noise: NotNegative = 0.1
    """Standard deviation of the Gaussian exploration noise on actions in [-1, 1]."""


SPEC = TrainerSpec(
    summary="Stable-Baselines3",
    algorithms={
        "ppo": "rlcli.rl.sb3.config:PpoConfig",
        "a2c": "rlcli.rl.sb3.config:A2cConfig",
        "sac": "rlcli.rl.sb3.config:SacConfig",
        "td3": "rlcli.rl.sb3.config:Td3Config",
        "ddpg": "rlcli.rl.sb3.config:DdpgConfig",
    },
    trainer="rlcli.rl.sb3.trainer:Sb3Trainer",
    refused={
        "dqn": "the algorithm needs discrete actions, and tasks have continuous ones",
        "her": "the algorithm needs goals as observations, and tasks have vectors",
    },
)
