"""Every term of the library gives the values computed by hand, in environments with different states."""

import ast
import inspect

import numpy as np
import pytest
import torch
from support.mdp_numbers import states
from support.mdp_table import OBSERVATIONS, REWARDS, ROWS, SUCCESS, TERMINATIONS
from support.mdp_worlds import bound, hand_made, put, sensors
from support.worlds import ENGINES, build, edited, write

from rlcli.config.term_signatures import builtin_terms
from rlcli.errors import ConfigError
from rlcli.mdp import observations, rewards
from rlcli.task import reads_body_forces

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    return hand_made(tmp_path_factory.mktemp("hand"))


def value_of(env, term, kwargs):
    params = bound(env, kwargs, sensors())
    return term(env, **params)() if inspect.isclass(term) else term(env, **params)


def name_of(row):
    return row[0].__name__


@pytest.mark.parametrize(("term", "kwargs", "expected"), OBSERVATIONS, ids=map(name_of, OBSERVATIONS))
def test_observation_matches_hand_computed_value(env, term, kwargs, expected):
    value = value_of(env, term, kwargs)
    by_hand = np.array([expected(s) for s in states()])
    assert value.dtype == torch.float32
    assert value.shape == by_hand.shape
    np.testing.assert_allclose(value.numpy(), by_hand, atol=3e-6)


VALUES = [*REWARDS, *SUCCESS]


@pytest.mark.parametrize(("term", "kwargs", "expected"), VALUES, ids=map(name_of, VALUES))
def test_reward_or_value_of_success_matches_hand_computed_value(env, term, kwargs, expected):
    value = value_of(env, term, kwargs)
    assert value.shape == (3,)
    np.testing.assert_allclose(value.float().numpy(), [expected(s) for s in states()], rtol=2e-5, atol=3e-6)


@pytest.mark.parametrize(("term", "kwargs", "expected"), TERMINATIONS, ids=map(name_of, TERMINATIONS))
def test_termination_matches_hand_computed_value(env, term, kwargs, expected):
    value = value_of(env, term, kwargs)
    assert value.dtype == torch.bool
    assert value.tolist() == [bool(expected(s)) for s in states()]


@pytest.mark.parametrize("row", ROWS, ids=map(name_of, ROWS))
def test_expected_values_differ_between_envs(row):
    """A row with the same value everywhere would test little; some terms are 0 by nature."""
    values = np.array([np.broadcast_to(row[2](s), np.shape(row[2](s))) for s in states()], dtype=float)
    same = np.allclose(values, values[0])
    assert not same or name_of(row) in {"ProgressReward", "time_out", "joint_pos_limit_normalized"}


FORCES = {"body_lin_acc_l2", "body_incoming_wrench"}
"""Terms of body forces: tested with a pendulum below."""
PICTURES = {"image"}
"""Terms of cameras: tested in test_pictures.py."""
EPISODES = {"mean_velocity_error", "mean_yaw_rate_error"}
"""Terms of whole episodes: tested in tests/managers/test_commands_and_curriculum.py."""


def test_all_library_terms_are_in_the_table():
    tabled = {"observations": OBSERVATIONS, "rewards": REWARDS, "terminations": TERMINATIONS, "success": SUCCESS}
    for section, rows in tabled.items():
        named = {name_of(row) for row in rows} | FORCES | PICTURES | EPISODES
        terms = {signature.attribute for signature in builtin_terms(section).values()}
        assert terms, section
        assert terms <= named, terms - named


def test_docstrings_of_terms_have_shapes():
    for section in ("observations", "rewards", "terminations", "success"):
        for file in {term.file for term in builtin_terms(section).values()}:
            for node in ast.parse(file.read_text()).body:
                if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                    text = ast.get_docstring(node)
                    assert "(num_envs," in text, node.name


