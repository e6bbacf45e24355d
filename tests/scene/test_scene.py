"""Tests of scenes: the compiled model has the settings of the configuration."""

import math
import os
import re
import warnings

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import CRITTER, PENDULUM, PENDULUM_TASK, build, edited, write

from rlcli.errors import ConfigError, MissingModelError, TaskError
from rlcli.registry.models import model_file

ARM = """
<mujoco model="arm">
  <compiler autolimits="true"/>
  <option integrator="implicitfast" iterations="7"/>
  <size memory="20M"/>
  <worldbody>
    <body name="base">
      <geom size="0.05" mass="1" contype="0" conaffinity="0"/>
      <body name="upper"><joint name="shoulder" axis="0 1 0" range="-90 90" damping="0.3"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1" contype="0" conaffinity="0"/>
        <body name="ball" pos="0 0 -0.3"><joint name="wrist" type="ball"/>
          <geom size="0.03" mass="0.2" contype="0" conaffinity="0"/>
          <body name="lower"><joint name="elbow" axis="0 1 0" ref="10"/>
            <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5" contype="0" conaffinity="0"/>
            <site name="tip" pos="0 0 -0.3"/>
          </body></body></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder" gear="50" ctrlrange="-1 1"/>
    <position joint="elbow" kp="10" kv="1" gear="2"/>
  </actuator>
  <sensor><jointpos name="angle" joint="elbow"/></sensor>
  <keyframe><key name="home" qpos="0.1 1 0 0 0 0.2"/></keyframe>
</mujoco>
"""

ARM_ACTIONS = {"torque": {"func": "joint_effort", "joints": ["shoulder"], "scale": 20.0}}
ARM_TASK = edited(PENDULUM_TASK, scene={"entities": {"robot": {"model": "arm.xml"}}}, actions=ARM_ACTIONS)


def arm(tmp_path, xml=ARM, robot=None, **changes):
    scene = {"entities": {"robot": {"model": "arm.xml", **(robot or {})}}}
    return write(tmp_path / "arm", edited(edited(ARM_TASK, scene=scene), **changes), arm_xml=xml)


def model_of(tmp_path, **kwargs):
    return build(arm(tmp_path, **kwargs)).engine.model


def joint(model, name):
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)


def dof(model, name):
    return int(model.jnt_dofadr[joint(model, name)])


def test_joint_overrides_change_only_named_joints(tmp_path):
    model = model_of(tmp_path, robot={"joints": {
        "elbow": {"damping": 2.0, "stiffness": 3.0, "armature": 0.4, "friction_loss": 0.5},
    }})  # fmt: skip
    e, s = joint(model, "robot/elbow"), joint(model, "robot/shoulder")
    d = dof(model, "robot/elbow")
    assert np.ravel(model.dof_damping[d])[0] == 2.0
    assert np.ravel(model.jnt_stiffness[e])[0] == 3.0
    assert model.dof_armature[d] == 0.4
    assert model.dof_frictionloss[d] == 0.5
    assert np.ravel(model.dof_damping[dof(model, "robot/shoulder")])[0] == 0.3
    assert np.ravel(model.jnt_stiffness[s])[0] == 0.0


@pytest.mark.parametrize("gravity", [[0.0, 0.0, -9.81], [0.0, 0.0, 0.0]])
def test_gravity_that_the_mjcf_turns_off_is_reported(tmp_path, caplog, gravity):
    xml = ARM.replace(
        '<option integrator="implicitfast" iterations="7"/>', '<option><flag gravity="disable"/></option>'
    )
    model_of(tmp_path, xml=xml, sim={"gravity": gravity})
    said = any("sim.gravity has no effect" in record.getMessage() for record in caplog.records)
    assert said == any(gravity)


def test_joint_overrides_merge_keys_and_later_pattern_wins(tmp_path):
    model = model_of(tmp_path, robot={"joints": {".*": {"damping": 1.0, "armature": 0.1}, "elbow": {"damping": 5.0}}})
    assert np.ravel(model.dof_damping[dof(model, "robot/shoulder")])[0] == 1.0
    assert np.ravel(model.dof_damping[dof(model, "robot/elbow")])[0] == 5.0
    assert model.dof_armature[dof(model, "robot/elbow")] == 0.1


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_joint_range_is_in_rad_for_any_mjcf_unit(tmp_path, angle):
    xml = ARM.replace("<compiler ", f'<compiler angle="{angle}" ').replace("-90 90", "-1.5 1.5").replace("10", "0.1")
    model = model_of(tmp_path, xml=xml, robot={"joints": {"shoulder": {"range": [-0.5, 0.25]}}})
    assert model.jnt_range[joint(model, "robot/shoulder")].tolist() == pytest.approx([-0.5, 0.25])


