"""`rlcli export` on the command line: its files, its output and its errors."""

import ast
import hashlib
import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch

from rlcli.cli.app import main
from rlcli.deploy.run_policy_files import generate_program

WITHOUT = """
import importlib.abc, sys
class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked!r}:
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)
sys.meta_path.insert(0, Blocker())
"""
MODULES = {"mujoco", "gymnasium", "stable_baselines3", "rlcli_tasks"}


def python(code, *arguments, cwd, blocked=frozenset(), env=None):
    return subprocess.run(
        [sys.executable, "-B", "-c", WITHOUT.format(blocked=set(blocked)) + code, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, **(env or {})},
    )


COMMAND = "from rlcli.cli.app import main\nsys.exit(main(sys.argv[1:]))"


@pytest.fixture
def copied(newest, tmp_path):
    """Copy of a checkpoint folder of the PPO cartpole that a test may damage."""
    return Path(shutil.copytree(newest("cartpole"), tmp_path / "checkpoint"))


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_export_writes_into_run_and_prints_path(runs, newest, capfd):
    assert main(["export", "--checkpoint", str(newest("cartpole").parent.parent)]) == 0
    out, err = capfd.readouterr()
    file = newest("cartpole").parent.parent / "exports" / "policy.onnx"
    assert out == f"{file}\n"
    assert files(file.parent) == ["policy.onnx"]
    assert "its newest checkpoint" in err
    assert "equals the policy on" in err


def test_export_of_task_uses_newest_run(runs, newest, capfd, tmp_path):
    file = tmp_path / "a" / "b" / "arm.pt2"
    arguments = ["--runs-dir", str(runs), "--format", "torch", "--output", str(file), "--json", "-q"]
    assert main(["export", "arm", *arguments]) == 0
    out, err = capfd.readouterr()
    document = json.loads(out)
    assert err == ""
    assert document["command"] == "export"
    assert document["format"] == "torch"
    assert document["file"] == str(file)
    assert document["bytes"] == file.stat().st_size
    assert document["checkpoint"] == str(newest("arm"))
    assert document["max_difference"] <= 1e-5
    assert document["observations"] == 832  # recorded and 256 random ones, and both x 1,000
    assert document["metadata"]["task"]["name"] == "arm"
    assert files(tmp_path) == ["a", "a/b", "a/b/arm.pt2"]


@pytest.mark.slow
@pytest.mark.parametrize("format_", ["onnx", "torch"])
@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_export_imports_neither_simulator_nor_task(runs, newest, tmp_path, task, format_):
    output = tmp_path / ("policy.onnx" if format_ == "onnx" else "policy.pt2")
    arguments = ("export", task, "--runs-dir", runs, "--format", format_, "--output", output)
    result = python(COMMAND, *arguments, cwd=tmp_path, blocked=MODULES)
    assert (result.returncode, result.stdout) == (0, f"{output}\n"), result.stderr
    printed = [line for line in result.stderr.splitlines() if not line.startswith("rlcli export: ")]  # no progress
    assert len(printed) == 2, result.stderr  # the exporter itself says nothing


def test_export_of_bare_checkpoint_without_simulator(copied, tmp_path):
    output = tmp_path / "policy.onnx"
    arguments = ("export", "--checkpoint", copied, "--output", output)
    result = python(COMMAND, *arguments, cwd=tmp_path, blocked=MODULES)
    assert (result.returncode, result.stdout) == (0, f"{output}\n"), result.stderr


def test_checkpoint_outside_run_needs_output(copied, capsys):
    assert main(["export", "--checkpoint", str(copied)]) == 2
    assert "--output FILE" in capsys.readouterr().err


