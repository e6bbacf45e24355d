"""RSL-RL adapter: sizes, observations, time-outs, resets."""

import pytest
import torch

from rlcli.adapters.rsl_rl import RslRlVecEnv
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

CRITIC = "observations.critic={x: {func: joint_pos}, torque: {func: last_action}}"


@pytest.fixture(params=["batch", "warp"])
def vec(request):
    torch.set_num_threads(1)
    overrides = ["scene.num_envs=3", "episode_length_s=0.1", f"sim.engine={request.param}", CRITIC]
    return RslRlVecEnv(make_env(resolve(find_task("cartpole"), overrides=overrides), seed=4), 0.5)


def steps(vec, count, action=0.1):
    return [vec.step(torch.full((3, 1), action)) for _ in range(count)]


def test_sizes_and_observation_groups(vec):
    assert (vec.num_envs, vec.num_actions, vec.max_episode_length) == (3, 1, 6)
    obs = vec.get_observations()
    assert {group: tuple(values.shape) for group, values in obs.items()} == {"policy": (3, 4), "critic": (3, 3)}
    assert {group: values.shape for group, values in vec.zero_observations().items()} == {
        k: v.shape for k, v in obs.items()
    }


def test_get_observations_twice_starts_one_episode(vec):
    first = vec.get_observations()["policy"].clone()
    assert torch.equal(vec.get_observations()["policy"], first)
    steps(vec, 2)
    assert vec.episode_length_buf.tolist() == [2, 2, 2]
    assert not torch.equal(vec.get_observations()["policy"], first)


def test_time_outs_and_final_obs_in_extras(vec):
    *before, last = steps(vec, 6)
    for _, _, dones, extras in before:
        assert not dones.any()
        assert not extras["time_outs"].any()
        assert "log" not in extras
    obs, _, dones, extras = last
    assert dones.tolist() == [1, 1, 1]
    assert extras["time_outs"].tolist() == [True, True, True]
    assert not torch.equal(extras["final_obs"]["policy"], obs["policy"])
    assert extras["log"]["Episode_Termination/time_out"] == 1.0
    assert set(extras["log"]) >= {"Train/mean_reward", "Episode_Reward/alive"}


def test_episode_length_buf_can_be_set(vec):
    vec.get_observations()
    vec.episode_length_buf = torch.tensor([5, 0, 3])
    *_, dones, _ = steps(vec, 1)[0]
    assert dones.tolist() == [1, 0, 0]


def test_clip_actions(vec):
    vec.get_observations()
    steps(vec, 1, action=7.0)
    assert vec.get_observations()["critic"][:, 2].tolist() == [0.5, 0.5, 0.5]


def test_reset_starts_other_episodes(vec):
    first = vec.get_observations()["policy"].clone()
    obs, _ = vec.reset()
    assert not torch.equal(obs["policy"], first)
    assert vec.episode_length_buf.tolist() == [0, 0, 0]
