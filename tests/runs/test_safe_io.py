"""Reading of untrusted files, and every reason for a refusal."""

import contextlib
import json
import os

import pytest

from rlcli.errors import CheckpointError
from rlcli.runs import safe_io
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.safe_io import check_json, parse_json, read_file, read_tail, require_plain_entries
from rlcli.safe_text import message_line


@pytest.fixture
def file(tmp_path):
    (tmp_path / "data.json").write_bytes(b'{"a": 1}')
    return tmp_path / "data.json"


def test_read_file_refuses_one_byte_above_the_limit(file):
    assert read_file(file, 8) == b'{"a": 1}'
    assert read_file(file, 100, size=8) == b'{"a": 1}'
    with pytest.raises(CheckpointError, match=r"data\.json is too large: 8 bytes; at most 7 are read"):
        read_file(file, 7)


@pytest.mark.parametrize("size", [7, 9])
def test_read_file_refuses_another_size(file, size):
    with pytest.raises(CheckpointError, match=rf"corrupt: its size is 8 bytes, but the manifest has {size}") as caught:
        read_file(file, 100, size=size)
    assert caught.value.hint == "choose an older checkpoint: RUN@step:N"


def test_read_file_raises_file_not_found_for_a_missing_file(tmp_path):
    (tmp_path / "file").touch()
    for missing in (tmp_path / "nothing", tmp_path / "file" / "below"):
        with pytest.raises(FileNotFoundError):
            read_file(missing, 10)


def test_read_file_refuses_links(file):
    for number, target in enumerate((file, file.parent / "nothing")):
        link = file.with_name(f"link{number}")
        link.symlink_to(target)
        with pytest.raises(CheckpointError, match="is a link; replace it by the file itself"):
            read_file(link, 100)


def test_read_file_refuses_a_link_that_appears_after_the_check(file, monkeypatch):
    link = file.with_name("link")
    link.symlink_to(file)
    monkeypatch.setattr(type(file), "is_symlink", lambda self: False)
    with pytest.raises(CheckpointError, match="link cannot be read: it is not a regular file"):
        read_file(link, 100)


@pytest.mark.parametrize("kind", ["folder", "pipe", "device"])
def test_read_file_refuses_special_files_without_blocking(tmp_path, kind):
    odd = tmp_path / kind
    if kind == "folder":
        odd.mkdir()
    elif kind == "pipe":
        os.mkfifo(odd)
    else:
        odd = type(odd)("/dev/zero")
    with pytest.raises(CheckpointError, match="is not a regular file") as caught:
        read_file(odd, 100)
    assert "delete" not in f"{caught.value.message} {caught.value.hint}", "the user named this file"


def test_read_file_closes_its_handle(file, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    before = len(os.listdir("/proc/self/fd"))
    for name, limit, size in (
        ("data.json", 100, None),
        ("data.json", 1, None),
        ("data.json", 100, 3),
        ("pipe", 9, None),
    ):
        with contextlib.suppress(CheckpointError):
            read_file(tmp_path / name, limit, size=size)
    assert len(os.listdir("/proc/self/fd")) == before


def test_read_file_refuses_an_invalid_name(tmp_path):
    for name, output in (("x" * 300, "File name too long"), ("a\0b", "embedded null byte")):
        with pytest.raises(CheckpointError) as caught:
            read_file(tmp_path / name, 10)
        # a long name is cut in the middle, and a control character is escaped
        assert caught.value.message == message_line(f"{tmp_path / name} cannot be read: {output}")
        assert caught.value.message.endswith(f" cannot be read: {output}")


def test_json_limit_is_4_mib(tmp_path):
    manifest = tmp_path / "manifest.json"
    manifest.write_bytes(b" " * (4 * 1024 * 1024 + 1))
    with pytest.raises(CheckpointError, match=r"is too large: 4,194,305 bytes; at most 4,194,304 are read"):
        open_checkpoint(tmp_path)
    manifest.write_bytes(b" " * 4 * 1024 * 1024)
    with pytest.raises(CheckpointError, match="not JSON"):
        open_checkpoint(tmp_path)


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), MemoryError()])
def test_read_error_names_the_file(file, monkeypatch, error):
    class Broken:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            os.close(self.handle)

        def read(self, count):
            raise error

    def opened(handle, mode):
        broken = Broken()
        broken.handle = handle
        return broken

    monkeypatch.setattr(safe_io.os, "fdopen", opened)
    output = "Input/output error" if isinstance(error, OSError) else "there is not enough memory"
    with pytest.raises(CheckpointError, match=rf"data\.json cannot be read: {output}"):
        read_file(file, 100)


