"""Untrusted run folders: no code is executed, nothing hangs, nothing outside is written, refusals have a message."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import torch
from support import hostile_runs
from support.child_processes import PATIENCE
from support.fault_sizes import chosen

from rlcli.cli.app import COMMANDS, GROUPS, main

_QUICK = ["scene.num_envs=4", "--viewer", "none", "--quiet"]


@pytest.fixture(autouse=True)
def _alone(tmp_path, monkeypatch):
    monkeypatch.setenv("RLCLI_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.delenv("RLCLI_RUNS_DIR", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A run of an installed task, and a recording of it."""
    folder = tmp_path_factory.mktemp("good")
    command = ["train", "cartpole", "scene.num_envs=4", "agent.n_steps=8", "agent.num_minibatches=2"]
    assert main([*command, "--max-iterations", "1", "--runs-dir", str(folder), "--quiet"]) == 0
    (run,) = folder.glob("cartpole/*")
    recording = folder / "episodes.safetensors"
    play = ["eval", "--checkpoint", str(run), "scene.num_envs=4", "--episodes", "4", "--record", str(recording)]
    assert main([*play, "--quiet"]) == 0
    return SimpleNamespace(run=run, recording=recording)


@pytest.fixture
def at(tmp_path, good, monkeypatch):
    place = hostile_runs.place(tmp_path, good.run)
    monkeypatch.chdir(place.cwd)
    return place


@pytest.fixture
def cli(capfd):
    def run(*arguments):
        capfd.readouterr()
        begin = time.process_time()
        code = main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert "Traceback" not in err, err
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", out + err), repr(out + err)
        return SimpleNamespace(code=code, out=out, err=err, took=time.process_time() - begin)

    return run


def commands(run, good_run):
    """Return the command line of every command that takes a run."""
    lines = {
        "play": ["play", "--checkpoint", run, "scene.num_envs=4", "--viewer", "none"],
        "play latest": ["play", "cartpole", "scene.num_envs=4", "--viewer", "none"],
        "eval": ["eval", "--checkpoint", run, "scene.num_envs=4", "--episodes", "2"],
        "resume": ["train", "--resume", run, "--max-iterations", "2"],
        "reproduce": ["reproduce", run],
    }
    known = {*COMMANDS, *GROUPS}
    return {name: line for name, line in lines.items() if line[0] in known}


def reading(run, good_run):
    """Return the commands that read a run without its task."""
    lines = {
        "export": ["export", "--checkpoint", run, "--format", "torch"],
        "init-from": ["train", "cartpole", "--init-from", run, "--max-iterations", "1"],
        "diff": ["diff", run, good_run],
        "runs": ["runs"],
        "watch": ["watch", run],
        "plot": ["plot", run],
        "report": ["report", run, "--no-eval", "--no-video"],
        "import sb3": ["import", "sb3", run],
        "import rsl-rl": ["import", "rsl-rl", run],
        "as a task": ["play", f"{run}/", "--policy", "zero"],
        "validate": ["validate", run / "config.yaml", "--deep"],
    }
    known = {*COMMANDS, *GROUPS}
    return {name: line for name, line in lines.items() if line[0] in known}


def refused(message, codes, *words):
    assert message.code in codes, (message.code, message.err)
    assert all(word in message.err for word in words), message.err
    assert message.took < 20, message.took


ATTACKS = [(kind, name) for kind in ("CODE", "RECORD") for name in getattr(hostile_runs, kind)]


@pytest.mark.parametrize(("kind", "name"), chosen(ATTACKS, 10))
def test_code_named_by_an_untrusted_run_is_not_executed(kind, name, at, good, cli):
    getattr(hostile_runs, kind)[name](at)
    before = hostile_runs.outside(at)
    for command, line in commands(at.run, good.run).items():
        message = cli(*line)
        if command == "play latest":
            if name == "a home folder":  # there is no folder of this name, and the command line names another task
                assert "is not on this machine (~/evil); the task 'cartpole' of rlcli is used instead" in message.err
            else:
                assert message.code in (4, 5), (command, message.err)
        else:
            refused(
                message, (5,) if kind == "RECORD" and "distribution that c" not in name else (4, 5), "untrusted-run"
            )
            assert (
                "hint: " in message.err
                or "corrupt" in message.err
                or "cannot be read" in message.err
                or "too large" in message.err
                or message.code == 4
            )
    for line in reading(at.run, good.run).values():
        assert cli(*line).code in (0, 2, 3, 4, 5, 9, 10)
    assert not at.canary.exists()
    assert {name: held for name, held in hostile_runs.outside(at).items() if name in before} == before


@pytest.mark.parametrize("name", chosen(list(hostile_runs.CONFIG), 4))
def test_untrusted_configuration_reaches_only_installed_code(name, at, good, cli):
    hostile_runs.CONFIG[name](at)
    for command, line in commands(at.run, good.run).items():
        line = [word for word in line if "num_envs" not in str(word)] if "billion" in name else line
        codes = (3, 5, 9) if command == "reproduce" else (3, 5)  # 9: it is not what the record says
        refused(cli(*line), codes, *(() if command == "play latest" else ("untrusted-run",)))
    if "diff" in COMMANDS:
        assert cli("diff", at.run, good.run).code in (0, 3, 5, 9)
    assert not at.canary.exists()


