"""`rlcli play --env E --episode K` equals that episode of `rlcli eval` bit by bit, or reports its dependencies."""

import json

import pytest
import torch
from support.worlds import CRITTER_TASK, build, critter, edited

from rlcli.evaluation.evaluate import evaluate
from rlcli.replay.episode_from_seed import run_episode, start_episode
from rlcli.replay.episode_recorder import EpisodeRecorder
from rlcli.replay.trajectory import read_trajectory

pytestmark = pytest.mark.usefixtures("empty_folder")

ENVS, ENV_ID, EPISODE, SEED = 5, 3, 4, 11
COMMANDS = {"walk": {"func": "uniform_velocity", "resampling_time_s": [0.1, 0.3], "lin_vel_x": [-1.0, 1.0]}}
EVENTS = {
    "push": None,
    "shove": None,
    "mass": {"func": "randomize_body_mass", "mode": "reset", "range": [0.5, 1.5]},
    "friction": {"func": "randomize_geom_friction", "mode": "startup", "range": [0.5, 1.5]},
    "spin": {"func": "reset_joints_by_offset", "mode": "reset", "joints": ["hip_.."], "position": [-0.2, 0.2],
             "velocity": [-1.0, 1.0]},
}  # fmt: skip
INTERVALS = {
    "push": {"func": "push_by_setting_velocity", "mode": "interval", "interval_range_s": [0.1, 0.3],
             "linear_velocity": [[-1.0, 1.0], [-1.0, 1.0], [0.0, 0.0]]},
    "gravity": {"func": "randomize_gravity", "mode": "interval", "range": [-1, 1], "interval_range_s": [0.1, 0.3],
                "global_time": True},
}  # fmt: skip
SOMETIMES = {"mass": {**EVENTS["mass"], "min_steps_between": 70}}
ASKED = {"policy": {"asked": {"func": "generated_commands", "command": "walk"}}}
OWN = {"func": "noise", "weight": 1.0}
NOISE = {"policy": {"asked": {"func": "joint_vel_rel", "noise": {"kind": "gaussian", "std": 0.1}}}}
CONNECTED = {
    "commands": ({"events": EVENTS, "commands": COMMANDS, "observations": ASKED}, "commands.walk"),
    "intervals": ({"events": {**EVENTS, **INTERVALS}}, "events.gravity"),
    "throttled resets": ({"events": {**EVENTS, **SOMETIMES}}, "events.mass"),
    "noise": ({"events": EVENTS, "observations": NOISE}, "observations.policy.asked"),
}
"""Change of the critter task -> reason why its episodes depend on each other."""


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def policy(env):
    """Return an action function that depends only on all observations."""
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(env.layout.size(), env.layout.action_size, generator=generator)
    return lambda obs: (obs @ weights).tanh()


def make_task_env(task):
    torch.manual_seed(SEED)
    return build(task, ENVS, "episode_length_s=0.3", seed=SEED)


def recorded(task, tmp_path):
    """Record the episode in the whole evaluation and alone: states, actions and rewards of both."""
    env = make_task_env(task)
    whole, count = tmp_path / "whole.safetensors", ENVS * (EPISODE + 1)
    with env.observers.added(EpisodeRecorder(env, count)) as recorder:
        evaluate(env, policy(env), count)
    recorder.save({"all": whole})
    env = make_task_env(task)
    start = start_episode(env, policy(env), ENV_ID, EPISODE)
    with env.observers.added(EpisodeRecorder(env, 1, env_id=ENV_ID)) as recorder:
        run_episode(env, policy(env), start.obs, ENV_ID)
    recorder.save({"all": tmp_path / "one.safetensors"})
    recording = read_trajectory(whole)
    number = [n for n, e in enumerate(recording.header.episodes) if e.env == ENV_ID][EPISODE]
    return parts(recording, number), parts(read_trajectory(tmp_path / "one.safetensors"), 0), start


def parts(recording, number):
    prefix = f"episode.{number}."
    return {n.removeprefix(prefix): v for n, v in recording.tensors.items() if n.startswith(prefix)}


def assert_same(left, right):
    assert left.keys() == right.keys()
    for name, value in left.items():
        assert value.numpy().tobytes() == right[name].numpy().tobytes(), name


@pytest.mark.parametrize("task", ["critter", "cartpole"])
def test_independent_episode_starts_at_once(task, tmp_path):
    place = critter(tmp_path, edited(CRITTER_TASK, events=EVENTS)) if task == "critter" else task
    whole, one, start = recorded(place, tmp_path)
    assert (start.episodes_before, start.reasons, start.shared_draws()) == (0, [], False)
    assert_same(whole, one)


