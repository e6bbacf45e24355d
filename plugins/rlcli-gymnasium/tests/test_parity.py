"""Each task step by step beside Gymnasium's environment: equal values before the conversion to float32."""

import gymnasium
import numpy as np
import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

TASKS = {
    "gym-ant": "Ant-v5",
    "gym-half-cheetah": "HalfCheetah-v5",
    "gym-hopper": "Hopper-v5",
    "gym-humanoid": "Humanoid-v5",
    "gym-humanoid-standup": "HumanoidStandup-v5",
    "gym-inverted-double-pendulum": "InvertedDoublePendulum-v5",
    "gym-inverted-pendulum": "InvertedPendulum-v5",
    "gym-pusher": "Pusher-v5",
    "gym-reacher": "Reacher-v5",
    "gym-swimmer": "Swimmer-v5",
    "gym-walker2d": "Walker2d-v5",
}
WORLDS = 4


def ours(task, *overrides, seed=1):
    torch.set_num_threads(1)
    return make_env(resolve(find_task(task), overrides=[f"scene.num_envs={WORLDS}", *overrides]), seed=seed)


def record_observations(env):
    """Record the task's observations before the conversion to float32; the last item is the latest."""
    looks, look = [], env.task.get_observations

    def get_observations():
        look()
        looks.append(env.task.observation.clone().numpy())

    env.task.get_observations = get_observations
    return looks


def begin(theirs, env, world):
    """Begin an episode of Gymnasium's environment in the initial state of one of rlcli's environments."""
    inner = theirs.unwrapped
    qpos, qvel = (env.engine.field(name)[world].numpy().copy() for name in ("qpos", "qvel"))

    def reset_model():
        inner.set_state(qpos, qvel)
        return inner._get_obs()

    inner.reset_model = reset_model
    return theirs.reset()[0]


def compare(task, episodes, *overrides, max_episode_steps=None):
    """Run both environments until enough episodes have ended in each possible way."""
    env = ours(task, *overrides)
    looks = record_observations(env)
    limit = {} if max_episode_steps is None else {"max_episode_steps": max_episode_steps}
    theirs = [gymnasium.make(TASKS[task], **limit) for _ in range(WORLDS)]
    env.reset()
    for world in range(WORLDS):
        np.testing.assert_allclose(looks[-1][world], begin(theirs[world], env, world), rtol=0, atol=1e-9)
    low, high = theirs[0].action_space.low, theirs[0].action_space.high
    assert env.layout.action_size == len(low)
    rng = np.random.default_rng(3)
    ended = {"terminated": 0, "truncated": 0}
    while sum(ended.values()) < episodes:
        actions = rng.uniform(1.1 * low, 1.1 * high, (WORLDS, len(low))).astype(np.float32)  # also beyond the limits
        looks.clear()
        result = env.step(torch.from_numpy(actions))
        for world in range(WORLDS):
            obs, reward, terminated, truncated, _ = theirs[world].step(actions[world])
            np.testing.assert_allclose(looks[0][world], obs, rtol=0, atol=1e-9)
            np.testing.assert_allclose(float(env.task.reward[world]), float(reward), rtol=0, atol=1e-9)
            assert bool(result.terminated[world]) == terminated
            assert bool(result.truncated[world]) == truncated
            if terminated or truncated:
                ended["terminated"] += terminated
                ended["truncated"] += truncated and not terminated
                final = result.final_obs["policy"][world].numpy()
                np.testing.assert_array_equal(final, obs.astype(np.float32))
                np.testing.assert_allclose(looks[-1][world], begin(theirs[world], env, world), rtol=0, atol=1e-9)
    return ended


@pytest.mark.parametrize("task", TASKS)
def test_short_episodes_with_resets_equal_gymnasium(task):
    step_s = ours(task).step_dt
    ended = compare(task, 12, f"episode_length_s={30 * step_s}", max_episode_steps=30)
    assert sum(ended.values()) >= 12


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_twenty_episodes_equal_gymnasium(task):
    assert sum(compare(task, 20).values()) >= 20
