"""RSL-RL's PPO as a trainer: equal to RSL-RL itself, equal saved policies, exact resumes."""

import json
import math
from pathlib import Path

import pytest
import torch
from rlcli_rsl_rl.trainer import RslRlTrainer
from rsl_rl.models import MLPModel
from rsl_rl.runners import OnPolicyRunner

from rlcli.adapters.rsl_rl import RslRlVecEnv
from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli.rl.policy import load_policy

SMALL = ("scene.num_envs=6", "episode_length_s=0.2", "agent.num_steps_per_env=16", "agent.max_iterations=9")
CRITIC = "observations.critic={x: {func: joint_pos}, v: {func: joint_vel}, torque: {func: last_action}}"
NEW_FORM = (
    "agent.policy=null",
    "agent.actor={hidden_dims: [32, 32], distribution_cfg: {init_std: 1.0}}",
    "agent.critic={hidden_dims: [32, 32]}",
)
LSTM = (
    "agent.policy.class_name=ActorCriticRecurrent",
    "agent.policy.rnn_hidden_dim=5",
    "agent.policy.rnn_num_layers=2",
    "agent.algorithm.num_mini_batches=2",
)
NORMALIZED = ("agent.policy.actor_obs_normalization=true", "agent.policy.critic_obs_normalization=true")
CURIOUS = (
    "agent.algorithm.rnd_cfg={weight: 3.0, num_outputs: 4, predictor_hidden_dims: [8], target_hidden_dims: [8],"
    " reward_normalization: true, state_normalization: true,"
    " weight_schedule: {mode: linear, initial_step: 4, final_step: 40, final_value: 0.5}}",
)
MIRROR = '''"""The cart and the pole, seen in a mirror."""

import torch


def mirror(env, obs, actions):
    assert env.unwrapped.num_envs == 6
    if obs is not None:
        twice = obs.repeat(2)
        twice["policy"][obs.batch_size[0]:] *= -1.0
        obs = twice
    return obs, None if actions is None else torch.cat([actions, -actions])
'''


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def trainer_of(*overrides, task="cartpole", seed=5):
    resolved = resolve(find_task(str(task)), agent="rsl-rl", overrides=[*SMALL, *overrides])
    trainer = RslRlTrainer(make_env(resolved, seed=3), resolved.agent, seed=seed, device="cpu", torch_threads=1)
    trainer.start()
    return trainer


def bits(trainer):
    state = trainer.state()
    return {f"{part}.{name}": value for part, values in state.tensors.items() for name, value in values.items()}


def same(first, second):
    assert first.keys() == second.keys()
    return [name for name, value in first.items() if not torch.equal(value.nan_to_num(), second[name].nan_to_num())]


RUNNER = {
    "num_steps_per_env": 16,
    "save_interval": 50,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": {
        "class_name": "MLPModel",
        "hidden_dims": [32, 32],
        "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0},
    },
    "critic": {"class_name": "MLPModel", "hidden_dims": [32, 32]},
    "algorithm": {"class_name": "PPO", "entropy_coef": 0.005},
}


def test_iterations_equal_rsl_rl_runner_bit_for_bit(capsys):
    trainer = trainer_of("agent.bootstrap=pre_step")
    ours = bits(trainer)
    for _ in range(3):
        trainer.iterate()
    env = make_env(resolve(find_task("cartpole"), agent="rsl-rl", overrides=list(SMALL)), seed=3)
    runner = OnPolicyRunner(RslRlVecEnv(env), RUNNER, device="cpu")
    runner.alg.actor.load_state_dict({n[14:]: v for n, v in ours.items() if n.startswith("trainer.actor.")})
    runner.alg.critic.load_state_dict({n[15:]: v for n, v in ours.items() if n.startswith("trainer.critic.")})
    torch.set_rng_state(ours["rng.torch"])
    runner.learn(3)
    assert same(trainer.alg.actor.state_dict(), runner.alg.actor.state_dict()) == []
    assert same(trainer.alg.critic.state_dict(), runner.alg.critic.state_dict()) == []
    assert trainer.alg.learning_rate == runner.alg.learning_rate != 1e-3


def test_both_forms_of_settings_give_same_agent():
    after = []
    for form in ((), NEW_FORM):
        trainer = trainer_of(*form)
        trainer.iterate()
        after.append(bits(trainer))
    assert same(*after) == []


def test_shipped_settings_reach_rsl_rl():
    alg = trainer_of().alg
    assert [layer.out_features for layer in alg.actor.mlp if hasattr(layer, "out_features")] == [32, 32, 1]
    assert (alg.gamma, alg.lam, alg.clip_param, alg.entropy_coef) == (0.99, 0.95, 0.2, 0.005)
    assert (alg.num_learning_epochs, alg.num_mini_batches, alg.schedule, alg.desired_kl) == (5, 4, "adaptive", 0.01)
    assert (alg.value_loss_coef, alg.max_grad_norm, alg.use_clipped_value_loss) == (1.0, 1.0, True)


