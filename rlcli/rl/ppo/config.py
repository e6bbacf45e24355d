"""Settings (agent keys) of the built-in PPO trainer, as pydantic models.

The module does not import torch, so that a task's YAML file is checked fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel, Width, Widths
from rlcli.config.strict_yaml import load
from rlcli.trainers import TrainerSpec

Fraction = Annotated[float, Field(ge=0, le=1)]
_Sizes = Annotated[tuple[Annotated[int, Field(ge=1, le=4096)], ...], Field(min_length=1, max_length=16)]
"""Channels, kernels or strides of the layers of a CNN."""


class NetworkConfig(StrictModel):
    """Multilayer perceptron."""

    hidden: Widths = (64, 64)
    """Widths of the hidden layers."""
    activation: Literal["elu", "relu", "tanh", "silu"] = "elu"
    """Activation between layers."""


class RnnConfig(StrictModel):
    """Recurrent network before the MLPs of actor and critic. A minibatch then holds all steps of its environments."""

    type: Literal["lstm"] = "lstm"
    """Kind of the RNN: lstm."""
    hidden: Width = 64
    """Number of cells of a layer."""
    layers: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of layers."""


class CnnConfig(StrictModel):
    """CNN over each image of an observation, without padding, with the activation of the MLP that follows."""

    channels: _Sizes = (16, 32)
    """Output channels of each layer."""
    kernels: _Sizes = (8, 4)
    """Edge of each layer's square kernel [pixels]."""
    strides: _Sizes = (4, 2)
    """Stride of each layer [pixels]."""
    motion: Positive | None = None
    """Each older image of a history becomes (newest - older) times this factor, so that velocities are learned much
    sooner; null: images are not changed."""

    @model_validator(mode="after")
    def _layers(self) -> CnnConfig:
        counts = [len(self.channels), len(self.kernels), len(self.strides)]
        if len(set(counts)) > 1:
            message = f"channels, kernels and strides must have one number for each layer, found {counts} numbers"
            raise ValueError(message)
        return self


class SymmetryConfig(StrictModel):
    """Symmetry of a robot about the x-z plane of its root. The training derives how observations and actions change in
    the mirror, and refuses a robot, reward or observation that is not symmetric. Mittal et al. 2024.
    """

    augment: bool = True
    """Add the mirror image of each sample to its minibatch, with the same advantage and value target."""
    mirror_coef: NotNegative = 0.0
    """Weight of the mirror loss: the mean squared difference between the mean action for a mirrored observation and the
    mirrored mean action."""
    tolerance: Positive = 1e-3
    """Largest difference between the motion, reward or observation of a robot and of its mirror image that is allowed,
    relative to the mean size of its changes."""

    @model_validator(mode="after")
    def _require_effect(self) -> SymmetryConfig:
        if not self.augment and not self.mirror_coef:
            raise ValueError("symmetry has no effect: set augment: true or mirror_coef above 0")
        return self


