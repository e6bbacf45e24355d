"""`show`, `validate` and the configuration step of `train`: output, imports and errors."""

import json
import subprocess
import sys

import pytest

HEAVY = {"torch", "mujoco", "numpy", "stable_baselines3"}


def modules_after(arguments, here):
    """Run a command; return its exit code, the heavy modules that it imported, and its stderr."""
    program = (
        "import sys; from rlcli.cli.app import main; code = main(sys.argv[1:]);"
        f"print(); print(code, *sorted(set(sys.modules) & {HEAVY!r}))"
    )
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, cwd=here)
    code, *loaded = done.stdout.splitlines()[-1].split()
    return int(code), loaded, done.stderr


def test_mistyped_override_fails_before_torch_is_imported(here, rlcli):
    done = rlcli("train", "cartpole", "rewards.alive.wieght=2")
    assert done.returncode == 3
    assert done.stderr == (
        "error: override 'rewards.alive.wieght=2': rewards.alive.wieght: unknown key 'wieght'; did you mean 'weight'?\n"
    )
    assert list(here.iterdir()) == []
    assert modules_after(["train", "cartpole", "rewards.alive.wieght=2"], here)[:2] == (3, [])


def test_all_mistakes_in_file_have_line_and_column(here, small):
    task = small(
        ("decimation: 2", "decimation: -2"),
        ("{func: is_alive, weight: 1.0}", "{func: is_alive, weight: 1.0, wieght: 2}"),
    )
    code, loaded, err = modules_after(["train", task], here)
    assert (code, loaded) == (3, [])
    assert err.splitlines() == [
        "error: small/task.yaml:2:1: decimation: expected a whole number >= 1, found -2",
        "error: small/task.yaml:15:40: rewards.alive.wieght: unknown key 'wieght'; did you mean 'weight'?",
    ]


COLUMN = """\
from rlcli.task import Entity


def column(env, *, entity: Entity = "robot"):
    return entity.data.joint_pos
"""


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("  alive: {func: is_alive, weight: 1.0}", "  bad:\n    weight: 1.0\n    func: column", "15:3: rewards.bad"),
        ("rewards:", "terminations: {bad: {func: column}}\nrewards:", "14:16: terminations.bad"),
        ("rewards:", "success:\n  centred: {func: column}\nrewards:", "15:3: success.centred"),
    ],
)
def test_wrong_shape_of_term_is_reported_once(in_process, small, old, new, place):
    task = small((old, new), terms=COLUMN)
    message = "'column' returned a tensor of shape (4, 2); return a tensor of shape (4,)"
    message += " of booleans" if "terminations" in place else ""
    for command in (["play", task, "--policy", "zero", "--viewer", "none"], ["train", task]):
        code, _, err = in_process(*command)
        assert code == 3
        assert [line for line in err.splitlines() if "error" in line] == [f"error: small/task.yaml:{place}: {message}"]


def test_train_without_agent_is_config_error(in_process, small):
    task = small(("agents:\n  default: small\n  small: {trainer: sb3, algorithm: ppo, max_iterations: 1}\n", ""))
    code, _, err = in_process("train", task)
    assert code == 3
    assert "this task has no agent to train" in err
    assert in_process("validate", task)[0] == 0


def test_mistake_in_config_file_names_file(in_process, here):
    (here / "mine.yaml").write_text("rewards: {alive: {weight: x}}\n")
    code, _, err = in_process("train", "cartpole", "--config", "mine.yaml")
    assert code == 3
    assert "mine.yaml:1:19: rewards.alive.weight: expected a number, found 'x'" in err


def test_validate_refuses_a_model_outside_of_the_folder_before_it_prints_a_result(in_process, small):
    code, out, err = in_process("validate", small(("model: model.xml", "model: ../model.xml")))
    assert (code, out) == (3, "")
    assert "small/task.yaml:8:13: scene.entities.robot.model: '../model.xml' lies outside the task's folder" in err


def test_validate_reports_missing_model(in_process, here, small):
    code, _, err = in_process("validate", small(("model.xml", "models.xml")))
    assert code == 3
    assert "small/task.yaml:8:13: scene.entities.robot.model: no file 'models.xml' in" in err
    assert "MJCF files there: model.xml" in err
    code, _, err = in_process("validate", small(("model: model.xml", "model: 'models:nobody/robot.xml'")))
    assert code == 0
    assert "model of robot: RLCLI_MODELS is not set" in err


def test_unknown_term_of_folder_without_terms_names_the_file(in_process, small):
    code, _, err = in_process("validate", small(("func: is_alive", "func: home_sweet_home")))
    assert code == 3
    assert "there is no reward term 'home_sweet_home'" in err
    assert "the folder small has no terms.py; terms: " in err


