"""Precedence of the layers, origins of values, and targets of overrides."""

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.fault_sizes import amount
from support.small_task import TASK

from rlcli.config.layers import parse_override
from rlcli.config.load import resolve
from rlcli.errors import ConfigError


def test_later_layers_win(task, tmp_path):
    source = task(TASK.replace("  num_envs: 8\n", ""))
    config = tmp_path / "mine.yaml"

    def num_envs(**options):
        return resolve(source, **options).task.scene.num_envs

    no_patch = {"agent": "two"}
    assert num_envs(**no_patch) == 1024  # the schema's default
    source = task()
    assert num_envs(**no_patch) == 8
    assert num_envs() == 4
    assert num_envs(play=True) == 2
    config.write_text("scene: {num_envs: 16}\n")
    assert num_envs(play=True, config_file=config) == 16
    assert num_envs(play=True, config_file=config, overrides=["scene.num_envs=32"]) == 32
    assert num_envs(config_file=config, overrides=["scene.num_envs=32"], flags={"scene.num_envs": 64}) == 64


def test_later_override_wins(task):
    resolved = resolve(task(), overrides=["decimation=4", "decimation=5"])
    assert resolved.task.decimation == 5


def test_place_of_values_from_each_layer(task, tmp_path):
    source = task()
    config = tmp_path / "mine.yaml"
    config.write_text("viewer:\n  eye: [1, 2, 3]\nagent: {gamma: 0.5}\n")
    resolved = resolve(
        source, play=True, config_file=config, overrides=["rewards.alive.weight=3"], flags={"sim.dt": 0.01}
    )
    place = resolved.place
    assert place(("episode_length_s",)) == f"{source.label}:3:1"
    assert place(("decimation",)) == f"{source.label}:22:87"  # the agent's patch
    assert place(("scene", "num_envs")) == f"{source.label}:19:16"  # the play patch
    assert place(("viewer", "eye")) == f"{config}:2:3"
    assert place(("agents", "one", "gamma")) == f"{config}:3:9"
    assert place(("rewards", "alive", "weight")) == "override 'rewards.alive.weight=3'"
    assert place(("sim", "dt")) == "--dt"
    layers = {resolved.layers.origins[p].layer for p in [("decimation",), ("scene", "num_envs"), ("viewer", "eye")]}
    assert layers == {"agent", "play", "config"}


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("a=1", ("a",), 1),
        ("a.b.c = [1, 2]", ("a", "b", "c"), [1, 2]),
        ('joints.".*".damping=1', ("joints", ".*", "damping"), 1),
        ('joints."a=b".x=2', ("joints", "a=b", "x"), 2),
        ("a.0=x", ("a", "0"), "x"),
        ("a=", ("a",), None),
        ("a=b=c", ("a",), "b=c"),
        ('a="1e-3"', ("a",), "1e-3"),
    ],
)
def test_parse_override_reads_keys_and_yaml_values(text, path, value):
    assert parse_override(text) == (path, value)


@pytest.mark.parametrize("text", ["a", "=1", "a.=1", ".a=1", "a..b=1", 'a."b=1', "a b=1", ""])
def test_parse_override_refuses_malformed_text(text):
    with pytest.raises(ConfigError, match="an override has the form"):
        parse_override(text)


def test_override_of_list_item_by_index(task):
    resolved = resolve(
        task(), overrides=["sim.gravity=[0, 0, -1]", "sim.gravity.2=-3.7", "rewards.near.joints.0=hinge"]
    )
    assert resolved.task.sim.gravity == (0.0, 0.0, -3.7)
    assert resolved.task.rewards["near"].params["joints"] == ["hinge"]


@pytest.mark.parametrize("index", ["1", "-1", "x", "²"])
def test_override_of_missing_index_is_refused(problems_of, index):
    (said,) = problems_of(TASK, f"rewards.near.joints.{index}=hinge")
    assert "is a list of length 1" in said


