"""rl_games' settings as they stand in a train YAML, under `params`.

Light: a YAML is checked without importing torch or rl_games.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from rlcli.config.schema import AgentConfig, Count, NotNegative, Positive, StrictModel
from rlcli.trainers import TrainerSpec

Fraction = Annotated[float, Field(ge=0, le=1)]
Activation = Literal["elu", "relu", "tanh", "swish"]
"""Those that a saved policy can have too; swish is SiLU."""
Initializer = dict[str, str | int | float]
"""`{name: default}`, or another of rl_games' with its parameters."""
Nothing = Literal["None"] | None
_DEFAULT: Initializer = {"name": "default"}
_ZERO: Initializer = {"name": "const_initializer", "val": 0}

IGNORED: Mapping[str, str] = {
    "name": "a run is named by its task",
    "full_experiment_name": "--name",
    "env_name": "there is one environment loop",
    "device": "--device decides",
    "device_name": "--device decides",
    "multi_gpu": "one process trains",
    "ppo": "algorithm decides",
    "num_actors": "scene.num_envs decides",
    "score_to_win": "training runs to its budget",
    "save_best_after": "save_interval decides",
    "print_stats": "",
    "player": "rlcli play",
    "games_to_track": "",
    "max_frames": "--max-steps decides",
    "seq_length": "of networks with a memory",
    "num_seed_steps": "rl_games itself does not read it",
}
"""Key of `params.config` that is accepted and not read -> why."""


class _Settings(StrictModel):
    """Keys that are not read are dropped before anything is checked."""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        return {k: v for k, v in data.items() if k not in IGNORED} if isinstance(data, dict) else data


class Named(StrictModel):
    """What rl_games looks up by a name."""

    name: str
    """The name."""


class MlpConfig(StrictModel):
    """A multilayer perceptron."""

    units: Annotated[list[Count], Field(min_length=1)]
    """Widths of the hidden layers."""
    activation: Activation
    """Activation between layers."""
    initializer: Initializer = _DEFAULT
    """Initial weights."""
    regularizer: dict[str, Any] | None = None
    """Accepted and not read, as in rl_games."""
    d2rl: Literal[False] = False
    """The input goes to the first layer only."""


class ContinuousConfig(StrictModel):
    """The distribution of continuous actions."""

    mu_activation: Nothing = None
    """The mean is what the network gives."""
    sigma_activation: Nothing = None
    """So is the logarithm of the deviation."""
    mu_init: Initializer = _DEFAULT
    """Initial weights of the mean's layer."""
    sigma_init: Initializer = _ZERO
    """Initial logarithm of the deviation."""
    fixed_sigma: Literal[True] = True
    """The deviation is learned and the same in every state."""


class SpaceConfig(StrictModel):
    """The space of actions."""

    continuous: ContinuousConfig | None = ContinuousConfig()
    """Continuous."""


class NetworkConfig(StrictModel):
    """Actor and critic of PPO."""

    name: Literal["actor_critic"] = "actor_critic"
    """actor_critic"""
    separate: bool = False
    """Whether the critic has a network of its own, or one more output of the actor's."""
    space: SpaceConfig = SpaceConfig()
    """The space of actions."""
    mlp: MlpConfig
    """The network."""


class SacNetworkConfig(StrictModel):
    """Actor and critics of SAC."""

    name: Literal["soft_actor_critic"] = "soft_actor_critic"
    """soft_actor_critic"""
    separate: Literal[True] = True
    """Actor and critics share nothing."""
    space: dict[str, Any] | None = None
    """Accepted and not read, as in rl_games."""
    mlp: MlpConfig
    """The networks."""
    log_std_bounds: tuple[float, float] = (-5.0, 2.0)
    """Where the logarithm of the deviation lies."""


class RewardShaper(StrictModel):
    """What is learned of a reward: (reward + shift_value) x scale_value, clipped."""

    scale_value: float = 1.0
    """Factor."""
    shift_value: float = 0.0
    """Added before."""
    min_val: float | None = None
    """Lower limit; null: none."""
    max_val: float | None = None
    """Upper limit; null: none."""


