"""rl_games' PPO and SAC as trainers: equal to rl_games itself, equal saved policies, exact resumes."""

import contextlib
import io
import json
from pathlib import Path

import pytest
import torch
from rlcli_rl_games.trainer import make_trainer

from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli.rl.policy import load_policy

PPO = (
    "scene.num_envs=6",
    "episode_length_s=0.2",
    "agent.params.config.minibatch_size=24",
    "agent.params.config.mini_epochs=2",
    "agent.max_iterations=9",
)
CRITIC = "observations.critic={x: {func: joint_pos}, v: {func: joint_vel}, torque: {func: last_action}}"
CENTRAL = (
    "agent.params.config.central_value_config={network: {name: actor_critic, central_value: true, mlp: {units: [8],"
    " activation: elu}}, learning_rate: 1e-3, lr_schedule: linear, mini_epochs: 2, minibatch_size: 24,"
    " clip_value: true, normalize_input: true, truncate_grads: true}"
)
SAC = """
agents:
  rl-games:
    trainer: rl-games
    algorithm: sac
    params:
      algo: {name: sac}
      model: {name: soft_actor_critic}
      network:
        name: soft_actor_critic
        separate: true
        space: {continuous: }
        mlp: {units: [16, 8], activation: relu, initializer: {name: default}}
        log_std_bounds: [-5, 2]
      config:
        name: Cartpole
        normalize_input: true
        reward_shaper: {scale_value: 1.0}
        max_epochs: 9
        num_steps_per_episode: 8
        num_warmup_steps: 2
        num_seed_steps: 5
        gamma: 0.99
        init_alpha: 1.0
        learnable_temperature: true
        alpha_lr: 0.005
        actor_lr: 0.0005
        critic_lr: 0.0005
        critic_tau: 0.005
        batch_size: 32
        replay_buffer_size: 150
        num_actors: 64
"""
SMALL_SAC = PPO[:2]


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def sac_task(tmp_path):
    """Return the manager-based cartpole with an agent of rl_games' SAC."""
    root, folder = find_task("cartpole").root, tmp_path / "pole"
    folder.mkdir()
    (folder / "task.yaml").write_text((root / "task.yaml").read_text().partition("agents:")[0] + SAC)
    (folder / "cartpole.xml").write_text((root / "cartpole.xml").read_text())
    return folder


@pytest.fixture
def asymmetric(tmp_path):
    """Return the manager-based cartpole with privileged observations for the critic."""
    root, folder = find_task("cartpole").root, tmp_path / "pole"
    folder.mkdir()
    agents = (root / "direct.yaml").read_text().partition("agents:")[2]
    (folder / "task.yaml").write_text((root / "task.yaml").read_text().partition("agents:")[0] + "agents:" + agents)
    (folder / "cartpole.xml").write_text((root / "cartpole.xml").read_text())
    return folder


def trainer_of(*overrides, task="cartpole-direct", seed=5, small=PPO):
    resolved = resolve(find_task(str(task)), agent="rl-games", overrides=[*small, *overrides])
    trainer = make_trainer(make_env(resolved, seed=3), resolved.agent, seed=seed, device="cpu", torch_threads=1)
    trainer.start()
    return trainer


def bits(trainer):
    state = trainer.state()
    return {f"{part}.{name}": value for part, values in state.tensors.items() for name, value in values.items()}


def differing(first, second):
    assert first.keys() == second.keys()
    return [name for name, value in first.items() if not torch.equal(value.nan_to_num(), second[name].nan_to_num())]


def outcomes_of(trainer, monkeypatch):
    """Return per step: reward, truncated, terminated, and last observations."""
    seen, step = [], trainer.env.step

    def record_step(action):
        result = step(action)
        cut = result.truncated & ~result.terminated
        final = None if result.final_obs is None else result.final_obs["policy"].clone()
        seen.append((result.reward.clone(), cut.clone(), result.terminated.clone(), final))
        return result

    monkeypatch.setattr(trainer.env, "step", record_step)
    return seen


def test_iterations_equal_rl_games_loop_bit_for_bit(tmp_path):
    ours = trainer_of("agent.bootstrap=pre_step")
    for _ in range(3):
        ours.iterate()
    theirs = trainer_of("agent.bootstrap=pre_step")
    agent = theirs.agent
    agent.nn_dir, agent.max_epochs = str(tmp_path), 3
    with contextlib.redirect_stdout(io.StringIO()):
        agent.train()
    assert agent.epoch_num == 3
    assert differing(dict(ours.agent.model.state_dict()), dict(agent.model.state_dict())) == []
    assert ours.agent.last_lr == agent.last_lr != 3e-4


