"""What a person at a viewer may ask of a policy in its environment, without any viewer."""

import copy
import json
import shutil
import threading

import numpy as np
import pytest
import torch
import yaml
from worlds import CRITTER, CRITTER_TASK

from rlcli.config.load import resolve
from rlcli.envs.vec_env import make_env
from rlcli.errors import CheckpointError, UsageError
from rlcli.registry import find_task, folder_task
from rlcli.rl.rollout import zero_policy
from rlcli.rl.run import open_run
from rlcli.viewer.player import SPEEDS, Player, hold_command
from rlcli.viewer.shelf import RunShelf


def cartpole(num_envs=3):
    return make_env(resolve(find_task("cartpole"), overrides=[f"scene.num_envs={num_envs}", "sim.engine_threads=1"]))


@pytest.fixture
def player():
    env = cartpole()
    return Player(env, zero_policy(env), patience=60.0)


@pytest.fixture
def counted(player, monkeypatch):
    """The player, and a list that grows with every step of its environment."""
    steps, real = [], player.env.step

    def step(*arguments):
        steps.append(player.env.is_playing())
        return real(*arguments)

    monkeypatch.setattr(player.env, "step", step)
    return player, steps


def test_steps_keep_pace_with_the_clock(counted):
    player, steps = counted
    for _ in range(30):
        player.advance(1 / 30)
    assert len(steps) == pytest.approx(60, abs=1)


@pytest.mark.parametrize("speed", SPEEDS)
def test_speed_multiplies_the_pace(counted, speed):
    player, steps = counted
    player.set_speed(speed)
    for _ in range(40):
        player.advance(0.02)
    assert len(steps) == pytest.approx(0.8 * 60 * speed, abs=1)
    assert player.view.speed == speed


def test_faster_and_slower_stop_at_the_ends(player):
    for _ in range(20):
        player.faster(1)
    assert player.speed == 8
    for _ in range(20):
        player.faster(-1)
    assert player.speed == 1 / 8


def test_a_slow_machine_answers_between_steps(counted):
    player, steps = counted
    player.patience = 0.0
    player.set_speed(8.0)
    assert player.advance(0.2) == 1
    assert len(steps) == 1


def test_a_long_gap_is_not_caught_up_with(counted):
    player, steps = counted
    player.advance(60.0)
    assert len(steps) <= 15


def test_while_paused_no_step_runs_and_the_environment_says_so(counted):
    player, steps = counted
    player.ask(player.pause)
    state = player.env.state_dict()
    for _ in range(10):
        player.advance(0.1)
    assert steps == []
    assert player.env.is_playing() is False
    assert player.view.paused
    for name, value in player.env.state_dict().items():
        assert torch.equal(value, state[name]), name
    player.ask(lambda: player.pause(False))
    player.advance(0.1)
    assert len(steps) == 6
    assert player.env.is_playing()


def test_a_single_step_is_one_and_leaves_it_paused(counted):
    player, steps = counted
    player.ask(player.single_step)
    for _ in range(5):
        player.advance(0.1)
    assert steps == [True]
    assert player.env.is_playing() is False
    player.ask(player.single_step)
    player.ask(player.single_step)
    player.advance(0.0)
    assert len(steps) == 3


def test_a_step_that_fails_leaves_it_paused(player, monkeypatch):
    player.pause()

    def fail(action):
        raise RuntimeError("in the middle")

    monkeypatch.setattr(player.env, "step", fail)
    player.ask(player.single_step)
    with pytest.raises(RuntimeError):
        player.advance(0.0)
    assert player.env.is_playing() is False


def test_reset_begins_new_episodes_also_while_paused(player):
    for _ in range(20):
        player.advance(0.1)
    player.ask(player.pause)
    before = player.env.episode_index.clone()
    player.ask(player.reset)
    player.advance(0.1)
    assert torch.equal(player.env.episode_index, before + 1)
    assert bool((player.env.episode_length_buf == 0).all())
    assert player.view.paused
    player.ask(player.single_step)
    player.advance(0.1)
    assert bool((player.env.episode_length_buf == 1).all())


def test_the_environment_shown_wraps_around(player):
    player.show(-1)
    player.advance(0.0)
    assert player.view.shown == 2
    player.show(3)
    player.advance(0.1)
    assert player.view.shown == 0
    assert player.view.episode_s == pytest.approx(player.env.episode_length_buf[0] * player.env.step_dt)


