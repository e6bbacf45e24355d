"""Contract of a step of manager-based environments, point by point."""

import itertools

import pytest
import torch
from support.worlds import CRITTER_TASK, PENDULUM_TASK, build, critter, edited, pendulum, run

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import DeviceError
from rlcli.registry import find_task

TERMS = '''
import torch

CALLS = []


def angle(env, *, entity: Entity = "robot") -> torch.Tensor:
    """(num_envs,)"""
    CALLS.append(float(entity.data.joint_pos[0, 0]))
    return entity.data.joint_pos[:, 0]


def beyond(env, *, entity: Entity = "robot", limit: float) -> torch.Tensor:
    """(num_envs,) bool"""
    return entity.data.joint_pos[:, 0] > limit


def explosive(env) -> torch.Tensor:
    """(num_envs,)"""
    raise AssertionError("called")


def note(env, selection, *, tag: str) -> None:
    """Record the environments and the steps in which the event fires."""
    env.notes = [*getattr(env, "notes", []), (tag, env.common_step, selection.read(env._counters.ids).tolist())]


def angle_row(env, *, entity: Entity = "robot") -> torch.Tensor:
    """(num_envs, 1)"""
    return entity.data.joint_pos
'''
TERMS = "from rlcli.task import Entity\n" + TERMS


def world(tmp_path, **changes):
    return pendulum(tmp_path, edited(PENDULUM_TASK, **changes), terms_py=TERMS)


def idle(env):
    return torch.zeros(env.num_envs, env.layout.action_size)


def set_angle(env, ids, value):
    env.engine.field("qpos")[ids, 0] = value
    env.sim.refresh()


BEYOND = {"time_out": {"func": "time_out", "time_out": True}, "beyond": {"func": "beyond", "limit": 1.0}}


def test_reward_is_weight_times_value_times_step_dt(tmp_path):
    env = build(world(tmp_path))
    env.reset()
    assert env.step(idle(env)).reward.tolist() == pytest.approx([0.02] * 3)


def test_reward_dt_scaling_false_omits_step_dt(tmp_path):
    env = build(world(tmp_path, reward_dt_scaling=False))
    env.reset()
    assert env.step(idle(env)).reward.tolist() == [1.0] * 3


def test_terminating_step_rewards_terminal_state(tmp_path):
    env = build(world(
        tmp_path,
        reward_dt_scaling=False,
        terminations=BEYOND,
        rewards={"angle": {"func": "angle", "weight": 100.0}},
    ))  # fmt: skip
    env.reset()
    set_angle(env, [1], 2.0)
    result = env.step(idle(env))
    terminal = float(result.final_obs["policy"][1, 0])
    assert terminal > 1.0
    assert result.terminated.tolist() == [False, True, False]
    assert not result.truncated.any()
    assert float(result.reward[1]) == pytest.approx(0.0 - 10.0 + 100.0 * terminal, rel=1e-6)
    assert float(result.reward[0]) == pytest.approx(1.0, abs=1e-6)


def test_time_out_is_truncation_and_counts_as_alive(tmp_path):
    env = build(world(tmp_path, reward_dt_scaling=False))
    assert env.max_episode_length == 10
    results = run(env, 20)
    for step, result in enumerate(results, 1):
        assert result.truncated.tolist() == [step in (10, 20)] * 3
        assert not result.terminated.any()
        assert result.reward.tolist() == [1.0] * 3
        assert (result.episodes is None) == (step not in (10, 20))
    assert results[9].episodes.lengths.tolist() == [10] * 3
    assert results[9].episodes.truncated.tolist() == [True] * 3
    assert results[9].episodes.causes["time_out"].tolist() == [True] * 3


@pytest.mark.parametrize(
    ("length", "dt", "decimation", "steps"),
    [(5.0, "1/120", 2, 300), (8.3, 0.0083, 2, 500), (1.0, 0.01, 3, 34), (0.06, 0.02, 3, 1)],
)
def test_max_episode_length_rounds_up_exactly(tmp_path, length, dt, decimation, steps):
    assert (
        build(world(tmp_path, episode_length_s=length, sim={"dt": dt}, decimation=decimation)).max_episode_length
        == steps
    )


