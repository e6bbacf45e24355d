"""RSL-RL's settings as they stand in a `RslRlOnPolicyRunnerCfg`, or in RSL-RL 5's own form.

Light: a YAML is checked without importing torch or RSL-RL.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel
from rlcli.trainers import TrainerSpec

Fraction = Annotated[float, Field(ge=0, le=1)]
Activation = Literal["elu", "relu", "tanh", "swish"]
"""Those that a saved policy can have too; swish is SiLU."""
Widths = Annotated[list[Count], Field(min_length=1)]
_WIDE = [256, 256, 256]
_AS_WIDE_AS_THE_INPUT = [-1]
_NO_GROUPS: dict[str, list[str]] = {}


class PolicyConfig(StrictModel):
    """Both networks, in the form of RSL-RL up to 4 and of Isaac Lab."""

    class_name: Literal["ActorCritic", "ActorCriticRecurrent"] = "ActorCritic"
    """ActorCriticRecurrent: with a memory before each network."""
    init_noise_std: Positive = 1.0
    """Deviation of the untrained policy."""
    noise_std_type: Literal["scalar", "log"] = "scalar"
    """Whether the deviation is learned or its logarithm."""
    state_dependent_std: Literal[False] = False
    """The deviation is the same in every state."""
    actor_obs_normalization: bool | None = None
    """Normalise what the actor sees by its running mean and deviation; null: as empirical_normalization says."""
    critic_obs_normalization: bool | None = None
    """The same of the critic."""
    actor_hidden_dims: Widths = _WIDE
    """Widths of the actor's hidden layers."""
    critic_hidden_dims: Widths = _WIDE
    """Widths of the critic's hidden layers."""
    activation: Activation = "elu"
    """Activation between layers."""
    rnn_type: Literal["lstm"] = "lstm"
    """Kind of the memory of an ActorCriticRecurrent."""
    rnn_hidden_dim: Count = 256
    """Cells of a layer of the memory."""
    rnn_num_layers: Count = 1
    """Layers of the memory."""


class DistributionConfig(StrictModel):
    """The distribution of actions, in the form of RSL-RL 5."""

    class_name: Literal["GaussianDistribution"] = "GaussianDistribution"
    """A mean from the network and a deviation that no state changes."""
    init_std: Positive = 1.0
    """Deviation of the untrained policy."""
    std_type: Literal["scalar", "log"] = "scalar"
    """Whether the deviation is learned or its logarithm."""
    std_range: tuple[NotNegative, Positive] = (1e-6, 1e6)
    """Where the deviation stays."""
    learn_std: bool = True
    """Whether the deviation is learned at all."""


class ModelConfig(StrictModel):
    """A network, in the form of RSL-RL 5."""

    class_name: Literal["MLPModel", "RNNModel"] = "MLPModel"
    """RNNModel: with a memory before the network."""
    hidden_dims: Widths = _WIDE
    """Widths of the hidden layers."""
    activation: Activation = "elu"
    """Activation between layers."""
    obs_normalization: bool = False
    """Normalise observations by their running mean and deviation."""
    distribution_cfg: DistributionConfig | None = None
    """Of the actor."""
    rnn_type: Literal["lstm"] = "lstm"
    """Kind of the memory of an RNNModel."""
    rnn_hidden_dim: Count = 256
    """Cells of a layer of the memory."""
    rnn_num_layers: Count = 1
    """Layers of the memory."""


class WeightScheduleConfig(StrictModel):
    """How the weight of the curiosity reward moves, by environment steps."""

    mode: Literal["constant", "step", "linear"]
    """constant, a step, or a straight line."""
    initial_step: NotNegative | None = None
    """Where a line begins."""
    final_step: NotNegative | None = None
    """Where a line ends, or the step is."""
    final_value: NotNegative | None = None
    """The weight from there on."""

    @model_validator(mode="after")
    def _needs(self) -> WeightScheduleConfig:
        needed = {"constant": (), "step": ("final_step", "final_value")}
        names = needed.get(self.mode, ("initial_step", "final_step", "final_value"))
        missing = [name for name in names if getattr(self, name) is None]
        if missing:
            raise ValueError(f"mode {self.mode} needs {' and '.join(missing)}")
        return self


