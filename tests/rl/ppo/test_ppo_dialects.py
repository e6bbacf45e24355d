"""Tests of each dialect against its library.

For the same rollout and the same order of samples, one update of the library gives the same losses, learning rate and
parameters.
"""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO as Sb3Ppo  # noqa: N811
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv as Sb3VecEnv
from support import worlds
from torch import nn

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.rl.ppo.trainer import PpoTrainer

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from rl_games.algos_torch.a2c_continuous import A2CAgent
    from rl_games.common.algo_observer import DefaultAlgoObserver
    from rsl_rl.algorithms import PPO as RslRlPpo  # noqa: N811
    from rsl_rl.models import MLPModel
    from rsl_rl.storage import RolloutStorage
    from tensordict import TensorDict

AGENT = """
agents:
  ppo:
    trainer: ppo
    algorithm: ppo
    max_iterations: 9
    action_bound: null
    reward_scale: 20.0
    actor: {hidden: [16, 12], activation: elu}
    critic: {hidden: [12, 16], activation: elu}
"""
SIZES = [(8, 4, 2, 3), (16, 12, 4, 5), (30, 40, 3, 4)]
"""Steps, environments, minibatches, epochs."""


@pytest.fixture
def make_trainer(tmp_path):
    """Function that makes a trainer with a rollout; its policy and value are far from their initial zeros."""

    def build(dialect, size, *overrides, seed=0):
        steps, envs, minibatches, epochs = size
        task = str(worlds.critter(tmp_path, worlds.CRITTER_TASK + AGENT))
        resolved = resolve(
            find_task(task),
            agent="ppo",
            overrides=[
                f"scene.num_envs={envs}", f"agent.dialect={dialect}", f"agent.num_steps={steps}",
                f"agent.num_minibatches={minibatches}", f"agent.num_epochs={epochs}", *overrides,
            ],
        )  # fmt: skip
        trainer = PpoTrainer(make_env(resolved, seed=3), resolved.agent, seed=seed, device="cpu", torch_threads=1)
        with torch.no_grad():
            trainer.networks.actor[-1].weight.mul_(30.0 if dialect == "sb3" else 3.0)
            trainer.networks.actor[-1].bias.add_(1.0)
            trainer.networks.critic[-1].weight.mul_(3.0)
        trainer.start()
        trainer.collector.collect()
        assert trainer.collector.rollout.time_out.any() or steps < 30
        return trainer

    return build


def permutation(count, seed=7):
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))


def update_ours(trainer, monkeypatch, orders=None):
    """Do one update with these orders of samples; return the metrics."""
    if orders is not None:
        remaining = iter(orders)
        monkeypatch.setattr(trainer.learner, "sample_order", lambda: next(remaining))
    rates, learner, step = [], trainer.learner, trainer.learner.optimizer.step
    monkeypatch.setattr(learner.optimizer, "step", lambda: (rates.append(learner.learning_rate.item()), step()))
    learner.update()
    if trainer.config.schedule == "adaptive":
        assert len({*rates, trainer.learner.learning_rate.item()}) > 1  # the KL divergence has changed it
    return trainer.learner.metrics()


def paired_parameters(ours, theirs):
    """Return pairs of corresponding parameters of two sequences of layers."""
    mine = [layer for layer in ours if isinstance(layer, nn.Linear)]
    yours = [layer for layer in theirs if isinstance(layer, nn.Linear)]
    assert len(mine) == len(yours)
    return [
        (a, b)
        for left, right in zip(mine, yours, strict=True)
        for a, b in zip(left.parameters(), right.parameters(), strict=True)
    ]


def copy_weights(theirs):
    with torch.no_grad():
        for mine, yours in theirs:
            yours.copy_(mine)


def require_equal_update(parameters, before, ours, theirs):
    for (mine, yours), old in zip(parameters, before, strict=True):
        assert (mine - old).abs().max().item() > 1e-4  # the update has changed them
        torch.testing.assert_close(mine.detach(), yours.detach(), rtol=1e-5, atol=1e-5)
    for name, value in theirs.items():
        assert ours[name] == pytest.approx(value, rel=1e-5, abs=1e-5), name


def copy_parameters(parameters):
    return [mine.detach().clone() for mine, _ in parameters]


# --- RSL-RL ---


