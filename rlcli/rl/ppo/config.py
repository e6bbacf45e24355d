"""Settings of the built-in PPO trainer; light, so that a YAML is checked without importing torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel
from rlcli.trainers import TrainerSpec

Fraction = Annotated[float, Field(ge=0, le=1)]


class NetworkConfig(StrictModel):
    """A multilayer perceptron."""

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (64, 64)
    """Widths of the hidden layers."""
    activation: Literal["elu", "relu", "tanh", "silu"] = "elu"
    """Activation between layers."""


class RnnConfig(StrictModel):
    """A memory before each network. Minibatches then hold whole environments."""

    type: Literal["lstm"] = "lstm"
    """lstm"""
    hidden: Count = 64
    """Cells of a layer."""
    layers: Count = 1
    """Layers."""


class CnnConfig(StrictModel):
    """Convolutions over every picture of an observation, with the activation of the network behind them; no padding."""

    channels: Annotated[tuple[Count, ...], Field(min_length=1)] = (16, 32)
    """What each layer gives."""
    kernels: Annotated[tuple[Count, ...], Field(min_length=1)] = (8, 4)
    """Edge of each layer's square window [pixels]."""
    strides: Annotated[tuple[Count, ...], Field(min_length=1)] = (4, 2)
    """How far each layer's window moves [pixels]."""
    motion: Positive | None = None
    """The steps of a history before the newest become what has changed since them, times this: velocities are learned
    much sooner; null: they stay pictures."""

    @model_validator(mode="after")
    def _layers(self) -> CnnConfig:
        counts = [len(self.channels), len(self.kernels), len(self.strides)]
        if len(set(counts)) > 1:
            raise ValueError(f"channels, kernels and strides have a number for each layer, not {counts}")
        return self


