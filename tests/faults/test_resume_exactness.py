"""A training that was interrupted and resumed equals an uninterrupted one, bit by bit."""

import json
import random
import shutil
from dataclasses import replace
from itertools import product

import pytest
from support.fault_sizes import SIZE, chosen
from support.run_comparison import content, leftovers, newest, rows_of
from support.small_trainings import AGENTS, ITERATIONS, Case, train

from rlcli.runs.checkpoint_reader import open_checkpoint, steps
from rlcli.training import loop
from rlcli.training.checkpoint_writer import KeepRule

TASKS = ("everything", "cartpole-direct")
CUTS = (1, 3, 7, "within")
GRID = [
    (Case(TASKS[task], agent, normalize), cut)
    for (i, agent), normalize, (j, cut), task in product(enumerate(AGENTS), (False, True), enumerate(CUTS), (0, 1))
    if SIZE == "long" or (i + normalize + j + task) % 2 == 0  # each agent and each cut on both tasks
]
SPECIAL = [("sac", True), ("ppo", True)] if SIZE != "long" else [*product(AGENTS, (True, False))]
RING = "buffer_size: 12, batch_size: 12"
"""A replay buffer of three steps, as many as in an iteration: every row is replaced between two checkpoints."""


@pytest.fixture(scope="module")
def base_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tasks")


@pytest.fixture(scope="module")
def uninterrupted(base_folder):
    """Uninterrupted trainings."""
    done = {}

    def of(case, **settings):
        key = case, tuple(sorted(settings.items()))
        if key not in done:
            done[key] = train(base_folder / f"whole-{len(done)}", case, base_folder, **settings)
        return done[key].folder

    return of


def assert_equal(run, reference):
    assert rows_of(run) == rows_of(reference)
    assert [row["iteration"] for row in rows_of(run)] == list(range(1, ITERATIONS + 1))
    wanted = content(newest(reference))
    assert len(wanted) >= 6
    assert content(newest(run)) == wanted
    assert leftovers(run) == []


@pytest.mark.parametrize(("case", "cut"), chosen(GRID, 3), ids=str)
def test_interrupted_training_resumes_bit_identical(case, cut, base_folder, uninterrupted, tmp_path, monkeypatch):
    if cut == "within":
        monkeypatch.setattr(loop, "LONG_S", -1.0)  # every iteration can be left, and its beginning is only in memory
        draw = random.Random(str(case))
        at = draw.randrange(1, ITERATIONS), draw.randrange(3)
        run = train(tmp_path / "r", case, base_folder, within=at, save_interval=None).folder
        assert newest(run).iteration == at[0]
    else:
        run = train(tmp_path / "r", case, base_folder, after=cut).folder
        assert newest(run).iteration == cut
    train(run, case, base_folder, resume=-1)
    assert_equal(run, uninterrupted(case))


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_repeated_resumption_with_other_threads_is_bit_identical(
    agent, normalize, base_folder, uninterrupted, tmp_path
):
    case = Case("everything", agent, normalize)
    run = train(tmp_path / "r", case, base_folder, after=2, threads=2).folder
    train(run, case, base_folder, resume=-1, after=3)
    train(run, case, base_folder, resume=-1, after=4, threads=3)
    train(run, case, base_folder, resume=-1, threads=2)
    assert_equal(run, uninterrupted(case))


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_resume_from_an_older_checkpoint_is_bit_identical(agent, normalize, base_folder, uninterrupted, tmp_path):
    case = Case("cartpole-direct", agent, normalize)
    run = train(tmp_path / "r", case, base_folder, after=8).folder
    have = steps(run / "checkpoints")
    train(run, case, base_folder, resume=have[4], after=5)
    assert steps(run / "checkpoints") == have[:6]
    assert (run / "checkpoints/latest").read_text().strip() == f"{have[5]:012d}"
    train(run, case, base_folder, resume=have[2])
    assert_equal(run, uninterrupted(case))
    assert steps(run / "checkpoints") == steps(uninterrupted(case) / "checkpoints")


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_every_kept_checkpoint_resumes_bit_identical(agent, normalize, base_folder, uninterrupted, tmp_path):
    case, keep = Case("cartpole-direct", agent, normalize), KeepRule(2, 3)
    run = train(tmp_path / "r", case, base_folder, after=8, keep=keep).folder
    kept = [open_checkpoint(run / "checkpoints" / f"{step:012d}").iteration for step in steps(run / "checkpoints")]
    assert kept == [0, 3, 6, 7, 8]
    assert leftovers(run) == []
    for step in steps(run / "checkpoints"):
        copy = tmp_path / str(step)
        shutil.copytree(run, copy)
        train(copy, case, base_folder, resume=step, keep=keep)
        assert_equal(copy, uninterrupted(case))


@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_evaluations_do_not_change_the_training(agent, normalize, base_folder, uninterrupted, tmp_path):
    case = Case("everything", agent, normalize)
    evaluated = train(tmp_path / "whole", case, base_folder, eval_interval=2).folder
    rows = [{k: v for k, v in row.items() if not k.startswith("Eval/")} for row in rows_of(evaluated)]
    assert rows == rows_of(uninterrupted(case))
    assert content(newest(evaluated)) == content(newest(uninterrupted(case)))
    run = train(tmp_path / "r", case, base_folder, after=5, eval_interval=2).folder
    train(run, case, base_folder, resume=-1, eval_interval=2)
    assert_equal(run, evaluated)
    best = max((row["Eval/mean_reward"], -row["step"]) for row in rows_of(evaluated) if "Eval/mean_reward" in row)
    for folder in (run, evaluated):
        assert read_best(folder) == -best[1]


def read_best(run):
    return json.loads((run / "run.json").read_text())["best"]


@pytest.mark.parametrize("cut", chosen([(2, 1), (4, 2), (7, 0), (9, 1)], 1), ids=str)
@pytest.mark.parametrize("agent", ["sac", "td3"])
def test_replay_buffer_overwritten_in_one_iteration_is_saved(
    agent, cut, base_folder, uninterrupted, tmp_path, monkeypatch
):  # fmt: skip
    monkeypatch.setattr(loop, "LONG_S", -1.0)
    case = replace(Case("cartpole-direct", agent, False), more=RING)
    run = train(tmp_path / "r", case, base_folder, within=cut, save_interval=None).folder
    train(run, case, base_folder, resume=-1)
    assert_equal(run, uninterrupted(case))


@pytest.mark.slow
def test_linear_schedule_continues_after_resumption(base_folder, uninterrupted, tmp_path):
    for agent in ("sb3-ppo", "sac", "a2c"):
        case = replace(Case("cartpole-direct", agent, False), more="schedule: linear")
        run = train(tmp_path / agent, case, base_folder, after=4).folder
        train(run, case, base_folder, resume=-1)
        assert_equal(run, uninterrupted(case))
