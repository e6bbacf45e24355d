"""Tests of recurrent policies: the update replays the hidden states of the rollout."""

import json
from pathlib import Path

import pytest
import torch

from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli.rl.action_functions import trained_policy
from rlcli.rl.policy import Lstm
from rlcli.rl.ppo.trainer import PpoTrainer

AGENT = """
agents:
  ppo: {trainer: ppo, algorithm: ppo, max_iterations: 2, num_steps: 8, num_minibatches: 2, num_epochs: 2,
        rnn: {hidden: 6, layers: 2}, actor: {hidden: [5]}, critic: {hidden: [7]}}
"""
CUE = """
summary: The first observation of an episode gives the right action for the whole episode.
decimation: 1
episode_length_s: 0.06
sim: {dt: 0.01}
scene: {num_envs: 64, entities: {robot: {model: model.xml}}}
agents:
  ppo: {trainer: ppo, algorithm: ppo, max_iterations: 60, num_steps: 12, num_minibatches: 4, num_epochs: 5,
        learning_rate: 3e-3, gamma: 0.5, init_std: 0.3, action_bound: null,
        actor: {hidden: [16]}, critic: {hidden: [16]}}
"""
CUE_TASK = """
import torch
from rlcli.envs.direct import DirectTask

class Task(DirectTask):
    num_observations = 1
    num_actions = 1
    def post_reset(self): self.cue = torch.zeros(self.num_envs)
    def reset_idx(self, env_ids): self.cue[env_ids] = self.draws(env_ids).uniform(-1.0, 1.0, (1,))[:, 0].sign()
    def pre_physics_step(self, actions): self.given = actions.clone()
    def get_observations(self): self.obs_buf[:, 0] = self.cue * (self.progress_buf == 0)
    def calculate_metrics(self): self.rew_buf[:] = -(self.given[:, 0] - self.cue).abs()
    def is_done(self): self.reset_buf[:] = 0
"""


@pytest.fixture
def recurrent_task(scheduled: str) -> str:
    """The scheduled task with a recurrent agent; episodes of different environments end at different steps."""
    file = Path(scheduled) / "task.yaml"
    file.write_text(file.read_text().partition("agents:")[0] + AGENT)
    return scheduled


def make_trainer(task, *overrides, seed=5, env_seed=3):
    resolved = resolve(find_task(task), agent="ppo", overrides=overrides)
    trainer = PpoTrainer(make_env(resolved, seed=env_seed), resolved.agent, seed=seed, device="cpu", torch_threads=1)
    trainer.start()
    return trainer


def test_lstm_matches_torch():
    mine, theirs = Lstm(3, [5, 5]), torch.nn.LSTM(3, 5, num_layers=2)
    with torch.no_grad():
        for number, layer in enumerate(mine.layers):
            for name, value in layer.named_parameters():
                getattr(theirs, f"{name}_l{number}").copy_(value)
        sequence, memory, outputs = torch.randn(7, 4, 3), mine.blank(4), []
        for seen in sequence:
            output, memory = mine(seen, memory)
            outputs.append(output)
        expected, (hidden, cell) = theirs(sequence)
    torch.testing.assert_close(torch.stack(outputs), expected)
    torch.testing.assert_close(memory, torch.cat([hidden[0], cell[0], hidden[1], cell[1]], dim=1))


@pytest.mark.parametrize("shuffle", ["epoch", "none"])
@pytest.mark.parametrize("minibatches", ["num_minibatches=3", "minibatch_size=17"])
def test_update_reproduces_outputs_of_rollout(recurrent_task, shuffle, minibatches):
    trainer = make_trainer(recurrent_task, "scene.num_envs=7", f"agent.shuffle={shuffle}", f"agent.{minibatches}")
    trainer.iterate()  # the next rollout starts in the middle of episodes
    trainer.collector.collect()
    assert any(memory.any() for memory in trainer.collector.initial_hidden_state.values())
    assert trainer.collector.rollout.samples.episode_start.any()
    with torch.no_grad():
        trainer.collector.estimate_advantages()
        trainer.collector.rollout.fill_minibatches(trainer.learner.sample_order())
        for number, batch in enumerate(trainer.collector.rollout.minibatches):
            obs, critic_obs = trainer.learner.network_inputs(batch, number)
            torch.testing.assert_close(trainer.networks.actor(obs), batch.mean)
            torch.testing.assert_close(trainer.networks.value(critic_obs), batch.value)
    seen = torch.cat([batch.log_prob for batch in trainer.collector.rollout.minibatches])
    torch.testing.assert_close(seen.sort().values, trainer.collector.rollout.samples.log_prob.flatten().sort().values)


