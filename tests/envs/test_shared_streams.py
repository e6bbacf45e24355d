"""`shared_streams`: groups of environments draw the same random numbers."""

import pytest
import torch
from support.worlds import ENGINES

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

NOISY = """
summary: A cart with noise, commands of chance and pushes.
decimation: 1
episode_length_s: 0.2
sim: {dt: 0.01, engine_threads: 1}
scene: {num_envs: 6, entities: {robot: {model: model.xml}}}
actions: {push: {func: joint_effort, joints: [slide]}}
observations:
  policy:
    pos: {func: joint_pos_rel, noise: {kind: uniform, low: -0.1, high: 0.1}}
events:
  mass: {func: randomize_body_mass, mode: startup, bodies: [block], range: [0.5, 2.0]}
  start: {func: reset_joints_by_offset, mode: reset, position: [-1.0, 1.0], velocity: [-1.0, 1.0]}
  damp: {func: randomize_joint_damping, mode: interval, interval_range_s: [0.03, 0.08], operation: set,
         range: [0.0, 5.0]}
rewards: {alive: {func: is_alive, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
"""
MODEL = """
<mujoco><worldbody><body name="block">
  <joint name="slide" type="slide"/><geom size="0.1" mass="1" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>
"""


@pytest.fixture(autouse=True)
def _one_torch_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def noisy(tmp_path):
    folder = tmp_path / "noisy"
    folder.mkdir()
    (folder / "task.yaml").write_text(NOISY)
    (folder / "model.xml").write_text(MODEL)
    return str(folder)


def rollout(task, *overrides, shared_streams=0, steps=50):
    """Observations and rewards of every step. (steps, num_envs, k)"""
    env = make_env(resolve(find_task(task), overrides=overrides), seed=5, shared_streams=shared_streams)
    seen = [env.reset(seed=5)["policy"].clone()]
    for number in range(steps):
        action = torch.full((env.num_envs, env.layout.action_size), 0.3 * (-1) ** number)
        seen.append(env.step(action).obs["policy"].clone())
    env.close()
    return torch.stack(seen)


@pytest.mark.parametrize("engine", ENGINES)
def test_shared_streams_repeat_those_of_fewer_envs(noisy, engine):
    steps = 50 if engine == "batch" else 12
    settings = (f"sim.engine={engine}", "episode_length_s=0.1")
    folded = rollout(noisy, *settings, shared_streams=2, steps=steps)
    torch.testing.assert_close(folded[:, 0:2], folded[:, 2:4], rtol=0, atol=0)
    torch.testing.assert_close(folded[:, 0:2], folded[:, 4:6], rtol=0, atol=0)
    assert not torch.equal(folded[:, 0], folded[:, 1])
    torch.testing.assert_close(
        rollout(noisy, *settings, "scene.num_envs=2", steps=steps), folded[:, 0:2], rtol=0, atol=0
    )


def test_without_shared_streams_envs_differ(noisy):
    seen = rollout(noisy, steps=2)
    assert len({float(x) for x in seen[0, :, 0]}) == 6


def test_shared_streams_hold_for_direct_tasks():
    folded = rollout("cartpole-direct", "scene.num_envs=4", shared_streams=2)
    torch.testing.assert_close(folded[:, 0:2], folded[:, 2:4], rtol=0, atol=0)
    torch.testing.assert_close(rollout("cartpole-direct", "scene.num_envs=2"), folded[:, 0:2], rtol=0, atol=0)


def test_shared_streams_use_same_terrain_patch(noisy):
    terrain = (
        "scene.terrain={kind: generator, rows: 3, columns: 5, patch: [4.0, 4.0], sub_terrains: {flat: {kind: flat}}}"
    )
    env = make_env(resolve(find_task(noisy), overrides=[terrain, "scene.num_envs=8"]), seed=5, shared_streams=4)
    assert torch.equal(env.origins[:4], env.origins[4:])
    assert torch.equal(env.env_origins[:4], env.env_origins[4:])
    assert len({tuple(place) for place in env.origins[:4].tolist()}) > 1
