"""Order of the parts of a step and of a reset in tasks of Isaac Lab, which decides what their code reads and writes."""

import logging

import pytest
import torch
from test_isaaclab_silent_differences import pole as pole
from test_isaaclab_user_code import rover

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli_isaaclab.runtime import facade_of

torch.set_num_threads(1)


def started(resolved):
    env = make_env(resolved, seed=0)
    env.reset()
    return env


def stepped(env, steps, action=0.0):
    for _ in range(steps):
        result = env.step(torch.full((env.num_envs, env.layout.action_size), action))
    return result


# commands

GOAL = """
from isaaclab.managers import CommandTerm, CommandTermCfg
LOG = []

class Goal(CommandTerm):
    def __init__(self, cfg, env):
        super().__init__(cfg, env)
        self.goal = torch.zeros(self.num_envs, 1, device=self.device)
        self.metrics["distance"] = torch.zeros(self.num_envs, device=self.device)
        self.metrics["updates"] = torch.zeros(self.num_envs, device=self.device)

    @property
    def command(self):
        return self.goal

    def _update_metrics(self):
        self.metrics["distance"] = self.goal[:, 0].abs()
        self.metrics["updates"] += 1.0

    def _resample_command(self, env_ids):
        LOG.append(len(env_ids))
        self.goal[env_ids] += 1.0

    def _update_command(self):
        BODY

@configclass
class GoalCfg(CommandTermCfg):
    class_type: type = Goal
"""
NEAR = "self._resample((self.metrics['distance'] < 0.5).nonzero().flatten())"
COMMAND = {"goal": "GoalCfg(resampling_time_range=(0.2, 0.2))"}


def goal(tmp_path, body, extra=""):
    env = make_env(rover(tmp_path / "rover", GOAL.replace("BODY", body) + extra, commands=COMMAND), seed=0)
    return env, env.command_manager.get_term("goal").term


def test_update_of_a_new_episode_reads_metrics_of_its_first_state(tmp_path):
    env, term = goal(tmp_path, NEAR)
    env.reset()
    assert term.goal.tolist() == [[1.0]] * 4  # a metric of 0 would have resampled the goal once more
    term.goal[1] = 0.0
    stepped(env, 1)
    assert term.goal.tolist() == [[1.0]] * 4
    assert term.command_counter.tolist() == [1, 2, 1, 1]


def test_metrics_are_updated_once_per_step_and_episode_start(tmp_path):
    env, term = goal(tmp_path, "pass")
    env.reset()
    assert term.metrics["updates"].tolist() == [1.0] * 4
    stepped(env, 3)
    assert term.metrics["updates"].tolist() == [4.0] * 4
    env.episode_length_buf[2] = env.max_episode_length - 1
    stepped(env, 1)
    assert term.metrics["updates"].tolist() == [5.0, 5.0, 1.0, 5.0]


def test_own_resampling_starts_the_time_again(tmp_path):
    env, term = goal(tmp_path, "self._resample((self.goal[:, 0] < 0.0).nonzero().flatten())")
    env.reset()
    stepped(env, 4)
    assert term.time_left.tolist() == pytest.approx([0.12] * 4)
    term.goal[3] = -5.0
    stepped(env, 1)
    assert term.time_left.tolist() == pytest.approx([0.1, 0.1, 0.1, 0.2])
    stepped(env, 5)
    assert term.command_counter.tolist() == [2, 2, 2, 6]
    assert term.time_left[:3].tolist() == pytest.approx([0.2] * 3)


def test_command_is_not_resampled_for_no_environments(tmp_path):
    env, _ = goal(tmp_path, "self._resample(torch.zeros(0, dtype=torch.long))")
    env.reset()
    stepped(env, 9)
    log = env.command_manager.get_term("goal").term._resample_command.__globals__["LOG"]
    assert log == [4]


def test_time_that_the_task_writes_decides_when_a_command_is_resampled(tmp_path):
    env, term = goal(tmp_path, "self.time_left[1] = 0.0")
    env.reset()
    stepped(env, 3)
    assert term.command_counter.tolist() == [1, 4, 1, 1]


