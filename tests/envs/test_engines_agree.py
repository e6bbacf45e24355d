"""The GPU engine, on Warp's CPU device, agrees with the CPU engine: in each step, and over many episodes."""

import math

import pytest
import torch
from support.worlds import actions, build, critter, pendulum

pytestmark = pytest.mark.warp
N = 8
SHORT = {  # episodes of about ten steps
    "cartpole": ("episode_length_s=0.16",),
    "cartpole-direct": ("episode_length_s=0.16",),
    "ant-direct": ("episode_length_s=0.16",),
    "quadcopter": ("episode_length_s=0.1",),
    "crazyflie": ("episode_length_s=0.1", "params.target_period=7", "params.target_low=[-1,-1,1]"),
    "ingenuity": ("episode_length_s=0.1", "params.target_period=7"),
    "humanoid": ("episode_length_s=0.16",),
}
TOLERANCE = {"cartpole": 2e-5, "cartpole-direct": 2e-5, "ant-direct": 2e-3, "quadcopter": 2e-4, "crazyflie": 2e-5,
             "ingenuity": 2e-5, "humanoid": 2e-3}  # fmt: skip
"""float32 rounding errors after the steps of one episode; they grow faster with contacts."""


def pair(task, num_envs=N, *overrides, seed=3):
    return [build(task, num_envs, f"sim.engine={engine}", *overrides, seed=seed) for engine in ("batch", "warp")]


def assert_same_step(host, device, tolerance, where):
    close = {"rtol": tolerance, "atol": tolerance, "msg": lambda text: f"{where}: {text}"}
    assert torch.equal(host.terminated, device.terminated), where
    assert torch.equal(host.truncated, device.truncated), where
    torch.testing.assert_close(host.reward, device.reward, **close)
    for group, values in host.obs.items():
        assert device.obs[group].dtype == torch.float32
        torch.testing.assert_close(values, device.obs[group], **close)
    finished = host.terminated | host.truncated
    episodes = device.episodes.ended()
    assert episodes.ids.tolist() == finished.nonzero()[:, 0].tolist(), where
    if not finished.any():
        return 0
    for group, values in host.final_obs.items():
        torch.testing.assert_close(values[finished], device.final_obs[group][finished], **close)
    assert torch.equal(host.episodes.ids, episodes.ids)
    assert torch.equal(host.episodes.lengths, episodes.lengths)
    assert torch.equal(host.episodes.truncated, episodes.truncated)
    torch.testing.assert_close(host.episodes.returns, episodes.returns, **close)
    assert host.episodes.reward_terms.keys() == episodes.reward_terms.keys()
    for name, values in host.episodes.reward_terms.items():
        torch.testing.assert_close(values, episodes.reward_terms[name], **close)
    assert {n: v.tolist() for n, v in host.episodes.causes.items() if v.any()} == {
        n: v.tolist() for n, v in episodes.causes.items() if v.any()
    }
    if host.episodes.success is None:
        assert episodes.success is None
    else:
        assert torch.equal(host.episodes.success, episodes.success)
    return len(episodes.ids)


def follow(host, device, tolerance, steps, strength=0.5):
    """Step both under the same actions, and return the number of ended episodes."""
    first = [env.reset(seed=5) for env in (host, device)]
    for group, values in first[0].items():
        torch.testing.assert_close(values, first[1][group], rtol=tolerance, atol=tolerance)
    ended = 0
    for i, action in enumerate(actions(steps, host.num_envs, host.layout.action_size)):
        results = [env.step(strength * action) for env in (host, device)]
        ended += assert_same_step(*results, tolerance, f"step {i}")
    device.check()
    assert host.divergences == device.divergences == 0
    assert torch.equal(host.episode_index, device.episode_index)
    assert host.common_step == device.common_step == steps
    return ended


@pytest.mark.parametrize("task", SHORT)
def test_engines_agree_through_resets(task):
    host, device = pair(task, N, *SHORT[task])
    ended = follow(host, device, TOLERANCE[task], 2 * host.max_episode_length + 2)
    assert ended >= 2 * N


