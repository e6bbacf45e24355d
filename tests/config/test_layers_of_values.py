"""Layers of a configuration: merging, setting values, origins."""

import os
import threading

import pytest

from rlcli.config.layers import Layers, Origin, document_origins, parse_address, parse_override, read
from rlcli.config.strict_yaml import Document, load
from rlcli.errors import ConfigError

TASK, PATCH, OVERRIDE = Origin("task", "task.yaml:1:1"), Origin("agent", "task.yaml:9:1"), Origin("override", "x=1")


def make_layers(data, origin=TASK):
    layers = Layers()
    layers.merge(data, lambda path: origin)
    return layers


def test_merge_merges_mappings_and_replaces_other_values():
    layers = make_layers({"a": {"x": 1, "y": [1, 2]}, "b": 1, "c": {"z": 1}})
    layers.merge({"a": {"y": [3], "w": {"v": 4}}, "b": {"q": 1}, "c": 5}, lambda path: PATCH)
    assert layers.data == {"a": {"x": 1, "y": [3], "w": {"v": 4}}, "b": {"q": 1}, "c": 5}
    from_patch = [("a", "y"), ("a", "y", 0), ("a", "w"), ("a", "w", "v"), ("b",), ("b", "q"), ("c",)]
    assert {path for path, origin in layers.origins.items() if origin is PATCH} == set(from_patch)
    assert layers.origins["a", "x"] is layers.origins["a",] is layers.origins[()] is TASK
    assert ("a", "y", 1) not in layers.origins, "origins of replaced values are removed"
    assert ("c", "z") not in layers.origins


def test_merge_of_mapping_over_list_removes_item_origins():
    layers = make_layers({"a": [1, 2]})
    layers.merge({"a": {"x": 1}}, lambda path: PATCH)
    assert layers.data == {"a": {"x": 1}}
    assert {path: origin for path, origin in layers.origins.items() if path} == {("a",): PATCH, ("a", "x"): PATCH}


def test_merge_at_path_calls_origin_with_patch_paths():
    layers, paths = make_layers({"agents": {"ppo": {"gamma": 0.9}}}), []
    layers.merge({"lr": {"start": 1}}, lambda path: paths.append(path) or PATCH, ("agents", "ppo", "deep"))
    assert layers.data == {"agents": {"ppo": {"gamma": 0.9, "deep": {"lr": {"start": 1}}}}}
    assert ("lr", "start") in paths
    assert ("agents",) not in paths
    assert layers.origins["agents", "ppo", "deep"] is PATCH
    assert layers.origins["agents", "ppo"] is TASK


def test_merge_at_path_creates_mapping():
    layers = make_layers({"agents": {"ppo": None}})
    layers.merge({"lr": 1}, lambda path: PATCH, ("agents", "ppo", "deep"))
    assert layers.data == {"agents": {"ppo": {"deep": {"lr": 1}}}}
    assert layers.origins["agents", "ppo"] is layers.origins["agents", "ppo", "deep"] is PATCH
    assert layers.origins["agents",] is TASK
    assert layers.place(("agents", "ppo", "deep", "lr")) == PATCH.where


def test_merge_copies_data():
    data = {"a": {"x": [{"y": 1}]}}
    layers = make_layers(data)
    layers.set(("a", "x", "0", "y"), 2, OVERRIDE)
    assert data == {"a": {"x": [{"y": 1}]}}
    assert layers.data == {"a": {"x": [{"y": 2}]}}


@pytest.mark.parametrize(
    ("path", "value", "data"),
    [
        (("a", "x"), 2, {"a": {"x": 2, "l": [1, {"k": 2}]}}),
        (("a", "l", "0"), 7, {"a": {"x": 1, "l": [7, {"k": 2}]}}),
        (("a", "l", 1, "k"), 7, {"a": {"x": 1, "l": [1, {"k": 7}]}}),
        (("a", "l", "1", "new"), 7, {"a": {"x": 1, "l": [1, {"k": 2, "new": 7}]}}),
        (("b", "c"), 1, {"a": {"x": 1, "l": [1, {"k": 2}]}, "b": {"c": 1}}),
        (("a",), None, {"a": None}),
        (("a", "l"), [], {"a": {"x": 1, "l": []}}),
    ],
)
def test_set_changes_value_and_origin(path, value, data):
    layers = make_layers({"a": {"x": 1, "l": [1, {"k": 2}]}})
    layers.set(path, value, OVERRIDE)
    assert layers.data == data
    own = tuple(int(step) if str(step).isdigit() else step for step in path)
    assert layers.origin(own) is OVERRIDE
    assert layers.origin(()) is TASK
    assert all(p[: len(own)] != own or p == own for p in layers.origins), "origins below the replaced value are removed"


