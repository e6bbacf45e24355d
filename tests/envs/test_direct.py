"""Direct workflow: hooks, buffers and views of OmniIsaacGymEnvs."""

import math
import re

import pytest
import torch
from support.worlds import CRITTER, PENDULUM, actions, build, clone, edited, run, write

from rlcli.errors import ConfigError, TaskError

HEAD = """
import torch
from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask
"""

RECORDING = (
    HEAD
    + '''

class Task(DirectTask):
    """Notes every hook it is called through."""

    num_observations = 2
    num_actions = 1
    num_states = 3

    def __init__(self, env, params):
        super().__init__(env, params)
        self.calls = ["__init__"]
        self.flags = []

    def set_up_scene(self, scene):
        self.calls.append("set_up_scene")
        assert scene.spec.worldbody is not None
        self.robots = scene.add(ArticulationView("robot"))

    def post_reset(self):
        self.calls.append("post_reset")
        assert self.robots.num_dof == 1

    def reset_idx(self, env_ids):
        self.calls.append(("reset_idx", env_ids.tolist(), env_ids.dtype))
        assert not self.robots.get_joint_positions(env_ids).any(), "the default state is visible"
        self.robots.set_joint_positions(torch.full((len(env_ids), 1), 0.25), indices=env_ids)
        assert (self.robots.get_joint_positions(env_ids) == 0.25).all()

    def pre_physics_step(self, actions):
        self.calls.append("pre_physics_step")
        self.flags.append(self.reset_buf.tolist())
        self.actions = actions.clone()
        self.time = self.env.engine.field("time").clone()

    def get_observations(self):
        self.calls.append("get_observations")
        self.obs_buf[:, 0:1] = self.robots.get_joint_positions()
        self.obs_buf[:, 1] = self.progress_buf

    def get_states(self):
        self.calls.append("get_states")
        self.states_buf[:, :2] = self.obs_buf
        self.states_buf[:, 2] = 100.0

    def calculate_metrics(self):
        self.calls.append("calculate_metrics")
        self.rew_buf[:] = self.progress_buf.float()

    def is_done(self):
        self.calls.append("is_done")
        self.reset_buf[:] = self.obs_buf[:, 0] > 1.0
'''
)

TASK = """
decimation: 2
episode_length_s: 0.2
sim: {dt: 0.01, gravity: [0.0, 0.0, 0.0]}
scene: {num_envs: 3, ground: null, entities: {robot: {model: pendulum.xml}}}
"""


def direct(tmp_path, code=RECORDING, xml=PENDULUM, **changes):
    return write(tmp_path / "direct", edited(TASK, **changes), pendulum_xml=xml, task_py=code)


def hooks(task):
    return [call if isinstance(call, str) else call[0] for call in task.calls]


IDLE = torch.zeros(3, 1)


def test_hooks_run_in_documented_order(tmp_path):
    env = build(direct(tmp_path))
    task = env.task
    assert hooks(task) == ["__init__", "set_up_scene", "post_reset"]
    task.calls.clear()
    env.reset()
    assert hooks(task) == ["reset_idx", "get_observations", "get_states"]
    assert task.calls[0] == ("reset_idx", [0, 1, 2], torch.int64)
    task.calls.clear()
    env.step(IDLE)
    look = ["get_observations", "get_states"]
    assert hooks(task) == ["pre_physics_step", *look, "calculate_metrics", "is_done"]
    env.engine.field("qpos")[1] = 2.0
    task.calls.clear()
    env.step(IDLE)
    assert hooks(task) == ["pre_physics_step", *look, "calculate_metrics", "is_done", "reset_idx", *look]
    assert task.calls[5] == ("reset_idx", [1], torch.int64)


def test_progress_and_reward_belong_to_current_step(tmp_path):
    env = build(direct(tmp_path))
    env.reset()
    for step in (1, 2, 3):
        result = env.step(IDLE)
        assert result.reward.tolist() == [step] * 3
        assert result.obs["policy"][:, 1].tolist() == [step] * 3
        assert env.task.progress_buf.tolist() == [step] * 3


