"""Files of strangers: what is read, and every reason for which it is not."""

import contextlib
import json
import os

import pytest

from rlcli.errors import CheckpointError
from rlcli.runs import safe_io
from rlcli.runs.checkpoint import open_checkpoint
from rlcli.runs.safe_io import parse_json, read_file, read_tail, refuse_links


@pytest.fixture
def file(tmp_path):
    (tmp_path / "data.json").write_bytes(b'{"a": 1}')
    return tmp_path / "data.json"


def test_a_file_is_read_up_to_its_limit_and_not_one_byte_further(file):
    assert read_file(file, 8) == b'{"a": 1}'
    assert read_file(file, 100, size=8) == b'{"a": 1}'
    with pytest.raises(CheckpointError, match=r"data\.json is too large: 8 bytes, at most 7 are read"):
        read_file(file, 7)


@pytest.mark.parametrize("size", [7, 9])
def test_a_file_of_another_size_is_corrupt(file, size):
    with pytest.raises(CheckpointError, match=rf"is corrupt: .* \(8 of {size} bytes\)") as caught:
        read_file(file, 100, size=size)
    assert caught.value.hint == "choose an older checkpoint with RUN@step:N"


def test_what_is_not_there_is_the_callers_to_name(tmp_path):
    (tmp_path / "file").touch()
    for missing in (tmp_path / "nothing", tmp_path / "file" / "below"):
        with pytest.raises(FileNotFoundError):
            read_file(missing, 10)


def test_a_link_is_refused_also_to_a_file_that_is_good_or_missing(file):
    for number, target in enumerate((file, file.parent / "nothing")):
        link = file.with_name(f"link{number}")
        link.symlink_to(target)
        with pytest.raises(CheckpointError, match="is a link; links in runs are not followed"):
            read_file(link, 100)


def test_a_link_that_appears_after_the_check_is_not_followed(file, monkeypatch):
    link = file.with_name("link")
    link.symlink_to(file)
    monkeypatch.setattr(type(file), "is_symlink", lambda self: False)
    with pytest.raises(CheckpointError, match="link cannot be read: it is not a plain file"):
        read_file(link, 100)


@pytest.mark.parametrize("kind", ["folder", "pipe", "device"])
def test_what_is_no_plain_file_is_refused_without_waiting(tmp_path, kind):
    odd = tmp_path / kind
    if kind == "folder":
        odd.mkdir()
    elif kind == "pipe":
        os.mkfifo(odd)
    else:
        odd = type(odd)("/dev/zero")
    with pytest.raises(CheckpointError, match="is not a plain file"):
        read_file(odd, 100)


def test_no_handle_is_left_open(file, tmp_path):
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


def test_a_name_that_no_file_can_have_is_refused(tmp_path):
    for name, said in (("x" * 300, "File name too long"), ("a\0b", "embedded null byte")):
        with pytest.raises(CheckpointError) as caught:
            read_file(tmp_path / name, 10)
        assert caught.value.message.endswith(f"{name} cannot be read: {said}")


def test_a_json_file_has_at_most_4_mib(tmp_path):
    manifest = tmp_path / "manifest.json"
    manifest.write_bytes(b" " * (4 * 1024 * 1024 + 1))
    with pytest.raises(CheckpointError, match=r"is too large: 4,194,305 bytes, at most 4,194,304 are read"):
        open_checkpoint(tmp_path)
    manifest.write_bytes(b" " * 4 * 1024 * 1024)
    with pytest.raises(CheckpointError, match="not JSON"):
        open_checkpoint(tmp_path)


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), MemoryError()])
def test_a_file_that_breaks_off_is_an_error_of_the_file(file, monkeypatch, error):
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
    said = "Input/output error" if isinstance(error, OSError) else "there is not enough memory"
    with pytest.raises(CheckpointError, match=rf"data\.json cannot be read: {said}"):
        read_file(file, 100)


def test_of_a_file_that_grows_its_end_is_read_and_whether_that_is_all(file):
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
def test_plain_json_is_read(file, data, value):
    assert parse_json(data, file) == value


def test_it_may_have_32_levels_the_innermost_value_counted_and_no_more(file):
    assert json.dumps(parse_json(nested(31), file)).count("{") == 31
    for deep in (nested(32), b'{"a":' + b"[" * 31 + b"1" + b"]" * 31 + b"}"):
        with pytest.raises(CheckpointError, match="is corrupt: it is nested more than 32 levels deep"):
            parse_json(deep, file)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b'{"a": 1, "b": 2, "b": 3}', "key 'b' appears twice"),
        (b'{"c": {"xy": 1, "xy": 1}}', "key 'xy' appears twice"),
        (b'{"a": NaN}', "NaN is not a JSON number"),
        (b'{"a": -Infinity}', "-Infinity is not a JSON number"),
        (b'{"a": 1e999}', "number 1e999 is out of range"),
        (b'{"a": 123456789012345678901}', "a number has 21 digits"),
        (b"[1]", "not a JSON object"),
        (b"3", "not a JSON object"),
        (b"{", "not JSON"),
        (b"", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (b"[" * 200_000, "not JSON"),
    ],
)
def test_what_is_no_strict_json_is_refused_with_the_reason(file, data, said):
    with pytest.raises(CheckpointError, match=r"data\.json is corrupt: ") as caught:
        parse_json(data, file)
    assert caught.value.message.endswith(said)


def test_a_long_key_or_number_is_not_repeated_at_length(file):
    for data in (f'{{"{"k" * 500}": 1, "{"k" * 500}": 2}}', f'{{"a": 1.{"0" * 500}e999}}'):
        with pytest.raises(CheckpointError) as caught:
            parse_json(data, file)
        assert len(caught.value.message) < len(str(file)) + 100


def test_the_first_link_of_a_folder_is_named(tmp_path):
    (tmp_path / "plain").touch()
    refuse_links(tmp_path)
    for name in ("b", "a", "c"):
        (tmp_path / name).symlink_to(tmp_path / "plain")
    with pytest.raises(CheckpointError, match=r"/a is a link; links in runs are not followed"):
        refuse_links(tmp_path)
    with pytest.raises(CheckpointError, match=r"nowhere cannot be read: No such file"):
        refuse_links(tmp_path / "nowhere")