def test_oige_settings_reach_rl_games():
    agent = trainer_of().agent
    assert (agent.gamma, agent.tau, agent.e_clip, agent.critic_coef, agent.bounds_loss_coef) == (
        0.99,
        0.95,
        0.2,
        4,
        1e-4,
    )
    assert (agent.horizon_length, agent.grad_norm, agent.truncate_grads, agent.clip_value) == (16, 1.0, True, True)
    assert (agent.normalize_input, agent.normalize_value, agent.normalize_advantage) == (True, True, True)
    assert (agent.is_adaptive_lr, agent.kl_threshold, agent.last_lr, agent.schedule_type) == (
        True,
        0.008,
        3e-4,
        "legacy",
    )
    resolved = resolve(find_task("cartpole-direct"), agent="rl-games")
    assert (resolved.agent.max_iterations, resolved.agent.save_interval) == (100, 25)
    assert resolved.agent.params.config.minibatch_size == 8192


def test_agent_with_a_separate_critic_differs_from_oige_in_four_settings():
    agents = [resolve(find_task("cartpole-direct"), agent=name).agent for name in ("rl-games", "rl-games-separate")]
    assert [agent.max_iterations for agent in agents] == [100, 150]
    oige, separate = (agent.params for agent in agents)
    assert (oige.network.separate, separate.network.separate) == (False, True)
    changed = {"lr_schedule": "linear", "learning_rate": 1e-2}
    assert separate.config.model_dump() == {**oige.config.model_dump(), **changed}
    assert separate.network.mlp == oige.network.mlp


@pytest.mark.parametrize("bootstrap", ["final_obs", "pre_step", "none"])
def test_time_out_bootstraps_as_configured(monkeypatch, bootstrap):
    trainer = trainer_of(f"agent.bootstrap={bootstrap}", "agent.params.config.reward_shaper={scale_value: 0.5}")
    with torch.no_grad():
        trainer.agent.model.a2c_network.value.weight.mul_(20.0)
    seen = outcomes_of(trainer, monkeypatch)
    agent = trainer.agent
    agent.set_eval()
    with torch.no_grad():
        agent.play_steps()
        columns = agent.experience_buffer.tensor_dict
        cuts = 0
        for step, (reward, cut, _, final) in enumerate(seen):
            expected = 0.5 * reward
            if final is not None and bootstrap == "final_obs":
                expected = expected + 0.99 * torch.where(cut, agent.get_values({"obs": final}).squeeze(1), 0.0)
            if bootstrap == "pre_step":
                expected = expected + 0.99 * torch.where(cut, columns["values"][step].squeeze(1), 0.0)
            torch.testing.assert_close(columns["rewards"][step].squeeze(1), expected)
            cuts += int(cut.sum())
    assert cuts > 0


def test_value_bootstrap_false_disables_bootstrap():
    assert trainer_of("agent.params.config.value_bootstrap=false").bootstrap == "none"


@pytest.mark.parametrize("bootstrap", ["final_obs", "pre_step", "none"])
def test_sac_stores_time_outs_as_configured(monkeypatch, sac_task, bootstrap):
    trainer = trainer_of(f"agent.bootstrap={bootstrap}", task=sac_task, small=SMALL_SAC)
    seen = outcomes_of(trainer, monkeypatch)
    trainer.iterate()
    trainer.iterate()
    buffer, cuts = trainer.agent.replay_buffer, 0
    for step, (_, cut, terminated, final) in enumerate(seen):
        rows = slice(6 * step, 6 * step + 6)
        ends = terminated | cut if bootstrap == "none" else terminated
        assert torch.equal(buffer.dones[rows].squeeze(1), ends)
        if bool(cut.any()) and bootstrap != "none":
            wanted = final if bootstrap == "final_obs" else buffer.obses[rows]
            assert torch.equal(buffer.next_obses[rows][cut], wanted[cut])
        cuts += int(cut.sum())
    assert cuts == 6


