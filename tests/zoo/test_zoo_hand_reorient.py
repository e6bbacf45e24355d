"""The task `hand-reorient`: model, observations, rewards, goals, terminations."""

import math

import mujoco
import pytest
import torch
from support.direct_states import observe, quat_around
from support.worlds import actions, build

from rlcli.sim.rotations import multiply, turn_between
from rlcli_tasks.hand_reorient.task import FINGERS, GOAL, JOINTS

N = 4
HAND = slice(0, 16)
CUBE_POS, CUBE_QUAT = slice(16, 19), slice(19, 23)
"""Columns of qpos; in qvel the cube is columns 16 to 21."""
PLACE = (-0.01, 0.0, 0.55)
LEVEL = (1.0, 0.0, 0.0, 0.0)
FAR = (0.0, 1.0, 0.0, 0.0)
"""An orientation half a turn from level: no goal is near."""


@pytest.fixture
def env():
    env = build("hand-reorient", N)
    env.reset()
    return env


def put(env, row=0, position=PLACE, quat=LEVEL, linear=(0, 0, 0), angular=(0, 0, 0), goal=FAR):
    """Set the cube and the goal of one environment; angular velocity is in the cube's frame."""
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    qpos[row, CUBE_POS], qpos[row, CUBE_QUAT] = torch.tensor(position).double(), torch.tensor(quat).double()
    qvel[row, 16:19], qvel[row, 19:22] = torch.tensor(linear).double(), torch.tensor(angular).double()
    env.task.goal_quat[row] = torch.tensor(goal)
    env.engine.forward(env._select_all())
    env.sim.refresh()


def compute_rewards(env):
    """Compute the rewards of the current state."""
    env.task.get_observations()
    env.task.get_states()
    env.task.calculate_metrics()
    env.task.is_done()
    return env.task.rew_buf


# --- the model ---


def test_masses_equal_sources():
    model = build("hand-reorient", 1).engine.model
    assert float(model.body("object/cube").mass[0]) == pytest.approx(400 * 0.065**3)
    assert model.body("object/cube").inertia == pytest.approx([400 * 0.065**5 / 6] * 3)
    for finger in FINGERS[:3]:
        links = [float(model.body(f"robot/{finger}_{n}").mass[0]) for n in ("swing", "proximal", "medial", "distal")]
        assert links == pytest.approx([0.0119, 0.065, 0.0355, 0.0306])


def test_finger_length_is_sum_of_links():
    model, data = build("hand-reorient", 1).world()
    data.qpos[HAND] = 0.0
    mujoco.mj_forward(model, data)
    root, tip = data.body("robot/middle_swing").xpos, data.site("robot/middle_tip").xpos
    assert tip - root == pytest.approx([0.0164 + 0.054 + 0.0384 + 0.029, 0, 0], abs=1e-9)


def test_positive_angles_bend_fingers_to_palm():
    model, data = build("hand-reorient", 1).world()
    for finger in FINGERS:
        heights = []
        for angle in (0.3, 0.6):
            data.qpos[HAND] = 0.0
            data.qpos[12:14] = 1.3, 1.163  # the thumb stands upright and faces the palm
            first = JOINTS.index(f"{finger}_1") + (finger == "thumb")
            data.qpos[first] = angle
            mujoco.mj_forward(model, data)
            heights.append(data.site(f"robot/{finger}_tip").xpos.copy())
        moved = heights[1] - heights[0]
        inwards = moved[1] if finger == "thumb" else moved[2]
        assert inwards > 0.01, finger


def test_collision_pairs(env):
    """Check that the cube touches palm and links, and fingertips touch each other and the palm; nothing else."""
    model = env.engine.model
    touching = set()
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            if (model.geom_contype[a] & model.geom_conaffinity[b]) or (
                model.geom_contype[b] & model.geom_conaffinity[a]
            ):
                touching.add(frozenset(model.geom(g).name.split("/")[1] for g in (a, b)))
    links = [f"{f}_{part}" for f in FINGERS for part in ("proximal", "medial", "distal")]
    links.remove("thumb_proximal")
    ends = [f"{f}_distal" for f in FINGERS]
    palm = [f"bar_{number}" for number in (1, 2, 3, 4)]
    expected = {frozenset(["cube", other]) for other in [*links, *palm]}
    expected |= {frozenset([end, bar]) for end in ends for bar in palm}
    expected |= {frozenset([a, b]) for a in ends for b in ends if a != b}
    assert touching == expected


def test_hand_in_initial_pose_holds_cube():
    """The fingers keep their start pose for two seconds: three cubes of four stay, and come to rest."""
    env = build("hand-reorient", 32)
    env.reset()
    still = (env.task.targets - env.task.middle) / env.task.half
    lost = torch.zeros(32, dtype=torch.bool)
    for _ in range(60):
        lost |= env.step(still).terminated
    assert int(lost.sum()) <= 8
    speed = env.entities["object"].data.root_lin_vel_w[~lost].norm(dim=1)
    assert float(speed.median()) < 0.005


