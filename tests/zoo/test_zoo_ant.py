"""The task `ant-direct`: its model, what it observes, what it pays, where it ends, how it starts."""

import json
import math
import subprocess
import sys
from itertools import pairwise

import mujoco
import pytest
import torch
from support.worlds import actions, build
from torch.utils._python_dispatch import TorchDispatchMode

from rlcli_tasks.ant.task import JOINTS

ROOT_POS, ROOT_QUAT, LEGS = slice(0, 3), slice(3, 7), slice(7, 15)
"""Columns of qpos; in qvel the legs are columns 6 to 13."""
REST = torch.tensor([0.0, math.pi / 4] * 4, dtype=torch.float64)


@pytest.fixture
def env():
    env = build("ant-direct", 4)
    env.reset()
    return env


def put(env, row=0, position=(0.0, 0.0, 0.5), quat=(1.0, 0.0, 0.0, 0.0), linear=(0, 0, 0), angular=(0, 0, 0),
        joints=REST, rates=0.0):  # fmt: skip
    """Put one environment into a state; angular is in the torso's frame."""
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    qpos[row, ROOT_POS], qpos[row, ROOT_QUAT] = torch.tensor(position).double(), torch.tensor(quat).double()
    qvel[row, :3], qvel[row, 3:6] = torch.tensor(linear).double(), torch.tensor(angular).double()
    qpos[row, LEGS], qvel[row, 6:] = joints, rates
    env.sim.refresh()


def look(env, row=0):
    """Column name -> value of the observation."""
    env.task.get_observations()
    return dict(zip(env.task.observation_names, env.task.obs_buf[row].tolist(), strict=True))


def about(axis, angle):
    """Quaternion of a turn about x, y or z."""
    return tuple(math.cos(angle / 2) if i == 0 else math.sin(angle / 2) * (i == axis) for i in range(4))


def pay(env, row=0):
    """Reward of the state as it is, and whether it ends the episode."""
    env.task.get_observations()
    env.task.calculate_metrics()
    env.task.is_done()
    return float(env.task.rew_buf[row]), bool(env.task.reset_buf[row])


# --- the model ---


def test_the_model_has_the_mass_the_limits_and_the_motors_of_its_sources():
    model = build("ant-direct", 1).engine.model
    assert float(model.body_mass.sum()) == pytest.approx(0.9109, abs=1e-4)
    low, high = (model.jnt_range[1:, end].reshape(4, 2) for end in (0, 1))
    assert low.tolist() == [pytest.approx([math.radians(-40), math.radians(30)])] * 4
    assert high.tolist() == [pytest.approx([math.radians(40), math.radians(100)])] * 4
    assert model.actuator_gear[:, 0].tolist() == [15.0] * 8
    assert model.dof_damping[6:].tolist() == [0.1] * 8
    assert model.dof_armature[6:].tolist() == [0.01] * 8


def test_all_legs_are_alike(env):
    """What one leg does, turned by a right angle, the next leg does."""
    for leg in range(4):
        joints = REST.clone()
        joints[2 * leg : 2 * leg + 2] += torch.tensor([0.3, 0.4])
        put(env, leg, joints=joints)
    feet = env.engine.field("xpos")
    env.engine.forward(env._select_all())
    bodies = env.entities["robot"].names["Bodies"]
    ends = [
        feet[leg, env.entities["robot"].body_ids[bodies.index(f"foot_{name}")]]
        for leg, name in enumerate(("fl", "bl", "br", "fr"))
    ]
    for before, after in pairwise(ends):
        turned = torch.stack([-before[1], before[0], before[2]])
        torch.testing.assert_close(after, turned, atol=1e-5, rtol=0)


def test_no_start_pose_reaches_into_the_ground():
    model, data = build("ant-direct", 1).world()
    for hip in (-0.2, 0.0, 0.2):
        for ankle in (-0.2, 0.0, 0.2):
            data.qpos[7::2], data.qpos[8::2] = hip, math.pi / 4 + ankle
            mujoco.mj_forward(model, data)
            assert data.ncon == 0 or data.contact.dist.min() > -2e-3


