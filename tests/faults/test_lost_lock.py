"""A training whose lock is lost: it ends with one error and writes nothing more, so that two never write one run."""

import os
import re
import shutil
import signal

import pytest
from support.child_processes import SMALL
from support.run_comparison import assert_loads, assert_same_run, newest

from rlcli.errors import MachineError
from rlcli.rl.trainer import TrainerState
from rlcli.runs.atomic_io import write_atomic
from rlcli.runs.run import open_run
from rlcli.training.checkpoint_writer import write_checkpoint
from rlcli.training.loggers import JsonLines

TRAIN = ("train", "cartpole", "agent.n_steps=8", "agent.num_minibatches=2", "agent.policy.hidden=[8]", *SMALL,
         "episode_length_s=0.3", "agent.save_interval=1", "--max-iterations", 8, "--seed", 5)  # fmt: skip
PAUSE = [{"kind": "slow", "call": "rlcli.envs.vec_env:VecEnv.step", "pattern": "", "nth": 26, "seconds": 1.0}]
"""In the fourth iteration: a second for each of a dozen steps."""


@pytest.fixture(scope="module")
def uninterrupted(child, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    ended = child(folder, *TRAIN).ended()
    assert ended.code == 0, ended.err
    return run_in(folder)


def run_in(folder):
    (run,) = [file.parent for file in folder.glob("runs/*/*/run.json")]
    return run


def content(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def changed(before, after):
    """Return the files of folders that differ."""
    pairs = zip(before, after, strict=True)
    return sorted({str(name) for a, b in pairs for name in a.keys() | b.keys() if a.get(name) != b.get(name)})


def paused(child, folder):
    """Start a training and return it with its run when it pauses, after three iterations."""
    started = child(folder, *TRAIN, faults=PAUSE)
    started.until(lambda: (folder / "slow").exists())
    run = run_in(folder)
    saved = run / "checkpoints"
    started.until(lambda: len(list(saved.glob("0*"))) == 4 and not list(run.rglob("*.tmp-*")))
    started.until(lambda: (saved / "latest").read_text().strip() == max(file.name for file in saved.glob("0*")))
    started.until(lambda: not list(run.rglob("*.tmp-*")))
    return started, run


def delete_lock(run):
    (run / ".lock").unlink()
    return run


def replace_lock(run):
    (run / ".lock").rename(run / "gone")
    (run / ".lock").touch()
    (run / "gone").unlink()
    return run


def replace_folder(run):
    moved = run.parent.parent.parent / "moved"
    run.rename(moved)
    shutil.copytree(moved, run)
    return moved


LOSSES = [delete_lock, replace_lock, replace_folder]


def assert_lost(ended):
    assert ended.code == 10, (ended.code, ended.err)
    assert ended.err.count("error:") == 1, ended.err
    assert re.search("this process has lost the lock of /[^ ]*/runs/cartpole/", ended.err)
    assert "continue with `rlcli train --resume runs/cartpole/" in ended.err
    assert "Traceback" not in ended.err


@pytest.mark.parametrize("lose", LOSSES)
def test_training_that_lost_its_lock_ends_and_writes_nothing_more(child, tmp_path, lose):
    first, run = paused(child, tmp_path)
    written = lose(run)
    before = content(run), content(written)
    assert_lost(first.ended())
    assert changed(before, (content(run), content(written))) == []
    assert_loads(run)


@pytest.mark.parametrize("lose", LOSSES)
def test_run_resumed_after_its_lock_was_lost_equals_an_uninterrupted_one(child, uninterrupted, tmp_path, lose):
    first, run = paused(child, tmp_path)
    lose(run)
    resumed = child(tmp_path, "train", "--resume", run, "-q").ended()
    assert resumed.code == 0, resumed.err
    assert_lost(first.ended())
    assert_same_run(run, uninterrupted)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_after_the_lock_was_lost_does_not_promise_a_resumption(child, tmp_path, number):
    first, run = paused(child, tmp_path)
    delete_lock(run)
    step = newest(run).step
    os.kill(first.pid, number)
    ended = first.ended()
    assert_lost(ended)
    assert "a resumed run repeats" not in ended.err
    assert newest(run).step == step


@pytest.mark.parametrize("lose", LOSSES)
@pytest.mark.parametrize(
    "write",
    [
        lambda run: run.update(state="x"),
        lambda run: write_checkpoint(run.checkpoints, 999, TrainerState({}, {"policy": {}}), {}),
        lambda run: write_atomic(run.folder / "autopsy.json", "{}"),
        lambda run: JsonLines(run.metrics),
    ],
    ids=["run.json", "checkpoint", "file", "metrics"],
)
def test_every_write_into_a_run_checks_its_lock(uninterrupted, tmp_path, lose, write):
    folder = tmp_path / "runs/cartpole/r"
    shutil.copytree(uninterrupted, folder)
    run = open_run(folder)
    run.lock()
    write_atomic(folder / "before", "")
    lose(folder)
    before = content(folder)
    with pytest.raises(MachineError, match="nothing more is written"):
        write(run)
    assert content(folder) == before


def test_metrics_are_not_written_after_the_lock_was_lost(uninterrupted, tmp_path):
    folder = tmp_path / "runs/cartpole/r"
    shutil.copytree(uninterrupted, folder)
    run = open_run(folder)
    run.lock()
    metrics = JsonLines(run.metrics)
    metrics.write(9, 9, {})
    moved = replace_folder(folder)
    before = content(folder), content(moved)
    with pytest.raises(MachineError, match="nothing more is written"):
        metrics.write(10, 10, {})
    metrics.close()
    assert (content(folder), content(moved)) == before


def test_discard_keeps_a_folder_that_was_replaced(uninterrupted, tmp_path):
    folder = tmp_path / "runs/cartpole/r"
    shutil.copytree(uninterrupted, folder)
    run = open_run(folder)
    run.lock()
    replace_folder(folder)
    run.discard()
    assert (folder / "run.json").is_file()