def test_slide_joint_range_is_in_m(tmp_path):
    xml = ARM.replace('name="shoulder" axis="0 1 0" range="-90 90"', 'name="shoulder" type="slide" range="-1 1"')
    model = model_of(tmp_path, xml=xml, robot={"joints": {"shoulder": {"range": [-0.5, 0.25]}}})
    assert model.jnt_range[joint(model, "robot/shoulder")].tolist() == [-0.5, 0.25]
    assert model.jnt_limited[joint(model, "robot/shoulder")]


def largest_force(env, column):
    """Return the magnitude of the joint force for a huge effort action."""
    env.reset()
    env.step(torch.full((env.num_envs, 1), 1e6))
    force = env.engine.field("qfrc_actuator")
    env.step(torch.full((env.num_envs, 1), 1e6))
    return float(force[0, column])


def test_effort_limit_applies_after_gear_of_existing_actuator(tmp_path):
    xml = ARM.replace(' ctrlrange="-1 1"', "")
    env = build(arm(tmp_path, xml=xml, robot={"joints": {"shoulder": {"effort_limit": 12.0}}}))
    assert largest_force(env, dof(env.engine.model, "robot/shoulder")) == pytest.approx(12.0)


def test_effort_limit_applies_to_added_actuator(tmp_path):
    xml = ARM.replace('<position joint="elbow" kp="10" kv="1" gear="2"/>', "")
    env = build(arm(tmp_path, xml=xml, robot={"joints": {"elbow": {"effort_limit": 3.0}}},
                    actions={"torque": {"func": "joint_effort", "joints": ["elbow"]}}))  # fmt: skip
    assert largest_force(env, dof(env.engine.model, "robot/elbow")) == pytest.approx(3.0)


@pytest.mark.parametrize("gear", [1, 50, -4])
def test_joint_effort_is_action_times_scale_for_any_gear(tmp_path, gear):
    env = build(arm(tmp_path, xml=ARM.replace('gear="50" ctrlrange="-1 1"', f'gear="{gear}"')))
    env.reset()
    force = env.engine.field("qfrc_actuator")
    env.step(torch.tensor([[0.3], [-0.2], [0.0]]))
    column = dof(env.engine.model, "robot/shoulder")
    assert force[:, column].tolist() == pytest.approx([6.0, -4.0, 0.0], rel=1e-6)


def test_mjcf_control_range_limits_effort(tmp_path):
    env = build(arm(tmp_path))
    env.reset()
    force = env.engine.field("qfrc_actuator")
    env.step(torch.full((3, 1), 1e6))
    assert float(force[0, dof(env.engine.model, "robot/shoulder")]) == pytest.approx(50.0)


def test_actuators_are_added_only_if_missing(tmp_path):
    both = {"torque": {"func": "joint_effort", "joints": ["shoulder", "elbow"]}}
    model = model_of(tmp_path, actions=both)
    drives = [int(j) for j in model.actuator_trnid[:, 0]]
    s, e = joint(model, "robot/shoulder"), joint(model, "robot/elbow")
    assert sorted(drives) == sorted([s, e, e])  # motor of the shoulder; servo and added motor of the elbow
    assert model_of(tmp_path).nu == 2


def test_unnamed_mjcf_actuator_is_used(tmp_path):
    env = build(arm(tmp_path, xml=ARM.replace('name="shoulder_motor" ', "")))
    assert env.engine.model.nu == 2
    assert env.layout.actions[0].elements == ("shoulder",)


def test_added_actuators_have_configured_gains(tmp_path):
    env = build(arm(tmp_path, robot={"joints": {"shoulder": {"kp": 30.0, "kv": 2.0, "actuator": "position"},
                                               "elbow": {"kv": 4.0, "actuator": "velocity"}}}))  # fmt: skip
    model = env.engine.model
    entity = env.entities["robot"]
    (column, a), *_ = entity.actuators_of("position")
    assert column == 0
    assert (model.actuator_gainprm[a, 0], *model.actuator_biasprm[a, 1:3]) == (30.0, -30.0, -2.0)
    ((column, a),) = entity.actuators_of("velocity")
    assert column == 1
    assert (model.actuator_gainprm[a, 0], *model.actuator_biasprm[a, 1:3]) == (4.0, 0.0, -4.0)