def test_read_tail_returns_the_end_and_whether_it_is_all(file):
    assert read_tail(file, 100) == (b'{"a": 1}', True)
    assert read_tail(file, 8) == (b'{"a": 1}', True)
    assert read_tail(file, 7) == (b'"a": 1}', False)
    assert read_tail(file, 0) == (b"", False)
    link = file.with_name("link")
    link.symlink_to(file)
    with pytest.raises(CheckpointError, match="is a link"):
        read_tail(link, 100)
    with pytest.raises(FileNotFoundError):
        read_tail(file.with_name("nothing"), 100)


# --- JSON ---


def nested(depth):
    return b'{"a":' * depth + b"1" + b"}" * depth


@pytest.mark.parametrize(
    ("data", "value"),
    [
        (b"{}", {}),
        ('{"a": "é"}', {"a": "é"}),
        ('{"a": "é"}'.encode(), {"a": "é"}),
        (b'{"a": [1, 2.5, null, true, {"b": []}]}', {"a": [1, 2.5, None, True, {"b": []}]}),
        (b'{"a": -1234567890123456789}', {"a": -1234567890123456789}),
        (b'{"a": 12345678901234567890}', {"a": 12345678901234567890}),
        (b'{"a": 1e-300}', {"a": 1e-300}),
        (b'{"a": {"x": 1}, "b": {"x": 2}}', {"a": {"x": 1}, "b": {"x": 2}}),
    ],
)
def test_parse_json_reads_valid_json(file, data, value):
    assert parse_json(data, file) == value


def test_parse_json_accepts_at_most_32_levels(file):
    assert json.dumps(parse_json(nested(31), file)).count("{") == 31
    for deep in (nested(32), b'{"a":' + b"[" * 31 + b"1" + b"]" * 31 + b"}"):
        with pytest.raises(CheckpointError, match="is corrupt: values are nested deeper than 32 levels"):
            parse_json(deep, file)


@pytest.mark.parametrize(
    ("data", "output"),
    [
        (b'{"a": 1, "b": 2, "b": 3}', "key 'b' appears twice"),
        (b'{"c": {"xy": 1, "xy": 1}}', "key 'xy' appears twice"),
        (b'{"a": NaN}', "NaN is not a JSON number"),
        (b'{"a": -Infinity}', "-Infinity is not a JSON number"),
        (b'{"a": 1e999}', "the number 1e999 is too large"),
        (b'{"a": 123456789012345678901}', "a number has 21 digits"),
        (b"[1]", "not a JSON object"),
        (b"3", "not a JSON object"),
        (b"{", "not JSON"),
        (b"", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (b"[" * 200_000, "not JSON"),
    ],
)
def test_parse_json_refuses_with_the_reason(file, data, output):
    with pytest.raises(CheckpointError, match=r"data\.json is corrupt: ") as caught:
        parse_json(data, file)
    assert output in caught.value.message


def test_parse_json_error_shortens_keys_and_numbers(file):
    for data in (f'{{"{"k" * 500}": 1, "{"k" * 500}": 2}}', f'{{"a": 1.{"0" * 500}e999}}'):
        with pytest.raises(CheckpointError) as caught:
            parse_json(data, file)
        assert len(caught.value.message) < len(str(file)) + 100


def test_require_plain_entries_names_the_first_link(tmp_path):
    (tmp_path / "plain").touch()
    require_plain_entries(tmp_path)
    for name in ("b", "a", "c"):
        (tmp_path / name).symlink_to(tmp_path / "plain")
    with pytest.raises(CheckpointError, match=r"/a is a link; replace it by the file itself"):
        require_plain_entries(tmp_path)
    with pytest.raises(CheckpointError, match=r"nowhere cannot be read: No such file"):
        require_plain_entries(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("value", "place"),
    [
        ({"started": "\ud800"}, "started"),
        ({"task": {"name": "a\udfffb"}}, "task.name"),
        ({"loggers": ["none", "\ud800x"]}, "loggers.1"),
    ],
)
def test_check_json_names_the_place_of_half_a_character(tmp_path, value, place):
    from rlcli.runs.run import RunRecord

    with pytest.raises(CheckpointError, match=rf"run\.json is corrupt: {place}: the text has half of a surrogate pair"):
        check_json(RunRecord, value, tmp_path / "run.json")
