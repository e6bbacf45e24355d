"""Stable-Baselines3 adapter: spaces, infos, seeds, attributes, training."""

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import VecMonitor

from rlcli.adapters.sb3 import Sb3VecEnv, make_sb3
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task


@pytest.fixture(params=["batch", "warp"])
def vec(request):
    torch.set_num_threads(1)
    overrides = ["scene.num_envs=3", "episode_length_s=0.1", f"sim.engine={request.param}"]
    return Sb3VecEnv(make_env(resolve(find_task("cartpole"), overrides=overrides), seed=4), 1.0)


def steps(vec, count):
    return [vec.step(np.full((3, 1), 0.1, np.float32)) for _ in range(count)]


def test_spaces_of_task(vec):
    assert vec.observation_space.shape == (4,)
    assert vec.action_space.shape == (1,)
    assert vec.action_space.high.tolist() == [1.0]
    assert vec.reset().dtype == np.float32


def test_infos_only_for_ended_episodes(vec):
    vec.reset()
    *quiet, last = steps(vec, 6)
    for _, _, dones, infos in quiet:
        assert not dones.any()
        assert infos == [{}, {}, {}]
    obs, _, dones, infos = last
    assert dones.all()
    for row, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        assert info["episode"]["l"] == 6
        assert info["is_success"] is False
        assert not np.array_equal(info["terminal_observation"], obs[row])


def test_terminal_observation_is_copy(vec):
    vec.reset()
    infos = steps(vec, 6)[-1][3]
    kept = infos[0]["terminal_observation"].copy()
    steps(vec, 12)
    np.testing.assert_array_equal(infos[0]["terminal_observation"], kept)


def test_seed_applies_to_one_reset(vec):
    vec.seed(9)
    first, second = vec.reset().copy(), vec.reset().copy()
    vec.seed(9)
    again = vec.reset().copy()
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second)


def test_unbounded_action_space_is_finite():
    env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=2"]))
    assert Sb3VecEnv(env, None).action_space.high.tolist() == [1e6]


def test_attributes_and_methods_are_forwarded(vec):
    assert vec.get_attr("step_dt", [0, 2]) == [vec.env.step_dt] * 2
    assert vec.env_method("is_playing", indices=[1]) == [True]
    vec.set_attr("final_obs_of", "truncated")
    assert vec.env.final_obs_of == "truncated"
    assert vec.env_is_wrapped(VecMonitor) == [False] * 3


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_sb3_algorithm_learns(vec, algorithm):
    sizes = {"batch_size": 24} if algorithm is PPO else {}
    model = algorithm("MlpPolicy", vec, n_steps=8, seed=1, device="cpu", **sizes)
    model.learn(48)
    assert model.num_timesteps == 48


def test_make_sb3_by_task_name():
    vec = make_sb3("cartpole", num_envs=2, cfg={"episode_length_s": 0.1}, action_bound=2.0)
    assert (vec.num_envs, vec.env.max_episode_length) == (2, 6)
    assert vec.action_space.high.tolist() == [2.0]
