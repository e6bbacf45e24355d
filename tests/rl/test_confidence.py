"""Tests of confidence intervals against published tables and hand-computed numbers."""

import numpy as np
import pytest

from rlcli.rl.confidence import difference, improvement, mean, proportion, student_quantile


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"),
    [
        # Newcombe 1998, "Two-sided confidence intervals for the single proportion", table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_proportion_matches_published_wilson_intervals(hits, count, low, high):
    interval = proportion(hits, count)
    assert interval["rate"] == hits / count
    assert interval["low"] == pytest.approx(low, abs=5e-5)
    assert interval["high"] == pytest.approx(high, abs=5e-5)


def test_proportion_interval_ends_at_zero_and_one():
    assert proportion(20, 20)["high"] == 1.0
    assert proportion(0, 20)["low"] == 0.0
    assert proportion(20, 20)["low"] == pytest.approx(1 - 0.1611, abs=5e-5)


@pytest.mark.parametrize(
    ("freedom", "quantile"),
    # table of Student's t distribution, quantile 0.975
    [(1, 12.706), (2, 4.303), (3, 3.182), (10, 2.228), (30, 2.042), (120, 1.980), (499, 1.965), (501, 1.965)],
)
def test_student_quantile_matches_tables(freedom, quantile):
    assert student_quantile(freedom) == pytest.approx(quantile, abs=6e-4)


def test_mean_has_student_interval():
    values = [1.0, 2.0, 3.0, 4.0]  # std sqrt(5/3), t of 3 degrees 3.182
    assert mean(values) == pytest.approx({"mean": 2.5, "std": 1.29099, "low": 0.4457, "high": 4.5543}, abs=1e-4)


def test_single_value_has_no_interval():
    assert mean([3.0]) == {"mean": 3.0, "std": 0.0, "low": None, "high": None}
    assert difference([3.0], [1.0]) == {"mean": 2.0, "low": None, "high": None}
    assert improvement([3.0], [1.0]) == {"probability": 1.0, "low": None, "high": None}


@pytest.mark.parametrize("samples", [8, 60])
def test_mean_interval_covers_true_mean_in_95_percent(samples):
    generator = np.random.default_rng(1)
    inside = 0
    for _ in range(1000):
        found = mean(generator.normal(2.0, 3.0, samples).tolist())
        inside += found["low"] < 2.0 < found["high"]
    assert 0.93 < inside / 1000 < 0.97


@pytest.mark.parametrize(
    ("left", "right", "probability"),
    [
        # (wins + ties / 2) / all pairs, counted by hand
        ([1, 2, 3], [0, 0, 0], 1.0),
        ([0, 0, 1], [1, 2, 3], 0.5 / 9),
        ([1, 3], [2, 2], 0.5),
        ([1, 2, 5], [2, 2, 3], (0 + 1 + 3) / 9),
        ([True, True, False], [True, False, False], (1 * 2 * 2 + 0.5 * (2 * 1 + 1 * 2)) / 9),
    ],
)
def test_improvement_matches_hand_computation(left, right, probability):
    assert improvement(left, right)["probability"] == pytest.approx(probability)


def test_comparison_of_a_sample_with_itself_is_neutral():
    values = np.random.default_rng(3).normal(size=50).tolist()
    assert improvement(values, values)["probability"] == 0.5
    assert difference(values, values) == {"mean": 0.0, "low": 0.0, "high": 0.0}


def test_comparison_intervals_cover_true_values_and_exclude_zero():
    generator = np.random.default_rng(5)
    inside = covered = 0
    for _ in range(60):
        base = generator.normal(size=40)
        left, right = base + generator.normal(0.5, 0.3, 40), base
        found = difference(left.tolist(), right.tolist())
        inside += found["low"] < 0.5 < found["high"]
        assert found["high"] < 1.0
        # P(left > right) for normal distributions with variances 1.09 and 1 and a distance of 0.5
        chance = improvement(left.tolist(), right.tolist())
        covered += chance["low"] < 0.635 < chance["high"]
        assert chance["low"] > 0.5
    assert inside >= 52
    assert covered >= 52
