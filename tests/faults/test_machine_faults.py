"""Disk and system errors: the last checkpoint stays, the message names cause and path, and training can resume."""

import errno
import json
import os
import re
import shutil

import pytest
from support.child_processes import SMALL
from support.fault_sizes import chosen
from support.run_comparison import assert_loads, assert_same_run, newest

from rlcli.errors import MachineError
from rlcli.runs.checkpoint_reader import steps
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.run import open_run

AGENT = """
agents:
  small:
    {trainer: sb3, algorithm: sac, train_freq: 4, gradient_steps: 2, learning_starts: 24, batch_size: 8,
     buffer_size: 96, policy: {hidden: [8]}}
"""
TRAIN = ("train", "cartpole", "--config", "agent.yaml", "--agent", "small", *SMALL, "episode_length_s=0.3",
         "agent.save_interval=1", "agent.keep_last=2", "--max-iterations", 8, "--seed", 5,
         "--logger", "none")  # fmt: skip
AIMS = {
    # what is written -> pattern of its files
    "checkpoint": r"checkpoints/\.tmp-|checkpoints/\d{12}$",
    "retention": r"checkpoints/\d{12} -> .*/\.tmp-|^(policy|trainer|state|env|rng|manifest)\.\w+$",
    "metrics": r"/metrics\.jsonl$",
}
ERRORS = ("ENOSPC", "EIO", "EACCES", "EROFS", "EDQUOT")
CASES = [
    *(("checkpoint", call, code) for code in ERRORS for call in ("write", "open")),
    *(("checkpoint", call, code) for call, code in (("mkdir", "EROFS"), ("mkdir", "EACCES"))),
    *(("checkpoint", "fsync", code) for code in ("EIO", "ENOSPC")),
    *(("checkpoint", "rename", code) for code in ("EIO", "EROFS")),
    *(("checkpoint", "short", code) for code in ("ENOSPC", "EDQUOT", "EIO")),
    *(("retention", "rename", code) for code in ERRORS),
    *(("retention", "unlink", code) for code in ("EIO", "EROFS")),
    *(("metrics", call, code) for call in ("write", "short") for code in ("ENOSPC", "EIO", "EDQUOT")),
]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "agent.yaml").write_text(AGENT)
    return tmp_path


