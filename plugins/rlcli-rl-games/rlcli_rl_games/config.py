"""Settings of the rl_games trainer: the mapping `params` of rl_games' own YAML files.

The module imports neither torch nor rl_games, so that a YAML is checked fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel
from rlcli.trainers import TrainerSpec

Fraction = Annotated[float, Field(ge=0, le=1)]
Activation = Literal["elu", "relu", "tanh", "swish"]
"""Activations of rl_games that a saved policy supports as well; swish is SiLU."""
Initializer = dict[str, str | int | float]
"""`{name: default}`, or another initialiser of rl_games with its parameters."""
Nothing = Literal["None"] | None
_DEFAULT: Initializer = {"name": "default"}
_ZERO: Initializer = {"name": "const_initializer", "val": 0}

IGNORED: Mapping[str, str] = {
    "name": "the task is named on the command line",
    "full_experiment_name": "use --name",
    "env_name": "rlcli has only one environment loop",
    "device": "use --device",
    "device_name": "use --device",
    "multi_gpu": "one process trains",
    "ppo": "use algorithm",
    "num_actors": "use scene.num_envs",
    "score_to_win": "training runs until its limit of iterations or steps",
    "save_best_after": "use save_interval",
    "print_stats": "rlcli prints its own statistics",
    "player": "use rlcli play",
    "games_to_track": "rlcli averages over at least 100 episodes",
    "max_frames": "use --max-steps",
    "seq_length": "this trainer has no recurrent networks",
    "num_seed_steps": "rl_games itself does not read it",
}
"""Key of `params.config` that has no effect -> reason."""


class _Settings(StrictModel):
    """Base class of the settings; before validation it drops keys of rl_games that have no effect here (`IGNORED`)."""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        return {k: v for k, v in data.items() if k not in IGNORED} if isinstance(data, dict) else data


class Named(StrictModel):
    """Reference to an algorithm or a model of rl_games by its name."""

    name: str
    """Name of the algorithm or model in rl_games."""


class MlpConfig(StrictModel):
    """Settings of a multilayer perceptron."""

    units: Annotated[list[Count], Field(min_length=1)]
    """Widths of the hidden layers."""
    activation: Activation
    """Activation after each hidden layer."""
    initializer: Initializer = _DEFAULT
    """How the weights are initialised: `{name: default}`, or another initialiser of rl_games with its parameters."""
    regularizer: dict[str, Any] | None = None
    """Ignored, as in rl_games."""
    d2rl: Literal[False] = False
    """Whether every hidden layer also receives the input (a D2RL network); must be false."""


class ContinuousConfig(StrictModel):
    """Settings of the normal distribution from which actions are sampled."""

    mu_activation: Nothing = None
    """Activation on the mean; must be null."""
    sigma_activation: Nothing = None
    """Activation on the logarithm of the standard deviation; must be null."""
    mu_init: Initializer = _DEFAULT
    """Initialiser of the layer that computes the mean."""
    sigma_init: Initializer = _ZERO
    """Initialiser of the logarithm of the standard deviation, such as `{name: const_initializer, val: 0}`."""
    fixed_sigma: Literal[True] = True
    """Whether the standard deviation is trained but does not depend on the observation; must be true."""


class SpaceConfig(StrictModel):
    """Settings of the action space."""

    continuous: ContinuousConfig | None = ContinuousConfig()
    """Settings of continuous actions, the only kind that rlcli has."""


class NetworkConfig(StrictModel):
    """Settings of the networks of PPO's actor and critic."""

    name: Literal["actor_critic"] = "actor_critic"
    """Name of the network in rl_games."""
    separate: bool = False
    """Whether the critic has a separate network; otherwise it is one more output of the actor's."""
    space: SpaceConfig = SpaceConfig()
    """The action space."""
    mlp: MlpConfig
    """The hidden layers of actor and critic."""


