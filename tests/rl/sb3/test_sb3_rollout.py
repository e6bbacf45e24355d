"""Tests of the SB3 trainer's rollout against Stable-Baselines3, and of the bootstrap of time-outs."""

from collections import deque

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from rlcli.adapters.sb3 import Sb3VecEnv
from rlcli.errors import ConfigError, DivergedError
from rlcli.rl.sb3.buffers import TorchRolloutBuffer
from rlcli.rl.sb3.trainer import Sb3Trainer


def make_trainer(env, agent, seed=5):
    trainer = Sb3Trainer(env, agent, seed=seed, device="cpu", torch_threads=1)
    trainer.start()
    return trainer


def collect(trainer):
    model = trainer.model
    model.collect_rollouts(model.env, None, model.rollout_buffer, model.n_steps)
    return model.rollout_buffer


def fill_buffers(steps, envs, seed=0):
    generator = torch.Generator().manual_seed(seed)
    observation, action = spaces.Box(-np.inf, np.inf, (3,)), spaces.Box(-1, 1, (2,))
    fast, stock = (
        kind(steps, observation, action, device="cpu", gae_lambda=0.93, gamma=0.97, n_envs=envs)
        for kind in (TorchRolloutBuffer, RolloutBuffer)
    )
    fast.reset()
    done = torch.zeros(envs, dtype=torch.bool)
    for _ in range(steps):
        obs, act = torch.randn(envs, 3, generator=generator), torch.randn(envs, 2, generator=generator)
        reward, value, log_prob = (torch.randn(envs, generator=generator) for _ in range(3))
        start, done = done, torch.rand(envs, generator=generator) < 0.2
        fast.put(obs, act, reward, start, value, log_prob)
        stock.add(obs.numpy(), act.numpy(), reward.numpy(), start.numpy(), value, log_prob)
    last = torch.randn(envs, generator=generator)
    fast.finish(last, done)
    stock.compute_returns_and_advantage(last, done.numpy())
    return fast, stock


@pytest.mark.parametrize("envs", [1, 7, 64])
def test_advantages_and_returns_match_sb3(envs):
    fast, stock = fill_buffers(13, envs)
    np.testing.assert_allclose(fast.advantage.numpy(), stock.advantages, atol=1e-6)
    np.testing.assert_allclose(fast.target.numpy(), stock.returns, atol=1e-6)
    # SB3's update reads these arrays for its explained variance
    np.testing.assert_array_equal(fast.returns, fast.target.numpy())
    np.testing.assert_allclose(fast.values, stock.values, atol=1e-6)


@pytest.mark.parametrize("envs", [1, 7, 512])
@pytest.mark.parametrize("parts", [1, 3, 4])
def test_minibatches_contain_each_sample_once(envs, parts):
    fast, _ = fill_buffers(5, envs)
    fast.num_minibatches = parts
    batches = list(fast.get(None))
    assert len(batches) == parts
    sizes = [len(batch.observations) for batch in batches]
    assert max(sizes) - min(sizes) <= 1
    seen = torch.cat([batch.old_log_prob for batch in batches]).sort().values
    torch.testing.assert_close(seen, fast.log_prob.flatten().sort().values, rtol=0, atol=0)


def test_minibatch_rows_keep_their_columns():
    fast, _ = fill_buffers(5, 7)
    fast.num_minibatches = 2
    key = {float(v): (s, e) for s, row in enumerate(fast.value.tolist()) for e, v in enumerate(row)}
    for batch in fast.get(None):
        for row in range(len(batch.old_values)):
            step, env = key[float(batch.old_values[row])]
            torch.testing.assert_close(batch.observations[row], fast.obs[step, env])
            torch.testing.assert_close(batch.actions[row], fast.action[step, env])
            torch.testing.assert_close(batch.returns[row], fast.target[step, env])
            torch.testing.assert_close(batch.advantages[row], fast.advantage[step, env])