def test_task_overrides_gains_of_existing_actuator(tmp_path):
    env = build(arm(tmp_path, robot={"joints": {"elbow": {"kp": 25.0, "kv": 3.0}}}))
    ((_, a),) = env.entities["robot"].actuators_of("position")
    model = env.engine.model
    assert (model.actuator_gainprm[a, 0], *model.actuator_biasprm[a, 1:3]) == (25.0, -25.0, -3.0)


def test_position_target_is_joint_position_for_any_gear(tmp_path):
    env = build(arm(tmp_path, sim={"gravity": [0.0, 0.0, 0.0]}, episode_length_s=100.0,
                    actions={"torque": {"func": "joint_position", "joints": ["elbow"], "use_default_offset": False}},
                    robot={"joints": {".*": {"damping": 1.0}}}))  # fmt: skip
    env.reset()
    for _ in range(400):
        env.step(torch.full((3, 1), 0.6))
    assert env.entities["robot"].data.joint_pos[:, 1].tolist() == pytest.approx([0.6] * 3, abs=0.01)


def test_position_actuator_without_gain_raises_config_error(tmp_path):
    with pytest.raises(ConfigError, match=r"scene.entities.robot.joints: joint 'shoulder' needs a position actuator"):
        build(arm(tmp_path, actions={"t": {"func": "joint_position", "joints": ["shoulder"]}}))


def test_two_entities_of_one_model_are_independent(tmp_path):
    entities = {
        "left": {"model": "arm.xml", "pos": [0.0, 1.0, 0.0], "init": {"joint_pos": {"elbow": 0.3}}},
        "right": {"model": "arm.xml", "pos": [0.0, -1.0, 0.0], "joints": {"elbow": {"damping": 9.0}}},
    }
    data = edited(
        ARM_TASK,
        scene={"entities": entities},
        actions={"torque": {"func": "joint_effort", "entity": "right", "joints": ["shoulder"]}},
        observations={
            "policy": {"l": {"func": "joint_pos", "entity": "left"}, "r": {"func": "joint_pos", "entity": "right"}}
        },
        rewards={"alive": {"func": "is_alive", "weight": 1.0}},
    )
    env = build(write(tmp_path / "arms", data, arm_xml=ARM))
    model = env.engine.model
    left, right = env.entities["left"], env.entities["right"]
    assert left.joint_names == right.joint_names == ["shoulder", "elbow"]
    assert model.body("left/base").pos.tolist() == [0, 1, 0]
    assert model.body("right/base").pos.tolist() == [0, -1, 0]
    assert np.ravel(model.dof_damping[dof(model, "left/elbow")])[0] == 0.0
    assert np.ravel(model.dof_damping[dof(model, "right/elbow")])[0] == 9.0
    obs = env.reset()["policy"]
    ref = math.radians(10)
    assert obs[0].tolist() == pytest.approx([0.0, 0.3, 0.0, ref])
    env.step(torch.ones(3, 1))
    assert not torch.equal(left.data.joint_vel, right.data.joint_vel)
    assert len(set(left.actuator_ids.tolist()) & set(right.actuator_ids.tolist())) == 0
    assert left.data.root_pos_w[0].tolist() == [0, 1, 0]


def test_columns_of_joints_skip_ball_joint(tmp_path):
    """Check the columns 0 and 5 of qpos, which enclose the four columns of a ball joint."""
    env = build(arm(tmp_path, robot={"init": {"joint_pos": {"shoulder": 0.2, "elbow": 0.4},
                                              "joint_vel": {"elbow": -0.5}}}))  # fmt: skip
    entity = env.entities["robot"]
    assert entity.qpos_columns.tolist() == [0, 5]
    assert entity.dof_columns.tolist() == [0, 4]
    obs = env.reset()["policy"]
    assert obs[1].tolist() == pytest.approx([0.2, 0.4, 0.0, -0.5])
    assert env.engine.field("qpos")[1].tolist() == pytest.approx([0.2, 1, 0, 0, 0, 0.4])
    env.step(torch.zeros(3, 1))
    expected = env.engine.field("qpos").float()[:, [0, 5]]
    assert torch.equal(entity.data.joint_pos, expected)
    assert torch.equal(entity.data.joint_vel, env.engine.field("qvel").float()[:, [0, 4]])