class SacNetworkConfig(StrictModel):
    """Settings of the networks of SAC's actor and its two critics."""

    name: Literal["soft_actor_critic"] = "soft_actor_critic"
    """Name of the network in rl_games."""
    separate: Literal[True] = True
    """Whether actor and critics have separate networks; must be true."""
    space: dict[str, Any] | None = None
    """Ignored, as in rl_games."""
    mlp: MlpConfig
    """The hidden layers of each network."""
    log_std_bounds: tuple[float, float] = (-5.0, 2.0)
    """[low, high]: bounds of the logarithm of the actions' standard deviation."""


class RewardShaper(StrictModel):
    """Reward used in training: (reward + shift_value) * scale_value, clipped."""

    scale_value: float = 1.0
    """Factor on the reward."""
    shift_value: float = 0.0
    """Number that is added to the reward before scaling."""
    min_val: float | None = None
    """Lower limit of the scaled reward; null: none."""
    max_val: float | None = None
    """Upper limit of the scaled reward; null: none."""


class CentralValueConfig(_Settings):
    """Settings of a critic with its own network and optimiser, which observes the group `critic`."""

    network: CentralNetworkConfig
    """Network of the critic."""
    learning_rate: Positive
    """Learning rate of Adam for this critic."""
    lr_schedule: Literal["linear", "constant", "None"] | None = None
    """Schedule of the learning rate: linear falls to 0 over the training."""
    mini_epochs: Count
    """Epochs per iteration."""
    minibatch_size: Count
    """Samples per minibatch."""
    clip_value: bool
    """Whether the loss is the larger of two errors: of the value, and of the value clipped to the old one +- e_clip."""
    normalize_input: bool
    """Whether this critic's observations are normalised by running mean and standard deviation."""
    truncate_grads: bool = False
    """Whether the norm of the gradient is clipped to grad_norm."""
    grad_norm: Positive = 1.0
    """Maximum norm of the gradient, with truncate_grads."""
    e_clip: Positive = 0.2
    """Largest change of the value from the old value, with clip_value."""
    kl_threshold: Positive | None = None
    """Ignored, as in rl_games."""
    weight_decay: NotNegative = 0.0
    """Weight decay of Adam for this critic."""


class CentralNetworkConfig(StrictModel):
    """Settings of the network of a separate critic (`central_value_config`)."""

    name: Literal["actor_critic"] = "actor_critic"
    """Name of the network in rl_games."""
    central_value: Literal[True] = True
    """Whether the network has a value output and no actions; must be true."""
    mlp: MlpConfig
    """The hidden layers of the critic."""


class PpoSettings(_Settings):
    """Settings of PPO: the mapping `params.config`."""

    normalize_input: bool
    """Whether observations are normalised by running mean and standard deviation."""
    normalize_value: bool = False
    """Whether the critic is trained on returns that are normalised by running mean and standard deviation."""
    normalize_advantage: bool
    """Whether advantages are normalised over the rollout."""
    value_bootstrap: bool = True
    """Whether a time-out is bootstrapped; `bootstrap` sets how."""
    reward_shaper: RewardShaper = RewardShaper()
    """Scale, shift and limits of the reward."""
    mixed_precision: Literal[False] = False
    """Whether updates use mixed precision; must be false."""
    gamma: Fraction
    """Discount factor."""
    tau: Fraction
    """Lambda of generalised advantage estimation."""
    learning_rate: Positive
    """Learning rate of Adam."""
    lr_schedule: Literal["adaptive", "linear", "constant", "identity", "None"] | None = None
    """Schedule of the learning rate: adaptive follows kl_threshold; linear falls to 0 over the budget."""
    schedule_type: Literal["legacy", "standard"] = "legacy"
    """When an adaptive rate changes: after each minibatch, or after each epoch."""
    kl_threshold: Positive = 0.008
    """Target KL divergence of an adaptive rate."""
    grad_norm: Positive = 1.0
    """Maximum norm of the gradient, with truncate_grads."""
    truncate_grads: bool = False
    """Whether the gradient is clipped to grad_norm."""
    entropy_coef: NotNegative
    """Weight of the entropy bonus."""
    e_clip: Positive
    """Largest deviation of the probability ratio from 1; with clip_value, also of the value from the old value."""
    clip_value: bool
    """Whether the loss is the larger of two errors: of the value, and of the value clipped to the old one +- e_clip."""
    clip_actions: bool = True
    """Whether actions are clipped to +-1."""
    horizon_length: Count
    """Steps per environment and iteration."""
    minibatch_size: Count | None = None
    """Samples per minibatch; the rollout must be divisible by it."""
    minibatch_size_per_env: Count | None = None
    """Samples of each environment in a minibatch; an alternative to minibatch_size."""
    mini_epochs: Count
    """Epochs per iteration."""
    critic_coef: NotNegative
    """Weight of the value loss; rl_games multiplies it by 0.5."""
    bounds_loss_coef: NotNegative | None = None
    """Weight of the bounds loss; null: none."""
    bound_loss_type: Literal["bound", "regularisation"] = "bound"
    """bound: square of the amount by which the mean action exceeds +-1.1. regularisation: square of the mean action."""
    use_smooth_clamp: bool = False
    """Whether the probability ratio is clipped by a smooth function."""
    weight_decay: NotNegative = 0.0
    """Weight decay of Adam."""
    central_value_config: CentralValueConfig | None = None
    """Settings of a separate critic; null: the critic is part of `network`."""

    @model_validator(mode="after")
    def _minibatch(self) -> PpoSettings:
        if (self.minibatch_size is None) == (self.minibatch_size_per_env is None):
            found = "neither" if self.minibatch_size is None else "both"
            raise ValueError(f"give one of minibatch_size and minibatch_size_per_env; found {found}")
        return self


