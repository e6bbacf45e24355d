"""Joint actions and actuator models, compared with the formulas in their documentation."""

import math

import mujoco
import numpy as np
import pytest
import torch
import yaml
from support.worlds import ENGINES, PENDULUM, PENDULUM_TASK, build, dump, write

from rlcli.errors import ConfigError
from rlcli.scene.jacobian import Jacobian

ARM = """
<mujoco model="arm">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3"><geom size="0.05" mass="1" contype="0" conaffinity="0"/>
      <body name="rail"><joint name="slide" type="slide" axis="1 0 0" range="-1 1"/>
        <geom size="0.04" mass="0.5" contype="0" conaffinity="0"/>
        <body name="upper" pos="0 0 0.1"><joint name="shoulder" axis="0 1 0" range="-2 2"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0" mass="0.4" contype="0" conaffinity="0"/>
          <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" range="-2.5 2.5"/>
            <geom type="capsule" size="0.02" fromto="0 0 0 0.3 0 0" mass="0.3" contype="0" conaffinity="0"/>
            <body name="hand" pos="0.3 0 0"><joint name="wrist" axis="0 0 1" range="-3 3"/>
              <geom size="0.03" mass="0.1" contype="0" conaffinity="0"/></body>
            <body name="finger" pos="0.3 0.05 0"><joint name="grip" type="slide" axis="0 1 0" range="0 0.04"/>
              <geom size="0.01" mass="0.02" contype="0" conaffinity="0"/></body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
JOINTS = ["slide", "shoulder", "elbow", "wrist", "grip"]
TASK = {
    "decimation": 4,
    "episode_length_s": 2.0,
    "sim": {"dt": 0.005, "gravity": [0.0, 0.0, 0.0]},
    "scene": {
        "num_envs": 3,
        "ground": None,
        "entities": {
            "robot": {
                "model": "arm.xml",
                "joints": {".*": {"kp": 60.0, "kv": 6.0, "damping": 1.0, "armature": 0.05}},
                "init": {"joint_pos": {"shoulder": 0.3, "elbow": 0.5}},
            }
        },
    },
    "observations": {"policy": {"pos": {"func": "joint_pos"}}},
    "events": {
        "start": {"func": "reset_joints_by_offset", "mode": "reset", "position": [-0.2, 0.2], "velocity": [-0.1, 0.1]}
    },
    "rewards": {"alive": {"func": "is_alive", "weight": 1.0}},
    "terminations": {"time_out": {"func": "time_out", "time_out": True}},
}


def arm(tmp_path, action, *overrides, actuators=None, num_envs=3, **changes):
    task = yaml.safe_load(dump({**TASK, **changes, "actions": {"move": action}}))
    if actuators:
        task["scene"]["entities"]["robot"]["actuators"] = actuators
    return build(write(tmp_path / "arm", dump(task), arm_xml=ARM), num_envs, *overrides)


def command_after(env, action):
    """Return the joint positions before a step, and its command."""
    env.reset()
    before = env.entities["robot"].data.joint_pos.clone()
    env.step(action)
    return before, env.action_manager.terms[0].instance.command.clone()


def test_scale_offset_and_clip_accept_joint_mappings(tmp_path):
    term = {"func": "joint_effort", "joints": ["elbow", "shoulder", "wrist"], "scale": {"elbow": 2.0, "w.*": 3.0},
            "offset": {"shoulder": 0.5}, "clip": {"wrist": [-1.0, 1.0]}}  # fmt: skip
    env = arm(tmp_path, term)
    action = torch.tensor([[1.0, 2.0, 3.0], [-1.0, -2.0, -3.0], [0.1, 0.2, 0.3]])
    _, command = command_after(env, action)
    # elbow 2 a; shoulder a + 0.5 (default scale 1); wrist 3 a, clipped to +-1
    expected = torch.stack([2 * action[:, 0], action[:, 1] + 0.5, (3 * action[:, 2]).clamp(-1, 1)], dim=1)
    assert torch.allclose(command, expected)
    layout = env.layout.actions[0]
    assert layout.scale == (2.0, 1.0, 3.0)
    assert layout.offset == (0.0, 0.5, 0.0)
    assert layout.clip == ((-math.inf, math.inf), (-math.inf, math.inf), (-1.0, 1.0))


@pytest.mark.parametrize("key", ["scale", "offset", "clip"])
def test_pattern_without_driven_joint_is_rejected(tmp_path, key):
    value = {"elbov": [0.0, 1.0] if key == "clip" else 1.0}
    with pytest.raises(ConfigError, match="elbov") as refusal:
        arm(tmp_path, {"func": "joint_effort", "joints": ["elbow"], key: value})
    assert "elbow" in refusal.value.problems[0].hint


def test_joint_matched_twice_is_rejected(tmp_path):
    with pytest.raises(ConfigError, match=r"'elbow' and 'e\.\*' both match joint"):
        arm(tmp_path, {"func": "joint_effort", "joints": ["elbow"], "scale": {"elbow": 1.0, "e.*": 2.0}})


def test_joint_velocity_writes_velocity_actuators(tmp_path):
    env = arm(tmp_path, {"func": "joint_velocity", "joints": ["wrist", "elbow"], "scale": 0.5})
    action = torch.tensor([[2.0, -1.0]] * 3)
    _, command = command_after(env, action)
    assert torch.equal(command, 0.5 * action)
    driven = dict(env.entities["robot"].actuators_of("velocity"))
    assert env.engine.field("ctrl")[0, [driven[3], driven[2]]].tolist() == [1.0, -0.5]
    for _ in range(60):
        env.step(action)
    assert env.entities["robot"].data.joint_vel[0, 3] > 0.4


def test_relative_joint_position_adds_to_joint_position(tmp_path):
    env = arm(tmp_path, {"func": "relative_joint_position", "joints": ["elbow", "slide"], "scale": 0.1})
    action = torch.tensor([[1.0, -1.0], [0.5, 0.0], [0.0, 2.0]])
    before, command = command_after(env, action)
    assert torch.allclose(command, before[:, [2, 0]] + 0.1 * action)


def test_position_to_limits_stretches_over_soft_limits(tmp_path):
    term = {"func": "joint_position_to_limits", "joints": ["shoulder", "elbow"]}
    env = arm(tmp_path, term, "scene.entities.robot.soft_joint_pos_limit_factor=0.5")
    action = torch.tensor([[-1.0, 1.0], [0.0, 0.5], [3.0, -3.0]])
    _, command = command_after(env, action)
    # half of [-2, 2] and of [-2.5, 2.5]
    assert torch.allclose(command, torch.tensor([[-1.0, 1.25], [0.0, 0.625], [1.0, -1.25]]))


def test_position_to_limits_rejects_unlimited_joint(tmp_path):
    task = yaml.safe_load(PENDULUM_TASK)
    task["actions"] = {"move": {"func": "joint_position_to_limits"}}
    task["scene"]["entities"]["robot"]["joints"] = {"swing": {"kp": 1.0}}
    with pytest.raises(ConfigError, match="'swing' has no position limits"):
        build(write(tmp_path, dump(task), pendulum_xml=PENDULUM), 2)


def test_ema_starts_at_joint_positions(tmp_path):
    env = arm(tmp_path, {"func": "ema_joint_position_to_limits", "joints": ["shoulder"], "alpha": 0.25})
    action = torch.tensor([[1.0], [-1.0], [0.5]])
    before, first = command_after(env, action)
    expected = 0.25 * 2.0 * action + 0.75 * before[:, 1:2]
    assert torch.allclose(first, expected)
    env.step(action)
    assert torch.allclose(env.action_manager.terms[0].instance.command, 0.25 * 2.0 * action + 0.75 * expected)


def test_binary_joint_uses_one_column(tmp_path):
    term = {"func": "binary_joint_position", "joints": ["grip", "wrist"], "open_command": {"grip": 0.04, "wrist": 0.1},
            "close_command": {".*": 0.0}}  # fmt: skip
    env = arm(tmp_path, term)
    assert env.layout.action_size == 1
    _, command = command_after(env, torch.tensor([[0.3], [-0.3], [0.0]]))
    assert torch.allclose(command, torch.tensor([[0.04, 0.1], [0.0, 0.0], [0.04, 0.1]]))


def test_binary_joint_requires_value_for_each_joint(tmp_path):
    term = {"func": "binary_joint_position", "joints": ["grip", "wrist"], "open_command": {"grip": 0.04},
            "close_command": {".*": 0.0}}  # fmt: skip
    with pytest.raises(ConfigError, match="open_command has no value for joint 'wrist'"):
        arm(tmp_path, term)


def test_jacobian_matches_mujoco(tmp_path):
    env = arm(tmp_path, {"func": "joint_position"}, num_envs=2)
    env.reset()
    robot = env.entities["robot"]
    body = robot.names["Bodies"].index("hand")
    point = robot.data.body_pos_w[:, body]
    ours = Jacobian(robot, [2, 0, 1, 4, 3], body)(point)
    for i in range(2):
        model, data = env.world(i)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, linear, angular, int(robot.body_ids[body]))
        assert np.allclose(ours[i, :3], linear[:, [2, 0, 1, 4, 3]], atol=1e-6)
        assert np.allclose(ours[i, 3:], angular[:, [2, 0, 1, 4, 3]], atol=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
def test_inverse_kinematics_reaches_position(tmp_path, engine):
    term = {"func": "differential_inverse_kinematics", "joints": ["slide", "shoulder", "elbow"], "bodies": ["hand"],
            "mode": "position"}  # fmt: skip
    # stiff, well damped joints and long physics steps, because each of them takes 50 ms on Warp's CPU device
    joints = 'scene.entities.robot.joints.".*"={kp: 200.0, kv: 0.0, damping: 20.0, armature: 0.05}'
    quick = ("sim.dt=0.04", "decimation=1", joints)
    env = arm(tmp_path, term, f"sim.engine={engine}", *quick, episode_length_s=20.0)
    env.reset()
    target = torch.tensor([[0.45, 0.0, 0.25], [0.3, 0.0, 0.3], [0.5, 0.0, 0.0]])  # in the root's frame
    for _ in range(25):
        env.step(target)
    robot = env.entities["robot"]
    hand = robot.data.body_pos_w[:, robot.names["Bodies"].index("hand")] - robot.data.root_pos_w
    assert (hand - target).norm(dim=1).max() < 5e-3


def test_inverse_kinematics_relative_mode(tmp_path):
    term = {"func": "differential_inverse_kinematics", "joints": ["slide", "shoulder", "elbow", "wrist"],
            "bodies": ["hand"], "mode": "pose", "relative": True, "scale": 0.01, "damping": 1.0e-4}  # fmt: skip
    env = arm(tmp_path, term)
    assert env.layout.action_size == 6
    action = torch.tensor([[1.0, 0.0, 0.5, 0.0, 0.0, 0.0]] * 3)
    env.reset()
    robot = env.entities["robot"]
    body = robot.names["Bodies"].index("hand")
    jacobian = Jacobian(robot, [0, 1, 2, 3], body)(robot.data.body_pos_w[:, body])
    before = robot.data.joint_pos.clone()
    env.step(action)
    command = env.action_manager.terms[0].instance.command - before[:, :4]
    moved = (jacobian @ command[:, :, None])[:, :, 0]
    assert torch.allclose(moved[:, [0, 2, 4]], torch.tensor([0.01, 0.005, 0.0]).expand(3, 3), atol=2e-4)


def test_inverse_kinematics_posture_keeps_body(tmp_path):
    """Three joints move the hand in a plane, where two are enough: one is redundant."""
    term = {"func": "differential_inverse_kinematics", "joints": ["slide", "shoulder", "elbow"], "bodies": ["hand"],
            "mode": "position", "damping": 1.0e-3}  # fmt: skip
    target = torch.tensor([[0.45, 0.0, 0.25]] * 3)
    homes = []
    for posture in (0.0, 0.05):
        env = arm(tmp_path, {**term, "posture": posture}, episode_length_s=20.0)
        env.reset()
        for _ in range(300):
            env.step(target)
        robot = env.entities["robot"]
        hand = robot.data.body_pos_w[:, robot.names["Bodies"].index("hand")] - robot.data.root_pos_w
        assert (hand - target).norm(dim=1).max() < 5e-3
        away = robot.data.joint_pos[:, :3] - robot.data.default_joint_pos[:, :3]
        homes.append(away.norm(dim=1))
    assert bool((homes[1] < homes[0] - 1e-3).all())


def test_inverse_kinematics_requires_one_body(tmp_path):
    term = {"func": "differential_inverse_kinematics", "bodies": ["hand", "lower"]}
    with pytest.raises(ConfigError, match="2 elements"):
        arm(tmp_path, term)


# --- actuator models ---


def substeps(env, action):
    """Run one step, and return (position, velocity, control) before each physics step. (decimation, num_envs, k)"""
    rows = []
    step = env.engine.step

    def spy(nstep, *, derive=True):
        rows.append([env.engine.field(name).clone() for name in ("qpos", "qvel", "ctrl")])
        step(nstep, derive=derive)

    env.engine.step = spy
    env.step(action)
    env.engine.step = step
    return [torch.stack(column) for column in zip(*rows, strict=True)]


PD = {"joints": ["elbow", "shoulder"], "stiffness": 30.0, "damping": {"elbow": 2.0, "shoulder": 1.0}}


def test_pd_model_computes_effort_in_each_physics_step(tmp_path):
    env = arm(tmp_path, {"func": "joint_position", "joints": ["elbow", "shoulder"], "use_default_offset": False},
              actuators={"legs": PD})  # fmt: skip
    env.reset()
    action = torch.tensor([[0.4, -0.2], [1.0, 1.0], [0.0, 0.0]])
    qpos, qvel, ctrl = substeps(env, action)
    assert len(ctrl) == 4
    elbow = 30.0 * (action[:, 0] - qpos[:, :, 2]) - 2.0 * qvel[:, :, 2]
    shoulder = 30.0 * (action[:, 1] - qpos[:, :, 1]) - 1.0 * qvel[:, :, 1]
    assert env.engine.model.nu == 2
    assert torch.allclose(ctrl, torch.stack([elbow, shoulder], dim=2), atol=1e-4)
    assert torch.allclose(env.entities["robot"].data.applied_effort[:, [2, 1]], ctrl[-1].float(), atol=1e-4)


def test_actuator_model_accepts_efforts_and_velocities(tmp_path):
    effort = arm(tmp_path / "a", {"func": "joint_effort", "joints": ["elbow"]},
                 actuators={"e": {"joints": ["elbow"], "effort_limit": 2.0}})  # fmt: skip
    effort.reset()
    _, _, ctrl = substeps(effort, torch.tensor([[1.5], [5.0], [-9.0]]))
    assert ctrl[:, :, 0].tolist() == [[1.5, 2.0, -2.0]] * 4
    velocity = arm(tmp_path / "b", {"func": "joint_velocity", "joints": ["elbow"]},
                   actuators={"e": {"joints": ["elbow"], "damping": 3.0}})  # fmt: skip
    velocity.reset()
    _, qvel, ctrl = substeps(velocity, torch.tensor([[1.0], [2.0], [0.0]]))
    assert torch.allclose(ctrl[:, :, 0], 3.0 * (torch.tensor([1.0, 2.0, 0.0]) - qvel[:, :, 2]), atol=1e-5)


def test_dc_motor_effort_falls_with_speed(tmp_path):
    motor = {"joints": ["elbow"], "kind": "dc_motor", "saturation_effort": 4.0, "velocity_limit": 10.0,
             "effort_limit": 3.0}  # fmt: skip
    env = arm(tmp_path, {"func": "joint_effort", "joints": ["elbow"]}, actuators={"m": motor}, num_envs=6)
    env.reset()
    speeds = torch.tensor([0.0, 5.0, 12.0, -5.0, 30.0, 0.0])
    env.engine.field("qvel")[:, 2] = speeds
    command = torch.tensor([[9.0], [9.0], [9.0], [9.0], [9.0], [-9.0]])
    _, _, ctrl = substeps(env, command)
    expected = []
    for speed, effort in zip(speeds.tolist(), command[:, 0].tolist(), strict=True):
        speed = max(-17.5, min(17.5, speed))  # 10 (1 + 3/4): speed at which the torque line leaves the effort limit
        low, high = max(-3.0, 4.0 * (-1 - speed / 10)), min(3.0, 4.0 * (1 - speed / 10))
        expected.append(max(low, min(high, effort)))
    # 3 (the limit), 2, -0.8 (it brakes), 3, -3, -3
    assert expected == pytest.approx([3.0, 2.0, -0.8, 3.0, -3.0, -3.0])
    assert ctrl[0, :, 0].tolist() == pytest.approx(expected)


def test_delayed_model_applies_commands_later(tmp_path):
    env = arm(tmp_path, {"func": "joint_effort", "joints": ["elbow"]},
              actuators={"e": {"joints": ["elbow"], "delay": [3, 3]}})  # fmt: skip
    env.reset()
    seen = [substeps(env, torch.full((3, 1), value))[2][:, 0, 0].tolist() for value in (1.0, 2.0, 3.0)]
    # 4 physics steps in a step, delay 3; the first command of an episode fills the delay line
    assert seen == [[1.0] * 4, [1.0, 1.0, 1.0, 2.0], [2.0, 2.0, 2.0, 3.0]]


def test_model_delay_is_drawn_per_env_and_episode(tmp_path):
    env = arm(tmp_path, {"func": "joint_effort", "joints": ["elbow"]}, num_envs=64,
              actuators={"e": {"joints": ["elbow"], "delay": [0, 3]}})  # fmt: skip
    env.reset()
    substeps(env, torch.full((64, 1), 1.0))
    ctrl = substeps(env, torch.full((64, 1), 2.0))[2][:, :, 0]
    lags = (ctrl == 1.0).sum(dim=0)
    assert set(lags.tolist()) == {0, 1, 2, 3}


def test_actuator_model_replaces_mjcf_actuators(tmp_path):
    model = PENDULUM.replace("</mujoco>", '<actuator><position joint="swing" kp="9"/></actuator></mujoco>')
    task = yaml.safe_load(PENDULUM_TASK)
    task["actions"] = {"a": {"func": "joint_position"}}
    task["scene"]["entities"]["robot"]["actuators"] = {"all": {"joints": ".*", "stiffness": 2.0}}
    env = build(write(tmp_path, dump(task), pendulum_xml=model), 2)
    assert env.engine.model.nu == 1
    assert env.entities["robot"].actuators_of("motor") == [(0, 0)]


DELAYED = {"legs": {**PD, "delay": [0, 5]}}


def test_state_dict_restores_actuator_models_bit_for_bit(tmp_path):
    term = {"func": "ema_joint_position_to_limits", "joints": ["elbow", "shoulder"], "alpha": 0.3}
    env, other = (arm(tmp_path / name, term, actuators=DELAYED, episode_length_s=0.3) for name in "ab")
    env.reset()
    actions = torch.rand(40, 3, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for action in actions[:10]:
        env.step(action)
    other.reset(seed=5)
    other.load_state_dict(env.state_dict())
    for action in actions[10:]:
        assert torch.equal(env.step(action).obs["policy"], other.step(action).obs["policy"])


def test_actuator_models_independent_of_num_envs(tmp_path):
    term = {"func": "joint_position", "joints": ["elbow", "shoulder"], "scale": 0.3}
    few, many = (arm(tmp_path / str(n), term, actuators=DELAYED, num_envs=n, episode_length_s=0.3) for n in (3, 11))
    few.reset()
    many.reset()
    for action in torch.rand(30, 11, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1:
        assert torch.equal(few.step(action[:3]).obs["policy"], many.step(action).obs["policy"][:3])


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"joints": ["elbov"]}, "no joint matches 'elbov'"),
        ({"joints": ["elbow"], "kind": "dc_motor"}, "kind dc_motor needs saturation_effort and velocity_limit"),
        ({"joints": ["elbow"], "velocity_limit": 3.0}, "are allowed only with kind: dc_motor"),
        ({"joints": ["elbow"], "stiffness": {"shoulder": 3.0}}, "no joint matches 'shoulder'"),
        ({"joints": ["elbow", "wrist"], "stiffness": {"elbow": 3.0}}, "no value for joint 'wrist'"),
        ({"joints": ["elbow"], "delay": [2, 1]}, "the lower end 2 is above"),
    ],
)
def test_invalid_actuator_model_is_rejected(tmp_path, model, message):
    with pytest.raises(ConfigError) as refusal:
        arm(tmp_path, {"func": "joint_effort", "joints": ["elbow"]}, actuators={"m": model})
    assert message in refusal.value.message


def test_joint_of_two_models_is_rejected(tmp_path):
    with pytest.raises(ConfigError, match="joint 'elbow' belongs to 'one' already; remove it from one"):
        arm(tmp_path, {"func": "joint_effort", "joints": ["elbow"]},
            actuators={"one": {"joints": ["elbow"]}, "two": {"joints": ["e.*"]}})  # fmt: skip
