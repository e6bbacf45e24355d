"""Settings of the Stable-Baselines3 trainer; light, so that a YAML is checked without importing the library."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel
from rlcli.trainers import TrainerSpec

Discount = Annotated[float, Field(ge=0, le=1)]


class NetworkConfig(StrictModel):
    """Actor and critic: two networks of the same shape."""

    hidden: tuple[Count, ...] = (64, 64)
    """Widths of the hidden layers."""
    activation: Literal["elu", "relu", "tanh", "silu"] = "tanh"
    """Activation between layers."""
    init_std: Positive = 1.0
    """Standard deviation of the untrained policy, the same in every state, learned."""
    ortho_init: bool = False
    """Orthogonal initial weights, SB3's own default; torch's otherwise."""


class PpoConfig(AgentConfig):
    """Proximal policy optimisation (SB3's `PPO`), under SB3's names."""

    algorithm: Literal["ppo"] = "ppo"
    """ppo"""
    n_steps: Count = 16
    """Steps an environment and iteration."""
    n_epochs: Count = 5
    """Passes over the rollout an iteration."""
    num_minibatches: Count = 4
    """Parts of the rollout, an update each; any number of environments divides into them."""
    learning_rate: Positive = 3e-4
    """Adam's step size."""
    schedule: Literal["constant", "linear", "adaptive"] = "constant"
    """How the learning rate moves: linear goes to 0 over the budget; adaptive follows desired_kl."""
    desired_kl: Positive | None = None
    """For schedule adaptive: after an iteration, / 1.5 above twice this divergence, x 1.5 below half of it."""
    gamma: Discount = 0.99
    """Discount."""
    gae_lambda: Discount = 0.95
    """Lambda of generalised advantage estimation."""
    clip_range: Positive = 0.2
    """Clipping of the probability ratio."""
    clip_range_vf: Positive | None = None
    """Clipping of the value's change; null: none."""
    normalize_advantage: bool = True
    """Normalise advantages in each minibatch."""
    ent_coef: NotNegative = 0.0
    """Weight of the entropy bonus."""
    vf_coef: NotNegative = 0.5
    """Weight of the value loss."""
    max_grad_norm: Positive = 0.5
    """Norm the gradient is clipped to."""
    reward_scale: Positive = 1.0
    """Factor on rewards in training; returns are reported without it."""
    policy: NetworkConfig = NetworkConfig()
    """Networks."""

    @model_validator(mode="after")
    def _schedule(self) -> PpoConfig:
        if (self.schedule == "adaptive") != (self.desired_kl is not None):
            raise ValueError("desired_kl belongs to schedule adaptive, and schedule adaptive needs it")
        return self


SPEC = TrainerSpec(
    summary="Stable-Baselines3",
    algorithms={"ppo": "rlcli.rl.sb3_config:PpoConfig"},
    trainer="rlcli.rl.sb3:Sb3Trainer",
)
