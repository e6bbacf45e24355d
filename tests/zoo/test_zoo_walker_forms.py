"""Both forms of ant and of humanoid, stepped together: equal observations, rewards and terminations."""

import pytest
import torch
from support.worlds import build

torch.set_num_threads(1)


def same_states(managed, direct, rows):
    """Copy the state of the manager-based form to the direct form, in some environments."""
    for field in ("qpos", "qvel"):
        direct.engine.field(field)[rows] = managed.engine.field(field)[rows]


def close(left, right, what):
    torch.testing.assert_close(left, right, rtol=1e-5, atol=2e-5, msg=lambda text: f"{what}: {text}")


@pytest.mark.parametrize(("name", "size", "low"), [("ant", 8, 0.2), ("humanoid", 21, 0.7)])
def test_both_forms_agree_step_by_step(name, size, low):
    n, steps = 24, 150
    short = "episode_length_s=1.0"
    managed, direct = build(name, n, short), build(f"{name}-direct", n, short)
    managed.reset(), direct.reset()
    same_states(managed, direct, torch.arange(n))
    age = torch.arange(n) * 2  # so that time-outs happen at different steps
    managed.episode_length_buf[:], direct.episode_length_buf[:] = age, age
    for env in (managed, direct):
        env.engine.field("qvel")[:, 0] = torch.linspace(-3.0, 3.0, n).double()
        env.engine.field("qpos")[::6, 2], env.engine.field("qvel")[::6, 2] = low, -3.0  # these environments have fallen
    random = torch.Generator().manual_seed(1)
    falls = outs = 0
    for step in range(steps):
        action = torch.rand(n, size, generator=random) * 2 - 1
        a, b = managed.step(action), direct.step(action)
        assert torch.equal(a.terminated, b.terminated), step
        assert torch.equal(a.truncated, b.truncated), step
        close(a.reward, b.reward, f"reward of step {step}")
        over = a.terminated | a.truncated
        close(a.obs["policy"][~over], b.obs["policy"][~over], f"observations of step {step}")
        if over.any():
            close(a.final_obs["policy"][over], b.final_obs["policy"][over], f"last observations, step {step}")
            rows = over.nonzero()[:, 0]
            close(
                managed.engine.field("qpos")[rows][:, :7], direct.engine.field("qpos")[rows][:, :7], "where they start"
            )
        falls, outs = falls + int(a.terminated.sum()), outs + int(a.truncated.sum())
        same_states(managed, direct, torch.arange(n))  # initial states differ, and rounding errors would grow
    assert falls >= 3
    assert outs >= 5


@pytest.mark.parametrize("name", ["ant", "humanoid"])
def test_both_forms_have_same_initial_distribution(name):
    states = []
    for form in (name, f"{name}-direct"):
        env = build(form, 600)
        env.reset()
        states.append((env.engine.field("qpos").clone(), env.engine.field("qvel").clone()))
    for managed, direct in zip(*states, strict=True):
        assert float((managed.amin(dim=0) - direct.amin(dim=0)).abs().max()) < 0.02
        assert float((managed.amax(dim=0) - direct.amax(dim=0)).abs().max()) < 0.02
        assert float((managed.mean(dim=0) - direct.mean(dim=0)).abs().max()) < 0.04
        assert float((managed.std(dim=0) - direct.std(dim=0)).abs().max()) < 0.02