def test_extreme_targets_keep_simulation_stable():
    env = build("hand-reorient", 32)
    env.reset()
    qvel, cube = env.engine.field("qvel"), env.entities["object"].data
    fastest, lowest = 0.0, 1.0
    for action in actions(90, 32, 16):
        env.step(action.sign())
        fastest = max(fastest, float(qvel[:, HAND].abs().max()))
        offset = cube.root_pos_w - torch.tensor([-0.0475, 0.0, 0.5])
        above = (offset[:, 0].abs() < 0.04) & (offset[:, 1].abs() < 0.05)
        lowest = min(lowest, float(torch.where(above, offset[:, 2], 1.0).min()))
    assert env.divergences == 0
    assert 3.0 < fastest < 40.0
    assert lowest > 0.0111 + 0.0325 - 0.004, "4 mm at most into the palm"


# --- actions ---


def test_targets_are_smoothed_and_within_limits(env):
    task, middle, half = env.task, env.task.middle, env.task.half
    before = task.targets.clone()
    env.step(torch.ones(N, 16))
    first = 0.5 * before + 0.5 * (middle + half)
    torch.testing.assert_close(task.targets, first)
    env.step(torch.full((N, 16), -3.0))  # clipped to -1
    torch.testing.assert_close(task.targets, 0.5 * first + 0.5 * (middle - half))
    torch.testing.assert_close(env.engine.field("ctrl").float(), task.targets)
    assert (task.targets >= task.low).all()
    assert (task.targets <= task.high).all()


# --- observations ---


def test_observation_of_state(env):
    put(env, position=(0.01, -0.02, 0.56), quat=quat_around(3, 0.5), linear=(0.1, 0.2, 0.3), angular=(1, 2, 3))
    env.engine.field("qpos")[0, HAND] = env.task.high.double()
    env.engine.field("qvel")[0, HAND] = 2.0
    env.sim.refresh()
    seen = observe(env)
    assert [seen[f"cube_{a}"] for a in "xyz"] == pytest.approx([0.01, -0.02, 0.56])
    assert [seen[f"cube_quat_{a}"] for a in "wxyz"] == pytest.approx(quat_around(3, 0.5))
    assert [seen[f"cube_vel_{a}"] for a in "xyz"] == pytest.approx([0.1, 0.2, 0.3])
    c, s = math.cos(0.5), math.sin(0.5)
    assert [seen[f"cube_rate_{a}"] for a in "xyz"] == pytest.approx([0.2 * (c - 2 * s), 0.2 * (s + 2 * c), 0.6])
    assert [seen[f"{joint}_pos"] for joint in JOINTS] == pytest.approx([1.0] * 16, abs=1e-6)
    assert [seen[f"{joint}_vel"] for joint in JOINTS] == pytest.approx([0.4] * 16)
    assert [seen[f"goal_quat_{a}"] for a in "wxyz"] == pytest.approx(FAR)


def test_observation_is_equal_for_both_quaternion_signs(env):
    quat = quat_around(1, 4.0)
    put(env, 0, quat=quat, goal=quat_around(2, 0.7))
    put(env, 1, quat=[-part for part in quat], goal=quat_around(2, 0.7))
    left, right = observe(env, 0), observe(env, 1)
    for name in ("cube_quat", "turn_quat"):
        for axis in "wxyz":
            assert left[f"{name}_{axis}"] == pytest.approx(right[f"{name}_{axis}"], abs=1e-6)
        assert left[f"{name}_w"] >= 0


def test_observed_rotation_is_from_goal_to_cube(env):
    put(env, quat=quat_around(1, 0.9), goal=quat_around(3, -0.4))
    seen = observe(env)
    turn = torch.tensor([[seen[f"turn_quat_{a}"] for a in "wxyz"]])
    cube = multiply(turn, torch.tensor([quat_around(3, -0.4)]))
    assert float(turn_between(cube, torch.tensor([quat_around(1, 0.9)]))) < 1e-3


def test_states_add_fingertips(env):
    for action in actions(3, N, 16):
        obs = env.step(action).obs
    assert torch.equal(obs["critic"][:, :69], obs["policy"])
    _, data = env.world(1)
    places = obs["critic"][1, 69:81].view(4, 3).tolist()
    for finger, place in zip(FINGERS, places, strict=True):
        assert place == pytest.approx(data.body(f"robot/{finger}_distal").xpos.tolist(), abs=1e-5)


def test_fingertip_load_at_rest_is_weight():
    env = build("hand-reorient", 2)
    env.reset()
    put(env, 0, position=(1.0, 0.0, 5.0))
    put(env, 1, position=(1.0, 0.0, 5.0))
    for _ in range(20):
        env.engine.step(4)
    env.task.progress_buf.fill_(5)
    env.sim.refresh()
    env.task.get_states()
    load = env.task.states_buf[:, 121:].view(2, 4, 2, 3)[:, :, 0].norm(dim=2)
    expected = 0.1 * 9.81 * torch.tensor([0.0306, 0.0306, 0.0306, 0.0598])
    torch.testing.assert_close(load, expected.expand(2, 4), atol=1e-3, rtol=0.02)


# --- rewards ---


