"""Tests of the built-in PPO: rollouts, advantages, minibatches, schedules and exact resume."""

from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from support import worlds
from torch.utils._python_dispatch import TorchDispatchMode

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, DivergedError
from rlcli.registry import find_task
from rlcli.rl.policy import Normalizer
from rlcli.rl.ppo.trainer import PpoTrainer

AGENTS = """
agents:
  ppo:
    {trainer: ppo, algorithm: ppo, max_iterations: 2, num_steps: 8, num_minibatches: 2, num_epochs: 2}
"""
ALL_STATE = (
    "agent.normalize_observations=true", "agent.normalize_value=true", "agent.std=scalar", "agent.schedule=adaptive",
    "agent.desired_kl=0.01", "agent.clip_grad=separate",
)  # fmt: skip


@pytest.fixture
def ppo_task(scheduled: str) -> str:
    """The scheduled task with an agent of the built-in trainer."""
    file = Path(scheduled) / "task.yaml"
    file.write_text(file.read_text().partition("agents:")[0] + AGENTS)
    return scheduled


@pytest.fixture
def asymmetric_task(tmp_path: Path) -> str:
    """A legged robot whose critic has other observations than the actor."""
    return str(worlds.critter(tmp_path, worlds.CRITTER_TASK + AGENTS))


def make_trainer(task, *overrides, seed=5, env_seed=3):
    resolved = resolve(find_task(task), agent="ppo", overrides=overrides)
    env = make_env(resolved, seed=env_seed)
    trainer = PpoTrainer(env, resolved.agent, seed=seed, device="cpu", torch_threads=1)
    trainer.start()
    return trainer


def collect_rollout(trainer):
    trainer.collector.collect()
    trainer.collector.estimate_advantages()
    return trainer.collector.rollout


def value_of(trainer, *obs):
    with torch.no_grad():
        return trainer.networks.value(torch.tensor([obs], dtype=torch.float32)).item()


def require_equal_tensors(left, right):
    for part, tensors in left.items():
        assert tensors.keys() == right[part].keys()
        for name, value in tensors.items():
            assert torch.equal(value.nan_to_num(), right[part][name].nan_to_num()), (part, name)


def require_equal_state(left, right):
    require_equal_tensors(left.tensors, right.tensors)
    assert left.values == right.values


# --- rollouts and advantages ---


def test_time_out_bootstraps_from_final_obs(ppo_task):
    trainer = make_trainer(ppo_task, "agent.lam=0.0", "agent.normalize_advantage=null", "agent.gamma=0.9")
    rollout = collect_rollout(trainer)
    samples = rollout.samples
    # environment 1 has a time-out at its third step, with the last observation (3, 1); environment 2 terminates too
    assert samples.obs[2, 1].tolist() == [2.0, 1.0]
    assert samples.obs[3, 1].tolist() == [0.0, 1.0]
    expected = 13.0 + 0.9 * value_of(trainer, 3, 1)
    assert samples.target[2, 1].item() == pytest.approx(expected, abs=1e-5)
    assert samples.target[2, 2].item() == pytest.approx(13.0, abs=1e-5)
    assert samples.target[0, 1].item() == pytest.approx(11.0 + 0.9 * value_of(trainer, 1, 1), abs=1e-5)
    assert abs(value_of(trainer, 3, 1) - value_of(trainer, 2, 1)) > 1e-3


def test_pre_step_bootstrap_uses_obs_before_the_step(ppo_task):
    trainer = make_trainer(
        ppo_task, "agent.lam=0.0", "agent.normalize_advantage=null", "agent.gamma=0.9", "agent.bootstrap=pre_step"
    )
    samples = collect_rollout(trainer).samples
    assert samples.target[2, 1].item() == pytest.approx(13.0 + 0.9 * value_of(trainer, 2, 1), abs=1e-5)
    assert samples.target[2, 2].item() == pytest.approx(13.0, abs=1e-5)


def test_reward_scale_scales_only_rewards(ppo_task):
    overrides = ("agent.lam=0.0", "agent.normalize_advantage=null")
    plain, scaled = (
        collect_rollout(make_trainer(ppo_task, *overrides, f"agent.reward_scale={s}")).samples.target for s in (1, 0.1)
    )
    own_rewards = torch.tensor([[11.0, 11, 11, 11], [12, 12, 12, 11], [11, 13, 13, 11]])
    torch.testing.assert_close(scaled[:3] - 0.1 * own_rewards, plain[:3] - own_rewards, rtol=0, atol=1e-5)


