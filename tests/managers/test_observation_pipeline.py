"""Pipeline of an observation: modifiers, noise, bias, clip, scale, delay, history."""

import pytest
import torch
import yaml
from support.worlds import CRITTER_TASK, PENDULUM_TASK, build, clone, critter, dump, edited, pendulum, run

from rlcli.errors import ConfigError


def environment(tmp_path, num_envs=3, *overrides, seed=42, group=None, **term):
    """Return a swinging pendulum: group `policy` observes the angle through `term`, `critic` observes it unchanged."""
    settings = {**(group or {}), "pos": {"func": "joint_pos", **term}}
    task = yaml.safe_load(PENDULUM_TASK)
    task["observations"] = {"policy": settings, "critic": {"pos": {"func": "joint_pos"}}}
    task["events"] = {"start": {"func": "reset_joints_by_offset", "mode": "reset", "position": [0.5, 1.0],
                                "velocity": [1.0, 2.0]}}  # fmt: skip
    return build(pendulum(tmp_path, dump(task)), num_envs, *overrides, seed=seed)


def seen_and_true(env, steps):
    """Return processed and raw observations of a reset and the steps after it. (steps + 1, num_envs, columns) each"""
    obs = env.reset()
    both = [(obs["policy"].clone(), obs["critic"].clone())]
    for _ in range(steps):
        obs = env.step(torch.zeros(env.num_envs, 1)).obs
        both.append((obs["policy"].clone(), obs["critic"].clone()))
    return (torch.stack(column) for column in zip(*both, strict=True))


def test_history_has_oldest_value_first(tmp_path):
    env = environment(tmp_path, history=3)
    assert env.layout.observations["policy"][0].history == 3
    seen, true = seen_and_true(env, 6)
    for t in range(2, 7):
        assert torch.equal(seen[t], torch.cat([true[t - 2], true[t - 1], true[t]], dim=1))


def test_history_starts_with_first_value_of_episode(tmp_path):
    env = environment(tmp_path, history=4)
    seen, true = seen_and_true(env, 10)  # an episode lasts 10 steps, so the last step begins a new one
    assert torch.equal(seen[0], true[0].repeat(1, 4))
    assert torch.equal(seen[10], true[10].repeat(1, 4))
    assert not torch.equal(seen[9], true[9].repeat(1, 4))


def test_history_columns_are_grouped_by_term(tmp_path):
    terms = {"history": 2, "pos": {"func": "joint_pos"}, "vel": {"func": "joint_vel"}}
    env = build(pendulum(tmp_path, edited(PENDULUM_TASK, observations={"policy": terms})), 2)
    first = env.reset()["policy"].clone()
    second = env.step(torch.ones(2, 1)).obs["policy"]
    assert torch.equal(second, torch.stack([first[:, 1], second[:, 1], first[:, 3], second[:, 3]], dim=1))


def test_final_obs_has_history_of_its_episode(tmp_path):
    env = environment(tmp_path, history=2)
    env.reset()
    for _ in range(9):
        before = env.step(torch.zeros(3, 1)).obs["critic"].clone()
    last = env.step(torch.zeros(3, 1))
    assert torch.equal(last.final_obs["policy"], torch.cat([before, last.final_obs["critic"]], dim=1))


@pytest.mark.parametrize("steps", [[1, 1], [3, 3]])
def test_delay_returns_value_of_earlier_step(tmp_path, steps):
    seen, true = seen_and_true(environment(tmp_path, delay={"steps": steps}), 9)
    lag = steps[0]
    for t in range(10):
        assert torch.equal(seen[t], true[max(0, t - lag)])


def test_delay_is_drawn_per_env_and_episode(tmp_path):
    seen, true = seen_and_true(environment(tmp_path, 64, delay={"steps": [0, 3]}), 9)
    lags = []
    for env in range(64):
        fits = [k for k in range(4) if all(torch.equal(seen[t, env], true[t - k, env]) for t in range(3, 10))]
        assert len(fits) == 1
        lags += fits
    assert set(lags) == {0, 1, 2, 3}


