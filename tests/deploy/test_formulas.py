"""Formulas compared with their terms: computed by the exported program, with numpy, from an MjData."""

import copy
import functools
import json

import mujoco
import numpy as np
import pytest
import torch

from rlcli.config.load import resolve
from rlcli.config.term_signatures import builtin_terms
from rlcli.deploy import formulas
from rlcli.deploy.deployed.run_policy import OPS, Controller
from rlcli.deploy.env_description import describe
from rlcli.envs.make import make_env
from rlcli.registry import folder_task
from rlcli.runs.layout_and_deployment import OPS as KNOWN
from rlcli.runs.layout_and_deployment import DeploymentRecord, check_formula

WALKER = """
<mujoco>
  <worldbody>
    <body name="trunk" pos="0 0 1">
      <freejoint/><geom size="0.2 0.1 0.05" pos="0.05 0.02 0" type="box"/><site name="imu" quat="0.9 0.1 0.3 0.2"/>
      <body name="leg" pos="0.2 0 0">
        <joint name="hip" axis="0 1 0" range="-0.6 1.2" limited="true"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/><site name="foot" pos="0 0 -0.3" euler="0 30 20"/>
        <body name="shin" pos="0 0 -0.3">
          <joint name="knee" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.1 0 -0.3" size="0.03"/>
        </body>
      </body>
    </body>
  </worldbody>
  <sensor>
    <gyro name="gyro" site="imu"/><accelerometer name="acc" site="imu"/>
    <framequat name="quat" objtype="site" objname="imu"/>
  </sensor>
</mujoco>
"""
BALL = """
<mujoco><worldbody><body name="ball" pos="0.5 0.2 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>
"""
YAML = """
summary: A walker beside a ball.
decimation: 2
episode_length_s: 1.0
sim: {dt: 0.005}
scene:
  num_envs: 3
  entities:
    robot:
      model: walker.xml
      velocity_point: com
      init: {joint_pos: {knee: 0.4}, joint_vel: {hip: 0.5}}
      joints: {knee: {kp: 20.0, kv: 1.0}, hip: {kp: 30.0, kv: 1.0}}
    object: {model: ball.xml}
commands:
  velocity: {func: uniform_velocity, lin_vel_x: [-1.0, 1.0], ang_vel_z: [-1.0, 1.0], resampling_time_s: [0.02, 0.05]}
actions:
  knee: {func: joint_position, joints: [knee], scale: 0.5, offset: 0.2}
  hip: {func: relative_joint_position, joints: [hip], scale: 0.3, clip: [-0.5, 0.5]}
observations:
  policy:
    enable_corruption: false
TERMS
events:
  joints: {func: reset_joints_by_offset, mode: reset, position: [-0.3, 0.3], velocity: [-2.0, 2.0]}
rewards:
  calm: {func: joint_vel_l1, weight: -1.0}
terminations:
  time_out: {func: time_out, time_out: true}
"""
TERMS = {
    "joint_pos": "joints: [knee, hip]",
    "joint_vel": "",
    "joint_pos_rel": "",
    "joint_vel_rel": "",
    "joint_angle": "joints: [knee, hip]",
    "joint_angle_sum": "joints: [knee, hip]",
    "joint_pos_limit_normalized": "",
    "joint_effort": "",
    "base_pos_z": "",
    "base_lin_vel": "",
    "base_ang_vel": "",
    "projected_gravity": "",
    "root_pos_w": "",
    "root_quat_w": "make_quat_unique: true",
    "root_lin_vel_w": "",
    "root_ang_vel_w": "",
    "base_yaw_roll": "",
    "base_roll_pitch": "",
    "base_up_proj": "",
    "base_heading_proj": "target: [3.0, -2.0, 0.0]",
    "base_angle_to_target": "target: [3.0, -2.0, 0.0]",
    "body_pose_w": "bodies: [shin, leg]",
    "body_projected_gravity_b": "bodies: [shin, trunk]",
    "body_state_b": "bodies: [leg, shin]",
    "last_action": "",
    "generated_commands": "command: velocity",
    "body_to_goal": "bodies: [shin], command: velocity, columns: [2, 0]",
    "current_time_s": "",
    "remaining_time_s": "",
    "sensor_data": "sensors: [gyro, quat]",
    "imu_orientation": "sensors: [quat]",
    "imu_projected_gravity": "sensors: [quat]",
    "imu_ang_vel": "sensors: [gyro]",
    "imu_lin_acc": "sensors: [acc]",
    "foot_height": "sites: [foot, imu]",
    "ee_pos": "sites: [foot]",
    "ee_quat": "sites: [foot, imu]",
    "ee_velocity": "sites: [foot, imu]",
    "object_position_in_robot_root_frame": "",
    "object_quat_b": "",
    "rel_ee_object_distance": "sites: [foot]",
    "ee_to_object_distance": "sites: [foot]",
}
PREPARED = {
    "scaled": "{func: joint_vel, joints: [hip, knee], clip: [-1.0, 0.5], scale: [2.0, 3.0]}",
    "long": "{func: joint_vel, history: 3}",
    "modified": "{func: joint_pos, history: 2, modifiers: [{kind: bias, offset: 0.5}, {kind: scale, factor: [2, 3]},"
    " {kind: clip, bounds: [-1.0, 1.5]}]}",
    "filtered": "{func: joint_vel, modifiers: [{kind: digital_filter, b: [0.2, 0.3, 0.1], a: [-0.5, 0.1]}]}",
    "fed_forward": "{func: joint_vel, modifiers: [{kind: digital_filter, b: [0.7, 0.3]}]}",
    "integrated": "{func: joint_vel, modifiers: [{kind: integrator}]}",
    "of_the_origin": "{func: base_lin_vel, entity: object}",
}


