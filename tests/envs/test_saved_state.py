"""Saved states: a new environment repeats the same steps bit for bit."""

import pytest
import torch
from support.worlds import CRITTER_TASK, actions, build, clone, critter, edited, results_of_env, same

TASKS = ["ant-direct", "cartpole", "cartpole-direct", "critter"]


@pytest.fixture
def place(tmp_path):
    return lambda name: critter(tmp_path) if name == "critter" else name


@pytest.mark.parametrize("moment", [20, 30, 31])
@pytest.mark.parametrize("name", TASKS)
def test_load_state_dict_repeats_steps_bit_for_bit(name, place, moment):
    """Saved in the middle of episodes, in the step in which all time out, and right after it."""
    task, n = place(name), 6
    length = "episode_length_s=0.6" if name != "cartpole-direct" else "episode_length_s=0.498"
    env = build(task, n, length, "sim.engine_threads=2", seed=3)
    assert env.max_episode_length in (30, 36)
    action_list = actions(moment + 45, n, env.layout.action_size, seed=4)
    env.reset()
    for action in action_list[:moment]:
        last = clone(env.step(action))
    saved = env.state_dict()
    kept = {name: value.clone() for name, value in saved.items()}
    expected = [clone(env.step(action)) for action in action_list[moment:]]
    assert all(torch.equal(saved[name], kept[name]) for name in saved), "a state dict is a copy"

    fresh = build(task, n, length, "sim.engine_threads=1", seed=99)
    obs = fresh.load_state_dict(saved)
    for group, value in last.obs.items():
        assert torch.equal(obs[group], value), "the observation of that moment"
    found = [clone(fresh.step(action)) for action in action_list[moment:]]
    for i in range(n):
        assert same(results_of_env(found, i), results_of_env(expected, i))
    for a, b in zip(expected, found, strict=True):
        assert (a.episodes is None) == (b.episodes is None)
        if a.episodes is not None:
            assert torch.equal(a.episodes.returns, b.episodes.returns)
            assert torch.equal(a.episodes.lengths, b.episodes.lengths)
    after, other = env.state_dict(), fresh.state_dict()
    assert after.keys() == other.keys()
    for key, value in after.items():
        assert torch.equal(value, other[key]), key


def test_load_state_dict_overwrites_all_state(place):
    task = place("critter")
    env, used = build(task, 4), build(task, 4, seed=8)
    for e, steps in ((env, 12), (used, 33)):
        e.reset()
        for action in actions(steps, 4, 4, seed=steps):
            e.step(action)
    used.load_state_dict(env.state_dict())
    for action in actions(30, 4, 4, seed=1):
        a, b = clone(env.step(action)), clone(used.step(action))
        assert torch.equal(a.obs["policy"], b.obs["policy"])
        assert torch.equal(a.reward, b.reward)


def test_load_state_dict_restores_observed_acceleration(tmp_path):
    terms = '''
from rlcli.task import Entity, Joints


def joint_acc(env, *, entity: Entity = "robot", joints: Joints = ".*"):
    """(num_envs, k)"""
    return entity.data.joint_acc[:, joints]
'''
    policy = {"acc": {"func": "joint_acc"}}
    task = critter(tmp_path, edited(CRITTER_TASK, observations={"policy": policy}), terms_py=terms)
    env = build(task, 3)
    env.reset()
    for action in actions(7, 3, 4):
        obs = env.step(action).obs["policy"].clone()
    assert torch.equal(build(task, 3).load_state_dict(env.state_dict())["policy"], obs)


def test_state_dict_contains_randomized_model_fields(place):
    task = place("critter")
    env = build(task, 3)
    env.engine.expand("body_mass")[:, 1] = torch.tensor([2.0, 3.0, 4.0], dtype=torch.float64)
    env.engine.set_constants()
    env.reset()
    for action in actions(5, 3, 4):
        env.step(action)
    fresh = build(task, 3)
    fresh.load_state_dict(env.state_dict())
    for action in actions(20, 3, 4, seed=2):
        assert torch.equal(env.step(action).obs["policy"], fresh.step(action).obs["policy"])