@pytest.mark.parametrize("bootstrap", ["final_obs", "pre_step"])
@pytest.mark.parametrize("extra", [(), LSTM])
def test_time_out_bootstraps_as_configured(monkeypatch, bootstrap, extra):
    trainer = trainer_of(f"agent.bootstrap={bootstrap}", *extra)
    with torch.no_grad():
        for parameter in trainer.alg.critic.parameters():
            parameter.mul_(4.0)  # make the values of observations differ
    steps, outcomes, step = [], [], trainer.env.step

    def recorded_step(action):
        steps.append(step(action))
        outcomes.append((steps[-1].reward.clone(), steps[-1].truncated & ~steps[-1].terminated))
        return steps[-1]

    monkeypatch.setattr(trainer.env, "step", recorded_step)
    values, memories = [], []
    act, process = trainer.alg.act, trainer.alg.process_env_step

    def recorded_act(obs):
        action = act(obs)
        values.append(trainer.alg.transition.values.squeeze(-1).clone())
        memory = trainer.alg.critic.get_hidden_state()
        memories.append(None if memory is None else tuple(part.clone() for part in memory))
        return action

    kept = []

    def recorded_process(obs, rewards, dones, extras):
        final = steps[-1].final_obs
        if final is not None:
            trainer.alg.critic.reset(hidden_state=memories[-1])
            with torch.no_grad():
                after = trainer.alg.critic(trainer._adapter.observations(final)).squeeze(-1)
            trainer.alg.critic.reset(hidden_state=memories[-1])
        else:
            after = torch.zeros(6)
        result = process(obs, rewards, dones, extras)
        kept.append((trainer.alg.storage.rewards[len(kept)].squeeze(-1).clone(), after))
        return result

    monkeypatch.setattr(trainer.alg, "act", recorded_act)
    monkeypatch.setattr(trainer.alg, "process_env_step", recorded_process)
    trainer._collect()
    ended = 0
    for (plain, cut), (reward, after), before in zip(outcomes, kept, values, strict=True):
        value = after if bootstrap == "final_obs" else before
        expected = plain + 0.99 * torch.where(cut, value, 0.0)
        torch.testing.assert_close(reward, expected, rtol=0, atol=1e-6)
        ended += int(cut.sum())
        assert not cut.any() or not torch.allclose(after[cut], before[cut], atol=1e-4)
    assert ended == 6


@pytest.mark.parametrize("extra", [(), NORMALIZED, LSTM, (*LSTM, *NORMALIZED), ("agent.policy.noise_std_type=log",)])
def test_saved_policy_equals_rsl_rl_actor(extra):
    trainer = trainer_of(*extra)
    for _ in range(3):
        trainer.iterate()
    state = trainer.state()
    saved = load_policy(state.values["policy"], state.tensors["policy"])
    actor, memory = trainer.alg.get_policy(), None
    actor.reset()
    for scale in (0.1, 1.0, 30.0):
        obs = torch.randn(6, 4) * scale
        with torch.no_grad():
            theirs = actor(trainer._adapter.observations({"policy": obs}))
            ours, memory = saved.step(obs, memory)
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
    actor.distribution.update(torch.zeros(1, 1))
    assert saved.log_std.exp().tolist() == pytest.approx(actor.output_std[0].tolist(), rel=1e-5)


@pytest.mark.parametrize(
    "extra", [(), (*NORMALIZED, CRITIC), LSTM, CURIOUS, ("agent.algorithm.optimizer=sgd",)],
    ids=["plain", "normalized", "lstm", "curious", "sgd"],
)  # fmt: skip
def test_resume_continues_bit_for_bit(extra):
    trainer = trainer_of(*extra)
    trainer.iterate()
    trainer.iterate()
    state = trainer.state()
    metrics = trainer.iterate().metrics
    other = trainer_of(*extra, seed=77)
    other.load(json_round_trip(state))
    again = other.iterate().metrics
    assert {k: v for k, v in metrics.items() if k[:4] != "Perf"} == {k: v for k, v in again.items() if k[:4] != "Perf"}
    assert same(bits(trainer), bits(other)) == []
    assert trainer.state().values == other.state().values


def json_round_trip(state):
    state.values = json.loads(json.dumps(state.values))
    return state


@pytest.mark.parametrize("extra", [(), NORMALIZED, LSTM])
def test_load_weights_gives_same_policy(extra):
    trainer = trainer_of(*extra)
    trainer.iterate()
    wanted = trainer.state().tensors["policy"]
    other = trainer_of(*extra, seed=8)
    other.load_weights(wanted)
    found = other.state().tensors["policy"]
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-6)


