"""Run folders, and references to them on a command line."""

import json
import os
import subprocess
import sys

import pytest
from support.saved_states import state_of

from rlcli.errors import CheckpointError, MachineError, UsageError
from rlcli.runs.run import create_run, open_run
from rlcli.runs.run_ref import find_checkpoint, find_run, find_runs, list_runs
from rlcli.runs.study import create_study
from rlcli.training import checkpoint_writer

RECORD = {"task": {"name": "cartpole", "distribution": "rlcli"}, "seed": 1}


def make_run(runs, task="cartpole", name=None, steps=(), **entries):
    record = {**RECORD, "task": {"name": task, "distribution": "rlcli"}, **entries}
    run = create_run(runs, task, name, "a: 1\n", record)
    run.unlock()
    for step in steps:
        checkpoint_writer.write_checkpoint(run.checkpoints, step, state_of(), {})
    return run


def test_create_run_writes_configuration_and_record(tmp_path):
    run = make_run(tmp_path / "runs", name="test")
    assert run.folder.parent == tmp_path / "runs" / "cartpole"
    assert run.folder.name.endswith("-test")
    assert ":" not in run.folder.name
    assert run.config.read_text() == "a: 1\n"
    assert json.loads((run.folder / "run.json").read_text())["state"] == "running"
    assert not [p for p in run.folder.iterdir() if ".tmp" in p.name]


FIVE = """
import json, sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from rlcli.runs.run import create_run
def create(_):
    return str(create_run(Path(sys.argv[1]), "cartpole", None, "a: 1", json.loads(sys.argv[2])).folder)
print(json.dumps(list(ThreadPoolExecutor(5).map(create, range(5)))))
"""


def test_concurrent_create_run_gives_separate_folders(tmp_path):
    command = [sys.executable, "-c", FIVE, str(tmp_path), json.dumps(RECORD)]
    children = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(4)]
    folders = [folder for child in children for folder in json.loads(child.communicate()[0])]
    assert len(set(folders)) == 20
    assert len(list_runs(tmp_path, "cartpole")) == 20


@pytest.mark.parametrize("name", ["a/b", "..", "a:b", "", "é", "a b", "-x"])
def test_create_run_refuses_an_invalid_name(tmp_path, name):
    with pytest.raises(UsageError, match="folder's name"):
        make_run(tmp_path, name=name)


