"""Requests of a viewer's user, tested without a viewer."""

import copy
import json
import logging
import shutil
import threading

import numpy as np
import pytest
import torch
import yaml
from support.worlds import CRITTER, CRITTER_TASK

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import CheckpointError, UsageError
from rlcli.registry import find_task, folder_task
from rlcli.rl.action_functions import zero_policy
from rlcli.runs.run import open_run
from rlcli.viewer.checkpoints import RunCheckpoints
from rlcli.viewer.playback import SPEEDS, Playback, hold_command, run_in_real_time


def cartpole(num_envs=3):
    return make_env(resolve(find_task("cartpole"), overrides=[f"scene.num_envs={num_envs}", "sim.engine_threads=1"]))


@pytest.fixture
def playback():
    env = cartpole()
    return Playback(env, zero_policy(env), max_advance_s=60.0)


@pytest.fixture
def counted(playback, monkeypatch):
    """Playback, and a list that grows with every step of its environment."""
    steps, real = [], playback.env.step

    def step(*arguments):
        steps.append(playback.env.is_playing())
        return real(*arguments)

    monkeypatch.setattr(playback.env, "step", step)
    return playback, steps


def test_steps_follow_real_time(counted):
    playback, steps = counted
    for _ in range(30):
        playback.advance(1 / 30)
    assert len(steps) == pytest.approx(60, abs=1)


@pytest.mark.parametrize("speed", SPEEDS)
def test_speed_scales_steps(counted, speed):
    playback, steps = counted
    playback.set_speed(speed)
    for _ in range(40):
        playback.advance(0.02)
    assert len(steps) == pytest.approx(0.8 * 60 * speed, abs=1)
    assert playback.view.speed == speed


def test_change_speed_stops_at_limits(playback):
    for _ in range(20):
        playback.change_speed(1)
    assert playback.speed == 8
    for _ in range(20):
        playback.change_speed(-1)
    assert playback.speed == 1 / 8


def test_advance_returns_after_patience(counted):
    playback, steps = counted
    playback.max_advance_s = 0.0
    playback.set_speed(8.0)
    assert playback.advance(0.2) == 1
    assert len(steps) == 1


def test_long_gap_is_not_caught_up(counted):
    playback, steps = counted
    playback.advance(60.0)
    assert len(steps) <= 15


def test_viewer_closes_after_its_seconds(counted):
    playback, steps = counted
    playback.longest_s = 0.2
    run_in_real_time(playback, lambda: True, lambda: None)
    assert 0 < len(steps) < 60


def test_pause_stops_steps_and_is_playing(counted):
    playback, steps = counted
    playback.submit(playback.pause)
    state = playback.env.state_dict()
    for _ in range(10):
        playback.advance(0.1)
    assert steps == []
    assert playback.env.is_playing() is False
    assert playback.view.paused
    for name, value in playback.env.state_dict().items():
        assert torch.equal(value, state[name]), name
    playback.submit(lambda: playback.pause(False))
    playback.advance(0.1)
    assert len(steps) == 6
    assert playback.env.is_playing()


def test_single_step_makes_one_step_and_pauses(counted):
    playback, steps = counted
    playback.submit(playback.single_step)
    for _ in range(5):
        playback.advance(0.1)
    assert steps == [True]
    assert playback.env.is_playing() is False
    playback.submit(playback.single_step)
    playback.submit(playback.single_step)
    playback.advance(0.0)
    assert len(steps) == 3


def test_failing_step_leaves_playback_paused(playback, monkeypatch):
    playback.pause()

    def fail(action):
        raise RuntimeError("in the middle")

    monkeypatch.setattr(playback.env, "step", fail)
    playback.submit(playback.single_step)
    with pytest.raises(RuntimeError):
        playback.advance(0.0)
    assert playback.env.is_playing() is False


def test_reset_works_while_paused(playback):
    for _ in range(20):
        playback.advance(0.1)
    playback.submit(playback.pause)
    before = playback.env.episode_index.clone()
    playback.submit(playback.reset)
    playback.advance(0.1)
    assert torch.equal(playback.env.episode_index, before + 1)
    assert bool((playback.env.episode_length_buf == 0).all())
    assert playback.view.paused
    playback.submit(playback.single_step)
    playback.advance(0.1)
    assert bool((playback.env.episode_length_buf == 1).all())


def test_shown_environment_wraps_around(playback):
    playback.show(-1)
    playback.advance(0.0)
    assert playback.view.shown == 2
    playback.show(3)
    playback.advance(0.1)
    assert playback.view.shown == 0
    assert playback.view.episode_s == pytest.approx(playback.env.episode_length_buf[0] * playback.env.step_dt)


def test_submitted_request_runs_between_steps(playback):
    done = []
    thread = threading.Thread(target=lambda: playback.submit(lambda: done.append(threading.get_ident())))
    thread.start()
    thread.join()
    assert done == []
    playback.advance(0.0)
    assert done == [threading.get_ident()]


# --- pushing ---


