"""Checkpoints: complete or absent, verified before use, never executed."""

import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import safetensors.torch
import torch
from support.saved_states import SPEC, rehash, state_of

from rlcli.errors import CheckpointError, MachineError
from rlcli.runs import checkpoint_reader
from rlcli.training import checkpoint_writer


@pytest.fixture
def saved(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    return checkpoint_writer.write_checkpoint(tmp_path / "checkpoints", 768, state_of(), {"seed": 1})


def load_all(folder):
    opened = checkpoint_reader.open_checkpoint(folder)
    return opened.policy(), opened.state()


def test_checkpoint_round_trip(saved):
    policy, state = load_all(saved)
    wanted = state_of()
    assert saved.name == "000000000768"
    assert (saved.parent / "latest").read_text() == "000000000768\n"
    assert not (saved.parent / "latest").is_symlink()
    for part in checkpoint_reader.PARTS:
        for name, value in wanted.tensors[part].items():
            assert torch.equal(value, state.tensors[part][name])
    assert torch.equal(policy.log_std, wanted.tensors["policy"]["log_std"])
    assert state.values == wanted.values


def test_policy_file_holds_only_tensors_and_is_deterministic(tmp_path):
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        files.append(checkpoint_writer.write_checkpoint(tmp_path / name, 5, state_of(), {"path": str(tmp_path / name)}))
        time.sleep(0.01)
    first, second = ((file / "policy.safetensors").read_bytes() for file in files)
    assert first == second
    header = json.loads(first[8 : 8 + int.from_bytes(first[:8], "little")])
    assert set(header) == set(state_of().tensors["policy"])  # no metadata: no time, no path


def test_write_checkpoint_keeps_an_existing_step(saved):
    before = {file.name: file.stat().st_mtime_ns for file in saved.iterdir()}
    assert checkpoint_writer.write_checkpoint(saved.parent, 768, state_of(1), {}) == saved
    assert {file.name: file.stat().st_mtime_ns for file in saved.iterdir()} == before


@pytest.mark.parametrize(
    "name", ["policy.safetensors", "trainer.safetensors", "env.safetensors", "rng.safetensors", "state.json"]
)
@pytest.mark.parametrize("damage", ["truncated", "flipped", "missing", "longer"])
def test_damaged_file_is_named_in_the_error(saved, name, damage):
    file = saved / name
    data = bytearray(file.read_bytes())
    if damage == "missing":
        file.unlink()
    else:
        data[len(data) // 2] ^= 1
        changed = {"truncated": bytes(data[:-7]), "flipped": bytes(data), "longer": bytes(data) + b"\0"}
        file.write_bytes(changed[damage])
    with pytest.raises(CheckpointError, match=name):
        load_all(saved)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"format": 1}',
        b'{"format": 1, "files": {}, "step": "x"}',
        b'{"format": 1, "files": {"policy.json": 3}, "step": 1}',
        b'{"format": 1, "files": [], "step": 1}',
        b'{"format": 2, "files": {}, "step": 1}',
        b'{"format": 1, "files": {}, "step": 1}',
        b'{"format": 1, "files": {"policy.json": {"size": 0, "sha256": "0"}}, "step": 1}',
    ],
)
def test_damaged_manifest_raises_checkpoint_error(saved, content):
    (saved / "manifest.json").write_bytes(content)
    with pytest.raises(CheckpointError, match="000000000768"):
        load_all(saved)


def test_other_format_error_has_both_versions(saved):
    manifest = json.loads((saved / "manifest.json").read_text())
    (saved / "manifest.json").write_text(json.dumps({**manifest, "format": 7}))
    with pytest.raises(CheckpointError, match="format 7; this rlcli reads 1"):
        load_all(saved)


class Bomb:
    def __reduce__(self):
        return (os.system, ("touch executed",))


@pytest.mark.parametrize("part", checkpoint_reader.PARTS)
@pytest.mark.parametrize("kind", ["pickle", "torch"])
def test_pickle_with_a_matching_hash_is_not_executed(saved, part, kind, monkeypatch):
    monkeypatch.chdir(saved.parent)
    file = saved / f"{part}.safetensors"
    if kind == "pickle":
        file.write_bytes(pickle.dumps(Bomb()))
    else:
        torch.save({"log_std": Bomb()}, file)
    rehash(saved, file.name)
    with pytest.raises(CheckpointError, match=part):
        load_all(saved)
    assert not (saved.parent / "executed").exists()


def change_policy(folder, change):
    file = folder / "policy.safetensors"
    tensors = safetensors.torch.load(file.read_bytes())
    change(tensors)
    file.write_bytes(safetensors.torch.save(tensors))
    rehash(folder, file.name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["log_std"].fill_(float("nan")), "log_std.*not finite"),
        (lambda t: t["actor.0.weight"].view(-1)[0].fill_(float("inf")), "actor.0.weight.*not finite"),
        (lambda t: t.update(log_std=torch.zeros(3)), r"log_std is float32 \(3,\), expected float32 \(2,\)"),
        (lambda t: t.pop("log_std"), "log_std is missing"),
        (lambda t: t.update(extra=torch.zeros(1)), "extra is .*expected nothing"),
        (lambda t: t.update(log_std=torch.zeros(2, dtype=torch.int64)), "log_std.*int64"),
    ],
)
def test_weights_that_do_not_fit_are_named(saved, change, message):
    change_policy(saved, change)
    with pytest.raises(CheckpointError, match=message):
        checkpoint_reader.open_checkpoint(saved).policy()