def test_time_out_bootstraps_from_final_obs(make, scheduled):
    env, agent = make(scheduled)
    trainer = make_trainer(env, agent)
    buffer, gamma = collect(trainer), trainer.model.gamma

    def value(progress, row):
        with torch.no_grad():
            return trainer.model.policy.predict_values(torch.tensor([[float(progress), float(row)]])).item()

    expected = torch.tensor([[11.0, 11.0, 11.0, 11.0], [12.0, 12.0, 12.0, 11.0], [11.0, 13.0, 13.0, 11.0]])
    expected[2, 1] += gamma * value(3, 1)  # a time-out: the last observation has progress 3, environment 1
    torch.testing.assert_close(buffer.reward[:3], expected, rtol=0, atol=1e-5)
    assert (
        abs(value(3, 1) - value(0, 1)) > 1e-3 < abs(value(3, 1) - value(2, 1))
    )  # so a wrong observation would be noticed
    assert buffer.start[3].tolist() == [0.0, 1.0, 1.0, 1.0]
    # after the end of an episode the first observation of the new one is stored
    assert buffer.obs[3, 1].tolist() == [0.0, 1.0]


def test_reward_scale_scales_only_rewards(make, scheduled):
    plain, scaled = (collect(make_trainer(*make(scheduled, f"agent.reward_scale={scale}"))) for scale in (1.0, 0.1))
    own = torch.tensor([[11.0, 11.0, 11.0, 11.0], [12.0, 12.0, 12.0, 11.0], [11.0, 13.0, 13.0, 11.0]])
    torch.testing.assert_close(scaled.reward[:3] - 0.1 * own, plain.reward[:3] - own, rtol=0, atol=1e-5)


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
@pytest.mark.parametrize("bound", ["1.0", "0.1", "null"])
def test_rollout_matches_stock_sb3(make, task, bound):
    overrides = ("scene.num_envs=7", "episode_length_s=0.4", "agent.n_steps=40", f"agent.action_bound={bound}")
    trainer = make_trainer(*make(task, *overrides))
    env, agent = make(task, *overrides)
    vec = Sb3VecEnv(env, agent.action_bound)
    stock = PPO(
        "MlpPolicy", vec, n_steps=40, batch_size=280, gamma=agent.gamma, gae_lambda=agent.gae_lambda,
        policy_kwargs=trainer.model.policy_kwargs, device="cpu",
    )  # fmt: skip
    stock.set_logger(Logger(folder=None, output_formats=[]))
    stock.policy.load_state_dict(trainer.model.policy.state_dict())
    vec.seed(env.seed)
    stock._last_obs, stock._last_episode_starts = vec.reset(), np.ones(7, dtype=bool)

    class Silent(BaseCallback):
        def _on_step(self):
            return True

    callback = Silent()
    callback.init_callback(stock)
    torch.manual_seed(11)
    fast = collect(trainer)
    torch.manual_seed(11)
    stock.ep_info_buffer, stock.ep_success_buffer = deque(), deque()
    stock.collect_rollouts(vec, callback, stock.rollout_buffer, 40)
    slow = stock.rollout_buffer
    scale = agent.reward_scale
    ends = fast.start[1:].bool()
    assert ends.any()
    # stock SB3 has no reward scale: compare unscaled rewards, except at ends with their bootstrap
    rewards = torch.as_tensor(slow.rewards)
    same = torch.ones_like(fast.reward, dtype=torch.bool)
    if scale != 1.0:
        same[:-1] = ~ends
        same[-1] = False
    torch.testing.assert_close(fast.reward[same] / scale, rewards[same], rtol=1e-5, atol=1e-5)
    for mine, theirs in (
        (fast.obs, slow.observations), (fast.action, slow.actions), (fast.value, slow.values),
        (fast.log_prob, slow.log_probs), (fast.start, slow.episode_starts),
    ):  # fmt: skip
        torch.testing.assert_close(mine, torch.as_tensor(theirs), rtol=1e-5, atol=1e-5)


def test_env_gets_actions_clipped_to_the_bound(make, scheduled):
    trainer = make_trainer(*make(scheduled, "agent.action_bound=0.25", "agent.policy={init_std: 5.0}"))
    reached = []
    hook = trainer.env.task.pre_physics_step
    trainer.env.task.pre_physics_step = lambda actions: (reached.append(actions.clone()), hook(actions))
    buffer = collect(trainer)
    assert float(torch.stack(reached).abs().max()) == 0.25
    assert float(buffer.action.abs().max()) > 1.0  # the learner keeps the sampled actions