@pytest.fixture(scope="module")
def walker(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walker")
    (folder / "walker.xml").write_text(WALKER)
    (folder / "ball.xml").write_text(BALL)
    lines = [f"    {name}: {{func: {name}{', ' if given else ''}{given}}}" for name, given in TERMS.items()]
    lines += [f"    {name}: {term}" for name, term in PREPARED.items()]
    (folder / "task.yaml").write_text(YAML.replace("TERMS", "\n".join(lines)))
    return folder


@pytest.fixture(scope="module")
def trajectories(walker):
    """Values of the environment and of the formulas in each step of several episodes: name -> two lists of rows."""
    torch.set_num_threads(1)
    env = make_env(resolve(folder_task(walker, "task.yaml")), seed=5)
    plan = json.loads(json.dumps(describe(env)))
    DeploymentRecord.model_validate(plan)
    about = {
        "deployment": {**plan, "observations": plan["observations"]["policy"]},
        "outputs": {"action": {"shape": ["batch", 2]}},
        "memory": [],
    }
    controllers = [controller_of(about) for _ in range(env.num_envs)]
    command = env.command_manager.get_command("velocity")
    seen = {term["name"]: ([], []) for term in about["deployment"]["observations"]}
    controls = ([], [])
    obs = env.reset()["policy"]
    generator = torch.Generator().manual_seed(1)
    for _ in range(230):
        action = torch.randn(env.num_envs, 2, generator=generator)
        wanted = []
        for i, controller in enumerate(controllers):
            _, data = env.world(i)
            data.sensordata[:] = env.engine.field("sensordata")[i]  # a forward pass computes forces anew
            data.qfrc_actuator[:] = env.engine.field("qfrc_actuator")[i]
            if int(env.episode_length_buf[i]) == 0:
                controller.reset()
            controller.policy = functools.partial(answer, action[i])
            wanted.append(controller.act(data, {"command/velocity": command[i].numpy()}))
            for term in about["deployment"]["observations"]:
                columns = slice(*term["columns"])
                seen[term["name"]][0].append(obs[i, columns].numpy().copy())
                seen[term["name"]][1].append(controller.obs[columns])
        obs = env.step(action).obs["policy"]
        running = (env.episode_length_buf > 0).numpy()
        controls[0].append(env.engine.field("ctrl").numpy()[running])
        controls[1].append(np.stack(wanted)[running])
    env.close()
    assert all(term["closed"] for term in about["deployment"]["observations"])
    return seen, controls


def controller_of(about):
    controller = copy.copy(Controller.__new__(Controller))
    controller.metadata, controller.plan = about, about["deployment"]
    ranges = [actuator["range"] or (-np.inf, np.inf) for actuator in controller.plan["actuators"]]
    controller.bounds = np.reshape(ranges, (-1, 2)).T
    controller.reset()
    return controller


def answer(action, inputs):
    """Return the outputs of a policy file for the walker: its knee has an affine term, its hip another one."""
    command = torch.stack([action[0] * 0.5 + (0.4 + 0.2), action[1]])
    return {"action": action[None].numpy(), "command": command[None].numpy()}


@pytest.mark.parametrize("name", [*TERMS, *PREPARED])
def test_observation_formula_equals_term(trajectories, name):
    expected, found = (np.stack(rows) for rows in trajectories[0][name])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-5)
    if name != "joint_effort":
        assert len(np.unique(expected.round(4), axis=0)) > 2  # a constant would agree with much


