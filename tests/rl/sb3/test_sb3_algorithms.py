"""Tests of the SB3 trainer: saved policies, replay buffers and normalisation."""

import numpy as np
import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli.rl.policy import Normalizer, Policy
from rlcli.rl.sb3.config import DdpgConfig, SacConfig, Td3Config
from rlcli.rl.sb3.trainer import Sb3Trainer

AGENTS = {
    "ppo": "algorithm: ppo, n_steps: 8",
    "a2c": "algorithm: a2c",
    "sac": "algorithm: sac, train_freq: 4, gradient_steps: 3, learning_starts: 24, batch_size: 16, buffer_size: 256",
    "td3": "algorithm: td3, train_freq: 4, gradient_steps: 3, learning_starts: 24, batch_size: 16, buffer_size: 256",
    "ddpg": "algorithm: ddpg, train_freq: 4, gradient_steps: 3, learning_starts: 24, batch_size: 16, buffer_size: 256",
}


def make_trainer(tmp_path, algorithm, *, normalize=False, seed=3, extra="", task="cartpole"):
    settings = f"{AGENTS[algorithm]}, max_iterations: 20, normalize_observations: {str(normalize).lower()}"
    settings += ", policy: {hidden: [16, 8], activation: elu}" + extra
    file = tmp_path / "agent.yaml"
    file.write_text("scene: {num_envs: 6}\nepisode_length_s: 0.2\nagents: {x: {trainer: sb3, " + settings + "}}\n")
    resolved = resolve(find_task(task), agent="x", config_file=file)
    torch.set_num_threads(1)
    env = make_env(resolved, seed=seed)
    return Sb3Trainer(env, resolved.agent, seed=seed, device="cpu", torch_threads=1)


def all_tensors(trainer):
    state = trainer.state()
    return {f"{part}.{name}": value for part, tensors in state.tensors.items() for name, value in tensors.items()}


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("algorithm", AGENTS)
def test_resumed_training_matches_bit_for_bit(tmp_path, algorithm, normalize):
    whole = make_trainer(tmp_path, algorithm, normalize=normalize)
    whole.start()
    for _ in range(3):
        whole.iterate()
    saved = whole.state()
    reports = [whole.iterate().metrics for _ in range(4)]
    other = make_trainer(tmp_path, algorithm, normalize=normalize, seed=99)
    other.load(saved)
    assert [other.iterate().metrics for _ in range(4)] == reports
    wanted, found = all_tensors(whole), all_tensors(other)
    assert wanted.keys() == found.keys()
    different = [n for n in wanted if not torch.equal(wanted[n].nan_to_num(), found[n].nan_to_num())]
    assert different == []


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("algorithm", AGENTS)
def test_saved_policy_matches_trained_policy(tmp_path, algorithm, normalize):
    trainer = make_trainer(tmp_path, algorithm, normalize=normalize, extra=", action_bound: 0.5")
    trainer.start()
    for _ in range(8):
        trainer.iterate()
    obs = torch.randn(100, 4) * 3.0
    seen = trainer.normalizer(obs) if normalize else obs
    expected, _ = trainer.model.predict(seen.numpy(), deterministic=True)
    found = trainer.policy()(obs)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-6)
    assert found.abs().max() <= 0.5


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_saved_policy_samples_from_trained_distribution(tmp_path, algorithm):
    trainer = make_trainer(tmp_path, algorithm)
    trainer.start()
    for _ in range(8):
        trainer.iterate()
    obs = torch.tensor([[0.3, -0.2, 0.1, 0.4]]).expand(20_000, 4)
    ours = trainer.policy().sample(obs, torch.Generator().manual_seed(0))
    with torch.no_grad():
        theirs = trainer.model.policy._predict(obs, deterministic=False).clamp(-1.0, 1.0)
    assert ours.mean().item() == pytest.approx(theirs.mean().item(), abs=0.02)
    assert ours.std().item() == pytest.approx(theirs.std().item(), abs=0.02)


def test_deterministic_policy_samples_its_action(tmp_path):
    policy = make_trainer(tmp_path, "td3").policy()
    obs = torch.randn(7, 4)
    assert torch.equal(policy.sample(obs), policy(obs))


def test_replay_buffer_stores_final_obs_at_time_outs(tmp_path):
    trainer = make_trainer(tmp_path, "sac")
    trainer.start()
    for _ in range(8):  # 32 steps: two episodes of 12 steps end
        trainer.iterate()
    replay = trainer.model.replay_buffer
    obs, following, done = replay.obs[: replay.pos], replay.next_obs[: replay.pos], replay.done[: replay.pos]
    moved = (following - obs)[..., 1].abs()  # angle of the pole [rad]
    speed = torch.maximum(obs[..., 3].abs(), following[..., 3].abs())
    # in 1/60 s the angle changes by rate / 60; a transition to a reset state would change it more
    assert bool((moved <= speed / 60.0 * 1.5 + 1e-3).all())
    restarts = (obs[1:] - following[:-1]).abs().amax(dim=2) > 1e-6
    assert bool(restarts.any())  # else the test proves nothing
    assert not bool(done[:-1][restarts].any())  # all ends are time-outs, which are stored as not done


