"""Commands and curriculum: timers, draws, metrics, and settings that change by address."""

import itertools
import math

import pytest
import torch
import yaml
from support.worlds import CRITTER_TASK, PENDULUM_TASK, build, critter, dump, pendulum, run, write

from rlcli.errors import ConfigError
from rlcli.mdp.success import mean_velocity_error, mean_yaw_rate_error
from rlcli.sim.rotations import rotate

VELOCITY = {"func": "uniform_velocity", "resampling_time_s": [0.1, 0.2], "lin_vel_x": [-1.0, 1.0],
            "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-2.0, 2.0]}  # fmt: skip


def walker(tmp_path, num_envs=4, *overrides, curriculum=None, events=None, **command):
    task = yaml.safe_load(CRITTER_TASK)
    task["commands"] = {"velocity": {**VELOCITY, **command}}
    task["observations"]["policy"]["asked"] = {"func": "generated_commands", "command": "velocity"}
    task["terminations"] = {"time_out": {"func": "time_out", "time_out": True}}
    if curriculum:
        task["curriculum"] = curriculum
    task["events"] |= events or {}
    terms = (
        "from rlcli.task import Command\n"
        "def generated_commands(env, *, command: Command):\n"
        "    return command.command\n"
    )
    return build(critter(tmp_path, dump(task), terms_py=terms), num_envs, *overrides)


def commands(env, steps):
    """Return the commands in each step. (steps, num_envs, 3)"""
    env.reset()
    seen = []
    for _ in range(steps):
        seen.append(env.command_manager.get_command("velocity").clone())
        env.step(torch.zeros(env.num_envs, env.layout.action_size))
    return torch.stack(seen)


def test_commands_stay_in_range_and_hold_between_draws(tmp_path):
    env = walker(tmp_path, 64)
    seen = commands(env, 29)
    for column, (low, high) in enumerate([(-1.0, 1.0), (-0.5, 0.5), (-2.0, 2.0)]):
        values = seen[:, :, column]
        assert values.min() >= low
        assert values.max() <= high
        assert values.std() == pytest.approx((high - low) / 12**0.5, rel=0.2)
    changed = (seen[1:] != seen[:-1]).any(dim=2)
    for env_id in range(64):
        at = [0, *(changed[:, env_id].nonzero()[:, 0] + 1).tolist()]
        gaps = [b - a for a, b in itertools.pairwise(at)]
        assert gaps
        assert all(5 <= gap <= 10 for gap in gaps)  # 0.1 to 0.2 s at 0.02 s


def test_reset_draws_command_and_restarts_timer(tmp_path):
    env = walker(tmp_path, 8, "commands.velocity.resampling_time_s=[100,100]")
    seen = commands(env, 61)  # an episode lasts 30 steps
    assert torch.equal(seen[0], seen[29])
    assert (seen[29] != seen[30]).any(dim=1).all()
    assert torch.equal(seen[30], seen[59])


def test_commands_independent_of_num_envs(tmp_path):
    few, many = commands(walker(tmp_path / "a", 3), 50), commands(walker(tmp_path / "b", 9), 50)
    assert torch.equal(few, many[:, :3])


def test_standing_environments_have_zero_command(tmp_path):
    seen = commands(walker(tmp_path, 400, rel_standing=0.25), 3)[2]
    assert float((seen == 0).all(dim=1).float().mean()) == pytest.approx(0.25, abs=0.07)


def test_heading_control_clips_yaw_rate(tmp_path):
    env = walker(tmp_path, 16, heading=[-3.0, 3.0], heading_stiffness=0.5, ang_vel_z=[-0.4, 0.4])
    env.reset()
    for _ in range(3):
        env.step(torch.zeros(16, env.layout.action_size))
    term = env.command_manager.get_term("velocity")
    for env_id in range(16):
        w, x, y, z = env.entities["robot"].data.root_quat_w[env_id].tolist()
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        error = (float(term.state_dict()["target"][env_id]) - yaw + math.pi) % (2 * math.pi) - math.pi
        assert float(term.command[env_id, 2]) == pytest.approx(max(-0.4, min(0.4, 0.5 * error)), abs=1e-5)


def test_command_metrics_are_episode_means(tmp_path):
    env = walker(tmp_path, 3, events={"push": None, "shove": None})
    env.reset()
    errors = []
    for _ in range(30):
        commanded = env.command_manager.get_command("velocity").clone()
        result = env.step(torch.zeros(3, env.layout.action_size))
        seen = result.obs["policy"] if result.final_obs is None else result.final_obs["policy"]
        errors.append((commanded[:, :2] - seen[:, 1:3]).norm(dim=1))
    found = result.episodes.ended().metrics["velocity/error_vel_xy"]
    assert torch.allclose(found, torch.stack(errors).mean(dim=0), rtol=1e-5)


def test_mean_errors_of_velocity_are_running_means(tmp_path):
    env = walker(tmp_path, 8, events={"push": None, "shove": None})
    env.reset()
    velocity = env.command_manager.get_term("velocity")
    linear = []
    for _ in range(29):
        env.step(torch.zeros(8, env.layout.action_size))  # metrics use the command before it is resampled
        lin, ang = (env.command_manager.running_mean(velocity, name) for name in ("error_vel_xy", "error_vel_yaw"))
        linear.append(lin)
    assert mean_velocity_error(env, command=velocity).tolist() == lin.tolist()
    assert mean_yaw_rate_error(env, command=velocity).tolist() == ang.tolist()
    assert lin.unique().numel() > 5
    steps = torch.stack([now * (n + 1) for n, now in enumerate(linear)]).diff(dim=0)
    assert (steps > 0).all()  # each step adds its error
    metrics = env.step(torch.zeros(8, env.layout.action_size)).episodes.ended().metrics
    assert torch.allclose(metrics["velocity/error_vel_yaw"], ang, atol=0.2)
    assert (
        env.command_manager.running_mean(velocity, "error_vel_xy").tolist() == [0.0] * 8
    )  # the next episode has begun


def test_state_dict_restores_commands(tmp_path):
    env, other = (walker(tmp_path / name, 4, heading=[-3.0, 3.0], rel_standing=0.2) for name in "ab")
    run(env, 17)
    other.reset(seed=3)
    other.load_state_dict(env.state_dict())
    for ours, theirs in zip(run(env, 40, 1, reset=False), run(other, 40, 1, reset=False), strict=True):
        assert torch.equal(ours.obs["policy"], theirs.obs["policy"])


def test_uniform_pose_is_in_root_frame(tmp_path):
    task = yaml.safe_load(CRITTER_TASK)
    task["commands"] = {"pose": {"func": "uniform_pose", "resampling_time_s": [9.0, 9.0], "bodies": ["leg_fl"],
                                 "x": [0.1, 0.4], "y": [0.0, 0.0], "z": [-0.3, -0.1], "yaw": [-1.0, 1.0]}}  # fmt: skip
    env = build(critter(tmp_path, dump(task)), 32)
    env.reset()
    pose = env.command_manager.get_command("pose")
    assert 0.1 <= pose[:, 0].min() < 0.2 < 0.3 < pose[:, 0].max() <= 0.4
    assert torch.equal(pose[:, 1], torch.zeros(32))
    assert torch.allclose(pose[:, 3:].norm(dim=1), torch.ones(32))
    metrics = env.command_manager.get_term("pose").metrics()
    data = env.entities["robot"].data
    index = env.entities["robot"].names["Bodies"].index("leg_fl")
    for i in range(4):
        w, x, y, z = data.root_quat_w[i].double().tolist()
        turn = torch.tensor([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                             [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                             [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])  # fmt: skip
        commanded = data.root_pos_w[i].double() + turn.double() @ pose[i, :3].double()
        distance = float((commanded - data.body_pos_w[i, index]).norm())
        assert float(metrics["position_error"][i]) == pytest.approx(distance, rel=1e-4)


@pytest.mark.parametrize("curriculum", [
    {"func": "stages", "address": "rewards.alive.weight", "steps": [5, 8], "values": [2.0, 0.0]},
])  # fmt: skip
def test_stages_changes_reward_weight_at_step(tmp_path, curriculum):
    task = yaml.safe_load(PENDULUM_TASK)
    task["curriculum"] = {"more": curriculum}
    env = build(pendulum(tmp_path, dump(task)), 2)
    rewards = [float(result.reward[0]) for result in run(env, 10)]
    # the weight changes after five steps
    assert rewards == pytest.approx([0.02] * 5 + [0.04] * 3 + [0.0] * 2)
    assert env.extras() == {"Curriculum/more": 0.0}


def test_interpolate_moves_number_linearly(tmp_path):
    curriculum = {"wider": {"func": "interpolate", "address": "commands.velocity.lin_vel_x", "to": [0.0, 4.0],
                            "begin": 2, "end": 12}}  # fmt: skip
    env = walker(tmp_path, 2, "commands.velocity.lin_vel_x=[0,0]", curriculum=curriculum)
    env.reset()
    seen = []
    for _ in range(14):
        env.step(torch.zeros(2, env.layout.action_size))
        seen.append(env.extras()["Curriculum/wider"] * 2)  # the mean of both ends
    assert seen == pytest.approx([0.0, 0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4, 2.8, 3.2, 3.6, 4.0, 4.0, 4.0])
    wide = commands(walker(tmp_path / "b", 64, curriculum=curriculum), 60)[45:, :, 0]
    assert wide.max() > 3.0


def test_interpolate_changes_event_range(tmp_path):
    events = {"joints": {"func": "reset_joints_by_offset", "mode": "reset", "position": [0.0, 0.0]}}
    curriculum = {"harder": {"func": "stages", "address": "events.joints.position.1", "steps": [10], "values": [0.5]}}
    env = walker(tmp_path, 32, curriculum=curriculum, events=events)
    env.reset()
    position, default = env.entities["robot"].data.joint_pos, env.entities["robot"].data.default_joint_pos
    assert torch.allclose(position, default)
    for _ in range(30):
        env.step(torch.zeros(32, env.layout.action_size))
    assert (position - default).max() > 0.4
    assert (position - default).min() >= -1e-6


def test_interpolate_changes_noise(tmp_path):
    task = yaml.safe_load(PENDULUM_TASK)
    task["observations"]["policy"]["pos"]["noise"] = {"kind": "uniform", "low": 0.0, "high": 0.0}
    task["observations"]["critic"] = {"pos": {"func": "joint_pos"}}
    task["curriculum"] = {"louder": {"func": "stages", "address": "observations.policy.pos.noise.high", "steps": [4],
                                     "values": [1.0]}}  # fmt: skip
    results = run(build(pendulum(tmp_path, dump(task)), 16), 8)
    noise = [float((r.obs["policy"][:, :1] - r.obs["critic"]).abs().max()) for r in results]
    assert noise[:3] == [0.0] * 3
    assert min(noise[3:]) > 0.5


def test_state_dict_restores_curriculum(tmp_path):
    task = yaml.safe_load(PENDULUM_TASK)
    task["curriculum"] = {"m": {"func": "interpolate", "address": "rewards.alive.weight", "to": 5.0, "end": 30}}
    env, other = (build(pendulum(tmp_path / name, dump(task)), 3) for name in "ab")
    run(env, 11)
    other.reset()
    other.load_state_dict(env.state_dict())
    for ours, theirs in zip(run(env, 25, 1, reset=False), run(other, 25, 1, reset=False), strict=True):
        assert torch.equal(ours.reward, theirs.reward)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("rewards.alife.weight", "'rewards' has no setting 'alife' that may change"),
        ("reward.alive.weight", "did you mean 'rewards'"),
        ("rewards.alive.func", "'rewards.alive' has no setting 'func' that may change"),
        ("rewards.alive", "which is neither a number nor a list of numbers"),
        ("rewards.alive.weight.0", "the setting has no element '0'"),
        ("sim.dt", "the task has no setting 'sim' that may change"),
        ("terminations.time_out.time_out", "has no setting 'time_out' that may change"),
    ],
)
def test_curriculum_rejects_unknown_address(tmp_path, address, message):
    task = yaml.safe_load(PENDULUM_TASK)
    task["curriculum"] = {"more": {"func": "stages", "address": address, "steps": [5], "values": [2.0]}}
    with pytest.raises(ConfigError) as refusal:
        build(pendulum(tmp_path, dump(task)), 2)
    assert message in str(refusal.value) + str([p.hint for p in refusal.value.problems])
    assert refusal.value.problems[0].path == "curriculum.more.address"


def test_curriculum_rejects_values_of_other_shape(tmp_path):
    task = yaml.safe_load(PENDULUM_TASK)
    task["curriculum"] = {"more": {"func": "stages", "address": "rewards.alive.weight", "steps": [5],
                                   "values": [[1.0, 2.0]]}}  # fmt: skip
    with pytest.raises(ConfigError, match="shape"):
        build(pendulum(tmp_path, dump(task)), 2)


def test_unknown_command_error_lists_commands(tmp_path):
    with pytest.raises(ConfigError) as refusal:
        walker(tmp_path, 2, "observations.policy.asked.command=velocty")
    (problem,) = refusal.value.problems
    assert "no command 'velocty'" in problem.message
    assert "velocity" in problem.hint


def test_reset_with_seed_restarts_schedules(tmp_path):
    ramp = {"func": "interpolate", "address": "commands.velocity.lin_vel_x", "end": 5, "to": [5.0, 6.0]}
    env = walker(tmp_path, 4, curriculum={"ramp": ramp})
    first = env.reset(seed=3)["policy"].clone()
    run(env, 8)
    assert env.reset()["policy"][:, -3].min() > 4.0  # a new episode, but the same training
    assert torch.equal(env.reset(seed=3)["policy"], first)


ARM = """<mujoco><worldbody><body name="upper" pos="0.5 0 0.1" euler="0 0 90"><joint name="a" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.4 0 0" mass="0.5"/><body name="fore" pos="0.4 0 0">
<joint name="b" axis="0 1 0" range="-90 90" limited="true"/>
<geom type="capsule" size="0.02" fromto="0.05 0 0 0.3 0 0" mass="0.3"/>
<body name="hand" pos="0.3 0 0"><geom size="0.03" mass="0.1"/></body></body></body></worldbody></mujoco>"""
"""An arm whose base is turned by 90 degrees, 10 cm above the ground."""


def reacher(tmp_path, num_envs=400, **command):
    task = yaml.safe_load(PENDULUM_TASK)
    task["scene"]["entities"]["robot"] = {"model": "arm.xml", "joints": {".*": {"kp": 9.0, "kv": 1.0}}}
    task["scene"].pop("ground")
    task["actions"] = {"joints": {"func": "joint_position"}}
    task["observations"]["policy"] = {"goal": {"func": "generated_commands", "command": "goal"}}
    task["commands"] = {
        "goal": {"func": "reachable_position", "resampling_time_s": [1, 1], "bodies": "hand", **command}
    }
    task |= {
        "rewards": {"slow": {"func": "joint_vel_l2", "weight": -1.0}},
        "events": {},
        "terminations": {"time_out": {"func": "time_out", "time_out": True}},
    }
    task.pop("success", None)
    env = build(write(tmp_path / "reacher", dump(task), arm_xml=ARM), num_envs)
    env.reset()
    return env, env.command_manager.get_command("goal")


def test_reachable_positions_are_within_reach_above_the_ground(tmp_path):
    env, goals = reacher(tmp_path)
    distance = goals.norm(dim=1)  # the base can be 0.3 + 0.4 m away, or, with the elbow at 90 degrees, 0.5 m
    assert 0.5 - 1e-5 <= float(distance.min()) < 0.53
    assert 0.67 < float(distance.max()) <= 0.7 + 1e-5
    assert goals[:, 1].abs().max() < 1e-6  # in the frame of the base, the arm moves in the plane of x and z
    assert goals[:, 2].min() > 0.03 - 0.1  # the hand, of radius 0.03 m, does not touch the ground
    assert goals[:, 2].max() > 0.6
    position, quat = env.entities["robot"].data.root_pos_w, env.entities["robot"].data.root_quat_w
    seen = env.command_manager.terms[0].instance.markers()[0].center
    assert torch.allclose(seen, position + rotate(quat, goals), atol=1e-6)


def test_reachable_positions_have_a_free_way_from_the_default_pose(tmp_path, monkeypatch):
    wall = '<body name="wall" pos="0.5 0 0.8"><geom type="box" size="0.1 0.25 0.4"/></body></worldbody>'
    monkeypatch.setitem(globals(), "ARM", ARM.replace("</worldbody>", wall))
    _, goals = reacher(tmp_path)
    assert goals[:, 2].max() > 0.3
    assert goals[:, 0].min() > -0.1  # the arm would have to pass through the wall to reach the other side


def test_joint_that_an_equality_couples_follows_in_reachable_positions(tmp_path, monkeypatch):
    tie = '<equality><joint joint1="b" joint2="a" polycoef="0 -1 0 0 0"/></equality></mujoco>'
    monkeypatch.setitem(globals(), "ARM", ARM.replace("</mujoco>", tie))
    _, goals = reacher(tmp_path, joints=["a"], position=[-1.0, 0.0])
    angle = torch.atan2(goals[:, 2], goals[:, 0] - 0.3)  # the forearm stays level
    assert (0.4 * torch.sin(angle)).allclose(goals[:, 2], atol=0.15)
    assert float((goals[:, 0] - 0.3).square().add(goals[:, 2].square()).sub(0.16).abs().max()) < 1e-4


def test_reachable_positions_follow_joints_and_offsets(tmp_path):
    _, goals = reacher(tmp_path, joints=["b"], position=[-0.5, 0.0])
    angle = torch.atan2(goals[:, 2], goals[:, 0] - 0.4)
    assert 0.0 <= float(angle.min()) < 0.02
    assert 0.48 < float(angle.max()) <= 0.5