def test_set_creates_mappings_with_override_origin():
    layers = make_layers({"a": None, "b": {"old": 1}})
    layers.set(("a", "x", "y"), {"k": [5]}, OVERRIDE)
    assert layers.data["a"] == {"x": {"y": {"k": [5]}}}
    made = [("a",), ("a", "x"), ("a", "x", "y"), ("a", "x", "y", "k"), ("a", "x", "y", "k", 0)]
    assert {p for p, o in layers.origins.items() if o is OVERRIDE} == set(made)
    layers.set(("b", "new"), 1, OVERRIDE)
    assert layers.origins["b",] is TASK
    assert layers.origins["b", "old"] is TASK


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (("l", "2"), "'l' is a list of length 2 without item '2'; give an index from 0 to 1"),
        (("l", "-1"), "'l' is a list of length 2 without item '-1'; give an index from 0 to 1"),
        (("l", "x"), "'l' is a list of length 2 without item 'x'; give an index from 0 to 1"),
        (("l", "2", "y"), "'l' is a list of length 2 without item '2'; give an index from 0 to 1"),
        (("n", "x"), "'n' is a single value; leave out the keys after it"),
        (("n", "x", "y"), "'n' is a single value; leave out the keys after it"),
        (("l", "0", "y"), "'0' is a single value; leave out the keys after it"),
    ],
)
def test_set_refuses_path_without_member(path, said):
    layers = make_layers({"l": [1, 2], "n": 3})
    with pytest.raises(LookupError) as caught:
        layers.set(path, 1, OVERRIDE)
    assert caught.value.args[0].replace("'0' is", "'0' is") == said
    assert layers.data == {"l": [1, 2], "n": 3}


def test_get_returns_value_or_default():
    layers = make_layers({"a": {"x": 0, "n": None}, "l": [1]})
    assert layers.get(("a", "x"), 5) == 0
    assert layers.get(("a", "n"), 5) is None
    assert layers.get(("a", "y"), 5) == 5
    assert layers.get(("a", "x", "y"), 5) == 5
    assert layers.get(("l", 0), 5) == 5
    assert layers.get(()) == layers.data
    assert layers.get(("b",)) is None


def test_place_falls_back_to_enclosing_value():
    layers = make_layers({"a": {"x": 1}})
    layers.set(("a", "y"), 2, OVERRIDE)
    assert layers.place(("a", "y", "z", "w")) == OVERRIDE.where
    assert layers.place(("a", "nothing")) == TASK.where
    assert layers.origin(("b",)) is TASK
    assert Layers().origin(("b",)) is None
    assert Layers().place(()) == "configuration"


# --- files ---


def test_document_origins_of_part_have_lines():
    document = load("a: 1\nagent:\n  lr: 2\n  net: {h: [3]}\n")
    whole, part = (
        document_origins(document, "f.yaml", "config"),
        document_origins(document, "f.yaml", "config", ("agent",)),
    )
    assert whole(("a",)) == Origin("config", "f.yaml:1:1")
    assert part(("lr",)) == Origin("config", "f.yaml:3:3")
    assert part(("net", "h", 0)) == Origin("config", "f.yaml:4:13")
    assert part(("net", "none")) == part(("net",)) == Origin("config", "f.yaml:4:3")
    assert part(("other",)) == part(()) == Origin("config", "f.yaml:2:1")
    assert whole(("other",)) == Origin("config", "f.yaml:1:1")
    assert document_origins(Document({"a": 1}), "task.py", "task")(("a",)) == Origin("task", "task.py")


def test_read_reports_unreadable_file_with_position(tmp_path):
    (tmp_path / "bad.yaml").write_text("a: 1\na: 2\n")
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "bad.yaml", "mine")
    assert [(p.where, p.path) for p in caught.value.problems] == [("mine:2:1", "")]
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "none.yaml")
    (problem,) = caught.value.problems
    assert (problem.where, problem.message) == (
        str(tmp_path / "none.yaml"),
        "the file cannot be read: No such file or directory; check the path",
    )
    (tmp_path / "big.yaml").write_text("a: 1\n" * 60_000)
    with pytest.raises(ConfigError) as caught:
        read(tmp_path / "big.yaml", pipe=True)
    assert [p.where for p in caught.value.problems] == [str(tmp_path / "big.yaml")], (
        "a problem of the whole file has no line"
    )


def test_read_accepts_pipe_only_if_allowed(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(ConfigError, match="cannot be read"):
        read(pipe)
    writer = threading.Thread(target=lambda: pipe.write_text("a: 1\n"))
    writer.start()
    assert read(pipe, pipe=True).data == {"a": 1}
    writer.join()


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("a=1", ("a",), 1),
        ("a.b.c=x", ("a", "b", "c"), "x"),
        (" a.b = [1, 2] ", ("a", "b"), [1, 2]),
        ('joints.".*".damping=1', ("joints", ".*", "damping"), 1),
        ('"a.b"=1', ("a.b",), 1),
        ("a.0.b=1", ("a", "0", "b"), 1),
        ("a=", ("a",), None),
        ("a=b=c", ("a",), "b=c"),
        ("a={x: 1,\n y: 2}", ("a",), {"x": 1, "y": 2}),
    ],
)
def test_parse_override_returns_path_and_value(text, path, value):
    assert parse_override(text) == (path, value)


@pytest.mark.parametrize("text", ["a", "=1", "a..b=1", ".a=1", "a.=1", "a b=1", '"a=1', ""])
def test_parse_override_refuses_other_forms(text):
    with pytest.raises(ConfigError, match="an override has the form"):
        parse_override(text)


def test_parse_override_reports_bad_yaml_at_key():
    with pytest.raises(ConfigError) as caught:
        parse_override("a.b=[1")
    (problem,) = caught.value.problems
    assert (problem.where, problem.path) == ("override 'a.b=[1'", "a.b")
    assert parse_address('a."b.c".d') == ("a", "b.c", "d")