def test_critic_observes_its_own_group():
    assert trainer_of(CRITIC).alg.critic.obs_dim == 5
    both = trainer_of(CRITIC, "agent.obs_groups={policy: [policy], critic: [policy, critic]}")
    assert (both.alg.actor.obs_dim, both.alg.critic.obs_dim) == (4, 9)
    both.iterate()


def test_curiosity_rewards_new_states_and_follows_schedule():
    trainer = trainer_of(*CURIOUS)
    first = trainer.iterate().metrics
    assert first["Loss/rnd"] > 0.0
    dt = trainer.env.step_dt
    assert first["Rnd/weight"] == pytest.approx(3.0 * dt + (0.5 - 3.0 * dt) * 12 / 36)
    trainer.iterate()
    assert trainer.iterate().metrics["Rnd/weight"] == 0.5


def test_symmetry_makes_policy_odd(tmp_path):
    source = find_task("cartpole").root
    for file in ("task.yaml", "cartpole.xml"):
        (tmp_path / file).write_text((source / file).read_text())
    (tmp_path / "mirrored.py").write_text(MIRROR)
    setting = (
        "agent.algorithm.symmetry_cfg={data_augmentation_func: 'mirrored.py:mirror', use_data_augmentation: true,"
        " use_mirror_loss: true, mirror_loss_coeff: 20.0}"
    )

    def oddness(*overrides):
        trainer = trainer_of(*overrides, task=tmp_path)
        for _ in range(8):
            report = trainer.iterate()
        obs = torch.randn(64, 4, generator=torch.Generator().manual_seed(0))
        policy = trainer.policy()
        return float((policy(obs) + policy(-obs)).abs().mean()), report.metrics

    (plain, _), (mirrored, metrics) = oddness(), oddness(setting)
    assert mirrored < 0.3 * plain
    assert metrics["Loss/symmetry"] < 0.1


def test_actions_are_clipped_to_clip_actions(monkeypatch):
    trainer = trainer_of("agent.clip_actions=0.05")
    taken, step = [], trainer.env.step
    monkeypatch.setattr(trainer.env, "step", lambda action: taken.append(action) or step(action))
    trainer.iterate()
    assert float(torch.stack(taken).abs().max()) == pytest.approx(0.05)
    assert trainer.policy().spec.action_bound == 0.05
    assert trainer_of().policy().spec.action_bound is None


def test_ignored_settings_are_reported_once(caplog):
    trainer = trainer_of("agent.seed=7", "agent.logger=wandb", "agent.device=cuda:0")
    trainer.iterate()
    first, _ = [record.message for record in caplog.records if record.name.startswith("rlcli")]
    assert "seed" in first
    assert "--seed" in first


@pytest.mark.parametrize(
    ("overrides", "place", "words"),
    [
        (["agent.algorithm.gama=0.9"], "algorithm.gama", "gamma"),
        (["agent.policy.activation=sigmoid"], "policy.activation", "elu"),
        (["agent.policy.rnn_type=gru"], "policy.rnn_type", "lstm"),
        (["agent.actor={hidden_dims: [4]}"], "agents.rsl-rl", "older form"),
        (["agent.algorithm.desired_kl=null"], "agents.rsl-rl", "desired_kl"),
        (["agent.algorithm.class_name=Distillation"], "algorithm", "teacher"),
        (["agent.clip_actions=1.0", "agent.action_bound=2.0"], "agents.rsl-rl", "set the same value"),
    ],
)
def test_invalid_settings_are_refused_without_heavy_imports(overrides, place, words):
    with pytest.raises(ConfigError) as caught:
        resolve(find_task("cartpole"), agent="rsl-rl", overrides=overrides)
    assert place in str(caught.value.problems)
    assert words in str(caught.value.problems)


@pytest.mark.parametrize(
    ("overrides", "place", "words"),
    [
        (["agent.obs_groups={critic: [camera]}"], "obs_groups.critic", "camera"),
        (["agent.obs_groups={teacher: [policy]}"], "obs_groups.teacher", "sets: "),
        ([CRITIC, "agent.obs_groups={policy: [critic]}"], "obs_groups.policy", "only the observation group 'policy'"),
        (["agent.algorithm.num_mini_batches=90"], "algorithm.num_mini_batches", "96 samples"),
        (
            ["agent.algorithm.symmetry_cfg={data_augmentation_func: 'rlcli.random:nothing'}"],
            "data_augmentation_func",
            "rlcli.random",
        ),
    ],
)
def test_settings_that_do_not_fit_env_name_their_key(overrides, place, words):
    with pytest.raises(ConfigError) as caught:
        trainer_of(*overrides)
    assert place in str(caught.value.problems)
    assert words in str(caught.value.problems)