def test_critic_that_is_not_finite_is_named(saved):
    (saved / "trainer.safetensors").write_bytes(safetensors.torch.save({"critic.w": torch.tensor([1.0, float("nan")])}))
    rehash(saved, "trainer.safetensors")
    with pytest.raises(CheckpointError, match=r"critic\.w"):
        load_all(saved)


@pytest.mark.parametrize(
    "change",
    [
        {"hidden": [-1]},
        {"hidden": [10**12]},  # must not be allocated
        {"observation_size": 0},
        {"activation": "os.system"},
        {"kind": "pickle"},
        {"surprise": 1},
    ],
)
def test_invalid_policy_description_is_refused(saved, change):
    (saved / "policy.json").write_text(json.dumps({**SPEC, **change}))
    rehash(saved, "policy.json")
    with pytest.raises(CheckpointError, match=r"policy\.(json|safetensors)"):
        checkpoint_reader.open_checkpoint(saved).policy()


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EDQUOT])
@pytest.mark.parametrize("call", ["fsync", "rename", "open"])
def test_disk_error_keeps_the_old_checkpoint_and_no_partial_one(saved, monkeypatch, call, code):
    def refuse(*args, **kwargs):
        raise OSError(code, os.strerror(code))

    if call == "open":
        real = Path.open
        monkeypatch.setattr(Path, "open", lambda self, *a, **k: refuse() if "env" in self.name else real(self, *a, **k))
    else:
        monkeypatch.setattr(os, call, refuse)
    with pytest.raises(MachineError, match=os.strerror(code)) as caught:
        checkpoint_writer.write_checkpoint(saved.parent, 900, state_of(1), {})
    assert "000000000900" in str(caught.value)
    assert caught.value.hint
    monkeypatch.undo()
    assert sorted(p.name for p in saved.parent.iterdir()) == [saved.name, "latest"]
    load_all(saved)


def test_interrupted_save_leaves_no_files(saved, monkeypatch):
    def interrupt(handle):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        checkpoint_writer.write_checkpoint(saved.parent, 900, state_of(1), {})
    assert checkpoint_reader.steps(saved.parent) == [768]
    assert not list(saved.parent.glob(".tmp-*"))


def test_write_checkpoint_does_not_recreate_a_deleted_folder(tmp_path):
    with pytest.raises(MachineError, match="No such file"):
        checkpoint_writer.write_checkpoint(tmp_path / "gone" / "checkpoints", 5, state_of(), {})
    assert not (tmp_path / "gone").exists()


LOOP = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from support.saved_states import state_of
from rlcli.runs import checkpoint_reader
from rlcli.training import checkpoint_writer
folder = Path(sys.argv[1])
step = max(checkpoint_reader.steps(folder), default=0)
print("go", flush=True)
while True:
    step += 1
    checkpoint_writer.write_checkpoint(folder, step, state_of(step % 3), {})
"""


@pytest.mark.slow
def test_kill_while_saving_leaves_a_valid_last_checkpoint(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for attempt in range(4):
        child = subprocess.Popen(
            [sys.executable, "-c", LOOP, str(folder), str(Path(__file__).parents[1])], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout.readline() == "go\n"
        time.sleep(0.05 + 0.037 * attempt)
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
        steps = checkpoint_reader.steps(folder)
        if steps:
            load_all(folder / f"{steps[-1]:012d}")
            assert (folder / "latest").read_text().strip() in {f"{s:012d}" for s in steps[-2:]}
    assert checkpoint_reader.steps(folder)
    (folder / ".tmp-1-dead").mkdir(exist_ok=True)
    (folder / ".latest.tmp-1").touch()
    checkpoint_writer.remove_temporary_files(folder)
    assert not [p for p in folder.iterdir() if p.name.startswith(".")]


LIMITED = """
import resource, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from support.saved_states import state_of
from rlcli.errors import MachineError
from rlcli.runs import checkpoint_reader
from rlcli.training import checkpoint_writer
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
try:
    checkpoint_writer.write_checkpoint(Path(sys.argv[1]), 5, state_of(), {})
except MachineError as error:
    print(error)
"""


def test_file_size_limit_raises_machine_error_and_leaves_no_files(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    # -B: under the limit Python would leave modules half-compiled for everybody
    command = [sys.executable, "-B", "-c", LIMITED, str(folder), str(Path(__file__).parents[1])]
    output = subprocess.run(command, capture_output=True, text=True)
    assert "File too large" in output.stdout, output.stderr
    assert list(folder.iterdir()) == []


def test_steps_are_sorted_and_other_folders_ignored(tmp_path):
    for name in ("000000000002", "000000000010", "1000000000000", "5", "²", "notes", ".tmp-1-x"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "manifest.json").touch()
    (tmp_path / "000000000099").mkdir()  # no manifest: damaged
    (tmp_path / "latest").touch()
    assert checkpoint_reader.steps(tmp_path) == [2, 10, 99, 1000000000000]
    assert checkpoint_reader.steps(tmp_path / "nowhere") == []