class SacSettings(_Settings):
    """Settings of SAC: the mapping `params.config`."""

    normalize_input: bool = False
    """Whether observations are normalised by running mean and standard deviation."""
    value_bootstrap: bool = True
    """Whether a time-out is bootstrapped; `bootstrap` sets how."""
    reward_shaper: RewardShaper = RewardShaper()
    """Scale, shift and limits of the reward."""
    mixed_precision: Literal[False] = False
    """Whether updates use mixed precision; must be false."""
    gamma: Fraction = 0.99
    """Discount factor."""
    num_steps_per_episode: Count = 1
    """Steps per environment and iteration."""
    num_updates_per_step: Count = 1
    """Gradient updates per step."""
    num_warmup_steps: Count = 1000
    """Iterations of random actions before the first update."""
    num_warmup_frames: Count | None = None
    """Random actions before the first update, in environment steps."""
    batch_size: Count
    """Transitions per update."""
    replay_buffer_size: Count
    """Transitions in the replay buffer, over all environments."""
    init_alpha: Positive
    """Initial entropy temperature."""
    learnable_temperature: bool
    """Whether the temperature is trained."""
    target_entropy_coef: Positive = 1.0
    """Factor of the target entropy, which is minus this factor times the number of action dimensions."""
    alpha_lr: Positive
    """Learning rate of the temperature."""
    actor_lr: Positive
    """Learning rate of the actor."""
    critic_lr: Positive
    """Learning rate of the critics."""
    critic_tau: Fraction = 0.005
    """Fraction of the new weights in each update of the target networks."""
    policy_frequency: Count = 2
    """Updates of the critics per update of the actor."""
    critic_grad_clip: NotNegative = 5.0
    """Maximum norm of the critics' gradient; 0: no clipping."""


class _Params(StrictModel):
    seed: int | None = None
    """Ignored: use --seed."""
    load_checkpoint: bool = False
    """Ignored: use --resume, --init-from."""
    load_path: str | None = None
    """Ignored: use --resume, --init-from."""


class PpoParams(_Params):
    """The mapping `params` of a configuration with PPO."""

    algo: Named = Named(name="a2c_continuous")
    """Algorithm of rl_games; its name must be a2c_continuous."""
    model: Named = Named(name="continuous_a2c_logstd")
    """Model of rl_games; its name must be continuous_a2c_logstd."""
    network: NetworkConfig
    """Settings of the networks."""
    config: PpoSettings
    """All other settings."""

    @model_validator(mode="after")
    def _names(self) -> PpoParams:
        _require(self.algo, "algo", "a2c_continuous", "ppo")
        _require(self.model, "model", "continuous_a2c_logstd", "ppo")
        return self