@pytest.mark.parametrize("envs", [1, 7, 64])
def test_advantages_match_sb3(ppo_task, envs):
    trainer = make_trainer(ppo_task, f"scene.num_envs={envs}", "agent.lam=0.93", "agent.normalize_advantage=null")
    rollout = collect_rollout(trainer)
    steps, samples = 8, rollout.samples
    stock = RolloutBuffer(
        steps, spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(-1, 1, (1,)), device="cpu", gae_lambda=0.93,
        gamma=trainer.config.gamma, n_envs=envs,
    )  # fmt: skip
    beyond = torch.zeros(steps, envs)
    with torch.no_grad():
        beyond[rollout.time_out] = trainer.networks.value(rollout.final_obs[rollout.time_out])
        last = trainer.networks.value(trainer.collector.obs["policy"])
    rewards = rollout.reward + trainer.config.gamma * beyond
    start = np.ones(envs)
    for t in range(steps):
        stock.add(
            samples.obs[t].numpy(), samples.action[t].numpy(), rewards[t].numpy(), start, samples.value[t],
            samples.log_prob[t],
        )  # fmt: skip
        start = rollout.done[t].numpy()
    stock.compute_returns_and_advantage(last, start)
    assert rollout.done.any()
    np.testing.assert_allclose(samples.advantage.numpy(), stock.advantages, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(samples.target.numpy(), stock.returns, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("bound", ["0.25", "null"])
def test_env_gets_clipped_and_learner_gets_sampled_actions(ppo_task, bound):
    trainer = make_trainer(ppo_task, f"agent.action_bound={bound}", "agent.init_std=5.0")
    reached = []
    hook = trainer.env.task.pre_physics_step
    trainer.env.task.pre_physics_step = lambda actions: (reached.append(actions.clone()), hook(actions))
    drawn = collect_rollout(trainer).samples.action
    assert float(drawn.abs().max()) > 1.0
    expected = drawn if bound == "null" else drawn.clamp(-0.25, 0.25)
    torch.testing.assert_close(torch.stack(reached), expected, rtol=0, atol=0)


def test_log_prob_matches_torch_distribution(ppo_task):
    trainer = make_trainer(ppo_task, "agent.init_std=0.3")
    samples = collect_rollout(trainer).samples
    expected = torch.distributions.Normal(samples.mean, 0.3).log_prob(samples.action).sum(dim=-1)
    torch.testing.assert_close(samples.log_prob, expected, rtol=1e-5, atol=1e-5)


def test_critic_reads_group_critic_if_the_task_has_it(asymmetric_task):
    trainer = make_trainer(asymmetric_task)
    assert trainer.networks.critic[0].in_features == trainer.env.layout.size("critic")
    samples = collect_rollout(trainer).samples
    first = trainer.env.reset(seed=3)
    torch.testing.assert_close(samples.critic_obs[0], first["critic"], rtol=0, atol=0)
    torch.testing.assert_close(samples.obs[0], first["policy"], rtol=0, atol=0)


def test_critic_reads_several_groups(asymmetric_task):
    trainer = make_trainer(asymmetric_task, "agent.critic_obs=[policy, critic]")
    samples = collect_rollout(trainer).samples
    first = trainer.env.reset(seed=3)
    torch.testing.assert_close(samples.critic_obs[0], torch.cat([first["policy"], first["critic"]], dim=1))


def test_normalizer_is_updated_after_the_rollout(ppo_task):
    trainer = make_trainer(ppo_task, "agent.normalize_observations=true")
    raw = collect_rollout(make_trainer(ppo_task)).samples.obs
    trainer.collector.collect()
    torch.testing.assert_close(
        trainer.collector.rollout.samples.obs, raw, rtol=0, atol=1e-6
    )  # the normaliser has no samples yet
    trainer.learner.update()
    expected = Normalizer(2)
    expected.update(raw.flatten(0, 1))
    for name, value in expected.state_dict().items():
        torch.testing.assert_close(trainer.collector.normalizer.state_dict()[name], value)
    trainer.collector.collect()
    assert float(trainer.collector.rollout.samples.obs.mean().abs()) < 0.2


def test_normalizer_update_step_updates_before_each_action(ppo_task):
    trainer = make_trainer(ppo_task, "agent.normalize_observations=true", "agent.normalizer_update=step")
    raw = collect_rollout(make_trainer(ppo_task)).samples.obs
    expected = Normalizer(2)
    trainer.collector.collect()
    for t in range(8):
        expected.update(raw[t])
        torch.testing.assert_close(trainer.collector.rollout.samples.obs[t], expected(raw[t]))


# --- minibatches ---


@pytest.mark.parametrize("envs", [1, 7, 64])
@pytest.mark.parametrize("how", ["num_minibatches=1", "num_minibatches=3", "minibatch_size=5"])
@pytest.mark.parametrize("shuffle", ["epoch", "update", "none"])
def test_minibatches_contain_each_sample_once(ppo_task, envs, how, shuffle):
    trainer = make_trainer(ppo_task, f"scene.num_envs={envs}", f"agent.{how}", f"agent.shuffle={shuffle}")
    rollout = collect_rollout(trainer)
    rollout.fill_minibatches(trainer.learner.sample_order())
    every = torch.cat([part.log_prob for part in rollout.minibatches])
    torch.testing.assert_close(every.sort().values, rollout.samples.log_prob.flatten().sort().values, rtol=0, atol=0)
    sizes = [len(part.value) for part in rollout.minibatches]
    if how.startswith("num"):
        assert len(sizes) == int(how[-1])
        assert max(sizes) - min(sizes) <= 1
    else:
        assert set(sizes[:-1]) <= {5}
    flat = {float(v): i for i, v in enumerate(rollout.samples.log_prob.flatten())}
    for part in rollout.minibatches:
        at = torch.tensor([flat[float(v)] for v in part.log_prob])
        for name in ("obs", "action", "mean", "value", "advantage", "target"):
            whole = getattr(rollout.samples, name).flatten(0, 1)
            torch.testing.assert_close(getattr(part, name), whole[at], rtol=0, atol=0)


def test_unshuffled_minibatches_contain_whole_environments(ppo_task):
    trainer = make_trainer(ppo_task, "agent.num_minibatches=2", "agent.shuffle=none")
    rollout = collect_rollout(trainer)
    rollout.fill_minibatches(trainer.learner.sample_order())
    for part, ids in zip(rollout.minibatches, ([0.0, 1.0], [2.0, 3.0]), strict=True):
        assert sorted(set(part.obs[:, 1].tolist())) == ids


def record_orders(trainer, monkeypatch):
    orders, rollout = [], trainer.collector.rollout
    fill = rollout.fill_minibatches
    monkeypatch.setattr(rollout, "fill_minibatches", lambda order: (orders.append(order.clone()), fill(order)))
    trainer.iterate()
    return orders


def test_shuffle_setting_gives_number_of_orders(ppo_task, monkeypatch):
    each = record_orders(make_trainer(ppo_task, "agent.shuffle=epoch", "agent.num_epochs=3"), monkeypatch)
    assert len({tuple(order.tolist()) for order in each}) == 3
    assert len(record_orders(make_trainer(ppo_task, "agent.shuffle=update", "agent.num_epochs=3"), monkeypatch)) == 1


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("scene.num_envs=1", "agent.num_steps=2", "agent.num_minibatches=3"), "3 minibatches are too many"),
        (("scene.num_envs=1", "agent.num_steps=1", "agent.num_minibatches=1"), "cannot be normalised over one sample"),
        (("agent.normalize_advantage=minibatch", "agent.minibatch_size=1"), "cannot be normalised over one sample"),
        (("agent.critic_obs=[critic]",), "no observation group 'critic'"),
    ],
)
def test_settings_that_do_not_fit_the_env_are_config_errors(ppo_task, overrides, message):
    with pytest.raises(ConfigError, match=message):
        make_trainer(ppo_task, *overrides)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["agent.schedule=adaptive"], "desired_kl"),
        (["agent.desired_kl=0.01"], "desired_kl"),
        (["agent.kl_from=last_pass"], "set shuffle to update or none"),
        (["agent.learning_rate_range=[1e-2, 1e-5]"], "is above"),
        (["agent.dialect=rslrl"], "dialect"),
        (["agent.dialect=sb3", "agent.critic={hiden: [3]}"], "hiden"),
        (["agent.actor.hidden=[]"], "hidden"),
    ],
)
def test_contradicting_settings_are_config_errors(ppo_task, overrides, message):
    with pytest.raises(ConfigError, match=message):
        resolve(find_task(ppo_task), agent="ppo", overrides=overrides)