def test_reward_is_documented_sum(env):
    put(env, position=(PLACE[0] + 0.03, PLACE[1], PLACE[2] + 0.04), quat=quat_around(2, 1.2), goal=quat_around(2, 0.2))
    env.task.actions[0] = 0.5
    assert float(compute_rewards(env)[0]) == pytest.approx(-10 * 0.05 + 1 / (1.0 + 0.1) - 0.0002 * 16 * 0.25, abs=1e-5)


@pytest.mark.parametrize(("angle", "bonus"), [(0.39, 250.0), (0.41, 0.0)])
def test_reached_goal_is_rewarded_and_counted(env, angle, bonus):
    put(env, quat=quat_around(1, angle), goal=LEVEL)
    env.task.actions.zero_()
    before = env.task.goal_quat.clone()
    assert float(compute_rewards(env)[0]) == pytest.approx(1 / (angle + 0.1) + bonus, abs=1e-2)
    assert env.task.successes.tolist() == [float(bonus > 0), 0, 0, 0]
    assert (env.task.goal_quat != before).any(dim=1).tolist() == [bonus > 0, False, False, False]


def test_next_goal_is_observed_in_same_step(env):
    put(env, quat=LEVEL, goal=LEVEL)
    compute_rewards(env)
    seen = env.task.obs_buf[0, GOAL]
    torch.testing.assert_close(seen[:4], env.task.goal_quat[0])
    assert torch.equal(env.task.states_buf[:, GOAL], env.task.obs_buf[:, GOAL])
    shown = env.entities["goal"].data
    torch.testing.assert_close(shown.root_quat_w[0].float(), env.task.goal_quat[0])
    assert float(turn_between(shown.root_quat_w[:1].float(), torch.tensor([LEVEL]))) > 0.2


def test_goals_do_not_depend_on_other_envs():
    drawn = []
    for reached in ([True, True, True, True], [False, True, False, False]):
        env = build("hand-reorient", N)
        env.reset()
        for row in range(N):
            put(env, row, goal=LEVEL if reached[row] else FAR)
        compute_rewards(env)
        drawn.append(env.task.goal_quat[1].clone())
    assert torch.equal(*drawn)


def test_goals_are_uniform_rotations(env):
    goals = []
    for step in range(250):
        env.episode_length_buf.fill_(step)
        for row in range(N):
            put_goal = env.task.selection(torch.arange(N) == row, "goal")
            env.task._draw_goal(put_goal)
        goals.append(env.task.goal_quat.clone())
    goals = torch.cat(goals)
    assert len(goals.unique(dim=0)) == 1000
    angle = turn_between(goals, torch.tensor([LEVEL]).expand_as(goals))
    assert float(angle.mean()) == pytest.approx(math.pi / 2 + 2 / math.pi, abs=0.06)  # mean of the uniform one


# --- ends and starts ---


def test_lost_cube_terminates(env):
    put(env, 0, position=(PLACE[0], 0.23, PLACE[2]))
    put(env, 1, position=(PLACE[0], 0.25, PLACE[2]))
    compute_rewards(env)
    assert env.task.reset_buf.tolist() == [0, 1, 0, 0]


def test_initial_states_are_within_ranges():
    env = build("hand-reorient", 256)
    env.reset()
    qpos = env.engine.field("qpos")
    default = env.entities["robot"].data.default_joint_pos[0]
    for end, sign in ((env.task.low, -1), (env.task.high, 1)):
        beyond = sign * (qpos[:, HAND].float() - torch.lerp(default, end, 0.2))
        assert float(beyond.max()) <= 1e-6
        assert float(beyond.max()) > -0.02
    offset = qpos[:, CUBE_POS] - torch.tensor([0.005, 0.0, 0.58])
    assert 0.009 < float(offset.abs().max()) <= 0.01 + 1e-6
    torch.testing.assert_close(env.task.targets, qpos[:, HAND].float())
    assert not env.engine.field("qvel").any()
    assert not env.task.successes.any()


def test_success_is_five_goals_without_lost_cube():
    env = build("hand-reorient", N, "episode_length_s=0.2")
    env.reset()
    env.task.successes.copy_(torch.tensor([0.0, 5.0, 4.0, 9.0]))
    ended = {}
    for step in range(6):
        for row in range(N):  # in the air above the palm, but the last one: that is lost in the end
            put(env, row, position=(0.0, 0.0, 0.7) if row < 3 or step < 5 else (0.0, 0.5, 0.5))
        episodes = env.step(torch.zeros(N, 16)).episodes
        if episodes is not None:
            ended |= dict(zip(episodes.ids.tolist(), episodes.success.tolist(), strict=True))
    assert ended == {0: False, 1: True, 2: False, 3: False}


def test_reached_goals_are_logged_per_episode(env):
    env.task.successes[1] = 3.0
    put(env, 1, position=(0.0, 0.5, 0.5))
    result = env.step(torch.zeros(N, 16))
    assert result.episodes.ids.tolist() == [1]
    assert result.episodes.metrics["successes"].tolist() == [3.0]
    assert env.task.successes[1] == 0.0
