"""Export of policies for robots with actuator models: the deployed program computes them in every physics step."""

import json
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import torch
import yaml
from support.worlds import CRITTER, CRITTER_TASK, build, dump

from rlcli.cli.app import main
from rlcli.deploy import run_policy_files
from rlcli.deploy.env_description import describe

LEGS = """
summary: Legs with a DC motor, ideal PD controllers, and one actuator of MuJoCo.
episode_length_s: 0.4
scene:
  num_envs: 4
  entities:
    robot:
      model: critter.xml
      joints: {hip_br: {actuator: position, kp: 20.0, kv: 0.5}}
      actuators:
        motor: {joints: [hip_fl], kind: dc_motor, stiffness: 20.0, damping: 0.5, effort_limit: 3.0,
                saturation_effort: 4.0, velocity_limit: 8.0}
        pd: {joints: [hip_bl, hip_fr], stiffness: {hip_bl: 15.0, hip_fr: 25.0}, damping: 0.4}
      init: {joint_pos: {"hip_.l": 0.1, "hip_.r": -0.1}}
actions:
  legs: {func: joint_position, joints: [hip_br, hip_fl, hip_bl], scale: 1.5}
  push: {func: joint_effort, joints: [hip_fl], scale: 0.5}
observations:
  policy: {pos: {func: joint_pos}, vel: {func: joint_vel}, before: {func: last_action}}
events:
  reset: {func: reset_joints_by_offset, mode: reset, position: [-0.2, 0.2], velocity: [-6.0, 6.0]}
rewards: {slow: {func: joint_vel_l2, weight: -0.01}}
terminations: {time_out: {func: time_out, time_out: true}}
agents:
  ppo: {trainer: ppo, algorithm: ppo, max_iterations: 1, num_steps: 4, num_minibatches: 1, torch_threads: 1,
        actor: {hidden: [8]}, critic: {hidden: [8]}, compile: false}
"""
TASK = dump(yaml.safe_load(CRITTER_TASK) | yaml.safe_load(LEGS))
GAINS = {"func": "randomize_pd_gains", "mode": "reset", "joints": ["hip_fl"], "stiffness": [0.5, 2.0]}


def changed(**gains_or_delay):
    """Return the task with other settings of the motor, or with random gains."""
    task = yaml.safe_load(TASK)
    if "event" in gains_or_delay:
        task["events"]["gains"] = gains_or_delay["event"]
    task["scene"]["entities"]["robot"]["actuators"]["motor"].update(gains_or_delay.get("motor", {}))
    return dump(task)


def folder_of(tmp_path, text):
    folder = tmp_path / "legs"
    folder.mkdir()
    (folder / "task.yaml").write_text(text)
    (folder / "critter.xml").write_text(CRITTER)
    return folder


def export(tmp_path, capfd, text):
    """Train one iteration, export and verify; return the document of the export and what it prints."""
    folder = folder_of(tmp_path, text)
    assert main(["train", str(folder), "--runs-dir", str(tmp_path / "runs"), "--logger", "none", "-q"]) == 0
    capfd.readouterr()
    (run,) = (tmp_path / "runs" / "legs").iterdir()
    words = ["export", "--checkpoint", str(run), "--format", "numpy", "--verify", "--json"]
    assert main([*words, "--output", str(tmp_path / "policy.py"), "--episodes", "4"]) == 0, capfd.readouterr().err
    out, err = capfd.readouterr()
    return json.loads(out), err