@pytest.mark.parametrize(("num_envs", "steps"), [(32, 200), pytest.param(200, 1000, marks=pytest.mark.slow)])
def test_random_torques_never_blow_the_simulation_up(num_envs, steps):
    env = build("ant-direct", num_envs, "params.termination_height=-10", "episode_length_s=1000")
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    generator = torch.Generator().manual_seed(0)
    fastest = highest = 0.0
    for _ in range(steps):
        env.step((torch.rand(num_envs, 8, generator=generator) * 2 - 1).sign())
        fastest = max(fastest, float(qvel[:, 6:].abs().max()))
        highest = max(highest, float(qpos[:, 2].max()))
    assert env.divergences == 0
    assert 15.0 < fastest < 75.0, "7.5 N m against a damping of 0.1 N m s/rad cannot turn a joint faster than this"
    assert highest < 2.0
    assert float(qpos[:, 2].min()) > 0.1


# --- observations ---


def test_height_velocities_and_joints_are_those_of_the_state(env):
    joints = REST.clone()
    joints[1], joints[2] = math.radians(100), math.radians(-40)
    put(env, position=(1, 2, 0.6), linear=(3, -2, 1), angular=(0.5, -0.25, 2), joints=joints, rates=2.0)
    seen = look(env)
    assert [seen[n] for n in ("height", "vel_x", "vel_y", "vel_z")] == pytest.approx([0.6, 3, -2, 1])
    assert [seen[n] for n in ("rate_x", "rate_y", "rate_z")] == pytest.approx([0.5, -0.25, 2])
    assert [seen["ankle_fl_pos"], seen["hip_bl_pos"], seen["hip_fl_pos"]] == pytest.approx([1, -1, 0], abs=1e-6)
    assert seen["ankle_br_pos"] == pytest.approx((45 - 65) / 35, abs=1e-6)
    assert [seen[f"{joint}_vel"] for joint in JOINTS] == pytest.approx([0.4] * 8)


@pytest.mark.parametrize("yaw", [-3.0, -1.5, -0.1, 0.0, 0.7, math.pi / 2, 3.1])
def test_a_turned_ant_sees_its_velocity_and_the_target_from_its_own_side(env, yaw):
    put(env, quat=about(3, yaw), linear=(1.0, 0.0, 0.0))
    seen = look(env)
    assert [seen["vel_x"], seen["vel_y"]] == pytest.approx([math.cos(yaw), -math.sin(yaw)], abs=1e-6)
    assert [seen["yaw"], seen["roll"], seen["target_angle"]] == pytest.approx([yaw, 0.0, -yaw], abs=1e-6)
    assert [seen["up"], seen["heading"]] == pytest.approx([1.0, math.cos(yaw)], abs=1e-6)


@pytest.mark.parametrize("roll", [-2.0, -0.3, 0.0, 1.0, 3.0])
def test_a_rolled_ant_sees_its_roll_and_how_upright_it_is(env, roll):
    put(env, quat=about(1, roll))
    seen = look(env)
    assert [seen["roll"], seen["yaw"], seen["up"]] == pytest.approx([roll, 0.0, math.cos(roll)], abs=1e-6)
    assert seen["heading"] == pytest.approx(1.0)


def test_an_ant_that_stands_on_its_head_or_tail_sees_numbers(env):
    for pitch in (math.pi / 2, -math.pi / 2):
        put(env, quat=about(2, pitch))
        assert all(math.isfinite(value) for value in look(env).values())


def test_the_target_is_seen_from_where_the_ant_is():
    env = build("ant-direct", 2, "params.target=[10.0, 4.0]")
    env.reset()
    put(env, position=(10.0, 1.0, 0.5))  # the target lies to its left
    seen = look(env)
    assert seen["target_angle"] == pytest.approx(math.pi / 2)
    assert seen["heading"] == pytest.approx(0.0, abs=1e-6)


def test_actions_are_observed_and_forgotten_when_an_episode_starts(env):
    action = torch.rand(4, 8) * 2 - 1
    obs = env.step(action).obs["policy"]
    assert torch.equal(obs[:, 52:], action)
    env.episode_length_buf[1] = env.max_episode_length - 1
    obs = env.step(action).obs["policy"]
    assert torch.equal(obs[[0, 2, 3], 52:], action[[0, 2, 3]])
    assert not obs[1, 52:].any()


