"""A training that was interrupted and resumed is, bit for bit, the one that never was."""

import json
import random
import shutil
from dataclasses import replace
from itertools import product

import pytest
from support.fault_sizes import SIZE, chosen
from support.run_comparison import content, leftovers, newest, rows_of
from support.small_trainings import AGENTS, ITERATIONS, Case, train

from rlcli.runs.checkpoint import open_checkpoint, steps
from rlcli.training import loop
from rlcli.training.checkpoint_writer import Keep

TASKS = ("everything", "cartpole-direct")
CUTS = (1, 3, 7, "within")
GRID = [
    (Case(TASKS[task], agent, normalize), cut)
    for (i, agent), normalize, (j, cut), task in product(enumerate(AGENTS), (False, True), enumerate(CUTS), (0, 1))
    if SIZE == "long" or (i + normalize + j + task) % 2 == 0  # each agent and each cut on both tasks
]
SPECIAL = [("sac", True), ("ppo", True)] if SIZE != "long" else [*product(AGENTS, (True, False))]
RING = "buffer_size: 12, batch_size: 12"
"""A ring of three steps, and an iteration takes three: every row is replaced between two checkpoints."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("tasks")


@pytest.fixture(scope="module")
def whole(place):
    """The trainings that nobody interrupted."""
    done = {}

    def of(case, **settings):
        key = case, tuple(sorted(settings.items()))
        if key not in done:
            done[key] = train(place / f"whole-{len(done)}", case, place, **settings)
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
def test_a_training_that_was_cut_goes_on_as_if_it_had_not_been(case, cut, place, whole, tmp_path, monkeypatch):
    if cut == "within":
        monkeypatch.setattr(loop, "LONG_S", -1.0)  # every iteration can be left, and its beginning is only in memory
        draw = random.Random(str(case))
        at = draw.randrange(1, ITERATIONS), draw.randrange(3)
        run = train(tmp_path / "r", case, place, within=at, save_interval=None).folder
        assert newest(run).iteration == at[0]
    else:
        run = train(tmp_path / "r", case, place, after=cut).folder
        assert newest(run).iteration == cut
    train(run, case, place, resume=-1)
    assert_equal(run, whole(case))


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_a_training_cut_again_and_again_with_other_threads_is_the_same(agent, normalize, place, whole, tmp_path):
    case = Case("everything", agent, normalize)
    run = train(tmp_path / "r", case, place, after=2, threads=2).folder
    train(run, case, place, resume=-1, after=3)
    train(run, case, place, resume=-1, after=4, threads=3)
    train(run, case, place, resume=-1, threads=2)
    assert_equal(run, whole(case))


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_an_older_checkpoint_leads_to_the_same_end(agent, normalize, place, whole, tmp_path):
    case = Case("cartpole-direct", agent, normalize)
    run = train(tmp_path / "r", case, place, after=8).folder
    have = steps(run / "checkpoints")
    train(run, case, place, resume=have[4], after=5)
    assert steps(run / "checkpoints") == have[:6]
    assert (run / "checkpoints/latest").read_text().strip() == f"{have[5]:012d}"
    train(run, case, place, resume=have[2])
    assert_equal(run, whole(case))
    assert steps(run / "checkpoints") == steps(whole(case) / "checkpoints")


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_what_is_kept_changes_nothing_and_every_kept_checkpoint_goes_on(agent, normalize, place, whole, tmp_path):
    case, keep = Case("cartpole-direct", agent, normalize), Keep(2, 3)
    run = train(tmp_path / "r", case, place, after=8, keep=keep).folder
    kept = [open_checkpoint(run / "checkpoints" / f"{step:012d}").iteration for step in steps(run / "checkpoints")]
    assert kept == [0, 3, 6, 7, 8]
    assert leftovers(run) == []
    for step in steps(run / "checkpoints"):
        copy = tmp_path / str(step)
        shutil.copytree(run, copy)
        train(copy, case, place, resume=step, keep=keep)
        assert_equal(copy, whole(case))


@pytest.mark.parametrize(("agent", "normalize"), chosen(SPECIAL, 1))
def test_evaluations_change_no_bit_and_the_best_is_the_same(agent, normalize, place, whole, tmp_path):
    case = Case("everything", agent, normalize)
    evaluated = train(tmp_path / "whole", case, place, eval_interval=2).folder
    rows = [{k: v for k, v in row.items() if not k.startswith("Eval/")} for row in rows_of(evaluated)]
    assert rows == rows_of(whole(case))
    assert content(newest(evaluated)) == content(newest(whole(case)))
    run = train(tmp_path / "r", case, place, after=5, eval_interval=2).folder
    train(run, case, place, resume=-1, eval_interval=2)
    assert_equal(run, evaluated)
    best = max((row["Eval/mean_reward"], -row["step"]) for row in rows_of(evaluated) if "Eval/mean_reward" in row)
    for folder in (run, evaluated):
        assert read_best(folder) == -best[1]


def read_best(run):
    return json.loads((run / "run.json").read_text())["best"]


@pytest.mark.parametrize("cut", chosen([(2, 1), (4, 2), (7, 0), (9, 1)], 1), ids=str)
@pytest.mark.parametrize("agent", ["sac", "td3"])
def test_a_ring_that_is_overwritten_in_one_iteration_is_saved_whole(
    agent, cut, place, whole, tmp_path, monkeypatch
):  # fmt: skip
    monkeypatch.setattr(loop, "LONG_S", -1.0)
    case = replace(Case("cartpole-direct", agent, False), more=RING)
    run = train(tmp_path / "r", case, place, within=cut, save_interval=None).folder
    train(run, case, place, resume=-1)
    assert_equal(run, whole(case))


@pytest.mark.slow
def test_a_linear_schedule_goes_on_where_it_was(place, whole, tmp_path):
    for agent in ("sb3-ppo", "sac", "a2c"):
        case = replace(Case("cartpole-direct", agent, False), more="schedule: linear")
        run = train(tmp_path / agent, case, place, after=4).folder
        train(run, case, place, resume=-1)
        assert_equal(run, whole(case))