def test_terminated_and_truncated_is_not_a_time_out(tmp_path):
    env = build(world(tmp_path, terminations=BEYOND))
    env.reset()
    for _ in range(9):
        env.step(idle(env))
    set_angle(env, [0], 2.0)
    result = env.step(idle(env))
    assert result.terminated.tolist() == [True, False, False]
    assert result.truncated.tolist() == [True, True, True]
    assert result.episodes.truncated.tolist() == [False, True, True]
    assert result.episodes.causes["beyond"].tolist() == [True, False, False]


def test_autoreset_clears_counters_and_returns_new_obs(tmp_path):
    env = build(critter(tmp_path), 4)
    env.reset()
    before = [env.step(torch.full((4, 4), 0.3)) for _ in range(2)][-1].obs["policy"].clone()
    env.episode_length_buf[2] = env.max_episode_length - 1
    result = env.step(torch.full((4, 4), 0.3))
    assert result.truncated.tolist() == [False, False, True, False]
    assert env.episode_length_buf.tolist() == [3, 3, 0, 3]
    final, fresh = result.final_obs["policy"][2], result.obs["policy"][2]
    assert not torch.equal(final, fresh)
    qpos = env.engine.field("qpos")[2].float()
    joints = env.entities["robot"].data.default_joint_pos[2]
    assert float(fresh[0]) == float(qpos[2])
    assert torch.allclose(fresh[10:14], qpos[7:11] - joints)
    assert (fresh[-4:] == 0).all(), "the new episode has no last action"
    assert (final[-4:] == 0.3).all(), "the old one had"
    assert torch.allclose(final, before[2], atol=2.0)
    assert not env.action_manager.action[2].any()
    assert not env.action_manager.prev_action[2].any()
    assert env.action_manager.action[1].all()


def test_final_obs_matches_endless_episode(tmp_path):
    """The final observation of a time-out is that of the state before the reset, bit for bit."""
    short = build(critter(tmp_path), 3, "episode_length_s=0.1", "events.push=null", "events.shove=null")
    long = build(critter(tmp_path), 3, "episode_length_s=9.0", "events.push=null", "events.shove=null")
    ended, goes_on = run(short, 5)[-1], run(long, 5)[-1]
    assert ended.truncated.all()
    for group in ("policy", "critic"):
        assert torch.equal(ended.final_obs[group], goes_on.obs[group])
    assert torch.equal(ended.reward, goes_on.reward)


@pytest.mark.parametrize("kind", ["pendulum", "cartpole-direct"])
def test_final_obs_of_truncated_is_none_without_truncation(tmp_path, kind):
    env = build(world(tmp_path, terminations=BEYOND) if kind == "pendulum" else kind, 3)
    env.reset()
    env.final_obs_of = "truncated"
    set_angle(env, [0], 3.5)
    result = env.step(idle(env))
    assert result.terminated.tolist() == [True, False, False]
    assert result.final_obs is None
    env.episode_length_buf[1] = env.max_episode_length - 1
    set_angle(env, [1], 0.25)
    result = env.step(idle(env))
    assert result.truncated.tolist() == [False, True, False]
    assert float(result.final_obs["policy"][1].abs().max()) > 0.2


def test_final_obs_and_episodes_are_none_without_ends(tmp_path):
    env = build(world(tmp_path))
    env.reset()
    result = env.step(idle(env))
    assert result.final_obs is None
    assert result.episodes is None


def test_zero_weight_reward_is_never_called(tmp_path):
    env = build(world(tmp_path, rewards={"off": {"func": "explosive", "weight": 0.0}}))
    results = run(env, 11)
    assert results[9].episodes.reward_terms["off"].tolist() == [0.0] * 3


def test_reward_terms_sum_to_return(tmp_path):
    env = build(critter(tmp_path), 8)
    returns = torch.zeros(8, dtype=torch.float64)
    seen = 0
    for result in run(env, 70):
        returns += result.reward.double()
        if result.episodes is not None:
            ended = result.episodes
            seen += len(ended.ids)
            terms = sum(v.double() for v in ended.reward_terms.values())
            assert torch.allclose(terms, ended.returns.double(), rtol=1e-6, atol=1e-6)
            assert torch.allclose(returns[ended.ids], ended.returns.double(), rtol=1e-5, atol=1e-5)
            returns[ended.ids] = 0.0
    assert seen > 10


