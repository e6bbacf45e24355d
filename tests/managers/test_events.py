"""Events: when they fire, curricula of their ranges, and partial resets."""

import itertools
import math

import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fault_sizes import amount
from support.worlds import CRITTER_TASK, ENGINES, PENDULUM_TASK, actions, build, critter, dump, edited, pendulum

from rlcli.config.load import resolve
from rlcli.errors import ConfigError
from rlcli.registry import find_task

LONG = ["batch", pytest.param("warp", marks=pytest.mark.slow)]  # slow without a GPU
DAMPING = {"func": "randomize_joint_damping", "operation": "set"}


def swinging(tmp_path, num_envs=4, *overrides, engine="batch", seed=42, **events):
    task = pendulum(tmp_path, edited(PENDULUM_TASK, events=events))
    env = build(task, num_envs, f"sim.engine={engine}", *overrides, seed=seed)
    env.reset()
    return env


def step(env, times=1):
    for _ in range(times):
        env.step(torch.zeros(env.num_envs, env.layout.action_size))


def damping(env):
    return env.engine.expand("dof_damping")[:, 0].clone()


@pytest.mark.parametrize("engine", LONG)
def test_min_steps_between_throttles_reset_event(tmp_path, engine):
    event = {**DAMPING, "mode": "reset", "range": [1.0, 2.0], "min_steps_between": 25}
    env = swinging(tmp_path, engine=engine, it=event)  # an episode is 10 steps
    first = damping(env)
    assert (first >= 1.0).all()
    step(env, 20)
    assert torch.equal(damping(env), first), "two resets, too early"
    step(env, 10)
    second = damping(env)
    assert not (second == first).any()
    step(env, 29)
    assert torch.equal(damping(env), second)
    env.reset()
    assert not (damping(env) == second).any(), "a reset of everything always fires"


def test_min_steps_between_counts_per_environment(tmp_path):
    event = {**DAMPING, "mode": "reset", "range": [1.0, 2.0], "min_steps_between": 6}
    env = swinging(tmp_path, it=event)
    step(env, 7)
    before = damping(env)
    env.episode_index[0] += 1
    env._reset_envs(env.engine.select(torch.tensor([True, False, False, False]), env.seed, env.episode_index))
    assert (damping(env) != before).tolist() == [True, False, False, False]
    step(env, 3)  # the other episodes end, 10 steps after their event; the first one continues
    assert (damping(env) != before).all()


@pytest.mark.parametrize("engine", LONG)
def test_global_timer_fires_everywhere_despite_resets(tmp_path, engine):
    event = {**DAMPING, "mode": "interval", "range": [1.0, 2.0], "interval_range_s": [0.26, 0.5], "global_time": True}
    env = swinging(tmp_path, engine=engine, it=event)
    now, fired = damping(env), []
    for i in range(60):
        step(env)
        new = damping(env)
        changed = new != now
        assert changed.all() or not changed.any()
        fired += [i] if changed.all() else []
        now = new
    gaps = [b - a for a, b in itertools.pairwise(fired)]
    assert len(fired) >= 2
    assert all(13 <= gap <= 25 for gap in gaps), "longer than an episode of 10 steps"


def test_global_timer_independent_of_num_envs(tmp_path):
    event = {**DAMPING, "mode": "interval", "range": [1.0, 2.0], "interval_range_s": [0.04, 0.3], "global_time": True}
    histories = []
    for n in (2, 9):
        env = swinging(tmp_path / str(n), n, it=event)
        history = []
        for _ in range(40):
            step(env)
            history.append(damping(env)[:2].tolist())
        histories.append(history)
    assert histories[0] == histories[1]


def test_curriculum_changes_randomization_range(tmp_path):
    stages = {"func": "stages", "address": "events.it.range", "steps": [15], "values": [[4.0, 5.0]]}
    task = pendulum(
        tmp_path,
        edited(
            PENDULUM_TASK, events={"it": {**DAMPING, "mode": "reset", "range": [1.0, 2.0]}}, curriculum={"it": stages}
        ),
    )
    env = build(task, 4)
    env.reset()
    step(env, 10)
    assert (damping(env) <= 2.0).all()
    step(env, 10)
    assert (damping(env) >= 4.0).all()