def test_lock_refuses_a_second_writer(tmp_path):
    run = make_run(tmp_path)
    holder = subprocess.Popen(
        [sys.executable, "-c",
         "import sys; from pathlib import Path; from rlcli.runs.run import open_run;"
         "r = open_run(Path(sys.argv[1])); r.lock(); print('held', flush=True); sys.stdin.read()", str(run.folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(MachineError, match="another process writes to"):
        open_run(run.folder).lock()
    holder.communicate()
    run.lock()
    run.unlock()


def test_lock_of_a_killed_writer_is_released(tmp_path):
    run = make_run(tmp_path)
    subprocess.run(
        [sys.executable, "-c",
         "import os, sys; from pathlib import Path; from rlcli.runs.run import open_run;"
         "r = open_run(Path(sys.argv[1])); r.lock(); os.kill(os.getpid(), 9)", str(run.folder)],
    )  # fmt: skip
    run.lock()
    run.unlock()


def test_latest_is_the_newest_run_of_the_task(tmp_path):
    old, new = make_run(tmp_path), make_run(tmp_path, name="aaa")
    other = make_run(tmp_path, task="ant")
    assert find_run("latest", tmp_path)[0].folder == other.folder
    run, why = find_run("latest", tmp_path, "cartpole")
    assert run.folder == new.folder != old.folder
    assert "newest run of cartpole" in why


def test_latest_is_a_trial_of_a_sweep_only_without_other_runs(tmp_path):
    trial = make_run(tmp_path).folder
    sweep = trial.parent / "sweep-x"
    sweep.mkdir()
    (sweep / "study.json").write_text('{"kind": "sweep", "task": "cartpole"}')
    trial.rename(sweep / "trial-0000")
    run, why = find_run("latest", tmp_path, "cartpole")
    assert (run.folder.name, why) == ("trial-0000", "newest trial of a sweep of cartpole")
    alone = make_run(tmp_path).folder
    record = json.loads((alone / "run.json").read_text())
    (alone / "run.json").write_text(json.dumps({**record, "started": "2001-01-01T00:00:00+00:00"}))
    assert find_run("latest", tmp_path)[0].folder == alone


def test_find_run_by_name_and_by_folder(tmp_path):
    run = make_run(tmp_path, name="one")
    for reference in (run.folder.name, str(run.folder), f"cartpole/{run.folder.name}"):
        assert find_run(reference, tmp_path)[0].folder.resolve() == run.folder.resolve()


def test_find_run_suggests_a_similar_name(tmp_path):
    run = make_run(tmp_path, name="one")
    with pytest.raises(CheckpointError) as caught:
        find_run(run.folder.name[:-1], tmp_path)
    assert run.folder.name in caught.value.hint


def test_find_run_names_studies_and_not_the_runs_in_them(tmp_path):
    study = create_study(tmp_path, "cartpole", "base", "a: 1\n", {**RECORD, "device": "cpu"}, [0, 1])
    single = make_run(tmp_path, name="fast")
    for reference, hint in (
        ("base", f"did you mean '{study.name}'?"),
        ("fast", f"did you mean '{single.folder.name}'?"),
        ("zebra", f"runs in {tmp_path}: {study.name}, {single.folder.name}"),
    ):
        with pytest.raises(CheckpointError) as caught:
            find_run(reference, tmp_path)
        assert caught.value.hint == hint


def test_task_without_runs_suggests_a_similar_task_with_runs(tmp_path):
    make_run(tmp_path, task="my_yam")
    with pytest.raises(CheckpointError, match="no run of my-yam") as caught:
        find_run("latest", tmp_path, "my-yam")
    assert caught.value.hint == "did you mean 'my_yam'?; rlcli train my-yam starts one"


def test_find_run_refuses_a_too_long_name(tmp_path):
    with pytest.raises(CheckpointError, match="no run 'aaaa"):
        find_checkpoint("a" * 5000, tmp_path)


def test_find_run_refuses_a_file(tmp_path):
    (tmp_path / "policy.onnx").touch()
    with pytest.raises(CheckpointError, match=r"policy.onnx' is a file, not the folder of a run") as caught:
        find_checkpoint(str(tmp_path / "policy.onnx"), tmp_path)
    assert "rlcli export --format bundle" in caught.value.hint


def test_find_run_without_runs_has_a_hint(tmp_path):
    with pytest.raises(CheckpointError, match="no run of cartpole") as caught:
        find_run("latest", tmp_path / "nowhere", "cartpole")
    assert "rlcli train cartpole" in caught.value.hint


def test_find_run_refuses_a_run_of_another_task(tmp_path):
    run = make_run(tmp_path, task="ant")
    with pytest.raises(UsageError, match="run of ant, not of cartpole"):
        find_run(str(run.folder), tmp_path, "cartpole")


def test_find_checkpoint_by_run_best_step_and_folder(tmp_path):
    run = make_run(tmp_path, steps=(0, 9, 10), best=9)
    name = run.folder.name
    for reference, step in ((name, 10), (f"{name}@best", 9), (f"{name}@step:0", 0), ("latest", 10), ("latest@best", 9)):
        assert int(find_checkpoint(reference, tmp_path)[1].name) == step, reference
    direct = find_checkpoint(str(run.checkpoints / "000000000009"), tmp_path)
    assert direct[0].folder == run.folder.resolve()
    assert direct[1] == run.checkpoints / "000000000009"


@pytest.mark.parametrize(
    ("steps", "state", "skipped"),
    [((), "failed", True), ((), "running", True), ((0,), "failed", True), ((0,), "diverged", True),
     ((0,), "stopped", True), ((0,), "running", False), ((0,), "finished", False), ((0, 5), "failed", False)],
)  # fmt: skip
def test_latest_policy_is_not_of_a_run_that_failed_before_it_was_trained(tmp_path, caplog, steps, state, skipped):
    old = make_run(tmp_path, steps=(0, 10), state="finished")
    new = make_run(tmp_path, name="new", steps=steps, state=state)
    run, _, why = find_checkpoint("latest", tmp_path, "cartpole")
    assert run.folder == (old if skipped else new).folder
    assert (f"has no trained policy ({state})" in caplog.text, "with a trained policy" in why) == (skipped, skipped)
    assert find_run("latest", tmp_path, "cartpole")[0].folder == new.folder


def test_latest_checkpoint_to_resume_is_of_the_newest_run(tmp_path):
    make_run(tmp_path, steps=(0, 10), state="finished")
    new = make_run(tmp_path, name="new", steps=(0,), state="failed")
    assert find_checkpoint("latest", tmp_path, "cartpole", whole=True)[0].folder == new.folder


def test_latest_policy_of_runs_without_any_is_an_error(tmp_path):
    make_run(tmp_path, state="failed")
    make_run(tmp_path, name="new", state="failed")
    with pytest.raises(CheckpointError, match="new has no complete checkpoint"):
        find_checkpoint("latest", tmp_path)


@pytest.mark.parametrize(
    ("which", "message", "hint"),
    [
        ("@step:7", "no checkpoint at step 7", "steps: 0, 9, 10"),
        ("@best", "no best checkpoint", "leave out @best"),
        ("@newest", "does not name a checkpoint", "RUN@step:N"),
        ("@step:x", "does not name a checkpoint", "RUN@step:N"),
        ("@step:²", "does not name a checkpoint", "RUN@step:N"),
        ("@step:" + "9" * 5000, "does not name a checkpoint", "RUN@step:N"),
    ],
)
def test_find_checkpoint_lists_existing_steps(tmp_path, which, message, hint):
    run = make_run(tmp_path, steps=(0, 9, 10))
    with pytest.raises(CheckpointError, match=message) as caught:
        find_checkpoint(run.folder.name + which, tmp_path)
    assert hint in caught.value.hint


def test_find_checkpoint_accepts_a_folder_with_an_at_sign(tmp_path):
    run = make_run(tmp_path / "user@host", steps=(3,))
    assert find_checkpoint(str(run.folder), tmp_path)[1].name == "000000000003"


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"[]", b"\xff", b"{}", b'{"task": 1}', b'{"task": {}}', b'{"task": {"name": 1}}',
        b'{"task": {"name": "x"}, "seed": 1}', b'{"task": {"name": "x", "distribution": "d"}}',
    ],
)  # fmt: skip
def test_damaged_record_does_not_hide_other_runs(tmp_path, content):
    good, bad = make_run(tmp_path, steps=(1,)), make_run(tmp_path)
    (bad.folder / "run.json").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"run\.json is corrupt"):
        find_run(str(bad.folder), tmp_path)
    assert find_run("latest", tmp_path)[0].folder == good.folder


