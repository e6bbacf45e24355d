"""The tasks as rlcli tasks: contract, saved states, initial states, both engines, training."""

import json
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from rlcli_gymnasium.base import float32_sum
from test_parity import TASKS, ours

from rlcli.adapters.gymnasium import action_space
from rlcli.config.load import resolve
from rlcli.registry import find_task
from rlcli.testing import check_task

torch.set_num_threads(1)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_and_episode_lengths_equal_gymnasium(task):
    env, spec = ours(task), gymnasium.spec(TASKS[task])
    theirs = gymnasium.make(spec)
    assert env.max_episode_length == spec.max_episode_steps
    assert (env.layout.size(),) == theirs.observation_space.shape
    assert len(env.layout.observations["policy"]) == env.layout.size()  # every column has a name
    assert action_space(env) == theirs.action_space
    assert env.step_dt == pytest.approx(theirs.unwrapped.dt)


@pytest.mark.parametrize("columns", [1, 2, 3, 6, 7, 8])
def test_float32_sum_equals_numpy_bit_for_bit(columns):
    values = np.random.default_rng(0).normal(size=(4000, columns)).astype(np.float32)
    expected = np.array([np.sum(row) for row in values])
    np.testing.assert_array_equal(float32_sum(torch.from_numpy(values)).numpy(), expected)


@pytest.mark.parametrize("task", ["gym-inverted-pendulum", "gym-hopper"])
def test_contract(task):
    assert [finding for finding in check_task(task) if finding.severity == "error"] == []


@pytest.mark.slow
@pytest.mark.parametrize("task", [task for task in TASKS if task not in ("gym-inverted-pendulum", "gym-hopper")])
def test_contract_except_constant_columns(task):
    errors = [finding for finding in check_task(task) if finding.severity == "error"]
    assert [finding for finding in errors if finding.check != "constant-columns"] == []


@pytest.mark.parametrize("task", ["gym-ant", "gym-humanoid", "gym-reacher", "gym-inverted-double-pendulum"])
def test_late_values_become_current_with_switch(task):
    late, current = ours(task), ours(task, "sim.derived_fields=current")
    for env in (late, current):
        env.reset()
    assert torch.equal(late.task.observation, current.task.observation)
    action = torch.full((4, late.layout.action_size), 0.3)
    results = [env.step(action) for env in (late, current)]
    assert torch.equal(late.engine.field("qpos"), current.engine.field("qpos"))
    assert not torch.equal(results[0].reward, results[1].reward)


@pytest.mark.parametrize("task", ["gym-ant", "gym-humanoid", "gym-inverted-double-pendulum"])
def test_saved_state_continues_bit_for_bit(task):
    env, other = ours(task), ours(task)
    env.reset()
    action = torch.full((4, env.layout.action_size), 0.2)
    for _ in range(12):
        obs = env.step(action).obs["policy"]
    again = other.load_state_dict(env.state_dict())["policy"]
    assert torch.equal(obs, again)
    for _ in range(12):
        here, there = env.step(action), other.step(action)
        assert torch.equal(here.obs["policy"], there.obs["policy"])
        assert torch.equal(here.reward, there.reward)


@pytest.mark.parametrize("task", TASKS)
def test_rollout_does_not_depend_on_num_envs(task):
    few, many = ours(task), ours(task, "scene.num_envs=7")
    few.reset()
    many.reset()
    for _ in range(10):
        a = few.step(torch.full((4, few.layout.action_size), 0.25))
        b = many.step(torch.full((7, few.layout.action_size), 0.25))
        assert torch.equal(a.obs["policy"], b.obs["policy"][:4])
        assert torch.equal(a.reward, b.reward[:4])


