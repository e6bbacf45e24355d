"""Tests of data-parallel training with real processes: gloo on the CPU and PyTorch's launcher."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from support import worlds

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import UsageError
from rlcli.machine.cores import available_cores
from rlcli.registry import find_task
from rlcli.rl.distributed import _exit_code, is_rank_zero, local_rank_and_size
from rlcli.rl.ppo.trainer import PpoTrainer
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.run_ref import list_runs

AGENT = """
agents:
  ppo:
    trainer: ppo
    algorithm: ppo
    max_iterations: 9
    num_steps: 8
    num_minibatches: 1
    num_epochs: 3
    shuffle: none
    schedule: adaptive
    desired_kl: 0.002
    normalize_observations: true
    normalize_value: true
    reward_scale: 20.0
    actor: {hidden: [8]}
    critic: {hidden: [8]}
"""
WORKER = """
import glob, sys, torch
from test_ppo_distributed import make_trainer, load_rollout
from rlcli.rl import distributed
folder, task = sys.argv[1:]
process_group = distributed.join("cpu")
trainer = make_trainer(task, 4, process_group.seed(3, "environments"))
load_rollout(trainer, torch.load(folder + "/rollout.pt"), slice(4 * process_group.rank, 4 * process_group.rank + 4))
trainer.learner.update()
given = {"update": trainer.learner.weights.detach().clone(), "metrics": trainer.learner.metrics(),
         "normalizer": {name: value.clone() for name, value in trainer.collector.normalizer.state_dict().items()},
         "value": {name: value.clone() for name, value in trainer.collector.value_normalizer.state_dict().items()}}
trainer.start()
first = trainer.collector.obs["policy"].clone()
own = trainer.statistics._sums
ended = []
all_reduce = trainer.statistics.all_reduce
trainer.statistics.all_reduce = lambda group: (ended.append(sum(float(v[-2]) for v in own.values())), all_reduce(group))
for _ in range(6): trainer.iterate()
torch.save({**given, "first": first, "vector": trainer.learner.weights.detach(), "steps": trainer.env_steps,
            "ended": sum(ended), "episodes": trainer.statistics.total,
            "noise": trainer.collector.rollout.samples.action}, f"{folder}/{process_group.rank}.pt")