OWN_RESET = """
def own_reset(self, env_ids=None):
    found = CommandTerm.reset(self, env_ids)
    self.goal[env_ids] = 7.0
    return {**found, "reached": 3.0}

def own_compute(self, dt):
    self.calls = getattr(self, "calls", 0) + 1
    CommandTerm.compute(self, dt)

Goal.reset, Goal.compute = own_reset, own_compute
"""


def test_own_reset_and_compute_of_a_command_extend_those_of_isaac_lab(tmp_path):
    env, term = goal(tmp_path, "pass", OWN_RESET)
    env.reset()
    assert term.goal.tolist() == [[7.0]] * 4  # written after the command was sampled
    assert facade_of(env).extras["log"]["Metrics/goal/reached"] == 3.0
    stepped(env, 3)
    assert term.calls == 4


def test_saved_commands_go_on_with_their_time_and_metrics(tmp_path):
    env, term = goal(tmp_path, NEAR)
    env.reset()
    stepped(env, 4)
    state, time = env.state_dict(), term.time_left.clone()
    stepped(env, 3)
    expected = (term.time_left.clone(), term.goal.clone())
    env.load_state_dict(state)
    assert torch.equal(term.time_left, time)
    stepped(env, 3)
    assert torch.equal(term.time_left, expected[0])
    assert torch.equal(term.goal, expected[1])


# actions

HALF = """
class Half(mdp.JointVelocityAction):
    def apply_actions(self):
        self._asset.set_joint_velocity_target(0.5 * self.processed_actions, joint_ids=self._joint_ids)

class Follow(mdp.RelativeJointPositionAction):
    pass
"""


def test_own_action_leaves_the_joints_of_other_actions_alone(tmp_path):
    arm = 'arm = mdp.JointPositionActionCfg(asset_name="robot", joint_names=["arm"])'
    wheel = 'wheel = mdp.JointVelocityActionCfg(asset_name="robot", joint_names=["wheel"])'
    both = (  # the own action acts in each physics step, after the built-in one
        "pair = mdp.JointPositionActionCfg(asset_name='robot', joint_names=['arm'], use_default_offset=False)",
        "wheel = mdp.RelativeJointPositionActionCfg(asset_name='robot', joint_names=['wheel'], scale=0.0)",
    )
    stiff = ('joint_names_expr=["wheel"], stiffness=0.0', 'joint_names_expr=["wheel"], stiffness=5.0')
    env = started(rover(tmp_path / "rover", HALF, [(arm, both[0]), (wheel, both[1]), stiff]))
    stepped(env, 5, 0.3)
    asset = facade_of(env).scene["robot"]
    model, controls = env.engine.model, env.engine.field("ctrl")
    by_name = {model.actuator(i).name.split("/")[-1]: controls[:, i].tolist() for i in range(model.nu)}
    assert by_name["arm"] == pytest.approx([0.3] * 4)
    assert asset.data.joint_pos[:, asset.find_joints("arm")[0]].abs().min() > 0.05


WRENCH = """
def lift(env, env_ids):
    asset = env.scene["robot"]
    force = torch.zeros(len(env_ids), asset.num_bodies, 3)
    force[:, 0, 2] = 6.0
    asset.set_external_force_and_torque(force, torch.zeros_like(force), env_ids=env_ids, is_global=True)
"""


def test_force_of_a_reset_event_acts_beside_an_own_action(tmp_path):
    wheel = "wheel = mdp.JointVelocityActionCfg("
    own = ("wheel = mdp.JointVelocityActionCfg(", "wheel = mdp.JointVelocityActionCfg(class_type=Half, ")
    assert wheel == own[0]
    events = {"lift": "EventTermCfg(func=lift, mode='reset')"}
    env = started(rover(tmp_path / "rover", HALF + WRENCH, [own], events=events))
    stepped(env, 1)
    assert env.engine.field("xfrc_applied")[:, 1, 2].tolist() == pytest.approx([6.0] * 4)


# state at resets

SEEN = """
SEEN = []

def look(env, env_ids):
    SEEN.append(env.scene["robot"].data.joint_pos[env_ids].clone())
"""


