"""Settings of the Stable-Baselines3 trainer; light, so that a YAML is checked without importing the library."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel
from rlcli.trainers import TrainerSpec

Discount = Annotated[float, Field(ge=0, le=1)]


class NetworkConfig(StrictModel):
    """Actor and critic: networks of the same shape."""

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (64, 64)
    """Widths of the hidden layers."""
    activation: Literal["elu", "relu", "tanh", "silu"] = "tanh"
    """Activation between layers."""
    init_std: Positive = 1.0
    """On-policy: standard deviation of the untrained policy, the same in every state, learned."""
    ortho_init: bool = False
    """On-policy: orthogonal initial weights, SB3's own default; torch's otherwise."""


class Sb3Config(AgentConfig):
    """What all algorithms have in common, under SB3's names."""

    learning_rate: Positive = 3e-4
    """Step size of the optimiser."""
    schedule: Literal["constant", "linear", "adaptive"] = "constant"
    """How the learning rate moves: linear goes to 0 over the budget; adaptive (PPO only) follows desired_kl."""
    gamma: Discount = 0.99
    """Discount."""
    reward_scale: Positive = 1.0
    """Factor on rewards in training; returns are reported without it."""
    normalize_observations: bool = False
    """Normalise observations by their running mean and deviation; the statistics are part of the policy."""
    policy: NetworkConfig = NetworkConfig()
    """Networks."""


class OnPolicyConfig(Sb3Config):
    """PPO and A2C."""

    n_steps: Count = 16
    """Steps an environment and iteration."""
    gae_lambda: Discount = 0.95
    """Lambda of generalised advantage estimation."""
    normalize_advantage: bool = True
    """Normalise advantages in each minibatch."""
    ent_coef: NotNegative = 0.0
    """Weight of the entropy bonus."""
    vf_coef: NotNegative = 0.5
    """Weight of the value loss."""
    max_grad_norm: Positive = 0.5
    """Norm the gradient is clipped to."""


class PpoConfig(OnPolicyConfig):
    """Proximal policy optimisation (SB3's `PPO`)."""

    algorithm: Literal["ppo"] = "ppo"
    """ppo"""
    n_epochs: Count = 5
    """Passes over the rollout an iteration."""
    num_minibatches: Count = 4
    """Parts of the rollout, an update each; any number of environments divides into them."""
    desired_kl: Positive | None = None
    """For schedule adaptive: after an iteration, / 1.5 above twice this divergence, x 1.5 below half of it."""
    clip_range: Positive = 0.2
    """Clipping of the probability ratio."""
    clip_range_vf: Positive | None = None
    """Clipping of the value's change; null: none."""

    @model_validator(mode="after")
    def _schedule(self) -> PpoConfig:
        if (self.schedule == "adaptive") != (self.desired_kl is not None):
            raise ValueError("desired_kl belongs to schedule adaptive, and schedule adaptive needs it")
        return self


class A2cConfig(OnPolicyConfig):
    """Advantage actor-critic (SB3's `A2C`): one update of the whole rollout an iteration, RMSprop."""

    algorithm: Literal["a2c"] = "a2c"
    """a2c"""
    n_steps: Count = 5
    """Steps an environment and iteration."""
    learning_rate: Positive = 7e-4
    """Step size of the optimiser."""
    schedule: Literal["constant", "linear"] = "constant"
    """How the learning rate moves: linear goes to 0 over the budget."""
    gae_lambda: Discount = 1.0
    """Lambda of generalised advantage estimation."""
    normalize_advantage: bool = False
    """Normalise advantages in each minibatch."""


class OffPolicyConfig(Sb3Config):
    """SAC, TD3 and DDPG. An iteration is `train_freq` steps of every environment, then `gradient_steps` updates."""

    schedule: Literal["constant", "linear"] = "constant"
    """How the learning rate moves: linear goes to 0 over the budget."""
    action_bound: Positive = 1.0
    """Actions are tanh times this; an off-policy algorithm needs a bound."""
    train_freq: Count = 16
    """Steps an environment and iteration."""
    gradient_steps: Count = 32
    """Updates an iteration."""
    batch_size: Count = 256
    """Transitions an update."""
    buffer_size: Count = 1_000_000
    """Transitions kept, over all environments."""
    learning_starts: Annotated[int, Field(ge=0)] = 4096
    """Environment steps of random actions before the first update."""
    tau: Annotated[float, Field(gt=0, le=1)] = 0.005
    """Share of the new weights that a target network takes on at each update."""
    policy: NetworkConfig = NetworkConfig(hidden=(256, 256), activation="relu")
    """Networks."""

    @model_validator(mode="after")
    def _sizes(self) -> OffPolicyConfig:
        if self.buffer_size < self.batch_size:
            raise ValueError(f"buffer_size ({self.buffer_size}) is smaller than batch_size ({self.batch_size})")
        return self


class SacConfig(OffPolicyConfig):
    """Soft actor-critic (SB3's `SAC`)."""

    algorithm: Literal["sac"] = "sac"
    """sac"""
    ent_coef: Positive | Literal["auto"] = "auto"
    """Entropy temperature; auto learns it."""


class Td3Config(OffPolicyConfig):
    """Twin delayed deterministic policy gradient (SB3's `TD3`)."""

    algorithm: Literal["td3"] = "td3"
    """td3"""
    exploration_noise: NotNegative = 0.1
    """Deviation of the Gaussian noise on actions in [-1, 1] while collecting."""
    policy_delay: Count = 2
    """Updates of the critics for one of the actor."""
    target_policy_noise: NotNegative = 0.2
    """Deviation of the noise on the target's actions."""
    target_noise_clip: NotNegative = 0.5
    """Limit of that noise."""


class DdpgConfig(OffPolicyConfig):
    """Deep deterministic policy gradient (SB3's `DDPG`)."""

    algorithm: Literal["ddpg"] = "ddpg"
    """ddpg"""
    exploration_noise: NotNegative = 0.1
    """Deviation of the Gaussian noise on actions in [-1, 1] while collecting."""


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
        "dqn": "it needs discrete actions, and tasks have continuous ones",
        "her": "it needs goals as observations, and tasks have vectors",
    },
)