def make_rsl_rl(trainer):
    """Return RSL-RL's PPO with the trainer's weights, settings and rollout."""
    config, samples, rollout = trainer.config, trainer.collector.rollout.samples, trainer.collector.rollout
    steps, envs = rollout.reward.shape
    groups = {"actor": ["policy"], "critic": ["critic"]}

    def observed(t):
        return TensorDict({"policy": samples.obs[t].clone(), "critic": samples.critic_obs[t].clone()}, [envs])

    actor = MLPModel(
        observed(0), groups, "actor", samples.action.shape[2], list(config.actor.hidden), "elu",
        distribution_cfg={"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": config.std},
    )  # fmt: skip
    critic = MLPModel(observed(0), groups, "critic", 1, list(config.critic.hidden), "elu")
    storage = RolloutStorage("rl", envs, steps, observed(0), [samples.action.shape[2]])
    theirs = RslRlPpo(
        actor, critic, storage, num_learning_epochs=config.num_epochs, num_mini_batches=config.num_minibatches,
        clip_param=config.clip_range, gamma=config.gamma, lam=config.lam, value_loss_coef=config.value_coef,
        entropy_coef=config.entropy_coef, learning_rate=config.learning_rate, max_grad_norm=config.max_grad_norm,
        use_clipped_value_loss=config.clip_value is not None, schedule=config.schedule, desired_kl=config.desired_kl,
        normalize_advantage_per_mini_batch=config.normalize_advantage == "minibatch",
    )  # fmt: skip
    std = trainer.networks.raw_std if config.std == "scalar" else trainer.networks.log_std
    their_std = actor.distribution.std_param if config.std == "scalar" else actor.distribution.log_std_param
    parameters = [
        *paired_parameters(trainer.networks.actor, actor.mlp),
        (std, their_std),
        *paired_parameters(trainer.networks.critic, critic.mlp),
    ]
    copy_weights(parameters)
    with torch.no_grad():
        for t in range(steps):
            theirs.act(observed(t))
            theirs.transition.actions = samples.action[t].clone()
            theirs.transition.actions_log_prob = samples.log_prob[t].clone()
            theirs.process_env_step(
                observed(t), rollout.reward[t], rollout.done[t], {"time_outs": rollout.time_out[t].float()}
            )
        theirs.compute_returns(TensorDict({k: value.clone() for k, value in trainer.collector.obs.items()}, [envs]))
    return theirs, parameters


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("agent.std=log", "agent.clip_value=null"),
        ("agent.normalize_advantage=minibatch",),
        ("agent.schedule=constant", "agent.desired_kl=null"),
        ("agent.learning_rate=5e-3", "agent.desired_kl=0.002"),
    ],
)
def test_rsl_rl_dialect_matches_rsl_rl(make_trainer, monkeypatch, size, overrides):
    trainer = make_trainer("rsl_rl", size, *overrides)
    theirs, parameters = make_rsl_rl(trainer)
    before, order = copy_parameters(parameters), permutation(trainer.steps_per_iteration)
    ours = update_ours(trainer, monkeypatch, [order])
    samples = trainer.collector.rollout.samples
    torch.testing.assert_close(samples.target, theirs.storage.returns.squeeze(-1), rtol=1e-5, atol=1e-5)
    if trainer.config.normalize_advantage == "batch":
        torch.testing.assert_close(samples.advantage, theirs.storage.advantages.squeeze(-1), rtol=1e-5, atol=1e-5)
    monkeypatch.setattr(torch, "randperm", lambda count, **_: order[:count])
    losses = theirs.update()
    expected = {f"Loss/{name}": losses[name] for name in ("value", "surrogate", "entropy")}
    require_equal_update(parameters, before, ours, {**expected, "Loss/learning_rate": theirs.learning_rate})


# --- Stable-Baselines3 ---


