"""Output of `show`: YAML that reads back as the same configuration, origins, and a JSON Schema."""

import copy
import functools

import jsonschema
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.fault_sizes import amount
from support.small_task import TASK

from rlcli.config import strict_yaml
from rlcli.config.dump import json_schema, origins, to_data, to_yaml, to_yaml_with_origins
from rlcli.config.load import extensions, resolve
from rlcli.registry import find_task

_TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=20).filter(
    lambda text: all(c in "\t\n" or c.isprintable() for c in text)
)
_SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**15), 10**15),
    st.floats(allow_nan=False, allow_infinity=False),
    _TEXT,
    st.sampled_from(
        [
            "1e-3",
            "on",
            "010",
            "",
            "null",
            "~",
            "true",
            "1/2",
            "a: b",
            "- a",
            "#",
            "a #b",
            "{",
            "*a",
            "&a",
            "!a",
            "'",
            '"',
            "%",
            "---",
            " a ",
        ]
    ),
)
_DATA = st.dictionaries(
    st.one_of(_TEXT, st.sampled_from(["on", "1", "", "null", ".*", "a.b", "a: b"])),
    st.recursive(
        _SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_TEXT, inner, max_size=3), max_leaves=8
    ),
    max_size=4,
)


def equal_with_types(a, b):
    """Return whether two values are equal and have equal types at every level."""
    if isinstance(a, dict):
        return type(b) is dict and list(a) == list(b) and all(equal_with_types(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return type(b) is list and len(a) == len(b) and all(map(equal_with_types, a, b))
    return type(a) is type(b) and a == b


@settings(max_examples=amount(120, 300), deadline=None)
@given(_DATA)
@example({"a": 1e-05, "b": 1e22, "c": -0.0, "d": 5e-324, "e": 1.7976931348623157e308, "f": 1.0})
@example({"<<": "<<"})
@example({"on": "on", "010": "010", "x": ["1e-3", "null", ""], "y": {}, "z": []})
def test_to_yaml_round_trips_plain_data(data):
    assert equal_with_types(strict_yaml.load(to_yaml(data)).data, data)


@pytest.mark.parametrize("name", ["ant-direct", "cartpole", "cartpole-direct"])
@pytest.mark.parametrize("play", [False, True])
def test_to_yaml_round_trips_built_in_task(name, play, tmp_path):
    from dataclasses import replace

    source = find_task(name)
    first = resolve(source, play=play, overrides=["agent.learning_rate=1e-5", "sim.dt=1/300"])
    file = tmp_path / "task.yaml"
    for text in (to_yaml(to_data(first)), to_yaml_with_origins(first)):
        file.write_text(text, encoding="utf-8")
        again = resolve(replace(source, config=file), play=play)
        assert again.task.model_dump(exclude={"play"}) == first.task.model_dump(exclude={"play"})
        assert (again.agent_name, again.trainer) == (first.agent_name, first.trainer)
        assert again.agent.model_dump(exclude={"task"}) == first.agent.model_dump(exclude={"task"})
        assert to_data(again) == to_data(first)


@settings(max_examples=amount(10, 25), deadline=None)
@given(summary=_TEXT, weight=st.floats(-1e30, 1e30), joint=_TEXT.filter(bool))
@example(summary="on", weight=1e-05, joint="1e-3")
@example(summary="", weight=1e22, joint="null")
@example(summary="two\nlines", weight=1.0, joint="a\nb: c")
@example(summary="?", weight=1.0, joint="a joint with a long name " * 8)
def test_to_yaml_round_trips_any_values(tmp_path_factory, summary, weight, joint):
    from rlcli.registry import folder_task

    folder = tmp_path_factory.mktemp("t")
    raw = yaml.safe_load(TASK)
    raw["sim"]["dt"] = 0.01
    raw["summary"] = summary
    raw["rewards"]["near"].update(weight=weight, joints=[joint])
    raw["scene"]["entities"]["robot"]["joints"] = {joint: {"kp": 1.0}}
    texts = [to_yaml(raw)]
    resolved = []
    for _ in range(3):
        (folder / "task.yaml").write_text(texts[-1], encoding="utf-8")
        resolved.append(resolve(folder_task(folder)))
        texts.append(
            (to_yaml if len(texts) == 1 else lambda _: to_yaml_with_origins(resolved[-1]))(to_data(resolved[-1]))
        )
    assert resolved[0].task == resolved[1].task == resolved[2].task
    assert resolved[0].task.rewards["near"].params["joints"] == [joint]


def test_to_data_keeps_removed_terms_and_null(task):
    data = to_data(resolve(task(), overrides=["rewards.near=null", "scene.ground=null"]))
    assert list(data["rewards"]) == ["alive"]
    assert data["scene"]["ground"] is None


def test_origins_cover_every_value(task):
    overrides = ["sim.gravity=[0, 0, -1]", "sim.gravity.2=-3", "rewards.alive.weight=2", 'summary="two\\nlines"']
    resolved = resolve(task(), overrides=overrides, flags={"scene.num_envs": 3})
    label = resolved.source.label
    found = origins(resolved)
    assert found["decimation"].startswith(f"agent: {label}:22:")
    assert found["episode_length_s"] == f"{label}:3:1"
    assert found["scene.num_envs"] == "--num-envs"
    assert found["scene.env_spacing"] == "default"
    assert found["rewards.alive.weight"] == "override 'rewards.alive.weight=2'"
    assert found["sim.gravity"] == "override 'sim.gravity=[0, 0, -1]', override 'sim.gravity.2=-3'"
    assert found["agents.one.max_iterations"] == f"{label}:22:39"
    text = to_yaml_with_origins(resolved)
    assert all("  # " in line for line in text.splitlines() if line[0] != "#" and line.rstrip()[-1] != ":")
    assert strict_yaml.load(text).data == to_data(resolved)


@functools.cache
def validator(name):
    schema = json_schema(*extensions(find_task(name)))
    unchecked = dict(schema)
    if name != "cartpole":  # a check of the parts that all tasks share takes seconds
        checked = validator("cartpole").schema
        for group in ("properties", "$defs"):
            unchecked[group] = {key: part for key, part in schema[group].items() if checked[group].get(key) != part}
    jsonschema.Draft202012Validator.check_schema(unchecked)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("name", ["ant-direct", "cartpole", "cartpole-direct"])
def test_json_schema_accepts_built_in_tasks(name):
    source = find_task(name)
    check = validator(name)
    written = strict_yaml.load(source.config.read_bytes()).data
    assert list(check.iter_errors(written)) == []
    assert list(check.iter_errors(to_data(resolve(source)))) == []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("decimation",), -2),
        (("decimatoin",), 2),
        (("sim", "dt"), "fast"),
        (("sim", "dt"), -1),
        (("rewards", "alive", "wieght"), 2.0),
        (("rewards", "pole_pos", "target"), "far"),
        (("rewards", "alive", "func"), "is_alife"),
        (("observations", "policy", "joint_pos_rel", "scale"), "big"),
        (("success", "pole", "at_most"), "far"),
    ],
)
def test_json_schema_refuses_invalid_values(path, value):
    source = find_task("cartpole")
    check = validator("cartpole")
    data = copy.deepcopy(strict_yaml.load(source.config.read_bytes()).data)
    target = data
    for step in path[:-1]:
        target = target[step]
    target[path[-1]] = value
    assert list(check.iter_errors(data))


def test_json_schema_contains_own_terms_and_params(task):
    terms = 'def mine(env, *, x: float = 2.0):\n    """My term."""\ndef odd(env, *, weight: float): ...\n'
    schema = json_schema(*extensions(task(terms=terms)))
    rewards = {
        t["properties"]["func"]["const"]: t
        for t in schema["properties"]["rewards"]["additionalProperties"]["anyOf"][:-1]
    }
    assert rewards["mine"]["properties"]["func"]["description"] == "My term."
    assert rewards["mine"]["properties"]["x"]["default"] == 2.0
    assert "odd" not in rewards
    params = json_schema(*extensions(find_task("cartpole-direct")))["properties"]["params"]
    assert params["properties"]["reset_dist"]["description"].startswith("An episode fails if the cart")
