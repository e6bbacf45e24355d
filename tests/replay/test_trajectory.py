"""`--record` and `rlcli replay`: whole episodes in a file, simulated again bit by bit."""

import json
import os
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from support.worlds import CRITTER, CRITTER_TASK, build, critter, edited

from rlcli.errors import CheckpointError
from rlcli.evaluation.evaluate import evaluate
from rlcli.replay.episode_recorder import EpisodeRecorder
from rlcli.replay.resimulate import replay_episodes
from rlcli.replay.trajectory import content_digest, read_trajectory
from rlcli.rl.action_functions import random_policy

pytestmark = pytest.mark.usefixtures("empty_folder")

EVENTS = {
    "mass": {"func": "randomize_body_mass", "mode": "reset", "range": [0.5, 1.5]},
    "friction": {"func": "randomize_geom_friction", "mode": "startup", "range": [0.5, 1.5]},
    "gravity": {"func": "randomize_gravity", "mode": "interval", "range": [-1, 1], "interval_range_s": [0.1, 0.3],
                "global_time": True},
    "hit": {"func": "apply_body_impulse", "mode": "interval", "interval_range_s": [0.1, 0.2], "bodies": "torso",
            "force": [-5.0, 5.0], "duration_s": [0.02, 0.1]},
}  # fmt: skip
"""Randomness apart from the policy, which a replay must reproduce."""


@pytest.fixture
def task(tmp_path):
    return critter(tmp_path, edited(CRITTER_TASK, events=EVENTS, agents={}))


def recorded(task, file, episodes=9, num_envs=4):
    env = build(task, num_envs)
    with env.observers.added(EpisodeRecorder(env, episodes)) as recorder:
        evaluate(env, random_policy(env, 1.0, 3), episodes)
    recorder.save({"all": file})
    return read_trajectory(file)


def test_replay_of_every_episode_is_bit_identical(task, tmp_path):
    recording = recorded(task, tmp_path / "r.safetensors")
    assert len(recording.header.episodes) == 9
    env = build(task, 4, seed=1)
    assert replay_episodes(recording, env, range(9)).difference is None
    assert replay_episodes(recording, env, [4]).difference is None, "the same environment again, another episode"


def test_recording_has_states_actions_rewards_and_model_fields(task, tmp_path):
    recording = recorded(task, tmp_path / "r.safetensors")
    masses = set()
    for number, episode in enumerate(recording.header.episodes):
        part = {n.split(".", 2)[2]: v for n, v in recording.tensors.items() if n.startswith(f"episode.{number}.")}
        assert part["qpos"].shape == (episode.length + 1, 11)
        assert part["qpos"].dtype == torch.float64
        assert part["qvel"].shape == (episode.length + 1, 10)
        assert part["actions"].shape == (episode.length, 4)
        assert float(part["rewards"].sum()) == pytest.approx(episode.total_reward, rel=1e-4)
        assert episode.causes
        masses.add(float(part["model.body_mass"][1]))
    assert len(masses) == 9, "each episode's own"


@pytest.mark.parametrize("field", ["qpos", "qvel", "ctrl", "rewards"])
def test_replay_reports_the_first_difference(task, tmp_path, field):
    recording = recorded(task, tmp_path / "r.safetensors")
    values = recording.tensors[f"episode.5.{field}"]
    place = (7,) if field == "rewards" else (7, 0)
    values[place] = torch.nextafter(values[place], torch.tensor(9.0, dtype=values.dtype))
    difference = replay_episodes(recording, build(task, 4), range(9)).difference
    step = 8 if field == "rewards" else 7
    assert (difference.episode, difference.step, difference.field) == (5, step, field.removesuffix("s") if field == "rewards" else field)  # fmt: skip # noqa: E501
    assert difference.recorded != difference.replayed


def test_replay_detects_a_changed_model_and_a_changed_task(task, tmp_path):
    recording = recorded(task, tmp_path / "r.safetensors")
    (task / "critter.xml").write_text(CRITTER.replace('damping="0.2"', 'damping="0.21"'))
    difference = replay_episodes(recording, build(task, 4), range(9)).difference
    assert difference.step <= 1
    other = critter(tmp_path / "other", edited(CRITTER_TASK, events=EVENTS))
    with pytest.raises(CheckpointError, match="does not fit"):
        replay_episodes(recording, build(other, 3), range(9))


def test_eval_recording_is_replayed_without_the_policy(cli, coin):
    message = cli("eval", coin, "--policy", "random", "--episodes", 50, "--record", "r.safetensors", "--json").json
    assert message["recorded"] == ["r.safetensors"]
    recording = read_recording_here("r.safetensors")
    assert len(recording.header.episodes) == message["episodes"] == 50
    assert sum(e.success for e in recording.header.episodes) == pytest.approx(50 * message["success"]["rate"])
    result = cli("replay", "r.safetensors", "--json").json
    assert result["equal"] is True
    assert result["episodes"] == 50
    assert result["steps"] == sum(e.length for e in recording.header.episodes)


def expect_code(result, code):
    assert result.code == code, result.err
    return result


def read_recording_here(name):
    return read_trajectory(Path(name).absolute())


