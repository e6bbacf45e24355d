"""Keys and captions of the window. The window itself would need a display."""

import pytest
import yaml
from support.worlds import CRITTER_TASK, build, critter

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.rl.action_functions import zero_policy
from rlcli.viewer.native import captions, press
from rlcli.viewer.playback import Playback

SPACE, BACKSPACE, MINUS, EQUAL, RIGHT, DOWN, UP, PAGE_UP = 32, 259, 45, 61, 262, 264, 265, 266
INSERT, DELETE, HOME, END = 260, 261, 268, 269


@pytest.fixture
def playback():
    env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=3", "sim.engine_threads=1"]))
    return Playback(env, zero_policy(env))


def commanded(folder):
    """Return a playback of a task with a velocity command."""
    task = yaml.safe_load(CRITTER_TASK)
    task["commands"] = {
        "velocity": {"func": "uniform_velocity", "resampling_time_s": [1.0, 2.0], "lin_vel_x": [-1.0, 2.0]}
    }
    env = build(critter(folder, yaml.safe_dump(task, sort_keys=False)))
    return Playback(env, zero_policy(env))


def pressed(playback, *keys):
    for key in keys:
        press(playback, key)
        playback.advance(0.0)
    return playback.view


def test_keys_submit_requests(playback):
    assert pressed(playback, SPACE).paused
    assert not pressed(playback, SPACE).paused
    assert pressed(playback, EQUAL, EQUAL).speed == 4.0
    assert pressed(playback, MINUS).speed == 2.0
    assert pressed(playback, UP).shown == 1
    assert pressed(playback, DOWN, DOWN).shown == 2
    steps = playback.steps
    assert pressed(playback, RIGHT).paused
    assert playback.steps == steps + 1
    index = int(playback.env.episode_index[0])
    pressed(playback, BACKSPACE)
    assert int(playback.env.episode_index[0]) == index + 1


@pytest.mark.parametrize("key", [PAGE_UP, 65, 0, -1])
def test_unknown_keys_are_ignored(playback, key):
    before = playback.view
    assert pressed(playback, key) == before


def test_keys_adjust_commands_within_ranges(tmp_path):
    playback = commanded(tmp_path)
    assert pressed(playback, END).held == {}
    assert pressed(playback, INSERT, INSERT).held == {"vy": pytest.approx(0.4)}
    assert pressed(playback, HOME, DELETE).held["vx"] == pytest.approx(-0.3)
    names, values = captions(playback.view)
    captions_by_name = dict(zip(names.splitlines(), values.splitlines(), strict=True))
    shown = [captions_by_name[name] for name in ("> vx [m/s]", "vy [m/s]", "wz [rad/s]")]
    assert shown[:2] == ["-0.3", "0.4"]
    assert shown[2] == f"{playback.view.commands[2]:.2f} from the task"
    pressed(playback, DELETE, DELETE)
    assert playback.view.held["vx"] == pytest.approx(-0.9)
    assert "vx" not in pressed(playback, DELETE).held


def test_captions_show_view(playback):
    names, values = captions(pressed(playback, SPACE, UP))
    captions_by_name = dict(zip(names.splitlines(), values.splitlines(), strict=True))
    assert captions_by_name["speed"] == "paused"
    assert captions_by_name["environment"] == "1 of 3"
    assert "checkpoint" not in captions_by_name
