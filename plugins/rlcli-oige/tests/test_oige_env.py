"""Tasks in OmniIsaacGymEnvs' form in the environment loop."""

import pytest
import torch
from reacher import TASK, YAML, arm_folder

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, TaskError
from rlcli.registry import find_task

torch.set_num_threads(1)


def build(folder, *overrides, seed=3):
    torch.manual_seed(seed)
    return make_env(resolve(find_task(str(folder)), overrides=overrides), seed=seed)


@pytest.fixture
def env(tmp_path):
    env = build(arm_folder(tmp_path / "arm"))
    env.reset()
    return env


IDLE = torch.zeros(4, 1)


def test_task_runs_with_only_import_lines_changed(env):
    for _ in range(30):
        result = env.step(torch.ones(4, 1))
    assert result.obs["policy"].shape == (4, 4)
    assert env.task.world.is_playing()
    assert env.task._env._world.is_playing()
    assert set(env.extras()) == {"Task/angle"}


STAR = TASK.replace("from rlcli_oige import limit_of_the_angle\n", "").replace(
    "from rlcli_oige import ArticulationView, DynamicSphere, RigidPrimView, RLTask, Robot, get_prim_at_path\n", ""
)


def as_package(folder):
    """Move the arm's files to the folders of the original repository: classes, shared modules, and `cfg`."""
    arm_folder(folder, task=STAR)
    for file, place in (
        ("arm.py", "tasks"),
        ("shared.py", "robots/articulations/views"),
        ("Arm.yaml", "cfg/task"),
        ("arm.xml", "cfg/task"),
        ("ArmPPO.yaml", "cfg/train"),
    ):
        (folder / place).mkdir(parents=True, exist_ok=True)
        (folder / file).rename(folder / place / file)
    return folder


@pytest.mark.parametrize("name", [".", "cfg/task/Arm.yaml"])
def test_package_keeps_folders_and_star_import_finds_all(tmp_path, name):
    folder = as_package(tmp_path / "arms")
    action = torch.linspace(-1.0, 1.0, 4)[:, None]
    rollouts = []
    for env in (build(folder / name), build(arm_folder(tmp_path / "arm"))):
        torch.manual_seed(0)
        env.reset()
        rollouts.append([(step.obs["policy"].clone(), step.reward.clone()) for step in map(env.step, [action] * 15)])
    assert all(
        torch.equal(a, b) for ours, theirs in zip(*rollouts, strict=True) for a, b in zip(ours, theirs, strict=True)
    )
    assert resolve(find_task(str(folder / name))).agent.num_epochs == 3  # of cfg/train


def test_star_import_keeps_own_definitions(tmp_path):
    own = STAR.replace("class ArmTask(", "def limit_of_the_angle():\n    return 0.0\n\n\nclass ArmTask(")
    env = build(arm_folder(tmp_path / "arm", task=own))
    env.reset()
    assert env.step(IDLE).terminated.all()  # its own limit, not that of the other file


def test_tasks_of_package_are_chosen_by_file(tmp_path):
    folder = as_package(tmp_path / "arms")
    (folder / "cfg" / "task" / "Leg.yaml").write_text(YAML.replace("name: Arm", "name: Leg"))
    with pytest.raises(TaskError, match="several tasks") as caught:
        find_task(str(folder))
    assert "arms/cfg/task/Arm.yaml" in caught.value.hint


def test_time_out_truncates_and_failure_terminates(env):
    position = env.engine.field("qpos")
    left = env.task._arms._qpos_columns[env.task._left]
    for _ in range(10):
        result = env.step(IDLE)
        assert not (result.terminated | result.truncated).any()
    position[2, left] = 0.9  # this one fails in the step in which time runs out for all
    result = env.step(IDLE)
    assert result.terminated.tolist() == [False, False, True, False]
    assert result.truncated.tolist() == [True, True, False, True]
    assert env.episode_length_buf.tolist() == [0, 0, 0, 0]
    assert result.episodes.lengths.tolist() == [11, 11, 11, 11]