def test_validate_does_not_import_terms(here, small):
    task = small(
        ("is_alive, weight", "mine, x: 2, weight"), terms="raise SystemExit(9)\ndef mine(env, *, x: int): ...\n"
    )
    assert modules_after(["validate", task], here)[:2] == (0, [])
    code, _, err = modules_after(["validate", task, "rewards.alive.x=two"], here)
    assert code == 3
    assert "rewards.alive.x: expected a whole number, found 'two'" in err


@pytest.mark.parametrize(
    "arguments",
    [
        ["validate", "cartpole"],
        ["validate", "cartpole-direct"],
        ["show", "cartpole"],
        ["show", "cartpole", "--origin"],
        ["show", "cartpole-direct", "--schema"],
    ],
)
def test_light_commands_import_nothing_heavy(here, arguments):
    assert modules_after(arguments, here)[:2] == (0, [])


def test_show_prints_valid_task_yaml(in_process, small, here):
    task = small()
    _, shown, _ = in_process("show", task, "rewards.alive.weight=1e-5", 'summary="010"')
    (here / "small" / "again.yaml").write_text(shown)
    code, again, _ = in_process("validate", "small/again.yaml")
    assert (code, again) == (0, "small/again.yaml: valid (files)\n")
    (here / "small" / "task.yaml").write_text(shown)
    assert in_process("show", task)[1] == shown


def test_show_origin(in_process, small):
    task = small()
    _, shown, _ = in_process("show", task, "--origin", "sim.dt=0.02", "--num-envs", "3")
    lines = {line.split(":")[0].strip(): line.partition("# ")[2] for line in shown.splitlines()}
    assert lines["dt"] == "override 'sim.dt=0.02'"
    assert lines["num_envs"] == "--num-envs"
    assert lines["decimation"] == "task.yaml:2:1"
    assert lines["gravity"] == "default"
    origins = json.loads(in_process("show", task, "--origin", "--json")[1])["origins"]
    assert origins["rewards.alive.weight"] == "small/task.yaml:15:27"
    assert origins["sim.gravity"] == "default"


def test_show_play_applies_the_play_patch(in_process):
    config = json.loads(in_process("show", "cartpole", "--play", "--json")[1])["config"]
    assert config["scene"]["num_envs"] == 16


def test_show_schema_has_terms_of_task(in_process, small):
    task = small(terms='def mine(env, *, x: int):\n    """Mine."""\n')
    schema = json.loads(in_process("show", task, "--schema")[1])
    assert schema["$schema"].startswith("https://json-schema.org")
    assert "Mine." in json.dumps(schema["properties"]["rewards"])
    assert json.loads(in_process("show", task, "--schema", "--json")[1])["schema_document"] == schema


@pytest.mark.parametrize("name", ["terms", "task"])
def test_show_schema_of_broken_source_is_config_error(in_process, small, name):
    task = small(**{name: "def f(:\n"})
    code, _, err = in_process("show", task, "--schema")
    assert code == 3
    assert f"{name}.py:1:" in err


def test_validate_accepts_file_folder_and_name(in_process, small, here):
    small()
    for target in ("small/task.yaml", "small", "./small", str(here / "small")):
        assert in_process("validate", target)[0] == 0
    document = json.loads(in_process("validate", "cartpole", "--json")[1])
    assert (document["command"], document["valid"], document["deep"]) == ("validate", True, False)


def test_validate_keeps_class_of_installed_direct_task(in_process):
    from rlcli.registry import find_task

    file = find_task("cartpole-direct").config
    assert in_process("validate", str(file))[0] == 0
    code, _, err = in_process("validate", str(file), "params.reset_dst=1")
    assert code == 3
    assert "did you mean 'reset_dist'?" in err


def test_validate_names_unchecked_agents(in_process, small, monkeypatch):
    monkeypatch.setenv("RLCLI_PLUGINS", "rlcli")
    task = small(
        ("max_iterations: 1}", "max_iterations: 1}\n  other: {trainer: rsl-rl, algorithm: ppo, max_iterations: 1}")
    )
    code, out, err = in_process("validate", task)
    assert (code, "valid" in out) == (0, True)
    assert "other" in err


def test_validate_deep_accepts_built_in_tasks(in_process):
    for name in ("ant-direct", "cartpole", "cartpole-direct"):
        code, out, _ = in_process("validate", name, "--deep")
        assert code == 0
        assert "valid (files and model)" in out


