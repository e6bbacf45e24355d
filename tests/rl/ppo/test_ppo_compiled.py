"""The compiled update: the same numbers as the plain one, and the plain one where there is no compiler."""

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
def trainer_of(tmp_path):
    """Overrides -> a trainer in a world whose critic sees other things than its policy."""
    task = str(worlds.critter(tmp_path, worlds.CRITTER_TASK + AGENTS))

    def build(*overrides):
        resolved = resolve(find_task(task), agent="ppo", overrides=["scene.num_envs=10", *overrides])
        trainer = PpoTrainer(make_env(resolved, seed=3), resolved.agent, seed=1, device="cpu", torch_threads=1)
        trainer.start()
        return trainer

    return build


def learned(trainer, iterations=2):
    reports = [trainer.iterate() for _ in range(iterations)]
    return trainer, {**trainer.state().tensors["policy"], **trainer.state().tensors["trainer"]}, reports


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch compiles with g++ on a CPU, and there is none here")
@pytest.mark.parametrize("setting", ["agent.dialect=rsl_rl", "agent.dialect=rl_games", "agent.rnn={hidden: 4}"])
def test_a_compiled_update_gives_the_numbers_of_the_plain_one(trainer_of, setting, tmp_path, monkeypatch, caplog):
    """Minibatches of 26 and 27 samples; gradients clipped apart or jointly, an adaptive learning rate at work."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "/tmp/torchinductor_somebody")  # as torch sets it when imported
    torch._dynamo.reset()
    (plain, expected, reports), (fused, found, fused_reports) = (
        learned(trainer_of(setting, f"agent.compile={given}", "agent.max_grad_norm=0.1")) for given in ("false", "true")
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
def test_without_a_compiler_the_update_runs_as_it_is_and_one_warning_says_so(trainer_of, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    torch._dynamo.reset()
    import torch._inductor.config as inductor

    monkeypatch.setattr(inductor.cpp, "cxx", (None, str(tmp_path / "no-compiler")))
    trainer, _, _ = learned(trainer_of("agent.compile=true"))
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
def test_an_update_is_compiled_if_asked_for_and_on_a_gpu_if_the_run_is_long(settings, device, expected):
    config = PpoConfig(trainer="ppo", **settings)
    assert compile_mode(config, torch.device(device), 65536) == expected


@pytest.mark.parametrize("allowed", [True, False])
def test_rounding_to_tf32_ends_with_what_it_is_allowed_for(allowed):
    before = torch.get_float32_matmul_precision()
    with tf32_matmul(allowed):
        assert torch.get_float32_matmul_precision() == ("high" if allowed else before)
    assert torch.get_float32_matmul_precision() == before == "highest"
