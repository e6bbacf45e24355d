"""Recurrent policies: exported with the hidden state as input and output."""

import runpy

import numpy as np
import onnxruntime
import pytest
import torch

from rlcli.deploy.export import FORMATS, export
from rlcli.errors import UsageError
from rlcli.rl.policy import Policy, PolicySpec
from rlcli.rl.trainer import TrainerState
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.training.checkpoint_writer import write_checkpoint

LAYOUT = {
    "observations": {"policy": [
        {"name": "seen", "size": 6, "elements": [], "unit": "", "scale": None, "clip": None, "history": 3,
         "modifiers": []}
    ]},
    "actions": [{"name": "push", "size": 2, "elements": ["a", "b"], "unit": "N", "scale": [3.0, 2.0],
                 "offset": [0.5, 0.0], "clip": None, "limits": [[-1.0, 2.0], [None, None]]}],
    "step_dt": 0.02, "dt": 0.01, "decimation": 2,
}  # fmt: skip


def saved(folder, memory, **changes):
    torch.manual_seed(3)
    policy = Policy(
        PolicySpec(
            kind="gaussian-lstm" if memory else "gaussian-mlp",
            observation_size=6,
            action_size=2,
            hidden=[8],
            activation="elu",
            action_bound=1.5,
            memory=memory,
            **changes,
        )
    )
    tensors = {"policy": policy.state_dict(), "trainer": {}}
    values = {"policy": policy.spec.model_dump(mode="json"), "iteration": 0, "env_steps": 0}
    folder.mkdir()
    write_checkpoint(
        folder, 0, TrainerState(tensors, values), {"layout": LAYOUT, "seed": 0, "agent": "x", "iteration": 0}
    )
    return open_checkpoint(next(path for path in folder.iterdir() if path.is_dir()))


def runner(file):
    """Return the function of a file, run by its own library: inputs by name -> outputs by name, numpy."""
    if file.suffix == ".py":
        return runpy.run_path(str(file))["run"]
    if file.suffix == ".onnx":
        session = onnxruntime.InferenceSession(str(file))
        return lambda x: dict(zip([o.name for o in session.get_outputs()], session.run(None, x), strict=True))
    program = torch.export.load(file).module()
    return lambda x: {k: v.numpy() for k, v in program(*(torch.from_numpy(v) for v in x.values())).items()}


@pytest.mark.parametrize(("memory", "normalize"), [([5], True), ([4, 4], False)])
@pytest.mark.parametrize("format_", FORMATS)
def test_hidden_state_is_input_and_output(tmp_path, format_, memory, normalize):
    checkpoint = saved(tmp_path / "run", memory, normalize=normalize)
    done = export(checkpoint, tmp_path / f"policy{FORMATS[format_]}", format_)
    shape = [len(memory), "batch", memory[0]]
    assert [(m["input"], m["output"], m["shape"]) for m in done.metadata["memory"]] == [
        ("h_in", "h_out", shape),
        ("c_in", "c_out", shape),
    ]
    run, policy = runner(done.file), checkpoint.policy()
    blank = np.zeros((len(memory), 3, memory[0]), np.float32)
    kept, own, first = {"h_in": blank, "c_in": blank}, None, None
    for step in range(20):
        obs = torch.randn(3, 6, generator=torch.Generator().manual_seed(step % 2))
        with torch.no_grad():
            expected, own = policy.step(obs, own)
        out = run({"obs": obs.numpy(), **kept})
        kept = {"h_in": out["h_out"], "c_in": out["c_out"]}
        np.testing.assert_allclose(out["action"], expected.numpy(), atol=1e-5, rtol=1e-5)
        command = (expected.numpy() * [3.0, 2.0] + [0.5, 0.0]).clip([-1.0, -np.inf], [2.0, np.inf])
        np.testing.assert_allclose(out["command"], command, atol=1e-5, rtol=1e-5)
        first = out["action"] if first is None else first
    assert np.abs(run({"obs": torch.randn(3, 6, generator=torch.Generator().manual_seed(0)).numpy(), **kept})["action"]
                  - first).max() > 1e-4  # it remembers  # fmt: skip


def test_numpy_episode_keeps_history_and_hidden_state(tmp_path):
    checkpoint = saved(tmp_path / "run", [5])
    space = runpy.run_path(str(export(checkpoint, tmp_path / "policy.py", "numpy").file))
    policy = checkpoint.policy()
    for _ in range(2):  # the second episode begins as the first did
        episode, own, past = space["Episode"](), None, None
        for step in range(6):
            now = np.float32([step, -step * 0.5])
            past = [now] * 3 if past is None else [*past[1:], now]
            with torch.no_grad():
                expected, own = policy.step(torch.from_numpy(np.concatenate(past))[None], own)
            action, _ = episode.step(now)
            np.testing.assert_allclose(action, expected[0].numpy(), atol=1e-6)


def test_unequal_recurrent_layers_are_rejected(tmp_path):
    checkpoint = saved(tmp_path / "run", [4, 5])
    with pytest.raises(UsageError, match="recurrent layers of different sizes"):
        export(checkpoint, tmp_path / "policy.py", "numpy")
    assert not (tmp_path / "policy.py").exists()


@pytest.mark.parametrize("name", ["'''", '"""', "\\", "\n", "}", "é中\U0001f600", "import os", "\u2028", "{0}"])
def test_numpy_file_contains_checkpoint_values_as_literals(tmp_path, name, monkeypatch):
    monkeypatch.setitem(LAYOUT["observations"]["policy"][0], "name", f"x{name}__import__('os')._exit(3)")
    file = export(saved(tmp_path / "run", []), tmp_path / "policy.py", "numpy").file
    assert runpy.run_path(str(file))["METADATA"]["observations"][0]["name"].startswith(f"x{name}")
    assert file.read_bytes().isascii()