def test_record_modes_select_episodes(cli, coin):
    def count(*flags):
        cli("play", coin, "--policy", "zero", "--viewer", "none", "--record", "r.safetensors", *flags)
        return [e.success for e in read_recording_here("r.safetensors").header.episodes]

    every = count()
    assert {True, False} == set(every)
    assert count("--record-mode", "succeeded") == [True] * sum(every)
    assert count("--record-mode", "failed") == [False] * (len(every) - sum(every))
    cli("play", coin, "--policy", "zero", "--viewer", "none", "--record", "s.safetensors", "--record-mode", "separate")
    parts = [read_recording_here(f"s-{word}.safetensors").header.episodes for word in ("succeeded", "failed")]
    assert [len(part) for part in parts] == [sum(every), len(every) - sum(every)]
    assert cli("replay", "s-failed.safetensors").code == 0


def test_replay_exits_9_with_the_first_difference(cli, task):
    flags = ("--policy", "random", "--episodes", 4, "--num-envs", 2, "--record", "r.safetensors")
    cli("eval", "./critter", *flags)
    assert cli("replay", "r.safetensors").code == 0
    (task / "critter.xml").write_text(CRITTER.replace('damping="0.2"', 'damping="0.21"'))
    result = expect_code(cli("replay", "r.safetensors", "--json"), 9).json
    assert result["equal"] is False
    assert result["difference"]["episode"] == 0
    assert result["difference"]["step"] == 1
    assert result["difference"]["field"] == "qpos"
    message = expect_code(cli("replay", "r.safetensors"), 9).out
    assert "episode 0 differs first at step 1 in qpos: recorded [" in message


@pytest.mark.parametrize("damage", ["cut", "bit", "empty", "text", "foreign", "missing", "version"])
def test_damaged_recording_exits_5(cli, coin, damage):
    file = Path("r.safetensors")
    cli("eval", coin, "--policy", "random", "--episodes", 4, "--record", file)
    data = bytearray(file.read_bytes())
    if damage == "bit":
        data[-30] ^= 1
    file.write_bytes({"cut": data[:-100], "empty": b"", "text": b"episodes: 3\n"}.get(damage, bytes(data)))
    if damage == "foreign":
        save_file({"a": torch.zeros(3)}, file)
    if damage == "version":
        save_file(load_file(file), file, metadata={"rlcli": json.dumps({"format": 99})})
    if damage == "missing":
        os.remove(file)
    result = expect_code(cli("replay", file, "--json"), 5)
    assert "r.safetensors" in result.json["error"]["message"]


def test_invalid_record_options_are_refused_before_the_run(cli, coin):
    flags = ("eval", coin, "--policy", "random", "--record")
    assert "did you mean 'failed'" in expect_code(cli(*flags, "r", "--record-mode", "faild"), 2).err
    assert "there is no folder" in expect_code(cli(*flags, "no/where"), 10).err
    assert "is a folder" in expect_code(cli(*flags, "."), 2).err
    assert expect_code(cli("play", coin, "--policy", "zero", "--video", "x.mp4", "--record", "r"), 2).code == 2


def test_unknown_episode_is_refused_with_the_count(cli, coin):
    cli("eval", coin, "--policy", "random", "--episodes", 4, "--record", "r.safetensors")
    assert "the file has 4 episodes" in expect_code(cli("replay", "r.safetensors", "--episode", 4), 2).err


@pytest.mark.slow
def test_replay_writes_a_video(cli):
    cli("eval", "cartpole", "--policy", "random", "--episodes", 2, "--num-envs", 2, "--record", "r.safetensors",
        "episode_length_s=0.5")  # fmt: skip
    result = cli("replay", "r.safetensors", "--episode", 1, "--video", "r.gif", "--json").json
    assert result["equal"] is True
    assert result["frames"] >= 10


def forged(file, change=lambda header: None, tensors=lambda name, tensor: tensor):
    """Write a recording again with a changed header or changed tensors and a valid hash."""
    content = {name: tensors(name, tensor) for name, tensor in load_file(file).items()}
    with safe_open(file, "pt") as opened:
        header = json.loads(opened.metadata()["rlcli"])
    del header["sha256"]
    change(header)
    header["sha256"] = content_digest(content, header)
    save_file(content, file, metadata={"rlcli": json.dumps(header)})


def test_many_episodes_without_tensors_are_refused_early(cli, task):
    recorded(task, Path("r.safetensors"), 2, 2)
    forged("r.safetensors", lambda header: header.update(episodes=header["episodes"] * 100_000))
    message = expect_code(cli("replay", "r.safetensors"), 5).err
    assert "the file is damaged: 200000 episodes, but only" in message


def test_mistake_in_a_recorded_configuration_names_the_recording(cli, task):
    recorded(task, Path("r.safetensors"), 2, 2)
    forged("r.safetensors", lambda header: header.update(config=header["config"] + "\nnonsense: 3\n"))
    message = expect_code(cli("replay", "r.safetensors", "--task", "./critter"), 3).err
    assert "error: r.safetensors:" in message
    assert "task.yaml" not in message
    assert "unknown key 'nonsense'" in message


def test_huge_numbers_in_a_recording_print_no_warning(cli, task):
    def huge(name, tensor):
        return torch.frombuffer(bytearray(b"\x7f" * tensor.nbytes), dtype=tensor.dtype).reshape(tensor.shape)

    recorded(task, Path("r.safetensors"), 2, 2)
    forged("r.safetensors", tensors=lambda name, t: huge(name, t) if t.dtype.is_floating_point and t.numel() else t)
    result = cli("replay", "r.safetensors", "--task", "./critter")
    assert result.code in (5, 6, 9)
    assert "Warning" not in result.err
