"""Schema of RSL-RL's settings, in the form of Isaac Lab's `RslRlOnPolicyRunnerCfg` or of RSL-RL 5.

The module imports neither torch nor RSL-RL, so that a YAML is checked fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel
from rlcli.trainers import TrainerSpec

Fraction = Annotated[float, Field(ge=0, le=1)]
Activation = Literal["elu", "relu", "tanh", "swish"]
"""Activations that a saved policy supports too; swish is SiLU."""
Widths = Annotated[list[Count], Field(min_length=1)]
_WIDE = [256, 256, 256]
_AS_WIDE_AS_THE_INPUT = [-1]
_NO_GROUPS: dict[str, list[str]] = {}


class PolicyConfig(StrictModel):
    """Settings of the actor's and the critic's network, in the form of Isaac Lab and of RSL-RL up to version 4."""

    class_name: Literal["ActorCritic", "ActorCriticRecurrent"] = "ActorCritic"
    """Kind of the networks; ActorCriticRecurrent has an LSTM before each network."""
    init_noise_std: Positive = 1.0
    """Standard deviation of the untrained policy."""
    noise_std_type: Literal["scalar", "log"] = "scalar"
    """Trained parameter: the standard deviation (scalar), or its logarithm (log)."""
    state_dependent_std: Literal[False] = False
    """Whether the standard deviation depends on the state; must be false."""
    actor_obs_normalization: bool | None = None
    """Normalise the actor's observations by running mean and standard deviation; null: use empirical_normalization."""
    critic_obs_normalization: bool | None = None
    """Normalise the critic's observations; null: use empirical_normalization."""
    actor_hidden_dims: Widths = _WIDE
    """Widths of the actor's hidden layers."""
    critic_hidden_dims: Widths = _WIDE
    """Widths of the critic's hidden layers."""
    activation: Activation = "elu"
    """Activation between layers."""
    rnn_type: Literal["lstm"] = "lstm"
    """Recurrent network of an ActorCriticRecurrent."""
    rnn_hidden_dim: Count = 256
    """Cells of each recurrent layer."""
    rnn_num_layers: Count = 1
    """Number of recurrent layers."""


class DistributionConfig(StrictModel):
    """Settings of the distribution from which actions are sampled, in the form of RSL-RL 5."""

    class_name: Literal["GaussianDistribution"] = "GaussianDistribution"
    """The network gives the mean; the standard deviation does not depend on the state."""
    init_std: Positive = 1.0
    """Standard deviation of the untrained policy."""
    std_type: Literal["scalar", "log"] = "scalar"
    """Trained parameter: the standard deviation (scalar), or its logarithm (log)."""
    std_range: tuple[NotNegative, Positive] = (1e-6, 1e6)
    """Bounds of the standard deviation."""
    learn_std: bool = True
    """Whether the standard deviation is trained."""


class ModelConfig(StrictModel):
    """Settings of one network (actor or critic), in the form of RSL-RL 5."""

    class_name: Literal["MLPModel", "RNNModel"] = "MLPModel"
    """Kind of the network; RNNModel has an LSTM before its hidden layers."""
    hidden_dims: Widths = _WIDE
    """Widths of the hidden layers."""
    activation: Activation = "elu"
    """Activation between layers."""
    obs_normalization: bool = False
    """Normalise observations by running mean and standard deviation."""
    distribution_cfg: DistributionConfig | None = None
    """Distribution of the actions; for the actor only."""
    rnn_type: Literal["lstm"] = "lstm"
    """Recurrent network of an RNNModel."""
    rnn_hidden_dim: Count = 256
    """Cells of each recurrent layer."""
    rnn_num_layers: Count = 1
    """Number of recurrent layers."""


class WeightScheduleConfig(StrictModel):
    """Schedule of the weight of the curiosity reward, by environment steps."""

    mode: Literal["constant", "step", "linear"]
    """Shape of the schedule."""
    initial_step: NotNegative | None = None
    """Step at which the linear change begins."""
    final_step: NotNegative | None = None
    """Step at which the linear change ends, or at which the weight jumps to its final value."""
    final_value: NotNegative | None = None
    """Weight after final_step."""

    @model_validator(mode="after")
    def _needs(self) -> WeightScheduleConfig:
        needed = {"constant": (), "step": ("final_step", "final_value")}
        names = needed.get(self.mode, ("initial_step", "final_step", "final_value"))
        missing = [name for name in names if getattr(self, name) is None]
        if missing:
            raise ValueError(f"mode {self.mode} needs {' and '.join(missing)}; set each of them")
        return self