class CentralValueConfig(_Settings):
    """A critic of its own, which sees the observation group `critic`."""

    network: CentralNetworkConfig
    """Its network."""
    learning_rate: Positive
    """Step size of its optimiser."""
    lr_schedule: Literal["linear", "constant", "None"] | None = None
    """How it moves."""
    mini_epochs: Count
    """Passes over the rollout an iteration."""
    minibatch_size: Count
    """Samples an update."""
    clip_value: bool
    """Clip the value's change."""
    normalize_input: bool
    """Normalise what it sees."""
    truncate_grads: bool = False
    """Clip the gradient's norm to grad_norm."""
    grad_norm: Positive = 1.0
    """That norm."""
    e_clip: Positive = 0.2
    """Clipping of the value's change."""
    kl_threshold: Positive | None = None
    """Accepted and not read, as in rl_games."""
    weight_decay: NotNegative = 0.0
    """Weight decay of its optimiser."""


class CentralNetworkConfig(StrictModel):
    """The network of a central value."""

    name: Literal["actor_critic"] = "actor_critic"
    """actor_critic"""
    central_value: Literal[True] = True
    """It has no actions."""
    mlp: MlpConfig
    """The network."""


class PpoSettings(_Settings):
    """`params.config` of PPO."""

    normalize_input: bool
    """Normalise observations by their running mean and deviation."""
    normalize_value: bool = False
    """The critic learns returns normalised by their running mean and deviation."""
    normalize_advantage: bool
    """Normalise advantages over the rollout."""
    value_bootstrap: bool = True
    """Whether a time-out earns what came after it; how, `bootstrap` says."""
    reward_shaper: RewardShaper = RewardShaper()
    """What is learned of a reward."""
    mixed_precision: Literal[False] = False
    """Updates are float32."""
    gamma: Fraction
    """Discount."""
    tau: Fraction
    """Lambda of generalised advantage estimation."""
    learning_rate: Positive
    """Step size of Adam."""
    lr_schedule: Literal["adaptive", "linear", "constant", "identity", "None"] | None = None
    """How it moves: adaptive follows kl_threshold; linear goes to 0 over the budget."""
    schedule_type: Literal["legacy", "standard"] = "legacy"
    """An adaptive rate moves after each minibatch, or after each pass."""
    kl_threshold: Positive = 0.008
    """Divergence that an adaptive rate aims at."""
    grad_norm: Positive = 1.0
    """Norm the gradient is clipped to, with truncate_grads."""
    truncate_grads: bool = False
    """Whether it is."""
    entropy_coef: NotNegative
    """Weight of the entropy bonus."""
    e_clip: Positive
    """Clipping of the probability ratio and of the value's change."""
    clip_value: bool
    """Take the larger error of the value and of the value clipped about its old one."""
    clip_actions: bool = True
    """Whether actions are clipped to +-1."""
    horizon_length: Count
    """Steps an environment and iteration."""
    minibatch_size: Count | None = None
    """Samples an update; it divides the rollout."""
    minibatch_size_per_env: Count | None = None
    """The same, for each environment."""
    mini_epochs: Count
    """Passes over the rollout an iteration."""
    critic_coef: NotNegative
    """Weight of the value loss, of which rl_games takes half."""
    bounds_loss_coef: NotNegative | None = None
    """Weight of the bounds loss; null: none."""
    bound_loss_type: Literal["bound", "regularisation"] = "bound"
    """The square of what the mean action exceeds 1.1 by, or of the mean action."""
    use_smooth_clamp: bool = False
    """A smooth clipping of the probability ratio."""
    weight_decay: NotNegative = 0.0
    """Weight decay of Adam."""
    central_value_config: CentralValueConfig | None = None
    """A critic of its own; null: none."""

    @model_validator(mode="after")
    def _minibatch(self) -> PpoSettings:
        if (self.minibatch_size is None) == (self.minibatch_size_per_env is None):
            raise ValueError("one of minibatch_size and minibatch_size_per_env is needed")
        return self


