"""`rlcli export --verify`: an exported file controls plain MuJoCo, and errors in the file are found."""

import ast
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rlcli.cli.app import main
from rlcli.deploy import run_policy_files
from rlcli.deploy.closed_loop import open_reference
from rlcli.errors import UsageError
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.policy_ref import Choice
from rlcli.runs.run import open_run
from rlcli.runs.run_ref import find_checkpoint

PUSHED = """
summary: A cart that is pushed, under a randomised mass, asked for a velocity, seen through a history and a delay.
decimation: 2
episode_length_s: 0.5
sim: {dt: 0.01}
scene: {num_envs: 6, entities: {robot: {model: cart.xml, joints: {slide: {kp: 30.0, kv: 2.0}}}}}
commands:
  wanted: {func: wanted, resampling_time_s: [0.1, 0.2]}
actions:
  slide: {func: relative_joint_position, joints: [slide], scale: 0.2}
observations:
  policy:
    pos: {func: joint_pos, history: 3, scale: 2.0, noise: {kind: uniform, low: -0.1, high: 0.1}}
    vel: {func: joint_vel, modifiers: [{kind: integrator}], delay: {steps: [1, 2]}}
    own: {func: doubled}
    before: {func: last_action}
    asked: {func: generated_commands, command: wanted}
events:
  reset: {func: reset_joints_by_offset, mode: reset, position: [-0.2, 0.2], velocity: [-1.0, 1.0]}
  mass: {func: randomize_body_mass, mode: reset, operation: scale, range: [0.5, 2.0]}
  kick: {func: kick, mode: interval, interval_range_s: [0.06, 0.1]}
rewards:
  near: {func: joint_pos_target_l2, weight: -1.0, joints: [slide], target: 0.3}
  alive: {func: is_alive, weight: 0.1}
curriculum:
  dearer: {func: dearer, address: rewards.near.weight}
terminations:
  time_out: {func: time_out, time_out: true}
  far: {func: joint_pos_out_of_manual_limit, joints: [slide], bounds: [-0.9, 0.9]}
agents:
  ppo: {trainer: ppo, algorithm: ppo, max_iterations: 1, num_steps: 4, num_minibatches: 1, rnn: {hidden: 6},
        torch_threads: 1, actor: {hidden: [8]}, critic: {hidden: [8]}, compile: false}
"""
TERMS = '''
"""Terms without a formula."""
import torch

from rlcli.task import Address, Entity, Joints


def doubled(env, *, entity: Entity = "robot", joints: Joints = ".*"):
    """Twice the velocity. (num_envs, k)"""
    return 2.0 * entity.data.joint_vel[:, joints]


def kick(env, selection, *, entity: Entity = "robot"):
    """A push."""
    selection.add(env.engine.field("qvel"), selection.uniform(-2.0, 2.0, (1,)))


def dearer(env, selection, *, address: Address):
    """What an episode costs grows with the episodes before it."""
    address.sub_(0.1)


class wanted:
    """What is asked."""

    def __init__(self, env):
        self.command = torch.zeros(env.num_envs, 2)

    def resample(self, selection):
        selection.write(self.command, selection.uniform(-1.0, 1.0, (2,)))

    def update(self):
        pass
'''
CART = """
<mujoco><worldbody>
  <body name="cart"><joint name="slide" type="slide" axis="1 0 0" damping="0.5"/><geom size="0.1" mass="1"/></body>
</worldbody></mujoco>
"""


def checks(document):
    return {row["check"].partition(":")[0]: row["passed"] for row in document["verified"]["checks"]}


def verify(capfd, run, output, *more, code=0):
    asked = ["export", "--checkpoint", str(run), "--output", str(output), "--verify", "--json", "-q", *more]
    assert main(asked) == code, capfd.readouterr().err
    return json.loads(capfd.readouterr().out)


