"""Signals at any moment: the run stops soon with the right exit code, and resumes bit-identical."""

import json
import os
import pty
import random
import re
import shutil
import signal
import time
from pathlib import Path

import pytest
from support.child_processes import PATIENCE, SMALL
from support.fault_sizes import amount, chosen
from support.run_comparison import assert_same_run, newest

import rlcli_tasks.cartpole

SHORT = ("episode_length_s=0.3", "agent.n_steps=64", "agent.n_epochs=10", "agent.policy.hidden=[8]", "--logger", "none")
TRAIN = ("cartpole", *SMALL, *SHORT, "--max-iterations", 4, "--seed", 5)
STEP, UPDATE = "rlcli.envs.vec_env:VecEnv.step", "rlcli.rl.optimizers:Adam.step"
LONG_FIRST = {"kind": "sleep", "call": STEP, "pattern": "", "nth": 3, "seconds": 0.2}
"""Delays: the first iteration is slow, so that the second can be interrupted."""
PHASES = {
    # in the second of four iterations: 64 steps, 40 updates each
    "rollout": {"kind": "slow", "call": STEP, "pattern": "", "nth": 64 + 20, "seconds": 0.3},
    "update": {"kind": "slow", "call": UPDATE, "pattern": "", "nth": 40 + 9, "seconds": 0.3},
    "save": {"kind": "slow", "call": "fsync", "pattern": r"checkpoints/\.tmp-", "nth": 9, "seconds": 0.2},
}
SIGNALS = {
    "SIGINT": ([signal.SIGINT], 130),
    "SIGTERM": ([signal.SIGTERM], 75),
    "SIGUSR1": ([signal.SIGUSR1], 75),
    "SIGHUP": ([signal.SIGHUP], 75),
    "SIGINT twice": ([signal.SIGINT, signal.SIGINT], 130),
    "SIGPIPE": ([signal.SIGPIPE], 0),
}
CASES = [(number, phase) for phase in (*PHASES, "plugin import") for number in SIGNALS]
PLUGIN = """
import time
from pathlib import Path
Path("slow").write_text(".")
while not Path("go on").exists():
    time.sleep(0.01)
"""