def test_reset_flag_at_full_length_truncates(tmp_path):
    task = TASK.replace("self._max_episode_length - 1", "self._max_episode_length")
    env = build(arm_folder(tmp_path / "arm", task=task))
    env.reset()
    results = [env.step(IDLE) for _ in range(12)]
    assert not any((r.terminated | r.truncated).any() for r in results[:-1])
    assert results[-1].truncated.all()
    assert not results[-1].terminated.any()


def test_episode_length_override_reaches_class(tmp_path):
    env = build(arm_folder(tmp_path / "arm"), "episode_length_s=0.1")
    assert env.task._max_episode_length == env.max_episode_length == 5


def test_reward_uses_exact_obs_and_policy_gets_clipped_obs(env):
    result = env.step(IDLE)
    assert (result.obs["policy"][:, 3] == 5.0).all()
    assert (result.reward > 90.0).all()


def test_joints_and_bodies_are_breadth_first(env):
    arms = env.task._arms
    assert arms.dof_names == ["left_a", "right_a", "left_b"]
    assert arms.body_names == ["base", "left", "right", "left_tip"]
    env.engine.field("qpos")[:, :3] = torch.tensor([0.1, 0.2, 0.3]).double()  # depth first: left_a, left_b, right_a
    env.sim.refresh()
    assert arms.get_joint_positions()[0].tolist() == pytest.approx([0.1, 0.3, 0.2])
    limits = arms.get_dof_limits()
    assert limits.shape == (4, 3, 2)
    assert limits[0, 0].tolist() == [-1.0, 1.0]
    assert limits[0, 1].isinf().all()


def test_setters_write_selected_rows_and_joints(env):
    arms = env.task._arms
    before = arms.get_joint_positions()
    arms.set_joint_positions(
        torch.tensor([[0.7], [0.8]]), indices=torch.tensor([3, 1]), joint_indices=torch.tensor([2])
    )
    after = arms.get_joint_positions()
    assert after[3, 2] == pytest.approx(0.7)
    assert after[1, 2] == pytest.approx(0.8)
    changed = torch.zeros(4, 3, dtype=torch.bool)
    changed[3, 2] = changed[1, 2] = True
    assert torch.equal(after[~changed], before[~changed])
    with pytest.raises(TaskError, match=r"values of shape \(3, 3\) for 4 environments and 3 joints"):
        arms.set_joint_positions(torch.zeros(3, 3))


def test_world_poses_are_grid_and_start_position_of_root(env):
    position, _ = env.task._arms.get_world_poses()
    assert torch.allclose(position - env.task._env_pos, torch.tensor([0.0, 0.0, 0.5]))
    assert env.task._env_pos[:, :2].unique(dim=0).shape[0] == 4
    assert torch.allclose(env.task._balls.get_world_poses()[0], env.task._env_pos + torch.tensor([0.0, 0.0, 2.0]))


def test_kinematic_body_stays_and_free_body_falls(env):
    for _ in range(5):
        env.step(IDLE)
    balls, boxes = env.task._balls.get_world_poses()[0], env.task._boxes.get_world_poses()[0]
    assert torch.allclose(balls[:, 2], torch.full((4,), 2.0))
    time = 10 * 0.01
    # semi-implicit Euler falls half a step farther than the exact parabola
    assert torch.allclose(boxes[:, 2], torch.full((4,), 2.0 - 0.5 * 9.81 * time * (time + 0.01)), atol=1e-4)