@pytest.mark.parametrize("label", ["cartpole", "cartpole sac", "cartpole-direct"])
def test_verify_passes_for_each_built_in_task(newest, tmp_path, capfd, label):
    run = newest(label).parent.parent
    more = ("--format", "numpy", "--episodes", "8")
    document = verify(capfd, run, tmp_path / "policy.py", *more)
    verified = document["verified"]
    assert verified["passed"]
    assert verified["episodes"] == 8
    assert verified["closed_by_task"] == []
    assert len(verified["closed_by_metadata"]) == (5 if label == "cartpole-direct" else 3)
    assert verified["return"] == pytest.approx(verified["evaluation_return"], rel=1e-4)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["model.xml", "policy.py", "run_policy.py"]
    assert main(["eval", "--checkpoint", str(run), "--episodes", "8", "--json", "-q"]) == 0
    assert json.loads(capfd.readouterr().out)["return"]["mean"] == pytest.approx(verified["evaluation_return"])


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """Run of a task with histories, an RNN, pushes and commands, and with a term without a formula."""
    folder = tmp_path_factory.mktemp("pushed")
    task = folder / "pushed"
    task.mkdir()
    for name, text in {"task.yaml": PUSHED, "terms.py": TERMS, "cart.xml": CART}.items():
        (task / name).write_text(text)
    assert main(["train", str(task), "--runs-dir", str(folder / "runs"), "--logger", "none", "-q"]) == 0
    return next((folder / "runs" / "pushed").iterdir())


@pytest.mark.slow
def test_verify_covers_histories_rnn_pushes_and_commands(pushed, tmp_path, capfd):
    verified = verify(capfd, pushed, tmp_path / "p.py", "--format", "numpy", "--episodes", "24")["verified"]
    assert verified["passed"]
    assert verified["closed_by_task"] == ["observation own"]
    closed = ["observation pos", "observation vel", "observation before", "observation asked", "control slide"]
    assert verified["closed_by_metadata"] == closed
    assert verified["return"] == pytest.approx(verified["evaluation_return"], abs=1e-4)


OWN = """
import mujoco
import numpy as np
from run_policy import Controller

controller, model = Controller("p.py"), mujoco.MjModel.from_xml_path("model.xml")
data = mujoco.MjData(model)
for _ in range(20):
    inputs = {"command/wanted": np.zeros(2), "observation/own": 2.0 * data.qvel}
    data.ctrl[:] = controller.act(data, inputs)
    mujoco.mj_step(model, data, controller.metadata["decimation"])
    mujoco.mj_step1(model, data)
print(controller.steps, controller.command.shape)
"""


