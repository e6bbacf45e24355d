"""`rlcli import isaaclab`: the files of a run become a task of rlcli, and every key is reported."""

import json
import os
from pathlib import Path

import pytest
import torch
import yaml

from rlcli.cli.app import main
from rlcli.config.dump import to_data
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task, folder_task
from rlcli_isaaclab.dump_yaml import read

torch.set_num_threads(1)
HERE = Path(__file__).parent
ENV, AGENT = HERE / "env.yaml", HERE / "agent.yaml"


@pytest.fixture
def imported(tmp_path, capsys):
    """Return imported(env_text, ...) -> exit code, JSON document, stderr, folder."""

    def run(text=None, *words, agent=AGENT):
        env = tmp_path / "env.yaml"
        env.write_text(ENV.read_text() if text is None else text, encoding="utf-8")
        folder = tmp_path / "task"
        agents = [str(agent)] if agent else []
        code = main(["import", "isaaclab", str(env), *agents, "-o", str(folder), "--json", *words])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out.strip() else {}, err, folder

    return run


def test_cartpole_run_equals_builtin_cartpole_config(imported):
    code, _, _, folder = imported()
    assert code == 0
    ours = to_data(resolve(folder_task(folder)))
    theirs = to_data(resolve(find_task("cartpole"), flags={"scene.num_envs": 4096}))
    theirs["scene"]["entities"]["robot"]["velocity_point"] = "com"  # Isaac Lab's velocities
    for key in ("decimation", "episode_length_s", "sim", "scene", "actions", "observations", "rewards", "terminations"):
        assert ours[key] == theirs[key], key
    assert list(ours["events"].values()) == list(theirs["events"].values())
    assert ours["viewer"]["eye"] == theirs["viewer"]["eye"]
    assert ours["reward_dt_scaling"] is theirs["reward_dt_scaling"]
    agent = ours["agents"]["rsl-rl"]
    assert (agent["trainer"], agent["dialect"], agent["num_steps"], agent["entropy_coef"]) == (
        "ppo",
        "rsl_rl",
        16,
        0.005,
    )
    assert agent["actor"] == {"hidden": [32, 32], "activation": "elu"}


@pytest.mark.parametrize(("loss", "coefficient"), [("true", 0.5), ("false", 0.0)])
def test_symmetry_cfg_of_agent(imported, tmp_path, loss, coefficient):
    """The mirror map that rlcli finds replaces the function, and the report says so."""
    symmetry = f"{{use_data_augmentation: true, use_mirror_loss: {loss}, mirror_loss_coeff: 0.5,"
    text = AGENT.read_text().replace("symmetry_cfg: null", f"symmetry_cfg: {symmetry} data_augmentation_func: 'a:b'}}")
    (tmp_path / "agent.yaml").write_text(text)
    code, document, _, folder = imported(agent=tmp_path / "agent.yaml")
    assert code == 0
    symmetry = to_data(resolve(folder_task(folder)))["agents"]["rsl-rl"]["symmetry"]
    assert (symmetry["augment"], symmetry["mirror_coef"]) == (True, coefficient)
    status = {row["key"]: row["status"] for row in document["keys"] if "symmetry_cfg" in row["key"]}
    assert sorted(status.values()) == ["approximated", "mapped", "mapped", "mapped"]


def test_imported_task_equals_builtin_cartpole_steps(imported):
    _, _, _, folder = imported()
    ours = make_env(resolve(folder_task(folder), flags={"scene.num_envs": 4}))
    other = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": 4}))
    ours.reset(seed=0), other.reset(seed=0)
    for field in ("qpos", "qvel"):
        ours.engine.field(field).copy_(other.engine.field(field))
    ours.engine.forward(ours._select_all())
    ours.sim.refresh()
    for _ in range(30):
        a, b = (env.step(torch.full((4, 1), 0.02)) for env in (ours, other))
        assert torch.equal(a.obs["policy"], b.obs["policy"])
        assert torch.equal(a.reward, b.reward)


def leaves(value, key=()):
    if isinstance(value, dict) and value:
        for name, item in value.items():
            yield from leaves(item, (*key, str(name)))
    else:
        yield key


def test_every_key_is_reported(imported):
    _, document, _, _ = imported()
    reported = {tuple(row["key"].split(".")): row for row in document["keys"]}
    text = ENV.read_text().replace("!!python/tuple", "").replace("!!python/object/apply:builtins.slice", "")
    text = text.replace("!!python/object/apply:isaaclab.managers.recorder_manager.DatasetExportMode", "")
    missing = []
    for key in leaves(yaml.safe_load(text)):
        above = [".".join(key[:length]) for length in range(1, len(key) + 1)]
        if not any(".".join(known) in above for known in reported):
            missing.append(key)
    assert missing == []
    status = {row["key"]: row["status"] for row in document["keys"]}
    assert status["sim.dt"] == status["rewards.alive.weight"] == "mapped"
    assert status["scene.robot.spawn.rigid_props.max_depenetration_velocity"] == status["sim.physx"] == "ignored"
    assert status["scene.robot.spawn.collision_props"] == "default"


