"""Tests of the history of engine calls and of the reported causes of divergence."""

import math

import mujoco
import numpy as np
import pytest

from rlcli.config.schema import SimConfig
from rlcli.sim import divergence_report
from rlcli.sim.divergence_report import Divergence, StateHistory, StateLayout
from rlcli.sim.engine import open_cpu_engine

MODEL = """
<mujoco>
  <worldbody>
    <body name="base"><freejoint name="root"/><geom size="0.1"/>
      <body><joint name="swing" axis="0 1 0"/><geom size="0.1"/>
        <body><joint axis="0 1 0"/><geom size="0.1"/></body></body></body>
  </worldbody>
  <actuator><motor name="turn" joint="swing"/><motor joint="swing"/></actuator>
</mujoco>
"""
DEFAULT = [-1.0, -2.0, -3.0, -4.0]
COLUMNS = {"time": (0, 1), "qpos": (1, 3), "qvel": (4, 2), "ctrl": (6, 1), "qacc_warmstart": (7, 2)}


@pytest.fixture
def layout():
    return StateLayout(mujoco.MjModel.from_xml_string(MODEL), COLUMNS)


def history(envs=2, columns=4, width=3, calls=3):
    state = np.zeros((envs, columns))
    return state, StateHistory(state, width, np.array(DEFAULT), calls)


def test_divergence_text_has_environment_cause_and_element():
    assert str(Divergence(3, "BADQACC", "joint 'swing'")) == "environment 3: BADQACC (joint 'swing')"
    assert str(Divergence(0, "engine error")) == "environment 0: engine error"
    assert Divergence(0, "x").index == -1


def test_history_returns_last_calls_with_default_columns():
    state, kept = history()
    assert (kept.calls, kept.width) == (3, 3)
    assert kept.calls_of(0) == []
    for number in range(5):
        state[:] = number
        kept.record(nstep=10 + number)
        found = kept.calls_of(1)
        assert [call.nstep for call in found] == [10 + n for n in range(max(0, number - 2), number + 1)]
    state[:] = 99.0
    assert [call.state.tolist() for call in kept.calls_of(0)] == [[n, n, n, -4.0] for n in (2.0, 3.0, 4.0)]
    assert kept.last_state(0).tolist() == [4.0, 4.0, 4.0, -4.0]


def test_start_episodes_drops_calls_of_selected_environments():
    state, kept = history()
    assert kept.last_state(0).tolist() == DEFAULT
    for number in (1.0, 2.0):
        state[:] = number
        kept.record(1)
    kept.start_episodes(np.array([1]))
    assert kept.last_state(1).tolist() == DEFAULT
    assert kept.calls_of(1) == []
    assert kept.last_state(0).tolist() == [*[2.0] * 3, -4.0]
    state[:] = 3.0
    kept.record(1)
    assert [call.state[0] for call in kept.calls_of(1)] == [3.0]
    assert [call.state[0] for call in kept.calls_of(0)] == [1.0, 2.0, 3.0]
    assert kept.last_state(1).tolist() == [*[3.0] * 3, -4.0]


def test_clear_drops_all_calls():
    state, kept = history()
    for number in (1.0, 2.0):
        state[:] = number
        kept.record(1)
    kept.clear()
    assert [kept.calls_of(env) for env in (0, 1)] == [[], []]
    assert kept.last_state(0).tolist() == DEFAULT
    assert kept.calls_between(0, 0, kept.count) == []
    state[:] = 3.0
    kept.record(1)
    assert [call.state[0] for call in kept.calls_between(0, 0, kept.count)] == [3.0]


def test_calls_between_returns_recorded_numbers_only():
    state, kept = history(calls=4)
    for number in range(4):
        state[:] = number
        kept.record(1)
    assert [call.state[0] for call in kept.calls_between(0, 1, 3)] == [1.0, 2.0]
    assert [call.state[0] for call in kept.calls_between(0, 2, 99)] == [2.0, 3.0]


def test_history_continues_count_of_earlier_history():
    state = np.zeros((1, 2))
    kept = StateHistory(state, 2, np.zeros(2), 5, memory=3 * state.nbytes, count=7)
    assert (kept.count, kept.calls, kept.requested_calls, kept.memory) == (7, 3, 5, 48)
    assert kept.calls_between(0, 0, 99) == []
    kept.record(1)
    assert len(kept.calls_of(0)) == len(kept.calls_between(0, 0, 99)) == 1


