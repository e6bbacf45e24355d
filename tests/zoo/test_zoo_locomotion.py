"""Tests that hold for both direct locomotion tasks, `ant-direct` and `humanoid-direct`."""

import math
from dataclasses import dataclass

import pytest
import torch
from support.direct_states import reward_and_done, set_floating_state
from support.worlds import actions, build

LEVEL = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Walker:
    """A task and its numbers."""

    task: str
    rest_pose: tuple[float, ...]
    """Joint angles without a cost [rad]."""
    height: float
    """Height of the torso in an upright state [m]."""
    fall_height: float
    """Height of the torso below which an episode terminates [m]."""
    fall_reward: float
    standing_reward: float
    """Reward of standing still: alive, up and heading."""
    sensors: slice
    """Columns of the foot sensors."""
    joint_speed_range: tuple[float, float]
    """Bounds of the fastest joint under random full torques [rad/s]."""
    max_height: float
    min_height: float
    """Bounds of the torso's height under random full torques [m]."""

    @property
    def size(self):
        return len(self.rest_pose)

    def set_state(self, env, row=0, height=None, linear=(0.0, 0.0, 0.0)):
        """Set one environment to the rest pose, and start to measure its progress from there."""
        height = self.height if height is None else height
        joints = torch.tensor(self.rest_pose, dtype=torch.float64)
        set_floating_state(env, row, (0.0, 0.0, height), LEVEL, linear, (0, 0, 0), joints, 0.0)
        env.task.position_before[row] = 0.0
        env.task.distance_before[row] = 1000.0


ANT = Walker(
    task="ant-direct", rest_pose=(0.0, math.pi / 4) * 4, height=0.5, fall_height=0.31, fall_reward=-2.0,
    standing_reward=0.5 + 0.1 + 0.5, sensors=slice(28, 52),
    # 7.5 N m against a damping of 0.1 N m s/rad cannot turn a joint faster than 75 rad/s
    joint_speed_range=(15.0, 75.0), max_height=2.0, min_height=0.1,
)  # fmt: skip
HUMANOID = Walker(
    task="humanoid-direct", rest_pose=(0.0,) * 21, height=1.3, fall_height=0.8, fall_reward=-1.0,
    standing_reward=2.0 + 0.1 + 0.5, sensors=slice(54, 66),
    joint_speed_range=(20.0, 150.0), max_height=1.6, min_height=0.0,
)  # fmt: skip


@pytest.fixture(params=[ANT, HUMANOID], ids=lambda walker: walker.task)
def walker(request):
    return request.param


@pytest.fixture
def env(walker):
    env = build(walker.task, 4)
    env.reset()
    return env


@pytest.mark.parametrize(
    ("walker", "num_envs", "steps"),
    [
        (ANT, 32, 200),
        (HUMANOID, 16, 150),
        pytest.param(ANT, 200, 1000, marks=pytest.mark.slow),
        pytest.param(HUMANOID, 100, 1000, marks=pytest.mark.slow),
    ],
)
def test_random_full_torques_keep_simulation_stable(walker, num_envs, steps):
    env = build(walker.task, num_envs, "params.termination_height=-10", "episode_length_s=1000")
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    generator = torch.Generator().manual_seed(0)
    fastest = highest = 0.0
    for _ in range(steps):
        env.step((torch.rand(num_envs, walker.size, generator=generator) * 2 - 1).sign())
        fastest = max(fastest, float(qvel[:, 6:].abs().max()))
        highest = max(highest, float(qpos[:, 2].max()))
    assert env.divergences == 0
    low, high = walker.joint_speed_range
    assert low < fastest < high
    assert highest < walker.max_height
    assert float(qpos[:, 2].min()) > walker.min_height


def test_new_episode_has_zero_sensors_and_actions(walker, env):
    for action in actions(40, 4, walker.size):
        result = env.step(action * 0.3)
    others = [0, 1, 3]
    assert result.obs["policy"][:, walker.sensors].any(dim=1).all()
    env.episode_length_buf[2] = env.max_episode_length - 1
    result = env.step(action * 0.3)
    assert bool(result.truncated[2])
    assert not result.obs["policy"][2, walker.sensors.start :].any()
    assert result.obs["policy"][others, walker.sensors].any(dim=1).all()
    assert result.final_obs["policy"][2, walker.sensors].any(), "the final observation belongs to the old episode"


def test_standing_still_is_rewarded(walker, env):
    walker.set_state(env)
    assert reward_and_done(env) == (pytest.approx(walker.standing_reward), False)


def test_progress_is_speed_towards_target(walker, env):
    walker.set_state(env)
    env.engine.field("qpos")[0, :2] = torch.tensor([0.05, 0.02], dtype=torch.float64)
    env.sim.refresh()
    assert reward_and_done(env)[0] == pytest.approx(walker.standing_reward + 0.05 * 60, abs=1e-4)
    assert float(env.task.speed[0]) == pytest.approx(3.0, abs=1e-4)


def test_fall_below_height_terminates_with_fall_reward_only(walker, env):
    walker.set_state(env, height=walker.fall_height - 1e-4, linear=(5.0, 0.0, 0.0))
    assert reward_and_done(env) == (walker.fall_reward, True)
    walker.set_state(env, height=walker.fall_height + 1e-4, linear=(5.0, 0.0, 0.0))
    assert reward_and_done(env)[1] is False