def test_validate_deep_reports_all_problems_at_once(in_process, small):
    overrides = [
        "actions.push.joints=[sldier]",
        "observations.policy.pos.joints=leg_.*",
        'rewards.twice={func: joint_vel_l1, weight: 1, joints: ["h.*", hinge]}',
        'rewards.regex={func: joint_vel_l1, weight: 1, joints: "("}',
        "rewards.who={func: joint_vel_l1, weight: 1, entity: robto}",
        "scene.entities.robot.joints.nope.damping=1",
        "scene.entities.robot.init.joint_pos={knee: 1.0}",
    ]
    task = small()
    assert in_process("validate", task, *overrides)[0] == 0
    code, out, err = in_process("validate", task, "--deep", *overrides, "--json")
    problems = {p["path"]: f"{p['message']} | {p['hint']}" for p in json.loads(out)["error"]["problems"]}
    assert code == 3
    assert "no joint matches 'sldier' | did you mean 'slider'?" in problems["actions.push.joints"]
    assert "no joint matches 'leg_.*' | joints: slider, hinge" in problems["observations.policy.pos.joints"]
    assert "joint 'hinge' is matched twice" in problems["rewards.twice.joints"]
    assert "neither the name of a joint nor a regular expression" in problems["rewards.regex.joints"]
    assert "no entity 'robto' in the scene | did you mean 'robot'?" in problems["rewards.who.entity"]
    assert "no joint matches 'nope'" in problems["scene.entities.robot.joints.nope"]
    assert "no joint matches 'knee'" in problems["scene.entities.robot.init"]
    assert len(problems) == 7
    assert err.count("error: override") == 7


@pytest.mark.parametrize(
    ("model", "override", "message"),
    [
        (None, "", "no file 'model.xml'"),
        ("<mujoco>", "", "'model.xml' is not a valid MJCF"),
        ("not xml", "", "'model.xml' is not a valid MJCF"),
        ("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", "", "no joint matches"),
        (
            "<mujoco><worldbody><body><joint type='slide'/></body></worldbody></mujoco>",
            "actions.push.joints=.*",
            "mass and inertia",
        ),
        ("<mujoco/>", "scene.entities.robot.model=../outside.xml", "lies outside the task's folder"),
        ("<mujoco/>", "scene.entities.robot.model=/etc/passwd", "lies outside the task's folder"),
        ("<mujoco/>", "scene.entities.robot.model=task.yaml", "'task.yaml' is not a valid MJCF"),
    ],
)
def test_validate_deep_of_broken_model(in_process, small, model, override, message):
    code, _, err = in_process("validate", small(model=model), "--deep", *filter(None, [override]))
    assert code == 3
    assert message in err
    assert "Traceback" not in err


def test_validate_deep_accepts_unnamed_elements(in_process, small):
    bare = "<mujoco><worldbody><body><joint type='slide'/><geom size='.1'/></body></worldbody></mujoco>"
    assert in_process("validate", small(("[slider]", "[joint_0]"), model=bare), "--deep")[0] == 0


def test_validate_deep_of_failing_import_is_task_error(in_process, small):
    task = small(("is_alive, weight", "mine, weight"), terms="import no_such_module\ndef mine(env): ...\n")
    assert in_process("validate", task)[0] == 0
    code, _, err = in_process("validate", task, "--deep")
    assert code == 4
    assert "No module named 'no_such_module'" in err


def test_show_prints_chosen_parts(rlcli):
    done = rlcli("show", "cartpole", "rewards.alive", "sim.dt", "sim.dt=0.01", "--json")
    config = json.loads(done.stdout)["config"]
    assert (config["sim"], list(config), list(config["rewards"])) == ({"dt": 0.01}, ["rewards", "sim"], ["alive"])
    wrong = rlcli("show", "cartpole", "rewards.alive.wieght")
    assert (wrong.returncode, "did you mean 'weight'?" in wrong.stderr) == (2, True)


def test_origins_name_each_file_once(rlcli):
    lines = rlcli("show", "cartpole", "rewards", "--origin").stdout.splitlines()
    assert lines[0].startswith("# task.yaml: /")
    assert [line for line in lines[1:] if "/" in line] == []
    assert lines[3].split("# ")[1].startswith("task.yaml:")


def test_check_and_lint_read_a_configuration_file(here, rlcli):
    (here / "more.yaml").write_text("rewards: {alive: {wieght: 2}}\n")
    for command in ("check", "lint"):
        done = rlcli(command, "cartpole", "--config", "more.yaml")
        assert (done.returncode, "more.yaml:1:19" in done.stderr) == (3, True)
