"""The built-in tasks live as they did when their trajectories were recorded."""

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
def test_a_built_in_task_lives_as_recorded(task, seed):
    """Bit for bit on a machine like that of the record, nearly so on another."""
    record = golden.recorded()
    then, now = record["tasks"][task][str(seed)], golden.trajectory(task, seed)
    assert golden.furthest(then["states"], now["states"]) <= golden.TOLERANCE
    if record["machine"] == golden.machine():
        assert now["sha256"] == then["sha256"]


def test_the_record_is_of_the_installed_tasks_and_of_moving_robots():
    record = golden.recorded()["tasks"]
    assert sorted(record) == sorted(golden.TASKS)
    for seeds in record.values():
        first, second = (seeds[str(seed)]["states"] for seed in golden.SEEDS)
        assert len(first) == 1 + golden.CLOSE_STEPS // golden.EVERY
        assert golden.furthest(first, second) > 1e-3
        assert golden.furthest(first[:-1], first[1:]) > 1e-3