def test_ankles_carry_what_stands_on_them(env):
    idle = torch.zeros(4, 8)
    for _ in range(240):
        result = env.step(idle)
    model, data = env.world(0)
    above = model.body_mass[[i for i in range(model.nbody) if "foot" not in model.body(i).name]].sum()
    lifted = 0.0
    for leg, name in enumerate(("fl", "bl", "br", "fr")):
        force = 10.0 * result.obs["policy"][0, 28 + 6 * leg : 31 + 6 * leg].double().numpy()
        lifted += (data.site(f"robot/ankle_{name}").xmat.reshape(3, 3) @ force)[2]
    assert abs(lifted) == pytest.approx(above * 9.81, rel=0.01)


def test_a_new_episode_has_felt_nothing_yet(env):
    for action in actions(40, 4, 8):
        result = env.step(action)
    assert result.obs["policy"][:, 28:52].any(dim=1).all()
    env.episode_length_buf[2] = env.max_episode_length - 1
    result = env.step(action)
    assert bool(result.truncated[2])
    assert not result.obs["policy"][2, 28:52].any()
    assert result.obs["policy"][[0, 1, 3], 28:52].any(dim=1).all()
    assert result.final_obs["policy"][2, 28:52].any(), "the old episode's last observation has its own"


# --- rewards and ends ---


def test_standing_still_pays_for_life_posture_and_heading(env):
    put(env)
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    assert pay(env) == (pytest.approx(0.5 + 0.1 + 0.5), False)


def test_progress_is_the_speed_towards_the_target(env):
    put(env, position=(2.0, 0.0, 0.5))
    pay(env)
    put(env, position=(2.05, 0.0, 0.5))
    assert pay(env)[0] == pytest.approx(1.1 + 0.05 * 60, abs=0.01)
    assert float(env.task.speed[0]) == pytest.approx(3.0, abs=0.01)
    put(env, position=(2.05, 0.5, 0.5))
    assert pay(env)[0] == pytest.approx(1.1, abs=0.02), "sideways is no progress"


def test_the_first_step_of_an_episode_counts_from_its_start(env):
    env.engine.field("qvel")[:, 0] = 1.2
    env.step(torch.zeros(4, 8))
    assert env.task.speed.tolist() == pytest.approx([1.2] * 4, abs=0.1)
    env.episode_length_buf[0] = env.max_episode_length - 1
    put(env, 0, position=(50.0, 0.0, 0.6))
    env.step(torch.zeros(4, 8))
    env.step(torch.zeros(4, 8))
    assert abs(float(env.task.speed[0])) < 0.5, "not the way back from where the last episode ended"


@pytest.mark.parametrize(("yaw", "share"), [(0.5, 1.0), (1.0, math.cos(1.0) / 0.8), (2.0, math.cos(2.0) / 0.8)])
def test_heading_pays_in_full_up_to_an_angle_and_less_beyond(env, yaw, share):
    put(env, quat=about(3, yaw))
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    assert pay(env)[0] == pytest.approx(0.6 + 0.5 * share, abs=1e-4)


@pytest.mark.parametrize(("roll", "bonus"), [(0.37, 0.1), (0.39, 0.0)])
def test_being_upright_pays_up_to_an_angle(env, roll, bonus):
    put(env, quat=about(1, roll))
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    assert pay(env)[0] == pytest.approx(1.0 + bonus, abs=1e-5)


def test_actions_and_their_power_cost(env):
    put(env, rates=torch.tensor([1.0, -2, 3, -4, 5, -6, 7, -8]).double())
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    env.task.actions[0] = torch.tensor([0.1, 0.2, 0.3, 0.4, -0.5, -0.6, -0.7, -0.8])
    squares = sum(0.01 * i * i for i in range(1, 9))
    power = sum(0.1 * i * 0.2 * i for i in range(1, 9))
    assert pay(env)[0] == pytest.approx(1.1 - 0.005 * squares - 0.05 * power, abs=1e-5)


@pytest.mark.parametrize("end", [-1, 1])
def test_a_joint_at_either_limit_costs(env, end):
    joints = REST.clone()
    joints[0], joints[3] = math.radians(40 * end), math.radians(65 + 35 * end)
    joints[4] = math.radians(0.98 * 40 * end)
    put(env, joints=joints)
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    assert pay(env)[0] == pytest.approx(1.1 - 2 * 0.1, abs=1e-5)