@pytest.mark.parametrize("envs", [1, 3, 7])
def test_any_number_of_envs_and_minibatches_trains(ppo_task, envs):
    report = make_trainer(ppo_task, f"scene.num_envs={envs}", "agent.num_minibatches=5").iterate()
    assert {"Loss/surrogate", "Loss/value", "Loss/kl", "Policy/mean_std"} <= report.metrics.keys()


# --- the learning rate ---


def learning_rates(trainer, iterations):
    return [trainer.iterate().metrics["Loss/learning_rate"] for _ in range(iterations)]


def test_constant_schedule_keeps_learning_rate(ppo_task):
    assert learning_rates(make_trainer(ppo_task, "agent.learning_rate=2e-3"), 3) == pytest.approx([2e-3] * 3)


def test_linear_schedule_decreases_to_zero_over_the_budget(ppo_task):
    trainer = make_trainer(ppo_task, "agent.learning_rate=1e-3", "agent.schedule=linear", "agent.max_iterations=4")
    assert learning_rates(trainer, 4) == pytest.approx([1e-3, 7.5e-4, 5e-4, 2.5e-4])


@pytest.mark.parametrize(("grain", "changes"), [("minibatch", 4), ("epoch", 2), ("iteration", 1)])
@pytest.mark.parametrize(("desired", "factor"), [("1e-9", 1 / 1.5), ("1e9", 1.5)])
def test_adaptive_schedule_follows_kl_at_its_grain(ppo_task, grain, changes, desired, factor):
    trainer = make_trainer(
        ppo_task, "agent.learning_rate=1e-3", "agent.schedule=adaptive", f"agent.desired_kl={desired}",
        f"agent.kl_grain={grain}", "agent.learning_rate_range=[1e-9, 1.0]",
    )  # fmt: skip
    trainer.collector.obs["policy"] += 1.0
    trainer.iterate()
    before = float(trainer.learner.learning_rate)
    after = trainer.iterate().metrics["Loss/learning_rate"]
    # in the first minibatch of an iteration the KL divergence is about 0, with either sign
    assert after / before == pytest.approx(factor**changes) or (
        grain == "minibatch" and after / before == pytest.approx(factor ** (changes - 1))
    )