def test_joint_starts_at_qpos0_or_init(tmp_path):
    env = build(arm(tmp_path))
    assert env.entities["robot"].data.default_joint_pos[0].tolist() == pytest.approx([0.0, math.radians(10)])


def test_mjcf_keyframes_are_dropped(tmp_path):
    assert model_of(tmp_path).nkey == 0


def test_options_come_from_first_mjcf_unless_overridden(tmp_path):
    model = model_of(tmp_path)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.iterations == 7
    assert model.opt.timestep == 0.01
    changed = model_of(tmp_path, sim={"integrator": "rk4", "iterations": 9, "gravity": [0.0, 1.0, -2.0], "dt": 0.002})
    assert changed.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert changed.opt.iterations == 9
    assert changed.opt.gravity.tolist() == [0, 1, -2]
    assert changed.opt.timestep == 0.002


def test_mjcf_memory_size_is_kept(tmp_path):
    assert model_of(tmp_path).narena == 20 * 1024 * 1024


def test_entity_orientation_is_normalised(tmp_path):
    model = model_of(tmp_path, robot={"quat": [2.0, 0.0, 0.0, 2.0], "pos": [1.0, 2.0, 3.0]})
    body = model.body("robot/base")
    assert body.quat.tolist() == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])
    assert body.pos.tolist() == [1, 2, 3]


def test_scene_has_ground_and_lights(tmp_path):
    model = model_of(tmp_path, scene={
        "entities": {"robot": {"model": "arm.xml"}},
        "ground": {"size": 12.0, "friction": 0.7},
        "lights": {"dome": {"color": [1.0, 0.5, 0.0], "intensity": 500.0},
                   "distant": {"intensity": 800.0, "direction": [0.0, 0.0, -1.0], "color": [1.0, 1.0, 1.0]}},
    })  # fmt: skip
    ground = model.geom("ground")
    assert ground.type[0] == mujoco.mjtGeom.mjGEOM_PLANE
    assert ground.size[:2].tolist() == [6.0, 6.0]
    assert ground.friction[0] == 0.7
    assert model.nlight == 1
    assert model.light("distant").diffuse.tolist() == pytest.approx([0.8] * 3, rel=1e-5)
    assert model.vis.headlight.ambient.tolist() == pytest.approx([0.5, 0.25, 0.0], rel=1e-5)
    assert model_of(tmp_path).ngeom == 4  # ground: null


def test_floating_root_is_found_in_unnamed_mjcf(tmp_path):
    xml = CRITTER.replace('<body name="torso" pos', "<body pos").replace('<freejoint name="root"/>', "<freejoint/>")
    xml = xml.replace('name="hip_fl" ', "")
    data = edited(
        PENDULUM_TASK, scene={"ground": {}, "entities": {"robot": {"model": "c.xml", "pos": [1.0, 0.0, 0.5]}}}
    )
    env = build(write(tmp_path / "c", data, c_xml=xml))
    entity = env.entities["robot"]
    assert entity.is_floating
    assert entity.data.root_pos_w[0].tolist() == pytest.approx([1.0, 0.0, 0.5])
    assert len(entity.joint_names) == 4
    assert entity.joint_names[1:] == ["hip_fr", "hip_bl", "hip_br"]


def test_entity_without_bodies_is_fixed(tmp_path):
    table = '<mujoco><worldbody><geom type="box" size="1 1 0.1"/></worldbody></mujoco>'
    data = edited(PENDULUM_TASK, scene={"entities": {
        "robot": {"model": "pendulum.xml"}, "table": {"model": "table.xml", "pos": [0.0, 0.0, -3.0]}}})  # fmt: skip
    env = build(write(tmp_path / "t", data, pendulum_xml=PENDULUM, table_xml=table))
    assert not env.entities["table"].is_floating
    assert env.entities["table"].data.root_pos_w[0].tolist() == [0, 0, -3]
    env.reset()
    env.step(torch.zeros(3, 1))


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ({"model": "../outside.xml"}, r"scene.entities.robot.model: '../outside.xml' lies outside the task's folder"),
        ({"model": "amr.xml"}, r"scene.entities.robot.model: no file 'amr.xml' in .*MJCF files there: .*arm.xml"),
        ({"model": "pipe.xml"}, r"scene.entities.robot.model: 'pipe.xml' in .* is not a regular file"),
        ({"model": "broken.xml"}, r"scene.entities.robot.model: 'broken.xml' is not a valid MJCF: .*bdoy"),
        ({"joints": {"elbo": {"damping": 1.0}}}, r"robot.joints.elbo: no joint matches 'elbo'; did you mean 'elbow'"),
        ({"joints": {"wrist": {"damping": 1.0}}}, r"no joint matches 'wrist'.*joints: shoulder, elbow"),
        ({"joints": {"(": {"damping": 1.0}}}, r"neither the name of a joint nor a regular expression"),
        ({"init": {"joint_pos": {"knee": 1.0}}}, r"scene.entities.robot.init: no joint matches 'knee'"),
    ],
)  # fmt: skip
def test_mismatch_with_model_raises_config_error_with_key(tmp_path, robot, message):
    folder = arm(tmp_path, robot=robot)
    (tmp_path / "outside.xml").write_text(ARM)
    os.mkfifo(folder / "pipe.xml")
    (folder / "broken.xml").write_text("<mujoco><worldbody><bdoy/></worldbody></mujoco>")
    with pytest.raises(ConfigError, match=message) as caught:
        build(folder)
    assert "task.yaml:" in str(caught.value)