def test_latest_names_the_refused_runs(tmp_path, caplog):
    runs = [make_run(tmp_path, steps=(1,)) for _ in range(3)]
    for run in runs[1:]:
        run.config.unlink(missing_ok=True)
        os.mkfifo(run.config)
    assert find_run("latest", tmp_path, "cartpole")[0].folder == runs[0].folder
    assert "a run is skipped: " in caplog.text
    assert "is not a regular file; move it out of the run's folder; 1 more are skipped" in caplog.text
    (runs[0].folder / "tb").symlink_to(tmp_path)
    with pytest.raises(CheckpointError, match=r"no valid run of cartpole in .* 2 more are skipped"):
        find_run("latest", tmp_path, "cartpole")
    for reference in ("cartpole", runs[0].folder.name):
        with pytest.raises(CheckpointError, match=r"is a link|not a regular file"):
            find_runs([reference], tmp_path)
    with pytest.raises(CheckpointError, match="there is no run of other in"):
        find_run("latest", tmp_path, "other")


def test_unknown_run_suggests_a_word_or_names_the_absolute_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for reference, hint in (("shiped", "did you mean 'shipped'?"), ("zebra", f"runs in {tmp_path / 'runs'}: (none)")):
        with pytest.raises(CheckpointError) as caught:
            find_run(reference, tmp_path.relative_to(tmp_path) / "runs")
        assert caught.value.hint == hint


def test_runs_folder_that_is_a_file_raises_machine_error(tmp_path):
    (tmp_path / "runs").touch()
    with pytest.raises(MachineError, match="cannot write"):
        make_run(tmp_path / "runs")
    with pytest.raises(CheckpointError, match="no run"):
        find_run("latest", tmp_path / "runs")


def test_full_disk_in_create_run_leaves_no_folder(tmp_path, monkeypatch):
    import os

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(MachineError, match="No space left") as caught:
        make_run(tmp_path)
    assert "free some space" in caught.value.hint
    assert list((tmp_path / "cartpole").iterdir()) == []
