"""Tests of `MaskSelection`: it equals `IdSelection` in the masked rows and does not change the others."""

import numpy as np
import pytest
import torch

from rlcli import random
from rlcli.sim.env_selection import IdSelection
from rlcli.sim.gpu_env_selection import MaskSelection

N = 11
MASK = torch.tensor([i in (0, 3, 4, 9) for i in range(N)])
IDS = MASK.nonzero()[:, 0]
COUNTERS = torch.arange(N) * 7 + 2


def both(seed=5, mask=MASK, counters=COUNTERS):
    ids = mask.nonzero()[:, 0].numpy()
    return IdSelection(ids, seed, counters.numpy()[ids]), MaskSelection(mask, seed, counters)


def close(by_id, by_mask, ulp=1):
    """Compare up to one unit in the last place: a compiler may fuse a product and a sum."""
    np.testing.assert_array_max_ulp(by_id.numpy(), by_mask[IDS].numpy(), ulp)


# --- draws ---


@pytest.mark.parametrize("seed", [0, 5, -1, 2**63])
@pytest.mark.parametrize("name", [None, "events.reset_joints"])
@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 4)])
def test_uniform_equals_id_selection(seed, name, shape):
    by_id, by_mask = both(seed)
    if name:
        by_id, by_mask = (s.stream(random.stream(name)) for s in (by_id, by_mask))
    for low, high in ((0.0, 1.0), (-2.0, 3.0), (0.5, 0.5)):  # consecutive draws use new random words
        drawn = by_mask.uniform(low, high, shape)
        assert drawn.shape == (N, *shape)
        assert drawn.dtype == torch.float32
        scale = max(abs(low), abs(high))
        torch.testing.assert_close(by_id.uniform(low, high, shape), drawn[IDS], rtol=0, atol=2**-23 * scale)
    assert len(drawn[IDS].unique()) == 1  # of [0.5, 0.5)
    assert torch.equal(by_id.uniform(0.0, 1.0, shape), by_mask.uniform(0.0, 1.0, shape)[IDS]), "bit for bit in [0, 1)"


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (torch.tensor([-1.0, 0.0, 2.0]), torch.tensor([1.0, 0.5, 2.0])),
        (torch.tensor([-1.0, 0.0, 2.0]), 3.0),
        (-3.0, torch.tensor([1.0, 0.5, 2.0])),
        (torch.tensor([[-1.0], [2.0]]), torch.tensor([[1.0], [5.0]])),
    ],
)
def test_uniform_accepts_bounds_per_column(low, high):
    by_id, by_mask = both()
    shape = (3,) if torch.broadcast_tensors(torch.as_tensor(low), torch.as_tensor(high))[0].dim() == 1 else (2, 3)
    expected, found = by_id.uniform(low, high, shape), by_mask.uniform(low, high, shape)
    assert found.shape == (N, *shape)
    torch.testing.assert_close(expected, found[IDS], rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", [(), (2,), (3, 5)])
def test_normal_equals_id_selection(shape):
    by_id, by_mask = both()
    for mean, std in ((0.0, 1.0), (4.0, 0.1), (torch.tensor(2.0), torch.tensor(3.0))):
        expected, found = by_id.normal(mean, std, shape), by_mask.normal(mean, std, shape)
        assert found.shape == (N, *shape)
        torch.testing.assert_close(expected, found[IDS], rtol=1e-6, atol=3e-6)
    assert torch.equal(by_id.uniform(0.0, 1.0), by_mask.uniform(0.0, 1.0)[IDS]), (
        "both used the same number of random words"
    )


@pytest.mark.parametrize("options", [1, 2, 7, 100_000])
def test_choice_equals_id_selection(options):
    by_id, by_mask = both()
    expected, found = by_id.choice(options, (50,)), by_mask.choice(options, (50,))
    assert found.dtype == torch.int64
    assert torch.equal(expected, found[IDS])
    assert int(found.min()) >= 0
    assert int(found.max()) < options


def test_normal_has_gaussian_moments():
    everyone = MaskSelection(torch.ones(2000, dtype=torch.bool), 1, torch.zeros(2000, dtype=torch.int64))
    drawn = everyone.normal(0.0, 1.0, (20,))
    assert drawn.isfinite().all()
    assert abs(float(drawn.mean())) < 0.02
    assert abs(float(drawn.std()) - 1.0) < 0.02
    assert abs(float((drawn.abs() < 1.0).float().mean()) - 0.6827) < 0.01


def test_draws_depend_on_seed_stream_counter_and_environment():
    base = both()[1].uniform(0.0, 1.0, (4,))
    assert not torch.equal(base, both(6)[1].uniform(0.0, 1.0, (4,)))
    assert not torch.equal(base, both()[1].stream(random.stream("x")).uniform(0.0, 1.0, (4,)))
    other = COUNTERS.clone()
    other[3] += 1
    moved = both(counters=other)[1].uniform(0.0, 1.0, (4,))
    assert (moved != base).all(dim=1).tolist() == [i == 3 for i in range(N)]
    assert torch.equal(base, both(mask=~MASK)[1].uniform(0.0, 1.0, (4,))), (
        "draws do not depend on the other selected rows"
    )


# --- reading and writing ---


COLUMNS = {
    "all": slice(None),
    "slice": slice(1, 4),
    "stepped": slice(0, None, 2),
    "one": slice(2, 3),
    "index": torch.tensor([4, 0, 3]),
    "one of an index": torch.tensor([2]),
}
DTYPES = [torch.float32, torch.float64, torch.int64, torch.bool]


def field(dtype):
    values = torch.arange(N * 5).view(N, 5)
    return values % 3 == 0 if dtype == torch.bool else values.to(dtype)


@pytest.mark.parametrize("columns", COLUMNS.values(), ids=COLUMNS)
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_write_equals_id_selection(dtype, columns):
    by_id, by_mask = both()
    expected, found = field(dtype), field(dtype)
    width = len(expected[0, columns])
    values = (torch.arange(N * width).view(N, width) * 3 + 1).to(dtype)
    by_id.write(expected, values[IDS], columns)
    by_mask.write(found, values, columns)
    assert torch.equal(expected, found)
    assert torch.equal(found[~MASK], field(dtype)[~MASK])
    assert not torch.equal(found, field(dtype))


@pytest.mark.parametrize("columns", COLUMNS.values(), ids=COLUMNS)
@pytest.mark.parametrize(("dtype", "value"), [(torch.float32, -1.5), (torch.float64, 0.1), (torch.int64, 0),
                                              (torch.int64, 0.0), (torch.bool, True)])  # fmt: skip
def test_write_number_sets_masked_rows(dtype, value, columns):
    by_id, by_mask = both()
    expected, found = field(dtype), field(dtype)
    by_id.write(expected, value, columns)
    by_mask.write(found, value, columns)
    assert torch.equal(expected, found)
    assert torch.equal(found[~MASK], field(dtype)[~MASK])


@pytest.mark.parametrize("columns", COLUMNS.values(), ids=COLUMNS)
def test_add_changes_masked_rows(columns):
    by_id, by_mask = both()
    expected, found = field(torch.float32), field(torch.float32)
    width = len(expected[0, columns])
    values = torch.rand(N, width)
    by_id.add(expected, values[IDS], columns)
    by_mask.add(found, values, columns)
    by_id.add(expected, 0.5, columns)
    by_mask.add(found, 0.5, columns)
    assert torch.equal(expected, found)
    assert torch.equal(found[~MASK], field(torch.float32)[~MASK])


def test_write_casts_values_to_field_dtype():
    by_id, by_mask = both()
    values = torch.rand(N, 5)
    for dtype in (torch.float64, torch.float32):
        expected, found = field(dtype), field(dtype)
        by_id.write(expected, values[IDS])
        by_mask.write(found, values)
        assert torch.equal(expected, found)


def test_write_accepts_one_and_three_dimensions():
    by_id, by_mask = both()
    for shape in ((N,), (N, 2, 3)):
        expected, found = torch.zeros(shape), torch.zeros(shape)
        values = torch.rand(shape)
        by_id.write(expected, values[IDS])
        by_mask.write(found, values)
        assert torch.equal(expected, found)


def test_write_broadcasts_one_row():
    by_id, by_mask = both()
    expected, found = field(torch.float32), field(torch.float32)
    by_id.write(expected, torch.tensor([7.0, 8.0, 9.0]), slice(1, 4))
    by_mask.write(found, torch.tensor([7.0, 8.0, 9.0]), slice(1, 4))
    assert torch.equal(expected, found)


def test_write_ignores_nan_in_unmasked_rows():
    _, by_mask = both()
    values = torch.full((N, 5), torch.nan)
    values[MASK] = 1.0
    found = field(torch.float32)
    by_mask.write(found, values)
    by_mask.add(found, values)
    assert torch.equal(found, torch.where(MASK[:, None], 2.0, field(torch.float32)))
    assert float(by_mask.mean(values[:, 0])) == 1.0


@pytest.mark.parametrize("columns", COLUMNS.values(), ids=COLUMNS)
def test_read_returns_copy(columns):
    by_id, by_mask = both()
    source = field(torch.float32)
    read = by_mask.read(source, columns)
    assert torch.equal(by_id.read(source, columns), read[IDS])
    read.fill_(-1.0)
    assert torch.equal(source, field(torch.float32))


def test_mean_count_and_env_ids_use_masked_rows():
    by_id, by_mask = both()
    values = torch.rand(N)
    torch.testing.assert_close(by_mask.mean(values), by_id.mean(values))
    assert float(by_mask.mean(values > 2.0)) == 0.0
    assert int(by_mask.count) == by_id.count == 4
    assert torch.equal(by_mask.env_ids(), by_id.env_ids())


def test_empty_mask_changes_nothing():
    empty = MaskSelection(torch.zeros(N, dtype=torch.bool), 5, COUNTERS)
    found = field(torch.float32)
    empty.write(found, empty.uniform(0.0, 1.0, (5,)))
    empty.add(found, 3.0)
    assert torch.equal(found, field(torch.float32))
    assert float(empty.mean(torch.ones(N))) == 0.0
    assert int(empty.count) == 0
    assert len(empty.env_ids()) == 0


def test_union_has_rows_of_both_with_same_draws():
    chosen = torch.zeros_like(MASK)
    chosen[[1, 5]] = True
    by_id, by_mask = both()
    others = both(mask=chosen)
    joined_ids, joined_mask = by_id.union(others[0]), by_mask.union(others[1])
    assert joined_ids.env_ids().tolist() == (MASK | chosen).nonzero()[:, 0].tolist()
    assert joined_mask.env_ids().tolist() == joined_ids.env_ids().tolist()
    assert torch.equal(joined_ids.uniform(0.0, 1.0), joined_mask.uniform(0.0, 1.0)[joined_ids.env_ids()])