class PpoConfig(AgentConfig):
    """Proximal policy optimisation on the CPU or the GPU."""

    algorithm: Literal["ppo"] = "ppo"
    """Algorithm: ppo."""
    dialect: Literal["rsl_rl", "rl_games", "sb3"] | None = None
    """Library whose defaults are used for keys that are not given: RSL-RL, rl_games or Stable-Baselines3."""

    num_steps: Count = 16
    """Steps of each environment per iteration."""
    gamma: Fraction = 0.99
    """Discount factor."""
    lam: Fraction = 0.95
    """Lambda of generalised advantage estimation."""
    bootstrap: Literal["final_obs", "pre_step"] = "final_obs"
    """Bootstrap of a time-out: gamma times the critic's value of an observation is added to the reward. final_obs: the
    last observation of the episode. pre_step: the observation before the step, as in RSL-RL and rl_games."""
    reward_scale: Positive = 1.0
    """Factor on rewards in training; reported returns do not include it."""

    num_epochs: Count = 5
    """Passes over the rollout per iteration."""
    num_minibatches: Count = 4
    """Number of minibatches of a rollout; the number of environments need not be a multiple."""
    minibatch_size: Count | None = None
    """Samples of a minibatch, instead of num_minibatches; the last minibatch may be smaller."""
    shuffle: Literal["epoch", "update", "none"] = "epoch"
    """When samples are shuffled: before each epoch, once per iteration, or never. If never, a minibatch holds all
    steps of its environments."""
    clip_range: Positive = 0.2
    """Clipping range of the probability ratio: 1 +- clip_range."""
    clip_value: Literal["larger", "clipped"] | None = "larger"
    """Squared error in the value loss. null: the error of the critic's value. clipped: the error after the value is
    clipped to the range old value +- clip_value_range. larger: the larger one of these two errors."""
    clip_value_range: Positive | None = None
    """Clipping range of the change of the value; null: clip_range."""
    value_coef: NotNegative = 1.0
    """Weight of the value loss, a mean squared error."""
    entropy_coef: NotNegative = 0.0
    """Weight of the entropy bonus."""
    bounds_coef: NotNegative = 0.0
    """Weight of the bounds loss: the squared excess of the mean action over bounds_margin."""
    bounds_margin: Positive = 1.1
    """The bounds loss is 0 for mean actions within +-bounds_margin."""
    normalize_advantage: Literal["batch", "minibatch"] | None = "batch"
    """Samples over which advantages are normalised; null: no normalisation."""
    max_grad_norm: Positive | None = 1.0
    """Largest norm of the gradient; null: no clipping."""
    clip_grad: Literal["joint", "separate"] = "joint"
    """Whether the gradients of actor and critic are clipped by one joint norm or separately."""

    learning_rate: Positive = 1e-3
    """Learning rate of Adam."""
    adam_eps: Positive = 1e-8
    """Adam's epsilon."""
    schedule: Literal["constant", "linear", "adaptive", "adaptive_linear"] = "constant"
    """Schedule of the learning rate. linear: it decreases to 0 over the budget. adaptive: it is divided by 1.5 if the
    KL divergence is above 2 desired_kl, and multiplied by 1.5 if it is below desired_kl / 2. adaptive_linear: like
    adaptive, with an upper limit that decreases from the upper end of learning_rate_range to 0 over the budget."""
    desired_kl: Positive | None = None
    """Target of an adaptive schedule: KL divergence between the policies before and after an update."""
    kl_grain: Literal["minibatch", "epoch", "iteration"] = "minibatch"
    """How often an adaptive schedule changes the learning rate. epoch: by the mean KL divergence of the epoch.
    iteration: by the mean of the last epoch."""
    kl_from: Literal["rollout", "last_pass"] = "rollout"
    """Old policy of the KL divergence. rollout: the policy that collected the rollout; the schedule acts before the
    minibatch's update. last_pass: the policy of the previous epoch for the same sample; the schedule acts after the
    update, as in rl_games."""
    learning_rate_range: tuple[Positive, Positive] = (1e-5, 1e-2)
    """Lowest and highest learning rate of an adaptive schedule."""

    normalize_observations: bool = False
    """Normalise observations by their running mean and standard deviation, which are part of the policy."""
    normalizer_update: Literal["rollout", "step"] = "rollout"
    """When the statistics of normalize_observations are updated: at the end of a rollout, or in each step before the
    action."""
    normalize_value: bool = False
    """Train the critic on returns normalised by their running mean and standard deviation."""

    critic_obs: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Observation groups of the critic; null: critic if the task has this group, else policy."""
    actor: NetworkConfig = NetworkConfig()
    """Network of the policy."""
    critic: NetworkConfig = NetworkConfig()
    """Network of the value function."""
    rnn: RnnConfig | None = None
    """RNN of actor and critic, one each; null: none."""
    cnn: CnnConfig | None = None
    """CNN of actor and critic, one each; null: the pixels of images are columns like all others."""
    tell_coef: NotNegative = 0.0
    """Weight of an auxiliary loss: a linear layer, which is not a part of the policy, predicts the critic's observation
    from the actor's last hidden layer. The targets are standardised and clipped to +-3. An actor of images learns
    sooner with it if the critic observes the state."""
    symmetry: SymmetryConfig | None = None
    """Mirror symmetry of the robot; null: not used."""
    init: Literal["default", "zero_bias", "orthogonal"] = "default"
    """Initial weights. default: torch's. zero_bias: torch's weights and zero biases. orthogonal: zero biases and
    orthogonal weights with gain sqrt(2) in hidden layers, 0.01 in the actor's and 1 in the critic's output layer."""
    init_std: Positive = 1.0
    """Initial standard deviation of the actions; it is learned and does not depend on the state."""
    std: Literal["log", "scalar"] = "log"
    """Learned parameter: the logarithm of the standard deviation (log), or the standard deviation (scalar)."""

    compile: bool | Literal["tuned"] | None = None
    """Whether torch's compiler fuses the operations of a minibatch. tuned: it also benchmarks matrix kernels, which
    takes half a minute the first time. null: true on a GPU if the run is long enough."""
    tf32: bool = True
    """On a GPU, multiply matrices in TF32 in updates: factors have 10 bits of mantissa, sums are float32. Rollouts
    always use float32."""

    @model_validator(mode="before")
    @classmethod
    def _dialect(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        preset = DIALECTS.get(str(data.get("dialect")), {})
        networks = {
            name: {**preset[name], **data[name]}
            for name in ("actor", "critic")
            if name in preset and isinstance(data.get(name), dict)
        }
        return _lists_to_tuples({**preset, **data, **networks})

    @model_validator(mode="after")
    def _relations(self) -> PpoConfig:
        if self.schedule.startswith("adaptive") != (self.desired_kl is not None):
            raise ValueError("desired_kl and an adaptive schedule are only used together: set both or neither")
        if self.kl_from == "last_pass" and self.shuffle == "epoch":
            message = "kl_from: last_pass needs the same minibatches in every epoch: set shuffle to update or none"
            raise ValueError(message)
        if self.cnn is not None and self.rnn is not None:
            message = "cnn and rnn cannot be combined: set rnn: null, and give the image a history to show motion"
            raise ValueError(message)
        if self.symmetry is not None and (self.cnn is not None or self.rnn is not None):
            raise ValueError("symmetry needs networks without cnn and rnn: set both to null, or set symmetry: null")
        low, high = self.learning_rate_range
        if low > high:
            raise ValueError(f"learning_rate_range: {low:g} is above {high:g}; write [low, high]")
        return self


DIALECTS: Mapping[str, Mapping[str, Any]] = load(Path(__file__).with_name("dialects.yaml").read_bytes()).data
"""Dialect (library whose defaults are used) -> settings whose defaults differ from those of `PpoConfig`."""

SPEC = TrainerSpec(
    summary="Built-in PPO in torch; on a GPU it runs as CUDA graphs",
    algorithms={"ppo": "rlcli.rl.ppo.config:PpoConfig"},
    trainer="rlcli.rl.ppo.trainer:PpoTrainer",
    parallel=True,
    gpu=True,
)


def _lists_to_tuples(value: object) -> Any:
    """Return JSON data in which all lists are replaced by tuples.

    pydantic accepts a list from a YAML file for a field whose type is a tuple. The output of a validator is checked
    more strictly: there the value must already be a tuple.
    """
    if isinstance(value, dict):
        return {key: _lists_to_tuples(item) for key, item in value.items()}
    return tuple(_lists_to_tuples(item) for item in value) if isinstance(value, list) else value