@pytest.mark.parametrize("name", chosen(list(hostile_runs.LINKS), 2))
def test_files_outside_an_untrusted_run_are_unchanged(name, at, good, cli):
    hostile_runs.LINKS[name](at)
    before = hostile_runs.outside(at)
    refused(cli("train", "--resume", at.run, "--max-iterations", "2"), (5,), "untrusted-run")
    for line in ({**commands(at.run, good.run), **reading(at.run, good.run)}).values():
        assert cli(*line).code in (0, 2, 3, 4, 5, 9, 10)
    after = hostile_runs.outside(at)
    assert {file: after.get(file) for file in before} == before
    new = {file for file in after if file not in before and "/untrusted-run" not in file}
    assert not {file for file in new if "victim" in file}, new


@pytest.mark.parametrize(("part", "command"), [("videos", "play"), ("exports", "export")])
def test_video_and_export_are_not_written_through_a_link(part, command, at, cli):
    victim = at.cwd / "victim"
    victim.write_text("kept")
    (at.run / part).mkdir(exist_ok=True)
    step = max((at.run / "checkpoints").glob("0*")).name
    (at.run / part / {"videos": f"{step}.gif", "exports": "policy.pt2"}[part]).symlink_to(victim)
    hostile_runs.link(at.run / part, at.cwd)
    line = ["export", "--checkpoint", at.run, "--format", "torch"]
    refused(cli(*(line if command == "export" else ["play", "--checkpoint", at.run, "--video"])), (5,), part)
    assert victim.read_text() == "kept"


RECORDINGS = {
    "a folder": {"task": {"name": "evil", "distribution": None, "folder": "{evil}"}},
    "a Python file": {"task": {"name": "evil", "folder": "{evil}", "python": "{evil}/task.py:TASK"}},
    "a file as distribution": {"task": {"name": "TASK", "distribution": "{evil}/task.py"}},
    "a task that is text": {"task": "evil"},
    "a task without a name": {"task": {"distribution": "rlcli"}},
    "a configuration that is a number": {"config": 7},
    "a configuration with an object": {"config": "a: !!python/object/apply:os.system ['touch {canary}']"},
    "a configuration of ten megabytes": {"config": " " * (10 << 20)},
    "episodes that are text": {"episodes": "all"},
    "an episode that is a number": {"episodes": [7]},
    "an episode with other fields": {"episodes": [{"evil": 1}]},
    "an episode of no environment": {"episodes": [{"env": 99}]},
    "an episode that never ends": {"episodes": [{"length": 10**12}]},
    "an episode before time": {"episodes": [{"begin": -5}]},
    "an episode that is longer than the recording": {"episodes": [{"length": 10_000}]},
    "a million environments": {"config": "num_envs"},
    "another format": {"format": "\x1b[2J"},
}