@pytest.mark.parametrize("what", CONNECTED)
def test_dependent_episode_runs_earlier_ones_with_reasons(what, tmp_path):
    change, named = CONNECTED[what]
    task = critter(tmp_path, edited(CRITTER_TASK, **change))
    whole, one, start = recorded(task, tmp_path)
    assert start.episodes_before == EPISODE
    assert named in start.reasons
    assert not [other for _, other in CONNECTED.values() if other != named and other in start.reasons]
    assert_same(whole, one)
    env = make_task_env(task)  # the reason matters: without the earlier episodes it is another episode
    with env.observers.added(EpisodeRecorder(env, 1, env_id=ENV_ID)) as recorder:
        run_episode(env, policy(env), env.reset(seed=SEED, episode=EPISODE)["policy"], ENV_ID)
    recorder.save({"all": tmp_path / "other.safetensors"})
    other = parts(read_trajectory(tmp_path / "other.safetensors"), 0)
    assert whole["qpos"].shape != other["qpos"].shape or not torch.equal(whole["qpos"], other["qpos"])


def test_direct_task_runs_earlier_episodes(tmp_path):
    whole, one, start = recorded("cartpole-direct", tmp_path)
    assert start.episodes_before == EPISODE
    assert start.reasons == ["the class CartpoleTask"]
    assert_same(whole, one)


@pytest.fixture
def sampled_coin(coin):
    """The coin task with draws from torch's global generator, as ported tasks make them."""
    file = coin_file(coin)
    text = file.read_text().replace("self.draws(env_ids).uniform(0.0, 1.0, (1,))[:, 0]", "torch.rand(len(env_ids))")
    file.write_text(text)
    return coin


def coin_file(coin):
    from pathlib import Path

    return Path(coin) / "task.py"


def test_draws_from_torch_depend_on_num_envs_with_a_warning(sampled_coin, cli):
    arguments = ("--policy", "zero", "--env", "3", "--episode", "6", "--num-envs", "5")
    said = cli("play", sampled_coin, *arguments, "--json")
    assert said.code == 0
    assert said.json["shared_draws"] is True
    assert "the episode is only the same with --num-envs 5" in said.err
    whole = cli("eval", sampled_coin, "--policy", "zero", "--num-envs", "5", "--episodes", "35", "--record", "all.st")
    assert whole.code == 0
    mine = [e for e in read_trajectory(coin_file("").parent / "all.st").header.episodes if e.env == 3][6]
    assert (said.json["length"], said.json["ended_by"]) == (mine.length, mine.causes)


def test_reward_that_draws_from_torch_runs_earlier_episodes(tmp_path):
    task = critter(tmp_path, edited(CRITTER_TASK, events=EVENTS, rewards={"noise": OWN}))
    (task / "terms.py").write_text(
        'import torch\n\n\ndef noise(env):\n    """Noise. (num_envs,)"""\n    return torch.rand(env.num_envs)\n'
    )
    whole, one, start = recorded(task, tmp_path)
    assert start.episodes_before == EPISODE
    assert start.shared_draws()
    assert_same(whole, one)


def test_play_episode_equals_the_evaluation(coin, cli):
    message = cli("play", coin, "--policy", "zero", "--env", "40", "--episode", "2", "--record", "one.st", "--json")
    assert message.code == 0
    document = message.json
    assert (document["num_envs"], document["env"], document["episode"], document["lived_before"]) == (41, 40, 2, 2)
    assert cli("replay", "one.st").code == 0
    assert (
        cli("eval", coin, "--policy", "zero", "--num-envs", "41", "--episodes", "123", "--record", "all.st").code == 0
    )
    mine = [e for e in read_trajectory(coin_file("").parent / "all.st").header.episodes if e.env == 40][2]
    assert (document["length"], document["return"], document["ended_by"]) == (
        mine.length,
        mine.total_reward,
        mine.causes,
    )
    assert json.dumps(document)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env", "3"], "--env needs --episode"),
        (["--episode", "3"], "--episode needs --env"),
        (["--env", "3", "--episode", "0", "--num-envs", "3"], "--env 3 does not exist: --num-envs is 3"),
        (["--env", "3", "--episode", "0", "--record-mode", "failed"], "--record-mode"),
    ],
)
def test_invalid_episode_options_are_refused(coin, cli, arguments, message):
    done = cli("play", coin, "--policy", "zero", *arguments)
    assert done.code == 2
    assert message in done.err


@pytest.mark.slow
def test_video_of_one_episode_has_its_frames(cli):
    imageio = pytest.importorskip("imageio.v2")
    arguments = ("--policy", "zero", "--env", "2", "--episode", "3")
    shown = cli("play", "cartpole", *arguments, "--video", "one.gif", "--json")
    assert shown.code == 0, shown.err
    assert shown.json["length"] == cli("play", "cartpole", *arguments, "--json").json["length"]
    frames = imageio.mimread("one.gif")
    assert len(frames) == shown.json["frames"]
    assert shown.json["frames"] > 1
    assert frames[0].std() > 0
    assert (frames[0] != frames[-1]).any()