BAD = [
    ({**DAMPING, "mode": "reset", "range": [0, 1], "global_time": True}, "global_time belongs to mode interval"),
    ({**DAMPING, "mode": "startup", "range": [0, 1], "min_steps_between": 3}, "belongs to mode reset"),
    ({"func": "reset_joints_by_offset", "mode": "reset", "position": [1, 0]}, "the lower end 1 is above"),
]  # fmt: skip


@pytest.mark.parametrize(("event", "message"), BAD, ids=[message for _, message in BAD])
def test_validation_rejects_wrong_timer(tmp_path, event, message):
    task = pendulum(tmp_path, edited(PENDULUM_TASK, events={"it": event}))
    with pytest.raises(ConfigError) as error:
        resolve(find_task(str(task)))
    assert any(message in str(problem) and "events.it" in problem.path for problem in error.value.problems)


@pytest.mark.parametrize("engine", LONG)
def test_impulse_acts_for_its_duration(tmp_path, engine):
    push = {"func": "apply_body_impulse", "mode": "interval", "interval_range_s": [0.06, 0.06], "bodies": "arm",
            "force": [1.0, 2.0], "duration_s": [0.04, 0.04]}  # fmt: skip
    env = swinging(tmp_path, engine=engine, it=push)
    arm = env.engine.model.body("robot/arm").id
    force = env.engine.field("xfrc_applied")
    acting = []
    for _ in range(12):
        step(env)
        acting.append(bool((force[:, arm, :3] != 0).all()))
        assert not force[:, :arm].any()
    #        every 3rd step begins one of 2 steps; the episode's end at the 10th step ends it
    assert acting == [False, False, True, True, False, True, True, False, True, False, False, False]


def test_state_dict_contains_impulse(tmp_path):
    push = {"func": "apply_body_impulse", "mode": "reset", "bodies": "arm", "force": [1.0, 2.0],
            "duration_s": [0.08, 0.08]}  # fmt: skip
    env = swinging(tmp_path, it=push)
    step(env, 2)
    fresh = swinging(tmp_path / "again", it=push)
    fresh.load_state_dict(env.state_dict())
    arm = env.engine.model.body("robot/arm").id
    for expected in (True, False):
        step(fresh)
        assert bool(fresh.engine.field("xfrc_applied")[:, arm].any()) is expected
        step(fresh)


@pytest.mark.parametrize("engine", ENGINES)
def test_random_orientation_is_uniform(tmp_path, engine):
    events = {"root": {"func": "reset_root_state_with_random_orientation", "mode": "reset", "z": [1.0, 1.0]},
              "joints": None, "push": None, "shove": None}  # fmt: skip
    env = build(critter(tmp_path, edited(CRITTER_TASK, events=events)), 600, f"sim.engine={engine}")
    env.reset()
    quat = env.entities["robot"].data.root_quat_w
    assert torch.allclose(quat.norm(dim=1), torch.ones(600), atol=1e-5)
    assert (quat.mean(dim=0).abs() < 0.1).all()  # components of uniform quaternions have mean 0 and variance 1/4
    assert (quat.square().mean(dim=0) - 0.25).abs().max() < 0.04


def test_reset_joints_within_limits_fills_soft_range(tmp_path):
    joints = {"func": "reset_joints_within_limits", "mode": "reset", "position": [0.5, 1.0], "velocity": [1.0, 1.0]}
    task = critter(tmp_path, edited(CRITTER_TASK, events={"joints": joints, "push": None, "shove": None}))
    env = build(task, 50)
    env.reset()
    data = env.entities["robot"].data
    assert (data.joint_pos >= -1e-6).all()
    assert (data.joint_pos <= math.pi / 3 + 1e-6).all()
    assert data.joint_pos.max() > 0.9
    assert (data.joint_vel == 1.0).all()


def test_reset_joints_by_gaussian_is_about_default(tmp_path):
    joints = {"func": "reset_joints_by_gaussian", "mode": "reset", "position": [0.1, 0.05], "velocity": [0.0, 0.5]}
    task = critter(tmp_path, edited(CRITTER_TASK, events={"joints": joints, "push": None, "shove": None}))
    env = build(task, 400)
    env.reset()
    data = env.entities["robot"].data
    offset = data.joint_pos - data.default_joint_pos
    assert abs(offset.mean() - 0.1) < 0.01
    assert abs(offset.std() - 0.05) < 0.005
    assert abs(data.joint_vel.mean()) < 0.05
    assert abs(data.joint_vel.std() - 0.5) < 0.03


# --- a partial reset ---