def test_scene_reports_all_problems_at_once(tmp_path):
    with pytest.raises(ConfigError) as caught:
        build(arm(tmp_path, robot={"joints": {"elbo": {"damping": 1.0}, "shuolder": {"armature": 1.0}}}))
    assert len(caught.value.problems) == 2


def test_compile_error_raises_config_error(tmp_path):
    xml = ARM.replace('<geom size="0.03" mass="0.2"', '<geom size="0.03" mass="0"').replace('mass="0.5"', 'mass="0"')
    with pytest.raises(
        ConfigError,
        match=r"'arm.xml' is not a valid MJCF: .*arm.xml: .*mass and inertia of moving bodies must be larger",
    ):
        build(arm(tmp_path, xml=xml))


def test_model_that_does_not_compile_is_reported_before_its_joints(tmp_path):
    xml = ARM.replace('<geom size="0.03" mass="0.2"', '<geom size="0.03" mass="0"').replace('mass="0.5"', 'mass="0"')
    with pytest.raises(ConfigError) as caught:
        build(arm(tmp_path, xml=xml, robot={"joints": {"elbo": {"damping": 1.0}}}))
    assert [problem.path for problem in caught.value.problems] == [
        "scene.entities.robot.model",
        "scene.entities.robot.joints.elbo",
    ]


@pytest.mark.parametrize("number", [1, 2])
def test_settotalmass_is_kept_for_each_entity(tmp_path, number):
    xml = ARM.replace('autolimits="true"', 'autolimits="true" settotalmass="14"')
    entities = {f"arm_{i}": {"model": "arm.xml"} for i in range(number)}
    task = edited(PENDULUM_TASK, scene={"entities": {"robot": {"model": "arm.xml"}, **entities}}, actions=ARM_ACTIONS)
    model = build(write(tmp_path / "arm", task, arm_xml=xml)).engine.model
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        alone = mujoco.MjModel.from_xml_string(xml)
    for name in ("robot", *entities):
        for body in ("upper", "ball", "lower"):
            attached, own = model.body(f"{name}/{body}"), alone.body(body)
            for field in ("mass", "inertia", "ipos", "iquat"):
                np.testing.assert_array_equal(getattr(attached, field), getattr(own, field), err_msg=f"{body} {field}")
    assert model.body_mass.sum() == pytest.approx(14.0 * (number + 1))


def test_attach_with_other_options_prints_nothing(tmp_path, capfd):
    model_of(tmp_path, xml=ARM.replace("<option ", '<option timestep="0.003" '))
    assert capfd.readouterr() == ("", "")


def test_model_in_installed_package_is_read_without_import(tmp_path, monkeypatch):
    package = tmp_path / "site" / "armory" / "assets"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").write_text("raise SystemExit('imported')\n")
    (package / "arm.xml").write_text(ARM)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    model = model_of(tmp_path, robot={"model": "package:armory/assets/arm.xml"})
    assert joint(model, "robot/elbow") >= 0


def users_folder(tmp_path, monkeypatch):
    folder = tmp_path / "models"
    (folder / "arm").mkdir(parents=True)
    (folder / "arm" / "arm.xml").write_text(ARM)
    monkeypatch.setenv("RLCLI_MODELS", os.pathsep.join([str(tmp_path / "nowhere"), str(folder)]))
    return folder


