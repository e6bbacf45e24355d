"""Physics, episodes and random draws are bit-identical for any number of threads and environments."""

import functools
import json
import os
import subprocess
import sys
from itertools import combinations_with_replacement, product

import numpy as np
import pytest
import torch
from support.fault_sizes import SIZE, amount, chosen
from support.same_bits import ENVS, STEPS, TASKS, HashedRollout, against_plain_steps, make, other_work, rollout_hashes

from rlcli.sim.env_selection import IdSelection

THREADS = (1, 2, 3, 4, 8) if SIZE != "long" else (1, 2, 3, 4, 5, 6, 8, 12, 16)
NUM_ENVS = (1, 7, ENVS) if SIZE != "long" else (1, 2, 7, 13, ENVS)
SEEDS = (42,) if SIZE != "long" else (42, 7)


@pytest.fixture(autouse=True)
def _one_torch_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tasks")


@pytest.fixture(scope="module")
def reference(folder):
    """Trajectories of many environments on one thread, each physics step compared with `mj_step`."""

    @functools.cache
    def trajectories(task, seed=42):
        torch.set_num_threads(1)
        trajectory = HashedRollout(make(task, folder, ENVS, seed=seed))
        differing = against_plain_steps(trajectory.env)
        for _ in range(STEPS):
            trajectory.step()
        assert differing == [], "steps that differ from mj_step"
        assert trajectory.ends >= ENVS, "every trajectory crosses a reset"
        assert len(set(trajectory.hashes())) == ENVS, "all trajectories differ"
        return trajectory.hashes()

    return trajectories


@pytest.mark.parametrize(
    ("task", "num_envs", "threads", "seed"), chosen(list(product(TASKS, NUM_ENVS, THREADS, SEEDS)), 7)
)
def test_trajectories_equal_plain_steps_for_any_threads_and_num_envs(task, num_envs, threads, seed, folder, reference):
    assert rollout_hashes(make(task, folder, num_envs, threads, seed)) == reference(task, seed)[:num_envs]


@pytest.mark.parametrize(("task", "order"), chosen(list(product(TASKS, range(amount(6, 6, 30)))), 4))
def test_partial_reset_does_not_depend_on_order_or_grouping(task, order, folder):
    together, apart = (make(task, folder, 16, 2) for _ in range(2))
    rng = np.random.default_rng(order)
    ids = np.sort(rng.choice(16, size=int(rng.integers(2, 16)), replace=False))
    parts = [np.sort(part) for part in np.array_split(rng.permutation(ids), int(rng.integers(2, len(ids) + 1)))]
    hashes = []
    for env, groups in ((together, [ids]), (apart, parts)):
        trajectory = HashedRollout(env, steps=60)
        for _ in range(20):
            trajectory.step()
        env.episode_index[ids] += 1
        for group in groups:
            env._reset_envs(IdSelection(group, env.seed, env.episode_index.numpy()[group]))
        env.sim.forward_moved()
        for _ in range(40):
            trajectory.step()
        hashes.append(trajectory.hashes())
    assert hashes[0] == hashes[1]


PROCESS = """
import json, sys, pathlib, torch
torch.set_num_threads(1)
from support.same_bits import TASKS, rollout_hashes, make, other_work
for work in other_work().values():
    work()
torch.set_num_threads(1)
print(json.dumps({task: rollout_hashes(make(task, pathlib.Path(sys.argv[1]), 7, int(sys.argv[2]))) for task in TASKS}))
"""


@pytest.fixture(scope="module")
def process(tmp_path_factory):
    """Trajectories of every task in a new process, by its hash seed."""

    @functools.cache
    def run(hash_seed):
        place = tmp_path_factory.mktemp("process")
        command = [sys.executable, "-c", PROCESS, str(place), str(1 + len(str(hash_seed)) % 3)]
        environment = {**os.environ, "PYTHONHASHSEED": str(hash_seed), "OMP_NUM_THREADS": "1"}
        environment["PYTHONPATH"] = os.pathsep.join([*filter(None, sys.path), environment.get("PYTHONPATH", "")])
        done = subprocess.run(command, env=environment, cwd=place, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    return run


HASH_SEEDS = chosen([0, 1, 12345, "random", *(range(100, 100 + amount(0, 0, 7)))], 1)


@pytest.mark.slow
@pytest.mark.parametrize(("hash_seed", "task"), list(product(HASH_SEEDS, TASKS)))
def test_another_process_and_hash_seed_give_equal_trajectories(hash_seed, task, process, reference):
    assert process(hash_seed)[task] == reference(task)[:7]


@pytest.mark.parametrize(("one", "other"), chosen(list(combinations_with_replacement(TASKS, 2)), 2))
def test_two_environments_of_one_process_do_not_touch_each_other(one, other, folder, reference):
    trajectories = [HashedRollout(make(one, folder, 7, 2)), HashedRollout(make(other, folder, 3, 1, seed=5))]
    alone = rollout_hashes(make(other, folder, 3, 1, seed=5))
    for _ in range(STEPS):
        for trajectory in trajectories:
            trajectory.step()
    assert trajectories[0].hashes() == reference(one)[:7]
    assert trajectories[1].hashes() == alone
    assert alone != reference(other)[:3]


@pytest.mark.parametrize(("task", "work"), chosen(list(product(TASKS, sorted(other_work()))), 3))
def test_other_work_in_between_changes_nothing(task, work, folder, reference):
    trajectory = HashedRollout(make(task, folder, 7, 2))
    for step in range(STEPS):
        if step % 20 == 0:
            other_work()[work]()
        trajectory.step()
    assert trajectory.hashes() == reference(task)[:7]