def test_an_ant_below_the_height_has_fallen_and_gets_that_reward_alone(env):
    put(env, position=(0.0, 0.0, 0.3099), linear=(5.0, 0.0, 0.0))
    assert pay(env) == (-2.0, True)
    put(env, position=(0.0, 0.0, 0.3101), linear=(5.0, 0.0, 0.0))
    assert pay(env)[1] is False


def test_a_fall_terminates_and_time_truncates(env):
    env.engine.field("qpos")[1, 2] = 0.2
    env.engine.field("qvel")[1, 2] = -3.0
    env.episode_length_buf[2] = 999
    result = env.step(torch.zeros(4, 8))
    assert result.terminated.tolist() == [False, True, False, False]
    assert result.truncated.tolist() == [False, False, True, False]
    assert float(result.reward[1]) == -2.0
    assert env.max_episode_length == 1000


# --- starts ---


def test_starts_fill_their_ranges_and_nothing_else_differs():
    env = build("ant-direct", 500)
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    assert torch.equal(qpos[:, :7], torch.tensor([0, 0, 0.55, 1, 0, 0, 0], dtype=torch.float64).expand(500, 7))
    assert not qvel[:, :6].any()
    for values, centre, span in ((qpos[:, LEGS], REST, 0.2), (qvel[:, 6:], torch.zeros(8).double(), 0.1)):
        away = (values - centre) / span
        assert (away.abs() <= 1.0 + 1e-6).all()
        assert (away.amax(dim=0) > 0.95).all()
        assert (away.amin(dim=0) < -0.95).all()
    assert (qpos[0, LEGS] != qpos[1, LEGS]).all()


def test_starts_stay_inside_the_joint_limits():
    env = build("ant-direct", 200, "params.joint_pos_noise=2.0")
    env.reset()
    low, high = env.entities["robot"].data.joint_pos_limits.unbind(dim=1)
    joints = env.entities["robot"].data.joint_pos
    assert ((joints >= low) & (joints <= high)).all()
    assert float(joints[:, 0].max()) > 0.6, "the range is the limits' own"


# --- fit for a GPU ---


class Operations(TorchDispatchMode):
    """Notes what torch runs."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


VIEWS = {"unbind", "slice", "select", "unsqueeze", "view", "expand", "detach", "alias", "as_strided"}
ON_THE_HOST = {"_local_scalar_dense", "nonzero", "masked_select", "lift_fresh", "scalar_tensor"}
"""Operations that wait for the device, or bring numbers to it."""


def test_the_hooks_of_a_step_are_few_operations_none_of_which_waits_for_the_device(env):
    task, action = env.task, torch.rand(4, 8)
    with Operations() as step:
        task.pre_physics_step(action)
        task.get_observations()
        task.calculate_metrics()
        task.is_done()
    assert not ON_THE_HOST & set(step.names)
    assert not {"index", "index_put_"} & set(step.names), "an index of booleans is a search"
    assert len([name for name in step.names if name not in VIEWS]) < 68


def test_buffers_keep_their_place_from_step_to_step_and_over_resets(env):
    def places():
        return {k: v.data_ptr() for k, v in vars(env.task).items() if isinstance(v, torch.Tensor)}

    before = places()
    for action in actions(3, 4, 8):
        env.step(action)
    env.episode_length_buf[1] = env.max_episode_length - 1
    env.step(action)
    env.reset()
    assert places() == before


# --- success ---


@pytest.mark.parametrize(("speed", "succeeds"), [(4.0, True), (0.5, False)])
def test_an_episode_that_ends_at_speed_is_a_success(speed, succeeds):
    env = build("ant-direct", 2, "episode_length_s=1.0", "success.hold_s=0.5")
    env.reset()
    for _ in range(60):
        env.engine.field("qvel")[:, 0] = speed
        env.engine.field("qpos")[:, 2] = 0.7
        result = env.step(torch.zeros(2, 8))
    assert result.truncated.all()
    assert result.episodes.success.tolist() == [succeeds] * 2


@pytest.mark.slow
def test_a_hundred_iterations_teach_it_to_walk(tmp_path):
    command = ["-m", "rlcli", "train", "ant-direct", "--max-iterations", "100", "--runs-dir", str(tmp_path), "--quiet"]
    subprocess.run([sys.executable, *command], check=True)
    (metrics,) = tmp_path.glob("ant-direct/*/metrics.jsonl")
    last = json.loads(metrics.read_text().splitlines()[-1])
    assert last["Task/speed"] > 1.0