def test_quoted_key_may_contain_dot(task):
    resolved = resolve(task(), overrides=['scene.entities.robot.joints.".*".damping=7'])
    assert resolved.task.scene.entities["robot"].joints[".*"].damping == 7.0


def test_agent_override_changes_chosen_agent(task):
    source = task()
    assert resolve(source, overrides=["agent.gamma=0.5"]).agent.gamma == 0.5
    two = resolve(source, agent="two", overrides=["agent.gamma=0.5", "agents.one.gamma=0.1"])
    assert (two.agent_name, two.agent.gamma, two.agent.max_iterations) == ("two", 0.5, 5)
    assert resolve(source, overrides=["agents.default=two"]).agent_name == "two"


def test_patches_can_be_overridden(task):
    source = task()
    assert resolve(source, overrides=["agent.task.decimation=7"]).task.decimation == 7
    assert resolve(source, overrides=["play.scene.num_envs=5"]).task.scene.num_envs == 4
    assert resolve(source, play=True, overrides=["play.scene.num_envs=5"]).task.scene.num_envs == 5


def test_config_file_may_add_agent(task, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text("agents: {mine: {trainer: sb3, algorithm: ppo, max_steps: 9, task: {decimation: 6}}}\n")
    resolved = resolve(task(), agent="mine", config_file=config)
    assert (resolved.agent.max_steps, resolved.task.decimation) == (9, 6)


def test_default_agent_may_differ_by_device(task):
    source = task(TASK.replace("default: one", "default: {cpu: one, cuda: two}"))
    assert resolve(source).agent_name == "one"
    assert resolve(source, device="cuda:1").agent_name == "two"


def test_null_removes_term_and_order_is_kept(task):
    resolved = resolve(task(), overrides=["rewards.alive=null", "rewards.more={func: is_alive, weight: 2}"])
    assert list(resolved.task.rewards) == ["near", "more"]


def test_config_file_merges_mappings_and_replaces_lists(task, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text("rewards: {near: {weight: -3.0, joints: [hinge]}}\n")
    near = resolve(task(), config_file=config).task.rewards["near"]
    assert (near.weight, near.params["joints"], near.params["target"]) == (-3.0, ["hinge"], 0.0)


_VALUES = {
    ("decimation",): st.integers(1, 9),
    ("episode_length_s",): st.floats(1, 100),
    ("sim", "dt"): st.floats(1e-5, 0.1),
    ("sim", "gravity"): st.lists(st.floats(-20, 20), min_size=3, max_size=3),
    ("scene", "num_envs"): st.integers(1, 99),
    ("scene", "entities", "robot", "joints", "slider", "damping"): st.floats(0, 9),
    ("scene", "entities", "robot", "joints", "a.b*", "kp"): st.floats(0.1, 9),
    ("rewards", "alive", "weight"): st.floats(-5, 5),
    ("rewards", "near", "joints"): st.sampled_from([["hinge"], ["hinge", "slider"], ".*"]),
    ("summary",): st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), max_size=10),
    ("reward_dt_scaling",): st.booleans(),
    ("divergence_reward",): st.none() | st.floats(-9, 9),
}


@settings(max_examples=amount(30, 60), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_override_equals_edited_yaml(task, data):
    from rlcli.config.dump import to_yaml

    raw = yaml.safe_load(TASK)
    raw["sim"]["dt"] = 0.01
    del raw["agents"]
    plain = to_yaml(raw)
    path = data.draw(st.sampled_from(list(_VALUES)))
    value = data.draw(_VALUES[path])
    key = ".".join(f'"{part}"' if "." in part else part for part in path)
    written = to_yaml({"x": value}).strip().removeprefix("x:").strip()
    overridden = resolve(task(plain), overrides=[f"{key}={written}"]).task
    target = raw
    for part in path[:-1]:
        target = target.setdefault(part, {})
    target[path[-1]] = value
    assert resolve(task(to_yaml(raw))).task == overridden