@pytest.mark.parametrize("task", TASKS)
def test_initial_states_have_gymnasium_distribution(task):
    env = ours(task, "scene.num_envs=400")
    env.reset()
    theirs = gymnasium.make(TASKS[task]).unwrapped
    starts = []
    for seed in range(400):
        theirs.reset(seed=seed)
        starts.append(np.concatenate([theirs.data.qpos, theirs.data.qvel]))
    found = torch.cat([env.engine.field("qpos"), env.engine.field("qvel")], dim=1).numpy()
    expected = np.array(starts)
    spread = expected.std(axis=0)
    np.testing.assert_allclose(found.mean(axis=0), expected.mean(axis=0), rtol=0, atol=0.35 * spread.max() + 1e-6)
    np.testing.assert_allclose(found.std(axis=0), spread, rtol=0.25, atol=1e-6)


def test_target_and_puck_positions_have_gymnasium_distribution():
    reacher, pusher = ours("gym-reacher", "scene.num_envs=2000"), ours("gym-pusher", "scene.num_envs=2000")
    reacher.reset()
    pusher.reset()
    target = torch.linalg.vector_norm(reacher.engine.field("qpos")[:, -2:], dim=1)
    puck = pusher.engine.field("qpos")[:, -4:-2]
    assert 0.19 < float(target.max()) < 0.2
    assert float((target < 0.1).float().mean()) == pytest.approx(0.25, abs=0.04)  # uniform over the disc
    assert float(torch.linalg.vector_norm(puck, dim=1).min()) > 0.17
    assert -0.3 <= float(puck[:, 0].min()) < -0.29
    assert float(puck[:, 1].abs().max()) <= 0.2


def rlcli(folder, *arguments):
    command = [sys.executable, "-m", "rlcli", *arguments, "--runs-dir", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("agent", ["sb3-ppo", "ppo"])
def test_agents_train(task, agent, tmp_path):
    sizes = {"sb3-ppo": ["agent.n_steps=8"], "ppo": ["agent.num_steps=8"]}[agent]
    rlcli(tmp_path, "train", task, "--agent", agent, "--max-iterations", "2", "--num-envs", "8", "--quiet", *sizes)
    report = json.loads(
        rlcli(tmp_path, "eval", task, "--episodes", "2", "--num-envs", "2", "--json", "episode_length_s=1")
    )
    assert report["episodes"] >= 2


@pytest.mark.slow
@pytest.mark.parametrize("task", ["gym-ant", "gym-half-cheetah", "gym-hopper", "gym-swimmer", "gym-walker2d"])
def test_million_step_agents_train_for_a_million_steps(task, tmp_path):
    agent = resolve(find_task(task), agent="ppo-1m")
    steps = agent.agent.max_iterations * agent.agent.num_steps * agent.task.scene.num_envs
    assert 0.99e6 < steps <= 1e6
    rlcli(tmp_path, "train", task, "--agent", "ppo-1m", "--max-iterations", "1", "--quiet", "agent.num_epochs=1")


@pytest.mark.slow
def test_pendulum_is_balanced_after_training(tmp_path):
    rlcli(tmp_path, "train", "gym-inverted-pendulum", "--quiet")
    report = json.loads(rlcli(tmp_path, "eval", "gym-inverted-pendulum", "--episodes", "20", "--json"))
    assert report["return"]["mean"] >= 950  # Gymnasium's own threshold


@pytest.mark.slow  # Warp compiles the kernels of each model
@pytest.mark.parametrize("task", ["gym-hopper", "gym-ant", "gym-humanoid"])
def test_gpu_engine_equals_cpu_in_first_steps(task):
    pytest.importorskip("mujoco_warp", reason="the GPU engine is an extra of rlcli")
    host, device = ours(task), ours(task, "sim.engine=warp")
    for env in (host, device):
        env.reset()
    assert torch.allclose(host.task.observation.float(), device.task.observation.float(), rtol=1e-3, atol=1e-3)
    action = torch.full((4, host.layout.action_size), 0.1)
    a, b = host.step(action), device.step(action)
    assert torch.allclose(a.reward, b.reward, rtol=0.02, atol=0.02)