def test_delay_redraw_in_each_step(tmp_path):
    seen, true = seen_and_true(environment(tmp_path, 16, delay={"steps": [0, 2], "redraw": 1.0}), 9)
    lags = torch.stack([(seen[t] == true[t - k]).any(dim=1) * k for t in range(2, 10) for k in range(3)])
    assert len(set(lags[:, 0].tolist())) == 3


@pytest.mark.parametrize(
    ("noise", "low", "high"),
    [
        ({"kind": "uniform", "low": -0.1, "high": 0.3}, -0.1, 0.3),
        ({"kind": "constant", "value": 0.25}, 0.25, 0.25),
        ({"kind": "gaussian", "mean": 1.0, "std": 0.01}, 0.94, 1.06),
    ],
)
def test_noise_is_drawn_in_each_step_within_bounds(tmp_path, noise, low, high):
    seen, true = seen_and_true(environment(tmp_path, 256, noise=noise), 8)
    added = seen - true
    assert added.min() >= low - 1e-6
    assert added.max() <= high + 1e-6
    assert added.mean() == pytest.approx((low + high) / 2, abs=0.02)
    if low < high:
        assert not torch.allclose(added[1], added[2], atol=1e-3)
        assert added.std() > 0.005


def test_noise_operations_scale_and_set(tmp_path):
    constant = {"kind": "constant", "value": 2.0}
    seen, true = seen_and_true(environment(tmp_path / "a", noise={**constant, "operation": "scale"}), 3)
    assert torch.equal(seen, 2.0 * true)
    seen, _ = seen_and_true(environment(tmp_path / "b", noise={**constant, "operation": "set"}), 3)
    assert torch.equal(seen, torch.full_like(seen, 2.0))


def test_bias_is_constant_within_episode(tmp_path):
    seen, true = seen_and_true(environment(tmp_path, 32, bias={"kind": "uniform", "low": -0.1, "high": 0.1}), 400)
    bias = (seen - true)[:, :, 0]
    episodes = bias[:400].view(40, 10, 32)
    assert torch.allclose(episodes, episodes[:, :1].expand_as(episodes), atol=1e-6)
    assert episodes.abs().max() <= 0.1 + 1e-6
    assert episodes[:, 0].std() == pytest.approx(0.2 / 12**0.5, rel=0.1)
    assert len({round(float(x), 5) for x in episodes[:, 0, 0]}) > 35


def test_clip_runs_after_noise_and_before_scale(tmp_path):
    term = {"noise": {"kind": "constant", "value": 10.0}, "clip": [-1.0, 2.0], "scale": 3.0}
    seen, _ = seen_and_true(environment(tmp_path, **term), 2)
    assert torch.equal(seen, torch.full_like(seen, 6.0))


def test_modifiers_run_in_order_before_noise(tmp_path):
    modifiers = [{"kind": "scale", "factor": 2.0}, {"kind": "bias", "offset": 1.0},
                 {"kind": "clip", "bounds": [0.0, 2.5]}]  # fmt: skip
    seen, true = seen_and_true(environment(tmp_path, modifiers=modifiers), 5)
    assert torch.allclose(seen, (2.0 * true + 1.0).clamp(0.0, 2.5))


def test_digital_filter_matches_difference_equation(tmp_path):
    modifiers = [{"kind": "digital_filter", "a": [0.5, -0.25], "b": [0.2, 0.3]}]
    seen, true = seen_and_true(environment(tmp_path, modifiers=modifiers), 9)
    x, y = true[:, 0, 0].tolist(), []
    for t in range(10):
        last, before = (y[t - 1] if t > 0 else 0.0), (y[t - 2] if t > 1 else 0.0)
        y.append(0.2 * x[t] + 0.3 * (x[t - 1] if t else 0.0) - 0.5 * last + 0.25 * before)
    assert seen[:, 0, 0].tolist() == pytest.approx(y, rel=1e-5)