class SacParams(_Params):
    """The mapping `params` of a configuration with SAC."""

    algo: Named = Named(name="sac")
    """Algorithm of rl_games; its name must be sac."""
    model: Named = Named(name="soft_actor_critic")
    """Model of rl_games; its name must be soft_actor_critic."""
    network: SacNetworkConfig
    """Settings of the networks."""
    config: SacSettings
    """All other settings."""

    @model_validator(mode="after")
    def _names(self) -> SacParams:
        _require(self.algo, "algo", "sac", "sac")
        _require(self.model, "model", "soft_actor_critic", "sac")
        return self


def _require(named: Named, key: str, name: str, algorithm: str) -> None:
    if named.name != name:
        raise ValueError(f"{key}.name '{named.name}' does not fit algorithm {algorithm}; write '{name}'")


class RlGamesConfig(AgentConfig):
    """Settings of an agent of rl_games, PPO or SAC.

    `max_epochs` and `save_frequency` of `params.config` set rlcli's `max_iterations` and `save_interval`.
    """

    budget: ClassVar[Mapping[str, str]] = {"max_epochs": "max_iterations", "save_frequency": "save_interval"}

    bootstrap: Literal["final_obs", "pre_step", "none"] = "final_obs"
    """Return after a time-out. final_obs: gamma times the value of the episode's last observation. pre_step: gamma
    times the value of the observation before the step, as in rl_games itself. none: 0, as after a failure; the tasks of
    OmniIsaacGymEnvs use this. `params.config.value_bootstrap: false` is the same as none."""

    @model_validator(mode="before")
    @classmethod
    def _budgets(cls, data: Any) -> Any:
        params = data.get("params") if isinstance(data, dict) else None
        config = params.get("config") if isinstance(params, dict) else None
        if not isinstance(config, dict):
            return data
        given = {ours: config[theirs] for theirs, ours in cls.budget.items() if theirs in config}
        rest = {key: value for key, value in config.items() if key not in cls.budget}
        data = {**given, **data, "params": {**params, "config": rest}}
        network = params.get("network")
        if isinstance(network, dict) and isinstance(network.get("log_std_bounds"), list):
            # pydantic's strict mode accepts only tuples from a validator
            network = {**network, "log_std_bounds": tuple(network["log_std_bounds"])}
            data["params"]["network"] = network
        return data


class PpoConfig(RlGamesConfig):
    """Proximal policy optimisation (rl_games' `a2c_continuous`)."""

    algorithm: Literal["ppo"] = "ppo"
    """Algorithm: ppo."""
    params: PpoParams
    """`params` of a train YAML, unchanged."""

    @model_validator(mode="before")
    @classmethod
    def _bound(cls, data: Any) -> Any:
        try:
            clipped = data["params"]["config"].get("clip_actions", True)
        except (KeyError, TypeError, AttributeError):
            return data
        bound = 1.0 if clipped is True else None
        if data.get("action_bound", bound) != bound:
            raise ValueError("action_bound: rl_games clips actions to +-1 (params.config.clip_actions), or not at all")
        return {**data, "action_bound": bound}


class SacConfig(RlGamesConfig):
    """Soft actor-critic (rl_games' `sac`). An iteration is `num_steps_per_episode` steps of every environment."""

    algorithm: Literal["sac"] = "sac"
    """Algorithm: sac."""
    action_bound: Positive = 1.0
    """Actions are tanh times this bound."""
    params: SacParams
    """`params` of a train YAML, unchanged."""


CentralValueConfig.model_rebuild()
PpoConfig.model_rebuild()

SPEC = TrainerSpec(
    summary="rl_games, with its own settings",
    algorithms={"ppo": "rlcli_rl_games.config:PpoConfig", "sac": "rlcli_rl_games.config:SacConfig"},
    trainer="rlcli_rl_games.trainer:make_trainer",
    refused={
        "a2c_continuous": "rlcli names this algorithm ppo",
        "a2c_discrete": "the algorithm needs discrete actions, and tasks have continuous ones",
    },
)