def test_ended_env_gets_new_obs_and_final_obs(tmp_path):
    env = build(direct(tmp_path))
    env.reset()
    env.step(IDLE)
    env.engine.field("qpos")[1] = 2.0
    result = env.step(IDLE)
    assert result.terminated.tolist() == [False, True, False]
    assert result.obs["policy"].tolist() == [[0.25, 2.0], [0.25, 0.0], [0.25, 2.0]]
    assert result.final_obs["policy"][1].tolist() == [2.0, 2.0]
    assert result.final_obs["critic"][1].tolist() == [2.0, 2.0, 100.0]
    assert result.obs["critic"][1].tolist() == [0.25, 0.0, 100.0]
    assert result.episodes.returns.tolist() == [3.0]
    assert result.episodes.causes["task"].tolist() == [True]
    assert env.task.progress_buf.tolist() == [2, 0, 2]
    assert env.episode_length_buf.tolist() == [2, 0, 2]


def test_reset_buf_stays_set_until_next_pre_physics_step(tmp_path):
    env = build(direct(tmp_path))
    env.reset()
    env.step(IDLE)
    env.engine.field("qpos")[1] = 2.0
    env.step(IDLE)
    assert env.task.reset_buf.tolist() == [0, 1, 0]
    env.step(IDLE)
    assert env.task.flags == [[1, 1, 1], [0, 0, 0], [0, 1, 0]]
    assert env.task.reset_buf.tolist() == [0, 0, 0]


def test_time_out_is_added_as_truncation(tmp_path):
    env = build(direct(tmp_path))
    results = run(env, 20)
    assert [bool(r.truncated[0]) for r in results] == [step in (10, 20) for step in range(1, 21)]
    assert not any(r.terminated.any() for r in results)
    assert results[9].final_obs["policy"][0].tolist() == [0.25, 10.0]


OIGE = RECORDING.replace(
    """        self.calls.append("pre_physics_step")
""",
    """        self.calls.append("pre_physics_step")
        if not self.env.is_playing():
            return
        reset_env_ids = self.reset_buf.nonzero(as_tuple=False).squeeze(-1)
        if len(reset_env_ids) > 0:
            self.reset_idx(reset_env_ids)
        assert not self.reset_buf.any(), "its own reset has lowered the flags"
""",
)


def test_oige_style_reset_does_not_reset_twice(tmp_path):
    plain, own = build(direct(tmp_path / "a")), build(direct(tmp_path / "b", OIGE))
    for env in (plain, own):
        env.reset()
    for step in range(25):
        for env in (plain, own):
            if step in (3, 4, 17):
                env.engine.field("qpos")[step % 3] = 2.0
        a, b = (clone(env.step(torch.full((3, 1), 0.1))) for env in (plain, own))
        assert torch.equal(a.obs["policy"], b.obs["policy"])
        assert torch.equal(a.reward, b.reward)
        assert torch.equal(a.terminated, b.terminated)
        assert torch.equal(a.truncated, b.truncated)
    assert [c for c in own.task.calls if c[0] == "reset_idx"] == [c for c in plain.task.calls if c[0] == "reset_idx"]
    assert len([c for c in own.task.calls if c[0] == "reset_idx"]) > 3


def test_task_can_reset_running_env(tmp_path):
    code = RECORDING.replace('''        self.flags.append(''', '''        if self.progress_buf[2] == 4:
            self.reset_idx(torch.tensor([2]))
        self.flags.append(''')  # fmt: skip
    # the hook then runs on a state that the framework has not reset
    code = re.sub(r"        assert not self.robots.get_joint_positions.*\n", "", code)
    env = build(direct(tmp_path, code))
    env.reset()
    for _ in range(4):
        env.step(IDLE)
    env.engine.field("qpos")[2] = 0.9
    result = env.step(IDLE)
    assert result.obs["policy"].tolist() == [[0.25, 5.0], [0.25, 5.0], [0.25, 1.0]]
    assert env.episode_length_buf.tolist() == [5, 5, 1]