def test_terms_do_not_modify_state(env):
    read = ("qpos", "qvel", "qacc", "qfrc_actuator", "sensordata", "xpos", "xquat", "cvel", "site_xpos", "ctrl")
    watched = {name: env.engine.field(name).clone() for name in read}
    made = sensors()
    before = [{k: v.clone() for k, v in vars(part).items() if torch.is_tensor(v)} for part in made.values()]
    data = env.entities["robot"].data
    cached = [data.body_lin_vel_w.clone(), data.site_lin_vel_w.clone(), data.projected_gravity_b.clone()]
    for term, kwargs, _ in ROWS:
        params = bound(env, kwargs, made)
        _ = term(env, **params)() if inspect.isclass(term) else term(env, **params)
    assert all(torch.equal(values, env.engine.field(name)) for name, values in watched.items())
    for part, was in zip(made.values(), before, strict=True):
        assert all(torch.equal(getattr(part, key), value) for key, value in was.items())
    now = [data.body_lin_vel_w, data.site_lin_vel_w, data.projected_gravity_b]
    assert all(torch.equal(a, b) for a, b in zip(cached, now, strict=True))


PENDULUM = """
<mujoco><worldbody><body name="base"><geom size="0.05" mass="1"/>
  <body name="arm" pos="0.2 0 0"><joint name="swing" axis="0 1 0"/>
    <inertial pos="0.5 0 0" mass="2" diaginertia="0.01 0.04 0.04"/>
  </body></body></worldbody></mujoco>
"""
SWING = {
    "decimation": 1, "episode_length_s": 1.0, "sim": {"dt": 1e-5, "integrator": "euler"},
    "scene": {"num_envs": 3, "ground": None, "entities": {"robot": {"model": "arm.xml"}}},
    "actions": {"torque": {"func": "joint_effort"}},
    "observations": {"policy": {"wrench": {"func": "body_incoming_wrench", "bodies": "arm"}}},
    "rewards": {"acc": {"func": "body_lin_acc_l2", "weight": 1.0, "bodies": ["arm", "base"]}},
    "terminations": {"time_out": {"func": "time_out", "time_out": True}},
}  # fmt: skip


@pytest.mark.parametrize("engine", ENGINES)
def test_joint_wrench_and_acceleration_follow_newton(tmp_path, engine):
    """A pendulum of 2 kg, 0.5 m from its joint; the angle is below the horizontal."""
    env = build(write(tmp_path / "swing", edited("{}", **SWING), arm_xml=PENDULUM), 3, f"sim.engine={engine}")
    env.reset()
    angle, rate, g, m, length = np.array([0.0, 0.4, -1.0]), np.array([0.0, 3.0, -2.0]), 9.81, 2.0, 0.5
    env.engine.field("qpos")[:, 0] = torch.tensor(angle).to(env.engine.field("qpos").dtype)
    env.engine.field("qvel")[:, 0] = torch.tensor(rate).to(env.engine.field("qvel").dtype)
    wrench = env.step(torch.zeros(3, 1)).obs["policy"].numpy()
    turning = m * g * length * np.cos(angle) / (0.04 + m * length**2)
    along, across = np.stack([np.cos(angle), -np.sin(angle)]), np.stack([-np.sin(angle), -np.cos(angle)])  # x, z
    centre = length * (turning * across - rate**2 * along)
    force = m * (centre + np.array([[0.0], [g]]))
    # the arm's frame: x along the arm, z up, against `across`
    np.testing.assert_allclose(wrench[:, 0], (force * along).sum(axis=0), rtol=2e-4, atol=5e-3)
    np.testing.assert_allclose(wrench[:, 2], -(force * across).sum(axis=0), rtol=2e-4, atol=5e-3)
    np.testing.assert_allclose(wrench[:, [1, 3, 4, 5]], 0.0, atol=2e-2)  # a free hinge holds no torque about y
    robot = env.entities["robot"]
    np.testing.assert_allclose(robot.data.body_lin_acc_w[:, 1].numpy(), 0.0, atol=5e-3)
    np.testing.assert_allclose(robot.data.body_ang_acc_w[:, 1, 1].numpy(), turning, rtol=2e-4, atol=5e-3)