@pytest.mark.parametrize(
    ("envs", "calls", "kept"), [(1, 64, 64), (2**14, 64, 64), (2**15, 64, 32), (2**21, 64, 1), (1, 0, 1)]
)
def test_history_is_limited_to_64_mb_and_at_least_one_call(envs, calls, kept, monkeypatch):
    monkeypatch.setattr(divergence_report.np, "empty", lambda shape: np.zeros(1))
    state = np.broadcast_to(np.zeros((1, 8)), (envs, 8))
    assert StateHistory(state, 8, np.zeros(8), calls).calls == kept


def test_history_accepts_state_without_columns():
    kept = StateHistory(np.zeros((2, 0)), 0, np.zeros(0), 4)
    kept.record(1)
    assert [call.state.tolist() for call in kept.calls_of(0)] == [[]]


def test_layout_returns_columns_of_fields(layout):
    assert layout.columns("qpos") == slice(1, 4)
    assert layout.fields() == [
        ("time", slice(0, 1)), ("qpos", slice(1, 4)), ("qvel", slice(4, 6)), ("ctrl", slice(6, 7)),
        ("qacc_warmstart", slice(7, 9)),
    ]  # fmt: skip


def test_nonfinite_fields_lists_inputs_first(layout):
    row = np.zeros(9)
    assert layout.nonfinite_fields(row) == []
    row[[0, 3, 5, 6, 8]] = np.nan, np.inf, -np.inf, np.nan, np.nan
    assert layout.nonfinite_fields(row) == ["ctrl", "qpos", "qvel", "qacc_warmstart", "time"]


@pytest.mark.parametrize(
    ("name", "index", "place"),
    [
        ("qpos", 0, "joint 'root'"),
        ("qpos", 6, "joint 'root'"),
        ("qpos", 7, "joint 'swing'"),
        ("qpos", 8, "joint '2'"),
        ("qpos", 9, "qpos[9]"),
        ("qpos", -1, "qpos[-1]"),
        ("qvel", 0, "joint 'root'"),
        ("qvel", 5, "joint 'root'"),
        ("qvel", 6, "joint 'swing'"),
        ("qvel", 7, "joint '2'"),
        ("qvel", 8, "qvel[8]"),
        ("qvel", -1, "qvel[-1]"),
        ("qacc", 6, "joint 'swing'"),
        ("qacc", 8, "qacc[8]"),
        ("ctrl", 0, "actuator 'turn'"),
        ("ctrl", 1, "actuator '1'"),
        ("ctrl", 2, "ctrl[2]"),
        ("ctrl", -1, "ctrl[-1]"),
        ("act", 0, "act[0]"),
    ],
)
def test_element_at_returns_joint_or_actuator(layout, name, index, place):
    assert layout.element_at(name, index) == place


LIMITED = """
<mujoco><worldbody><body pos="0 0 1"><joint name="swing" damping="0.1"/><geom size="0.1" pos="0.1 0 0"/></body>
</worldbody><actuator><motor joint="swing" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>
"""


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("field", "place", "found"),
    [
        ("ctrl", (1, 0), True),  # MuJoCo clamps an infinite control to its range
        ("qfrc_applied", (1, 0), True),
        ("xfrc_applied", (1, 1, 0), True),
        ("xfrc_applied", (1, 0, 1), True),  # on the world body, where it has no effect
        ("time", (1,), True),
        ("qacc_warmstart", (1, 0), False),  # the step overwrites it
    ],
)
def test_diverged_detects_nonfinite_inputs_with_finite_motion(field, place, found, value):
    verdicts = []
    for looked_at in (False, True):
        engine = open_cpu_engine(mujoco.MjModel.from_xml_string(LIMITED), 3, SimConfig(dt=0.002, engine_threads=1))
        engine.field(field)[place] = value
        engine.step(2)
        finite = bool(engine.field("qpos").isfinite().all()) and bool(engine.field("qvel").isfinite().all())
        diverged = engine.diverged(looked_at and finite)
        verdicts.append((None if diverged is None else diverged.tolist(), engine.divergence_causes))
    assert verdicts[0] == verdicts[1]
    assert (verdicts[1][0] == [False, True, False]) == found