def test_unbounded_actions_are_not_clipped(make, scheduled):
    trainer = make_trainer(*make(scheduled, "agent.action_bound=null", "agent.policy={init_std: 5.0}"))
    reached = []
    hook = trainer.env.task.pre_physics_step
    trainer.env.task.pre_physics_step = lambda actions: (reached.append(actions.clone()), hook(actions))
    buffer = collect(trainer)
    torch.testing.assert_close(torch.stack(reached), buffer.action, rtol=0, atol=0)


def learning_rates(trainer, iterations):
    return [trainer.iterate().metrics["Loss/learning_rate"] for _ in range(iterations)]


def test_constant_schedule_keeps_learning_rate(make, scheduled):
    assert learning_rates(make_trainer(*make(scheduled, "agent.learning_rate=2e-3")), 3) == [2e-3] * 3


def test_linear_schedule_decreases_to_zero_over_the_budget(make, scheduled):
    trainer = make_trainer(
        *make(scheduled, "agent.learning_rate=1e-3", "agent.schedule=linear", "agent.max_iterations=4")
    )
    assert learning_rates(trainer, 4) == pytest.approx([1e-3, 7.5e-4, 5e-4, 2.5e-4])


@pytest.mark.parametrize(("desired", "factor"), [("1e-9", 1 / 1.5), ("1e9", 1.5)])
def test_adaptive_schedule_follows_kl(make, scheduled, desired, factor):
    trainer = make_trainer(
        *make(scheduled, "agent.learning_rate=1e-3", "agent.schedule=adaptive", f"agent.desired_kl={desired}")
    )
    trainer.iterate()
    assert trainer.iterate().metrics["Loss/learning_rate"] == pytest.approx(1e-3 * factor)


def test_adaptive_schedule_stays_in_its_range(make, scheduled):
    trainer = make_trainer(
        *make(scheduled, "agent.learning_rate=9e-3", "agent.schedule=adaptive", "agent.desired_kl=1e9")
    )
    assert max(learning_rates(trainer, 4)) == 1e-2


@pytest.mark.parametrize("rate", ["1e10", "1e30"])
def test_nan_in_learner_is_a_divergence(make, scheduled, rate):
    trainer = make_trainer(*make(scheduled, f"agent.learning_rate={rate}"))
    with pytest.raises(DivergedError, match="not finite in iteration"):
        [trainer.iterate() for _ in range(3)]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("scene.num_envs=1", "agent.n_steps=2", "agent.num_minibatches=3"), "3 minibatches are too many"),
        (("scene.num_envs=1", "agent.n_steps=1", "agent.num_minibatches=1"), "advantages cannot be normalised"),
    ],
)
def test_too_small_rollout_is_a_config_error(make, scheduled, overrides, message):
    env, agent = make(scheduled, *overrides)
    with pytest.raises(ConfigError, match=message):
        Sb3Trainer(env, agent, seed=0, device="cpu", torch_threads=1)


@pytest.mark.parametrize("envs", [1, 3, 7])
def test_any_number_of_envs_and_minibatches_trains_without_warning(make, scheduled, envs):
    trainer = make_trainer(*make(scheduled, f"scene.num_envs={envs}", "agent.num_minibatches=5"))
    assert "Loss/surrogate" in trainer.iterate().metrics


def test_state_is_a_copy_and_restores_bit_for_bit(make, scheduled):
    trainer = make_trainer(*make(scheduled))
    trainer.iterate()
    state = trainer.state()
    before = {k: v.clone() for k, v in state.tensors["policy"].items()}
    trainer.iterate()
    after = trainer.state()
    assert all(torch.equal(before[name], state.tensors["policy"][name]) for name in before)
    other = make_trainer(*make(scheduled, seed=99), seed=98)
    other.load(state)
    other.iterate()
    again = other.state()
    for part, tensors in after.tensors.items():
        for name, value in tensors.items():
            if value.is_floating_point():
                assert torch.equal(value.nan_to_num(), again.tensors[part][name].nan_to_num()), (part, name)
            else:
                assert torch.equal(value, again.tensors[part][name]), (part, name)
    assert after.values == again.values


def test_deployable_policy_matches_learner(make, scheduled):
    trainer = make_trainer(*make(scheduled))
    trainer.iterate()
    obs = torch.randn(50, 2) * 3
    learner, _ = trainer.model.predict(obs.numpy(), deterministic=True)
    with torch.no_grad():
        np.testing.assert_allclose(trainer.policy()(obs).numpy(), learner, atol=1e-6)