class PpoConfig(AgentConfig):
    """Proximal policy optimisation, on the CPU or the GPU."""

    algorithm: Literal["ppo"] = "ppo"
    """ppo"""
    dialect: Literal["rsl_rl", "rl_games", "sb3"] | None = None
    """Whose defaults the keys that are not given take: those of RSL-RL, rl_games or Stable-Baselines3."""

    num_steps: Count = 16
    """Steps an environment and iteration."""
    gamma: Fraction = 0.99
    """Discount."""
    lam: Fraction = 0.95
    """Lambda of generalised advantage estimation."""
    bootstrap: Literal["final_obs", "pre_step"] = "final_obs"
    """What a step that ran out of time still earns: gamma times the value of its true last observation, or, as RSL-RL
    and rl_games have it, of the observation before the step."""
    reward_scale: Positive = 1.0
    """Factor on rewards in training; returns are reported without it."""

    num_epochs: Count = 5
    """Passes over the rollout an iteration."""
    num_minibatches: Count = 4
    """Parts of the rollout, an update each; any number of environments divides into them."""
    minibatch_size: Count | None = None
    """Samples an update, instead of a number of minibatches; the last one may be smaller."""
    shuffle: Literal["epoch", "update", "none"] = "epoch"
    """Samples are shuffled before each epoch, once an iteration, or not at all: then a minibatch holds whole
    environments."""
    clip_range: Positive = 0.2
    """Clipping of the probability ratio."""
    clip_value: Literal["larger", "clipped"] | None = "larger"
    """The value's error is taken of the value clipped about its old one: alone, or the larger of that and the plain
    one; null: the plain one."""
    clip_value_range: Positive | None = None
    """Clipping of the value's change; null: clip_range."""
    value_coef: NotNegative = 1.0
    """Weight of the value loss, a mean square."""
    entropy_coef: NotNegative = 0.0
    """Weight of the entropy bonus."""
    bounds_coef: NotNegative = 0.0
    """Weight of the bounds loss: the square of what the mean action exceeds bounds_margin by."""
    bounds_margin: Positive = 1.1
    """Mean actions within +-this cost nothing."""
    normalize_advantage: Literal["batch", "minibatch"] | None = "batch"
    """Over what advantages are normalised; null: they are not."""
    max_grad_norm: Positive | None = 1.0
    """Norm the gradient is clipped to; null: it is not."""
    clip_grad: Literal["joint", "separate"] = "joint"
    """Actor and critic have one gradient norm, or one each."""

    learning_rate: Positive = 1e-3
    """Step size of Adam."""
    adam_eps: Positive = 1e-8
    """Adam's epsilon."""
    schedule: Literal["constant", "linear", "adaptive", "adaptive_linear"] = "constant"
    """How the learning rate moves: linear goes to 0 over the budget; adaptive follows desired_kl: / 1.5 above twice
    that divergence, x 1.5 below half of it; adaptive_linear does so under a ceiling that goes from the upper end of
    learning_rate_range to 0 over the budget, so that the last iterations settle."""
    desired_kl: Positive | None = None
    """Divergence between the policies before and after an update that an adaptive schedule aims at."""
    kl_grain: Literal["minibatch", "epoch", "iteration"] = "minibatch"
    """How often an adaptive schedule looks at the divergence; of an epoch at its mean, of an iteration at that of the
    last epoch."""
    kl_from: Literal["rollout", "last_pass"] = "rollout"
    """The old policy: the one that acted, looked at before a minibatch's update; or, as rl_games has it, the one that
    the epoch before found for the same sample, looked at after the update."""
    learning_rate_range: tuple[Positive, Positive] = (1e-5, 1e-2)
    """Where an adaptive schedule stays."""

    normalize_observations: bool = False
    """Normalise observations by their running mean and deviation; the statistics are part of the policy."""
    normalizer_update: Literal["rollout", "step"] = "rollout"
    """When these statistics take in observations: a rollout's at its end, or each step's before acting."""
    normalize_value: bool = False
    """The critic learns returns normalised by their running mean and deviation."""

    critic_obs: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Observation groups that the critic sees; null: critic if the task has it, else policy."""
    actor: NetworkConfig = NetworkConfig()
    """The policy's network."""
    critic: NetworkConfig = NetworkConfig()
    """The value's network."""
    rnn: RnnConfig | None = None
    """Actor and critic remember what they saw of the episode; null: they do not."""
    cnn: CnnConfig | None = None
    """Actor and critic see pictures through convolutions of their own; null: as columns like all others."""
    tell_coef: NotNegative = 0.0
    """Weight of a loss by which the actor's last hidden layer learns to tell what the critic sees, through a linear
    layer that is not in the policy: each column less its mean, by its deviation, within +-3. So an actor of pictures
    learns sooner what it looks at, where the critic has the state."""
    init: Literal["default", "zero_bias", "orthogonal"] = "default"
    """Initial weights: torch's; torch's with biases of zero; orthogonal, with a gain of sqrt(2) in the hidden layers,
    0.01 at the actor's output and 1 at the critic's, and biases of zero."""
    init_std: Positive = 1.0
    """Standard deviation of the untrained policy, the same in every state, learned."""
    std: Literal["log", "scalar"] = "log"
    """Whether the logarithm of the deviation is learned, or the deviation itself."""

    compile: bool | Literal["tuned"] | None = None
    """Whether torch's compiler fuses what a minibatch computes; tuned: it also tries out matrix kernels, for half a
    minute more the first time; null: true on a GPU, if the run is long enough for it."""
    tf32: bool = True
    """On a GPU, updates multiply matrices in TF32: sums are float32, factors have 10 bits of mantissa. Acting is always
    float32."""

    @model_validator(mode="before")
    @classmethod
    def _dialect(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        dialect = data.get("dialect")
        preset = DIALECTS.get(dialect, {}) if isinstance(dialect, str) else {}
        return _tuples(_over(preset, data))

    @model_validator(mode="after")
    def _relations(self) -> PpoConfig:
        if self.schedule.startswith("adaptive") != (self.desired_kl is not None):
            raise ValueError("desired_kl belongs to an adaptive schedule, and an adaptive schedule needs it")
        if self.kl_from == "last_pass" and self.shuffle == "epoch":
            raise ValueError("kl_from last_pass needs the same minibatches in every epoch: shuffle update or none")
        if self.cnn is not None and self.rnn is not None:
            raise ValueError("cnn and rnn cannot be had together: a history of pictures shows what moves")
        low, high = self.learning_rate_range
        if low > high:
            raise ValueError(f"learning_rate_range: {low:g} is above {high:g}")
        return self


DIALECTS: Mapping[str, Mapping[str, Any]] = {
    "rsl_rl": {
        "num_steps": 24,
        "bootstrap": "pre_step",
        "shuffle": "update",
        "clip_value": "larger",
        "value_coef": 1.0,
        "entropy_coef": 0.01,
        "normalize_advantage": "batch",
        "clip_grad": "separate",
        "schedule": "adaptive",
        "desired_kl": 0.01,
        "kl_grain": "minibatch",
        "learning_rate_range": [1e-5, 1e-2],
        "std": "scalar",
        "actor": {"hidden": [256, 256, 256], "activation": "elu"},
        "critic": {"hidden": [256, 256, 256], "activation": "elu"},
    },
    "rl_games": {
        "bootstrap": "pre_step",
        "shuffle": "none",
        "clip_value": "larger",
        "value_coef": 2.0,
        "bounds_coef": 1e-4,
        "normalize_advantage": "batch",
        "clip_grad": "joint",
        "learning_rate": 3e-4,
        "schedule": "adaptive",
        "desired_kl": 0.008,
        "kl_grain": "minibatch",
        "kl_from": "last_pass",
        "learning_rate_range": [1e-6, 1e-2],
        "init": "zero_bias",
    },
    "sb3": {
        "bootstrap": "final_obs",
        "shuffle": "epoch",
        "num_epochs": 10,
        "clip_value": None,
        "value_coef": 0.5,
        "normalize_advantage": "minibatch",
        "max_grad_norm": 0.5,
        "clip_grad": "joint",
        "learning_rate": 3e-4,
        "adam_eps": 1e-5,
        "init": "orthogonal",
        "actor": {"activation": "tanh"},
        "critic": {"activation": "tanh"},
    },
}
"""Dialect -> the defaults that it replaces."""

SPEC = TrainerSpec(
    summary="Built-in PPO in torch alone; on a GPU all of it is captured",
    algorithms={"ppo": "rlcli.rl.ppo.config:PpoConfig"},
    trainer="rlcli.rl.ppo.trainer:PpoTrainer",
    parallel=True,
    gpu=True,
)


def _over(base: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with what is given put over it, mappings key by key."""
    merged = {**base, **given}
    for key, value in base.items():
        if isinstance(value, dict) and isinstance(given.get(key), dict):
            merged[key] = {**value, **given[key]}
    return merged


def _tuples(value: object) -> Any:
    """JSON's lists as tuples: what a validator returns counts as Python's, of which a list is no tuple."""
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
