"""Atomic writes: a file is written completely or not at all, and disk errors have a hint."""

import errno
import json
import os

import pytest

from rlcli.errors import MachineError, UsageError
from rlcli.runs import atomic_io


def names(folder):
    return sorted(file.name for file in folder.iterdir())


@pytest.mark.parametrize(("content", "bytes_"), [("é\n", "é\n".encode()), (b"\x00\xff", b"\x00\xff"), ("", b"")])
def test_write_atomic_writes_text_and_bytes_unchanged(tmp_path, content, bytes_):
    (tmp_path / "file").write_text("a longer content that was there before")
    atomic_io.write_atomic(tmp_path / "file", content)
    assert (tmp_path / "file").read_bytes() == bytes_
    assert names(tmp_path) == ["file"]


def test_write_atomic_replaces_no_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match="pipe: it is a pipe"):
        atomic_io.write_atomic(tmp_path / "pipe", "content")
    assert (tmp_path / "pipe").is_fifo()
    assert names(tmp_path) == ["pipe"]


def test_write_atomic_syncs_before_the_rename(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append(("fsync", os.fstat(handle).st_size)), fsync(handle)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append(("replace", b.name)), replace(a, b)))
    atomic_io.write_atomic(tmp_path / "file", b"12345")
    assert done == [("fsync", 5), ("replace", "file")]


def test_write_atomic_does_not_follow_a_link_at_the_temporary_path(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / f".file.tmp-{os.getpid()}").symlink_to(precious)
    atomic_io.write_atomic(tmp_path / "file", "new")
    assert precious.read_text() == "mine"
    assert names(tmp_path) == ["file", "precious"]
    assert not (tmp_path / "file").is_symlink()


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_write_atomic_keeps_the_old_content_after_an_error(tmp_path, monkeypatch, call, error):
    (tmp_path / "file").write_text("old")

    def fail(*_):
        raise error

    monkeypatch.setattr(os, call, fail)
    kind = MachineError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(kind) as caught:
        atomic_io.write_atomic(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "old"
    assert names(tmp_path) == ["file"]
    if kind is MachineError:
        assert caught.value.message == f"cannot write {tmp_path / 'file'}: No space left on device"
        assert caught.value.__cause__ is error


def test_write_atomic_reports_an_error_of_the_temporary_path(tmp_path):
    (tmp_path / f".file.tmp-{os.getpid()}").mkdir()
    with pytest.raises(MachineError, match=r"cannot write .*file: "):
        atomic_io.write_atomic(tmp_path / "file", "new")
    assert not (tmp_path / "file").exists()


@pytest.mark.parametrize(
    ("code", "hint"),
    [
        (errno.ENOSPC, "free some space"),
        (errno.EACCES, "choose another path (for runs: --runs-dir FOLDER)"),
        (
            errno.EROFS,
            "the disk is read-only: make it writable, copy the run, or choose another path "
            "(for runs: --runs-dir FOLDER)",
        ),
        (errno.EDQUOT, "the disk quota is used up: free some space"),
        (errno.EIO, None),
    ],
)
def test_disk_error_has_a_hint_for_its_errno(tmp_path, code, hint):
    error = atomic_io.disk_error(tmp_path, OSError(code, os.strerror(code)))
    assert error.message == f"cannot write {tmp_path}: {os.strerror(code)}"
    assert error.hint == hint


def test_disk_error_names_the_first_missing_folder(tmp_path):
    error = atomic_io.disk_error(
        tmp_path / "run" / "checkpoints" / "x", FileNotFoundError(errno.ENOENT, "No such file")
    )
    assert error.message.endswith(f"x: No such file (there is no folder {tmp_path / 'run'})")
    assert error.hint == "create the folder; if the folder was moved or deleted meanwhile, put it back"


def test_disk_error_without_errno_keeps_its_message(tmp_path):
    error = atomic_io.disk_error(tmp_path, OSError("odd"))
    assert (error.message, error.hint) == (f"cannot write {tmp_path}: odd", None)


def test_sync_folder_syncs_entries_and_closes_its_handle(tmp_path, monkeypatch):
    synced = []
    fsync = os.fsync
    monkeypatch.setattr(
        os, "fsync", lambda handle: (synced.append(os.readlink(f"/proc/self/fd/{handle}")), fsync(handle))
    )
    before = len(os.listdir("/proc/self/fd"))
    atomic_io.sync_folder(tmp_path)
    assert synced == [str(tmp_path)]

    def fail(handle):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="Input/output"):
        atomic_io.sync_folder(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == before


def test_to_json_is_indented_and_refuses_nan():
    assert atomic_io.to_json({"a": [1]}) == '{\n  "a": [\n    1\n  ]\n}\n'
    assert json.loads(atomic_io.to_json({"a": 0.1})) == {"a": 0.1}
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="not JSON compliant"):
            atomic_io.to_json({"a": value})