class RndConfig(StrictModel):
    """Settings of random network distillation (Burda et al. 2018), a reward for states that are new (curiosity)."""

    weight: NotNegative = 0.0
    """Weight of the curiosity reward; RSL-RL multiplies it by the step time."""
    weight_schedule: WeightScheduleConfig | None = None
    """Schedule of the weight; null: constant."""
    reward_normalization: bool = False
    """Divide the curiosity reward by the standard deviation of its discounted sum."""
    state_normalization: bool = False
    """Normalise the inputs of the networks."""
    learning_rate: Positive = 1e-3
    """Learning rate of the predictor."""
    num_outputs: Count = 1
    """Number of outputs of both networks: the fixed random target, and the predictor that learns its outputs."""
    predictor_hidden_dims: Annotated[list[int], Field(min_length=1)] = _AS_WIDE_AS_THE_INPUT
    """Widths of the predictor; -1: as wide as its input."""
    target_hidden_dims: Annotated[list[int], Field(min_length=1)] = _AS_WIDE_AS_THE_INPUT
    """Widths of the target."""
    activation: Activation = "elu"
    """Activation between layers."""


class SymmetryConfig(StrictModel):
    """Settings of the use of a task's mirror symmetry in the update (Mittal et al. 2024)."""

    data_augmentation_func: str
    """`module:function` of the task's package or a plugin's, or `file.py:function` beside the task, called as
    `f(env=, obs=, actions=)`. It returns the observations and the actions with their mirror images appended. `obs` or
    `actions` may be None. `env.unwrapped` is rlcli's environment."""
    use_data_augmentation: bool = False
    """Also train on mirrored samples."""
    use_mirror_loss: bool = False
    """Add a loss on the difference between the action in a mirrored state and the mirrored action."""
    mirror_loss_coeff: NotNegative = 0.0
    """Weight of the mirror loss."""


class AlgorithmConfig(StrictModel):
    """Settings of the PPO update."""

    class_name: Literal["PPO"] = "PPO"
    """Name of RSL-RL's algorithm class, for proximal policy optimisation."""
    num_learning_epochs: Count = 5
    """Epochs per iteration."""
    num_mini_batches: Count = 4
    """Minibatches per epoch; samples that remain after the division are dropped."""
    learning_rate: Positive = 1e-3
    """Learning rate."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """Optimiser of both networks."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """adaptive: the learning rate follows desired_kl after every minibatch."""
    desired_kl: Positive | None = 0.01
    """Target KL divergence between the policies before and after an update, for the adaptive schedule."""
    gamma: Fraction = 0.99
    """Discount factor."""
    lam: Fraction = 0.95
    """Lambda of generalised advantage estimation."""
    entropy_coef: NotNegative = 0.01
    """Weight of the entropy bonus."""
    value_loss_coef: NotNegative = 1.0
    """Weight of the value loss, a mean square."""
    use_clipped_value_loss: bool = True
    """Use the larger error of the value and of the value clipped around its old prediction."""
    clip_param: Positive = 0.2
    """Clipping of the probability ratio and of the value's change."""
    max_grad_norm: Positive = 1.0
    """Maximum norm of the gradients; actor and critic are clipped separately."""
    normalize_advantage_per_mini_batch: bool = False
    """Normalise advantages in each minibatch instead of over the rollout."""
    rnd_cfg: RndConfig | None = None
    """Curiosity reward; null: none."""
    symmetry_cfg: SymmetryConfig | None = None
    """Symmetry of the task; null: not used."""


_ELSEWHERE: Mapping[str, tuple[Any, str]] = {
    "seed": (42, "--seed"),
    "device": ("cuda:0", "--device"),
    "run_name": ("", "--name"),
    "logger": ("tensorboard", "--logger"),
    "resume": (False, "--resume"),
    "load_run": (".*", "--resume"),
    "load_checkpoint": ("model_.*.pt", "--resume"),
}
"""Key of a runner's configuration that has no effect -> (RSL-RL's default, what to use instead)."""


