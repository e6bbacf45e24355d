"""Tests of the built-in PPO from the command line: runs, exact resume, export and evaluation."""

import json
from pathlib import Path

import onnxruntime
import pytest
import torch

from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.evaluation.evaluate import evaluate
from rlcli.registry import find_task
from rlcli.rl.ppo.trainer import PpoTrainer
from rlcli.runs.checkpoint_reader import open_checkpoint


@pytest.fixture
def cli(tmp_path, monkeypatch, capfd):
    """Function that runs a command in an empty folder and returns its JSON."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RLCLI_RUNS_DIR", raising=False)

    def run(*arguments, code=0):
        capfd.readouterr()
        found = main([*(str(argument) for argument in arguments), "--json"])
        out, err = capfd.readouterr()
        assert found == code, err
        return json.loads(out)

    return run


TRAIN = ("train", "cartpole", "--agent", "ppo", "--num-envs", "16", "--logger", "none")


def open_checkpoint_of(done):
    return open_checkpoint(Path(done["checkpoint"]))


def test_resumed_run_matches_uninterrupted_run_bit_for_bit(cli):
    normalize = ("agent.normalize_observations=true", "agent.normalize_value=true", "agent.schedule=adaptive")
    whole = cli(*TRAIN, *normalize, "--max-iterations", "4", "--name", "whole")
    cli(*TRAIN, *normalize, "--max-iterations", "2", "--name", "parts")
    parts = cli("train", "--resume", "latest", "--max-iterations", "4")
    left, right = (open_checkpoint_of(done) for done in (whole, parts))
    assert left.manifest["files"]["policy.safetensors"] == right.manifest["files"]["policy.safetensors"]
    assert left.manifest["files"]["trainer.safetensors"] == right.manifest["files"]["trainer.safetensors"]


@pytest.mark.parametrize("overrides", [(), ("agent.normalize_observations=true", "agent.std=scalar")])
def test_exported_policy_matches_trained_policy(cli, overrides):
    done = cli(*TRAIN, *overrides, "--max-iterations", "3")
    exported = cli("export", "--checkpoint", done["run"], "--output", "policy.onnx")
    assert exported["max_difference"] < 1e-5
    obs = torch.randn(100, 4) * 3
    (action,) = onnxruntime.InferenceSession("policy.onnx").run(["action"], {"obs": obs.numpy()})
    with torch.no_grad():
        expected = open_checkpoint_of(done).policy()(obs)
    torch.testing.assert_close(torch.from_numpy(action), expected, rtol=1e-5, atol=1e-5)


def test_trained_policy_is_evaluated_and_initialises_a_run(cli):
    done = cli(*TRAIN, "--max-iterations", "2")
    assert cli("eval", "--checkpoint", done["run"], "--episodes", "4", "--num-envs", "4")["episodes"] == 4
    other = cli(*TRAIN, "--max-iterations", "1", "--init-from", done["run"], "agent.learning_rate=1e-9",
                "agent.schedule=constant", "agent.desired_kl=null")  # fmt: skip
    left, right = (open_checkpoint_of(run).tensors("policy")["actor.0.weight"] for run in (done, other))
    torch.testing.assert_close(left, right, rtol=0, atol=1e-6)


def test_resume_refuses_checkpoint_without_value_normalizer(cli):
    done = cli(*TRAIN, "--max-iterations", "1", "--name", "plain")
    config = open_checkpoint_of(done).folder.parent.parent / "config.yaml"
    config.write_text(config.read_text().replace("normalize_value: false", "normalize_value: true"))
    error = cli("train", "--resume", "latest", "--max-iterations", "2", code=5)["error"]
    assert "cannot be resumed" in error["message"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_agent_solves_cartpole(task, seed):
    resolved = resolve(find_task(task), agent="ppo", overrides=["scene.num_envs=512"])
    trainer = PpoTrainer(make_env(resolved, seed=seed), resolved.agent, seed=seed, device="cpu", torch_threads=1)
    trainer.start()
    for _ in range(resolved.agent.max_iterations):
        trainer.iterate()
    played = resolve(find_task(task), agent="ppo", overrides=["scene.num_envs=1000"])
    summary = evaluate(make_env(played, seed=1000 + seed), trainer.policy(), 1000).summary()
    assert summary["success"]["rate"] >= 0.99