@pytest.mark.parametrize(("desired", "limit"), [("1e-9", 5e-4), ("1e9", 2e-3)])
def test_adaptive_schedule_stays_in_its_range(ppo_task, desired, limit):
    trainer = make_trainer(
        ppo_task, "agent.schedule=adaptive", f"agent.desired_kl={desired}", "agent.learning_rate_range=[5e-4, 2e-3]"
    )
    assert learning_rates(trainer, 3)[-1] == pytest.approx(limit)


def test_adaptive_linear_schedule_stays_below_decreasing_limit(ppo_task):
    trainer = make_trainer(
        ppo_task, "agent.schedule=adaptive_linear", "agent.desired_kl=1e9", "agent.learning_rate=1e-3",
        "agent.learning_rate_range=[1e-5, 2e-3]", "agent.max_iterations=4",
    )  # fmt: skip
    assert learning_rates(trainer, 4) == pytest.approx([2e-3, 1.5e-3, 1e-3, 0.5e-3])


@pytest.mark.parametrize("rate", ["1e10", "1e30"])
def test_nan_in_learner_is_a_divergence(ppo_task, rate):
    trainer = make_trainer(ppo_task, f"agent.learning_rate={rate}")
    with pytest.raises(DivergedError, match="not finite"):
        [trainer.iterate() for _ in range(4)]


