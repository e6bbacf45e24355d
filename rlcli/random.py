"""Counter-based random numbers: each number depends only on (seed, stream, environment, counter, index).

So an environment draws the same numbers for any number of environments and threads, and for any order in which other
environments reset or sample. A stream is a sequence of random numbers for one purpose, such as a term; the counter is
the number of an episode or step. The mixing function is the finaliser of SplitMix64 (Steele, Lea and Flood 2014,
https://doi.org/10.1145/2660193.2660195).
"""

import functools
import hashlib

import numpy as np
from numpy.typing import NDArray

Keys = NDArray[np.uint64]
"""Keys: 64-bit numbers from which random numbers are computed, one for each (seed, environment, counter)."""

# 0-d arrays instead of scalars: numpy converts each scalar operand to an array, which takes as long as the operation
_GOLDEN = np.array(0x9E3779B97F4A7C15, np.uint64)
_MIX1 = np.array(0xBF58476D1CE4E5B9, np.uint64)
_MIX2 = np.array(0x94D049BB133111EB, np.uint64)
_S30, _S27, _S31, _S40 = (np.array(shift, np.uint64) for shift in (30, 27, 31, 40))
_TO_UNIT = np.array(2.0**-24, np.float32)
_NARROW = 8
"""Number of words per key up to which numpy is faster if its inner loop runs over the keys instead of the words."""
_BLOCK = 1 << 14
"""Number of 64-bit values that are hashed at once, so that their copies stay in the cache of a core."""


@functools.lru_cache(maxsize=4096)
def stream(name: str) -> np.uint64:
    """Return the number of the random stream with a name (such as a term's name): 64 bits of its BLAKE2b hash."""
    return np.uint64(int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "little"))


def mix(x: Keys) -> Keys:
    """Mix the bits of 64-bit words in place with SplitMix64's finaliser: every output bit depends on all input bits.

    Overflow of the products is intended: the arithmetic is modulo 2**64.
    """
    x ^= x >> _S30
    x *= _MIX1
    x ^= x >> _S27
    x *= _MIX2
    x ^= x >> _S31
    return x


def row_keys(seed: int, env_ids: NDArray[np.int64], counters: NDArray[np.int64]) -> Keys:
    """Return a key for each pair of an environment and a counter, from which its random numbers are computed. (n,)

    Args:
        seed: the seed.
        env_ids: indices of environments. (n,)
        counters: number of the episode or step of each of these environments. (n,)
    """
    keys = mix(env_ids.astype(np.uint64) * _GOLDEN + start(seed))
    keys += counters.astype(np.uint64) * _GOLDEN
    return mix(keys)


def bits(keys: Keys, stream: np.uint64, index: int, count: int) -> Keys:
    """Return random 64-bit words for each key. (n, count)

    Args:
        keys: keys from `row_keys`. (n,)
        stream: number of the random stream, from `stream(name)`.
        index: index in the stream of the first word to return.
        count: number of words for each key.
    """
    offsets = _offsets(int(stream), index, count)
    if count > _NARROW:
        return mix(keys[:, None] + offsets)
    return mix(keys + offsets[:, None]).T  # numpy's inner loop then runs over the keys


def uniform(keys: Keys, stream: np.uint64, index: int, count: int) -> NDArray[np.float32]:
    """Return uniform random numbers in [0, 1), multiples of 2**-24; for the arguments see `bits`. (n, count)"""
    rows = max(1, _BLOCK // max(1, count))
    if len(keys) <= rows:
        return _to_unit(bits(keys, stream, index, count))
    unit = np.empty((len(keys), count), np.float32)
    for first in range(0, len(keys), rows):
        unit[first : first + rows] = _to_unit(bits(keys[first : first + rows], stream, index, count))
    return unit


def _to_unit(words: Keys) -> NDArray[np.float32]:
    """Convert random 64-bit words to numbers in [0, 1), of the same shape. The words are overwritten."""
    words >>= _S40  # 24 bits remain, as many as the significand of a float32 holds exactly
    unit = words.view(np.int64).astype(np.float32, order="C")  # numpy converts signed words faster
    unit *= _TO_UNIT
    return unit


def normal(keys: Keys, stream: np.uint64, index: int, count: int) -> NDArray[np.float32]:
    """Return standard normal random numbers, each from two uniform numbers (Box-Muller). (n, count)

    For the arguments see `bits`.
    """
    u = uniform(keys, stream, index, 2 * count)
    # log1p(-u) with u in [0, 1) is finite; log(u) would be -inf at u = 0
    radius = np.sqrt(-2.0 * np.log1p(-u[:, :count].astype(np.float64)))
    values: NDArray[np.float32] = (radius * np.cos(2.0 * np.pi * u[:, count:])).astype(np.float32)
    return values


def integers(keys: Keys, stream: np.uint64, index: int, count: int, high: int) -> NDArray[np.int64]:
    """Return uniform random integers from 0 to `high` - 1; for the other arguments see `bits`. (n, count)"""
    return (uniform(keys, stream, index, count).astype(np.float64) * high).astype(np.int64)


def derive(seed: int, name: str) -> int:
    """Return a 31-bit seed for another random generator, such as torch's.

    Args:
        seed: the seed of the training or evaluation.
        name: purpose of the generator; seeds for different purposes are independent.
    """
    return int(mix(_word(seed) ^ stream(name))[0] >> np.uint64(33))


@functools.lru_cache
def start(seed: int) -> Keys:
    """Return the 64-bit word of a seed from which `row_keys` computes all keys. (1,)"""
    return mix(_word(seed) + _GOLDEN)


@functools.lru_cache(maxsize=4096)
def _offsets(stream: int, index: int, count: int) -> Keys:
    """Return the numbers that are added to a key before mixing, one for each index of the stream. (count,)"""
    return np.arange(index + 1, index + count + 1, dtype=np.uint64) * _GOLDEN + np.uint64(stream)


def _word(seed: int) -> Keys:
    """Return the lowest 64 bits of a seed. (1,)"""
    return np.array([seed & 0xFFFFFFFFFFFFFFFF], np.uint64)