@pytest.mark.parametrize("name", ["ant-direct", "cartpole", "cartpole-direct", "critter"])
def test_consecutive_results_share_no_memory(tmp_path, name):
    env = build(critter(tmp_path) if name == "critter" else name, 4)
    previous = env.reset()["policy"]
    kept = previous.clone()
    reward = None
    for _ in range(4):
        result = env.step(torch.rand(4, env.layout.action_size))
        assert torch.equal(previous, kept), "the observation before was overwritten"
        if reward is not None:
            assert torch.equal(reward[0], reward[1])
        assert result.obs["policy"].data_ptr() != previous.data_ptr()
        previous, kept = result.obs["policy"], result.obs["policy"].clone()
        reward = (result.reward, result.reward.clone())


@pytest.mark.parametrize("name", ["ant-direct", "cartpole", "cartpole-direct", "critter"])
def test_partial_reset_keeps_other_envs(tmp_path, name):
    task = critter(tmp_path) if name == "critter" else name
    twins = [build(task, 6) for _ in range(2)]
    for env in twins:
        run(env, 7)
    twins[1].episode_length_buf[[1, 4]] = twins[1].max_episode_length - 1
    action = torch.full((6, twins[0].layout.action_size), 0.1)
    plain, partly = (env.step(action) for env in twins)
    assert partly.truncated.tolist() == [False, True, False, False, True, False]
    rest = [0, 2, 3, 5]
    for group in plain.obs:
        assert torch.equal(plain.obs[group][rest], partly.obs[group][rest])
        assert not torch.equal(plain.obs[group][1], partly.obs[group][1])
    rows = [env.engine.state_dict()["state"] for env in twins]
    assert torch.equal(rows[0][rest], rows[1][rest])
    assert not torch.equal(rows[0][1], rows[1][1])


@pytest.mark.parametrize("name", ["ant-direct", "cartpole", "cartpole-direct", "critter"])
def test_restart_repeats_start_and_keeps_other_envs(tmp_path, name):
    task = critter(tmp_path) if name == "critter" else name
    waiting, plain = (build(task, 6) for _ in range(2))
    for env in (waiting, plain):
        run(env, 7)
        env.episode_length_buf[[1, 4]] = env.max_episode_length - 1
    action = torch.full((6, plain.layout.action_size), 0.1)
    plain.step(action)
    first = waiting.step(action).obs["policy"][[1, 4]].clone()
    begin = torch.tensor([False, True, False, False, True, False])
    index = waiting.episode_index.clone()
    sat, went = waiting.step(action.masked_fill(begin[:, None], torch.nan), begin), plain.step(action)
    rest = [0, 2, 3, 5]
    for group in went.obs:
        assert torch.equal(sat.obs[group][rest], went.obs[group][rest])
    assert torch.equal(sat.reward[rest], went.reward[rest])
    assert not sat.reward[begin].any()
    assert not (sat.terminated | sat.truncated)[begin].any()
    assert torch.equal(waiting.episode_index, index)
    assert waiting.episode_length_buf[begin].tolist() == [0, 0]
    if name != "critter":  # its observations have noise, and its commands are keyed by the step
        assert torch.equal(sat.obs["policy"][begin], first)


def events(env, tag):
    return [(step, ids) for t, step, ids in getattr(env, "notes", []) if t == tag]


def test_startup_and_reset_events_fire_on_time(tmp_path):
    env = build(world(tmp_path, events={
        "first": {"func": "note", "mode": "startup", "tag": "startup"},
        "each": {"func": "note", "mode": "reset", "tag": "reset"},
    }))  # fmt: skip
    env.reset()
    env.episode_length_buf[1] = 7
    for _ in range(3):
        env.step(idle(env))
    env.reset(seed=3)
    assert events(env, "startup") == [(0, [0, 1, 2])]
    assert events(env, "reset") == [(0, [0, 1, 2]), (3, [1]), (0, [0, 1, 2])]


def fired_steps(tmp_path, interval, dt, decimation, steps, length=1000.0):
    env = build(world(
        tmp_path,
        sim={"dt": dt}, decimation=decimation, episode_length_s=length,
        events={"tick": {"func": "note", "mode": "interval", "interval_range_s": [interval, interval], "tag": "tick"}},
    ), 1)  # fmt: skip
    env.reset()
    for _ in range(steps):
        env.step(idle(env))
    return [step for step, _ in events(env, "tick")]