def test_actions_and_observations_are_clipped(tmp_path):
    env = build(direct(tmp_path, clip_actions=0.5, clip_observations=1.5))
    env.reset()
    for _ in range(2):
        result = env.step(torch.tensor([[3.0], [-0.2], [-9.0]]))
    assert env.task.actions[:, 0].tolist() == pytest.approx([0.5, -0.2, -0.5])
    assert result.obs["policy"][:, 1].tolist() == [1.5] * 3
    assert result.obs["critic"][:, 2].tolist() == [1.5] * 3
    free = build(direct(tmp_path / "free"))
    free.reset()
    free.step(torch.tensor([[3.0], [-0.2], [-9.0]]))
    assert free.task.actions[:, 0].tolist() == pytest.approx([3.0, -0.2, -9.0])


RESTLESS = RECORDING.replace(
    "        self.obs_buf[:, 1] = self.progress_buf\n",
    "        self.looks = getattr(self, 'looks', 0) + 1\n        self.obs_buf[:, 1] = self.looks\n",
)


def test_obs_after_reset_keeps_rows_of_running_envs(tmp_path):
    """This also holds for a task whose observation changes at each call."""
    env = build(direct(tmp_path, RESTLESS))
    env.reset()
    env.step(IDLE)
    env.engine.field("qpos")[1] = 2.0
    obs = env.step(IDLE).obs["policy"]
    assert obs[:, 1].tolist() == [3.0, 4.0, 3.0]
    assert env.task.obs_buf[:, 1].tolist() == [3.0, 4.0, 3.0]


def test_draws_depend_only_on_env_and_episode(tmp_path):
    code = RECORDING.replace(
        "        self.robots.set_joint_positions(torch.full((len(env_ids), 1), 0.25), indices=env_ids)\n"
        "        assert (self.robots.get_joint_positions(env_ids) == 0.25).all()\n",
        "        self.robots.set_joint_positions(self.draws(env_ids).uniform(-0.5, 0.5, (1,)), indices=env_ids)\n",
    )
    alone, together = build(direct(tmp_path, code)), build(direct(tmp_path, code))
    first = alone.reset()["policy"].clone()
    assert torch.equal(first, together.reset()["policy"])
    assert len(set(first[:, 0].tolist())) == 3
    alone.engine.field("qpos")[1] = together.engine.field("qpos")[:] = 2.0
    a, b = alone.step(IDLE).obs["policy"], together.step(IDLE).obs["policy"]
    assert torch.equal(a[1], b[1])
    assert a[1, 0] != first[1, 0]


def test_params_are_validated_by_params_model(tmp_path):
    params = "    class Params(StrictModel):\n        gain: float = 2.0\n\n"
    code = RECORDING.replace("    num_observations = 2\n", params + "    num_observations = 2\n")
    assert build(direct(tmp_path, code)).task.params.gain == 2.0
    assert build(direct(tmp_path / "b", code, params={"gain": 3.5})).task.params.gain == 3.5
    with pytest.raises(ConfigError, match="gian"):
        build(direct(tmp_path / "c", code, params={"gian": 3.5}))


def test_view_of_unknown_entity_lists_entities(tmp_path):
    with pytest.raises(TaskError, match=r"ArticulationView\('robto'\): no such entity") as caught:
        build(direct(tmp_path, RECORDING.replace('ArticulationView("robot")', 'ArticulationView("robto")')))
    assert "robot" in caught.value.hint


def test_module_without_direct_task_raises_task_error(tmp_path):
    with pytest.raises(TaskError, match="from DirectTask"):
        build(direct(tmp_path, "class Task:\n    pass\n"))
    with pytest.raises(TaskError, match="ZeroDivisionError"):
        build(direct(tmp_path / "b", "1 / 0\n"))


FLOATING = (
    HEAD
    + '''

class Task(DirectTask):
    """Task that applies the actions as joint efforts."""

    num_observations = 1
    num_actions = 4

    def set_up_scene(self, scene):
        self.robots = scene.add(ArticulationView("robot"))

    def pre_physics_step(self, actions):
        self.robots.set_joint_efforts(actions)

    def get_observations(self):
        self.obs_buf[:] = self.robots.get_joint_positions()[:, :1]

    def calculate_metrics(self):
        self.rew_buf[:] = 0.0

    def is_done(self):
        self.reset_buf[:] = 0
'''
)


