import pytest
import torch
import yaml
from support.worlds import CRITTER_TASK, build, critter, dump, edited, results_of_env, run, same

TASKS = ["ant-direct", "cartpole", "cartpole-direct", "critter"]


@pytest.fixture
def place(tmp_path):
    return lambda name: critter(tmp_path) if name == "critter" else name


def steps_of(name):
    return 65 if name == "critter" else 80  # two episodes of 0.6 s


@pytest.mark.parametrize("name", TASKS)
def test_first_env_is_bit_identical_for_any_num_envs_and_threads(name, place):
    task, steps = place(name), steps_of(name)
    reference = run(build(task, 1, "sim.engine_threads=1", "episode_length_s=0.6"), steps)
    ended = sum(bool(r.terminated[0] | r.truncated[0]) for r in reference)
    assert ended >= 2, "the trajectory must cross resets"
    for num_envs, threads in [(8, 2), (64, 4), (64, 1), (3, 1), (1, 4)]:
        env = build(task, num_envs, f"sim.engine_threads={threads}", "episode_length_s=0.6")
        assert same(results_of_env(run(env, steps), 0), results_of_env(reference, 0)), (num_envs, threads)


@pytest.mark.parametrize("name", TASKS)
def test_equal_seeds_repeat_and_other_seeds_differ(name, place):
    task = place(name)
    first, again, other = (run(build(task, 4, seed=seed), 40) for seed in (5, 5, 6))
    for env in range(4):
        assert same(results_of_env(first, env), results_of_env(again, env))
        assert not same(results_of_env(first, env), results_of_env(other, env))


@pytest.mark.parametrize("name", TASKS)
def test_environments_of_one_run_differ(name, place):
    results = run(build(place(name), 4), 5)
    assert not same(results_of_env(results, 0), results_of_env(results, 1))


@pytest.mark.parametrize("name", TASKS)
def test_reset_with_seed_equals_new_environment(name, place):
    task = place(name)
    used = build(task, 4, seed=1)
    run(used, 30)
    used.reset(seed=9)
    fresh = build(task, 4, seed=9)
    assert same(results_of_env(run(used, 30, reset=False), 2), results_of_env(run(fresh, 30), 2))


def test_reset_without_seed_begins_other_episodes(place):
    env = build("cartpole", 4)
    first = env.reset()["policy"].clone()
    assert not first.equal(env.reset()["policy"])


def test_episodes_independent_of_resets_of_others(place):
    task = place("critter")
    reference = run(build(task, 8), 60)
    env = build(task, 8)
    env.reset()
    env.episode_length_buf[[0, 2, 5, 6]] = 17  # the others time out at different times
    disturbed = run(env, 60, reset=False)
    ends = [[bool(r.truncated[i]) for r in results] for results in (reference, disturbed) for i in (0,)]
    assert ends[0] != ends[1]
    for i in (1, 3, 4, 7):
        assert same(results_of_env(disturbed, i), results_of_env(reference, i))


def test_episodes_independent_of_other_events(tmp_path):
    """An event that draws but changes nothing, before the others, shifts no other draw."""
    idle = {
        f"idle_{mode}": {"func": "apply_external_force_torque", "mode": mode, "bodies": ["leg_fl"]}
        for mode in ("startup", "reset")
    }
    data = yaml.safe_load(CRITTER_TASK)
    data["events"] = {**idle, **data["events"]}
    more = critter(tmp_path / "more", dump(data))
    reference = run(build(critter(tmp_path), 8), 60)
    results = run(build(more, 8), 60)
    assert same(results_of_env(results, 7), results_of_env(reference, 7))


def test_interval_event_draws_independent_of_other_envs(tmp_path):
    task = critter(tmp_path, edited(CRITTER_TASK, episode_length_s=5.0))
    few, many = run(build(task, 2), 60), run(build(task, 16), 60)
    assert same(results_of_env(few, 1), results_of_env(many, 1))


def test_reward_sum_is_equal_for_any_num_envs(tmp_path):
    hips = ("hip_fl", "hip_fr", "hip_bl", "hip_br")
    many = {
        f"term_{n}": {"func": "joint_vel_l1", "weight": (-1) ** n * 3.0 ** (n % 7), "joints": [hips[n % 4]]}
        for n in range(40)
    }
    task = critter(tmp_path, edited(CRITTER_TASK, rewards=many))
    rewards = [torch.stack([result.reward[0] for result in run(build(task, n), 60)]) for n in (1, 2, 5)]
    assert torch.equal(rewards[0], rewards[1])
    assert torch.equal(rewards[0], rewards[2])