N = 9
"""A number of environments that no other dimension of a state tensor has."""
RANDOMISED = {
    "mass": {"func": "randomize_body_mass", "mode": "reset", "range": [0.5, 1.5]},
    "friction": {"func": "randomize_geom_friction", "mode": "reset", "range": [0.5, 1.5], "min_steps_between": 5},
    "gravity": {"func": "randomize_gravity", "mode": "interval", "range": [-1, 1], "interval_range_s": [0.04, 0.2]},
    "pose": {"func": "randomize_default_joint_pos", "mode": "reset", "range": [-0.1, 0.1]},
    "hit": {"func": "apply_body_impulse", "mode": "interval", "interval_range_s": [0.04, 0.2], "bodies": "torso",
            "force": [-5.0, 5.0], "duration_s": [0.02, 0.1]},
}  # fmt: skip


def crowd_of(engine, tmp_path_factory):
    task = yaml.safe_load(edited(CRITTER_TASK, events=RANDOMISED, episode_length_s=2.0))
    task["observations"]["policy"]["pos"] |= {
        "noise": {"kind": "gaussian", "std": 0.1},
        "bias": {"kind": "uniform"},
        "delay": {"steps": [0, 3], "redraw": 0.5},
        "history": 4,
        "modifiers": [{"kind": "digital_filter", "a": [0.5], "b": [0.5]}],
    }
    task["commands"] = {"walk": {"func": "uniform_velocity", "resampling_time_s": [0.04, 0.08], "lin_vel_x": [-1, 1]}}
    front = {"joints": ["hip_f."], "stiffness": 20.0, "damping": 0.5, "delay": [0, 3]}
    task["scene"]["entities"]["robot"]["actuators"] = {"front": front}
    folder = critter(tmp_path_factory.mktemp("crowd"), dump(task))
    return [build(folder, N, f"sim.engine={engine}") for _ in range(2)]


@pytest.fixture(scope="module")
def crowd(tmp_path_factory):
    return crowd_of("batch", tmp_path_factory)


@pytest.fixture(scope="module")
def crowd_on_warp(tmp_path_factory):
    return crowd_of("warp", tmp_path_factory)


def rows_of(state, keep):
    """Return the rows of some environments of every tensor, and tensors without such rows as a whole."""
    kept = {}
    for name, value in state.items():
        dims = [d for d, size in enumerate(value.shape) if size == N]
        assert len(dims) <= 1, name
        kept[name] = value.index_select(dims[0], keep) if dims else value
    return kept


def check_partial_reset(crowd, chosen, warm_up, seed):
    env, twin = crowd
    env.reset(seed=seed)
    for action in actions(warm_up, N, 4, seed):
        env.step(action)
    derived = {name: env.engine.field(name).clone() for name in ("xpos", "sensordata", "qacc")}
    state = env.state_dict()
    twin.load_state_dict(state)
    mask = torch.tensor(chosen)
    keep = (~mask).nonzero()[:, 0]
    env.episode_index += mask
    selection = env.engine.select(mask, env.seed, env.episode_index)
    if selection is not None:
        env._reset_envs(selection)
    before, after = rows_of(state, keep), rows_of(env.state_dict(), keep)
    assert before.keys() == after.keys()
    for name, value in before.items():
        assert torch.equal(value, after[name]), name
    for name, value in derived.items():
        assert torch.equal(env.engine.field(name)[keep], value[keep]), name
    for action in actions(2, N, 4, seed + 1):
        left, right = env.step(action), twin.step(action)
        for group, obs in left.obs.items():
            assert torch.equal(obs[keep], right.obs[group][keep])
        assert torch.equal(left.reward[keep], right.reward[keep])


CASES = {"chosen": st.lists(st.booleans(), min_size=N, max_size=N), "warm_up": st.integers(0, 6),
         "seed": st.integers(0, 10_000)}  # fmt: skip


@settings(max_examples=amount(60, 500), deadline=None)
@given(**CASES)
def test_partial_reset_keeps_other_envs_bit_identical(crowd, chosen, warm_up, seed):
    check_partial_reset(crowd, chosen, warm_up, seed)


@pytest.mark.slow  # a step on Warp's CPU device takes 0.1 s
@settings(max_examples=30, deadline=None)
@given(**CASES)
def test_partial_reset_keeps_other_envs_on_warp(crowd_on_warp, chosen, warm_up, seed):
    check_partial_reset(crowd_on_warp, chosen, warm_up % 3, seed % 3)