FALLING = '<mujoco><worldbody><body name="b"><freejoint/><geom size="0.1" mass="1"/><body name="out" pos="0.3 0 0"><joint name="j" axis="0 0 1" armature="1000"/><geom size="0.01" mass="0.001"/></body></body></worldbody></mujoco>'  # noqa: E501


@pytest.mark.parametrize("engine", ENGINES)
def test_spinning_body_acceleration_is_gravity_plus_centripetal(tmp_path, engine):
    task = {**SWING, "observations": {"policy": {"z": {"func": "base_pos_z"}}},
            "rewards": {"acc": {"func": "body_lin_acc_l2", "weight": 1.0, "bodies": "b"}}}  # fmt: skip
    env = build(write(tmp_path / "fall", edited("{}", **task), arm_xml=FALLING), 3, f"sim.engine={engine}")
    env.reset()
    env.engine.field("qvel")[:, 5] = torch.tensor([0.0, 2.0, -4.0]).to(env.engine.field("qvel").dtype)
    result = env.step(torch.zeros(3, 1))
    acceleration = env.entities["robot"].data.body_lin_acc_w.numpy()
    out = 0.3 * 1.0 / 1.001  # relative to the common centre of mass
    np.testing.assert_allclose(acceleration[:, 0, 2], -9.81, rtol=1e-4)
    inward = np.array([0.0, 4.0, 16.0])
    np.testing.assert_allclose(acceleration[:, 1, 0], -out * inward, atol=2e-3)
    expected = np.hypot(9.81, (0.3 - out) * inward)
    np.testing.assert_allclose(result.reward.numpy(), expected * env.step_dt, rtol=1e-3)


def test_body_forces_without_sensor_error_has_hint(tmp_path):
    code = "def mine(env, *, entity: Entity = 'robot'):\n    return entity.data.body_lin_acc_w[:, 0, 0]\n"
    task = {**SWING, "observations": {"policy": {"pos": {"func": "joint_pos"}}},
            "rewards": {"x": {"func": "mine", "weight": 1.0}}}  # fmt: skip
    folder = write(tmp_path / "swing", edited("{}", **task), arm_xml=PENDULUM,
                   terms_py="from rlcli.task import Entity, reads_body_forces\n" + code)  # fmt: skip
    with pytest.raises(ConfigError, match=r"rewards.x.*reads_body_forces.*accelerometer"):
        build(folder)
    (folder / "terms.py").write_text("from rlcli.task import Entity, reads_body_forces\n@reads_body_forces\n" + code)
    assert reads_body_forces(len_like) is len_like


def len_like(env):
    return env


def test_action_acc_l2_is_second_difference_within_episode(env):
    put(env)
    term = rewards.ActionAccL2(env)
    manager = env.action_manager
    history = [torch.zeros(3, 4), torch.zeros(3, 4)]
    for step in range(4):
        action = torch.full((3, 4), float(step**2))
        manager.prev_action.copy_(history[-1])
        manager.action.copy_(action)
        expected = 4 * (step**2 - 2 * float(history[-1][0, 0]) + float(history[-2][0, 0])) ** 2
        assert term().tolist() == [expected] * 3
        history.append(action)
    all_envs = env._select_all()
    state = term.state_dict()
    term.reset(all_envs)
    manager.prev_action.zero_()
    manager.action.fill_(1.0)
    assert term().tolist() == [4.0] * 3
    term.load_state_dict(state)
    assert term().tolist() == [4 * (1 - 0 + 4) ** 2] * 3
    put(env)