def test_own_reset_event_reads_the_last_state_and_what_no_event_writes_stays(tmp_path):
    events = {
        "look": "EventTermCfg(func=look, mode='reset')",
        "root": "EventTermCfg(func=mdp.reset_root_state_uniform, mode='reset', params={'pose_range': {},"
        " 'velocity_range': {}})",
    }
    resolved = rover(tmp_path / "rover", SEEN, events=events)
    assert resolved.task.keep_state_at_reset
    env = started(resolved)
    stepped(env, 10, 0.4)
    robot = env.entities["robot"].data
    env.episode_length_buf[1] = env.max_episode_length - 1
    stepped(env, 1, 0.4)
    seen = env._bound["events"][0].call.term.__globals__["SEEN"][-1]
    assert seen.abs().min() > 0.05
    assert torch.equal(robot.joint_pos[1], seen[0])
    assert torch.equal(robot.root_pos_w[1], robot.default_root_state[1, :3])


@pytest.mark.parametrize(
    ("events", "kept"),
    [
        (["reset_scene_to_default"], False),
        (["reset_joints_by_offset", "reset_root_state_uniform"], False),
        (["reset_joints_by_offset"], True),
        (["reset_root_state_uniform"], True),
        (["reset_joints_by_offset, arm", "reset_root_state_uniform"], True),
        (["reset_joints_by_offset, arm", "reset_joints_by_offset, wheel", "reset_root_state_uniform"], False),
        ([], True),
    ],
)
def test_state_is_kept_if_events_do_not_write_all_of_it(tmp_path, events, kept):
    ranges = {
        "reset_scene_to_default": "{}",
        "reset_joints_by_offset": "{'position_range': (-0.01, 0.01), 'velocity_range': (0.0, 0.0)}",
        "reset_root_state_uniform": "{'pose_range': {'x': (-0.1, 0.1)}, 'velocity_range': {}}",
    }
    terms = {}
    for number, event in enumerate(events):
        name, _, joint = event.partition(", ")
        params = ranges[name]
        if joint:
            params = params.replace("}", f", 'asset_cfg': SceneEntityCfg('robot', joint_names=['{joint}'])}}")
        terms[f"e{number}"] = f"EventTermCfg(func=mdp.{name}, mode='reset', params={params})"
    resolved = rover(tmp_path / "rover", events=terms)
    assert resolved.task.keep_state_at_reset is kept
    env = started(resolved)
    stepped(env, 10, 0.4)
    env.episode_length_buf[:] = env.max_episode_length - 1
    stepped(env, 1, 0.4)
    wheel = env.entities["robot"].data.joint_pos[:, 1]
    assert (wheel.abs() > 0.02).all() == (kept and "reset_joints_by_offset" not in events)


def test_state_is_not_kept_if_several_events_write_all_of_it(package):
    assert not resolve(find_task(str(package()))).task.keep_state_at_reset


# direct tasks

EVENTS = """
from isaaclab.managers import EventTermCfg, SceneEntityCfg

def shift(env, env_ids, amount):
    robot = env.scene["robot"]
    position = robot.data.default_joint_pos[env_ids] + amount
    robot.write_joint_state_to_sim(position, torch.zeros_like(position), env_ids=env_ids)

@configclass
class Events:
    shift = EventTermCfg(func=shift, mode="reset", params={"amount": 0.25})

"""
CLASS = "\n@configclass\nclass PoleEnvCfg(DirectRLEnvCfg):\n"
SUPER = "        super()._reset_idx(env_ids)\n"
WRITE = (
    "        position = self.robot.data.default_joint_pos[env_ids]\n"
    "        self.robot.write_joint_state_to_sim(position, torch.zeros_like(position), None, env_ids)\n"
)


@pytest.mark.parametrize(("order", "expected"), [("super first", 0.0), ("super last", 0.25), ("no super", 0.0)])
def test_reset_events_of_a_direct_task_run_at_the_call_of_super(pole, order, expected):
    body = {"super first": SUPER + WRITE, "super last": WRITE + SUPER, "no super": WRITE}[order]
    env = started(pole((CLASS, EVENTS + CLASS + "    events: Events = Events()\n"), (SUPER + WRITE, body)))
    assert env.entities["robot"].data.joint_pos[:, 0].tolist() == [expected] * 4
    stepped(env, 30, 1.0)
    env.episode_length_buf[:] = env.max_episode_length - 1
    assert stepped(env, 1).truncated.all()
    assert env.entities["robot"].data.joint_pos[:, 0].tolist() == [expected] * 4


