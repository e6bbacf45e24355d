"""Intervals: how far a share, a mean or a comparison of finished episodes can be trusted. All are of 95 %."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NORMAL = 1.959963984540054
"""97.5 % of the standard normal distribution lie below."""
RESAMPLES = 2000
"""Of a bootstrap."""
_GRID = 20_001
_SEED = 0
"""The same numbers always give the same interval."""
_BLOCK = 2**21


def proportion(hits: int, count: int) -> dict[str, float]:
    """A share with its interval: Wilson's score interval (Wilson 1927)."""
    z = NORMAL
    share = hits / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    # at the ends the formula gives 0 and 1 but for rounding
    return {"rate": share, "low": middle - half if hits else 0.0, "high": middle + half if hits < count else 1.0}


def mean(values: Sequence[float]) -> dict[str, float | None]:
    """A mean with Student's t interval; of a single value nothing is known about how far others lie."""
    count = len(values)
    middle = math.fsum(values) / max(1, count)  # exact, so that no order of the episodes shows
    if count < 2:
        return {"mean": middle, "std": 0.0, "low": None, "high": None}
    std = math.sqrt(math.fsum((v - middle) ** 2 for v in values) / (count - 1))
    half = student(count - 1) * std / math.sqrt(count)
    return {"mean": middle, "std": std, "low": middle - half, "high": middle + half}


@functools.lru_cache(maxsize=256)
def student(freedom: int) -> float:
    """97.5 % of Student's t distribution with so many degrees of freedom lie below.

    With t = sqrt(freedom) tan(a), P(|T| < t) is the integral of cos(a)^(freedom - 1) from 0 to a, as a share of that
    to pi / 2.
    """
    if freedom > 500:  # the first terms of its expansion, Abramowitz and Stegun 26.7.5
        z = NORMAL
        return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
    angle = np.linspace(0.0, math.pi / 2, _GRID)
    density = np.cos(angle) ** (freedom - 1)
    below = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2)])
    return math.sqrt(freedom) * math.tan(float(np.interp(0.95, below / below[-1], angle)))


def difference(left: Sequence[float], right: Sequence[float]) -> dict[str, float | None]:
    """The mean of left - right over pairs, with a bootstrap interval of percentiles (Efron 1979)."""
    gaps = np.asarray(left, dtype=np.float64) - np.asarray(right, dtype=np.float64)
    middle = float(gaps.mean())
    if len(gaps) < 2:
        return {"mean": middle, "low": None, "high": None}
    low, high = _percentiles(np.concatenate([gaps[rows].mean(axis=1) for rows in _resampled(len(gaps))]))
    return {"mean": middle, "low": low, "high": high}


def improvement(left: Sequence[float], right: Sequence[float]) -> dict[str, float | None]:
    """P(left > right) + P(left = right) / 2 of one episode each, with a bootstrap interval over the pairs.

    The statistic of Mann and Whitney (1947), as a probability of improvement (Agarwal et al. 2021). Episodes of equal
    place in the two lists are resampled together: they began alike.
    """
    one, other = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    share = _exceeds(one, other)
    if len(one) < 2:
        return {"probability": share, "low": None, "high": None}
    rows = np.concatenate(list(_resampled(len(one))))
    low, high = _percentiles(np.array([_exceeds(one[chosen], other[chosen]) for chosen in rows]))
    return {"probability": share, "low": low, "high": high}


def _exceeds(left: NDArray[np.float64], right: NDArray[np.float64]) -> float:
    """The share of all pairs in which the left is larger; equal ones count half."""
    order = np.sort(right)
    below, up_to = np.searchsorted(order, left, "left"), np.searchsorted(order, left, "right")
    return float((below + up_to).sum()) / (2.0 * len(left) * len(right))


def _resampled(count: int) -> list[NDArray[np.int64]]:
    """Rows drawn with replacement, in blocks of at most so many numbers. (n, count) each"""
    generator = np.random.default_rng(_SEED)
    block = max(1, _BLOCK // count)
    starts = range(0, RESAMPLES, block)
    return [generator.integers(0, count, (min(block, RESAMPLES - start), count)) for start in starts]


def _percentiles(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)