def test_hidden_state_is_reset_at_episode_start(recurrent_task):
    trainer = make_trainer(recurrent_task)
    trainer.collector.collect()
    samples = trainer.collector.rollout.samples
    # each episode of environment 1 has three steps
    assert samples.episode_start[:, 1].tolist() == [1, 0, 0, 1, 0, 0, 1, 0]
    torch.testing.assert_close(samples.mean[0, 1], samples.mean[3, 1], rtol=0, atol=0)
    torch.testing.assert_close(samples.mean[1, 1], samples.mean[4, 1], rtol=0, atol=0)
    assert not torch.equal(samples.mean[0, 1], samples.mean[1, 1])


def test_time_out_bootstraps_with_hidden_state_of_critic(recurrent_task):
    trainer = make_trainer(recurrent_task, "agent.lam=0.0", "agent.normalize_advantage=null", "agent.gamma=0.9")
    trainer.collector.collect()
    trainer.collector.estimate_advantages()
    recall, networks = trainer.networks.critic_memory, trainer.networks
    memory = recall.blank(1)
    with torch.no_grad():
        for progress in range(4):  # environment 1 has a time-out at its third step
            features, memory = recall(torch.tensor([[float(progress), 1.0]]), memory)
    expected = 13.0 + 0.9 * networks.value(features).item()
    assert trainer.collector.rollout.samples.target[2, 1].item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("overrides", [(), ("agent.normalize_observations=true", "agent.std=scalar")])
def test_state_restores_hidden_states_bit_for_bit(recurrent_task, overrides):
    trainer = make_trainer(recurrent_task, *overrides)
    trainer.iterate()
    state = trainer.state()
    trainer.iterate()
    after = trainer.state()
    other = make_trainer(recurrent_task, *overrides, seed=98, env_seed=99)
    other.load(state)
    other.iterate()
    for part, tensors in after.tensors.items():
        for name, value in tensors.items():
            assert torch.equal(value.nan_to_num(), other.state().tensors[part][name].nan_to_num()), (part, name)


def test_deployed_recurrent_policy_matches_learner(recurrent_task):
    trainer = make_trainer(recurrent_task, "agent.init_std=1e-6")
    trainer.collector.collect()
    means = trainer.collector.rollout.samples.mean.clone()
    env = make_env(resolve(find_task(recurrent_task), agent="ppo"), seed=3)
    act, obs = trained_policy(env, trainer.policy()), env.reset(seed=3)["policy"]
    for t in range(8):
        action = act(obs)
        torch.testing.assert_close(action, means[t].clamp(-1.0, 1.0), rtol=1e-4, atol=1e-5)
        obs = env.step(action).obs["policy"]


def test_fewer_environments_than_minibatches_is_a_config_error(recurrent_task):
    with pytest.raises(ConfigError, match="5 minibatches are too many"):
        make_trainer(recurrent_task, "agent.num_minibatches=5")


def test_recurrent_run_is_resumed_evaluated_and_exported(recurrent_task, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        capfd.readouterr()
        code = main([*arguments, "--json"])
        return code, json.loads(capfd.readouterr().out)

    code, done = run("train", recurrent_task, "--runs-dir", "runs", "--logger", "none")
    assert code == 0
    code, again = run("train", "--resume", done["run"], "--max-iterations", "3")
    assert (code, again["iteration"]) == (0, 3)
    for extra in ((), ("--stochastic",)):
        code, played = run("play", "--checkpoint", done["run"], "--viewer", "none", *extra)
        assert (code, played["episodes"]) == (0, 4)
    code, exported = run("export", "--checkpoint", done["run"], "--format", "numpy")
    assert (code, exported["metadata"]["run"]) == (0, Path(done["run"]).name)
    assert [part["input"] for part in exported["metadata"]["memory"]] == ["h_in", "c_in"]


@pytest.mark.slow
def test_only_recurrent_policy_learns_memory_task(tmp_path):
    folder = tmp_path / "cue"
    folder.mkdir()
    model = (
        "<mujoco><worldbody><body name='b'><joint name='s' type='slide'/><geom size='0.1'/></body></worldbody></mujoco>"
    )
    for name, text in (("task.yaml", CUE), ("task.py", CUE_TASK), ("model.xml", model)):
        (folder / name).write_text(text)
    returns = []
    for overrides in (("agent.rnn={hidden: 16}",), ()):
        trainer = make_trainer(str(folder), *overrides)
        reports = [trainer.iterate() for _ in range(60)]
        returns.append(reports[-1].metrics["Train/mean_reward"])
    # six steps; without an RNN every step but the first has a mean error of about 1
    assert returns[0] > -2.5
    assert returns[1] < -4.0