def test_program_computes_actuator_models(tmp_path, capfd):
    document, _ = export(tmp_path, capfd, TASK)
    verified, metadata = document["verified"], document["metadata"]
    assert verified["passed"]
    assert verified["closed_by_task"] == []
    assert {"actuator robot.motor", "actuator robot.pd"} <= set(verified["closed_by_metadata"])
    assert verified["return"] == pytest.approx(verified["evaluation_return"], rel=1e-4)
    legs, push = metadata["actions"]
    assert [legs["command"], push["command"]] == ["actuator model", "actuator model"]
    assert [legs["unit"], push["unit"]] == ["m or rad", "N or N m"]
    motor, pd = metadata["deployment"]["actuator_models"]
    assert (motor["effort_limit"], motor["saturation_effort"], motor["velocity_limit"]) == ([3.0], 4.0, [8.0])
    assert (pd["joints"], pd["stiffness"], pd["effort_limit"]) == (["hip_bl", "hip_fr"], [15.0, 25.0], [None, None])
    done = subprocess.run(
        [sys.executable, "run_policy.py", "20"], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.startswith("20 steps, 0.40 s; qpos "), done.stderr


def test_controls_held_for_a_whole_step_are_an_error(tmp_path, capfd):
    export(tmp_path, capfd, TASK)
    code = (
        "import mujoco; from run_policy import Controller\n"
        "c, m = Controller('policy.py'), mujoco.MjModel.from_xml_path('model.xml'); d = mujoco.MjData(m)\n"
        "for _ in range(2):\n    d.ctrl[:] = c.act(d, {})\n    mujoco.mj_step(m, d, 4)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert "call Controller.controls before every physics step" in done.stderr
    assert "robot.motor, robot.pd" in done.stderr


@pytest.mark.parametrize(
    ("change", "term"),
    [
        ({"event": GAINS}, "actuator robot.motor"),
        ({"motor": {"delay": [0, 2]}}, "actuator robot.motor"),
    ],
    ids=["random gains", "delay"],
)
def test_verification_names_actuator_models_that_the_task_computes(tmp_path, capfd, change, term):
    document, printed = export(tmp_path, capfd, changed(**change))
    assert document["verified"]["passed"]
    assert document["verified"]["closed_by_task"] == [term]
    assert "actuator robot.pd" in document["verified"]["closed_by_metadata"]
    if "motor" in change:
        assert "cannot compute the actuator model robot.motor (its targets are delayed)" in printed


def test_wrong_formula_of_an_actuator_model_fails_the_verification(tmp_path, capfd):
    export(tmp_path, capfd, TASK)
    manifest = max((tmp_path / "runs").rglob("checkpoints/0*/manifest.json"))
    content = json.loads(manifest.read_text())
    (model,) = (m for m in content["deployment"]["actuator_models"] if m["name"] == "robot.pd")
    model["value"]["of"][0] = {"op": "mul", "of": [[0.9, 0.9], model["value"]["of"][0]]}
    manifest.write_text(json.dumps(content))
    words = ["export", "--checkpoint", str(manifest.parents[2]), "--format", "numpy", "--verify"]
    assert main([*words, "--output", str(tmp_path / "policy.py"), "--episodes", "4"]) == 9
    assert any("control" in line and "FAILS" in line for line in capfd.readouterr().out.splitlines())


def test_formula_equals_actuator_model_for_random_states_and_targets(tmp_path):
    env = build(folder_of(tmp_path, TASK))
    env.reset(seed=1)
    plan, rng = describe(env), np.random.default_rng(3)
    space = {"__name__": "template"}
    source = (run_policy_files._TEMPLATE).read_text().replace("import onnxruntime\n", "")
    exec(compile(source, "run_policy.py", "exec"), space)
    value = space["Controller"].__new__(space["Controller"]).value
    for _ in range(50):
        qpos, qvel = rng.normal(size=(4, env.engine.model.nq)), 8.0 * rng.normal(size=(4, env.engine.model.nv))
        env.engine.field("qpos")[:] = torch.from_numpy(qpos)
        env.engine.field("qvel")[:] = torch.from_numpy(qvel)
        action = torch.from_numpy(rng.normal(size=(4, 4))).float()
        env.action_manager.process(action)
        env.compute_efforts()
        for i in range(4):
            data = mujoco.MjData(env.engine.model)
            data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
            commands = [term.instance.command[i].numpy() for term in env.action_manager.terms]
            targets = {f"target/{t.name}": c for t, c in zip(env.action_manager.terms, commands, strict=True)}
            for model in plan["actuator_models"]:
                found = value(model["value"], data, targets)
                np.testing.assert_allclose(found, env.engine.field("ctrl")[i, model["ctrl"]], rtol=1e-5, atol=1e-5)