def floating(tmp_path, robot=None, xml=CRITTER):
    scene = {"num_envs": 4, "ground": None, "entities": {"robot": {"model": "pendulum.xml", **(robot or {})}}}
    env = build(direct(tmp_path, FLOATING, xml, scene=scene))
    env.reset()
    return env, env.task.robots


def test_view_has_joint_names_and_indices(tmp_path):
    env, view = floating(tmp_path)
    assert (view.count, view.num_dof) == (4, 4)
    assert view.dof_names == ["hip_fl", "hip_fr", "hip_bl", "hip_br"]
    assert view.get_dof_index("hip_bl") == 2
    with pytest.raises(TaskError, match="view 'robot' has no joint 'hip_xx'"):
        view.get_dof_index("hip_xx")
    limits = view.get_dof_limits()
    assert limits.shape == (4, 4, 2)
    assert limits[3, 1].tolist() == pytest.approx([-math.pi / 3, math.pi / 3])
    assert env.num_envs == 4


def test_joint_setters_and_getters_accept_indices(tmp_path):
    env, view = floating(tmp_path)
    values = torch.arange(16.0).view(4, 4) / 100
    view.set_joint_positions(values)
    view.set_joint_velocities(-values)
    assert torch.equal(view.get_joint_positions(), values)
    assert torch.equal(view.get_joint_velocities(), -values)
    assert torch.equal(env.engine.field("qpos")[:, 7:].float(), values)
    rows = torch.tensor([3, 1], dtype=torch.int32)
    view.set_joint_positions(torch.full((2, 4), 0.5), indices=rows)
    expected = values.clone()
    expected[[3, 1]] = 0.5
    assert torch.equal(view.get_joint_positions(), expected)
    assert torch.equal(view.get_joint_positions(indices=torch.tensor([2, 3])), expected[[2, 3]])
    view.set_joint_velocities(torch.stack([values[0], values[1]]), indices=rows)
    assert torch.equal(view.get_joint_velocities(indices=rows), values[:2])


def test_clone_false_returns_live_view(tmp_path):
    _, view = floating(tmp_path)
    copy, live_view = view.get_joint_positions(), view.get_joint_positions(clone=False)
    view.set_joint_positions(torch.full((4, 4), 0.5))
    assert not copy.any()
    assert (live_view == 0.5).all()
    copy[:] = 9.0
    assert (view.get_joint_positions() == 0.5).all()


def test_root_pose_and_velocity_round_trip_in_world_frame(tmp_path):
    env, view = floating(tmp_path)
    assert view.get_world_poses()[0][0].tolist() == pytest.approx([0, 0, 0.35])
    half = math.sqrt(0.5)
    rows = torch.tensor([2, 0])
    view.set_world_poses(torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), torch.tensor([[half, 0, 0, half]] * 2), rows)
    view.set_velocities(torch.tensor([[1.0, 0.0, 0.0, 0.5, 0.0, 0.0]] * 2), rows)
    position, quat = view.get_world_poses(rows)
    assert position.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert quat[0].tolist() == pytest.approx([half, 0, 0, half])
    assert view.get_velocities(rows)[1].tolist() == pytest.approx([1, 0, 0, 0.5, 0, 0], abs=1e-6)
    # with a yaw of 90 degrees, the world's x axis is the body's -y axis
    assert env.engine.field("qvel")[2, :6].tolist() == pytest.approx([1, 0, 0, 0, -0.5, 0], abs=1e-6)
    assert view.get_world_poses()[0][1].tolist() == pytest.approx([0, 0, 0.35]), "others stay"


