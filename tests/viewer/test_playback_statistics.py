"""Statistics of a playback: returns, ends of episodes, and curves of reward terms."""

import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.rl.action_functions import zero_policy
from rlcli.viewer.playback import Playback


@pytest.fixture(scope="module")
def played():
    """Return a playback of the zero policy and the sums of its rewards, when first episodes have ended."""
    overrides = ["scene.num_envs=3", "sim.engine_threads=1", "episode_length_s=0.5"]
    env = make_env(resolve(find_task("cartpole"), overrides=overrides))
    playback = Playback(env, zero_policy(env), max_advance_s=60.0, shown=1)
    total = torch.zeros(3)
    for _ in range(20):
        playback.single_step()
        playback.advance(0.0)
        total += playback._reward
    return playback, total


def test_return_is_the_sum_of_the_rewards_of_the_episode(played):
    playback, total = played
    assert playback.view.episodes == 0
    assert playback.view.episode_return == pytest.approx(float(total[1]), rel=1e-5)
    assert playback.view.last_episode == ""


def test_curves_have_one_line_for_the_reward_and_for_each_term(played):
    playback, _ = played
    curves = playback.view.curves
    terms = [term.name for term in playback.env.reward_manager.terms]
    assert [name for name, _ in curves.values] == ["reward", *terms]
    points = dict(curves.values)
    assert len(curves.time_s) == len(points["reward"]) == 10  # every second step: 5 s of 1/60 s are at most 150 points
    assert curves.time_s[-1] == 0.0
    assert sum(points[name][-1] for name in terms) == pytest.approx(points["reward"][-1], rel=1e-4)
    assert float(playback._reward[1]) == pytest.approx(points["reward"][-1])


def test_end_of_an_episode_and_another_environment(played):
    playback, _ = played
    while not playback.view.episodes:
        playback.single_step()
        playback.advance(0.0)
    view = playback.view
    assert view.last_episode.startswith("return ")
    assert view.last_episode.endswith(" steps, time_out")
    assert view.episode_return == 0.0
    assert view.succeeded in (0, 1)
    playback.show(2)
    playback.advance(0.0)
    assert playback.view.curves.values == ()
    playback.reset()
    playback.advance(0.0)
    assert playback.view.episode_return == 0.0