class SacSettings(_Settings):
    """`params.config` of SAC."""

    normalize_input: bool = False
    """Normalise observations by their running mean and deviation."""
    value_bootstrap: bool = True
    """Whether a time-out earns what came after it; how, `bootstrap` says."""
    reward_shaper: RewardShaper = RewardShaper()
    """What is learned of a reward."""
    mixed_precision: Literal[False] = False
    """Updates are float32."""
    gamma: Fraction = 0.99
    """Discount."""
    num_steps_per_episode: Count = 1
    """Steps an environment and iteration."""
    num_updates_per_step: Count = 1
    """Updates a step."""
    num_warmup_steps: Count = 1000
    """Iterations of random actions before the first update."""
    num_warmup_frames: Count | None = None
    """The same in environment steps."""
    batch_size: Count
    """Transitions an update."""
    replay_buffer_size: Count
    """Transitions kept, over all environments."""
    init_alpha: Positive
    """Entropy temperature at the beginning."""
    learnable_temperature: bool
    """Whether it is learned."""
    target_entropy_coef: Positive = 1.0
    """It aims at an entropy of minus this for each action."""
    alpha_lr: Positive
    """Step size of the temperature's optimiser."""
    actor_lr: Positive
    """Of the actor's."""
    critic_lr: Positive
    """Of the critics'."""
    critic_tau: Fraction = 0.005
    """Share of the new weights that a target network takes on at each update."""
    policy_frequency: Count = 2
    """Updates of the critics for one of the actor."""
    critic_grad_clip: NotNegative = 5.0
    """Norm the critics' gradient is clipped to; 0: none."""


class _Params(StrictModel):
    seed: int | None = None
    """Accepted and not read: --seed."""
    load_checkpoint: bool = False
    """Accepted and not read: --resume, --init-from."""
    load_path: str | None = None
    """Accepted and not read: --resume, --init-from."""


class PpoParams(_Params):
    """`params` of PPO."""

    algo: Named = Named(name="a2c_continuous")
    """a2c_continuous"""
    model: Named = Named(name="continuous_a2c_logstd")
    """continuous_a2c_logstd"""
    network: NetworkConfig
    """Networks."""
    config: PpoSettings
    """Everything else."""

    @model_validator(mode="after")
    def _names(self) -> PpoParams:
        _require(self.algo, "algo", "a2c_continuous", "ppo")
        _require(self.model, "model", "continuous_a2c_logstd", "ppo")
        return self


class SacParams(_Params):
    """`params` of SAC."""

    algo: Named = Named(name="sac")
    """sac"""
    model: Named = Named(name="soft_actor_critic")
    """soft_actor_critic"""
    network: SacNetworkConfig
    """Networks."""
    config: SacSettings
    """Everything else."""

    @model_validator(mode="after")
    def _names(self) -> SacParams:
        _require(self.algo, "algo", "sac", "sac")
        _require(self.model, "model", "soft_actor_critic", "sac")
        return self


def _require(given: Named, key: str, name: str, algorithm: str) -> None:
    if given.name != name:
        raise ValueError(f"{key}.name '{given.name}' does not go with algorithm {algorithm}, whose {key} is '{name}'")


class RlGamesConfig(AgentConfig):
    """What both algorithms have. `max_epochs` and `save_frequency` of `params.config` are rlcli's budget."""

    budget: ClassVar[Mapping[str, str]] = {"max_epochs": "max_iterations", "save_frequency": "save_interval"}

    bootstrap: Literal["final_obs", "pre_step", "none"] = "final_obs"
    """What a step that ran out of time still earns: gamma times the value of its true last observation; or, as rl_games
    itself has it, of the observation before the step; or nothing, as if it were a failure, which is what
    OmniIsaacGymEnvs' tasks make of it. `params.config.value_bootstrap: false` is none as well."""

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
            # what a validator returns counts as Python's, where a list is no tuple
            network = {**network, "log_std_bounds": tuple(network["log_std_bounds"])}
            data["params"]["network"] = network
        return data


class PpoConfig(RlGamesConfig):
    """Proximal policy optimisation (rl_games' `a2c_continuous`)."""

    algorithm: Literal["ppo"] = "ppo"
    """ppo"""
    params: PpoParams
    """A train YAML's `params`, as they stand."""

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
    """sac"""
    action_bound: Positive = 1.0
    """Actions are tanh times this."""
    params: SacParams
    """A train YAML's `params`, as they stand."""


CentralValueConfig.model_rebuild()
PpoConfig.model_rebuild()

SPEC = TrainerSpec(
    summary="rl_games, its settings as they stand",
    algorithms={"ppo": "rlcli_rl_games.config:PpoConfig", "sac": "rlcli_rl_games.config:SacConfig"},
    trainer="rlcli_rl_games.trainer:make_trainer",
    refused={
        "a2c_continuous": "here it is called ppo",
        "a2c_discrete": "it needs discrete actions, and tasks have continuous ones",
    },
)