def test_model_in_user_folder_is_read(tmp_path, monkeypatch):
    users_folder(tmp_path, monkeypatch)
    assert joint(model_of(tmp_path / "a", robot={"model": "models:arm/arm.xml"}), "robot/elbow") >= 0


def test_model_in_user_folder_may_not_load_files_outside(tmp_path, monkeypatch):
    folder = users_folder(tmp_path, monkeypatch)
    (tmp_path / "secret.xml").write_text("<mujoco/>")
    (folder / "arm" / "arm.xml").write_text(ARM.replace("<worldbody>", '<include file="../../secret.xml"/><worldbody>'))
    with pytest.raises(ConfigError, match="lies outside of"):
        model_of(tmp_path / "a", robot={"model": "models:arm/arm.xml"})


@pytest.mark.parametrize("first", ["models:leg/leg.xml", "package:no_such_package_here/arm.xml", "absent.xml"])
def test_first_existing_model_is_used(tmp_path, monkeypatch, first):
    users_folder(tmp_path, monkeypatch)
    model = model_of(tmp_path / "a", robot={"model": f"{first} | models:arm/arm.xml | package:numpy/arm.xml"})
    assert joint(model, "robot/elbow") >= 0


def test_missing_user_model_raises_missing_model_error(tmp_path, monkeypatch):
    monkeypatch.delenv("RLCLI_MODELS", raising=False)
    with pytest.raises(TaskError) as missing:
        model_of(tmp_path, robot={"model": "models:arm/arm.xml | package:no_such_package_here/arm.xml"})
    assert missing.value.exit_code == 4
    assert "RLCLI_MODELS is not set; no Python package 'no_such_package_here' is installed" in missing.value.message
    assert missing.value.hint == (
        "set RLCLI_MODELS to a folder that holds arm/arm.xml,"
        " or install the distribution that has the package no_such_package_here"
    )


@pytest.mark.parametrize(
    ("reference", "error", "expected"),
    [
        ("models:leg/leg.xml", TaskError, "no file 'leg/leg.xml' in"),
        ("models:../secret.xml", ConfigError, "lies outside the folder"),
    ],
)
def test_model_outside_user_folders_is_refused(tmp_path, monkeypatch, reference, error, expected):
    users_folder(tmp_path, monkeypatch)
    (tmp_path / "secret.xml").write_text(ARM)
    with pytest.raises(error, match=re.escape(expected)):
        model_of(tmp_path / "a", robot={"model": reference})


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ("package:no_such_package_here/arm.xml", "no Python package 'no_such_package_here'"),
        ("package:numpy/arm.xml", "no file 'arm.xml' in the package 'numpy'"),
        ("package:numpy/../arm.xml", "lies outside the package 'numpy'"),
    ],
)
def test_model_outside_packages_is_refused(tmp_path, reference, expected):
    with pytest.raises(ConfigError) as refused:
        model_of(tmp_path, robot={"model": reference})
    assert expected in str(refused.value)


def test_models_in_the_cache_of_mujoco_menagerie(tmp_path, monkeypatch):
    monkeypatch.delenv("RLCLI_MODELS", raising=False)
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path))
    for name, complete in (
        ("arm-0123456789abcdef", True),
        ("arm-fedcba9876543210", False),
        ("arm-2-0123456789abcdef", True),
    ):
        folder = tmp_path / "models" / name
        folder.mkdir(parents=True)
        (folder / "arm.xml").write_text("<mujoco/>")
        if complete:
            (folder / ".complete").write_text("{}")
    assert model_file(tmp_path, "models:arm/arm.xml") == tmp_path / "models" / "arm-0123456789abcdef" / "arm.xml"
    for missing in ("models:arm/other.xml", "models:ar/arm.xml", "models:*/arm.xml"):
        with pytest.raises(MissingModelError):
            model_file(tmp_path, missing)
    with pytest.raises(TaskError, match="outside"):
        model_file(tmp_path, "models:arm/../../x.xml")


def test_options_of_models_cause_no_warning(tmp_path):
    slow = PENDULUM.replace("<worldbody>", '<option timestep="0.005" gravity="0 0 -5" iterations="3"/>\n<worldbody>', 1)
    write(tmp_path, PENDULUM_TASK, pendulum_xml=slow)
    with warnings.catch_warnings(action="error"):
        scene = build(tmp_path).spec
        text = scene.to_xml()
    assert 'iterations="3"' in text
    assert 'gravity="0 0 -5"' not in text
