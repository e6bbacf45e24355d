"""Contract of a step, with all managers at work: commands, noise, history, ...

One task has all of them. The tests end episodes at chosen times.
"""

import mujoco
import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from support.worlds import CRITTER, CRITTER_TASK, build, clone, dump, write

torch.set_num_threads(1)

TERMS = '''
"""Terms that write down what they see."""

import torch
from torch import Tensor

from rlcli.task import Entity

class Log:
    """0; records the positions of bodies and joints that the terms of this step read."""

    def __init__(self, env, *, name: str, entity: Entity = "robot") -> None:
        self._env, self._name = env, name
        env.notes = getattr(env, "notes", {})

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        field = self._env.engine.field
        self._env.notes[self._name] = (field("qpos").clone(), field("xpos").clone())
        return torch.zeros(self._env.num_envs, device=self._env.device)


class LogEnd(Log):
    """Never."""

    def __init__(self, env, *, name: str, entity: Entity = "robot") -> None:
        super().__init__(env, name=name, entity=entity)

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        return super().__call__() > 1.0


def height(env, *, entity: Entity = "robot") -> Tensor:
    """(num_envs,)"""
    return entity.data.root_pos_w[:, 2]


def never_called(env) -> Tensor:
    """(num_envs,)"""
    raise AssertionError("a term of weight 0 was called")


class Beats:
    """Event that counts its calls, and adds up the steps of the episode at which it fires."""

    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self._env = env
        env.beats = torch.zeros(env.num_envs, dtype=torch.int64)
        env.beat_steps = [[] for _ in range(env.num_envs)]

    def __call__(self, selection) -> None:
        """Count."""
        selection.add(self._env.beats, 1)
        for env_id in selection.env_ids().tolist():
            self._env.beat_steps[env_id].append(int(self._env.episode_length_buf[env_id]))
'''