@pytest.mark.parametrize("scope", ["joint", "separate"])
def test_clip_grad_is_joint_or_separate(ppo_task, scope):
    trainer = make_trainer(ppo_task, f"agent.clip_grad={scope}", "agent.max_grad_norm=0.5")
    gradient = trainer.learner.gradient
    end = len(gradient) - sum(p.numel() for n, p in trainer.networks.named_parameters() if n.startswith("critic"))
    gradient[:end], gradient[end:] = 0.001, 3.0
    before = gradient.clone()
    trainer.learner.clip_gradient()
    critic = before[end:] * 0.5 / before[end:].norm()
    torch.testing.assert_close(gradient[end:], critic, rtol=1e-4, atol=0)
    if scope == "separate":
        torch.testing.assert_close(gradient[:end], before[:end], rtol=0, atol=0)
    else:
        assert float(gradient.norm()) == pytest.approx(0.5, rel=1e-4)
        torch.testing.assert_close(gradient / gradient.norm(), before / before.norm())


# --- conditions of a CUDA graph ---


class SyncRecorder(TorchDispatchMode):
    """Recorder of operations that synchronise host and device on a GPU."""

    SYNCHRONISING = ("_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "unique")

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.name().removeprefix("aten::").partition(".")[0]
        by_mask = name == "index" and any(i is not None and i.dtype == torch.bool for i in args[1])
        if name in self.SYNCHRONISING or by_mask:
            self.seen.append(name)
        return func(*args, **(kwargs or {}))


def test_sync_recorder_records_synchronising_operations():
    values = torch.tensor([1.0, 2.0])
    with SyncRecorder() as recorder:
        bool(values.sum() > 0)
        values[values > 1.5]
        values.nonzero()
    assert recorder.seen == ["_local_scalar_dense", "index", "nonzero"]


@pytest.mark.parametrize("setting", ["dialect=rsl_rl", "dialect=rl_games", "dialect=sb3", "rnn={hidden: 4}"])
def test_update_forces_no_host_sync(ppo_task, setting, monkeypatch):
    trainer = make_trainer(
        ppo_task, f"agent.{setting}", "agent.normalize_observations=true", "agent.normalize_value=true"
    )
    trainer.iterate()
    monkeypatch.setattr(
        trainer.collector, "_value_where", lambda mask, obs: torch.where(mask, trainer.collector._value(obs), 0.0)
    )  # as on a GPU
    monkeypatch.setattr(trainer.collector, "checks_every_stage", False)  # as on a GPU
    trainer.collector.collect()
    with SyncRecorder() as recorder:
        trainer.learner.update()
    assert recorder.seen == []


def test_value_where_matches_values_of_all_rows(ppo_task):
    trainer = make_trainer(ppo_task)
    rollout = collect_rollout(trainer)
    with torch.no_grad():
        rows = trainer.collector._value_where(rollout.time_out, rollout.final_obs)
        every = torch.where(rollout.time_out, trainer.collector._value(rollout.final_obs), 0.0)
    assert rollout.time_out.any()
    torch.testing.assert_close(rows, every)


def tensor_addresses(trainer):
    held = {**trainer._learner_tensors(), **{f"obs.{k}": v for k, v in trainer.collector.obs.items()}}
    held |= {f"actor.{name}": value for name, value in trainer.networks.actor.named_parameters()}
    held["gradient"] = trainer.learner.weights.grad
    held |= {f"normalizer.{name}": value for name, value in trainer.collector.normalizer.state_dict().items()}
    held |= {"metrics": trainer.learner.metric_values, "samples": trainer.collector.rollout.samples.value}
    return {name: value.data_ptr() for name, value in held.items()}


def test_tensors_keep_their_addresses(ppo_task):
    trainer = make_trainer(ppo_task, *ALL_STATE)
    before = tensor_addresses(trainer)
    trainer.iterate()
    state = trainer.state()
    trainer.iterate()
    trainer.load(state)
    trainer.load_weights(state.tensors["policy"])
    assert tensor_addresses(trainer) == before


# --- state ---


@pytest.mark.parametrize("overrides", [(), ALL_STATE, (*ALL_STATE, "agent.normalizer_update=step")])
def test_state_is_a_copy_and_restores_bit_for_bit(asymmetric_task, overrides):
    overrides = (*overrides, "agent.num_steps=16")
    trainer = make_trainer(asymmetric_task, *overrides)
    trainer.iterate()
    trainer.iterate()
    state = trainer.state()
    kept = {part: {name: v.clone() for name, v in tensors.items()} for part, tensors in state.tensors.items()}
    trainer.iterate()
    after = trainer.state()
    require_equal_tensors(kept, state.tensors)
    other = make_trainer(asymmetric_task, *overrides, seed=98, env_seed=99)
    other.load(state)
    require_equal_state(other.state(), state)
    other.iterate()
    require_equal_state(other.state(), after)


def test_seed_decides_the_bits(ppo_task):
    runs = []
    for seed in (5, 5, 6):
        trainer = make_trainer(ppo_task, seed=seed)
        trainer.iterate()
        runs.append(trainer.state().tensors["policy"]["actor.0.weight"])
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


@pytest.mark.parametrize("overrides", [(), ALL_STATE])
def test_deployable_policy_matches_learner(ppo_task, overrides):
    trainer = make_trainer(ppo_task, *overrides)
    trainer.iterate()
    obs = torch.randn(50, 2) * 3
    with torch.no_grad():
        expected = trainer.networks.actor(trainer.collector.actor_input({"policy": obs})).clamp(-1.0, 1.0)
        torch.testing.assert_close(trainer.policy()(obs), expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(trainer.policy().log_std.exp(), trainer.networks.std.detach())


@pytest.mark.parametrize("std", ["log", "scalar"])
def test_load_weights_does_not_change_the_critic(ppo_task, std):
    donor, trainer = (
        make_trainer(ppo_task, "agent.normalize_observations=true", f"agent.std={std}", seed=s) for s in (1, 2)
    )
    donor.iterate()
    critic = trainer.networks.critic[0].weight.clone()
    trainer.load_weights(donor.state().tensors["policy"])
    obs = torch.randn(20, 2)
    torch.testing.assert_close(trainer.policy()(obs), donor.policy()(obs), rtol=0, atol=0)
    torch.testing.assert_close(trainer.networks.std, donor.networks.std)
    assert torch.equal(trainer.networks.critic[0].weight, critic)


# --- settings ---


@pytest.mark.parametrize(
    ("init", "check"),
    [
        ("zero_bias", lambda layer: not layer.bias.any()),
        ("default", lambda layer: bool(layer.bias.any())),
        ("orthogonal", lambda layer: not layer.bias.any()),
    ],
)
def test_init_setting_gives_initial_weights(ppo_task, init, check):
    networks = make_trainer(ppo_task, f"agent.init={init}", "agent.init_std=0.7", "agent.actor={hidden: [8]}").networks
    for network in (networks.actor, networks.critic):
        assert all(check(layer) for layer in network if isinstance(layer, torch.nn.Linear))
    torch.testing.assert_close(networks.std.detach(), torch.tensor([0.7]))
    if init == "orthogonal":
        weight = networks.actor[0].weight.detach()
        torch.testing.assert_close(weight.T @ weight, 2.0 * torch.eye(2), rtol=0, atol=1e-5)
        assert networks.actor[-1].weight.norm().item() == pytest.approx(0.01, rel=1e-4)
        assert networks.critic[-1].weight.norm().item() == pytest.approx(1.0, rel=1e-4)


def test_dialect_defaults_are_replaced_by_given_keys(ppo_task):
    def agent(*overrides):
        return resolve(find_task(ppo_task), agent="ppo", overrides=overrides).agent

    plain, preset = agent(), agent("agent.dialect=sb3")
    assert (plain.normalize_advantage, preset.normalize_advantage) == ("batch", "minibatch")
    assert preset.num_epochs == 2  # the task sets it
    assert preset.actor.activation == "tanh"
    replaced = agent("agent.dialect=sb3", "agent.actor={hidden: [7]}", "agent.max_grad_norm=9.0")
    assert (replaced.actor.hidden, replaced.actor.activation, replaced.max_grad_norm) == ((7,), "tanh", 9.0)
    rsl_rl, rl_games = agent("agent.dialect=rsl_rl"), agent("agent.dialect=rl_games")
    assert (rsl_rl.clip_grad, rl_games.clip_grad) == ("separate", "joint")
    assert (rsl_rl.learning_rate_range, rl_games.learning_rate_range) == ((1e-5, 1e-2), (1e-6, 1e-2))
