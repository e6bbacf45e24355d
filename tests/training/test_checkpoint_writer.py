"""Tests of the checkpoint writer: background writing, pruning, and rows of logs."""

import json
import threading

import pytest
import torch
from support.saved_states import state_of

from rlcli.errors import MachineError
from rlcli.rl.trainer import Rows
from rlcli.runs import checkpoint_reader
from rlcli.training import checkpoint_writer
from rlcli.training.checkpoint_writer import CheckpointWriter, KeepRule


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    return folder


def save_all(folder, keep, iterations, best=None):
    writer = CheckpointWriter(folder, keep, {})
    for iteration in iterations:
        writer.save(state_of(), iteration, 100 * iteration)
        writer.wait()
        if iteration == best:
            writer.best = 100 * iteration
    return writer


@pytest.mark.parametrize(
    ("keep", "best", "remaining"),
    [
        (KeepRule(), None, list(range(0, 13))),
        (KeepRule(last=2), None, [0, 11, 12]),
        (KeepRule(last=1), 4, [0, 4, 12]),
        (KeepRule(last=2, every=5), None, [0, 5, 10, 11, 12]),
        (KeepRule(last=20), None, list(range(0, 13))),
        (KeepRule.from_settings(None, None, None), None, [0, *range(3, 13)]),
        (KeepRule.from_settings(None, None, 1), None, list(range(0, 13))),
        (KeepRule.from_settings(3, None, 1), None, [0, 10, 11, 12]),
    ],
)
def test_first_best_and_newest_checkpoints_are_kept(folder, keep, best, remaining):
    save_all(folder, keep, range(13), best)
    assert checkpoint_reader.steps(folder) == [100 * iteration for iteration in remaining]
    assert sorted(file.name for file in folder.iterdir()) == [*(f"{100 * i:012d}" for i in remaining), "latest"]


def test_newest_is_set_by_save_and_by_resume(folder):
    writer = CheckpointWriter(folder, KeepRule(), {"seed": 1})
    assert writer.newest is None
    writer.save(state_of(), 3, 300)
    assert writer.newest == (3, 300)
    writer.wait()
    opened = checkpoint_reader.open_checkpoint(folder / f"{300:012d}")
    assert (opened.iteration, opened.step, opened.manifest["seed"]) == (3, 300, 1)
    assert CheckpointWriter(folder, KeepRule(), {}, resumed=opened).newest == (3, 300)


def test_save_does_not_block_while_a_checkpoint_is_written(folder, monkeypatch):
    go, started = threading.Event(), threading.Event()
    write = checkpoint_writer.write_checkpoint

    def slow(*arguments):
        started.set()
        assert go.wait(30)
        return write(*arguments)

    monkeypatch.setattr(checkpoint_writer, "write_checkpoint", slow)
    writer = CheckpointWriter(folder, KeepRule(), {})
    writer.save(state_of(), 1, 100)
    assert started.wait(30)
    assert checkpoint_reader.steps(folder) == []
    go.set()
    writer.save(state_of(), 2, 200)
    writer.wait()
    assert checkpoint_reader.steps(folder) == [100, 200]


def test_write_error_is_raised_once_by_check(folder):
    writer = CheckpointWriter(folder / "gone", KeepRule(), {})
    writer.save(state_of(), 1, 100)
    while writer._thread.is_alive():
        pass
    with pytest.raises(MachineError, match="No such file"):
        writer.check()
    writer.check()


# --- rows ---


def ring_rows(total, size, at_risk=0):
    """Return the rows of a ring buffer of `size` rows after `total` rows; row r contains r."""
    first = max(0, total - size)
    return Rows(first, total, lambda start, stop: {"x": torch.arange(start, stop).float()[:, None]})


def state_with(total, size=10):
    state = state_of()
    state.logs["replay"] = ring_rows(total, size)
    return state


def rows_of(folder, step):
    rows = checkpoint_reader.open_checkpoint(folder / f"{step:012d}").state().logs["replay"]
    return rows.first, rows.stop, rows.read(rows.first, rows.stop)["x"].flatten().tolist()


def test_rows_are_written_once_for_all_checkpoints(folder):
    writer = CheckpointWriter(folder, KeepRule(), {})
    for iteration, total in enumerate([0, 4, 4, 9, 14, 30]):
        writer.save(state_with(total), iteration, 100 * iteration)
    writer.wait()
    files = sorted(file.name for file in (folder / "logs/replay").iterdir())
    spans = [tuple(map(int, name.removesuffix(".safetensors").split("-"))) for name in files]
    assert spans == [(0, 4), (4, 9), (9, 14), (20, 30)]
    for iteration, total in [(1, 4), (2, 4), (3, 9), (4, 14), (5, 30)]:
        first = max(0, total - 10)
        assert rows_of(folder, 100 * iteration) == (first, total, [float(r) for r in range(first, total)])


def test_pruning_removes_unneeded_rows(folder):
    writer = CheckpointWriter(folder, KeepRule(last=1), {})
    for iteration in range(8):
        writer.save(state_with(5 * iteration), iteration, 100 * iteration)
    writer.wait()
    assert checkpoint_reader.steps(folder) == [0, 700]
    assert sorted(file.name[:12] for file in (folder / "logs/replay").iterdir()) == [f"{n:012d}" for n in (25, 30)]
    assert rows_of(folder, 700) == (25, 35, [float(r) for r in range(25, 35)])