@pytest.mark.parametrize("kept", [("reset_cart", "reset_pole"), ("reset_pole",), ()], ids=["all", "pole", "none"])
def test_engines_agree_on_states_that_resets_keep(kept):
    """Joints without a reset event go on from the last state of the episode; `kept` are the events that are removed."""
    overrides = [f"events.{name}=null" for name in kept]
    host, device = pair("cartpole", N, *SHORT["cartpole"], "keep_state_at_reset=true", *overrides)
    ended = follow(host, device, 1e-4, 3 * host.max_episode_length + 2)
    assert ended >= 3 * N
    for env in (host, device):
        env.episode_length_buf[::2] = env.max_episode_length - 1
        data = env.entities["robot"].data
        before, speed = data.joint_pos[::2].clone(), data.joint_vel[::2].clone()
        assert env.step(torch.zeros(N, 1)).truncated[::2].all()
        jump = (data.joint_pos[::2] - before - speed * env.step_dt).abs().amax(dim=0)
        for joint, name in enumerate(("reset_cart", "reset_pole")):
            assert bool(jump[joint] < 0.05) is (name in kept)
            assert before[:, joint].abs().max() > 0.1


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_engines_agree_through_terminations(task):
    host, device = pair(task, N)
    states = [env.reset(seed=5) for env in (host, device)]
    assert torch.equal(states[0]["policy"].isfinite(), states[1]["policy"].isfinite())
    causes = 0
    for i, action in enumerate(actions(30, N, 1)):
        push = torch.where(torch.arange(N)[:, None] < N // 2, 4.0 + action, 0.1 * action)
        results = [env.step(push) for env in (host, device)]
        assert_same_step(*results, 1e-3, f"step {i}")
        causes += int(results[0].terminated.sum())
    assert causes >= 2, "carts left their track"
    assert not results[0].terminated.all()
    device.check()


def test_engines_agree_with_every_kind_of_term(tmp_path):
    """Position actuators, root resets, pushes, wrenches at intervals and force terms, in free fall.

    Feet that hit the ground are chaotic: an error of 1e-6 grows to 1e-2 within three steps.
    """
    host, device = pair(critter(tmp_path), 6, "scene.ground=null", "sim.dt=0.01", "decimation=2")
    ended = follow(host, device, 2e-5, steps=40, strength=0.3)
    assert ended >= 12


def test_engines_agree_when_episodes_end_at_different_times(tmp_path):
    host, device = pair(pendulum(tmp_path), 5)
    for env in (host, device):
        env.reset(seed=5)
        env.episode_length_buf.copy_(torch.tensor([0, 3, 7, 9, 1]))
    ended = []
    for i, action in enumerate(actions(12, 5, 1)):
        results = [env.step(action) for env in (host, device)]
        ended.append(assert_same_step(*results, 1e-5, f"step {i}"))
    assert 1 in ended
    assert 0 in ended
    assert sum(ended) >= 5


def gather(env, episodes):
    """Return the returns and lengths of each environment's first episode under a random policy."""
    env.reset(seed=11)
    generator = torch.Generator().manual_seed(env.num_envs)
    returns, lengths = torch.full((env.num_envs,), math.nan), torch.zeros(env.num_envs)
    for _ in range(env.max_episode_length):
        result = env.step(torch.rand(env.num_envs, env.layout.action_size, generator=generator) * 2 - 1)
        if result.episodes is not None:
            ended = result.episodes.ended()
            new = returns[ended.ids].isnan()
            returns[ended.ids[new]], lengths[ended.ids[new]] = ended.returns[new], ended.lengths[new].float()
    assert not returns.isnan().any()
    env.check()
    return returns[:episodes], lengths[:episodes]


@pytest.mark.parametrize("task", ["cartpole", "ant-direct"])
def test_engines_agree_in_distribution_of_episodes(task):
    """Both sides have other start states and actions, so only the distributions can be equal."""
    overrides = {"cartpole": ("episode_length_s=0.8",), "ant-direct": ("episode_length_s=0.25",)}[task]
    host = build(task, 256, "sim.engine=batch", *overrides, seed=1)
    device = build(task, 256, "sim.engine=warp", *overrides, seed=2)
    host_values, device_values = gather(host, 256), gather(device, 256)
    for here, there in zip(host_values, device_values, strict=True):
        error = math.sqrt(float(here.var() + there.var()) / 256)
        assert abs(float(here.mean() - there.mean())) <= 4.0 * error + 1e-9
        if float(here.std()) > 0:
            assert 0.7 < float(there.std() / here.std()) < 1.4