def test_action_formulas_equal_environment_controls(trajectories):
    expected, found = (np.concatenate(rows) for rows in trajectories[1])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    assert len(np.unique(expected[:, 0])) > 50


def test_all_mjdata_observation_terms_have_formulas():
    ours = set(builtin_terms("observations"))
    without = {  # contacts, rays, pictures and memories of the environment's own
        "height_scan", "foot_air_time", "foot_contact", "foot_contact_forces", "fingers_contact_force_b",
        "body_incoming_wrench", "rel_ee_drawer_distance", "object_to_goal_distance", "goal_quat_diff", "image",
    }  # fmt: skip
    known = set(formulas._OBSERVATIONS)
    assert {name for name in ours if name not in known} <= without | aliases(ours, known)
    assert set(TERMS) >= known - {"ee_frame_pos"}


def aliases(ours, known):
    """Return the names in YAML whose function has another name."""
    return {name for name in ours if builtin_terms("observations")[name].attribute in known}


def test_program_and_reader_have_same_operations():
    assert set(OPS) | {"filter"} == set(KNOWN)


@pytest.mark.parametrize(
    "value",
    [
        {"field": "__class__", "at": [0]},
        {"field": "qpos", "at": [-1]},
        {"field": "qpos", "at": [True]},
        {"field": "qpos"},
        {"given": "secrets"},
        {"op": "system", "of": [[1.0]]},
        {"op": "add", "of": [[1.0]]},
        {"op": "add", "of": [[1.0], "x"]},
        {"op": ["add"], "of": [[1.0], [1.0]]},
        {"op": "filter", "of": [[1.0]], "b": [], "a": [], "key": "x"},
        [None],
        "qpos",
        None,
    ],
)
def test_invalid_formula_is_rejected(value):
    with pytest.raises(ValueError, match=r"."):
        check_formula(value)


def test_terrain_and_own_gravity_have_no_formula(walker):
    text = (walker / "task.yaml").read_text()
    terrain = "  terrain: {kind: generator, rows: 1, columns: 1, sub_terrains: {flat: {kind: flat}}}\n"
    (walker / "hilly.yaml").write_text(text.replace("scene:\n", f"scene:\n{terrain}"))
    env = make_env(resolve(folder_task(walker, "hilly.yaml"), overrides=["scene.num_envs=2"]))
    closed = {term["name"]: term["closed"] for term in describe(env)["observations"]["policy"]}
    assert not closed["root_pos_w"]
    assert closed["root_quat_w"]
    env.engine.expand("opt.gravity")
    closed = {term["name"]: term["closed"] for term in describe(env)["observations"]["policy"]}
    assert not closed["projected_gravity"]
    assert closed["joint_pos"]
    env.close()


def test_mj_step1_updates_derived_fields():
    model = mujoco.MjModel.from_xml_string(WALKER)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 3)
    stale = data.xpos.copy()
    mujoco.mj_step1(model, data)
    assert not np.array_equal(stale, data.xpos)
