"""The window's keys and captions; the window itself needs a display."""

import pytest
import yaml
from worlds import CRITTER_TASK, build, critter

from rlcli.config.load import resolve
from rlcli.envs.vec_env import make_env
from rlcli.registry import find_task
from rlcli.rl.rollout import zero_policy
from rlcli.viewer.native import captions, press
from rlcli.viewer.player import Player

SPACE, BACKSPACE, MINUS, EQUAL, RIGHT, DOWN, UP, PAGE_UP = 32, 259, 45, 61, 262, 264, 265, 266
INSERT, DELETE, HOME, END = 260, 261, 268, 269


@pytest.fixture
def player():
    env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=3", "sim.engine_threads=1"]))
    return Player(env, zero_policy(env))


def commanded(folder):
    """A player of a task with a velocity command."""
    task = yaml.safe_load(CRITTER_TASK)
    task["commands"] = {
        "velocity": {"func": "uniform_velocity", "resampling_time_s": [1.0, 2.0], "lin_vel_x": [-1.0, 2.0]}
    }
    env = build(critter(folder, yaml.safe_dump(task, sort_keys=False)))
    return Player(env, zero_policy(env))


def pressed(player, *keys):
    for key in keys:
        press(player, key)
        player.advance(0.0)
    return player.view


def test_the_keys_ask_the_player(player):
    assert pressed(player, SPACE).paused
    assert not pressed(player, SPACE).paused
    assert pressed(player, EQUAL, EQUAL).speed == 4.0
    assert pressed(player, MINUS).speed == 2.0
    assert pressed(player, UP).shown == 1
    assert pressed(player, DOWN, DOWN).shown == 2
    steps = player.steps
    assert pressed(player, RIGHT).paused
    assert player.steps == steps + 1
    index = int(player.env.episode_index[0])
    pressed(player, BACKSPACE)
    assert int(player.env.episode_index[0]) == index + 1


@pytest.mark.parametrize("key", [PAGE_UP, 65, 0, -1])
def test_keys_that_mean_nothing_here_do_nothing(player, key):
    before = player.view
    assert pressed(player, key) == before


def test_keys_turn_commands_within_their_ranges(tmp_path):
    player = commanded(tmp_path)
    assert pressed(player, END).held == {}
    assert pressed(player, INSERT, INSERT).held == {"vy": pytest.approx(0.4)}
    assert pressed(player, HOME, DELETE).held["vx"] == pytest.approx(-0.3)
    names, values = captions(player.view)
    said = dict(zip(names.splitlines(), values.splitlines(), strict=True))
    assert (said["> vx"], said["vy"], said["wz"]) == ("-0.3", "0.4", "as drawn")
    pressed(player, DELETE, DELETE)
    assert player.view.held["vx"] == pytest.approx(-0.9)
    assert "vx" not in pressed(player, DELETE).held


def test_the_captions_say_what_is_shown(player):
    names, values = captions(pressed(player, SPACE, UP))
    said = dict(zip(names.splitlines(), values.splitlines(), strict=True))
    assert said["speed"] == "paused"
    assert said["environment"] == "1 of 3"
    assert "checkpoint" not in said