distributed.leave()
# a thread that outlives the process group can crash the process at exit
assert not [task for task in glob.glob("/proc/self/task/*/comm") if "gloo" in open(task).read()]
"""


def make_trainer(task, envs, seed=3):
    resolved = resolve(find_task(task), agent="ppo", overrides=[f"scene.num_envs={envs}"])
    trainer = PpoTrainer(make_env(resolved, seed=seed), resolved.agent, seed=0, device="cpu", torch_threads=1)
    trainer.start()
    return trainer


def copy_rollout(trainer):
    """Return copies of the tensors of a rollout; the second axis is the environment."""
    rollout = trainer.collector.rollout
    kept = {name: getattr(rollout, name) for name in ("_packed", "reward", "done", "time_out", "final_obs")}
    kept |= {f"raw.{name}": value for name, value in trainer.collector.raw_obs.items()}
    kept |= {f"obs.{name}": value[None] for name, value in trainer.collector.obs.items()}
    return {name: value.clone() for name, value in kept.items()}


def load_rollout(trainer, kept, envs):
    """Load the columns `envs` of a rollout that `copy_rollout` has returned."""
    held = {**copy_rollout(trainer)}
    for name in held:
        kind, _, group = name.partition(".")
        tensors = {"raw": trainer.collector.raw_obs, "obs": trainer.collector.obs}.get(kind)
        target = tensors[group] if tensors is not None else getattr(trainer.collector.rollout, name)
        target.copy_(kept[name][:, envs].reshape(target.shape))


@pytest.fixture
def critter(tmp_path) -> str:
    return str(worlds.critter(tmp_path, worlds.CRITTER_TASK + AGENT))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


def run_in_two_processes(*arguments: str) -> None:
    """Run a program in two processes, with the environment variables of a launcher."""
    port = str(free_port())
    workers = [
        subprocess.Popen(
            [sys.executable, "-c", *arguments],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "RANK": str(rank), "LOCAL_RANK": str(rank),
                 "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": port},
            stderr=subprocess.PIPE, text=True,
        )
        for rank in range(2)
    ]  # fmt: skip
    try:
        errors = [worker.communicate(timeout=120)[1] for worker in workers]
    finally:
        for worker in workers:
            worker.kill()
    assert [worker.returncode for worker in workers] == [0, 0], "\n".join(errors)


def test_two_processes_update_like_one_with_both_rollouts(critter, tmp_path):
    alone = make_trainer(critter, 8)
    alone.collector.collect()
    torch.save(copy_rollout(alone), tmp_path / "rollout.pt")
    run_in_two_processes(WORKER, str(tmp_path), critter)
    alone.learner.update()
    losses = alone.learner.metrics()
    both = [torch.load(tmp_path / f"{rank}.pt") for rank in range(2)]
    for one in both:
        torch.testing.assert_close(one["update"], alone.learner.weights.detach(), rtol=1e-4, atol=1e-5)
        assert one["metrics"].keys() == losses.keys()
        for name in ("Loss/surrogate", "Loss/value", "Loss/kl", "Loss/learning_rate", "Loss/clip_fraction"):
            assert one["metrics"][name] == pytest.approx(losses[name], rel=1e-3, abs=1e-5), name
        collector = alone.collector
        for name, normalizer in (("normalizer", collector.normalizer), ("value", collector.value_normalizer)):
            for key, value in normalizer.state_dict().items():
                torch.testing.assert_close(one[name][key], value, rtol=1e-5, atol=1e-6)
    assert losses["Loss/learning_rate"] != pytest.approx(1e-3)
    # equal weights to the bit, but different observations and noise
    assert torch.equal(both[0]["vector"], both[1]["vector"])
    assert not torch.equal(both[0]["vector"], both[0]["update"])
    assert not torch.equal(both[0]["first"], both[1]["first"])
    assert not torch.equal(both[0]["noise"], both[1]["noise"])
    assert both[0]["steps"] == both[1]["steps"] == 6 * 8 * 4 * 2
    assert both[0]["episodes"] == both[1]["episodes"] == both[0]["ended"] + both[1]["ended"]
    assert min(both[0]["ended"], both[1]["ended"]) > 0


# --- from the command line ---

TRAIN = (
    "train", "cartpole", "--agent", "ppo", "--num-envs", "16", "--device", "cpu", "--logger", "none", "--json",
    "agent.schedule=adaptive",
)  # fmt: skip
LAUNCHED = "import sys; from rlcli.rl.distributed import launch; sys.exit(launch(2, sys.argv[1:]))"
TORCHRUN = ("torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "rlcli")


def start(folder: Path, *command: str) -> subprocess.Popen:
    environment = {**os.environ, "RLCLI_RUNS_DIR": str(folder / "runs"), "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *command], env=environment, cwd=folder, **pipes)


def wait_for(process: subprocess.Popen, code: int = 0) -> tuple[dict, str]:
    out, err = process.communicate(timeout=200)
    assert process.returncode == code, err
    return json.loads(out) if out.strip() else {}, err


def run(folder: Path, *command: str, code: int = 0) -> tuple[dict, str]:
    return wait_for(start(folder, *command), code)


def metrics_of(done: dict) -> list[dict]:
    return [json.loads(line) for line in (Path(done["run"]) / "metrics.jsonl").read_text().splitlines()]


def policy_weights(done: dict) -> torch.Tensor:
    return open_checkpoint(Path(done["checkpoint"])).tensors("policy")["actor.0.weight"]


@pytest.mark.slow
def test_torchrun_run_resumes_with_one_or_two_processes(tmp_path):
    done, _ = run(tmp_path, "-m", *TORCHRUN, *TRAIN, "--max-iterations", "2", "--name", "parts")
    assert len(list_runs(tmp_path / "runs", "cartpole")) == 1
    assert done["step"] == 2 * 16 * 16 * 2
    assert [line["step"] for line in metrics_of(done)] == [512, 1024]
    assert json.loads((Path(done["run"]) / "run.json").read_text())["processes"] == 2

    again, err = run(tmp_path, "-m", *TORCHRUN, "train", "--resume", "latest", "--max-iterations", "4", "--device",
                     "cpu", "--json")  # fmt: skip
    assert "new episode" not in err
    whole, _ = run(tmp_path, "-m", *TORCHRUN, *TRAIN, "--max-iterations", "4", "--name", "whole")
    assert torch.equal(policy_weights(again), policy_weights(whole))

    alone, err = run(tmp_path, "-m", "rlcli", "train", "--resume", done["run"], "--max-iterations", "6", "--json")
    assert "saved with 2 processes and is resumed with 1: every environment starts a new episode" in err
    assert alone["run"] == done["run"]
    assert [line["step"] for line in metrics_of(alone)] == [512, 1024, 1536, 2048, 2304, 2560]
    single, _ = run(tmp_path, "-m", "rlcli", *TRAIN, "--max-iterations", "2", "--name", "single")
    assert not torch.equal(policy_weights(single), policy_weights(done))


@pytest.mark.slow
def test_signal_stops_all_processes_at_the_same_boundary(tmp_path):
    process = start(tmp_path, "-c", LAUNCHED, *TRAIN, "--max-iterations", "100000")
    for _ in range(600):
        if any((tmp_path / "runs").glob("cartpole/*/metrics.jsonl")):
            break
        time.sleep(0.1)
    time.sleep(1.0)
    process.send_signal(signal.SIGTERM)
    _, err = wait_for(process, code=75)
    (trained,) = list_runs(tmp_path / "runs", "cartpole")
    assert trained.record["state"] == "stopped"
    newest = max(trained.checkpoints.glob("*/manifest.json")).parent
    state = json.loads((newest / "state.json").read_text())
    assert state["iteration"] > 0
    assert err.count("checkpoint written") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "code", "fragment"),
    [
        (("agent.learning_rate=1e30", "agent.learning_rate_range=[1e-5, 1e30]"), 6, "not finite"),
        (("agent.num_stepz=3",), 3, "num_stepz"),
        (("--agent", "sb3-ppo", "agent.desired_kl=0.01"), 2, "trains in one process only"),
    ],
)
def test_launcher_reports_error_of_failed_process(tmp_path, changes, code, fragment):
    document, err = run(tmp_path, "-c", LAUNCHED, *TRAIN, "--max-iterations", "3", *changes, code=code)
    assert document["error"]["exit_code"] == code
    assert fragment in err
    assert "Traceback" not in err


def test_missing_gpus_are_a_device_error(tmp_path):
    document, _ = run(tmp_path, "-m", "rlcli", "train", "cartpole", "--gpus", "2", "--json", code=8)
    assert document["error"]["kind"] == "device"


def test_gpus_with_device_cpu_is_a_usage_error(tmp_path):
    document, _ = run(tmp_path, "-m", "rlcli", "train", "cartpole", "--gpus", "2", "--device", "cpu", "--json", code=2)
    assert "contradict" in document["error"]["message"]


@pytest.mark.parametrize(
    ("codes", "expected"), [([10, 6], 6), ([-15, 3], 3), ([-9], 10), ([10, -15], 10), ([1, 10], 1)]
)
def test_exit_code_is_of_the_process_that_failed_by_itself(codes, expected):
    assert _exit_code(codes) == expected


@pytest.mark.parametrize("name", ["LOCAL_WORLD_SIZE", "WORLD_SIZE", "RANK", "LOCAL_RANK"])
@pytest.mark.parametrize("text", ["x", "-1", "1_0", "1.0", "9" * 5000])
def test_malformed_variable_of_a_launcher_is_named(monkeypatch, name, text):
    variables = {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1", name: text}
    for key, value in variables.items():
        monkeypatch.setenv(key, value)
    with pytest.raises(UsageError, match=f"^the environment variable {name} is '") as caught:
        (is_rank_zero(), local_rank_and_size(), available_cores())
    assert len(caught.value.message) < 400