def test_resume_from_older_checkpoint_rewrites_later_rows(folder):
    writer = CheckpointWriter(folder, KeepRule(), {})
    for iteration in range(1, 5):
        writer.save(state_with(6 * iteration), iteration, 100 * iteration)
    writer.wait()
    resumed = checkpoint_reader.open_checkpoint(folder / f"{200:012d}")
    assert checkpoint_writer.drop_after(folder, 200) == [300, 400]
    assert sorted(file.name[:12] for file in (folder / "logs/replay").iterdir()) == [f"{n:012d}" for n in (0, 6)]
    writer = CheckpointWriter(folder, KeepRule(), {}, resumed=resumed)
    writer.save(state_with(15), 3, 300)
    writer.wait()
    assert rows_of(folder, 300) == (5, 15, [float(r) for r in range(5, 15)])


def test_large_logs_are_split_into_files(folder, monkeypatch):
    monkeypatch.setattr(checkpoint_writer, "_SHARD_BYTES", 12)
    writer = CheckpointWriter(folder, KeepRule(), {})
    writer.save(state_with(8), 1, 100)
    writer.wait()
    assert [file.name[:12] for file in sorted((folder / "logs/replay").iterdir())] == [f"{n:012d}" for n in (0, 3, 6)]
    assert rows_of(folder, 100)[2] == [float(r) for r in range(8)]


@pytest.mark.parametrize("damage", ["missing", "short", "flipped", "gap"])
def test_damaged_rows_are_a_checkpoint_error(folder, damage):
    from rlcli.errors import CheckpointError

    writer = CheckpointWriter(folder, KeepRule(), {})
    for iteration in (1, 2):
        writer.save(state_with(5 * iteration), iteration, 100 * iteration)
    writer.wait()
    (file, _) = sorted((folder / "logs/replay").iterdir())
    data = bytearray(file.read_bytes())
    if damage == "missing":
        file.unlink()
    elif damage == "short":
        file.write_bytes(data[:-1])
    elif damage == "flipped":
        data[-1] ^= 1
        file.write_bytes(data)
    else:
        manifest = folder / f"{200:012d}/manifest.json"
        content = json.loads(manifest.read_text())
        del content["logs"]["replay"]["shards"][0]
        manifest.write_text(json.dumps(content))
    where = "manifest.json" if damage == "gap" else file.name
    with pytest.raises(CheckpointError, match=where):
        rows_of(folder, 200)


def test_rows_can_be_read_while_new_rows_are_stored():
    from gymnasium.spaces import Box

    from rlcli.rl.sb3.buffers import TorchReplayBuffer

    space = Box(-1, 1, (1,))
    for filled in (3, 6, 8, 11):
        buffer = TorchReplayBuffer(8 * 2, space, space, n_envs=2)

        def put(value, buffer=buffer):
            row = torch.full((2, 1), float(value))
            buffer.put(row, row, row, row[:, 0], row[:, 0])

        for value in range(filled):
            put(value)
        rows = buffer.rows(3)
        for value in range(filled, filled + 3):
            put(value)
        first = max(0, filled - 8)
        assert (rows.first, rows.stop) == (first, filled)
        assert rows.read(first, filled)["obs"][:, 0, 0].tolist() == [float(v) for v in range(first, filled)]
        fresh = TorchReplayBuffer(8 * 2, space, space, n_envs=2)
        fresh.load_rows(rows)
        assert (fresh.pos, fresh.full, fresh.added) == (filled % 8, filled >= 8, filled)


@pytest.mark.parametrize("content", [None, "000000000100\n", ""])
def test_drop_after_repairs_latest_file(folder, content):
    save_all(folder, KeepRule(), range(3))
    (folder / "latest").unlink() if content is None else (folder / "latest").write_text(content)
    assert checkpoint_writer.drop_after(folder, 200) == []
    assert (folder / "latest").read_text() == "000000000200\n"


@pytest.mark.parametrize("damage", ["format", "policy.safetensors", "rng.safetensors", "manifest.json"])
def test_drop_after_keeps_what_it_cannot_read(folder, damage):
    writer = CheckpointWriter(folder, KeepRule(), {})
    for iteration in range(1, 5):
        writer.save(state_with(6 * iteration), iteration, 100 * iteration)
    writer.wait()
    broken = folder / f"{300:012d}"
    if damage == "format":
        manifest = json.loads((broken / "manifest.json").read_text())
        (broken / "manifest.json").write_text(json.dumps({**manifest, "format": 99}))
    else:
        (broken / damage).rename(broken / "aside")
    names = sorted(file.name for file in broken.iterdir())
    rows = sorted(file.name for file in (folder / "logs/replay").iterdir())
    assert checkpoint_writer.drop_after(folder, 200) == [400]
    kept = folder / f"{300:012d}.unreadable"
    assert checkpoint_reader.steps(folder) == [100, 200]
    assert {*names} <= {file.name for file in kept.iterdir()}
    assert sorted(file.name for file in folder.glob("**/0*-*.safetensors")) == rows


def test_pruning_keeps_what_it_cannot_read(folder):
    save_all(folder, KeepRule(), range(4))
    (folder / f"{200:012d}/manifest.json").write_text("{")
    save_all(folder, KeepRule(last=1), [4])
    assert checkpoint_reader.steps(folder) == [0, 200, 400]
