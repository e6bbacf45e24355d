"""Training with several worker processes: the same files as with one, exact resume with other numbers, dead workers."""

import os
import signal
import subprocess
import sys
import time

import pytest
from safetensors import safe_open
from support.sharded_runs import same

SMALL = ["--agent", "ppo", "--device", "cpu", "--seed", "3", "--logger", "none", "-q"]
OVERRIDES = ["scene.num_envs=16", "agent.num_steps=16", "agent.torch_threads=1", "episode_length_s=0.9"]


def train(folder, workers, *words, task="cartpole"):
    """Run `rlcli train`; return the folder of the run."""
    command = [sys.executable, "-P", "-m", "rlcli", "train"]
    command += [*words] if "--resume" in words else [task, *SMALL, *OVERRIDES, f"scene.workers={workers}", *words]
    done = subprocess.run([*command, "--runs-dir", str(folder)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (run,) = [file.parent for file in folder.glob("*/*/run.json")]
    return run


def tensors(file):
    with safe_open(file, "pt") as opened:
        return {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - it is no mapping


def assert_equal_runs(one, other):
    """Compare checkpoints and failure cases; settings and times differ."""
    files = sorted(str(file.relative_to(one)) for file in one.rglob("*.safetensors"))
    assert files == sorted(str(file.relative_to(other)) for file in other.rglob("*.safetensors"))
    for file in files:
        assert same(tensors(one / file), tensors(other / file)), file


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_workers_do_not_change_checkpoints_and_failure_cases(tmp_path, task):
    one = train(tmp_path / "one", 1, "--max-iterations", "3", task=task)
    three = train(tmp_path / "three", 3, "--max-iterations", "3", task=task)
    assert_equal_runs(one, three)
    if task == "cartpole-direct":
        assert list(one.glob("autopsy/*.safetensors"))


def test_run_resumes_exactly_with_other_number_of_workers(tmp_path):
    whole = train(tmp_path / "whole", 1, "--max-iterations", "4")
    run = train(tmp_path / "parts", 3, "--max-iterations", "4", "agent.save_interval=1", "agent.keep_last=9")
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("workers: 3", "workers: 2"))
    assert "workers: 2" in (run / "config.yaml").read_text()
    train(tmp_path / "parts", 2, "--resume", f"{run}@step:512")
    newest = sorted((whole / "checkpoints").glob("0*"))[-1].name
    for part in ("policy", "trainer", "env"):
        file = f"checkpoints/{newest}/{part}.safetensors"
        assert same(tensors(whole / file), tensors(run / file)), part


def children(pid):
    """Return the numbers of the child processes."""
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def started(tmp_path):
    """Start an endless training with three workers; return the process when its first iteration has ended."""
    command = [sys.executable, "-P", "-m", "rlcli", "train", "cartpole", *SMALL, *OVERRIDES, "scene.workers=3"]
    command += ["--max-iterations", "100000", "--runs-dir", str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 240
    while not any(file.stat().st_size for file in tmp_path.glob("*/*/metrics.jsonl")):
        assert time.monotonic() < deadline
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    return process


def ended(pids, seconds=20):
    deadline = time.monotonic() + seconds
    while any(os.path.exists(f"/proc/{pid}") for pid in pids):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


@pytest.mark.slow
def test_killed_worker_ends_training_with_one_error_and_run_resumes(tmp_path):
    process = started(tmp_path)
    workers = children(process.pid)
    assert len(workers) == 2
    os.kill(workers[1], signal.SIGKILL)
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 10
    assert error.count("error:") == 1
    assert "worker process 2" in error
    assert "SIGKILL" in error
    assert ended(workers)
    (run,) = [file.parent for file in tmp_path.glob("*/*/run.json")]
    train(tmp_path, 3, "--resume", str(run), "--max-iterations", "1")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75), (signal.SIGKILL, -9)])
def test_workers_end_with_training(tmp_path, number, code):
    process = started(tmp_path)
    workers = children(process.pid)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert process.returncode == code
    assert ended(workers)