def test_unknown_function_becomes_stub(imported):
    own = "func: my_robots.mdp:wobble\n    params:\n      strength: 2.0"
    text = ENV.read_text().replace("func: isaaclab.envs.mdp.rewards:is_alive\n    params: {}", own)
    code, _, err, folder = imported(text)
    assert code == 0
    assert "rewards.alive.func: to do: write 'wobble' in terms.py" in err
    assert "def wobble(env, *, strength: float):" in (folder / "terms.py").read_text()
    assert resolve(folder_task(folder)).task.rewards["alive"].params == {"strength": 2.0}


def test_unknown_command_and_curriculum_become_loadable_stubs(imported):
    own = """commands:
  place:
    class_type: my_robots.mdp:PlaceCommand
    resampling_time_range: !!python/tuple [2.0, 4.0]
    asset_name: robot
    debug_vis: true
    ranges: {x: [-1, 1.0]}
curriculum:
  ramp: {func: 'my_robots.mdp:ramp', params: {term_name: alive, weight: 2.0}}
"""
    lines = [line for line in ENV.read_text().split("\n") if not line.startswith(("commands:", "curriculum:"))]
    code, _, err, folder = imported("\n".join(lines) + own)
    assert code == 0
    assert "commands.place.class_type: to do: write 'PlaceCommand' in terms.py" in err
    text = (folder / "terms.py").read_text()
    assert "def __init__(self, env, *, entity: Entity, ranges: dict[str, list[float]]):" in text
    assert "def ramp(env, selection, *, term_name: str, weight: float):" in text
    task = resolve(folder_task(folder)).task
    assert task.commands["place"].params == {"entity": "robot", "ranges": {"x": [-1.0, 1.0]}}


def test_model_option_replaces_unknown_usd_file(imported, tmp_path):
    text = ENV.read_text().replace("Classic/Cartpole/cartpole.usd", "Own/wobbly.usd")
    code, document, _, folder = imported(text)
    assert code == 3
    assert "scene.robot.spawn.usd_path" in json.dumps(document)
    assert not folder.exists()
    model = tmp_path / "wobbly.xml"
    model.write_text((find_task("cartpole").root / "cartpole.xml").read_text())
    code, _, _, folder = imported(text, "--model", f"robot={model}")
    assert code == 0
    assert resolve(folder_task(folder)).task.scene.entities["robot"].model == "wobbly.xml"
    assert make_env(resolve(folder_task(folder), flags={"scene.num_envs": 2})).num_envs == 2


def test_import_executes_and_constructs_nothing(imported, tmp_path):
    mark = tmp_path / "ran"
    evil = f"evil: !!python/object/apply:os.system ['touch {mark}']\n"
    code, _, _, _ = imported(evil + ENV.read_text())
    assert code == 0
    assert not mark.exists()


BOMB = "a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in zip("abcdef", "bcdefg", strict=True)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "env.yaml:"),
        ("- 1", "the top level must be a mapping"),
        ("a: 1", "missing 'decimation'"),
        (BOMB, "env.yaml:5:12: the file has more than 20000 items"),
        ("x: " + "[" * 3000, "env.yaml:1:36: values are nested deeper than 32 levels"),
        ("x: &a [" + "[" * 20 + "1" + "]" * 20 + "]\ny: " + "[" * 20 + "*a", "env.yaml:2:24: values are nested deeper"),
        ("x: &a [*a]", "env.yaml:1:8: the anchor 'a' contains the alias *a"),
        ("x: '" + "y" * 300_000 + "'", "env.yaml: cannot be read: the file is larger than 262144 bytes"),
        ("x: '" + "y" * 20_000 + "'", "env.yaml:1:4: the value is longer than 16384 characters"),
        ("x: 1\nx: 2", "env.yaml:2:1: duplicate key 'x'"),
        ("x: &a {y: 1}\nz: {<<: *a}", "env.yaml:2:5: merge keys (<<) are not allowed"),
        ("x: {[1]: 2}", "env.yaml:1:5: a key must be text"),
        ("x: !!binary aGVsbG8=", "env.yaml:1:4: only tags of scalars and of Python objects are allowed"),
        ("x: !!python/tuple 1", "env.yaml:1:4: the tag needs a list"),
        ("x: !!python/object/apply:builtins.slice [1, 2, 3, 4]", "env.yaml:1:4: this value is not a valid builtins"),
        ("x: " + "9" * 5000, "env.yaml:1:4: '" + "9" * 60 + "' is not a valid int"),
        ("x: !!float a", "env.yaml:1:4: 'a' is not a valid float"),
        ('x: "\\U00110000"', "is not a Unicode character; correct it"),
        ('x: "\\ud800"', "env.yaml:1:4: half of a surrogate pair"),
        ("x: 1\n--- {}", "env.yaml:2:1: "),
    ],
)  # fmt: skip
def test_invalid_file_is_refused(imported, text, message):
    code, document, _, folder = imported(text)
    assert code == 3
    assert message in json.dumps(document)
    assert not folder.exists()