@pytest.mark.parametrize("reference", ["stranger:mirror", "stranger.mirror", "{folder}/stranger.py:mirror"])
def test_symmetry_function_is_imported_only_from_task_and_plugins(reference, tmp_path, monkeypatch):
    (tmp_path / "stranger.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\ndef mirror(**_): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    named = reference.format(folder=tmp_path)
    with pytest.raises(ConfigError, match=r"belongs neither|is outside"):
        trainer_of(f"agent.algorithm.symmetry_cfg={{data_augmentation_func: '{named}'}}")
    assert not (tmp_path / "ran").exists()


def test_ppo_alone_uses_rsl_rl_defaults():
    overrides = [*SMALL, "agent.algorithm=ppo", "agent.policy=null", "agent.experiment_name=null"]
    agent = resolve(find_task("cartpole"), agent="rsl-rl", overrides=[*overrides[:-1]]).agent
    actor, critic = agent.networks
    assert (actor.hidden_dims, critic.hidden_dims, agent.algorithm.entropy_coef) == ([256] * 3, [256] * 3, 0.01)
    assert actor.distribution_cfg.init_std == 1.0
    assert MLPModel.__init__.__defaults__[0] == (256, 256, 256)


def rlcli(capsys, *words, code=0):
    assert main([str(word) for word in words]) == code
    return capsys.readouterr()


def test_run_is_played_exported_resumed_without_pickle(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ("--agent", "rsl-rl", "--num-envs", 8, "--logger", "none", "-q")
    run = rlcli(capsys, "train", "cartpole", *small, "--max-iterations", 2, *NORMALIZED, "agent.save_interval=1").out
    run = Path(run.strip().splitlines()[-1])
    endings = {file.suffix for file in run.rglob("*") if file.is_file()}
    assert endings <= {".safetensors", ".json", ".jsonl", ".yaml", ""}
    assert {folder.name for folder in (run / "checkpoints").iterdir() if folder.is_dir()} == {
        f"{step:012d}" for step in (0, 128, 256)
    }
    rlcli(capsys, "eval", "cartpole", "--checkpoint", run, "--episodes", 4, "--num-envs", 4)
    rlcli(capsys, "export", "cartpole", "--checkpoint", run, "--format", "torch", "--output", tmp_path / "p.pt2")
    assert (tmp_path / "p.pt2").is_file()
    rlcli(capsys, "train", "--resume", run, "--max-iterations", 4, "-q")
    straight = rlcli(capsys, "train", "cartpole", *small, "--max-iterations", 4, *NORMALIZED).out.strip()
    newest = [Path(folder) / "checkpoints" / f"{512:012d}" for folder in (run, straight)]
    for part in ("policy", "trainer", "env", "rng"):
        assert len({(folder / f"{part}.safetensors").read_bytes() for folder in newest}) == 1, part


def test_checkpoint_of_other_trainer_is_refused_with_names(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ("--num-envs", 8, "--max-iterations", 1, "--logger", "none", "-q")
    run = Path(rlcli(capsys, "train", "cartpole", "--agent", "rsl-rl", *small).out.strip())
    error = rlcli(capsys, "train", "cartpole", "--agent", "sac", *small, "--init-from", run, code=5).err
    assert "'rsl-rl'" in error
    assert "'sb3'" in error
    assert "squashed-gaussian-mlp" in error
    step = next(folder for folder in (run / "checkpoints").iterdir() if folder.name == f"{128:012d}")
    manifest = json.loads((step / "manifest.json").read_text())
    assert manifest["trainer"] == "rsl-rl"
    (step / "manifest.json").write_text(json.dumps({**manifest, "trainer": "sb3"}))
    error = rlcli(capsys, "train", "--resume", run, "--max-iterations", 2, code=5).err
    assert "a checkpoint of trainer 'sb3'" in error
    assert "the run's agent uses 'rsl-rl'" in error


def test_init_from_other_trainer_with_same_policy_form(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ("--num-envs", 8, "--max-iterations", 1, "--logger", "none", "-q")
    first = rlcli(capsys, "train", "cartpole", "--agent", "sb3-ppo", *small).out.strip()
    rlcli(capsys, "train", "cartpole", "--agent", "rsl-rl", *small, "--init-from", first)


@pytest.mark.slow
def test_shipped_settings_learn_to_balance(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("train", "cartpole", "--agent", "rsl-rl", "--num-envs", 1024, "--logger", "none", "-q", "--seed", 1)
    run = rlcli(capsys, *words).out.strip()
    done = rlcli(capsys, "eval", "cartpole", "--checkpoint", run, "--episodes", 200, "--json").out
    assert json.loads(done)["success"]["rate"] > 0.95
    assert math.isfinite(json.loads(done)["return"]["mean"])