def test_integrator_matches_trapezoidal_rule(tmp_path):
    seen, true = seen_and_true(environment(tmp_path, modifiers=[{"kind": "integrator"}]), 9)
    x, area = true[:, 0, 0].tolist(), 0.0
    for t in range(10):
        area += 0.5 * 0.02 * (x[t] + (x[t - 1] if t else 0.0))
        assert float(seen[t, 0, 0]) == pytest.approx(area, rel=1e-5)


def test_group_without_corruption_ignores_noise(tmp_path):
    corrupted = {"noise": {"kind": "uniform"}, "bias": {"kind": "gaussian"}, "delay": {"steps": [1, 2]}}
    env = environment(tmp_path, group={"enable_corruption": False}, **corrupted)
    seen, true = seen_and_true(env, 5)
    assert torch.equal(seen, true)


ALL = {
    "modifiers": [{"kind": "digital_filter", "a": [0.5], "b": [0.5, 0.5]}, {"kind": "integrator"}],
    "noise": {"kind": "gaussian", "std": 0.1},
    "bias": {"kind": "uniform"},
    "delay": {"steps": [0, 3], "redraw": 0.3},
    "history": 3,
}


def test_observations_independent_of_num_envs(tmp_path):
    few = [r.obs["policy"] for r in run(environment(tmp_path / "a", 3, **ALL), 25)]
    many = [r.obs["policy"] for r in run(environment(tmp_path / "b", 17, **ALL), 25)]
    for a, b in zip(few, many, strict=True):
        assert torch.equal(a, b[:3])


def test_state_dict_restores_observations_bit_for_bit(tmp_path):
    env, other = (environment(tmp_path / name, 4, **ALL) for name in "ab")
    last = run(env, 13)[-1].obs["policy"]
    state = env.state_dict()
    other.reset(seed=7)
    assert torch.equal(other.load_state_dict(state)["policy"], last)
    for ours, theirs in zip(run(env, 20, 1, reset=False), run(other, 20, 1, reset=False), strict=True):
        assert torch.equal(ours.obs["policy"], theirs.obs["policy"])
        assert ours.final_obs is None or torch.equal(ours.final_obs["policy"], theirs.final_obs["policy"])


def test_final_obs_does_not_advance_memory(tmp_path):
    plain, with_final = (environment(tmp_path / name, 4, "episode_length_s=0.1", **ALL) for name in "ab")
    with_final.reset()
    plain.reset()
    for _ in range(12):
        action = torch.zeros(4, 1)
        with_final.observation_manager.compute_final()
        ours, theirs = clone(plain.step(action)), with_final.step(action)
        assert torch.equal(ours.obs["policy"], theirs.obs["policy"])


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (
            {"noise": {"kind": "uniform", "low": [0.0, 0.0], "high": 1.0}},
            "noise.low: noise.low has 2 values; give 1, or one for each of the term's columns (1)",
        ),
        ({"scale": [1.0, 2.0]}, "scale: scale has 2 values; give 1, or one for each of the term's columns (1)"),
        ({"delay": {"steps": [3, 1]}}, "delay.steps"),
        ({"noise": {"kind": "pink"}}, "noise"),
        ({"noise": {"kind": "uniform", "std": 1.0}}, "unknown key 'std'"),
        ({"history": 0}, "history"),
        ({"modifiers": [{"kind": "digital_filter", "b": []}]}, "modifiers.0"),
    ],
)
def test_invalid_setting_error_names_key(tmp_path, term, message):
    with pytest.raises(ConfigError) as refusal:
        environment(tmp_path, **term)
    assert message in refusal.value.message


def test_noise_columns_differ_between_terms(tmp_path):
    vel = {"func": "joint_vel_rel", "noise": {"kind": "constant", "value": [1.0, 2.0, 3.0, 4.0]}}
    task = edited(CRITTER_TASK, observations={"policy": {"vel": vel}, "critic": {"vel": {"func": "joint_vel_rel"}}})
    env = build(critter(tmp_path, task), 2)
    obs = env.reset()
    assert torch.allclose(obs["policy"] - obs["critic"], torch.tensor([1.0, 2.0, 3.0, 4.0]).expand(2, 4))