class RndConfig(StrictModel):
    """Random network distillation (Burda et al. 2018): a reward for what is new."""

    weight: NotNegative = 0.0
    """Weight of that reward; RSL-RL multiplies it by the time of a step."""
    weight_schedule: WeightScheduleConfig | None = None
    """How the weight moves; null: it does not."""
    reward_normalization: bool = False
    """Divide that reward by the deviation of its discounted sum."""
    state_normalization: bool = False
    """Normalise what the networks see."""
    learning_rate: Positive = 1e-3
    """Step size of the predictor's optimiser."""
    num_outputs: Count = 1
    """Columns that the predictor predicts."""
    predictor_hidden_dims: Annotated[list[int], Field(min_length=1)] = _AS_WIDE_AS_THE_INPUT
    """Widths of the predictor; -1: as wide as what it sees."""
    target_hidden_dims: Annotated[list[int], Field(min_length=1)] = _AS_WIDE_AS_THE_INPUT
    """Widths of the target."""
    activation: Activation = "elu"
    """Activation between layers."""


class SymmetryConfig(StrictModel):
    """Symmetry of the task (Mittal et al. 2024)."""

    data_augmentation_func: str
    """`module:function` of the task's package or a plugin's, or `file.py:function` beside the task, called as
    `f(env=, obs=, actions=)`: the samples and, after them, their mirror images; `obs` or `actions` may be None.
    `env.unwrapped` is rlcli's."""
    use_data_augmentation: bool = False
    """Learn from the mirror images as well."""
    use_mirror_loss: bool = False
    """Punish what the policy does differently in the mirror."""
    mirror_loss_coeff: NotNegative = 0.0
    """Weight of that loss."""


class AlgorithmConfig(StrictModel):
    """The update."""

    class_name: Literal["PPO"] = "PPO"
    """Proximal policy optimisation."""
    num_learning_epochs: Count = 5
    """Passes over the rollout an iteration."""
    num_mini_batches: Count = 4
    """Parts of the rollout, an update each; what does not divide is left out."""
    learning_rate: Positive = 1e-3
    """Step size of the optimiser."""
    optimizer: Literal["adam", "adamw", "sgd", "rmsprop"] = "adam"
    """The optimiser."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """adaptive: the step size follows desired_kl, a minibatch at a time."""
    desired_kl: Positive | None = 0.01
    """Divergence between the policies before and after an update that an adaptive schedule aims at."""
    gamma: Fraction = 0.99
    """Discount."""
    lam: Fraction = 0.95
    """Lambda of generalised advantage estimation."""
    entropy_coef: NotNegative = 0.01
    """Weight of the entropy bonus."""
    value_loss_coef: NotNegative = 1.0
    """Weight of the value loss, a mean square."""
    use_clipped_value_loss: bool = True
    """Take the larger error of the value and of the value clipped about its old one."""
    clip_param: Positive = 0.2
    """Clipping of the probability ratio and of the value's change."""
    max_grad_norm: Positive = 1.0
    """Norm the gradients of actor and critic are clipped to, each its own."""
    normalize_advantage_per_mini_batch: bool = False
    """Normalise advantages in each minibatch, not over the rollout."""
    rnd_cfg: RndConfig | None = None
    """A reward for what is new; null: none."""
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
"""Key of a runner's configuration that is accepted and not read -> its default there, and what decides here."""


