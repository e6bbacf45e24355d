"""Files are written whole or not at all, and what the disk said is passed on with what to do."""

import errno
import json
import os

import pytest

from rlcli.errors import MachineError
from rlcli.runs import atomic_io


def names(folder):
    return sorted(file.name for file in folder.iterdir())


@pytest.mark.parametrize(("content", "bytes_"), [("é\n", "é\n".encode()), (b"\x00\xff", b"\x00\xff"), ("", b"")])
def test_text_and_bytes_are_written_as_they_are_and_nothing_else_is_left(tmp_path, content, bytes_):
    (tmp_path / "file").write_text("a longer content that was there before")
    atomic_io.write_atomic(tmp_path / "file", content)
    assert (tmp_path / "file").read_bytes() == bytes_
    assert names(tmp_path) == ["file"]


def test_what_is_written_is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append(("fsync", os.fstat(handle).st_size)), fsync(handle)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append(("replace", b.name)), replace(a, b)))
    atomic_io.write_atomic(tmp_path / "file", b"12345")
    assert done == [("fsync", 5), ("replace", "file")]


def test_a_link_in_the_temporary_files_place_is_not_followed(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / f".file.tmp-{os.getpid()}").symlink_to(precious)
    atomic_io.write_atomic(tmp_path / "file", "new")
    assert precious.read_text() == "mine"
    assert names(tmp_path) == ["file", "precious"]
    assert not (tmp_path / "file").is_symlink()


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_when_it_fails_the_old_content_stays_and_nothing_is_left(tmp_path, monkeypatch, call, error):
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


def test_what_cannot_even_be_cleaned_away_is_the_disks_error_too(tmp_path):
    (tmp_path / f".file.tmp-{os.getpid()}").mkdir()
    with pytest.raises(MachineError, match=r"cannot write .*file: "):
        atomic_io.write_atomic(tmp_path / "file", "new")
    assert not (tmp_path / "file").exists()


@pytest.mark.parametrize(
    ("code", "hint"),
    [
        (errno.ENOSPC, "free some space, then continue with --resume"),
        (errno.EACCES, "choose another folder with --runs-dir"),
        (errno.EROFS, "choose another folder with --runs-dir"),
        (errno.EDQUOT, "the disk quota is used up"),
        (errno.EIO, None),
    ],
)
def test_the_hint_fits_what_the_disk_said(tmp_path, code, hint):
    error = atomic_io.disk_error(tmp_path, OSError(code, os.strerror(code)))
    assert error.message == f"cannot write {tmp_path}: {os.strerror(code)}"
    assert error.hint == hint


def test_an_error_without_a_number_is_passed_on_as_it_is(tmp_path):
    error = atomic_io.disk_error(tmp_path, OSError("odd"))
    assert (error.message, error.hint) == (f"cannot write {tmp_path}: odd", None)


def test_a_folders_entries_are_synced_and_no_handle_is_left(tmp_path, monkeypatch):
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


def test_json_is_readable_ends_with_a_newline_and_holds_no_nan():
    assert atomic_io.to_json({"a": [1]}) == '{\n  "a": [\n    1\n  ]\n}\n'
    assert json.loads(atomic_io.to_json({"a": 0.1})) == {"a": 0.1}
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="not JSON compliant"):
            atomic_io.to_json({"a": value})
