"""Evaluation of episodes with known lengths and causes, and intervals against published values."""

import pytest
import torch

from rlcli.errors import ConfigError
from rlcli.evaluation.evaluate import evaluate
from rlcli.rl.action_functions import random_policy, zero_policy
from rlcli.rl.episode_statistics import EpisodeStatistics


@pytest.mark.parametrize("episodes", [1, 3, 4, 10])
def test_evaluate_runs_the_first_episodes_of_each_environment(make, scheduled, episodes):
    env, _ = make(scheduled)
    result = evaluate(env, zero_policy(env), episodes)
    assert len(result.returns) == episodes
    # environments end after 2, 3, 3 and 1 steps, rewards are 11, 12, 13
    share = [episodes // 4 + (row < episodes % 4) for row in range(4)]
    wanted = sorted(n for n, count in zip((2, 3, 3, 1), share, strict=True) for _ in range(count))
    assert sorted(result.lengths) == wanted
    totals = {1: 11.0, 2: 23.0, 3: 36.0}
    assert sorted(result.returns) == sorted(totals[n] for n in result.lengths)
    # ended by time alone: the second environment only, the third was terminated in the same step
    assert sum(result.truncated) == share[1]


def test_summary_has_rates_of_terminations(make, scheduled):
    env, _ = make(scheduled)
    summary = evaluate(env, zero_policy(env), 8).summary()
    shares = {name: share["rate"] for name, share in summary["terminations"].items()}
    assert shares == {"time_out": 0.5, "task": 0.75}
    assert summary["length"]["mean"] == pytest.approx(9 / 4)
    assert "success" not in summary


def test_summary_has_means_of_command_metrics(make):
    env, _ = make("quadruped-flat", "scene.num_envs=4", "episode_length_s=0.2")
    seen = []

    def keep(step):
        if step.episodes is not None:
            seen.append(step.episodes.metrics["velocity/error_vel_xy"])

    result = evaluate(env, zero_policy(env), 8, keep)
    errors = torch.cat(seen).tolist()
    assert len(set(errors)) == 8
    assert sorted(result.values["velocity/error_vel_xy"]) == pytest.approx(sorted(errors))
    summary = result.summary()["values"]
    assert set(summary) == {"velocity/error_vel_xy", "velocity/error_vel_yaw"}
    assert summary["velocity/error_vel_xy"]["mean"] == pytest.approx(sum(errors) / 8)
    assert summary["velocity/error_vel_xy"]["low"] < sum(errors) / 8 < summary["velocity/error_vel_xy"]["high"]
    assert (
        result.part(0, 1).values["velocity/error_vel_xy"]
        == result.in_environment_order().values["velocity/error_vel_xy"][:2]
    )


def test_groups_run_equal_numbers_of_episodes(make, scheduled):
    env, _ = make(scheduled, "scene.num_envs=8")
    result = evaluate(env, zero_policy(env), 6, groups=2)
    alone = evaluate(make(scheduled)[0], zero_policy(make(scheduled)[0]), 6)
    assert (
        result.part(0, 4).in_environment_order().lengths == alone.in_environment_order().lengths == [2, 2, 3, 3, 3, 1]
    )
    assert result.part(4, 8).envs == result.part(0, 4).envs
    assert result.part(4, 8).summary()["episodes"] == 6


def test_episode_without_end_raises_config_error(make):
    env, _ = make("cartpole", "scene.num_envs=2", "episode_length_s=0.1", "terminations.time_out=null",
                  "terminations.cart_out_of_bounds=null")  # fmt: skip
    with pytest.raises(ConfigError, match="has not ended") as caught:
        evaluate(env, zero_policy(env), 2)
    assert "time_out: true" in str(caught.value)


def test_random_policy_fills_the_bound_and_repeats_with_its_seed(make, scheduled):
    env, _ = make(scheduled, "scene.num_envs=500")
    actions = [random_policy(env, 0.5, 7)(torch.zeros(500, 2)) for _ in range(2)]
    assert torch.equal(*actions)
    assert 0.45 < float(actions[0].abs().max()) <= 0.5
    assert float(random_policy(env, None, 7)(torch.zeros(500, 2)).std()) == pytest.approx(1.0, abs=0.15)


def test_statistics_have_the_names_of_rsl_rl(make):
    env, _ = make("cartpole", "scene.num_envs=3", "episode_length_s=0.1")
    statistics = EpisodeStatistics(env.config.episode_length_s)
    env.reset(seed=1)
    returns = []
    for _ in range(12):
        episodes = env.step(torch.zeros(3, 1)).episodes
        statistics.add(episodes)
        returns += episodes.returns.tolist() if episodes is not None else []
    metrics = statistics.flush()
    assert metrics["Train/mean_reward"] == pytest.approx(sum(returns) / len(returns))
    assert metrics["Train/mean_episode_length"] == 6
    # the terms' mean episodic sums over the episode's length in seconds add up to the return's
    total = sum(value for name, value in metrics.items() if name.startswith("Episode_Reward/"))
    assert total * 0.1 == pytest.approx(metrics["Train/mean_reward"], rel=1e-4)
    assert metrics["Episode_Termination/time_out"] == 1.0
    assert "Episode_Termination/time_out" not in statistics.flush()  # nothing ended since