def test_force_acts_for_one_step_in_its_frame(env):
    boxes = env.task._boxes
    half_turn = torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(4, 1)  # around z
    boxes.set_world_poses(boxes.get_world_poses()[0], half_turn)
    boxes.set_velocities(torch.zeros(4, 6))
    env.engine.forward(env._select_all())
    env.sim.refresh()
    act = env.task.pre_physics_step

    def push(actions):
        act(actions)
        boxes.apply_forces(torch.tensor([[3.0, 0.0, 0.0]]), indices=torch.tensor([0]), is_global=False)
        boxes.apply_forces(torch.tensor([[3.0, 0.0, 0.0]]), indices=torch.tensor([1]))

    env.task.pre_physics_step = push
    env.step(IDLE)
    env.task.pre_physics_step = act
    speed = boxes.get_velocities()[:, 0]
    # 3 N on 3 kg for two steps of 0.01 s
    assert torch.allclose(speed, torch.tensor([-0.02, 0.02, 0.0, 0.0]), atol=1e-6)
    env.step(IDLE)
    assert torch.allclose(boxes.get_velocities()[:, 0], speed, atol=1e-6)


def test_view_of_links_orders_rows_by_env(env):
    links = env.task._links
    assert links.count == 8
    position = links.get_world_poses()[0].reshape(4, 2, 3) - env.task._env_pos[:, None]
    assert torch.allclose(position[:, 0, 1], torch.full((4,), 0.1), atol=1e-6)
    assert torch.allclose(position[:, 1, 1], torch.full((4,), -0.1), atol=1e-6)


def test_effort_adds_to_drive_and_target_moves_joint(env):
    arms = env.task._arms
    arms.set_joint_efforts(torch.tensor([0.0, 0.5, 0.0]).repeat(4, 1))
    assert torch.allclose(env.engine.field("qfrc_applied")[:, arms._dof_columns[1]].float(), torch.full((4,), 0.5))
    assert arms.get_applied_joint_efforts()[0].tolist() == [0.0, 0.5, 0.0]
    arms.set_joint_position_targets(torch.tensor([0.0, 0.3, 0.0]).repeat(4, 1))
    assert torch.allclose(env.engine.field("ctrl")[:, arms._drives["position"][1]].float(), torch.full((4, 1), 0.3))
    with pytest.raises(TaskError, match="no joint of 'Arm' has a velocity actuator"):
        arms.set_joint_velocity_targets(torch.zeros(4, 3))


def test_measured_joint_forces_carry_weight_of_children(tmp_path):
    task = TASK.replace("self.obs_buf[:, 3] = 100.0", "self.wrench = self._arms.get_measured_joint_forces()")
    env = build(arm_folder(tmp_path / "arm", task=task), "oige.env.maxEffort=0.0")
    env.reset()
    arms = env.task._arms
    assert not env.task.wrench.any(), "no force has acted on a start state"
    zero = torch.zeros(4, 3)
    arms.set_joint_positions(zero)
    arms.set_joint_velocities(zero)
    env.step(IDLE)
    assert env.task.wrench.shape == (4, 4, 6)
    # all upright: each joint carries the weight above it, along the body's z axis
    weights = 9.81 * torch.tensor([0.7, 0.5, 0.2])
    assert torch.allclose(env.task.wrench[:, 1:, 2], weights.expand(4, -1), rtol=1e-2)


def test_restored_state_continues_bit_for_bit(env):
    actions = [torch.rand(4, 1) * 2 - 1 for _ in range(20)]
    for action in actions[:5]:
        env.step(action)
    state = env.state_dict()
    first = [env.step(action) for action in actions[5:]]
    first = [(r.obs["policy"].clone(), r.reward.clone()) for r in first[-1:]]
    env.load_state_dict(state)
    for action in actions[5:]:
        result = env.step(action)
    assert torch.equal(result.obs["policy"], first[0][0])
    assert torch.equal(result.reward, first[0][1])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("self.reset_buf[:] = resets", "self.reset_buf = resets > 0"),
        ("self.reset_buf[:] = resets", "self.reset_buf = resets.float()"),
        ("self.rew_buf[:] = ", "self.rew_buf = 1 + "),
        ("self.rew_buf[:] = ", "self.rew_buf = 2 * self.reset_buf + self.progress_buf  # "),
    ],
)
def test_state_is_restored_in_a_task_that_replaces_its_buffers(tmp_path, old, new):
    assert TASK.count(old) == 1
    folder = arm_folder(tmp_path / "arm", task=TASK.replace(old, new))
    first, second = build(folder), build(folder)
    first.reset()
    second.reset()
    for _ in range(5):
        first.step(torch.ones(4, 1))
    state = first.state_dict()
    found = []
    for env in (first, second):  # one after the other: both draw from torch's global generator
        env.load_state_dict(state)
        steps = [env.step(torch.ones(4, 1)) for _ in range(5)]
        found.append((steps[-1].obs["policy"].clone(), steps[-1].reward.clone(), steps[-1].terminated.clone()))
    assert all(map(torch.equal, *found))