class RunnerConfig(AgentConfig):
    """A training run: the keys of `RslRlOnPolicyRunnerCfg`, and those that every agent of rlcli has."""

    algorithm: AlgorithmConfig = AlgorithmConfig()  # type: ignore[assignment]
    """The update; `ppo` alone: with RSL-RL's defaults."""
    bootstrap: Literal["final_obs", "pre_step"] = "final_obs"
    """What a step that ran out of time still earns: gamma times the value of its true last observation, or, as RSL-RL
    itself has it, of the observation before the step."""
    action_bound: Positive | None = None
    """Actions are clipped to +-this in training, play and export alike; null: unbounded. RSL-RL's name for it,
    `clip_actions`, is accepted."""
    class_name: Literal["OnPolicyRunner"] = "OnPolicyRunner"
    """OnPolicyRunner"""
    num_steps_per_env: Count = 24
    """Steps an environment and iteration."""
    obs_groups: dict[str, Annotated[list[str], Field(min_length=1)]] = _NO_GROUPS
    """Which observation groups the actor (`actor`, or `policy` as before RSL-RL 5), the `critic` and the curiosity
    (`rnd_state`) see. Not given: the critic sees the group critic if the task has one, else policy; the others see
    policy."""
    policy: PolicyConfig | None = None
    """Both networks, in the older form; null, with actor and critic null as well: RSL-RL's defaults."""
    actor: ModelConfig | None = None
    """The policy's network, in the form of RSL-RL 5."""
    critic: ModelConfig | None = None
    """The value's network, in the form of RSL-RL 5."""
    empirical_normalization: bool | None = None
    """Of the older form: normalise observations of both networks."""
    experiment_name: str = ""
    """Accepted and not read: a run is named by its task and --name."""
    run_name: str = ""
    """Accepted and not read: --name."""
    seed: int = 42
    """Accepted and not read: --seed."""
    device: str = "cuda:0"
    """Accepted and not read: --device."""
    logger: str = "tensorboard"
    """Accepted and not read: --logger."""
    neptune_project: str = "isaaclab"
    """Accepted and not read."""
    wandb_project: str = "isaaclab"
    """Accepted and not read."""
    resume: bool = False
    """Accepted and not read: --resume."""
    load_run: str = ".*"
    """Accepted and not read: --resume."""
    load_checkpoint: str = "model_.*.pt"
    """Accepted and not read: --resume."""
    check_for_nan: bool = True
    """Accepted and not read: what is not finite always ends a run."""

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
                raise ValueError(f"clip_actions ({clip}) and action_bound ({data['action_bound']}) are one thing")
            data["action_bound"] = clip
        return _tuples(data)

    @model_validator(mode="after")
    def _relations(self) -> RunnerConfig:
        if self.policy is not None and (self.actor is not None or self.critic is not None):
            raise ValueError("policy and actor, critic are two forms of the same: give one")
        if self.algorithm.symmetry_cfg is not None and self.memory is not None:
            raise ValueError("RSL-RL has no symmetry for networks with a memory")
        if self.algorithm.schedule == "adaptive" and self.algorithm.desired_kl is None:
            raise ValueError("algorithm.schedule adaptive needs algorithm.desired_kl")
        if self.critic is not None and self.critic.distribution_cfg is not None:
            raise ValueError("critic.distribution_cfg: only the actor has a distribution")
        return self

    @property
    def networks(self) -> tuple[ModelConfig, ModelConfig]:
        """Actor and critic in the form of RSL-RL 5."""
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
        """Cells of each layer of the actor's memory; None: it has none."""
        actor, critic = self.networks
        if "RNNModel" not in (actor.class_name, critic.class_name):
            return None
        return [actor.rnn_hidden_dim] * actor.rnn_num_layers if actor.class_name == "RNNModel" else []

    @property
    def not_read(self) -> list[str]:
        """What was set and decides nothing here, with what does."""
        said = [f"{key}: {flag} decides" for key, (usual, flag) in _ELSEWHERE.items() if getattr(self, key) != usual]
        return said


def _tuples(data: dict[str, Any]) -> dict[str, Any]:
    """What a validator returns counts as Python's, where a list is no tuple."""
    try:
        distribution = data["actor"]["distribution_cfg"]
        pair = tuple(distribution["std_range"])
    except (KeyError, TypeError):
        return data
    return {**data, "actor": {**data["actor"], "distribution_cfg": {**distribution, "std_range": pair}}}


SPEC = TrainerSpec(
    summary="RSL-RL's PPO, its settings as they stand",
    algorithms={"ppo": "rlcli_rsl_rl.config:RunnerConfig"},
    trainer="rlcli_rsl_rl.trainer:RslRlTrainer",
    refused={"distillation": "it needs a teacher's observations and policy"},
)