RUN = """
import numpy, torch
obs = torch.from_numpy(numpy.load(sys.argv[2]))
if sys.argv[1].endswith(".onnx"):
    import onnxruntime
    action, command = onnxruntime.InferenceSession(sys.argv[1]).run(["action", "command"], {"obs": obs.numpy()})
else:
    out = torch.export.load(sys.argv[1]).module()(obs)
    action, command = out["action"].numpy(), out["command"].numpy()
numpy.save("action.npy", action)
numpy.save("command.npy", command)
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
def test_exported_file_runs_without_rlcli(newest, tmp_path, suffix):
    import numpy as np

    from rlcli.deploy.export import export
    from rlcli.runs.checkpoint_reader import open_checkpoint

    checkpoint, file = open_checkpoint(newest("cartpole sac")), tmp_path / f"policy{suffix}"
    export(checkpoint, file, {".onnx": "onnx", ".pt2": "torch"}[suffix])
    obs = torch.randn(13, 4)
    np.save(tmp_path / "obs.npy", obs.numpy())
    result = python(RUN, file, tmp_path / "obs.npy", cwd=tmp_path, blocked={"rlcli", *MODULES})
    assert result.returncode == 0, result.stderr
    action = torch.from_numpy(np.load(tmp_path / "action.npy"))
    torch.testing.assert_close(action, checkpoint.policy()(obs), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(torch.from_numpy(np.load(tmp_path / "command.npy")), 100.0 * action)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--format", "keras"], "formats: onnx, torch, numpy"),
        (["--format", "onxx"], "did you mean 'onnx'?"),
        (["--output", "policy.pt2"], "--format torch"),
        (["--format", "torch", "--output", "policy.onnx"], "--format onnx"),
        (["--output", "policy"], "policy.onnx"),
        (["--output", "."], "does not end in .onnx"),
    ],
)
def test_unknown_format_or_wrong_suffix_is_usage_error(copied, tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "--checkpoint", str(copied), *arguments]) == 2
    out, err = capsys.readouterr()
    assert says in err
    assert out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ([], 2, "rlcli export TASK, or --checkpoint"),
        (["--checkpoint", "latest"], 5, "there is no run in"),
        (["--checkpoint", "nothing"], 5, "no run 'nothing'"),
        (["cartpole", "--checkpoint", "latest"], 5, "rlcli train cartpole"),
        (["cartpol"], 4, "did you mean 'cartpole'"),
    ],
)
def test_missing_checkpoint_is_reported(tmp_path, capsys, arguments, code, says):
    assert main(["export", *arguments, "--runs-dir", str(tmp_path)]) == code
    assert says in capsys.readouterr().err


def test_verify_with_the_task_of_a_folder_names_the_run(newest, tmp_path, capsys):
    trained = newest("cartpole").parent.parent
    run = tmp_path / "my_yam" / trained.name
    shutil.copytree(trained, run)
    record = json.loads((run / "run.json").read_text())
    record["task"]["name"] = "my_yam"
    (run / "run.json").write_text(json.dumps(record))
    assert main(["export", "my_yam", "--verify", "--runs-dir", str(tmp_path)]) == 4
    err = capsys.readouterr().err
    assert "no task 'my_yam'" in err
    assert f"rlcli export --checkpoint {run} --verify" in err


@pytest.mark.parametrize("missing", ["onnx", "onnxscript", "onnxruntime"])
def test_missing_extra_names_pip_command(copied, tmp_path, monkeypatch, capsys, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    output = tmp_path / "out" / "policy.onnx"
    assert main(["export", "--checkpoint", str(copied), "--output", str(output)]) == 7
    err = capsys.readouterr().err
    assert '"rlcli[export]"' in err
    assert missing in err
    assert not output.parent.exists()


def test_torch_format_needs_no_extra(copied, tmp_path, monkeypatch):
    for missing in ("onnx", "onnxscript", "onnxruntime"):
        monkeypatch.setitem(sys.modules, missing, None)
    output = tmp_path / "policy.pt2"
    assert main(["export", "--checkpoint", str(copied), "--format", "torch", "--output", str(output)]) == 0
    assert output.is_file()


def damage(folder, how):
    """Damage a checkpoint; for some kinds of damage the manifest is changed to agree with it."""
    manifest = json.loads((folder / "manifest.json").read_text())
    policy = folder / "policy.safetensors"
    if how == "truncated weights":
        policy.write_bytes(policy.read_bytes()[:-7])
    elif how == "flipped bit in the weights":
        data = bytearray(policy.read_bytes())
        data[-3] ^= 1
        policy.write_bytes(bytes(data))
    elif how == "weights that are not finite":
        tensors = safetensors.torch.load_file(policy)
        tensors["actor.0.weight"][0, 0] = torch.nan
        data = safetensors.torch.save(tensors)
        policy.write_bytes(data)
        manifest["files"][policy.name] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    elif how == "no weights":
        policy.unlink()
    elif how == "flipped bit in the record":
        file = folder / "trainer.safetensors"
        data = bytearray(file.read_bytes())
        data[-1] ^= 1
        file.write_bytes(bytes(data))
    elif how == "no layout":
        del manifest["layout"]
    elif how == "layout of an older version":
        del manifest["layout"]["actions"][0]["scale"]
    elif how == "layout of another width":
        manifest["layout"]["observations"]["policy"].pop()
    elif how == "scale of another width":
        manifest["layout"]["actions"][0]["scale"] = [1.0, 2.0]
    elif how == "scale that is not finite":
        manifest["layout"]["actions"][0]["scale"] = [float("nan")]
    elif how == "layout that is text":
        manifest["layout"] = "lost"
    (folder / "manifest.json").write_text("{" if how == "broken manifest" else json.dumps(manifest))


@pytest.mark.parametrize(
    "how",
    [
        "truncated weights",
        "flipped bit in the weights",
        "weights that are not finite",
        "no weights",
        "flipped bit in the record",
        "no layout",
        "layout of an older version",
        "layout of another width",
        "scale of another width",
        "scale that is not finite",
        "layout that is text",
        "broken manifest",
    ],
)
def test_damaged_checkpoint_is_rejected_without_output(copied, tmp_path, capsys, how):
    damage(copied, how)
    output = tmp_path / "out" / "policy.onnx"
    assert main(["export", "--checkpoint", str(copied), "--output", str(output)]) == 5
    err = capsys.readouterr().err
    assert str(copied) in err or "policy.safetensors" in err
    assert "Traceback" not in err
    assert not output.parent.exists()


@pytest.mark.parametrize("place", ["below a file", "/proc", "/proc/deep/er"])
def test_unwritable_folder_is_machine_error(copied, tmp_path, capsys, place):
    folder = Path(place)
    if place == "below a file":
        folder = tmp_path / "file" / "deep"
        folder.parent.write_text("")
    elif not Path("/proc").is_dir():
        pytest.skip("no /proc on this system, the one folder that not even root can write to")
    before = files(tmp_path)
    assert main(["export", "--checkpoint", str(copied), "--output", str(folder / "policy.onnx")]) == 10
    err = capsys.readouterr().err
    assert "cannot write" in err
    assert "--output" in err
    assert files(tmp_path) == before


FULL = """
import resource
from rlcli.cli.app import main
import onnx, onnxruntime, onnxscript  # their caches are written before the disk is full
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(os.name != "posix", reason="limits on file sizes are POSIX")
@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
def test_full_disk_keeps_old_file(copied, tmp_path, suffix):
    old = tmp_path / f"policy{suffix}"
    old.write_text("the last export")
    before = files(tmp_path)
    format_ = {".onnx": "onnx", ".pt2": "torch"}[suffix]
    uncounted = {"COVERAGE_PROCESS_CONFIG": ""}  # what counts lines would write its own file, and complain
    arguments = ("export", "--checkpoint", copied, "--format", format_, "--output", old)
    result = python(FULL, *arguments, cwd=tmp_path, env=uncounted)
    assert result.returncode == 10, result.stderr
    assert "cannot write" in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    assert files(tmp_path) == before
    assert old.read_text() == "the last export"


def test_names_of_untrusted_files_stay_literals_in_exported_code(copied, tmp_path, capsys):
    run = tmp_path / "NETWORK: dict = {}"
    shutil.copytree(copied, run)
    file = tmp_path / "policy.py"
    assert main(["export", "--checkpoint", str(run), "--format", "numpy", "--output", str(file)]) == 0, (
        capsys.readouterr()
    )
    assert runpy.run_path(str(file))["NETWORK"]["kind"]


def test_names_of_files_stay_literals_in_generated_program(tmp_path):
    program = generate_program(
        Path('a "model.xml" from_xml_path.onnx'), Path("model.xml"), "onnx", {"deployment": None}
    )
    names = [node.value for node in ast.walk(ast.parse(program)) if isinstance(node, ast.Constant)]
    assert 'a "model.xml" from_xml_path.onnx' in names
    assert "model.xml" in names