def forces(env, newtons):
    """Return a force on the cart along its rail. (nbody, 6) [N, N m]"""
    model = env.engine.model
    given = np.zeros((model.nbody, 6))
    given[model.nbody - 2, np.abs(model.jnt_axis[0]).argmax()] = newtons
    return given


def test_push_acts_only_on_shown_environment():
    pushed, free = (Playback(env, zero_policy(env)) for env in (cartpole(), cartpole()))
    for one in (pushed, free):
        one.show(1)
    pushed.push(forces(pushed.env, 50.0))
    for _ in range(10):
        pushed.advance(1 / 60)
        free.advance(1 / 60)
    apart = (pushed.env.engine.field("qpos") - free.env.engine.field("qpos")).abs().amax(dim=1)
    assert apart[1] > 0.01
    assert apart[0] == apart[2] == 0.0


def test_push_leaves_no_force_behind(playback):
    playback.push(forces(playback.env, 50.0))
    playback.advance(0.1)
    playback.push(None)
    playback.advance(0.1)
    assert not playback.env.engine.field("xfrc_applied").any()


def test_reset_during_push_leaves_no_force(playback):
    playback.push(forces(playback.env, 1e4))
    ended = playback.statistics.ended.clone()
    for _ in range(40):
        playback.advance(0.1)
    assert playback.statistics.ended[0] > ended[0]
    assert not playback.env.engine.field("xfrc_applied").any()


def test_push_keeps_forces_of_task(playback):
    field = playback.env.engine.field("xfrc_applied")
    field[0, 1, 2] = 3.0
    before = field.clone()
    playback.push(forces(playback.env, 7.0))
    playback.single_step()
    playback.advance(0.0)
    assert torch.equal(field, before)


@pytest.mark.parametrize("bad", [np.zeros((1, 6)), np.full((5, 6), np.nan), np.zeros(7), np.full((3, 6), np.inf)])
def test_invalid_push_is_ignored(playback, bad):
    playback.push(bad)
    playback.advance(0.1)
    assert playback.env.divergences == 0
    assert bool(playback.env.engine.field("qpos").isfinite().all())


# --- commands ---

VELOCITY = {
    "func": "uniform_velocity",
    "resampling_time_s": [0.1, 0.2],
    "lin_vel_x": [-1.0, 2.0],
    "ang_vel_z": [-0.5, 0.5],
    "heading": [-3.0, 3.0],
}


def commanded(folder, **more):
    task = yaml.safe_load(CRITTER_TASK)
    task["commands"] = {"velocity": dict(VELOCITY), **more}
    task["observations"]["policy"]["asked"] = {"func": "generated_commands", "command": "velocity"}
    folder.mkdir(exist_ok=True)
    (folder / "critter.xml").write_text(CRITTER)
    (folder / "task.yaml").write_text(yaml.safe_dump(task, sort_keys=False))
    env = make_env(resolve(folder_task(folder)))
    return Playback(env, zero_policy(env))


def test_held_command_survives_resampling_and_reset(tmp_path):
    playback = commanded(tmp_path / "t")
    seen = []
    act = playback.act
    playback.act = lambda obs: (seen.append(obs[:, -3:].clone()), act(obs))[1]
    playback.submit(lambda: playback.hold("vx", 0.5))
    playback.submit(lambda: playback.hold("wz", 0.0))
    for _ in range(60):
        playback.advance(0.02)
    later = torch.stack(seen[1:])
    assert len(later) > 50
    assert bool((later[..., 0] == 0.5).all())
    assert bool((later[..., 2] == 0.0).all())
    assert int(playback.statistics.ended.sum()) > 0
    playback.submit(lambda: playback.hold("vx", None))
    playback.advance(0.0)
    assert playback.view.held == {"wz": 0.0}
    seen.clear()
    for _ in range(30):
        playback.advance(0.02)
    assert len({value for row in seen[2:] for value in row[:, 0].tolist()}) > 3


def test_knobs_are_command_elements(tmp_path):
    view = commanded(tmp_path / "t").view
    assert [(knob.name, knob.low, knob.high) for knob in view.knobs] == [
        ("vx", -1.0, 2.0),
        ("vy", -1.0, 1.0),
        ("wz", -0.5, 0.5),
    ]


def test_knobs_of_two_terms_have_term_names(tmp_path):
    playback = commanded(tmp_path / "t", second=copy.deepcopy(VELOCITY))
    assert [knob.name for knob in playback.view.knobs][:2] == ["velocity.vx", "velocity.vy"]
    playback.hold("second.vx", 1.5)
    playback.advance(0.1)
    assert bool((playback.env.command_manager.get_command("second")[:, 0] == 1.5).all())
    assert not bool((playback.env.command_manager.get_command("velocity")[:, 0] == 1.5).any())
    with pytest.raises(UsageError):
        playback.hold("vx", 1.0)