def forge(file, changes, at):
    """Write a changed recording with a matching digest."""
    from safetensors import safe_open
    from safetensors.torch import save

    from rlcli.replay.trajectory import content_digest

    with safe_open(file, "pt") as opened:
        document = json.loads(opened.metadata()["rlcli"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    for key, value in changes.items():
        if value == "num_envs":
            document["config"] = re.sub(r"num_envs: \d+", "num_envs: 10000000", document["config"])
        elif key == "task" and isinstance(value, dict):
            document["task"] = {k: v and v.format(**vars(at)) for k, v in value.items()}
        elif key == "episodes" and isinstance(value, list) and isinstance(value[0], dict) and "evil" not in value[0]:
            document["episodes"] = [{**document["episodes"][0], **value[0]}]
        else:
            document[key] = value.format(**vars(at)) if isinstance(value, str) else value
    del document["sha256"]
    document["sha256"] = content_digest(tensors, document)
    forged = at.cwd / "forged.safetensors"
    forged.write_bytes(save(tensors, metadata={"rlcli": json.dumps(document)}))
    return forged


@pytest.mark.parametrize("name", chosen(list(RECORDINGS), 4))
def test_untrusted_recording_executes_nothing(name, at, good, cli):
    refused(cli("replay", forge(good.recording, RECORDINGS[name], at)), (3, 4, 5), "forged.safetensors")
    assert not at.canary.exists()


@pytest.mark.parametrize("kind", ["a pipe", "a device", "a folder"])
def test_special_file_is_not_a_recording(kind, at, cli):
    file = at.cwd / "recording"
    {
        "a pipe": lambda: hostile_runs.pipe(file),
        "a folder": file.mkdir,
        "a device": lambda: file.symlink_to("/dev/zero"),
    }[kind]()
    refused(cli("replay", file), (5,), "recording")


@pytest.mark.parametrize("name", ["manifest.json", "policy.json", "policy.safetensors"])
def test_pipe_in_place_of_a_checkpoint_file_does_not_block(name, at, good, cli):
    for folder in (at.run / "checkpoints").glob("0*"):
        hostile_runs.pipe(folder / name)
    for command, line in commands(at.run, good.run).items():
        if command != "reproduce":  # which needs no checkpoint
            refused(cli(*line), (5,))


@pytest.mark.slow
def test_modules_in_the_current_folder_are_not_imported(at, good):
    """Start a process in the untrusted folder, beside modules with well-known names and a plugin's metadata."""
    shutil.copytree(at.evil, at.run, dirs_exist_ok=True)
    for name in ("yaml", "torch", "numpy", "typer", "json", "pydantic", "rlcli_tasks", "stable_baselines3", "evil"):
        (at.run / f"{name}.py").write_text(hostile_runs.code(at.canary))
    metadata = at.run / "evil-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Name: evil\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[rlcli.tasks]\ncartpole = evil:TASK\nevil = evil:TASK\n")
    line = [sys.executable, "-m", "rlcli", "show", "evil"]
    done = subprocess.run(line, cwd=at.run, capture_output=True, text=True, timeout=PATIENCE, env=os.environ.copy())
    assert done.returncode == 4, done.stderr
    line = [sys.executable, "-m", "rlcli", "play", "--checkpoint", ".", "--viewer", "none", "scene.num_envs=2"]
    done = subprocess.run(line, cwd=at.run, capture_output=True, text=True, timeout=PATIENCE, env=os.environ.copy())
    assert done.returncode == 0, done.stderr
    assert not at.canary.exists()


TASK = """
summary: A block.
decimation: 1
episode_length_s: 0.05
sim: {dt: 0.01}
scene: {num_envs: 4, entities: {robot: {model: model.xml}}}
actions: {effort: {func: joint_effort, joints: [slide]}}
observations: {policy: {pos: {func: joint_pos}}}
rewards: {mine: {func: mine, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
agents: {ppo: {trainer: sb3, algorithm: ppo, max_iterations: 1, n_steps: 8, num_minibatches: 2}}
"""
TERMS = "def mine(env):\n    return env.entities['robot'].data.joint_pos[:, 0]\n"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A task folder of the user."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "mine"
    folder.mkdir()
    for name, text in (("task.yaml", TASK), ("terms.py", TERMS), ("model.xml", hostile_runs.MODEL)):
        (folder / name).write_text(text)
    return folder


def test_task_plays_where_it_was_trained_or_has_been_named(own, cli, monkeypatch, tmp_path):
    assert cli("train", "./mine").code == 0
    (run,) = (tmp_path / "runs").glob("*/*")
    assert cli("play", "--checkpoint", "latest", "--viewer", "none").code == 0
    (note,) = (tmp_path / "state" / "used-tasks").iterdir()
    assert note.read_text() == str(own)
    assert note.stat().st_mode & 0o777 == 0o600
    monkeypatch.setenv("RLCLI_STATE_DIR", str(tmp_path / "another-machine"))
    for line in (["play", "--checkpoint", run, "--viewer", "none"], ["train", "--resume", run, "--max-iterations", 2]):
        refused(cli(*line), (5,), str(run), str(own), "rlcli play")
    moved = tmp_path / "elsewhere" / "mine"
    shutil.move(own, moved)
    assert cli("play", moved, "--checkpoint", run, "--viewer", "none").code == 0
    refused(cli("play", "--checkpoint", run, "--viewer", "none"), (5,), str(own))  # what the run names is gone
    assert cli("train", moved, "--resume", run, "--max-iterations", 2).code == 0
    shutil.move(moved, own)
    assert cli("eval", own, "--checkpoint", run, "--episodes", 2).code == 0
    assert cli("eval", "--checkpoint", run, "--episodes", 2).code == 0


def test_naming_an_installed_task_trusts_no_folder_of_that_name(at, cli):
    hostile_runs.CODE["a folder"](at)
    refused(
        cli("play", "cartpole", "--checkpoint", at.run, "--viewer", "none"), (5,), "has not been used on this machine"
    )
    assert not at.canary.exists()


def test_trust_is_limited_to_the_path_and_reference(own, cli, tmp_path):
    from rlcli.runs.trusted_tasks import is_known, named_task

    (own / "task.py").write_text("TASK = None\n")
    (tmp_path / "link").symlink_to(own)
    assert not is_known({"folder": str(own)})
    named_task("./mine")
    named_task("mine/task.py:TASK")
    assert is_known({"folder": str(own)})
    assert is_known({"folder": f"{tmp_path}/link/../mine/."})
    assert is_known({"folder": str(own), "python": f"{own}/task.py:TASK"})
    for record in (
        {"folder": str(own.parent)},
        {"folder": str(own / "terms.py")},
        {"folder": str(own), "python": f"{own}/task.py:OTHER"},
        {"folder": str(own), "python": f"{own}/terms.py:TASK"},
        {"folder": str(own), "python": f"{own}/task.py:TASK.__class__"},
    ):
        assert not is_known(record), record


def test_read_only_state_folder_is_not_an_error(own, cli, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("RLCLI_STATE_DIR", str(tmp_path / "file"))
    assert cli("train", "./mine").code == 0
    refused(cli("play", "--checkpoint", "latest", "--viewer", "none"), (5,), "has not been used")
