import numpy as np
import pytest
import torch

from rlcli import random
from rlcli.sim.env_selection import IdSelection

N = 100_000
S = random.stream("rewards.pole")


def keys(seed=0, envs=None, counters=None):
    envs = np.arange(N) if envs is None else np.asarray(envs)
    counters = np.zeros_like(envs) if counters is None else np.asarray(counters)
    return random.row_keys(seed, envs, counters)


def one(seed, env, counter, index, stream=S):
    return random.uniform(keys(seed, [env], [counter]), stream, index, 1)[0, 0]


def test_sample_does_not_depend_on_other_rows():
    alone = random.normal(keys(3, [7], [2]), S, 5, 4)
    crowd = random.normal(keys(3, np.arange(50), np.full(50, 2)), S, 5, 4)
    np.testing.assert_array_equal(alone[0], crowd[7])


def test_words_of_stream_do_not_depend_on_chunk_size():
    at_once = random.bits(keys(1, [4]), S, 0, 6)[0]
    one_by_one = [random.bits(keys(1, [4]), S, i, 1)[0, 0] for i in range(6)]
    np.testing.assert_array_equal(at_once, one_by_one)


@pytest.mark.parametrize("other", [(1, 5, 2, 3), (0, 6, 2, 3), (0, 5, 3, 3), (0, 5, 2, 4)])
def test_every_argument_changes_sample(other):
    assert one(0, 5, 2, 3) != one(*other)


def test_streams_differ_by_name():
    assert one(0, 5, 2, 3) != one(0, 5, 2, 3, random.stream("rewards.cart"))


@pytest.mark.parametrize(("a", "b"), [((0, 1, 0), (1, 0, 0)), ((0, 0, 1), (0, 1, 0)), ((1, 0, 0), (0, 0, 1))])
def test_swapped_seed_env_and_counter_give_other_samples(a, b):
    assert not np.array_equal(
        random.bits(keys(a[0], [a[1]], [a[2]]), S, 0, 8), random.bits(keys(b[0], [b[1]], [b[2]]), S, 0, 8)
    )


def test_keys_are_unique_over_envs_seeds_and_counters():
    grid = np.stack(np.meshgrid(np.arange(200), np.arange(200)), -1).reshape(-1, 2)
    all_keys = np.concatenate([keys(seed, grid[:, 0], grid[:, 1]) for seed in (0, 1, 2, -1)])
    assert len(np.unique(all_keys)) == len(all_keys)


def test_uniform_range_and_moments():
    u = random.uniform(keys(), S, 0, 1)[:, 0].astype(np.float64)
    assert u.dtype == np.float64
    assert 0.0 <= u.min() < 1e-3
    assert 1 - 1e-3 < u.max() < 1.0
    assert abs(u.mean() - 0.5) < 0.005
    assert abs(u.var() - 1 / 12) < 0.002
    counts, _ = np.histogram(u, bins=20, range=(0, 1))
    assert abs(counts - N / 20).max() < 6 * np.sqrt(N / 20)


def test_normal_moments_and_tails():
    z = random.normal(keys(), S, 0, 1)[:, 0].astype(np.float64)
    assert np.isfinite(z).all()
    assert abs(z.mean()) < 0.02
    assert abs(z.std() - 1) < 0.02
    assert abs((z**3).mean()) < 0.05
    assert abs((z**4).mean() - 3) < 0.15
    assert abs((np.abs(z) > 2).mean() - 0.0455) < 0.005


def test_integers_are_in_range_and_uniform():
    k = random.integers(keys(), S, 0, 1, 7)[:, 0]
    assert k.dtype == np.int64
    counts = np.bincount(k, minlength=7)
    assert len(counts) == 7
    assert abs(counts - N / 7).max() < 6 * np.sqrt(N / 7)


def draws_of(kind):
    if kind == "environments":
        u = random.uniform(keys(), S, 0, 1)[:, 0]
        return u[:-1], u[1:]
    if kind == "counters":
        zero = np.zeros(N, np.int64)
        u = random.uniform(keys(0, zero, np.arange(N)), S, 0, 1)[:, 0]
        return u[:-1], u[1:]
    if kind == "indices":
        u = random.uniform(keys(), S, 0, 2)
        return u[:, 0], u[:, 1]
    if kind == "seeds":
        return random.uniform(keys(0), S, 0, 1)[:, 0], random.uniform(keys(1), S, 0, 1)[:, 0]
    return random.uniform(keys(), S, 0, 1)[:, 0], random.uniform(keys(), random.stream("b"), 0, 1)[:, 0]


@pytest.mark.parametrize("kind", ["environments", "counters", "indices", "seeds", "streams"])
def test_neighbouring_samples_are_uncorrelated(kind):
    a, b = draws_of(kind)
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.015


def test_derived_seeds_have_31_bits_and_differ():
    seeds = {random.derive(seed, name) for seed in (0, 1, 42, -1, 2**40) for name in ("play", "evaluation")}
    assert len(seeds) == 10
    assert all(0 <= seed < 2**31 for seed in seeds)


def selection(ids, counters=None, seed=0):
    ids = np.asarray(ids)
    return IdSelection(ids, seed, np.zeros_like(ids) if counters is None else np.asarray(counters), S)


def test_selection_samples_differ_and_ignore_other_rows():
    def draw(ids):
        s = selection(ids)
        return s.uniform(-2, 3, (2,)), s.normal(1.0, 2.0, (3,)), s.choice(5), s.uniform(-2, 3, (2,))

    many, few = draw(range(10)), draw([3, 8])
    assert [tuple(v.shape) for v in few] == [(2, 2), (2, 3), (2,), (2, 2)]
    for a, b in zip(many, few, strict=True):
        assert torch.equal(a[[3, 8]], b)
    assert not torch.equal(few[0], few[3])


def test_selection_uniform_stays_in_bounds():
    drawn = selection(range(N)).uniform(-0.3, 0.7)
    assert -0.3 <= float(drawn.min()) < -0.299
    assert 0.699 < float(drawn.max()) <= 0.7


def test_selection_reads_writes_and_adds_only_its_rows():
    field = torch.zeros(5, 4, dtype=torch.float64)
    s = selection([1, 3])
    s.write(field, torch.ones(2, 4))
    s.add(field, torch.full((2, 2), 2.0), torch.tensor([3, 0]))
    s.write(field, 7.0, slice(1, 2))
    expected = torch.zeros(5, 4, dtype=torch.float64)
    expected[[1, 3]] = torch.tensor([3.0, 7.0, 1.0, 3.0], dtype=torch.float64)
    assert torch.equal(field, expected)
    assert torch.equal(s.read(field, torch.tensor([1, 0])), torch.tensor([[7.0, 3.0]] * 2, dtype=torch.float64))
    field[3, 0] = -1
    assert float(s.mean(field[:, 0])) == 1.0