def test_feet_swing_height_uses_peak_at_touchdown(env):
    put(env)
    made = sensors()
    term = rewards.FeetSwingHeight(env, **bound(env, {
        "entity": "robot", "sites": ["leg_fl_tip", "leg_fr_tip", "leg_bl_tip", "leg_br_tip"], "sensor": "feet",
        "command": "place", "target_height": 0.5}, made))  # fmt: skip
    feet = made["feet"]
    feet.first_contact[:], feet.found[:] = False, False
    qpos, high = env.engine.field("qpos"), {}
    for lift in (0.0, 0.7, 0.1):  # lift and touch down
        qpos[1, 2] = states()[1].pos[2] + lift
        env.engine.forward(env._select_all())
        env.sim.refresh()
        assert term().tolist() == [0.0] * 3
        high[lift] = env.entities["robot"].data.site_pos_w[1, 1:, 2] - 0.25
    feet.first_contact[1], feet.found[1] = True, True
    peaks = [max(0.0, *(float(values[i]) for values in high.values())) for i in range(4)]
    assert float(term()[1]) == pytest.approx(sum((peak / 0.5 - 1) ** 2 for peak in peaks), rel=1e-5)
    feet.first_contact[1], feet.found[1] = False, False
    assert float(term()[1]) == 0.0, "reset"
    put(env)


def test_mismatched_parameters_raise_value_error(env):
    made = sensors()
    with pytest.raises(ValueError, match="3 elements; select 4"):
        rewards.feet_slide(env, **bound(env, {"entity": "robot", "bodies": "leg_[fb]l|torso", "sensor": "feet"}, made))
    with pytest.raises(ValueError, match="exactly one site; 4 are selected"):
        rewards.object_ee_distance(env, std=1.0, **bound(
            env, {"entity": "robot", "sites": "leg.*", "object": "object"}, made))  # fmt: skip
    with pytest.raises(
        ValueError, match="`sensors` selects 3 columns of sensor data; select one framequat sensor, which has 4"
    ):
        observations.imu_orientation(env, **bound(env, {"entity": "robot", "sensors": "gyro"}, made))
    with pytest.raises(ValueError, match="no termination matches 'fel'"):
        rewards.IsTerminatedTerm(env, terms=["fel"])
    with pytest.raises(ValueError, match="no body 'leg'; its bodies: leg_fl, leg_fr"):
        rewards.GaitReward(env, std=1.0, max_err=1.0, velocity_threshold=1.0, **bound(
            env, {"entity": "robot", "sensor": "feet", "command": "velocity"}, made),
            synced_feet_pairs=(("leg", "leg_br"), ("leg_fr", "leg_bl")))  # fmt: skip
    with pytest.raises(ValueError, match=r"std has 3 values; give one number, or a list of 4 \(one per joint\)"):
        rewards.Posture(env, entity=env.entities["robot"], joints=slice(0, 4), std=[1.0, 2.0, 3.0])


def test_withheld_effort_uses_limits_of_actuator_model(tmp_path):
    """A PD controller of 30 N m/rad with a limit of 4 N m, 0.3 rad from its target: 9 N m wanted, 5 withheld."""
    robot = {"model": "arm.xml", "actuators": {"pd": {"kind": "pd", "joints": "swing", "stiffness": 30.0,
                                                      "damping": 0.0, "effort_limit": 4.0}}}  # fmt: skip
    rewards_of = {"limits": {"func": "applied_torque_limits", "weight": 1.0}}
    task = {**SWING, "scene": {"num_envs": 3, "ground": None, "entities": {"robot": robot}}, "rewards": rewards_of,
            "actions": {"torque": {"func": "joint_position", "use_default_offset": False}},
            "observations": {"policy": {"pos": {"func": "joint_pos"}}},
            "terminations": {**SWING["terminations"], "weak": {"func": "joint_effort_out_of_limit"}},
            "sim": {"dt": 1e-5, "gravity": [0.0, 0.0, 0.0]}}  # fmt: skip
    env = build(write(tmp_path / "swing", edited("{}", **task), arm_xml=PENDULUM), 3)
    env.reset()
    result = env.step(torch.tensor([[0.3], [0.1], [-0.2]]))
    data = env.entities["robot"].data
    assert result.reward.tolist() == pytest.approx([5.0 * 1e-5, 0.0, 2.0 * 1e-5], rel=1e-4)
    assert result.terminated.tolist() == [True, False, True]
    assert data.joint_effort_limits.tolist() == [[4.0]] * 3