@pytest.fixture(scope="module")
def uninterrupted(child, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    (folder / "agent.yaml").write_text(AGENT)
    ended = child(folder, *TRAIN).ended()
    assert ended.code == 0, ended.err
    return run_in(folder)


def run_in(folder):
    (run,) = [file.parent for file in folder.glob("runs/*/*/run.json")]
    return run


def fault(aim, call, code, nth):
    short = call == "short"
    return [{"kind": "short" if short else "error", "call": "write" if short else call, "pattern": AIMS[aim],
             "code": code, "nth": nth}]  # fmt: skip


def assert_one_error(ended, code, *words):
    """Check that there is one message with the system's error and the path."""
    assert ended.code == 10, (ended.code, ended.err)
    assert os.strerror(getattr(errno, code)) in ended.err
    for word in words:
        assert re.search(word, ended.err), ended.err
    assert "Traceback" not in ended.err
    assert "Exception" not in ended.err


def assert_files_complete(run, state="failed"):
    """Check that files are complete, that no other files exist, and that the lock is free."""
    assert_loads(run)
    record = json.loads((run / "run.json").read_text())
    assert record["state"] == state
    assert record["step"] == newest(run).step
    locked = open_run(run)
    locked.lock()
    locked.unlock()


@pytest.mark.parametrize(("aim", "call", "code"), chosen(CASES, 1))
def test_disk_error_keeps_everything_saved_before(child, uninterrupted, folder, aim, call, code):
    # from the third checkpoint on, which has about twenty files before it
    nth = {"checkpoint": {"mkdir": 4, "rename": 4}.get(call, 25), "retention": 1, "metrics": 4}[aim]
    ended = child(folder, *TRAIN, faults=fault(aim, call, code, nth)).ended()
    run = run_in(folder)
    if aim == "retention":  # what cannot be removed stays
        assert ended.code == 0, ended.err
        assert_files_complete(run, "finished")
        assert len(steps(run / "checkpoints")) >= len(steps(uninterrupted / "checkpoints"))
        more = child(folder, "train", "--resume", "latest", "--max-iterations", 9, "-q").ended()
        assert more.code == 0, more.err
        assert len(steps(run / "checkpoints")) == 3
        return
    where = r"checkpoints/\d{12}" if aim == "checkpoint" else r"metrics\.jsonl"
    assert_one_error(ended, code, where)
    assert_files_complete(run)
    assert newest(run).iteration >= 2
    assert not [file for file in run.rglob("*") if ".tmp" in file.name]
    resumed = child(folder, "train", "--resume", "latest", "-q").ended()
    assert resumed.code == 0, resumed.err
    assert_same_run(run, uninterrupted)


@pytest.mark.slow
@pytest.mark.parametrize("aim", ["checkpoint", "metrics"])
def test_file_size_limit_is_handled_like_a_full_disk(child, uninterrupted, folder, aim):
    """Set RLIMIT_FSIZE, under which writes first are incomplete and then fail."""
    size = 6000 if aim == "checkpoint" else 1500
    calls = {
        "checkpoint": "rlcli.training.checkpoint_writer:write_checkpoint",
        "metrics": "rlcli.training.loggers:JsonLines.write",
    }
    faults = [{"kind": "limit", "call": calls[aim], "pattern": "", "nth": 3, "code": str(size)}]
    ended = child(folder, *TRAIN, faults=faults).ended()
    assert_one_error(
        ended, "EFBIG", r"checkpoints/\d{12}" if aim == "checkpoint" else r"checkpoints/\d{12}|metrics\.jsonl"
    )
    assert_loads(run_in(folder))
    assert newest(run_in(folder)).iteration >= 1
    resumed = child(folder, "train", "--resume", "latest", "-q").ended()
    assert resumed.code == 0, resumed.err
    assert_same_run(run_in(folder), uninterrupted)


@pytest.mark.slow
@pytest.mark.parametrize("gone", ["checkpoints", "run", "file in its place"])
def test_deleted_folder_is_not_recreated(child, folder, gone):
    wait = [{"kind": "slow", "call": "rlcli.envs.vec_env:VecEnv.step", "pattern": "", "nth": 8, "seconds": 0.2}]
    process = child(folder, *TRAIN, faults=wait)
    process.until(lambda: (folder / "slow").exists())
    run = run_in(folder)
    target = run if gone == "run" else run / "checkpoints"
    os.rename(target, folder / "elsewhere")
    if gone == "file in its place":
        target.touch()
    ended = process.ended()
    # a checkpoint may come in the moment between
    code = "ENOTDIR" if os.strerror(errno.ENOTDIR) in ended.err and gone == "file in its place" else "ENOENT"
    assert_one_error(ended, code, str(run.relative_to(folder)))
    assert not target.is_dir()
    elsewhere = folder / "elsewhere"
    assert steps(elsewhere if gone != "run" else elsewhere / "checkpoints")


def test_file_in_place_of_the_runs_folder_is_a_machine_error(child, folder):
    (folder / "runs").touch()
    ended = child(folder, *TRAIN).ended()
    assert ended.code == 10
    assert "runs" in ended.err
    assert (folder / "runs").read_text() == ""


@pytest.mark.slow
def test_full_disk_for_metrics_ends_the_run(child, uninterrupted, folder):
    """Use a file on a device that is full."""
    faults = [{"kind": "full", "call": "open", "pattern": AIMS["metrics"]}]
    ended = child(folder, *TRAIN, faults=faults).ended()
    assert_one_error(ended, "ENOSPC", r"metrics\.jsonl")
    run = run_in(folder)
    assert_files_complete(run)
    resumed = child(folder, "train", "--resume", "latest", "-q").ended()
    assert resumed.code == 0, resumed.err
    assert_same_run(run, uninterrupted)


@pytest.mark.slow
def test_run_behind_a_link_trains_and_resumes(child, uninterrupted, folder):
    (folder / "disk").mkdir()
    (folder / "runs").symlink_to(folder / "disk")
    ended = child(folder, *TRAIN, faults=fault("checkpoint", "rename", "EIO", 5)).ended()
    assert_one_error(ended, "EIO")
    link = folder / "link"
    link.symlink_to(run_in(folder))
    resumed = child(folder, "train", "--resume", link, "-q").ended()
    assert resumed.code == 0, resumed.err
    assert link.is_symlink()
    assert_same_run(run_in(folder), uninterrupted)


@pytest.mark.slow
def test_second_writer_is_refused_and_changes_nothing(child, uninterrupted, folder):
    wait = [{"kind": "slow", "call": "rlcli.envs.vec_env:VecEnv.step", "pattern": "", "nth": 12, "seconds": 0.3}]
    first = child(folder, *TRAIN, faults=wait)
    first.until(lambda: (folder / "slow").exists())
    second = child(folder, "train", "--resume", "latest").ended()
    assert second.code == 10
    assert "another process writes to" in second.err
    ended = first.ended()
    assert ended.code == 0, ended.err
    assert_same_run(run_in(folder), uninterrupted)


@pytest.mark.slow
def test_clock_set_back_changes_nothing(child, uninterrupted, folder):
    back = [{"kind": "clock", "call": "rlcli.envs.vec_env:VecEnv.step", "pattern": "", "nth": 9, "code": "-1e8"}]
    ended = child(folder, *TRAIN, faults=back).ended()
    assert ended.code == 0, ended.err
    assert_same_run(run_in(folder), uninterrupted)
    assert [row["iteration"] for row in read_rows(run_in(folder) / "metrics.jsonl")] == list(range(1, 9))


def test_held_lock_raises_machine_error(uninterrupted, tmp_path):
    shutil.copytree(uninterrupted, tmp_path / "r")
    first, second = open_run(tmp_path / "r"), open_run(tmp_path / "r")
    first.lock()
    with pytest.raises(MachineError, match="another process"):
        second.lock()
    first.unlock()
    second.lock()
    second.unlock()