def test_what_is_asked_in_another_thread_is_done_between_steps(player):
    done = []
    thread = threading.Thread(target=lambda: player.ask(lambda: done.append(threading.get_ident())))
    thread.start()
    thread.join()
    assert done == []
    player.advance(0.0)
    assert done == [threading.get_ident()]


# --- pushing ---


def forces(env, newtons):
    """On the cart, along its rail."""
    model = env.engine.model
    given = np.zeros((model.nbody, 6))
    given[model.nbody - 2, np.abs(model.jnt_axis[0]).argmax()] = newtons
    return given


def test_a_push_reaches_the_environment_shown_alone():
    pushed, free = (Player(env, zero_policy(env)) for env in (cartpole(), cartpole()))
    for one in (pushed, free):
        one.show(1)
    pushed.push(forces(pushed.env, 50.0))
    for _ in range(10):
        pushed.advance(1 / 60)
        free.advance(1 / 60)
    apart = (pushed.env.engine.field("qpos") - free.env.engine.field("qpos")).abs().amax(dim=1)
    assert apart[1] > 0.01
    assert apart[0] == apart[2] == 0.0


def test_after_a_push_nothing_of_it_is_left(player):
    player.push(forces(player.env, 50.0))
    player.advance(0.1)
    player.push(None)
    player.advance(0.1)
    assert not player.env.engine.field("xfrc_applied").any()


def test_a_reset_under_a_push_leaves_no_force(player):
    player.push(forces(player.env, 1e4))
    ended = player.ended.clone()
    for _ in range(40):
        player.advance(0.1)
    assert player.ended[0] > ended[0]
    assert not player.env.engine.field("xfrc_applied").any()


def test_a_force_of_the_task_outlasts_a_push(player):
    field = player.env.engine.field("xfrc_applied")
    field[0, 1, 2] = 3.0
    before = field.clone()
    player.push(forces(player.env, 7.0))
    player.single_step()
    player.advance(0.0)
    assert torch.equal(field, before)


@pytest.mark.parametrize("bad", [np.zeros((1, 6)), np.full((5, 6), np.nan), np.zeros(7), np.full((3, 6), np.inf)])
def test_a_push_that_is_none_is_ignored(player, bad):
    player.push(bad)
    player.advance(0.1)
    assert player.env.divergences == 0
    assert bool(player.env.engine.field("qpos").isfinite().all())


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
    return Player(env, zero_policy(env))


def test_held_commands_reach_the_policy_through_draws_and_resets(tmp_path):
    player = commanded(tmp_path / "t")
    seen = []
    act = player.act
    player.act = lambda obs: (seen.append(obs[:, -3:].clone()), act(obs))[1]
    player.ask(lambda: player.hold("vx", 0.5))
    player.ask(lambda: player.hold("wz", 0.0))
    for _ in range(60):
        player.advance(0.02)
    later = torch.stack(seen[1:])
    assert len(later) > 50
    assert bool((later[..., 0] == 0.5).all())
    assert bool((later[..., 2] == 0.0).all())
    assert int(player.ended.sum()) > 0
    player.ask(lambda: player.hold("vx", None))
    player.advance(0.0)
    assert player.view.held == {"wz": 0.0}
    seen.clear()
    for _ in range(30):
        player.advance(0.02)
    assert len({value for row in seen[2:] for value in row[:, 0].tolist()}) > 3


def test_the_sliders_are_those_of_the_command_terms(tmp_path):
    view = commanded(tmp_path / "t").view
    assert [(knob.name, knob.low, knob.high) for knob in view.knobs] == [
        ("vx", -1.0, 2.0),
        ("vy", -1.0, 1.0),
        ("wz", -0.5, 0.5),
    ]


def test_of_two_terms_with_one_element_the_term_is_named(tmp_path):
    player = commanded(tmp_path / "t", second=copy.deepcopy(VELOCITY))
    assert [knob.name for knob in player.view.knobs][:2] == ["velocity.vx", "velocity.vy"]
    player.hold("second.vx", 1.5)
    player.advance(0.1)
    assert bool((player.env.command_manager.get_command("second")[:, 0] == 1.5).all())
    assert not bool((player.env.command_manager.get_command("velocity")[:, 0] == 1.5).any())
    with pytest.raises(UsageError):
        player.hold("vx", 1.0)