def full_task(**changes):
    """Return the critter's task with some terms of every manager."""
    task = yaml.safe_load(CRITTER_TASK)
    task["commands"] = {
        "walk": {"func": "uniform_velocity", "resampling_time_s": [0.06, 0.2], "lin_vel_x": [-1.0, 1.0],
                 "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-1.0, 1.0]}}  # fmt: skip
    policy = task["observations"]["policy"]
    policy["command"] = {"func": "generated_commands", "command": "walk"}
    policy["noisy"] = {"func": "joint_pos", "noise": {"kind": "uniform", "low": -0.1, "high": 0.1}, "history": 3}
    policy["late"] = {"func": "joint_vel", "delay": {"steps": [0, 3]}}
    policy["biased"] = {"func": "base_ang_vel", "bias": {"kind": "gaussian", "std": 0.1}}
    task["observations"]["clean"] = {"enable_corruption": False, **yaml.safe_load(dump(policy))}
    task["curriculum"] = {"rate": {"func": "stages", "address": "rewards.rate.weight", "steps": [7], "values": [-0.5]}}
    task["rewards"]["track"] = {"func": "track_lin_vel_xy_exp", "weight": 1.0, "command": "walk", "std": 0.5}
    task["rewards"]["acc"] = {"func": "action_acc_l2", "weight": -0.01}
    for key, value in changes.items():
        for name, part in value.items():
            if part is None:
                task[key].pop(name)
            else:
                task[key][name] = part
    return task


def make(tmp_path, num_envs, task=None, *overrides, seed=42):
    folder = write(tmp_path / "whole", dump(task or full_task()), critter_xml=CRITTER, terms_py=TERMS)
    return build(folder, num_envs, *overrides, seed=seed)


def idle(env):
    return torch.zeros(env.num_envs, env.layout.action_size)


def columns(env, group, name):
    start = 0
    for term in env.layout.observations[group]:
        if term.name == name:
            return slice(start, start + term.size)
        start += term.size
    raise AssertionError(name)


def end_now(env, *ids):
    env.episode_length_buf[list(ids)] = env.max_episode_length - 1


def test_terminating_step_rewards_terminal_state(tmp_path):
    task = full_task(curriculum={"rate": None})
    task["rewards"] = {"alive": {"func": "is_alive", "weight": 1.0}, "fell": {"func": "is_terminated", "weight": -5.0},
                       "height": {"func": "height", "weight": 100.0}}  # fmt: skip
    task["reward_dt_scaling"] = False
    env = make(tmp_path, 4, task)
    env.reset()
    env.engine.field("qpos")[2, 2:7] = torch.tensor([1.0, 0.0, 1.0, 0.0, 0.0], dtype=torch.float64)  # on its back
    result = env.step(idle(env))
    assert result.terminated.tolist() == [False, False, True, False]
    terminal = float(result.final_obs["policy"][2, columns(env, "policy", "height")][0])
    assert terminal > 0.9
    assert float(result.reward[2]) == pytest.approx(0.0 - 5.0 + 100.0 * terminal, rel=1e-6)
    height = env.entities["robot"].data.root_pos_w[:, 2]
    assert float(height[2]) < 0.5, "by then it stands again"
    for i in (0, 1, 3):
        assert float(result.reward[i]) == pytest.approx(1.0 + 100.0 * float(height[i]), rel=1e-6)


def test_time_out_counts_as_alive(tmp_path):
    task = full_task(curriculum={"rate": None})
    task["rewards"] = {"alive": {"func": "is_alive", "weight": 1.0}, "fell": {"func": "is_terminated", "weight": -5.0}}
    task["reward_dt_scaling"] = False
    env = make(tmp_path, 4, task)
    env.reset()
    end_now(env, 1)
    result = env.step(idle(env))
    assert result.truncated.tolist() == [False, True, False, False]
    assert result.reward.tolist() == [1.0] * 4


def test_autoreset_returns_state_of_new_episode(tmp_path):
    """Counters, actions, observations, history, delays and commands belong to the new episode."""
    env = make(tmp_path, 4)
    env.reset()
    for _ in range(5):
        before = env.step(torch.full((4, 4), 0.3))
    old_command = env.command_manager.get_command("walk")[2].clone()
    end_now(env, 2)
    result = env.step(torch.full((4, 4), 0.3))
    assert env.episode_length_buf.tolist() == [6, 6, 0, 6]
    for action in (env.action_manager.action, env.action_manager.prev_action):
        assert not action[2].any()
        assert (action[[0, 1, 3]] == 0.3).all()
    clean, robot = result.obs["clean"], env.entities["robot"]
    joint_pos, joint_vel = robot.data.joint_pos, robot.data.joint_vel
    history = clean[:, columns(env, "clean", "noisy")].view(4, 3, 4)
    assert torch.equal(history[2], joint_pos[2].expand(3, 4)), "filled with the episode's first value"
    assert torch.equal(history[:, 2], joint_pos)
    assert not torch.equal(history[0, 0], history[0, 2]), "the others have a past"
    late = result.obs["policy"][:, columns(env, "policy", "late")]
    assert torch.equal(late[2], joint_vel[2]), "a delayed value begins with the first"
    gravity = clean[:, columns(env, "clean", "gravity")]
    assert torch.equal(gravity, robot.data.projected_gravity_b)
    command = env.command_manager.get_command("walk")
    assert torch.equal(clean[:, columns(env, "clean", "command")], command)
    assert not torch.equal(command[2], old_command)
    assert not clean[2, columns(env, "clean", "action")].any()
    final = result.final_obs["clean"][2]
    assert (final[columns(env, "clean", "action")] == 0.3).all(), "the old episode's last observation is its own"
    past = before.obs["clean"][2, columns(env, "clean", "noisy")].view(3, 4)
    assert torch.equal(final[columns(env, "clean", "noisy")].view(3, 4)[:2], past[1:])
    assert torch.equal(final[columns(env, "clean", "command")], old_command)


@pytest.mark.parametrize(("dt", "decimation", "every", "steps"), [
    (0.005, 4, 0.1, 5), ("1/120", 2, 0.05, 3), (0.0083, 3, 0.0747, 3), (0.003, 7, 0.084, 4)])  # fmt: skip
def test_interval_timers_count_whole_steps(tmp_path, dt, decimation, every, steps):
    task = full_task()
    task["sim"], task["decimation"] = {"dt": dt}, decimation
    task["episode_length_s"] = 10.0
    task["terminations"] = {"time_out": {"func": "time_out", "time_out": True}}
    task["events"]["beat"] = {"func": "beats", "mode": "interval", "interval_range_s": [every, every]}
    env = make(tmp_path, 2, task)
    env.reset()
    for _ in range(8 * steps + 1):
        env.step(idle(env))
    assert env.beats.tolist() == [8, 8]
    assert env.beat_steps[0] == [steps * k for k in range(1, 9)]


def test_interval_timer_restarts_only_with_its_episode(tmp_path):
    task = full_task()
    task["terminations"] = {"time_out": {"func": "time_out", "time_out": True}}
    task["events"]["beat"] = {"func": "beats", "mode": "interval", "interval_range_s": [0.1, 0.1]}
    env = make(tmp_path, 2, task)
    env.reset()
    for step in range(12):
        if step == 3:
            end_now(env, 1)
        env.step(idle(env))
    assert env.beat_steps == [[5, 10], [5]]


def test_group_without_corruption_has_no_noise(tmp_path):
    quiet = full_task()
    for group in quiet["observations"].values():
        for term in group.values():
            if isinstance(term, dict):
                for key in ("noise", "bias", "delay"):
                    term.pop(key, None)
    noisy, plain = make(tmp_path / "a", 3), make(tmp_path / "b", 3, quiet)
    first = [env.reset() for env in (noisy, plain)]
    assert torch.equal(first[0]["clean"], first[1]["clean"])
    for step in range(40):
        action = torch.full((3, 4), 0.3 * (-1) ** step)
        results = [env.step(action) for env in (noisy, plain)]
        assert torch.equal(results[0].obs["clean"], results[1].obs["clean"])
        assert torch.equal(results[1].obs["clean"], results[1].obs["policy"])
        assert torch.equal(results[0].reward, results[1].reward)
        assert not torch.equal(results[0].obs["policy"], results[1].obs["policy"])


def test_zero_weight_reward_is_not_called(tmp_path):
    env = make(tmp_path, 2, full_task(rewards={"never": {"func": "never_called", "weight": 0.0}}))
    env.reset()
    for _ in range(35):
        result = env.step(idle(env))
    assert result.reward.isfinite().all()
    with pytest.raises(AssertionError, match="weight 0"):
        make(tmp_path / "called", 2, full_task(rewards={"never": {"func": "never_called", "weight": 0.1}}))


@pytest.mark.parametrize("engine", ["batch", "warp"])
def test_terms_read_kinematics_of_returned_state(tmp_path, engine):
    """Rewards, terminations and success read body positions of the final joint positions."""
    task = full_task(rewards={"log": {"func": "log", "weight": 1.0, "name": "reward"}},
                 terminations={"log": {"func": "log_end", "name": "termination"}})  # fmt: skip
    task["success"] = {"logged": {"func": "log_end", "name": "success"}}
    env = make(tmp_path, 3, task, f"sim.engine={engine}", "episode_length_s=0.1")
    env.reset()
    data, near = mujoco.MjData(env.engine.model), 1e-12 if engine == "batch" else 2e-6
    for step in range(12):
        env.step(torch.full((3, 4), 0.5 * (-1) ** step))
        assert env.notes.keys() == {"reward", "termination", "success"}
        for seen_qpos, seen_xpos in env.notes.values():
            for i in range(3):
                data.qpos[:] = seen_qpos[i].numpy()
                mujoco.mj_kinematics(env.engine.model, data)
                np.testing.assert_allclose(
                    seen_xpos[i].numpy(), data.xpos, rtol=0, atol=1e-12 if engine == "batch" else 2e-6
                )
        if step % 5 != 4:  # no episode has ended: this is the returned state
            assert torch.equal(seen_qpos, env.engine.field("qpos"))
        # after a reset: kinematics of the new state
        for i in range(3):
            data.qpos[:] = env.engine.field("qpos")[i].numpy()
            mujoco.mj_kinematics(env.engine.model, data)
            np.testing.assert_allclose(env.engine.field("xpos")[i].numpy(), data.xpos, rtol=0, atol=near)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Two equal environments in which no episode ends by itself."""
    folder = tmp_path_factory.mktemp("pair")
    task = full_task()
    task["terminations"] = {"time_out": {"func": "time_out", "time_out": True}}
    task["episode_length_s"] = 4.0
    return [make(folder / name, 5, task) for name in ("a", "b")]


def carried(env):
    """Return the whole state of the environments, one row for each."""
    rows = {}
    for name, value in env.state_dict().items():
        if value.dim() and value.shape[0] == 5:
            rows[name] = value
        elif value.dim() > 1 and value.shape[1] == 5:  # one row for each term
            rows[name] = value.transpose(0, 1)
    return rows


@settings(max_examples=25, deadline=None)
@given(ending=st.sets(st.integers(0, 4), max_size=4), at=st.integers(1, 6), seed=st.integers(0, 1000))
def test_partial_reset_keeps_other_envs_bit_identical(pair, ending, at, seed):
    """State, observations, histories, delays, timers, commands and sums of the others stay."""
    others = [i for i in range(5) if i not in ending]
    generator = torch.Generator().manual_seed(seed)
    actions = torch.rand(at + 3, 5, 4, generator=generator) - 0.5
    for env in pair:
        env.reset(seed=seed)
    for step, action in enumerate(actions):
        if step == at:
            end_now(pair[0], *ending)
        results = [clone(env.step(action)) for env in pair]
        for group in results[0].obs:
            assert torch.equal(results[0].obs[group][others], results[1].obs[group][others])
        assert torch.equal(results[0].reward[others], results[1].reward[others])
    left, right = (carried(env) for env in pair)
    assert left.keys() == right.keys()
    assert len(left) > 12
    for name, value in left.items():
        assert torch.equal(value[others], right[name][others]), name
    assert all(not torch.equal(left["engine.state"][i], right["engine.state"][i]) for i in ending)
