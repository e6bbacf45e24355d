"""Gymnasium adapter: spaces, autoreset modes, seeds, rendering, registration."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3
from support.worlds import PENDULUM, PENDULUM_TASK, write

import rlcli.gym
from rlcli.adapters.gymnasium import GymnasiumEnv, open_task
from rlcli.config.load import resolve
from rlcli.registry import find_task

torch.set_num_threads(1)

MODES = list(AutoresetMode)
TASKS = ["cartpole", "cartpole-direct"]
UNBOUNDED = "ignore:.*A Box observation space m.*imum value is -?infinity:UserWarning"
"""Warning of Gymnasium's checker about unbounded observations."""


def vector(name="cartpole", num_envs=3, **settings):
    return gym.make_vec(f"rlcli.gym:rlcli/{name}", num_envs=num_envs, **settings)


def single(task="cartpole", **settings):
    return gym.make(f"rlcli.gym:rlcli/{task}", **settings)


def short_episodes(steps, task="cartpole"):
    """Return changes of the configuration with which episodes time out after `steps` steps."""
    return {"episode_length_s": steps * resolve(find_task(task)).task.step_dt}


def first_episodes(task, mode, episodes):
    """Return the first episodes of three environments as lists of observations; actions depend on the step."""
    envs = vector(task, autoreset_mode=mode, cfg=short_episodes(5, task))
    obs, _ = envs.reset(seed=7)
    finished, running = [[] for _ in range(3)], [[row] for row in obs]
    ended = np.zeros(3, dtype=bool)
    while min(map(len, finished)) < episodes:
        actions = np.array([[0.3 * len(episode) - 0.5] for episode in running], dtype=np.float32)
        obs, reward, terminated, truncated, infos = envs.step(actions)
        was_ended, ended = ended, terminated | truncated
        if mode is AutoresetMode.NEXT_STEP:
            assert not reward[was_ended].any()
            assert not ended[was_ended].any()
        for world in range(3):
            if mode is AutoresetMode.NEXT_STEP and was_ended[world]:
                running[world] = [obs[world]]
            elif not ended[world]:
                running[world].append(obs[world])
            else:
                same_step = mode is AutoresetMode.SAME_STEP
                finished[world].append([*running[world], infos["final_obs"][world] if same_step else obs[world]])
                running[world] = [obs[world]]
        if mode is AutoresetMode.DISABLED and ended.any():
            obs, _ = envs.reset(options={"reset_mask": ended})
            for world in np.flatnonzero(ended):
                running[world] = [obs[world]]
        ended = ended if mode is AutoresetMode.NEXT_STEP else np.zeros(3, dtype=bool)
    envs.close()
    return [episode[:episodes] for episode in finished]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_episodes_are_equal_in_every_autoreset_mode(task, mode):
    expected, found = first_episodes(task, AutoresetMode.SAME_STEP, 4), first_episodes(task, mode, 4)
    for world in range(3):
        for ours, theirs in zip(expected[world], found[world], strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("mode", MODES)
def test_step_results_have_gymnasium_form_in_each_mode(mode):
    ours = vector(autoreset_mode=mode, cfg=short_episodes(3))
    theirs = SyncVectorEnv([lambda: single(cfg=short_episodes(3))] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for envs in (ours, theirs):
        envs.reset(seed=1)
        envs.action_space.seed(1)
    for step in range(3):
        for mine, own in zip(
            ours.step(ours.action_space.sample()), theirs.step(theirs.action_space.sample()), strict=True
        ):
            if isinstance(own, dict):
                keys = {key for key in own if mode is AutoresetMode.SAME_STEP or "success" in key}
                assert keys == set(mine), f"step {step}"
            else:
                assert (mine.dtype, mine.shape) == (own.dtype, own.shape)


def test_final_obs_only_for_ended_episodes():
    envs = vector(cfg=short_episodes(2))
    envs.reset(seed=1)
    assert "final_obs" not in envs.step(envs.action_space.sample())[4]
    obs, _, _, truncated, infos = envs.step(envs.action_space.sample())
    assert truncated.all()
    assert infos["_final_obs"].all()
    for world in range(3):
        assert not np.array_equal(infos["final_obs"][world], obs[world])
        assert bool(infos["final_info"]["success"][world]) is False


def test_step_results_are_copies():
    envs = vector()
    kept = [envs.reset(seed=1)[0]]
    copies = [kept[0].copy()]
    for _ in range(8):
        kept.append(envs.step(envs.action_space.sample())[0])
        copies.append(kept[-1].copy())
    for ours, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(ours, copy)


def test_seed_determines_episodes():
    envs = vector()
    first, again, other = (envs.reset(seed=seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_list_of_seeds_is_refused():
    with pytest.raises(TypeError, match="one number"):
        vector().reset(seed=[1, 2, 3])


def test_disabled_autoreset_refuses_step_and_early_reset():
    envs = vector(autoreset_mode="Disabled", cfg=short_episodes(2))
    envs.reset(seed=1)
    envs.step(envs.action_space.sample())
    with pytest.raises(ValueError, match=r"\[1\]: their episodes have not ended"):
        envs.reset(options={"reset_mask": np.array([False, True, False])})
    last = envs.step(envs.action_space.sample())[0]
    with pytest.raises(RuntimeError, match=r"environments \[0, 1, 2\] have ended"):
        envs.step(envs.action_space.sample())
    obs, _ = envs.reset(options={"reset_mask": np.array([True, False, False])})
    np.testing.assert_array_equal(obs[1:], last[1:])
    assert not np.array_equal(obs[0], last[0])
    with pytest.raises(RuntimeError, match=r"environments \[1, 2\] have ended"):
        envs.step(envs.action_space.sample())
    envs.reset(options={"reset_mask": np.array([False, True, True])})
    assert envs.step(envs.action_space.sample())[3].tolist() == [False] * 3


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.filterwarnings(UNBOUNDED)
def test_gymnasium_checker_accepts_single_env(task):
    check_env(single(task).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("task", TASKS)
def test_sb3_checker_accepts_single_env_without_warning(task):
    check_env_of_sb3(single(task))


@pytest.mark.slow
@pytest.mark.filterwarnings(UNBOUNDED)
def test_gymnasium_checker_accepts_rendering():
    env = single(render_mode="rgb_array", cfg={"viewer.width": 64, "viewer.height": 48})
    check_env(env.unwrapped)
    env.reset()
    assert env.render().shape == (48, 64, 3)
    assert env.render().std() > 0


def test_single_env_requires_reset_after_episode():
    env = single(cfg=short_episodes(1)).unwrapped
    env.reset(seed=2)
    last, _, _, truncated, info = env.step(env.action_space.sample())
    assert truncated
    assert info == {"success": False}
    with pytest.raises(RuntimeError, match="reset"):
        env.step(env.action_space.sample())
    assert not np.array_equal(env.reset()[0], last)


def test_single_env_equals_first_of_vector_env():
    one, many = single(cfg=short_episodes(4)), vector(cfg=short_episodes(4))
    a, b = one.reset(seed=5)[0], many.reset(seed=5)[0][0]
    for _ in range(9):
        np.testing.assert_array_equal(a, b)
        a, _, _, truncated, _ = one.step(np.array([0.4], np.float32))
        b = many.step(np.full((3, 1), 0.4, np.float32))[0][0]
        if truncated:
            a = one.reset()[0]


def test_single_env_requires_one_environment():
    with pytest.raises(ValueError, match="takes 1 environment, found 2"):
        GymnasiumEnv(open_task("cartpole", 2))


@pytest.mark.parametrize(
    "cfg", [{"episode_length_s": 1.0, "sim.dt": 0.01}, {"episode_length_s": 1.0, "sim": {"dt": 0.01}},
            ["episode_length_s=1.0", "sim.dt=0.01"]],
)  # fmt: skip
def test_cfg_as_mapping_or_overrides(cfg):
    env = open_task("cartpole", 2, cfg)
    assert (env.num_envs, env.config.episode_length_s, env.physics_dt) == (2, 1.0, 0.01)


def test_cfg_as_whole_configuration():
    task = resolve(find_task("cartpole"), overrides=["episode_length_s=2.0"])
    for cfg in (task, task.task):
        env = open_task("cartpole", 2, cfg)
        assert (env.num_envs, env.config.episode_length_s) == (2, 2.0)


def test_cfg_mistake_is_reported_with_key():
    with pytest.raises(Exception, match="episode_lenght_s"):
        vector(cfg={"episode_lenght_s": 1.0})
    with pytest.raises(TypeError, match="list of overrides"):
        vector(cfg="episode_length_s=1.0")


def test_action_space_bounds():
    assert single(action_bound=None).action_space.high.tolist() == [np.inf]
    assert single(action_bound=2.0).action_space.high.tolist() == [2.0]


def test_make_env_by_folder_path(tmp_path):
    folder = write(tmp_path / "swing", PENDULUM_TASK, pendulum_xml=PENDULUM)
    assert vector("task", task=str(folder)).num_envs == 3


def test_register_all_qualifies_shared_names(tmp_path, monkeypatch):
    for name in ("first-plugin", "second_plugin"):
        metadata = tmp_path / f"{name.replace('-', '_')}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        points = "shared-task = nowhere:TASK\n" + (f"own-task = nowhere:{name[0]}\n" if name[0] == "f" else "")
        (metadata / "entry_points.txt").write_text(f"[rlcli.tasks]\n{points}")
    monkeypatch.syspath_prepend(str(tmp_path))
    new = {"rlcli/own-task", "rlcli/first-plugin.shared-task", "rlcli/second_plugin.shared-task"}
    try:
        ids = rlcli.gym.register_all()
        assert {"rlcli/cartpole", "rlcli/ant-direct", *new} <= set(ids)
        assert len(ids) == len(set(ids))
        assert gym.spec("rlcli/second_plugin.shared-task").kwargs == {"task": "second_plugin:shared-task"}
        assert "rlcli/shared-task" not in gym.registry
    finally:
        for name in new:
            gym.registry.pop(name, None)


def test_gymnasium_episode_statistics_count_whole_episodes():
    envs = gym.wrappers.vector.RecordEpisodeStatistics(vector(cfg=short_episodes(4)))
    envs.reset(seed=1)
    for _ in range(12):
        envs.step(envs.action_space.sample())
    assert list(envs.length_queue) == [4] * 9
