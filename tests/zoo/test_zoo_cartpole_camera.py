"""The task `cartpole-camera`: its images; everything else equals `cartpole`."""

import math

import pytest
import torch
from support.worlds import build

from rlcli.config.load import resolve
from rlcli.registry import find_task

torch.set_num_threads(1)

TASK = "cartpole-camera"
WIDE, HIGH = 96, 32
PIXEL = 2.0 * 7.1 * math.tan(math.radians(16.5 / 2)) / HIGH
"""Edge of a pixel where the pole is seen, 7.1 m ahead, behind the cart [m]."""


@pytest.fixture
def env():
    env = build(TASK, 3)
    env.reset(seed=1)
    yield env
    env.close()


def show(env, cart, pole):
    """Return the images of carts and poles at given positions. (num_envs, 32, 96) [m]"""
    env.engine.field("qpos")[:] = torch.tensor([cart, pole]).double().T
    env.sensors["camera"].update(env.step_dt)
    return env.sensors["camera"].image[..., 0]


def middle(weights):
    """Column of the middle of what is seen in some rows, from the left."""
    return (weights.sum(dim=0) * torch.arange(WIDE)).sum() / weights.sum()


def test_cart_is_visible_at_its_position(env):
    """The camera looks along x, so that y points to the left."""
    carts = [-2.5, 0.0, 2.9]
    pictures = show(env, carts, [math.pi] * 3)  # poles hang
    for y, picture in zip(carts, pictures, strict=True):
        cart = (picture[14:15] - 1.0).clamp(min=0.0) * (picture[14:15] > 2.5)  # a row of the cart above the rail
        assert float(middle(cart)) == pytest.approx(47.5 - y / PIXEL, abs=1.0)


def test_whole_range_is_in_image(env):
    """Carts to 10 cm before where the episode ends, and poles all around: the tip is 0.97 m from the pivot."""
    for pole in (0.0, math.pi):
        left, _, right = show(env, [2.9, 0.0, -2.9], [pole] * 3)
        row = round(15.5 - math.cos(pole) * 0.9 / PIXEL)
        assert left[row].max() > 0.5
        assert right[row].max() > 0.5
        assert float(middle(left[row : row + 1])) == pytest.approx(47.5 - 2.9 / PIXEL, abs=1.0)
        assert float(middle(right[row : row + 1])) == pytest.approx(47.5 + 2.9 / PIXEL, abs=1.0)


def test_small_lean_and_its_side_are_visible(env):
    """A fifth of the tolerance of success, a sixth of a pixel at the tip."""
    pictures = show(env, [0.4, 0.4, 0.4], [-0.02, 0.0, 0.02])
    tops = [float(middle(picture[1:8])) for picture in pictures]
    assert tops[0] > tops[1] > tops[2] or tops[0] < tops[1] < tops[2]
    low = [float(middle(picture[1:8])) for picture in show(env, [0.4, 0.4, 0.4], [-0.3, 0.0, 0.3])]
    assert (tops[0] - tops[2]) * (low[0] - low[2]) > 0.0
    assert abs(low[0] - low[2]) * PIXEL == pytest.approx(2 * math.sin(0.3) * 0.75, abs=0.1)


def test_actor_observes_three_images_and_critic_state(env):
    (image,) = env.layout.observations["policy"]
    assert (image.shape, image.history, image.size) == ((1, HIGH, WIDE), 3, 3 * HIGH * WIDE)
    obs = env.reset(seed=2)
    assert obs["critic"].shape == (3, 4)
    frames = obs["policy"].unflatten(1, (3, HIGH, WIDE))
    assert torch.equal(frames[:, 0], frames[:, 2])  # the first image fills the history
    assert 1.95 < float(frames.max()) < 2.16  # 7 m are 2.1
    assert float((frames == 0.0).float().mean()) > 0.8  # empty space is 0
    frames = env.step(torch.full((3, 1), 1.0)).obs["policy"].unflatten(1, (3, HIGH, WIDE))
    assert torch.equal(frames[:, 0], frames[:, 1])
    assert not torch.equal(frames[:, 1], frames[:, 2])


def test_states_rewards_and_dones_equal_cartpole():
    """Compare with `cartpole` under the same actions through several episodes."""
    one, other = (build(task, 4) for task in (TASK, "cartpole"))
    obs, seen = one.reset(seed=5), other.reset(seed=5)
    generator = torch.Generator().manual_seed(0)
    ends = 0
    for _ in range(150):
        assert torch.equal(obs["critic"], seen["policy"])
        action = torch.rand(4, 1, generator=generator) * 2.0 - 0.6
        left, right = one.step(action), other.step(action)
        for name in ("reward", "terminated", "truncated"):
            assert torch.equal(getattr(left, name), getattr(right, name)), name
        ends += int((left.terminated | left.truncated).sum())
        obs, seen = left.obs, right.obs
    assert ends > 2
    one.close()
    mine, theirs = (resolve(find_task(task)).task for task in (TASK, "cartpole"))
    for part in ("success", "episode_length_s", "decimation", "actions", "terminations"):
        assert getattr(mine, part) == getattr(theirs, part), part


def test_final_images_show_last_state(env):
    env.reset(seed=3)
    while True:
        step = env.step(torch.full((3, 1), 4.0))  # off the rail to the left
        over = step.terminated.nonzero().flatten().tolist()
        if over:
            break
    last = step.final_obs["policy"].unflatten(1, (3, HIGH, WIDE))[over[0], 2].clone()
    y, angle = step.final_obs["critic"][over[0], :2].tolist()
    assert y > 3.0
    torch.testing.assert_close(last / 0.3, show(env, [y] * 3, [angle] * 3)[0], rtol=0.0, atol=1e-3)