class SpacesOnlyVecEnv(Sb3VecEnv):
    """Environment with only the parts that SB3 needs to build its networks."""

    def __init__(self, envs, obs, actions):
        super().__init__(envs, spaces.Box(-np.inf, np.inf, (obs,)), spaces.Box(-1, 1, (actions,)))

    def unused(self, *_, **__):
        raise NotImplementedError

    reset = step_async = step_wait = close = set_attr = env_method = get_images = unused

    def get_attr(self, attr_name, indices=None):
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def make_sb3(trainer):
    """Return SB3's PPO with the trainer's weights, settings and rollout."""
    config, rollout, samples = trainer.config, trainer.collector.rollout, trainer.collector.rollout.samples
    steps, envs, obs = samples.obs.shape
    theirs = Sb3Ppo(
        "MlpPolicy", SpacesOnlyVecEnv(envs, obs, samples.action.shape[2]), config.learning_rate, steps,
        steps * envs // config.num_minibatches, config.num_epochs, config.gamma, config.lam, config.clip_range,
        config.clip_value_range, ent_coef=config.entropy_coef, vf_coef=config.value_coef,
        max_grad_norm=config.max_grad_norm, device="cpu",
        policy_kwargs={
            "net_arch": {"pi": list(config.actor.hidden), "vf": list(config.critic.hidden)}, "activation_fn": nn.ELU
        },
    )  # fmt: skip
    theirs.set_logger(Logger(folder=None, output_formats=[]))
    policy = theirs.policy
    parameters = [
        *paired_parameters(trainer.networks.actor, [*policy.mlp_extractor.policy_net, policy.action_net]),
        (trainer.networks.log_std, policy.log_std),
        *paired_parameters(trainer.networks.critic, [*policy.mlp_extractor.value_net, policy.value_net]),
    ]
    copy_weights(parameters)
    with torch.no_grad():
        value = trainer.networks.value(samples.critic_obs)
        last = trainer.networks.value(trainer.collector.obs["policy"])
        beyond = torch.where(rollout.time_out, trainer.networks.value(rollout.final_obs), 0.0)
    reward, buffer, start = rollout.reward + config.gamma * beyond, theirs.rollout_buffer, np.ones(envs)
    for t in range(steps):
        buffer.add(
            samples.obs[t].numpy(), samples.action[t].numpy(), reward[t].numpy(), start, value[t], samples.log_prob[t]
        )
        start = rollout.done[t].numpy()
    buffer.compute_returns_and_advantage(last, start)
    return theirs, parameters


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("agent.clip_value=clipped", "agent.clip_value_range=0.1"),
        ("agent.entropy_coef=0.01", "agent.learning_rate=2e-3", "agent.max_grad_norm=1.0"),
    ],
)
def test_sb3_dialect_matches_sb3(make_trainer, monkeypatch, size, overrides):
    steps, envs, _, epochs = size
    trainer = make_trainer("sb3", size, "agent.critic_obs=[policy]", "agent.actor={activation: elu}", *overrides)
    theirs, parameters = make_sb3(trainer)
    before = copy_parameters(parameters)
    orders = [permutation(steps * envs, seed) for seed in range(epochs)]
    ours = update_ours(trainer, monkeypatch, orders)
    # SB3 numbers the samples of one environment after the other
    numbers = iter([((order % envs) * steps + order // envs).numpy() for order in orders])
    monkeypatch.setattr(np.random, "permutation", lambda count: next(numbers))
    theirs.train()
    logged = theirs.logger.name_to_value
    expected = {
        "Loss/surrogate": logged["train/policy_gradient_loss"],
        "Loss/value": logged["train/value_loss"],
        "Loss/entropy": -logged["train/entropy_loss"],
        "Loss/clip_fraction": logged["train/clip_fraction"],
        "Loss/explained_variance": logged["train/explained_variance"],
        "Policy/mean_std": logged["train/std"],
    }
    require_equal_update(parameters, before, ours, expected)


# --- rl_games ---


def make_rl_games(trainer, folder, schedule_type):
    """Return rl_games' continuous agent with the trainer's weights, settings and rollout."""
    config, rollout, samples = trainer.config, trainer.collector.rollout, trainer.collector.rollout.samples
    steps, envs, obs = samples.obs.shape
    initial = {"name": "default"}
    network = {
        "name": "actor_critic", "separate": True,
        "space": {"continuous": {
            "mu_activation": "None", "sigma_activation": "None", "mu_init": initial,
            "sigma_init": {"name": "const_initializer", "val": 0}, "fixed_sigma": True,
        }},
        "mlp": {"units": list(config.actor.hidden), "activation": "elu", "initializer": initial},
    }  # fmt: skip
    settings = {
        "name": "run", "env_name": "none", "train_dir": str(folder), "device": "cpu", "num_actors": envs,
        "env_info": {
            "observation_space": spaces.Box(-np.inf, np.inf, (obs,)),
            "action_space": spaces.Box(-1, 1, (samples.action.shape[2],)),
        },
        "vec_env": SimpleNamespace(set_train_info=lambda *_: None),
        "features": {"observer": DefaultAlgoObserver()}, "reward_shaper": None, "print_stats": False, "ppo": True,
        "horizon_length": steps, "minibatch_size": steps * envs // config.num_minibatches,
        "mini_epochs": config.num_epochs, "gamma": config.gamma, "tau": config.lam, "e_clip": config.clip_range,
        "clip_value": config.clip_value is not None, "critic_coef": 2.0 * config.value_coef,
        "entropy_coef": config.entropy_coef, "bounds_loss_coef": config.bounds_coef, "truncate_grads": True,
        "grad_norm": config.max_grad_norm, "learning_rate": config.learning_rate, "lr_schedule": "adaptive",
        "kl_threshold": config.desired_kl, "schedule_type": schedule_type, "normalize_advantage": True,
        "normalize_input": False, "normalize_value": config.normalize_value, "max_epochs": 10,
    }  # fmt: skip
    theirs = A2CAgent("run", {"model": {"name": "continuous_a2c_logstd"}, "network": network, "config": settings})
    theirs.init_tensors()
    model = theirs.model.a2c_network
    parameters = [
        *paired_parameters(trainer.networks.actor, [*model.actor_mlp, model.mu]),
        (trainer.networks.log_std, model.sigma),
        *paired_parameters(trainer.networks.critic, [*model.critic_mlp, model.value]),
    ]
    copy_weights(parameters)

    sigma = (
        trainer.collector.rollout.old_std[:1, None].clone().expand(samples.mean.shape)
    )  # a copy: an update changes it

    def by_environment(values):
        return values.transpose(0, 1).reshape(steps * envs, *values.shape[2:]).clone()

    def play_steps():
        """Return the rollout in the form of rl_games' `play_steps`; its own recursion computes the returns."""
        with torch.no_grad():
            theirs.model.eval()
            value = theirs.model.denorm_value(model.value(model.critic_mlp(samples.obs)))
            last = theirs.model.denorm_value(model.value(model.critic_mlp(trainer.collector.obs["policy"])))
        reward = rollout.reward[..., None] + config.gamma * value * rollout.time_out[..., None]
        starts = torch.cat([torch.zeros(1, envs), rollout.done[:-1]])
        returns = theirs.discount_values(rollout.done[-1], last, starts, value, reward) + value
        return {
            "obses": by_environment(samples.obs), "returns": by_environment(returns), "values": by_environment(value),
            "actions": by_environment(samples.action), "neglogpacs": by_environment(-samples.log_prob),
            "mus": by_environment(samples.mean), "sigmas": by_environment(sigma), "dones": by_environment(starts),
            "played_frames": steps * envs, "step_time": 0.0,
        }  # fmt: skip

    theirs.play_steps = play_steps
    return theirs, parameters


@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("grain", "overrides"),
    [
        ("legacy", ()),
        ("standard", ("agent.kl_grain=epoch", "agent.bounds_coef=0.05", "agent.entropy_coef=0.003")),
        ("legacy", ("agent.normalize_value=true", "agent.learning_rate=1e-3")),
        ("legacy", ("agent.clip_value=null", "agent.bounds_coef=0.01")),
    ],
)
def test_rl_games_dialect_matches_rl_games(make_trainer, monkeypatch, tmp_path, size, grain, overrides):
    trainer = make_trainer("rl_games", size, "agent.critic_obs=[policy]", "agent.critic={hidden: [16, 12]}", *overrides)
    theirs, parameters = make_rl_games(trainer, tmp_path, grain)
    before = copy_parameters(parameters)
    ours = update_ours(trainer, monkeypatch)
    *_, surrogates, values, bounds, entropies, _, _, _ = theirs.train_epoch()
    theirs.writer.close()
    expected = {
        "Loss/surrogate": torch.stack(surrogates).mean().item(),
        "Loss/value": torch.stack(values).mean().item(),
        "Loss/entropy": torch.stack(entropies).mean().item(),
        "Loss/bounds": torch.stack(bounds).mean().item(),
        "Loss/learning_rate": theirs.last_lr,
    }
    require_equal_update(parameters, before, ours, expected)
    assert expected["Loss/bounds"] > 0.0


def test_value_clipping_and_schedule_change_the_update(make_trainer, monkeypatch):
    """Check that the tests above cover value clipping and the adaptive schedule."""
    ends, clipped = [], []
    for overrides in ((), ("agent.clip_value=null",), ("agent.schedule=constant", "agent.desired_kl=null")):
        trainer = make_trainer("rsl_rl", SIZES[1], *overrides)
        losses = update_ours(trainer, monkeypatch, [permutation(trainer.steps_per_iteration)])
        clipped.append(losses["Loss/clip_fraction"])
        ends.append(trainer.learner.weights.detach().clone())
    assert (ends[0] - ends[1]).abs().max().item() > 1e-3
    assert (ends[0] - ends[2]).abs().max().item() > 1e-3
    assert min(clipped) > 0.01
