"""Checkpoints are written beside the training, as many as are wanted, and rows of logs once."""

import json
import threading

import pytest
import torch
from support.saved_states import state_of

from rlcli.errors import MachineError
from rlcli.rl.trainer import Rows
from rlcli.runs import checkpoint
from rlcli.training import checkpoint_writer
from rlcli.training.checkpoint_writer import CheckpointWriter, Keep


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    return folder


def save_all(folder, keep, iterations, best=None):
    saver = CheckpointWriter(folder, keep, {})
    for iteration in iterations:
        saver.save(state_of(), iteration, 100 * iteration)
        saver.wait()
        if iteration == best:
            saver.best = 100 * iteration
    return saver


@pytest.mark.parametrize(
    ("keep", "best", "left"),
    [
        (Keep(), None, list(range(0, 13))),
        (Keep(last=2), None, [0, 11, 12]),
        (Keep(last=1), 4, [0, 4, 12]),
        (Keep(last=2, every=5), None, [0, 5, 10, 11, 12]),
        (Keep(last=20), None, list(range(0, 13))),
        (Keep.from_settings(None, None, None), None, [0, *range(3, 13)]),
        (Keep.from_settings(None, None, 1), None, list(range(0, 13))),
        (Keep.from_settings(3, None, 1), None, [0, 10, 11, 12]),
    ],
)
def test_the_first_the_best_and_the_newest_stay(folder, keep, best, left):
    save_all(folder, keep, range(13), best)
    assert checkpoint.steps(folder) == [100 * iteration for iteration in left]
    assert sorted(file.name for file in folder.iterdir()) == [*(f"{100 * i:012d}" for i in left), "latest"]


def test_only_the_newest_boundary_is_said_to_be_saved_and_when_it_is(folder):
    saver = CheckpointWriter(folder, Keep(), {"seed": 1})
    assert saver.newest is None
    saver.save(state_of(), 3, 300)
    assert saver.newest == (3, 300)
    saver.wait()
    opened = checkpoint.open_checkpoint(folder / f"{300:012d}")
    assert (opened.iteration, opened.step, opened.manifest["seed"]) == (3, 300, 1)
    assert CheckpointWriter(folder, Keep(), {}, resumed=opened).newest == (3, 300)


def test_training_goes_on_while_a_checkpoint_is_written(folder, monkeypatch):
    go, begun = threading.Event(), threading.Event()
    write = checkpoint_writer.write_checkpoint

    def slow(*arguments):
        begun.set()
        assert go.wait(30)
        return write(*arguments)

    monkeypatch.setattr(checkpoint_writer, "write_checkpoint", slow)
    saver = CheckpointWriter(folder, Keep(), {})
    saver.save(state_of(), 1, 100)
    assert begun.wait(30)
    assert checkpoint.steps(folder) == []
    go.set()
    saver.save(state_of(), 2, 200)
    saver.wait()
    assert checkpoint.steps(folder) == [100, 200]


def test_what_the_disk_refused_is_said_once_at_the_next_chance(folder):
    saver = CheckpointWriter(folder / "gone", Keep(), {})
    saver.save(state_of(), 1, 100)
    while saver._thread.is_alive():
        pass
    with pytest.raises(MachineError, match="No such file"):
        saver.check()
    saver.check()


# --- rows ---


def ring(total, size, at_risk=0):
    """A ring buffer of `size` rows, into which row r wrote r, at a boundary after `total` rows."""
    first = max(0, total - size)
    return Rows(first, total, lambda start, stop: {"x": torch.arange(start, stop).float()[:, None]})


def state_with(total, size=10):
    state = state_of()
    state.logs["replay"] = ring(total, size)
    return state


def rows_of(folder, step):
    rows = checkpoint.open_checkpoint(folder / f"{step:012d}").state().logs["replay"]
    return rows.first, rows.stop, rows.read(rows.first, rows.stop)["x"].flatten().tolist()


def test_rows_are_written_once_and_each_checkpoint_has_its_own(folder):
    saver = CheckpointWriter(folder, Keep(), {})
    for iteration, total in enumerate([0, 4, 4, 9, 14, 30]):
        saver.save(state_with(total), iteration, 100 * iteration)
    saver.wait()
    files = sorted(file.name for file in (folder / "logs/replay").iterdir())
    spans = [tuple(map(int, name.removesuffix(".safetensors").split("-"))) for name in files]
    assert spans == [(0, 4), (4, 9), (9, 14), (20, 30)]
    for iteration, total in [(1, 4), (2, 4), (3, 9), (4, 14), (5, 30)]:
        first = max(0, total - 10)
        assert rows_of(folder, 100 * iteration) == (first, total, [float(r) for r in range(first, total)])


def test_rows_that_no_checkpoint_needs_go_with_the_checkpoints(folder):
    saver = CheckpointWriter(folder, Keep(last=1), {})
    for iteration in range(8):
        saver.save(state_with(5 * iteration), iteration, 100 * iteration)
    saver.wait()
    assert checkpoint.steps(folder) == [0, 700]
    assert sorted(file.name[:12] for file in (folder / "logs/replay").iterdir()) == [f"{n:012d}" for n in (25, 30)]
    assert rows_of(folder, 700) == (25, 35, [float(r) for r in range(25, 35)])


def test_going_on_from_an_older_checkpoint_drops_the_rows_after_it_and_writes_them_anew(folder):
    saver = CheckpointWriter(folder, Keep(), {})
    for iteration in range(1, 5):
        saver.save(state_with(6 * iteration), iteration, 100 * iteration)
    saver.wait()
    resumed = checkpoint.open_checkpoint(folder / f"{200:012d}")
    assert checkpoint_writer.drop_after(folder, 200) == [300, 400]
    assert sorted(file.name[:12] for file in (folder / "logs/replay").iterdir()) == [f"{n:012d}" for n in (0, 6)]
    saver = CheckpointWriter(folder, Keep(), {}, resumed=resumed)
    saver.save(state_with(15), 3, 300)
    saver.wait()
    assert rows_of(folder, 300) == (5, 15, [float(r) for r in range(5, 15)])


def test_large_logs_are_cut_into_files(folder, monkeypatch):
    monkeypatch.setattr(checkpoint_writer, "_SHARD_BYTES", 12)
    saver = CheckpointWriter(folder, Keep(), {})
    saver.save(state_with(8), 1, 100)
    saver.wait()
    assert [file.name[:12] for file in sorted((folder / "logs/replay").iterdir())] == [f"{n:012d}" for n in (0, 3, 6)]
    assert rows_of(folder, 100)[2] == [float(r) for r in range(8)]


@pytest.mark.parametrize("damage", ["missing", "short", "flipped", "gap"])
def test_damaged_rows_are_named(folder, damage):
    from rlcli.errors import CheckpointError

    saver = CheckpointWriter(folder, Keep(), {})
    for iteration in (1, 2):
        saver.save(state_with(5 * iteration), iteration, 100 * iteration)
    saver.wait()
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


def test_a_boundary_reads_its_rows_while_the_next_ones_are_stored():
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


@pytest.mark.parametrize("said", [None, "000000000100\n", ""])
def test_the_newest_checkpoint_is_said_to_be_it_also_after_a_kill_before_that(folder, said):
    save_all(folder, Keep(), range(3))
    (folder / "latest").unlink() if said is None else (folder / "latest").write_text(said)
    assert checkpoint_writer.drop_after(folder, 200) == []
    assert (folder / "latest").read_text() == "000000000200\n"