@pytest.fixture(scope="module")
def uninterrupted(child, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    assert child(folder, "train", *TRAIN).ended().code == 0
    return run_in(folder)


def run_in(folder):
    (run,) = [file.parent for file in folder.glob("runs/*/*/run.json")]
    return run


def slow_moments(folder):
    return len((folder / "slow").read_text()) if (folder / "slow").exists() else 0


def in_phase(child, folder, phase, *more, **settings):
    """Start a training, and return in the middle of a phase that takes seconds."""
    process = child(folder, "train", *TRAIN, *more, faults=[PHASES[phase], LONG_FIRST], **settings)
    process.until(lambda: slow_moments(folder))
    return process


@pytest.mark.parametrize(("number", "phase"), chosen(CASES, 1))
def test_signal_stops_soon_and_the_run_resumes_bit_identical(
    child, tmp_path, uninterrupted, number, phase
):  # fmt: skip
    numbers, code = SIGNALS[number]
    if phase == "plugin import":
        stops_in_an_import(child, tmp_path, numbers, code)
        return
    save = ("agent.save_interval=1",) if phase == "save" else ()
    process = in_phase(child, tmp_path, phase, *save)
    before = slow_moments(tmp_path)
    os.kill(process.pid, numbers[0])
    if len(numbers) > 1:
        time.sleep(0.05)
        if process.runs():
            os.kill(process.pid, numbers[1])
    ended = process.ended()
    assert "Traceback" not in ended.err, ended.err
    assert ended.code == code, ended.err
    run = run_in(tmp_path)
    if code:
        record = json.loads((run / "run.json").read_text())
        assert record["state"] == "stopped" or len(numbers) == 2
        if len(numbers) == 1:
            assert record["step"] == newest(run).step
        assert ended.out == ""
        if phase != "save":
            assert slow_moments(tmp_path) <= before + 2, "it stopped at the next step"
        if phase != "save" and len(numbers) == 1:
            assert record["iteration"] == 1, "the boundary before the iteration that was left"
        hint = re.search(r"hint: rlcli (train --resume \S+)", ended.err)
        assert hint or len(numbers) == 2, ended.err
        resumed = child(tmp_path, *(hint[1].split() if hint else ("train", "--resume", "latest")), "-q").ended()
        assert resumed.code == 0, resumed.err
    assert_same_run(run, uninterrupted)


def stops_in_an_import(child, folder, numbers, code):
    """Stop during the import of a task's module, when there is nothing to resume yet."""
    task, cartpole = folder / "mine", Path(rlcli_tasks.cartpole.__file__).parent
    task.mkdir()
    shutil.copy(cartpole / "direct.yaml", task / "task.yaml")
    shutil.copy(cartpole / "cartpole.xml", task)
    source = (cartpole / "task.py").read_text().replace("from __future__ import annotations", "")
    (task / "task.py").write_text(PLUGIN + source.replace("CartpoleTask", "Task"))
    more = ("scene.num_envs=4", "sim.engine_threads=1", "agent.torch_threads=1", "--max-iterations", 1)
    process = child(folder, "train", "./mine", *more, "--logger", "none", "-q")
    process.until(lambda: slow_moments(folder))
    for number in numbers:
        if process.runs():
            os.kill(process.pid, number)
    if not code:
        (folder / "go on").touch()
    ended = process.ended()
    assert "Traceback" not in ended.err, ended.err
    assert ended.code == code, ended.err
    runs = list(folder.glob("runs/*/*"))
    if code:
        assert runs == []
        assert "stopped before training began" in ended.err
    else:
        assert newest(runs[0]).iteration == 1


@pytest.mark.slow
def test_sighup_ignored_by_nohup_does_not_stop(child, tmp_path, uninterrupted):
    process = in_phase(child, tmp_path, "update", ignored=("SIGHUP",))
    os.kill(process.pid, signal.SIGHUP)
    ended = process.ended()
    assert ended.code == 0, ended.err
    assert_same_run(run_in(tmp_path), uninterrupted)


@pytest.mark.slow
@pytest.mark.parametrize("streams", [("err",), ("out",), ("out", "err")], ids="+".join)
def test_closed_output_pipe_does_not_stop_the_training(child, tmp_path, uninterrupted, streams):
    """Close the output as `rlcli train ... 2>&1 | head -1` does."""
    output, readers = tmp_path / "child", []
    for stream in streams:
        os.mkfifo(f"{output}.{stream}")
        readers.append(os.open(f"{output}.{stream}", os.O_RDONLY | os.O_NONBLOCK))
    loud = [word for word in TRAIN if word != "-q"]
    faults = [{"kind": "slow", "call": STEP, "pattern": "", "nth": 60, "seconds": 0.001}]
    process = child(tmp_path, "train", *loud, faults=faults, output=output)
    deadline = time.monotonic() + PATIENCE
    while not slow_moments(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.005)
    if "err" in streams:
        assert os.read(readers[-1], 10)
    for reader in readers:
        os.close(reader)
    status = process.ask(wait=process.pid, seconds=PATIENCE)["status"]
    assert status == 0
    assert_same_run(run_in(tmp_path), uninterrupted)


@pytest.mark.slow
def test_closed_terminal_does_not_stop_a_run_that_ignores_sighup(child, tmp_path, uninterrupted):
    terminal, name = pty.openpty()
    output = tmp_path / "child"
    for stream in ("out", "err"):
        Path(f"{output}.{stream}").symlink_to(os.ttyname(name))
    loud = [word for word in TRAIN if word != "-q"]
    faults = [{"kind": "slow", "call": STEP, "pattern": "", "nth": 60, "seconds": 0.005}]
    process = child(tmp_path, "train", *loud, faults=faults, output=output, ignored=("SIGHUP",))
    assert os.read(terminal, 10)
    os.close(name)
    os.close(terminal)
    assert process.ask(wait=process.pid, seconds=PATIENCE)["status"] == 0
    assert_same_run(run_in(tmp_path), uninterrupted)


ENDLESS = ("eval", "cartpole", "--policy", "zero", "--episodes", "1000000", "scene.num_envs=4")


@pytest.mark.processes
@pytest.mark.parametrize(
    ("number", "code", "message"),
    [
        (signal.SIGINT, 130, "error: interrupted\n"),
        (signal.SIGTERM, 75, "error: stopped by the signal SIGTERM\nhint: run the command again\n"),
        (signal.SIGHUP, 75, "error: stopped by the signal SIGHUP\nhint: run the command again\n"),
    ],
)
def test_signal_ends_a_command_that_does_not_train(start, empty_folder, number, code, message):
    process = start("doctor")
    assert process.stderr.readline().startswith("checking all plugins")
    process.send_signal(number)
    assert process.wait(timeout=PATIENCE) == code
    assert process.stderr.read().endswith(message)
    assert process.stdout.read() == ""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("words", [ENDLESS, ("list-tasks",), ("doctor",)])
def test_signals_at_random_times_print_no_traceback(start, empty_folder, words, number):
    for _ in range(amount(2, 10, 40)):
        process = start(*words)
        for _ in range(random.choice([1, 2, 3])):
            time.sleep(random.uniform(0.1, 1))  # before it has loaded rlcli, Python prints a traceback of its own
            process.send_signal(number)
        assert process.wait(timeout=PATIENCE) in (0, 75, 130, -number)
        assert "Traceback" not in process.stderr.read()