def run_python(folder, *arguments):
    command = [sys.executable, "-B", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


def test_program_names_observation_of_task_code_that_it_needs(pushed, tmp_path, capfd):
    arguments = ["--output", str(tmp_path / "p.py"), "--format", "numpy", "--verify", "--episodes", "2"]
    assert main(["export", "--checkpoint", str(pushed), *arguments]) == 0
    assert capfd.readouterr().err.count("pass inputs['observation/own'] (1 values of one step, with modifiers") == 1
    result = run_python(tmp_path, "run_policy.py")
    assert (result.returncode, result.stdout, result.stderr.count("\n")) == (1, "", 1), result.stderr
    assert (
        "error: run_policy.py cannot compute observation own, which only the task's code computes: pass inputs"
        in result.stderr
    )
    result = run_python(tmp_path, "-c", OWN)
    assert result.stdout == "20 (1,)\n", result.stderr
    result = run_python(tmp_path, "-c", OWN.replace('"observation/own": 2.0', '"observation/own": [1, 2] or 2.0'))
    assert "ValueError: Controller.act needs inputs['observation/own'] (1 values); an observation" in result.stderr


def test_program_names_missing_file(newest, tmp_path, capfd):
    arguments = ["--output", str(tmp_path / "p.py"), "--format", "numpy", "--verify", "--episodes", "2"]
    assert main(["export", "--checkpoint", str(newest("cartpole").parent.parent), *arguments]) == 0
    assert "keep p.py, model.xml and run_policy.py in one folder" in capfd.readouterr().err
    for name in ("model.xml", "p.py"):
        (tmp_path / name).unlink()
        result = run_python(tmp_path, "run_policy.py")
        last = result.stderr.splitlines()[-1]
        assert last.startswith("FileNotFoundError"), result.stderr
        assert str(tmp_path / name) in last


def test_numpy_policy_names_its_columns_for_wrong_shape(newest, tmp_path, capfd):
    file = tmp_path / "p.py"
    asked = ["export", "--checkpoint", str(newest("arm").parent.parent), "--format", "numpy", "--output", str(file)]
    assert main(asked) == 0, capfd.readouterr()
    space = runpy.run_path(str(file))
    needed = re.escape("with 4 columns: rates 3, angle 1")
    with pytest.raises(ValueError, match=r"obs has the shape \(2, 3\), the policy needs \(n, columns\) " + needed):
        space["run"]({"obs": np.zeros((2, 3))})
    with pytest.raises(ValueError, match=r"obs has the shape \(4,\), .*" + needed):
        space["run"]({"obs": np.zeros(4)})
    with pytest.raises(ValueError, match=r"now has the shape \(5,\), the policy needs \(columns,\) " + needed):
        space["Episode"]().step(np.zeros(5))


@pytest.fixture
def copied(newest, tmp_path):
    """Copy of a cartpole run that a test may change."""
    return Path(shutil.copytree(newest("cartpole").parent.parent, tmp_path / "copied"))


def tamper(run, change):
    file = find_checkpoint(str(run), run.parent)[1] / "manifest.json"
    manifest = json.loads(file.read_text())
    change(manifest)
    file.write_text(json.dumps(manifest))


def swap(manifest):
    manifest["deployment"]["observations"]["policy"][0]["value"]["of"][0]["at"] = [1, 0]


def shift(manifest):
    manifest["deployment"]["observations"]["policy"][1]["value"]["of"][1] = [0.0, 0.3]


def weaken(manifest):
    manifest["deployment"]["controls"][0]["value"] = {"op": "mul", "of": [{"given": "command", "at": [0]}, [0.2]]}


@pytest.mark.parametrize(
    ("change", "fails"),
    [(swap, "observation"), (shift, "observation"), (weaken, "control")],
    ids=["swapped columns", "shifted value", "weakened control"],
)
def test_verify_fails_on_wrong_metadata(copied, tmp_path, capfd, change, fails):
    tamper(copied, change)
    document = verify(capfd, copied, tmp_path / "policy.py", "--format", "numpy", "--episodes", "16", code=9)
    assert not document["verified"]["passed"]
    held = checks(document)
    assert not held[fails]
    assert held["action"]


def test_verify_fails_on_wrong_decimation(copied, tmp_path, capfd):
    tamper(copied, lambda manifest: manifest["layout"].update(decimation=8))
    document = verify(capfd, copied, tmp_path / "policy.py", "--format", "numpy", "--episodes", "16", code=9)
    found = checks(document)
    assert found == {"description": False, "action": True, "observation": True, "control": True, "return": False}


ELSEWHERE = {
    "layout.dt": lambda m: m["layout"].update(dt=0.5),
    "layout.actions.0.limits.0.1": lambda m: m["layout"]["actions"][0]["limits"][0].__setitem__(1, 500.0),
    "deployment.joints.0.default": lambda m: m["deployment"]["joints"][0].update(default=0.1),
    "deployment.joints.1.name": lambda m: m["deployment"]["joints"][1].update(name="pole"),
    "deployment.start.qpos.0": lambda m: m["deployment"]["start"]["qpos"].__setitem__(0, 0.5),
    "deployment.controls.0.closed": lambda m: m["deployment"]["controls"][0].update(closed=False),
    "deployment.actuators.0.name": lambda m: m["deployment"]["actuators"][0].update(name="motor"),
}


@pytest.mark.parametrize("place", ELSEWHERE)
def test_verify_fails_on_wrong_robot_description(copied, tmp_path, capfd, place):
    """The differences need not show in the episodes."""
    tamper(copied, ELSEWHERE[place])
    document = verify(capfd, copied, tmp_path / "policy.py", "--format", "numpy", "--episodes", "2", code=9)
    assert not checks(document)["description"]
    assert document["verified"]["unlike"] == [place]


SENSELESS = {
    "a control that is not there": lambda d: d["controls"][0].update(ctrl=[7]),
    "a command that is not there": lambda d: d["controls"][0]["value"].update(at=[7]),
    "a formula that is marked as open": lambda d: d["observations"]["policy"][0].update(closed=False),
    "a control without a formula": lambda d: d["controls"][0].update(value=None),
}


@pytest.mark.parametrize("kind", SENSELESS)
def test_verify_rejects_inconsistent_description(copied, tmp_path, capfd, kind):
    tamper(copied, lambda manifest: SENSELESS[kind](manifest["deployment"]))
    asked = ["export", "--checkpoint", str(copied), "--format", "numpy", "--output", str(tmp_path / "p.py"), "--verify"]
    assert main([*asked, "--episodes", "1"]) == 5


def test_verify_prints_table_of_checks(copied, tmp_path, capfd):
    tamper(copied, swap)
    asked = ["export", "--checkpoint", str(copied), "--output", str(tmp_path / "p.py"), "--format", "numpy"]
    assert main([*asked, "--verify", "--episodes", "4"]) == 9
    out, _ = capfd.readouterr()
    assert "observation: formulas - task" in out
    assert "FAILS" in out


@pytest.mark.parametrize(
    "value",
    ["text", [], {"joints": []}, {"field": "__class__"}, None],
    ids=["text", "list", "half", "class", "null"],
)
def test_export_rejects_invalid_description(copied, tmp_path, capfd, value):
    def change(manifest):
        if isinstance(value, dict) and "field" in value:
            manifest["deployment"]["observations"]["policy"][0]["value"] = {"field": "__class__", "at": [0]}
        else:
            manifest["deployment"] = value

    tamper(copied, change)
    output = tmp_path / "policy.py"
    asked = ["export", "--checkpoint", str(copied), "--format", "numpy", "--output", str(output)]
    if value is None:  # as of a checkpoint of an older version: the file is written, and says less
        assert main(asked) == 0
        return
    assert main(asked) == 5
    assert "deployment" in capfd.readouterr().err
    assert not output.exists()


def test_verify_describes_task_if_checkpoint_has_no_description(copied, tmp_path, capfd):
    tamper(copied, lambda manifest: manifest.pop("deployment"))
    more = ("--format", "numpy", "--episodes", "4")
    assert verify(capfd, copied, tmp_path / "policy.py", *more)["verified"]["passed"]


def test_verify_rejects_formula_with_index_out_of_range(copied, tmp_path, capfd):
    def change(manifest):
        manifest["deployment"]["observations"]["policy"][0]["value"]["of"][0]["at"] = [0, 5000]

    tamper(copied, change)
    asked = ["export", "--checkpoint", str(copied), "--format", "numpy", "--output", str(tmp_path / "p.py"), "--verify"]
    assert main(asked) == 5
    assert "does not fit the model" in capfd.readouterr().err


def test_verify_outside_run_is_usage_error(newest, tmp_path, capfd):
    folder = shutil.copytree(newest("cartpole"), tmp_path / "alone")
    assert main(["export", "--checkpoint", str(folder), "--output", str(tmp_path / "p.onnx"), "--verify"]) == 2
    assert "--verify" in capfd.readouterr().err


def test_verify_keeps_edited_program(newest, tmp_path, capfd):
    own = tmp_path / "run_policy.py"
    own.write_text("raise SystemExit('mine')\n")
    run = newest("cartpole").parent.parent
    asked = ["export", "--checkpoint", str(run), "--output", str(tmp_path / "policy.py"), "--format", "numpy"]
    assert main([*asked, "--verify", "--episodes", "4"]) == 0
    assert own.read_text() == "raise SystemExit('mine')\n"
    assert "is not replaced" in capfd.readouterr().err


def test_verify_does_not_overwrite_user_files(newest, tmp_path, capfd):
    run = newest("cartpole").parent.parent
    asked = ["export", "--checkpoint", str(run), "--format", "numpy", "--verify", "--episodes", "1", "--output"]
    assert main([*asked, str(tmp_path / "run_policy.py")]) == 2
    assert list(tmp_path.iterdir()) == []
    for _ in range(2):  # its own may be replaced
        assert main([*asked, str(tmp_path / "policy.py")]) == 0
    (tmp_path / "model.xml").write_text("<mujoco/>")
    capfd.readouterr()
    assert main([*asked, str(tmp_path / "policy.py")]) == 2
    assert "model.xml" in capfd.readouterr().err
    assert (tmp_path / "model.xml").read_text() == "<mujoco/>"


PROGRAM = """
import sys
sys.modules.update(dict.fromkeys({blocked!r}))
import runpy
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.parametrize("format_", [pytest.param("onnx", marks=pytest.mark.slow), "numpy"])
def test_program_is_short_and_runs_without_rlcli(newest, tmp_path, capfd, format_):
    run, suffix = newest("cartpole").parent.parent, {"onnx": ".onnx", "numpy": ".py"}[format_]
    verify(capfd, run, tmp_path / f"policy{suffix}", "--format", format_, "--episodes", "2")
    file = tmp_path / "run_policy.py"
    assert len(file.read_text().splitlines()) <= 80
    assert max(map(len, file.read_text().splitlines())) <= 120
    blocked = ["rlcli", "rlcli_tasks", "torch", "pydantic", *(["onnxruntime"] if format_ == "numpy" else [])]
    command = [sys.executable, "-B", "-c", PROGRAM.format(blocked=blocked), str(file), "60"]
    result = subprocess.run(command, cwd="/", capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("60 steps, 1.00 s; qpos ")


def test_written_model_equals_trained_model(newest, tmp_path, capfd):
    run = newest("arm").parent.parent
    verify(capfd, run, tmp_path / "policy.py", "--format", "numpy", "--episodes", "2")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    assert [model.actuator(i).name for i in range(model.nu)] == ["robot/m", "robot/p", "robot/w"]
    np.testing.assert_allclose(model.actuator_gainprm[1, 0], 5.0)


def test_model_with_mesh_files_is_written_as_binary(tmp_path):
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "part.obj").write_text(corners)
    text = """<mujoco><asset><mesh name="part" file="part.obj"/></asset><worldbody>
      <body><joint name="turn"/><geom type="mesh" mesh="part"/></body></worldbody></mujoco>"""
    (tmp_path / "source.xml").write_text(text)
    spec = mujoco.MjSpec.from_file(str(tmp_path / "source.xml"))
    folder = tmp_path / "written"
    folder.mkdir()
    model = spec.compile()
    file = run_policy_files.write_model(spec, model, folder)
    assert list(folder.iterdir()) == [file]
    assert file.name == "model.mjb"
    again = run_policy_files.open_model(file)
    assert again.joint(0).name == "turn"
    np.testing.assert_array_equal(again.mesh_vert, model.mesh_vert)


def test_binary_model_is_overwritten_only_beside_program_that_loads_it(tmp_path):
    policy, model, program = (tmp_path / name for name in ("policy.py", "model.mjb", "run_policy.py"))
    model.write_bytes(b"mine")

    def assert_refused():
        with pytest.raises(UsageError, match=r"model\.mjb"):
            run_policy_files.check_overwrites(policy)

    assert_refused()
    program.write_text('import mujoco\nmujoco.MjModel.from_binary_path("model.mjb")\n')
    assert_refused()
    program.write_text(run_policy_files.generate_program(policy, tmp_path / "model.xml", "numpy", {"deployment": None}))
    assert_refused()
    for format_ in ("numpy", "onnx", "torch"):
        program.write_text(run_policy_files.generate_program(policy, model, format_, {"deployment": None}))
        run_policy_files.check_overwrites(policy)
    assert model.read_bytes() == b"mine"


@pytest.mark.slow
def test_program_needs_only_numpy_onnxruntime_and_mujoco(newest, tmp_path, capfd):
    verify(capfd, newest("cartpole").parent.parent, tmp_path / "policy.onnx", "--episodes", "2")
    venv.create(tmp_path / "bare", with_pip=True)
    python = next(path for name in ("bin/python", "Scripts/python.exe") if (path := tmp_path / "bare" / name).exists())
    constraints = Path(__file__).parents[2] / "constraints.txt"
    install = [python, "-m", "pip", "install", "-q", "-c", constraints, "numpy", "onnxruntime", "mujoco"]
    subprocess.run(install, check=True, timeout=600)
    bare = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    asked = [python, tmp_path / "run_policy.py"]
    result = subprocess.run(asked, cwd=tmp_path, env=bare, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("300 steps, 5.00 s; qpos ")


def test_names_of_inputs_stay_literals_in_generated_program():
    name = '"model.xml" \'policy.onnx\' "policy.onnx"'
    term = {"name": name, "closed": False, "columns": [0, 2], "history": 1, "value": {"given": f"observation/{name}"}}
    metadata = {"deployment": {"commands": [], "observations": [term], "controls": []}}
    program = run_policy_files.generate_program(Path("p.onnx"), Path("model.xml"), "onnx", metadata)
    texts = [node.value for node in ast.walk(ast.parse(program)) if isinstance(node, ast.Constant)]
    assert f"observation/{name}" in texts
    assert any(str(text).startswith(f"error: run_policy.py cannot compute observation {name}") for text in texts)


def test_verify_builds_no_more_environments_than_episodes(pushed):
    folder = find_checkpoint(str(pushed), pushed.parent)[1]
    choice = Choice(folder, "as named", open_run(pushed), None)
    sizes = [open_reference(choice, open_checkpoint(folder), None, n).env.num_envs for n in (1, 3, 64)]
    assert sizes == [2, 3, 6]  # the run has 6; with one, random values would look like constants


def test_progress_of_verify_names_its_phases_and_never_decreases(newest, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr("rlcli.cli.ui.progress_view._WORK_LINE_EVERY_S", 0.02)
    run = newest("cartpole").parent.parent
    arguments = ["export", "--checkpoint", str(run), "--output", str(tmp_path / "policy.py"), "--format", "numpy"]
    assert main([*arguments, "--verify", "--episodes", "8"]) == 0
    lines = [line for line in capfd.readouterr().err.splitlines() if " of 3: " in line]
    phases = [re.search(r"(\d of 3: [\w ]+)", line)[1] for line in lines]
    assert list(dict.fromkeys(phases)) == ["1 of 3: evaluation", "2 of 3: plain MuJoCo"]
    shares = [int(found[1]) for line in lines if (found := re.search(r" (\d+)%", line))]
    assert shares == sorted(shares)
    assert 33 < shares[-1] <= 67


def test_export_without_verify_says_nothing_about_the_program_it_does_not_write(pushed, tmp_path, capfd):
    arguments = ["export", "--checkpoint", str(pushed), "--format", "numpy"]
    assert main([*arguments, "--output", str(tmp_path / "a" / "policy.py")]) == 0
    assert "run_policy.py" not in capfd.readouterr().err
    assert main([*arguments, "--output", str(tmp_path / "b" / "policy.py"), "--verify", "--episodes", "2"]) == 0
    assert "run_policy.py cannot compute observation own" in capfd.readouterr().err
