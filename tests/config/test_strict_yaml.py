"""Strict YAML: values, positions, and refused input."""

import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rlcli.config.strict_yaml import Document, YamlError, load, load_value

SAMPLE = """\
# a comment
summary: "text: with # signs"
sim: {dt: 1e-3, gravity: [0, 0, -9.81]}
names:
- a
- 'b''s'
- {x: null, y: ~, z: }
deep:
  deeper:
    - - 1
      - [2, 3]
block: |
  two
  lines
"""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("1E5", 1e5),
        (".5", 0.5),
        ("-3.", -3.0),
        ("1e22", 1e22),
        ("0", 0),
        ("-12", -12),
        ("+7", 7),
        ("true", True),
        ("False", False),
        ("null", None),
        ("~", None),
        ("", None),
        ("1:30", "1:30"),
        ("<<", "<<"),
        ("y", "y"),
        ("1/120", "1/120"),
        ("1_000", "1_000"),
        ("0x10", "0x10"),
        ("2024-01-01", "2024-01-01"),
        ("'010'", "010"),
        ('"on"', "on"),
        ("[1, a, {b: c}]", [1, "a", {"b": "c"}]),
    ],
)
def test_scalars_follow_yaml_1_2(text, value):
    found = load_value(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "line", "column", "said"),
    [
        ("a: 1\nb: 2\na: 3\n", 3, 1, "duplicate key 'a' (first on line 1)"),
        ("a:\n  x: 1\n  x: 2\n", 3, 3, "duplicate key 'x'"),
        ("a: {b: 1, b: 2}\n", 1, 11, "duplicate key 'b'"),
        ("a: !!python/object:os.system x\n", 1, 4, "tags are not allowed"),
        ("a: !!int '3'\n", 1, 4, "tags are not allowed"),
        ("a: !mine {b: 1}\n", 1, 4, "tags are not allowed"),
        ("a: &x 1\nb: 2\n", 1, 4, "anchors and aliases"),
        ("a: 1\nb: *x\n", 2, 4, "anchors and aliases"),
        ("a: 1\nb:\n  <<: {c: 1}\n", 3, 3, "merge keys"),
        ("a: 010\n", 1, 4, "remove the leading 0, or write the value in quotes"),
        ("a: [on]\n", 1, 5, "true or false, or quote the text"),
        ("a: No\n", 1, 4, "true or false, or quote the text"),
        ("a: .nan\n", 1, 4, "null for none"),
        ("a: -.INF\n", 1, 4, "null for none"),
        ("a: 1e999\n", 1, 4, "out of range"),
        ("a: 1\n---\nb: 2\n", 2, 1, "only one document"),
        ("a: 1\n1: 2\n", 2, 1, "keys must be text, found 1; write the key in quotes"),
        ("true: 2\n", 1, 1, "keys must be text, found True; write the key in quotes"),
        ("? [a, b]\n: 1\n", 1, 3, "a key must be text"),
        ("- 1\n- 2\n", 1, 1, "the top level must be a mapping"),
        ("a: [1, 2\nb: 3\n", 2, 2, "expected"),
        ("a:\n\t- 1\n", 2, 1, "cannot start any token"),
        ("a: 1\nb: \x00\n", 2, 4, "not allowed"),
        (b"a: 1\nb: \xff\n", 2, 4, "not UTF-8"),
    ],
)
def test_refused_text_is_reported_with_position(text, line, column, said):
    with pytest.raises(YamlError) as caught:
        load(text)
    assert said in caught.value.message
    assert (caught.value.line, caught.value.column) == (line, column)


def test_positions_of_keys_and_items():
    marks = load(SAMPLE).marks
    assert marks["sim", "dt"] == (3, 7)
    assert marks["sim", "gravity", 2] == (3, 33)
    assert marks["names", 1] == (6, 3)
    assert marks["names", 2, "y"] == (7, 13)
    assert marks["deep", "deeper", 0, 1, 1] == (11, 13)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"a: \xff\xfe\n", "not UTF-8"),
        (b"a: 1\n" * 60_000, "larger than"),
        (b"[" * 100_000, "nested deeper than 32"),
        (b"a: " + b"{a: " * 40 + b"1" + b"}" * 40, "nested deeper than 32"),
        (b"a: [" + b"1," * 30_000 + b"]", "more than 20000 items"),
        (b"a: " + b"x" * 20_000, "longer than"),
    ],
)
def test_oversized_input_is_refused_quickly(data, said):
    start = time.process_time()
    with pytest.raises(YamlError, match=said):
        load(data)
    assert time.process_time() - start < 3.0


@pytest.mark.parametrize(
    ("most", "one_more", "said"),
    [
        (b"a: 1 #" + b"x" * (262_144 - 6), b"a: 1 #" + b"x" * (262_144 - 5), "larger than 262144 bytes"),
        (b"a: " + b"x" * 16_384, b"a: " + b"x" * 16_385, "the value is longer than 16384 characters"),
        (b"a: " + b"[" * 31 + b"]" * 31, b"a: " + b"[" * 32 + b"]" * 32, "nested deeper than 32 levels"),
        # around the items stand the beginnings and ends of stream, document, mapping and list, and the key
        (b"a: [" + b"1," * 19_992 + b"]", b"a: [" + b"1," * 19_993 + b"]", "more than 20000 items"),
    ],
    ids=["bytes", "scalar", "depth", "items"],
)
def test_largest_allowed_input_is_read(most, one_more, said):
    assert set(load(most).data) == {"a"}
    with pytest.raises(YamlError, match=said) as caught:
        load(one_more)
    assert (caught.value.line, caught.value.column) == (0, 0) if "bytes" in said else caught.value.line == 1


def test_list_as_key_is_refused_without_printing_it():
    with pytest.raises(YamlError) as caught:
        load("? [a, b]\n: 1\n")
    assert str(caught.value) == caught.value.message == "a key must be text, not a list or mapping; write `name: value`"


def test_byte_order_mark_and_empty_file_are_read():
    assert load("\ufeffa: 1".encode()).data == {"a": 1}
    assert load(b"").data == {}
    assert load(b"# nothing\n").data == {}


def _only_a_document_or_a_yaml_error(data):
    try:
        return isinstance(load(data), Document)
    except YamlError as error:
        return bool(error.message)


@settings(max_examples=300, deadline=None)
@given(st.one_of(st.binary(max_size=200), st.text(max_size=200)))
def test_any_input_gives_document_or_yaml_error(data):
    assert _only_a_document_or_a_yaml_error(data)
