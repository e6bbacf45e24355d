"""Both engines compute the same control step with contacts, from the same state.

They cannot agree over many steps: contacts of a hand with a cube magnify rounding. So each step starts from the state
of the CPU engine.
"""

from collections import Counter

import mujoco
import pytest
import torch
from support.worlds import actions, build

pytestmark = pytest.mark.warp
N, STEPS = 16, 25
STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl")


def pair(task):
    engines = [build(task, N, f"sim.engine={name}", seed=3) for name in ("batch", "warp")]
    for env in engines:
        env.reset(seed=5)
    return engines


def follow(device, host):
    """Copy the state of the host's environments to the device."""
    for name in STATE:
        device.engine.field(name).copy_(host.engine.field(name).float())


@pytest.mark.slow
@pytest.mark.parametrize(("task", "velocity"), [("hand-reorient", 0.02), ("ant-direct", 0.002)])
def test_engines_agree_on_step_with_contacts(task, velocity):
    host, device = pair(task)
    touching = 0
    for number, action in enumerate(actions(STEPS, N, host.layout.action_size)):
        follow(device, host)
        results = [env.step(0.7 * action) for env in (host, device)]
        assert torch.equal(results[0].terminated, results[1].terminated), number
        goes_on = ~results[0].terminated
        difference = (host.engine.field("qvel").float() - device.engine.field("qvel")).abs()[goes_on]
        assert float(difference.max()) < velocity, number
        assert float(difference.amax(dim=1).median()) < velocity / 20, number
        for group in results[0].obs:
            seen, there = (result.obs[group][goes_on] for result in results)
            torch.testing.assert_close(seen, there, atol=velocity, rtol=0.01, msg=lambda text, n=number: f"{n}: {text}")
        torch.testing.assert_close(results[0].reward, results[1].reward, atol=velocity, rtol=1e-3)
        touching += sum(host.world(env)[1].ncon > 0 for env in range(N))
    device.check()
    assert touching > 0.3 * N * STEPS, "there were contacts"


def contacts(env):
    """Return the number of contacts of each pair of geoms, for each world of the GPU engine."""
    engine = env.engine
    count = int(engine._data.nacon.numpy()[0])
    worlds, geoms = engine._data.contact.worldid.numpy()[:count], engine._data.contact.geom.numpy()[:count]
    return [Counter(frozenset(map(int, pair)) for pair in geoms[worlds == world]) for world in range(N)]


def test_engines_find_same_contacts_on_hand():
    """Contacts of two boxes differ: the engines report other points. So the palm consists of round bars."""
    host, device = pair("hand-reorient")
    for number, action in enumerate(actions(15, N, 16)):
        host.step(0.7 * action)
        if number % 3 != 2:
            continue  # a step on Warp's CPU device takes half a second
        follow(device, host)
        device.engine.step(1)
        for world, found in enumerate(contacts(device)):
            model, _ = host.world(world)
            data = mujoco.MjData(model)
            for name in STATE:
                getattr(data, name)[:] = host.engine.field(name)[world].numpy()
            mujoco.mj_forward(model, data)
            assert found == Counter(frozenset(map(int, pair)) for pair in data.contact.geom)


def test_solver_converges_in_its_iterations():
    """Without convergence the fingers were off by several rad/s, and the engines disagreed."""
    host, _ = pair("hand-reorient")
    for action in actions(25, N, 16):
        host.step(0.7 * action)
        for world in range(N):
            model, data = host.world(world)
            mujoco.mj_step(model, data)
            assert data.solver_niter[0] < model.opt.iterations
