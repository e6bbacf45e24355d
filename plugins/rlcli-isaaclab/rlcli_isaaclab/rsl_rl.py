"""Settings of RSL-RL, which the `ppo` trainer reads with `dialect: rsl_rl`.

A task of Isaac Lab that imports a name from `isaaclab_rl.rsl_rl` gets the object of this name from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlcli.formats import Note
from rlcli_isaaclab.config_class import MISSING, configclass, to_dict
from rlcli_isaaclab.observation_sets import fit_groups


@configclass
class RslRlPpoActorCriticCfg:
    """Settings of the actor and critic MLPs, as RSL-RL before version 5 has them."""

    class_name: str = "ActorCritic"
    init_noise_std: float = MISSING
    noise_std_type: str = "scalar"
    state_dependent_std: bool = False
    actor_obs_normalization: Any = MISSING
    critic_obs_normalization: Any = MISSING
    actor_hidden_dims: Any = MISSING
    critic_hidden_dims: Any = MISSING
    activation: str = MISSING


@configclass
class RslRlPpoActorCriticRecurrentCfg(RslRlPpoActorCriticCfg):
    """Settings of actor and critic networks with a recurrent layer (GRU or LSTM) in front of the MLP."""

    class_name: str = "ActorCriticRecurrent"
    rnn_type: str = MISSING
    rnn_hidden_dim: int = MISSING
    rnn_num_layers: int = MISSING


@configclass
class RslRlMLPModelCfg:
    """Settings of one network, the actor or the critic, as RSL-RL 5 has them."""

    @configclass
    class GaussianDistributionCfg:
        """Settings of the normal distribution from which the actor samples actions."""

        class_name: str = "GaussianDistribution"
        init_std: float = 1.0
        std_type: str = "scalar"

    class_name: str = "MLPModel"
    hidden_dims: Any = MISSING
    activation: str = MISSING
    obs_normalization: bool = False
    distribution_cfg: Any = None


@configclass
class RslRlRNNModelCfg(RslRlMLPModelCfg):
    """Settings of one network with a recurrent layer (GRU or LSTM) in front of the MLP, as RSL-RL 5 has them."""

    class_name: str = "RNNModel"
    rnn_type: str = MISSING
    rnn_hidden_dim: int = MISSING
    rnn_num_layers: int = MISSING


@configclass
class RslRlCNNModelCfg(RslRlMLPModelCfg):
    """Settings of one network for images, as RSL-RL 5 has them. rlcli refuses them: it builds its own networks."""

    class_name: str = "CNNModel"
    cnn_cfg: Any = MISSING


@configclass
class RslRlSymmetryCfg:
    """Settings of the robot's symmetry in the PPO update: mirrored samples, or a loss for unequal mirrored actions."""

    use_data_augmentation: bool = False
    use_mirror_loss: bool = False
    data_augmentation_func: Any = None
    mirror_loss_coeff: float = 0.0


@configclass
class RslRlPpoAlgorithmCfg:
    """Settings of the PPO update."""

    class_name: str = "PPO"
    num_learning_epochs: int = MISSING
    num_mini_batches: int = MISSING
    learning_rate: float = MISSING
    schedule: str = MISSING
    gamma: float = MISSING
    lam: float = MISSING
    entropy_coef: float = MISSING
    desired_kl: Any = MISSING
    max_grad_norm: float = MISSING
    value_loss_coef: float = MISSING
    use_clipped_value_loss: bool = MISSING
    clip_param: float = MISSING
    optimizer: str = "adam"
    normalize_advantage_per_mini_batch: bool = False
    rnd_cfg: Any = None
    symmetry_cfg: Any = None


@configclass
class RslRlBaseRunnerCfg:
    """Settings that every runner of RSL-RL has. A runner trains one policy."""

    seed: int = 42
    device: str = "cuda:0"
    num_steps_per_env: int = MISSING
    max_iterations: int = MISSING
    empirical_normalization: Any = None
    obs_groups: Any = MISSING
    clip_actions: Any = None
    save_interval: int = MISSING
    experiment_name: str = MISSING
    run_name: str = ""
    logger: str = "tensorboard"
    neptune_project: str = "isaaclab"
    wandb_project: str = "isaaclab"
    resume: bool = False
    load_run: str = ".*"
    load_checkpoint: str = "model_.*.pt"


@configclass
class RslRlOnPolicyRunnerCfg(RslRlBaseRunnerCfg):
    """Settings of a training with PPO: the networks, the algorithm, the length of rollouts."""

    __rlcli_library__ = "rsl-rl"

    class_name: str = "OnPolicyRunner"
    policy: Any = MISSING
    actor: Any = MISSING
    critic: Any = MISSING
    algorithm: Any = MISSING

    def __rlcli_agent__(self, notes: list[Note] | None = None) -> dict[str, Any]:
        """Return the keys of `agent:` for the trainer; append to `notes` how each setting was translated."""
        from rlcli_isaaclab.convert import agent
        from rlcli_isaaclab.settings import Report

        report = Report()
        data = agent(to_dict(self), report)
        if notes is not None:
            notes += report.user_notes("agent")
        return data

    def __rlcli_fit__(self, agent: dict[str, Any], observations: Mapping[str, Any], notes: list[Note]) -> None:
        """Assign the task's observation groups to actor and critic in `agent`, as `obs_groups` defines."""
        if isinstance(self.obs_groups, Mapping):
            fit_groups(self.obs_groups, agent, observations, notes)