def test_unknown_command_error_lists_valid_names(tmp_path):
    playback = commanded(tmp_path / "t")
    with pytest.raises(UsageError) as caught:
        playback.hold("vz", 1.0)
    assert "vx, vy, wz" in caught.value.hint
    with pytest.raises(UsageError, match="cannot be nan"):
        playback.hold("vx", float("nan"))
    assert playback.env.command_manager.held == {}


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_hold_command_without_commands_is_usage_error(task):
    env = make_env(resolve(find_task(task), overrides=["scene.num_envs=1", "sim.engine_threads=1"]))
    with pytest.raises(UsageError) as caught:
        hold_command(env, "vx", 1.0)
    assert caught.value.hint == "leave out --command: the task has no commands"
    assert Playback(env, zero_policy(env)).view.knobs == ()


# --- checkpoints ---


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Run with a few checkpoints, trained only briefly."""
    from rlcli.cli.app import main

    runs = tmp_path_factory.mktemp("runs")
    words = ["train", "cartpole", "--runs-dir", str(runs), "--logger", "none", "-q", "--max-iterations", "2"]
    words += ["scene.num_envs=4", "sim.engine_threads=1", "agent.torch_threads=1", "agent.save_interval=1"]
    threads = torch.get_num_threads()
    assert main(words) == 0
    torch.set_num_threads(threads)
    (folder,) = runs.glob("*/*")
    return folder


@pytest.fixture
def playing(trained, tmp_path, caplog):
    """Playback of a copy of that run, the copy, and the captured log."""
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    env = cartpole()
    caplog.set_level(logging.INFO, "rlcli.viewer")
    checkpoint_source = RunCheckpoints(open_run(folder), env)
    newest = checkpoint_source.steps()[-1]
    return Playback(env, checkpoint_source.load(newest), checkpoint_source, newest), folder, caplog


def copy_as(folder, step):
    """Add a checkpoint as training does: complete, by renaming it to its final name."""
    newest = sorted((folder / "checkpoints").glob("0*"))[-1]
    fresh = folder / "checkpoints" / "writing"
    shutil.copytree(newest, fresh)
    file = fresh / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "step": step}))
    fresh.rename(folder / "checkpoints" / f"{step:012d}")


def test_switch_changes_policy_within_episode(playing):
    playback, _, log = playing
    obs = playback.env.reset()["policy"]
    for _ in range(5):
        playback.advance(0.02)
    lengths = playback.env.episode_length_buf.clone()
    before = playback.act(obs)
    first = playback.view.checkpoints[0]
    playback.submit(lambda: playback.switch(first))
    playback.advance(0.0)
    assert playback.view.checkpoint == first
    assert log.messages == [f"now playing step {first}"]
    assert not torch.equal(playback.act(obs), before)
    assert torch.equal(playback.env.episode_length_buf, lengths)


def test_new_checkpoints_are_listed_and_followed(playing):
    playback, folder, log = playing
    have = playback.view.checkpoints
    copy_as(folder, 1000)
    playback.refresh_checkpoints()
    playback.advance(0.0)
    assert playback.view.checkpoints == (*have, 1000)
    assert playback.view.checkpoint == have[-1]
    playback.set_follow(True)
    assert playback.checkpoint == 1000
    copy_as(folder, 2000)
    playback.refresh_checkpoints()
    assert playback.checkpoint == 2000
    assert log.messages == ["now playing step 1000", "now playing step 2000"]
    playback.switch_relative(-1)
    assert playback.checkpoint == 1000
    playback.switch_relative(1)
    playback.switch_relative(1)
    assert playback.checkpoint == 2000


def test_removed_checkpoint_is_reported_and_policy_stays(playing):
    playback, folder, log = playing
    first, newest = playback.view.checkpoints[0], playback.checkpoint
    act = playback.act
    shutil.rmtree(folder / "checkpoints" / f"{first:012d}")
    playback.switch(first)
    playback.advance(0.1)
    assert playback.act is act
    assert playback.view.checkpoint == newest
    assert first not in playback.view.checkpoints
    assert f"step {first} cannot be played, the current policy continues" in log.messages[0]
    assert "does not exist (training deletes old checkpoints)" in playback.view.message


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "policy.safetensors").write_bytes(b"x" * 40),
        lambda folder: (folder / "policy.safetensors").unlink(),
        lambda folder: (folder / "policy.json").write_text("{"),
        lambda folder: (folder / "manifest.json").write_text("[]"),
        lambda folder: (folder / "manifest.json").write_text(
            (folder / "manifest.json").read_text().replace("joint_vel_rel", "velocity")
        ),
    ],
)
def test_damaged_checkpoint_is_reported_and_policy_stays(playing, damage):
    playback, folder, log = playing
    first, act = playback.view.checkpoints[0], playback.act
    damage(folder / "checkpoints" / f"{first:012d}")
    playback.switch(first)
    assert playback.act is act
    assert "cannot be played" in log.messages[0]
    assert "\n" not in playback.message
    playback.advance(0.1)
    assert playback.steps > 0


def test_removed_run_keeps_policy(playing):
    playback, folder, _ = playing
    shutil.rmtree(folder)
    playback.set_follow(True)
    playback.refresh_checkpoints()
    playback.switch_relative(-1)
    playback.advance(0.1)
    assert playback.view.checkpoints == ()
    assert playback.steps > 0
    with pytest.raises(CheckpointError):
        playback.checkpoint_source.load(playback.checkpoint)
