"""Injected divergences of simulation, terms and learner: detected at once, named and isolated."""

import math

import pytest
import torch
from support.diverging_worlds import FAULTS, PLAIN_TASK, WHO, N, faults, machine, pair, step_both, untouched
from support.fault_sizes import chosen
from support.worlds import build, clone

from rlcli.errors import DivergedError
from rlcli.replay.crash_dump import CrashDumper
from rlcli.replay.resimulate import replay_calls
from rlcli.replay.trajectory import read_trajectory

CASES = [(name, who) for name in FAULTS for who in WHO]


@pytest.mark.parametrize(("name", "who"), chosen(CASES, 14))
def test_diverged_environment_is_detected_dumped_and_isolated(tmp_path, caplog, name, who):
    fault = FAULTS[name]
    sound, sick = pair(tmp_path, fault)
    CrashDumper(sick, tmp_path / "dumps")
    before = step_both((sound, sick), 4, seed=1)
    assert untouched(before, ())
    fault.strike(sick, [who])
    if name == "reset writes nan":
        sound.episode_length_buf[who] = sound.max_episode_length
    results = step_both((sound, sick), 1, seed=2)
    assert sick.causes == {fault.cause: 1}, "found in the same step, and counted by its cause"
    fault.cure(sick, [who])
    if fault.written:
        assert all(value.isfinite().all() for value in results[0][1].obs.values())
        results += step_both((sound, sick), 1, seed=3)
    struck = results[-1][1]
    assert struck.terminated.tolist() == [i == who for i in range(N)]
    assert not struck.truncated.any()
    assert struck.reward.isfinite().all()
    assert all(value[who].isfinite().all() for value in struck.final_obs.values())
    results += step_both((sound, sick), 12, seed=4)
    assert untouched(results, [who])
    assert sick.causes == {fault.cause: 1}, "and it does not come again"
    assert sick.engine.state_dict()["state"].isfinite().all()
    assert sick.extras() == {f"Sim/diverged/{fault.cause.replace(' ', '_')}": 1.0}
    assert sick.extras() == {}, "counted since the last call"

    (message,) = caplog.messages
    assert f"environment {who}: {fault.cause}" in message
    assert fault.detail in message
    (file,) = (tmp_path / "dumps").iterdir()
    assert f"rlcli replay {file}" in message
    dump = read_trajectory(file)
    (world,) = dump.header.worlds
    assert (world.env, world.cause) == (who, fault.cause)
    replayed = replay_calls(dump)
    assert replayed.difference is None
    assert replayed.same_model
    assert replayed.compared >= (1 if name == "reset writes nan" or fault.expands else 3)
    assert replayed.diverged_at[who] == world.diverged_at
    assert world.diverged_at is not None
    assert world.diverged_at.call >= world.first


@pytest.mark.parametrize("name", ["nan qpos", "nan ctrl", "engine error", "reset writes nan", "nan timestep"])
def test_divergence_of_all_environments_resets_them(tmp_path, caplog, name):
    fault = FAULTS[name]
    _, env = pair(tmp_path, fault)
    CrashDumper(env, tmp_path / "dumps")
    env.step(torch.zeros(N, 2))
    fault.strike(env, range(N))
    result = env.step(torch.zeros(N, 2))
    fault.cure(env, range(N))
    if fault.written:
        result = env.step(torch.zeros(N, 2))
    assert result.terminated.all()
    assert env.causes == {fault.cause: N}
    assert result.reward.isfinite().all()
    assert not env.step(torch.zeros(N, 2)).terminated.any()
    (file,) = (tmp_path / "dumps").iterdir()
    dump = read_trajectory(file)
    assert [world.env for world in dump.header.worlds] == [0, 1, 2, 3]
    assert replay_calls(dump).difference is None
    assert len(caplog.messages) == 1


TERMS = {
    "action": r"the policy's action is not finite in 1 of 5 .*environment {who} in column drive.push",
    "observation": r"observation 'policy.vel' \(seen\) is not finite in 1 .*environment {who}",
    "reward": r"reward term 'angle' \(angle\) is not finite in 1 .*environment {who}",
}


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize(("what", "who"), chosen([(what, who) for what in TERMS for who in WHO], 4))
def test_term_or_action_that_is_not_finite_raises_with_its_name(tmp_path, what, who, value):
    _, env = pair(tmp_path, FAULTS["nan qpos"])
    env.step(torch.zeros(N, 2))
    before = {name: values.clone() for name, values in env.reward_manager.state_dict().items()}
    action = torch.zeros(N, 2)
    if what == "action":
        action[who, 1] = value
    else:
        faults(env).update({what: [who], "value": value})
    with pytest.raises(DivergedError, match=TERMS[what].format(who=who)) as raised:
        env.step(action)
    assert raised.value.exit_code == 6
    if what != "observation":  # it comes after the reward of its step
        after = env.reward_manager.state_dict()
        assert all(torch.equal(after[name], values) for name, values in before.items())


def test_final_obs_and_state_of_a_direct_task_are_checked(tmp_path):
    env = build("cartpole-direct", 3)
    env.reset()
    env.episode_length_buf[1] = env.max_episode_length
    judge = env.task.is_done

    def spoiled():  # after the reward, which reads it
        judge()
        env.task.obs_buf[1, 2] = math.nan

    env.task.is_done = spoiled
    with pytest.raises(DivergedError, match=r"the last observation is not finite in 1 of 3 .* environment 1 in column"):
        env.step(torch.zeros(3, 1))


def test_divergence_in_every_step_continues_until_the_run_stops(tmp_path):
    _, env = pair(tmp_path, FAULTS["nan gravity"])
    FAULTS["nan gravity"].strike(env, range(N))
    for step in range(1, 4):
        assert env.step(torch.zeros(N, 2)).terminated.all()
        assert env.causes == {"BADQACC": step * N}


def test_quarantined_states_survive_a_checkpoint(tmp_path):
    fault = FAULTS["event writes nan"]
    env, other = pair(tmp_path, fault)
    for _ in range(4):  # the event is of the fifth step
        env.step(torch.zeros(N, 2))
    fault.strike(env, [3])
    env.step(torch.zeros(N, 2))
    fault.cure(env, [3])
    other.load_state_dict(env.state_dict())
    left, right = clone(env.step(torch.zeros(N, 2))), clone(other.step(torch.zeros(N, 2)))
    assert right.terminated.tolist() == left.terminated.tolist() == [i == 3 for i in range(N)]
    assert torch.equal(left.reward, right.reward)


@pytest.mark.slow  # compiles kernels
def test_warp_divergence_names_environment_and_cause(tmp_path, caplog):
    pytest.importorskip("mujoco_warp")
    task = machine(tmp_path, PLAIN_TASK)
    for who, field, column, value, cause in (
        (0, "qpos", 0, math.nan, "qpos not finite"),
        (2, "qvel", 1, math.inf, "qpos not finite"),
        (4, "qpos", 1, 1e12, "qpos out of bounds"),
    ):
        env = build(task, N, "sim.engine=warp")
        env.reset()
        caplog.clear()
        CrashDumper(env, tmp_path / "dumps")
        env.step(torch.zeros(N, env.layout.action_size))
        env.engine.field(field)[who, column] = value
        result = env.step(torch.zeros(N, env.layout.action_size))
        assert result.terminated.tolist() == [i == who for i in range(N)]
        assert result.reward.isfinite().all()
        assert env.causes == {cause: 1}
        env.check()
        assert len(caplog.messages) == 1
        assert f"environment {who}: {cause} (joint 'robot/" in caplog.messages[0]
        assert not (tmp_path / "dumps").exists()