def test_a_wrong_command_lists_the_right_ones(tmp_path):
    player = commanded(tmp_path / "t")
    with pytest.raises(UsageError) as caught:
        player.hold("vz", 1.0)
    assert "vx, vy, wz" in caught.value.hint
    with pytest.raises(UsageError, match="cannot be nan"):
        player.hold("vx", float("nan"))
    assert player.env.command_manager.held == {}


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_a_task_without_commands_says_so(task):
    env = make_env(resolve(find_task(task), overrides=["scene.num_envs=1", "sim.engine_threads=1"]))
    with pytest.raises(UsageError) as caught:
        hold_command(env, "vx", 1.0)
    assert caught.value.hint == "the task has no commands"
    assert Player(env, zero_policy(env)).view.knobs == ()


# --- checkpoints ---


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run with a few checkpoints, that nobody has trained for long."""
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
def playing(trained, tmp_path):
    """A player of a copy of that run, the copy, and what it has said."""
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    env, told = cartpole(), []
    shelf = RunShelf(open_run(folder), env)
    newest = shelf.steps()[-1]
    return Player(env, shelf.load(newest), shelf, newest, told.append), folder, told


def copy_as(folder, step):
    """A further checkpoint, as training writes it: whole, under its name at once."""
    newest = sorted((folder / "checkpoints").glob("0*"))[-1]
    fresh = folder / "checkpoints" / "writing"
    shutil.copytree(newest, fresh)
    file = fresh / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "step": step}))
    fresh.rename(folder / "checkpoints" / f"{step:012d}")


def test_switching_changes_the_policy_within_the_episode(playing):
    player, _, told = playing
    obs = player.env.reset()["policy"]
    for _ in range(5):
        player.advance(0.02)
    lengths = player.env.episode_length_buf.clone()
    before = player.act(obs)
    first = player.view.checkpoints[0]
    player.ask(lambda: player.switch(first))
    player.advance(0.0)
    assert player.view.checkpoint == first
    assert told == [f"now playing step {first}"]
    assert not torch.equal(player.act(obs), before)
    assert torch.equal(player.env.episode_length_buf, lengths)


def test_checkpoints_that_appear_are_listed_and_followed(playing):
    player, folder, told = playing
    have = player.view.checkpoints
    copy_as(folder, 1000)
    player.reread()
    player.advance(0.0)
    assert player.view.checkpoints == (*have, 1000)
    assert player.view.checkpoint == have[-1]
    player.set_follow(True)
    assert player.checkpoint == 1000
    copy_as(folder, 2000)
    player.reread()
    assert player.checkpoint == 2000
    assert told == ["now playing step 1000", "now playing step 2000"]
    player.neighbour(-1)
    assert player.checkpoint == 1000
    player.neighbour(1)
    player.neighbour(1)
    assert player.checkpoint == 2000


def test_a_checkpoint_that_was_pruned_is_said_to_be_gone_and_the_policy_stays(playing):
    player, folder, told = playing
    first, newest = player.view.checkpoints[0], player.checkpoint
    act = player.act
    shutil.rmtree(folder / "checkpoints" / f"{first:012d}")
    player.switch(first)
    player.advance(0.1)
    assert player.act is act
    assert player.view.checkpoint == newest
    assert first not in player.view.checkpoints
    assert f"step {first} cannot be played, step {newest} goes on" in told[0]
    assert "not there any more" in player.view.message


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
def test_a_damaged_checkpoint_is_told_of_and_the_policy_stays(playing, damage):
    player, folder, told = playing
    first, act = player.view.checkpoints[0], player.act
    damage(folder / "checkpoints" / f"{first:012d}")
    player.switch(first)
    assert player.act is act
    assert "cannot be played" in told[0]
    assert "\n" not in player.message
    player.advance(0.1)
    assert player.steps > 0


def test_a_run_that_disappears_leaves_the_policy_playing(playing):
    player, folder, _ = playing
    shutil.rmtree(folder)
    player.set_follow(True)
    player.reread()
    player.neighbour(-1)
    player.advance(0.1)
    assert player.view.checkpoints == ()
    assert player.steps > 0
    with pytest.raises(CheckpointError):
        player.shelf.load(player.checkpoint)