def test_set_velocities_turns_about_world_axis(tmp_path):
    env, view = floating(tmp_path)
    turn = torch.tensor([[math.cos(0.4), 0, math.sin(0.4), 0]]).expand(4, 4)  # a pitch of 0.8 rad
    view.set_world_poses(torch.zeros(4, 3), turn)
    view.set_velocities(torch.tensor([[0.0, 0, 0, 0, 0, 0.5]]).expand(4, 6))
    before = view.get_world_poses()[1]
    env.step(torch.zeros(4, 4))
    after = view.get_world_poses()[1]
    # rotation between the two, world frame: after * conj(before)
    w, x, y, z = after[0].tolist()
    a, b, c, d = (before[0] * torch.tensor([1.0, -1, -1, -1])).tolist()
    axis = [w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a]
    assert axis[2] > 0.004
    assert abs(axis[0]) < 0.1 * axis[2]
    assert abs(axis[1]) < 0.1 * axis[2]


def test_joint_efforts_are_limited(tmp_path):
    env, view = floating(tmp_path, {"joints": {"hip_fl": {"effort_limit": 2.0}}})
    force = env.engine.field("qfrc_actuator")
    env.step(torch.tensor([[5.0, 5.0, -1.0, 0.0]]).expand(4, 4))
    assert force[1, 6:].tolist() == pytest.approx([2.0, 5.0, -1.0, 0.0])
    view.set_joint_efforts(torch.full((1, 4), 0.5), indices=torch.tensor([3]))
    assert env.engine.field("ctrl")[3].tolist() == [0.5] * 4
    assert env.engine.field("ctrl")[0].tolist() == [5.0, 5.0, -1.0, 0.0]


def test_joint_efforts_account_for_gear(tmp_path):
    geared = '<actuator><motor joint="hip_fr" gear="40"/></actuator></mujoco>'
    env, _ = floating(tmp_path, {"joints": {"hip_fr": {"effort_limit": 3.0}}}, CRITTER.replace("</mujoco>", geared))
    force = env.engine.field("qfrc_actuator")
    env.step(torch.tensor([[0.5, 2.0, 0.0, 0.0]]).expand(4, 4))
    assert force[0, 6:].tolist() == pytest.approx([0.5, 2.0, 0.0, 0.0])
    env.step(torch.tensor([[0.5, 9.0, 0.0, 0.0]]).expand(4, 4))
    assert force[0, 7].item() == pytest.approx(3.0)


def test_joint_setters_set_actuator_targets(tmp_path):
    servo = '<actuator><position joint="hip_bl" kp="5" gear="2"/><velocity joint="hip_br" kv="3"/></actuator></mujoco>'
    env, view = floating(tmp_path, xml=CRITTER.replace("</mujoco>", servo))
    servo_column, velocity_column = 0, 1
    view.set_joint_positions(torch.tensor([[0.0, 0.0, 0.3, 0.1]]).expand(4, 4))
    view.set_joint_velocities(torch.tensor([[0.0, 0.0, 0.2, 0.7]]).expand(4, 4))
    ctrl = env.engine.field("ctrl")
    assert float(ctrl[1, servo_column]) == pytest.approx(2 * 0.3)
    assert float(ctrl[1, velocity_column]) == pytest.approx(0.7)
    view.set_joint_position_targets(torch.full((1, 4), -0.2), indices=torch.tensor([1]))
    view.set_joint_velocity_targets(torch.full((1, 4), 0.4), indices=torch.tensor([1]))
    assert ctrl[1, :2].tolist() == pytest.approx([-0.4, 0.4])
    assert float(ctrl[0, servo_column]) == pytest.approx(0.6)


def test_set_world_poses_rejects_fixed_robot(tmp_path):
    env = build("cartpole-direct", 2)
    env.reset()
    with pytest.raises(TaskError, match="fixed to the world"):
        env.task.cartpoles.set_world_poses(torch.zeros(2, 3), torch.tensor([[1.0, 0, 0, 0]] * 2))
    assert env.task.cartpoles.get_world_poses()[0].tolist() == [[0, 0, 2]] * 2
    assert not env.task.cartpoles.get_velocities().any()


def test_kept_observation_views_do_not_change(tmp_path):
    env = build("cartpole-direct", 4)
    env.reset()
    first, second = (env.step(a) for a in actions(2, 4, 1))
    assert not torch.equal(first.obs["policy"], second.obs["policy"])
    assert not torch.equal(first.reward, second.reward)
