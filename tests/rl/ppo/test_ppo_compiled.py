"""Tests of the compiled update: it matches the uncompiled update, which is used without a compiler."""

import shutil

import pytest
import torch
from support import worlds

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.rl.ppo.compile import tf32_matmul
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.loss import UpdateFunctions
from rlcli.rl.ppo.setup import compile_mode
from rlcli.rl.ppo.trainer import PpoTrainer

AGENTS = """
agents:
  ppo:
    {trainer: ppo, algorithm: ppo, max_iterations: 9, num_steps: 8, num_minibatches: 3, num_epochs: 2,
     actor: {hidden: [8]}, critic: {hidden: [8]}}
"""


@pytest.fixture
def make_trainer(tmp_path):
    """Function that makes a trainer from overrides; the critic has other observations than the actor."""
    task = str(worlds.critter(tmp_path, worlds.CRITTER_TASK + AGENTS))

    def build(*overrides):
        resolved = resolve(find_task(task), agent="ppo", overrides=["scene.num_envs=10", *overrides])
        trainer = PpoTrainer(make_env(resolved, seed=3), resolved.agent, seed=1, device="cpu", torch_threads=1)
        trainer.start()
        return trainer

    return build


def train(trainer, iterations=2):
    reports = [trainer.iterate() for _ in range(iterations)]
    return trainer, {**trainer.state().tensors["policy"], **trainer.state().tensors["trainer"]}, reports


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch compiles with g++ on a CPU, and there is none here")
@pytest.mark.parametrize("setting", ["agent.dialect=rsl_rl", "agent.dialect=rl_games", "agent.rnn={hidden: 4}"])
def test_compiled_update_matches_uncompiled_update(make_trainer, setting, tmp_path, monkeypatch, caplog):
    """The settings cover minibatches of 26 and 27 samples, both kinds of clipping and an adaptive learning rate."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "/tmp/torchinductor_user")  # as torch sets it when it is imported
    torch._dynamo.reset()
    (plain, expected, reports), (fused, found, fused_reports) = (
        train(make_trainer(setting, f"agent.compile={compiled}", "agent.max_grad_norm=0.1"))
        for compiled in ("false", "true")
    )
    assert plain.learner.functions == UpdateFunctions()
    assert not set(fused.learner.functions) & set(plain.learner.functions)
    assert list((tmp_path / "rlcli" / "inductor").iterdir())
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-5, msg=name)
    assert not [record for record in caplog.records if record.name.startswith("rlcli")]
    for mine, theirs in zip(fused_reports, reports, strict=True):
        assert mine.metrics == pytest.approx(theirs.metrics, rel=1e-4, abs=1e-5)


@pytest.mark.slow
def test_missing_compiler_runs_uncompiled_with_one_warning(make_trainer, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    torch._dynamo.reset()
    import torch._inductor.config as inductor

    monkeypatch.setattr(inductor.cpp, "cxx", (None, str(tmp_path / "no-compiler")))
    trainer, _, _ = train(make_trainer("agent.compile=true"))
    assert trainer.learner.functions == UpdateFunctions()
    (warning,) = [record for record in caplog.records if record.name.startswith("rlcli")]
    assert warning.levelname == "WARNING"
    assert "cannot be compiled and runs uncompiled" in warning.message


@pytest.mark.parametrize(
    ("settings", "device", "expected"),
    [
        ({"max_iterations": 10**9}, "cpu", False),
        ({"max_iterations": 10**9}, "cuda", True),
        ({"max_iterations": 10**9, "compile": False}, "cuda", False),
        ({"max_iterations": 1, "compile": True}, "cpu", True),
        ({"max_iterations": 1, "compile": "tuned"}, "cuda", "tuned"),
        ({"max_iterations": 120}, "cuda", False),
        ({"max_steps": 120 * 65536}, "cuda", False),
        ({"max_steps": 10**9 * 65536}, "cuda", True),
        ({"max_steps": 10**9 * 65536, "max_iterations": 120}, "cuda", False),
        ({"max_iterations": 120, "minibatch_size": 16}, "cuda", True),
    ],
)
def test_compile_mode_depends_on_setting_device_and_run_length(settings, device, expected):
    config = PpoConfig(trainer="ppo", **settings)
    assert compile_mode(config, torch.device(device), 65536) == expected


@pytest.mark.parametrize("allowed", [True, False])
def test_tf32_matmul_restores_precision(allowed):
    before = torch.get_float32_matmul_precision()
    with tf32_matmul(allowed):
        assert torch.get_float32_matmul_precision() == ("high" if allowed else before)
    assert torch.get_float32_matmul_precision() == before == "highest"