def test_reset_of_a_direct_task_reads_the_last_state(pole):
    read = "        self.last = self.robot.data.joint_pos[env_ids, 0].clone()\n"
    env = started(pole((SUPER + WRITE, read + SUPER + WRITE)))
    lab = vars(env)["_isaaclab_direct"].lab
    assert lab.last.tolist() == [0.0] * 4
    stepped(env, 5, 1.0)
    before = env.entities["robot"].data.joint_pos[:, 0].clone()
    env.episode_length_buf[:] = env.max_episode_length - 1
    stepped(env, 1, 1.0)
    assert (lab.last > before).all()
    assert env.entities["robot"].data.joint_pos[:, 0].tolist() == [0.0] * 4


def test_episode_lengths_that_a_direct_task_sets_in_a_reset_are_reported(pole):
    spread = SUPER + "        self.episode_length_buf[:] = torch.randint_like(self.episode_length_buf, high=9)\n"
    (note,) = [note for note in pole((SUPER, spread)).notes if "episode_length_buf" in note.key]
    assert note.status == "ignored"
    assert "pole_env.py:68: every episode starts at step 0" in note.text
    zero = SUPER + "        self.episode_length_buf[env_ids] = 0  # as the base class\n"
    assert not [note for note in pole((SUPER, zero)).notes if "episode_length_buf" in note.key]


@pytest.mark.parametrize("turn", ["", "        pose[:, 3:] = torch.tensor([0.0, 0.0, 0.0, 1.0])\n"])
def test_orientation_of_a_fixed_base_that_a_task_sets_is_reported(pole, caplog, turn):
    pose = "        pose = self.robot.data.default_root_state[env_ids, :7].clone()\n"
    write = "        self.robot.write_root_pose_to_sim(pose, env_ids)\n"
    with caplog.at_level(logging.WARNING):
        started(pole((SUPER, SUPER + pose + turn + write)))
    reported = "is fixed in its MJCF: the orientation that the task sets is ignored" in caplog.text
    assert reported is bool(turn)


def test_step_of_a_direct_tasks_own_class_is_reported(pole, caplog):
    own = "    def step(self, action):\n        return super().step(2.0 * action)\n\n    def _get_rewards(self):"
    with caplog.at_level(logging.WARNING):
        notes = pole(("    def _get_rewards(self):", own)).notes
    assert "rlcli does not run the method step of the class PoleEnv" in caplog.text
    assert [note.key for note in notes if note.key == "env_class"]


NOISE = """
    observation_noise_model = NoiseModelWithAdditiveBiasCfg(
        noise_cfg=GaussianNoiseCfg(std=0.0), bias_noise_cfg=GaussianNoiseCfg(std=0.5, operation="abs"))
"""


def test_saved_state_of_a_direct_task_has_the_biases_of_its_noise(pole):
    head = "from isaaclab.utils.noise import GaussianNoiseCfg, NoiseModelWithAdditiveBiasCfg\n"
    resolved = pole((CLASS, head + CLASS + NOISE))
    env = started(resolved)
    stepped(env, 3)
    state = env.state_dict()
    expected = stepped(env, 1).obs["policy"]
    other = started(resolved)
    other.load_state_dict(state)
    assert torch.equal(stepped(other, 1).obs["policy"], expected)
    assert expected[:, 0].abs().min() > 1e-3


def test_target_of_a_joint_that_another_action_drives_is_reported(tmp_path, caplog):
    both = "        self._asset.set_joint_velocity_target(0.5 * self.processed_actions, joint_ids=self._joint_ids)\n"
    arm = "        self._asset.set_joint_position_target(self.processed_actions, joint_ids=[0])\n"
    own = ("wheel = mdp.JointVelocityActionCfg(", "wheel = mdp.JointVelocityActionCfg(class_type=Half, ")
    env = started(rover(tmp_path / "rover", HALF.replace(both, both + arm), [own]))
    with caplog.at_level(logging.WARNING):
        stepped(env, 2)
    (text,) = [text for text in caplog.messages if "have no effect" in text]
    assert "rover_env.py:" in text
    assert "position targets of arm have no effect" in text