def test_dump_that_is_not_utf_8_is_refused(tmp_path, capsys):
    (tmp_path / "env.yaml").write_bytes(ENV.read_text().encode("utf-16"))
    assert main(["import", "isaaclab", str(tmp_path / "env.yaml"), "-o", str(tmp_path / "out")]) == 3
    assert "env.yaml:1:1: not UTF-8" in capsys.readouterr().err


def test_dump_of_python_objects_is_read_as_pyyaml_writes_it(tmp_path):
    shared = (1, 2.5)
    data = {"tuple": shared, "again": shared, "slice": slice(None), "function": os.path.join, "y": {"on": [None, True]}}
    (tmp_path / "env.yaml").write_text(yaml.dump(data) + ".nan: 1\n5: 2020-01-01\n")
    expected = {**data, "function": "posixpath:join", ".nan": 1, "5": "2020-01-01"}
    assert read(tmp_path / "env.yaml") == expected


def test_existing_task_is_not_overwritten(imported):
    assert imported()[0] == 0
    code, document, _, _ = imported()
    assert code == 2
    assert "exists" in json.dumps(document)


def test_agent_file_of_other_library_is_refused(imported, tmp_path):
    other = tmp_path / "agent.yaml"
    other.write_text("params:\n  seed: 42\n")
    code, document, _, _ = imported(None, str(other), agent=False)
    assert code == 3
    assert "not an agent.yaml of RSL-RL" in json.dumps(document)


def test_settings_that_cartpole_lacks_are_translated(imported):
    noise = "noise: {func: isaaclab.utils.noise.noise_model:uniform_noise, operation: add, n_min: -0.1, n_max: 0.1}"
    softer = "func: isaaclab.envs.mdp.curriculums:modify_reward_weight"
    softer += ", params: {term_name: alive, weight: 0.5, num_steps: 100}"
    plain = "clip: null\n      scale: null\n      history_length: 0"
    motor = "class_type: isaaclab.actuators.actuator_pd:"
    text = ENV.read_text()
    for old, new in (
        ("noise: null", noise),
        ("enable_corruption: false", "enable_corruption: true"),
        (plain, "clip: [-5, 5]\n      scale: 2.0\n      history_length: 3"),
        ("curriculum: null", f"curriculum: {{softer: {{{softer}}}}}"),
        (f"{motor}ImplicitActuator", f"{motor}IdealPDActuator"),
        ("effort_limit: null", "effort_limit: 30.0"),
        ("size: !!python/tuple\n      - 100.0\n      - 100.0", "size: [50.0, 60.0]"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    code, document, err, folder = imported(text)
    assert code == 0, (document, err)
    data = to_data(resolve(folder_task(folder)))
    term = data["observations"]["policy"]["joint_pos_rel"]
    assert (term["noise"]["low"], term["clip"], term["scale"], term["history"]) == (-0.1, [-5.0, 5.0], 2.0, 3)
    assert data["curriculum"]["softer"]["address"] == "rewards.alive.weight"
    actuator = data["scene"]["entities"]["robot"]["actuators"]["cart_actuator"]
    assert (actuator["kind"], actuator["damping"], actuator["effort_limit"]) == ("pd", 10.0, 30.0)
    assert data["scene"]["ground"]["size"] == 60.0


def test_pipe_and_endless_file_are_not_read(tmp_path, capsys):
    pipe, sparse = tmp_path / "pipe.yaml", tmp_path / "sparse.yaml"
    os.mkfifo(pipe)
    with sparse.open("wb") as file:
        file.truncate(2**40)
    for file, why in ((pipe, "not a regular file"), (sparse, "larger than")):
        assert main(["import", "isaaclab", str(file), "-o", str(tmp_path / "out")]) == 3
        assert why in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("x[31m", "neither the name of a joint nor a regular expression"),
        ("(([a-z_]*)*)*X", "can take exponential time"),
        ("slider" + ".*" * 30, "the pattern"),
    ],
)
@pytest.mark.parametrize("place", ["actions", "actuators", "init", "gains"])
def test_pattern_that_is_invalid_or_hangs_is_refused(imported, place, pattern, message):
    data = read(ENV)
    robot = data["scene"]["robot"]
    group = robot["actuators"]["cart_actuator"]
    if place == "actions":
        data["actions"]["joint_effort"]["joint_names"] = [pattern]
    elif place == "init":
        robot["init_state"]["joint_pos"] = {pattern: 0.0}
    elif place == "gains":
        group["damping"] = {pattern: 1.0}
    else:
        group["joint_names_expr"] = [pattern, 5]
    code, document, _, folder = imported(yaml.dump(data))
    assert code == 3
    messages = [problem["message"] for problem in document["error"]["problems"]]
    assert len([text for text in messages if message in text]) == 1, messages
    assert any("found 5" in text for text in messages) == (place == "actuators")
    assert not folder.exists()