@pytest.mark.parametrize(
    ("where", "old", "new", "error", "message"),
    [
        ("task", '/.*/Arm"', '/.*/Army"', TaskError, "no prim path matches '/World/envs/.*/Army'"),
        ("task", '"left_a"', '"left_c"', TaskError, "view 'arm_view' has no joint 'left_c'"),
        ("task", '["maxEffort"]', '["maxForce"]', TaskError, "ArmTask reads the key 'maxForce', which is missing"),
        ("task", "super().set_up_scene(scene)", "pass", TaskError, "set_up_scene does not call RLTask.set_up_scene"),
        ("task", "self._num_actions = 1", "pass", TaskError, "ArmTask does not set _num_actions"),
        ("task", "limit_of_the_angle", "limit_of_the_angel", TaskError, "rlcli_oige"),
        (
            "yaml",
            "  /World/envs/.*/Arm: arm.xml",
            "  Leg: arm.xml",
            ConfigError,
            "'/World/envs/env_0/Arm' has no model",
        ),
        ("yaml", "arm.xml", "leg.xml", ConfigError, "no file"),
        ("yaml", "Arm: arm.xml", "Arm: {model: arm.xml, joints: {x: knee}}", ConfigError, "arm.xml has no 'knee'"),
    ],
)
def test_invalid_task_is_reported_when_env_is_built(tmp_path, where, old, new, error, message):
    text = {"task": TASK, "yaml": YAML}
    text[where] = text[where].replace(old, new)
    with pytest.raises(error) as caught:
        build(arm_folder(tmp_path / "arm", **text))
    assert message in str(caught.value)


def test_names_in_yaml_replace_names_of_model(tmp_path):
    yaml = YAML.replace("Arm: arm.xml", "Arm: {model: arm.xml, joints: {shoulder: left_a}, bodies: {hand: left_tip}}")
    env = build(arm_folder(tmp_path / "arm", yaml=yaml, task=TASK.replace('"left_a"', '"shoulder"')))
    assert env.task._arms.dof_names == ["shoulder", "right_a", "left_b"]
    assert env.task._arms.get_body_index("hand") == 3


@pytest.mark.parametrize("robot", ["Cartpole", "Ant", "Humanoid", "Crazyflie", "Quadcopter", "Ingenuity"])
def test_robot_classes_have_built_in_models(tmp_path, robot):
    task = TASK.replace("Robot(prim_path", f"{robot}(prim_path").replace('"left_a"', "self._arms.dof_names[0]")
    task = task.replace("/Arm/(left|right)", "/Arm").replace("self.dof_pos\n", "self.dof_pos[:, :1]\n")
    task = task.replace("import ArticulationView", f"import {robot}, ArticulationView")
    env = build(arm_folder(tmp_path / "arm", yaml=YAML.partition("mjcf:")[0], task=task), "scene.num_envs=2")
    env.reset()
    for _ in range(3):
        result = env.step(torch.zeros(2, 1))
    assert result.obs["policy"].isfinite().all()
    joints = {"Cartpole": 2, "Ant": 8, "Humanoid": 21, "Crazyflie": 4, "Quadcopter": 8, "Ingenuity": 4}
    assert env.task._arms.num_dof == joints[robot]
