"""SIGKILL at every moment: saved files are complete, and the resumed run equals an uninterrupted one."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support.child_processes import SMALL
from support.fault_points import KILLED_AT
from support.fault_sizes import FIRST_SEED, SIZE, amount, chosen, seeds
from support.run_comparison import assert_loads, assert_same_run, newest

from rlcli.replay.trajectory import read_trajectory
from rlcli.runs.checkpoint_reader import steps

SAC = """
agents:
  small:
    {trainer: sb3, algorithm: sac, train_freq: 4, gradient_steps: 2, learning_starts: 24, batch_size: 8,
     buffer_size: 96, policy: {hidden: [8]}, normalize_observations: true}
"""
PPO = """
agents:
  small:
    {trainer: ppo, algorithm: ppo, num_steps: 8, num_minibatches: 2, num_epochs: 2, actor: {hidden: [8]},
     critic: {hidden: [8]}, normalize_observations: true}
"""
SHORT = ("episode_length_s=0.3", "agent.save_interval=1", "--max-iterations", 8)
MINI = ("agent.num_minibatches=2", "agent.policy.hidden=[8]")
RUNS = {
    # a step of everything that is written: evaluations, the best, retention, TensorBoard
    "sb3-ppo": (
        "cartpole",
        "agent.n_steps=8",
        "agent.n_epochs=2",
        "agent.eval_interval=2",
        "agent.eval_episodes=2",
        "agent.keep_last=2",
        *MINI,
    ),
    # replay rows in files of their own, in a ring of 24 steps that wraps
    "sac": ("cartpole", "--config", "sac.yaml", "--agent", "small", "agent.keep_last=2", "agent.keep_every=3"),
    "ppo": ("cartpole-direct", "--config", "ppo.yaml", "--agent", "small", "agent.keep_last=1", "--logger", "none"),
}
RESUMING = [
    "before the metrics are cut", "after the metrics are cut", "in the middle of the cut",
    "in the middle of TensorBoard's cut", "after TensorBoard's cut",
]  # fmt: skip
ROWS = ["in the middle of replay rows", "before replay rows have their name"]
RECORD = ["before run.json", "in the middle of run.json"]
KEPT = ["in the middle of a kept episode", "before a kept episode has its name"]
WRITING = [point for point in KILLED_AT if point not in (*RESUMING, *ROWS, *RECORD, *KEPT)]
FALLING = ("cartpole", "agent.n_steps=8", *MINI, "agent.autopsy.keep=1000",
           "terminations.cart_out_of_bounds.bounds=[-0.3,0.3]")  # fmt: skip
NAMED = [
    *((point, nth, name) for point in WRITING for nth, name in ((1, "sb3-ppo"), (4, "sac"), (3, "ppo"))),
    # its first time the run begins to be one
    *((point, nth, name) for point in RECORD for nth, name in ((2, "sb3-ppo"), (4, "sb3-ppo"), (3, "sac"))),
    *((point, nth, "sac") for point in ROWS for nth in (1, 3, 5)),
    *((point, 1, name) for point in RESUMING for name in ("sb3-ppo", "sac")),
]
NAMED = [case for case in NAMED if not ("TensorBoard" in case[0] and case[2] == "ppo")]


def train(child, folder, name, **faults):
    return child(folder, "train", *RUNS[name], *SMALL, *SHORT, "--seed", 5, **faults)


def prepared(folder):
    (folder / "sac.yaml").write_text(SAC)
    (folder / "ppo.yaml").write_text(PPO)
    return folder


@pytest.fixture(scope="module")
def uninterrupted(child, tmp_path_factory):
    """Uninterrupted runs and their durations."""
    done = {}

    def of(name):
        if name not in done:
            folder = prepared(tmp_path_factory.mktemp("whole"))
            begin = time.monotonic()
            ended = train(child, folder, name).ended()
            assert ended.code == 0, ended.err
            done[name] = run_in(folder), time.monotonic() - begin
        return done[name]

    return of


def run_in(folder):
    (run,) = [file.parent for file in folder.glob("runs/*/*/run.json")]
    return run


def killed_at(point, nth=1):
    call, pattern, when = KILLED_AT[point]
    return [{"kind": "kill", "call": call, "pattern": pattern, "when": when, "nth": nth}]


def assert_killed(ended):
    assert ended.code == -signal.SIGKILL, (ended.code, ended.err)


@pytest.mark.parametrize(("point", "nth", "name"), chosen(NAMED, 1), ids=lambda value: str(value).replace(" ", "-"))
def test_run_killed_at_a_fault_point_resumes_bit_identical(child, uninterrupted, tmp_path, point, nth, name):
    folder = prepared(tmp_path)
    if point in RESUMING:  # twice: it had come some way before
        assert_killed(train(child, folder, name, faults=killed_at("after the rename", 4)).ended())
        again = child(folder, "train", "--resume", run_in(folder), "-q", faults=killed_at(point, nth))
        assert_killed(again.ended())
    else:
        assert_killed(train(child, folder, name, faults=killed_at(point, nth)).ended())
    run = run_in(folder)
    assert_loads(run)
    resumed = child(folder, "train", "--resume", "latest", "-q").ended()
    assert resumed.code == 0, resumed.err
    assert_same_run(run, uninterrupted(name)[0])


def terminated(run):
    """Return the recorded episodes of a run that ended by a termination."""
    headers = [read_trajectory(file).header for file in (run / "autopsy").glob("*.safetensors")]
    return sorted(
        (header.failure.step, e.env, e.index, e.length, e.total_reward)
        for header in headers
        for e in header.episodes
        if header.failure.kind == "terminated"
    )


@pytest.mark.slow
@pytest.mark.parametrize("point", KEPT)
def test_kill_while_writing_cases_leaves_each_once_and_complete(child, tmp_path, point):
    runs = []
    for name, faults in (("whole", []), ("killed", killed_at(point, 3))):
        (tmp_path / name).mkdir()
        ended = child(tmp_path / name, "train", *FALLING, *SMALL, *SHORT, "--seed", 5, faults=faults).ended()
        assert ended.code == (-signal.SIGKILL if faults else 0), ended.err
        runs.append(run_in(tmp_path / name))
    uninterrupted, killed = runs
    for file in (killed / "autopsy").glob("*.safetensors"):
        read_trajectory(file)  # also before anything is cleaned away
    resumed = child(tmp_path / "killed", "train", "--resume", "latest", "-q").ended()
    assert resumed.code == 0, resumed.err
    assert_same_run(killed, uninterrupted)
    assert len(terminated(uninterrupted)) > 3
    assert terminated(killed) == terminated(uninterrupted)


@pytest.mark.slow
@pytest.mark.parametrize("number", seeds(1, 20, 240))
def test_run_killed_at_a_random_time_resumes_bit_identical(child, uninterrupted, tmp_path, number):
    draw, name = random.Random(number), list(RUNS)[number % len(RUNS)]
    reference, took = uninterrupted(name)
    folder, begun = prepared(tmp_path), None
    for _ in range(draw.choice([1, 1, 2, 3])):
        now = train(child, folder, name) if begun is None else child(folder, "train", "--resume", begun, "-q")
        time.sleep(draw.uniform(0.0, took))
        os.kill(now.pid, signal.SIGKILL)
        assert now.ended().code in (0, -signal.SIGKILL)  # it may have been done
        runs = list(folder.glob("runs/*/*/run.json"))  # before that there is no run
        if runs:
            begun = runs[0].parent
            assert_loads(begun)
    arguments = (*RUNS[name], *SMALL, *SHORT, "--seed", 5) if begun is None else ("--resume", begun, "-q")
    resumed = child(folder, "train", *arguments).ended()
    assert resumed.code == 0, resumed.err
    assert_same_run(run_in(folder), reference)


@pytest.mark.slow
def test_run_killed_before_its_first_checkpoint_restarts(child, uninterrupted, tmp_path):
    folder = prepared(tmp_path)
    assert_killed(train(child, folder, "sac", faults=killed_at("before the rename")).ended())
    assert steps(run_in(folder) / "checkpoints") == []
    resumed = child(folder, "train", "--resume", "latest").ended()
    assert resumed.code == 0, resumed.err
    assert "starts again" in resumed.err
    assert_same_run(run_in(folder), uninterrupted("sac")[0])


@pytest.mark.slow
def test_run_without_its_checkpoints_does_not_restart(child, tmp_path, uninterrupted):
    run = tmp_path / "runs/cartpole/r"
    shutil.copytree(uninterrupted("sac")[0], run)
    for folder in run.glob("checkpoints/0*"):
        shutil.rmtree(folder)
    ended = child(tmp_path, "train", "--resume", run, "--max-iterations", 9).ended()
    assert ended.code == 5
    assert "no complete checkpoint" in ended.err


@pytest.mark.slow
@pytest.mark.skipif(SIZE == "sample", reason="minutes long: make test-faults runs it")
@pytest.mark.timeout(1800)
def test_cartpole_training_killed_five_times_has_equal_weights(tmp_path):
    def start(folder, *arguments):
        command = [sys.executable, "-m", "rlcli", "train", *map(str, arguments), "--quiet"]
        return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def weights(folder):
        (run,) = [file.parent for file in folder.glob("runs/*/*/run.json")]
        assert json.loads((run / "run.json").read_text())["state"] == "finished"
        return newest(run).manifest["files"]["policy.safetensors"]["sha256"]

    (tmp_path / "whole").mkdir()
    (tmp_path / "killed").mkdir()
    begin = time.monotonic()
    arguments = ("cartpole", "--seed", 3, "--max-iterations", 60)
    process = start(tmp_path / "whole", *arguments)
    assert process.communicate()[0], "its run"
    took, draw = time.monotonic() - begin, random.Random(FIRST_SEED)
    for _ in range(5):
        process = start(tmp_path / "killed", *arguments)
        time.sleep(draw.uniform(0.1, 0.5) * took)
        process.kill()
        process.communicate()
        if list(Path(tmp_path).glob("killed/runs/*/*/run.json")):
            arguments = ("--resume", "latest")
    process = start(tmp_path / "killed", *arguments)
    message = process.communicate()[0]
    assert process.returncode == 0, message
    assert weights(tmp_path / "killed") == weights(tmp_path / "whole")


WRITERS = {
    "out.gif": ("play", "cartpole", "--video", "out.gif", "-q"),
    "out.mp4": ("play", "cartpole", "--video", "out.mp4", "-q"),
    "out.safetensors": ("eval", "cartpole", "--episodes", 16, *SMALL[:2], "--record", "out.safetensors", "-q"),
    "out.py": ("export", "cartpole", "--format", "numpy", "--output", "out.py", "-q"),
    "out.onnx": ("export", "cartpole", "--output", "out.onnx", "-q"),
    "out": ("export", "cartpole", "--format", "bundle", "--output", "out", "-q"),
}


def written(path):
    return {file.name: file.read_bytes() for file in ([path] if path.is_file() else path.glob("*"))}


@pytest.mark.slow
@pytest.mark.parametrize("name", chosen(list(WRITERS), 2))
def test_killed_writer_leaves_a_complete_file_or_none(child, uninterrupted, tmp_path, name):
    for folder in ("whole", "killed"):
        shutil.copytree(uninterrupted("sb3-ppo")[0], tmp_path / folder / "runs" / "cartpole" / "r")
    begin = time.monotonic()
    assert child(tmp_path / "whole", *WRITERS[name]).ended().code == 0
    took, draw, folder = time.monotonic() - begin, random.Random(FIRST_SEED), tmp_path / "killed"
    expected = written(tmp_path / "whole" / name)
    for _ in range(amount(2, 5, 40)):
        process = child(folder, *WRITERS[name])
        time.sleep(draw.uniform(0.1, 1.0) * took)
        os.kill(process.pid, signal.SIGKILL)
        process.ended()
        assert written(folder / name) in ({}, expected)
    ended = child(folder, *WRITERS[name]).ended()
    assert ended.code == 0, ended.err
    assert written(folder / name) == expected
    assert not list(folder.glob(".out*")), "files of the killed processes"
