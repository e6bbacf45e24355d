"""95 % confidence intervals of success rates, of mean returns, and of the difference between two policies.

Evaluations print the intervals; `rlcli train --until` compares a limit with them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NORMAL = 1.959963984540054
"""97.5 % quantile of the standard normal distribution."""
RESAMPLES = 2000
"""Number of bootstrap samples."""
_GRID = 20_001
"""Number of points of the numerical integration in `student_quantile`."""
_SEED = 0
"""Seed of the bootstrap samples; it is fixed so that the same values always give the same interval."""
_BLOCK = 2**21
"""Largest number of random indices of bootstrap samples that are in memory at a time."""


def proportion(hits: int, count: int) -> dict[str, float]:
    """Return the `rate` hits / count, and the ends `low` and `high` of its 95 % Wilson score interval (Wilson 1927)."""
    z = NORMAL
    rate = hits / count
    middle = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    # for 0 and for `count` hits the formula gives 0 and 1 except for a rounding error
    return {"rate": rate, "low": middle - half if hits else 0.0, "high": middle + half if hits < count else 1.0}


def mean(values: Sequence[float]) -> dict[str, float | None]:
    """Return `mean` and `std` of values, and the ends `low` and `high` of Student's 95 % interval of the mean.

    Both ends are None for a single value.
    """
    count = len(values)
    middle = math.fsum(values) / max(1, count)  # exact: the result does not depend on the order of the episodes
    if count < 2:
        return {"mean": middle, "std": 0.0, "low": None, "high": None}
    std = math.sqrt(math.fsum((v - middle) ** 2 for v in values) / (count - 1))
    half = student_quantile(count - 1) * std / math.sqrt(count)
    return {"mean": middle, "std": std, "low": middle - half, "high": middle + half}


@functools.lru_cache(maxsize=256)
def student_quantile(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t distribution with `freedom` degrees of freedom.

    With t = sqrt(freedom) tan(a), P(|T| < t) is the integral of cos(x)^(freedom - 1) from 0 to a, divided by the
    integral from 0 to pi / 2.
    """
    if freedom > 500:  # first terms of the expansion, Abramowitz and Stegun 26.7.5
        z = NORMAL
        return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
    angle = np.linspace(0.0, math.pi / 2, _GRID)
    density = np.cos(angle) ** (freedom - 1)
    below = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2)])
    return math.sqrt(freedom) * math.tan(float(np.interp(0.95, below / below[-1], angle)))


def difference(left: Sequence[float], right: Sequence[float]) -> dict[str, float | None]:
    """Return the `mean` of left[i] - right[i], and the ends `low` and `high` of its 95 % interval.

    The interval is a percentile bootstrap (Efron 1979); both ends are None for a single pair of values.
    """
    gaps = np.asarray(left, dtype=np.float64) - np.asarray(right, dtype=np.float64)
    middle = float(gaps.mean())
    if len(gaps) < 2:
        return {"mean": middle, "low": None, "high": None}
    low, high = _percentiles(np.concatenate([gaps[rows].mean(axis=1) for rows in _resampled(len(gaps))]))
    return {"mean": middle, "low": low, "high": high}


def improvement(left: Sequence[float], right: Sequence[float]) -> dict[str, float | None]:
    """Return the `probability` that a random value of `left` exceeds a random value of `right`, with `low` and `high`.

    The values are of episodes, such as their returns. A pair of equal values counts one half. The probability is the
    statistic of Mann and Whitney (1947) as a probability of improvement (Agarwal et al. 2021). `low` and `high` are the
    ends of its 95 % bootstrap interval, None for a single pair. The bootstrap resamples episodes with the same index in
    both lists together, because they start in the same state.
    """
    one, other = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    probability = _exceeds(one, other)
    if len(one) < 2:
        return {"probability": probability, "low": None, "high": None}
    rows = np.concatenate(list(_resampled(len(one))))
    low, high = _percentiles(np.array([_exceeds(one[chosen], other[chosen]) for chosen in rows]))
    return {"probability": probability, "low": low, "high": high}


def _exceeds(left: NDArray[np.float64], right: NDArray[np.float64]) -> float:
    """Return the fraction of all pairs whose left value is larger; a pair of equal values counts one half."""
    order = np.sort(right)
    below, up_to = np.searchsorted(order, left, "left"), np.searchsorted(order, left, "right")
    return float((below + up_to).sum()) / (2.0 * len(left) * len(right))


def _resampled(count: int) -> list[NDArray[np.int64]]:
    """Return the indices of all bootstrap samples of `count` values, drawn with replacement; one sample a row.

    The rows are split into blocks (n, count) of at most `_BLOCK` numbers.
    """
    generator = np.random.default_rng(_SEED)
    block = max(1, _BLOCK // count)
    starts = range(0, RESAMPLES, block)
    return [generator.integers(0, count, (min(block, RESAMPLES - start), count)) for start in starts]


def _percentiles(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