@pytest.mark.parametrize(
    ("interval", "dt", "decimation", "every"),
    [(0.1, 0.01, 2, 5), (5.0, "1/120", 2, 300), (2.0, 0.01, 1, 200), (0.05, 0.02, 1, 3), (0.001, 0.02, 1, 1)],
)
def test_interval_events_do_not_drift(tmp_path, interval, dt, decimation, every):
    steps = 3 * every + every // 2
    assert fired_steps(tmp_path, interval, dt, decimation, steps) == [every, 2 * every, 3 * every]


def test_interval_timers_restart_with_episode(tmp_path):
    # episodes of 8 steps, an event every 5 steps: in step 5, then in step 5 of the second episode
    assert fired_steps(tmp_path, 0.1, 0.01, 2, 24, length=0.16) == [5, 13, 21]


def test_interval_times_are_drawn_per_env_within_range(tmp_path):
    env = build(world(tmp_path, episode_length_s=100.0, events={
        "tick": {"func": "note", "mode": "interval", "interval_range_s": [0.1, 0.2], "tag": "tick"},
    }), 16)  # fmt: skip
    env.reset()
    for _ in range(60):
        env.step(idle(env))
    gaps = set()
    for env_id in range(16):
        steps = [0, *(step for step, ids in events(env, "tick") if env_id in ids)]
        gaps |= {b - a for a, b in itertools.pairwise(steps)}
    assert gaps <= set(range(5, 11))
    assert len(gaps) >= 4


def test_observation_includes_interval_event(tmp_path):
    env = build(critter(tmp_path, edited(CRITTER_TASK, episode_length_s=5.0)), 4)
    env.reset()
    for _ in range(30):
        obs = env.step(torch.zeros(4, 4)).obs["policy"]
        velocity = env.engine.field("qvel").float()
        assert torch.equal(env.entities["robot"].data.root_lin_vel_w, velocity[:, :3])
        assert torch.allclose(obs[:, 4:7], 0.25 * velocity[:, 3:6])


def test_pushes_add_up_and_start_from_reset_state(tmp_path):
    push = {"func": "push_by_setting_velocity", "linear_velocity": [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]]}
    both = {**push, "mode": "interval", "interval_range_s": [0.02, 0.02]}
    changes = {"root": None, "joints": None, "shove": None, "push": None}
    env = build(critter(tmp_path, edited(CRITTER_TASK, sim={"gravity": [0.0, 0.0, 0.0]}, events={
        **changes, "at_reset": {**push, "mode": "reset"}, "a": both, "b": both,
    })), 2)  # fmt: skip
    env.reset()
    for _ in range(2):
        assert env.engine.field("qvel")[:, 0].tolist() == pytest.approx([1.0, 1.0], abs=1e-6)
        env.step(torch.zeros(2, 4))
        assert env.engine.field("qvel")[:, 0].tolist() == pytest.approx([3.0, 3.0], abs=0.3)
        env.reset()


def test_step_rejects_nonfinite_or_misshaped_actions(tmp_path):
    env = build(world(tmp_path))
    env.reset()
    with pytest.raises(ValueError, match=r"action has shape \(3,\); pass shape \(3, 1\)"):
        env.step(torch.zeros(3))
    env.pause()
    assert not env.is_playing()
    with pytest.raises(RuntimeError, match="paused"):
        env.step(idle(env))
    env.pause(False)
    env.step(idle(env))


@pytest.mark.parametrize(("hold_s", "succeeds"), [(0.1, [True, True, False, False]), (0.0, [True, True, True, False])])
def test_success_requires_condition_until_time_out(tmp_path, hold_s, succeeds):
    """A condition without a time must hold in the last step."""
    task = world(tmp_path, terminations=BEYOND,
                 success={"near": {"func": "joint_error", "at_most": 0.5, "hold_s": hold_s}})  # fmt: skip
    env = build(task, 4)
    env.reset()
    for step in range(10):
        angles = [0.0, 0.9 if step < 5 else 0.0, 0.9 if step < 6 else 0.0, 0.0 if step < 9 else 1.5]
        env.engine.field("qvel")[:] = 0.0
        for i, angle in enumerate(angles):
            env.engine.field("qpos")[i, 0] = angle
        result = env.step(idle(env))
    assert result.episodes.success.tolist() == succeeds


def test_missing_device_raises_device_error(tmp_path):
    resolved = resolve(find_task(str(pendulum(tmp_path))))
    with pytest.raises(DeviceError, match="device 'cuda:99' is not available"):
        make_env(resolved, device="cuda:99")