class RunnerConfig(AgentConfig):
    """Settings of a training: the keys of `RslRlOnPolicyRunnerCfg`, and those of every agent of rlcli."""

    algorithm: AlgorithmConfig = AlgorithmConfig()  # type: ignore[assignment]
    """Settings of the update; `ppo` means RSL-RL's defaults."""
    bootstrap: Literal["final_obs", "pre_step"] = "final_obs"
    """Return after a time-out: gamma times the value of the last observation of the episode, or, as in RSL-RL
    itself, of the observation before the step."""
    action_bound: Positive | None = None
    """Actions are clipped to +-this value in training, play and export alike; null: unbounded. RSL-RL's name of this
    key, `clip_actions`, is accepted, too."""
    class_name: Literal["OnPolicyRunner"] = "OnPolicyRunner"
    """Name of RSL-RL's runner class."""
    num_steps_per_env: Count = 24
    """Steps per environment and iteration."""
    obs_groups: dict[str, Annotated[list[str], Field(min_length=1)]] = _NO_GROUPS
    """Which observation groups the actor (`actor`, or `policy` as before RSL-RL 5), the `critic` and the curiosity
    (`rnd_state`) observe. Default: the critic observes the group critic if the task has one, else policy; the others
    observe policy."""
    policy: PolicyConfig | None = None
    """Settings of both networks in the older form. If actor and critic are null as well, RSL-RL's defaults are used."""
    actor: ModelConfig | None = None
    """Actor network, in the form of RSL-RL 5."""
    critic: ModelConfig | None = None
    """Critic network, in the form of RSL-RL 5."""
    empirical_normalization: bool | None = None
    """Older form: normalise observations of both networks."""
    experiment_name: str = ""
    """Ignored: the task and --name set the name of a run."""
    run_name: str = ""
    """Ignored: use --name."""
    seed: int = 42
    """Ignored: use --seed."""
    device: str = "cuda:0"
    """Ignored: use --device."""
    logger: str = "tensorboard"
    """Ignored: use --logger."""
    neptune_project: str = "isaaclab"
    """Ignored: rlcli has no logger for Neptune."""
    wandb_project: str = "isaaclab"
    """Ignored: the environment variable WANDB_PROJECT sets the project."""
    resume: bool = False
    """Ignored: use --resume."""
    load_run: str = ".*"
    """Ignored: use --resume."""
    load_checkpoint: str = "model_.*.pt"
    """Ignored: use --resume."""
    check_for_nan: bool = True
    """Ignored: non-finite values always stop a training."""

    @model_validator(mode="before")
    @classmethod
    def _forms(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        data = dict(data)
        if isinstance(data.get("algorithm"), str):
            data["algorithm"] = {}
        if "clip_actions" in data:
            clip = data.pop("clip_actions")
            if data.get("action_bound", clip) != clip:
                bound = data["action_bound"]
                raise ValueError(f"clip_actions ({clip}) and action_bound ({bound}) set the same value: remove one")
            data["action_bound"] = clip
        return _tuples(data)

    @model_validator(mode="after")
    def _relations(self) -> RunnerConfig:
        if self.policy is not None and (self.actor is not None or self.critic is not None):
            raise ValueError("policy is the older form of actor and critic: remove policy, or actor and critic")
        if self.algorithm.symmetry_cfg is not None and self.memory is not None:
            raise ValueError("RSL-RL does not support symmetry for recurrent networks: remove one of the two")
        if self.algorithm.schedule == "adaptive" and self.algorithm.desired_kl is None:
            raise ValueError("algorithm.schedule adaptive needs algorithm.desired_kl: set it")
        if self.critic is not None and self.critic.distribution_cfg is not None:
            raise ValueError("only the actor has a distribution: remove critic.distribution_cfg")
        return self

    @property
    def networks(self) -> tuple[ModelConfig, ModelConfig]:
        """The actor's and the critic's settings in the form of RSL-RL 5, also if the user wrote the older `policy`."""
        policy = self.policy
        if policy is None:
            actor = self.actor or ModelConfig()
            distribution = actor.distribution_cfg or DistributionConfig()
            return actor.model_copy(update={"distribution_cfg": distribution}), self.critic or ModelConfig()
        everywhere = bool(self.empirical_normalization)

        def network(dims: list[int], normalized: bool | None, distribution: DistributionConfig | None) -> ModelConfig:
            return ModelConfig(
                class_name="RNNModel" if policy.class_name == "ActorCriticRecurrent" else "MLPModel",
                hidden_dims=dims,
                activation=policy.activation,
                obs_normalization=everywhere if normalized is None else normalized,
                distribution_cfg=distribution,
                rnn_type=policy.rnn_type,
                rnn_hidden_dim=policy.rnn_hidden_dim,
                rnn_num_layers=policy.rnn_num_layers,
            )

        noise = DistributionConfig(init_std=policy.init_noise_std, std_type=policy.noise_std_type)
        return (
            network(policy.actor_hidden_dims, policy.actor_obs_normalization, noise),
            network(policy.critic_hidden_dims, policy.critic_obs_normalization, None),
        )

    @property
    def memory(self) -> list[int] | None:
        """Number of cells in each recurrent layer of the actor.

        The list is empty if only the critic is recurrent. The value is None if neither network is recurrent.
        """
        actor, critic = self.networks
        if "RNNModel" not in (actor.class_name, critic.class_name):
            return None
        return [actor.rnn_hidden_dim] * actor.rnn_num_layers if actor.class_name == "RNNModel" else []

    @property
    def not_read(self) -> list[str]:
        """The settings that are set but have no effect, each with what to use instead, as in `seed: use --seed`."""
        return [f"{key}: use {flag}" for key, (default, flag) in _ELSEWHERE.items() if getattr(self, key) != default]


def _tuples(data: dict[str, Any]) -> dict[str, Any]:
    """Return an agent's settings with `actor.distribution_cfg.std_range` as a tuple instead of a list.

    A validator that runs before the field's own check must give a tuple, because the model is strict.
    """
    try:
        distribution = data["actor"]["distribution_cfg"]
        pair = tuple(distribution["std_range"])
    except (KeyError, TypeError):
        return data
    return {**data, "actor": {**data["actor"], "distribution_cfg": {**distribution, "std_range": pair}}}


SPEC = TrainerSpec(
    summary="RSL-RL's PPO, with its own settings",
    algorithms={"ppo": "rlcli_rsl_rl.config:RunnerConfig"},
    trainer="rlcli_rsl_rl.trainer:RslRlTrainer",
    refused={"distillation": "the algorithm needs a teacher's observations and policy"},
)