@pytest.mark.parametrize(
    "extra", [(), ("agent.params.network.separate=true", "agent.params.config.normalize_input=false")]
)
def test_saved_policy_equals_rl_games_actor(extra):
    trainer = trainer_of(*extra)
    for _ in range(3):
        trainer.iterate()
    state = trainer.state()
    saved, model = load_policy(state.values["policy"], state.tensors["policy"]), trainer.agent.model.eval()
    for scale in (0.1, 1.0, 30.0):
        obs = torch.randn(6, 4) * scale
        with torch.no_grad():
            theirs = model({"is_train": False, "obs": obs})
        torch.testing.assert_close(saved(obs), theirs["mus"].clamp(-1.0, 1.0), rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(saved.log_std.exp().expand(6, 1), theirs["sigmas"], rtol=1e-5, atol=1e-5)


def test_saved_sac_policy_equals_rl_games_actor(sac_task):
    trainer = trainer_of("agent.action_bound=0.7", task=sac_task, small=SMALL_SAC)
    for _ in range(4):
        trainer.iterate()
    state = trainer.state()
    saved, agent = load_policy(state.values["policy"], state.tensors["policy"]), trainer.agent
    agent.set_eval()
    for scale in (0.1, 1.0, 30.0):
        obs = torch.randn(6, 4) * scale
        with torch.no_grad():
            torch.testing.assert_close(saved(obs), agent.act(obs, (1,)), rtol=1e-5, atol=1e-5)
            spread = agent.model.actor(agent.model.norm_obs(obs)).base_dist.stddev
            features = saved.actor[:-1](saved.normalizer(obs))
            torch.testing.assert_close(saved._log_std(features).exp(), spread, rtol=1e-5, atol=1e-5)


def resumed(make):
    trainer = make(5)
    for _ in range(3):
        trainer.iterate()
    state = trainer.state()
    state.values = json.loads(json.dumps(state.values))
    expected = [trainer.iterate().metrics for _ in range(2)]
    other = make(77)
    other.load(state)
    assert [other.iterate().metrics for _ in range(2)] == expected
    assert differing(bits(trainer), bits(other)) == []
    assert json.dumps(trainer.state().values) == json.dumps(other.state().values)


@pytest.mark.parametrize(
    "extra",
    [
        (),
        ("agent.params.config.lr_schedule=linear",),
        ("agent.params.config.lr_schedule=null", "agent.params.config.bounds_loss_coef=null"),
        ("agent.params.config.schedule_type=standard",),
    ],
)
def test_resume_continues_bit_for_bit(extra):
    resumed(lambda seed: trainer_of(*extra, seed=seed))


def test_resume_with_central_value_continues_bit_for_bit(asymmetric):
    resumed(lambda seed: trainer_of(CRITIC, CENTRAL, task=asymmetric, seed=seed))


def test_sac_resume_continues_bit_for_bit(sac_task):
    resumed(lambda seed: trainer_of(task=sac_task, seed=seed, small=SMALL_SAC))


def test_ant_agent_trains_with_sac():
    small = ("scene.num_envs=4", "agent.params.config.num_warmup_steps=1", "agent.params.config.batch_size=16")
    small += ("agent.params.config.replay_buffer_size=500", "agent.params.network.mlp.units=[8, 8]")
    resolved = resolve(find_task("ant-direct"), agent="rl-games-sac", overrides=small)
    trainer = make_trainer(make_env(resolved, seed=3), resolved.agent, seed=1, device="cpu", torch_threads=1)
    trainer.start()
    before = dict(trainer.policy().state_dict())
    assert trainer.iterate().metrics["Loss/critic"] > 0.0
    assert "actor.0.weight" in differing(before, dict(trainer.policy().state_dict()))


def test_central_value_observes_critic_group(asymmetric):
    trainer = trainer_of(CRITIC, CENTRAL, task=asymmetric)
    before = {name: value.clone() for name, value in trainer.agent.central_value_net.state_dict().items()}
    trainer.iterate()
    assert trainer.agent.central_value_net.model.running_mean_std.running_mean.shape == (5,)
    moved = differing(before, dict(trainer.agent.central_value_net.state_dict()))
    assert {"model.a2c_network.value.weight", "model.a2c_network.actor_mlp.0.weight"} <= set(moved)


def test_load_weights_gives_same_policy(sac_task):
    for make in (
        lambda seed: trainer_of(seed=seed),
        lambda seed: trainer_of(task=sac_task, seed=seed, small=SMALL_SAC),
    ):
        trainer = make(1)
        for _ in range(3):
            trainer.iterate()
        wanted = trainer.state().tensors["policy"]
        other = make(8)
        other.load_weights(wanted)
        found = other.state().tensors["policy"]
        assert found.keys() == wanted.keys()
        for name, value in wanted.items():
            torch.testing.assert_close(found[name], value)


@pytest.mark.parametrize(
    ("overrides", "place", "words"),
    [
        (["agent.params.config.horison_length=8"], "params.config.horison_length", "horizon_length"),
        (["agent.params.network.mlp.activation=selu"], "params.network.mlp.activation", "elu"),
        (["agent.params.network.rnn={name: lstm}"], "params.network.rnn", "rnn"),
        (["agent.params.config.mixed_precision=true"], "params.config.mixed_precision", "false"),
        (["agent.params.algo.name=sac"], "agents.rl-games.params", "algorithm ppo"),
        (["agent.algorithm=a2c_discrete"], "algorithm", "discrete actions"),
        (["agent.algorithm=a2c_continuous"], "algorithm", "this algorithm ppo"),
        (["agent.action_bound=2.0"], "agents.rl-games", "clip_actions"),
        (["agent.params.config.minibatch_size_per_env=4"], "params.config", "found both"),
    ],
)
def test_invalid_settings_are_refused_without_heavy_imports(overrides, place, words):
    with pytest.raises(ConfigError) as caught:
        resolve(find_task("cartpole-direct"), agent="rl-games", overrides=overrides)
    assert place in str(caught.value.problems)
    assert words.lower() in str(caught.value.problems).lower()


@pytest.mark.parametrize(
    ("overrides", "place", "words"),
    [
        (["agent.params.config.minibatch_size=25"], "params.config.minibatch_size", "16 x 6 = 96"),
        ([CENTRAL], "params.config.central_value_config", "observation group 'critic'"),
    ],
)
def test_settings_that_do_not_fit_env_name_their_key(overrides, place, words):
    with pytest.raises(ConfigError) as caught:
        trainer_of(*overrides)
    assert place in str(caught.value.problems)
    assert words in str(caught.value.problems)


def test_clip_actions_false_gives_unbounded_policy():
    resolved = resolve(
        find_task("cartpole-direct"), agent="rl-games", overrides=["agent.params.config.clip_actions=false"]
    )
    assert resolved.agent.action_bound is None
    assert resolve(find_task("cartpole-direct"), agent="rl-games").agent.action_bound == 1.0


def rlcli(capsys, *words, code=0):
    assert main([str(word) for word in words]) == code
    return capsys.readouterr()


def test_run_is_played_exported_resumed_without_pickle(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ("--agent", "rl-games", "--num-envs", 8, "--logger", "none", "-q", "agent.params.config.minibatch_size=64")
    run = rlcli(capsys, "train", "cartpole-direct", *small, "--max-iterations", 2).out
    run = Path(run.strip())
    assert {file.suffix for file in tmp_path.rglob("*") if file.is_file()} <= {
        ".safetensors", ".json", ".jsonl", ".yaml", "",
    }  # fmt: skip
    rlcli(capsys, "eval", "cartpole-direct", "--checkpoint", run, "--episodes", 4, "--num-envs", 4)
    words = ("export", "cartpole-direct", "--checkpoint", run, "--format", "torch", "--output", tmp_path / "p.pt2")
    rlcli(capsys, *words)
    assert (tmp_path / "p.pt2").is_file()
    rlcli(capsys, "train", "--resume", run, "--max-iterations", 4, "-q")
    straight = rlcli(capsys, "train", "cartpole-direct", *small, "--max-iterations", 4).out.strip()
    newest = [Path(folder) / "checkpoints" / f"{512:012d}" for folder in (run, straight)]
    for part in ("policy", "trainer", "env", "rng"):
        assert len({(folder / f"{part}.safetensors").read_bytes() for folder in newest}) == 1, part


def test_sac_run_is_evaluated_with_its_own_std(tmp_path, sac_task, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("train", "./pole", "--num-envs", 8, "--logger", "none", "-q", "--max-iterations", 4)
    run = rlcli(capsys, *words).out.strip()
    rlcli(capsys, "eval", "./pole", "--checkpoint", run, "--episodes", 4, "--num-envs", 4, "--stochastic")


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "seed", "bar"), [("rl-games", 0, 0.9), ("rl-games-separate", 42, 0.99)])
def test_agent_learns_to_balance(tmp_path, capsys, monkeypatch, agent, seed, bar):
    monkeypatch.chdir(tmp_path)
    words = ("--agent", agent, "--seed", seed, "--logger", "none", "-q")
    run = rlcli(capsys, "train", "cartpole-direct", *words).out.strip()
    done = rlcli(capsys, "eval", "cartpole-direct", "--checkpoint", run, "--episodes", 1000, "--json").out
    assert json.loads(done)["success"]["rate"] > bar
