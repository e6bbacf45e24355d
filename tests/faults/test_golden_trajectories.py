"""Built-in tasks give the recorded trajectories."""

from itertools import product

import pytest
import support.golden_trajectories as golden
import torch
from support.fault_sizes import chosen


@pytest.fixture(autouse=True)
def _torch_threads():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize(("task", "seed"), chosen(list(product(golden.TASKS, golden.SEEDS)), 3))
def test_built_in_task_equals_its_golden_trajectory(task, seed):
    """Compare bit by bit on a machine like the recorded one, within a tolerance on another."""
    record = golden.recorded()
    then, now = record["tasks"][task][str(seed)], golden.trajectory(task, seed)
    assert golden.furthest(then["states"], now["states"]) <= golden.TOLERANCE
    if record["machine"] == golden.machine():
        assert now["sha256"] == then["sha256"]


def test_golden_trajectories_cover_all_tasks_and_move():
    record = golden.recorded()["tasks"]
    assert sorted(record) == sorted(golden.TASKS)
    for seeds in record.values():
        first, second = (seeds[str(seed)]["states"] for seed in golden.SEEDS)
        assert len(first) == 1 + golden.CLOSE_STEPS // golden.EVERY
        assert golden.furthest(first, second) > 1e-3
        assert golden.furthest(first[:-1], first[1:]) > 1e-3
