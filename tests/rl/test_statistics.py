"""Tests of episode statistics with hand-made episodes."""

import json

import pytest
import torch

from rlcli.envs.step_result import Episodes
from rlcli.rl.episode_statistics import EpisodeStatistics

LENGTH_S = 2.0


def make_episodes(returns, lengths, fell, success=None, mask=None):
    returns, fell = torch.tensor(returns), torch.tensor(fell)
    return Episodes(
        ids=torch.arange(len(returns)),
        returns=returns,
        lengths=torch.tensor(lengths),
        reward_terms={"upright": returns * 0.75, "effort": returns * 0.25},
        causes={"time_out": ~fell, "fell": fell},
        truncated=~fell,
        success=None if success is None else torch.tensor(success),
        mask=None if mask is None else torch.tensor(mask),
    )


TWO = make_episodes([4.0, 8.0], [10, 20], [True, False], [False, True])
METRICS = {
    "Train/mean_reward": 6.0,
    "Train/mean_episode_length": 15.0,
    "Train/success_rate": 0.5,
    "Episode_Reward/upright": 2.25,
    "Episode_Reward/effort": 0.75,
    "Episode_Termination/time_out": 0.5,
    "Episode_Termination/fell": 0.5,
}


@pytest.mark.parametrize("mode", [torch.enable_grad, torch.no_grad, torch.inference_mode])
def test_metrics_do_not_depend_on_gradient_mode(mode):
    statistics = EpisodeStatistics(LENGTH_S)
    for _ in range(3):
        with mode():
            statistics.add(None)
            statistics.add(TWO)
        assert statistics.flush() == pytest.approx(METRICS)
    assert statistics.total == 6


def test_sums_continue_in_inference_mode():
    statistics = EpisodeStatistics(LENGTH_S)
    statistics.add(TWO)
    with torch.inference_mode():
        statistics.add(make_episodes([4.0, 8.0], [10, 20], [True, False], [False, True]))
    assert statistics.flush() == pytest.approx(METRICS)
    assert statistics.total == 4


def test_masked_rows_do_not_count():
    statistics = EpisodeStatistics(LENGTH_S)
    columns = [4.0, 99.0, 8.0], [10, 77, 20], [True, True, False], [False, True, True]
    statistics.add(make_episodes(*columns, mask=[True, False, True]))
    assert statistics.flush() == pytest.approx(METRICS)
    statistics.add(make_episodes(*columns, mask=[False, False, False]))
    means = {name: value for name, value in METRICS.items() if name.startswith("Train/")}
    assert statistics.flush() == pytest.approx(means), "without an episode a mean is left out"
    assert statistics.total == 2


def test_no_success_rate_without_success_condition():
    statistics = EpisodeStatistics(LENGTH_S)
    statistics.add(make_episodes([1.0], [5], [False]))
    assert "Train/success_rate" not in statistics.flush()


def test_no_metrics_before_an_episode_ends():
    assert EpisodeStatistics(LENGTH_S).flush() == {}


def test_means_cover_last_iterations_with_100_episodes():
    statistics = EpisodeStatistics(LENGTH_S)
    for value in (1.0, 2.0, 3.0):
        statistics.add(make_episodes([value] * 60, [10] * 60, [False] * 60))
        metrics = statistics.flush()
    assert metrics["Train/mean_reward"] == 2.5  # mean of the last two iterations
    statistics.add(make_episodes([7.0] * 100, [10] * 100, [False] * 100))
    assert statistics.flush()["Train/mean_reward"] == 7.0


def test_state_restores_from_json():
    statistics, other = EpisodeStatistics(LENGTH_S), EpisodeStatistics(LENGTH_S)
    for value in (0.1, 0.7):
        statistics.add(make_episodes([value] * 40, [10] * 40, [False] * 40, [True] * 40))
        statistics.flush()
    other.add(TWO)
    other.flush()
    other.load(json.loads(json.dumps(statistics.state())))
    for each in (statistics, other):
        each.add(TWO)
    assert statistics.flush() == other.flush()
    assert statistics.total == other.total == 82
    assert statistics.state() == other.state()