def test_random_actions_are_scaled_by_the_action_bound(tmp_path):
    trainer = make_trainer(tmp_path, "td3", extra=", action_bound: 0.25")
    trainer.start()
    trainer.iterate()
    stored = trainer.model.replay_buffer.action[: trainer.model.replay_buffer.pos]
    assert stored.abs().max() > 0.5
    assert torch.allclose(trainer.env.action_manager.action, stored[-1] * 0.25)


def test_no_update_before_learning_starts(tmp_path):
    trainer = make_trainer(tmp_path, "sac", extra="")
    trainer.start()
    before = {name: value.clone() for name, value in trainer.model.policy.state_dict().items()}
    trainer.iterate()  # 24 steps, not more than learning_starts
    assert all(torch.equal(before[name], value) for name, value in trainer.model.policy.state_dict().items())
    trainer.iterate()
    assert any(not torch.equal(before[name], value) for name, value in trainer.model.policy.state_dict().items())


def test_replay_buffer_wraps(tmp_path):
    trainer = make_trainer(tmp_path, "ddpg")
    trainer.start()
    for _ in range(12):  # 48 steps into 256 // 6 = 42 rows
        trainer.iterate()
    replay = trainer.model.replay_buffer
    assert (replay.buffer_size, replay.pos, replay.full) == (42, 6, True)


def test_normalizer_merges_batches():
    batches = [torch.randn(n, 3) * torch.tensor([1.0, 5.0, 0.1]) + torch.tensor([0.0, 100.0, -3.0]) for n in (7, 1, 64)]
    normalizer = Normalizer(3)
    for batch in batches:
        normalizer.update(batch)
    whole = torch.cat(batches).double()
    torch.testing.assert_close(normalizer.mean, whole.mean(dim=0))
    torch.testing.assert_close(normalizer.var, whole.var(dim=0, unbiased=False))
    assert normalizer.count == 72
    assert normalizer(torch.full((1, 3), 1e6)).abs().max() == 10.0


def test_normalizer_does_not_change_when_the_policy_acts(tmp_path):
    trainer = make_trainer(tmp_path, "ppo", normalize=True)
    trainer.start()
    trainer.iterate()
    policy = trainer.policy()
    before = policy.normalizer.mean.clone()
    policy(torch.randn(50, 4) + 7.0)
    assert torch.equal(policy.normalizer.mean, before)
    assert not torch.equal(before, torch.zeros(4, dtype=torch.float64))


def test_load_weights_copies_actor_to_target(tmp_path):
    trained = make_trainer(tmp_path, "td3", normalize=True)
    trained.start()
    for _ in range(8):
        trained.iterate()
    fresh = make_trainer(tmp_path, "td3", normalize=True, seed=5)
    fresh.load_weights(trained.state().tensors["policy"])
    obs = torch.randn(20, 4)
    assert torch.equal(fresh.policy()(obs), trained.policy()(obs))
    actor, target = fresh.model.actor.state_dict(), fresh.model.actor_target.state_dict()
    assert all(torch.equal(actor[name], target[name]) for name in actor)


@pytest.mark.parametrize(
    ("agent", "message"),
    [
        ("algorithm: sac, action_bound: null", "action_bound"),
        ("algorithm: sac, buffer_size: 10", "buffer_size"),
        ("algorithm: td3, schedule: adaptive", "schedule"),
        ("algorithm: a2c, n_epochs: 3", "n_epochs"),
        ("algorithm: tqc", "no algorithm 'tqc'"),
        ("algorithm: dqn", "discrete"),
        ("algorithm: sac, policy: {hidden: []}", "hidden"),
    ],
)
def test_settings_that_do_not_fit_the_algorithm_are_config_errors(tmp_path, agent, message):
    file = tmp_path / "agent.yaml"
    file.write_text("agents: {x: {trainer: sb3, max_iterations: 1, " + agent + "}}\n")
    with pytest.raises(ConfigError, match=message):
        resolve(find_task("cartpole"), agent="x", config_file=file)


def test_policy_is_rebuilt_from_its_spec(tmp_path):
    for algorithm in AGENTS:
        trainer = make_trainer(tmp_path, algorithm, normalize=True)
        trainer.start()
        state = trainer.state()
        rebuilt = Policy(trainer.spec)
        rebuilt.load_state_dict(state.tensors["policy"])
        obs = torch.randn(5, 4)
        assert torch.equal(rebuilt(obs), trainer.policy()(obs))


@pytest.mark.parametrize("settings", [SacConfig, Td3Config, DdpgConfig])
def test_networks_of_off_policy_algorithms_keep_their_defaults_if_one_key_is_set(settings):
    policy = settings.model_validate({"trainer": "sb3", "max_iterations": 1, "policy": {"activation": "elu"}}).policy
    assert (policy.hidden, policy.activation) == ((256, 256), "elu")
