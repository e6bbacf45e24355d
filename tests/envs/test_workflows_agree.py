"""A managed task with the cartpole terms of OmniIsaacGymEnvs has the rewards and ends of `cartpole-direct`."""

from pathlib import Path

import torch
from support.worlds import build, write

import rlcli_tasks.cartpole

TASK = """
decimation: 2
episode_length_s: 8.3
sim: {dt: 0.0083}
reward_dt_scaling: false
scene: {num_envs: 1000, ground: null, entities: {robot: {model: cartpole.xml, pos: [0.0, 0.0, 2.0]}}}
actions: {effort: {func: joint_effort, joints: [slider_to_cart], scale: 400.0}}
observations:
  policy:
    cart_pos: {func: joint_pos, joints: [slider_to_cart]}
    cart_vel: {func: joint_vel, joints: [slider_to_cart]}
    pole_pos: {func: joint_pos, joints: [cart_to_pole]}
    pole_vel: {func: joint_vel, joints: [cart_to_pole]}
rewards:
  alive: {func: is_alive, weight: 1.0}
  terminating: {func: is_terminated, weight: -2.0}
  angle: {func: while_alive_l2, weight: -1.0, joints: [cart_to_pole]}
  cart: {func: while_alive_l1, weight: -0.01, joints: [slider_to_cart]}
  pole: {func: while_alive_l1, weight: -0.005, joints: [cart_to_pole]}
terminations:
  time_out: {func: time_out, time_out: true}
  cart: {func: joint_pos_out_of_manual_limit, joints: [slider_to_cart], bounds: [-3.0, 3.0]}
  pole: {func: joint_pos_out_of_manual_limit, joints: [cart_to_pole], bounds: [-1.5707963267948966, 1.5707963267948966]}
"""

TERMS = '''
from rlcli.task import Entity, Joints


def while_alive_l2(env, *, entity: Entity = "robot", joints: Joints = ".*"):
    """(num_envs,)"""
    return entity.data.joint_pos[:, joints].clamp(-5, 5).square().sum(dim=1) * ~env.termination_manager.terminated


def while_alive_l1(env, *, entity: Entity = "robot", joints: Joints = ".*"):
    """(num_envs,)"""
    return entity.data.joint_vel[:, joints].clamp(-5, 5).abs().sum(dim=1) * ~env.termination_manager.terminated
'''


def test_workflows_agree_from_equal_states_and_actions(tmp_path):
    xml = (Path(rlcli_tasks.cartpole.__file__).parent / "cartpole.xml").read_text()
    managed = build(write(tmp_path / "oige", TASK, cartpole_xml=xml, terms_py=TERMS), 1000)
    direct = build("cartpole-direct", 1000)
    random = torch.Generator().manual_seed(5)
    spans = torch.tensor([3.3, 1.8, 4.0, 8.0], dtype=torch.float64)
    states = (torch.rand(1000, 4, generator=random, dtype=torch.float64) * 2 - 1) * spans
    action = torch.rand(1000, 1, generator=random) * 2 - 1
    ages = torch.randint(0, 500, (1000,), generator=random)
    results = []
    for env in (managed, direct):
        env.reset()
        env.engine.field("qpos")[:] = states[:, :2]
        env.engine.field("qvel")[:] = states[:, 2:]
        env.episode_length_buf[:] = ages
        results.append(env.step(action))
    a, b = results
    assert torch.equal(managed.engine.field("qpos")[~a.terminated & ~a.truncated],
                       direct.engine.field("qpos")[~a.terminated & ~a.truncated])  # fmt: skip
    assert 100 < int(a.terminated.sum()) < 900
    assert int(a.truncated.sum()) > 0
    assert torch.equal(a.terminated, b.terminated)
    assert torch.equal(a.truncated, b.truncated)
    assert float((a.reward - b.reward).abs().max()) < 1e-6
    for group in ("obs", "final_obs"):
        left, right = getattr(a, group)["policy"], getattr(b, group)["policy"]
        rows = ~(a.terminated | a.truncated) if group == "obs" else a.terminated | a.truncated
        assert torch.equal(left[rows].clamp(-5, 5), right[rows])
