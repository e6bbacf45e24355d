"""Observation term of a camera, with an image that was made by hand."""

import pytest
import torch
from support.worlds import build, edited, write

from rlcli.errors import ConfigError
from rlcli.mdp.observations import image

torch.set_num_threads(1)

MODEL = """
<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="0 1 0"/>
  <geom size="0.2" contype="0" conaffinity="0" mass="1" rgba="0.9 0.3 0.1 1"/></body></worldbody></mujoco>
"""
TASK = """
decimation: 1
episode_length_s: 1.0
sim: {dt: 0.01}
scene:
  num_envs: 2
  ground: null
  entities: {robot: {model: model.xml}}
  sensors:
    eye: {kind: camera, data: rgb, width: 3, height: 2, samples: 4, eye: [-1, 0, 0], lookat: [0, 0, 0]}
    depth: {kind: camera, data: depth, width: 3, height: 2, eye: [-1, 0, 0], lookat: [0, 0, 0]}
    rays: {kind: rays, pattern: [[1, 0, 0]], sees: all}
actions: {push: {func: joint_effort}}
observations:
  policy:
    colours: {func: image, sensor: eye}
    raw: {func: image, sensor: eye, normalize: false}
    depth: {func: image, sensor: depth, history: 2}
rewards: {alive: {func: is_alive, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
"""
COLOURS = torch.tensor(
    [[[[255, 0, 0], [0, 51, 0], [0, 0, 0]], [[0, 0, 102], [0, 0, 0], [0, 0, 0]]]] * 2, dtype=torch.uint8
)
"""(num_envs, rows, columns, channels)"""


@pytest.fixture
def env(tmp_path):
    env = build(write(tmp_path / "task", TASK, model_xml=MODEL), 2)
    env.reset(seed=1)
    yield env
    env.close()


def test_image_normalizes_colours(env):
    eye = env.sensors["eye"]
    eye.image.copy_(COLOURS)
    seen = image(env, sensor=eye)
    assert seen.shape == (2, 3, 2, 3)  # channels, rows, columns
    assert seen.dtype == torch.float32
    for channel, (row, column, value) in enumerate(((0, 0, 1.0), (0, 1, 0.2), (1, 0, 0.4))):
        expected = torch.full((2, 3), -value / 6.0)
        expected[row, column] += value
        torch.testing.assert_close(seen[0, channel], expected, rtol=0.0, atol=1e-6)
    raw = image(env, sensor=eye, normalize=False)
    torch.testing.assert_close(raw, COLOURS.movedim(3, 1).float(), rtol=0.0, atol=0.0)


def test_image_keeps_distances_in_metres(env):
    depth = env.sensors["depth"]
    depth.image.copy_(torch.arange(12.0).view(2, 2, 3, 1))
    for normalize in (True, False):
        seen = image(env, sensor=depth, normalize=normalize)
        assert torch.equal(seen, torch.arange(12.0).view(2, 1, 2, 3))


def test_image_layout_is_row_major_with_shape(env):
    colours, raw, depth = env.layout.observations["policy"]
    assert [(term.size, term.shape, term.history) for term in (colours, raw, depth)] == [
        (18, (3, 2, 3), 1),
        (18, (3, 2, 3), 1),
        (12, (1, 2, 3), 2),
    ]
    obs = env.step(torch.zeros(2, 1)).obs["policy"]
    picture = env.sensors["eye"].image.movedim(3, 1).float()
    assert picture.amax() > 0.0
    assert torch.equal(obs[:, 18:36], picture.flatten(1))


def test_image_rejects_other_kind_of_sensor(tmp_path):
    folder = write(tmp_path / "task", TASK.replace("sensor: eye}", "sensor: rays}"), model_xml=MODEL)
    with pytest.raises(ConfigError, match="of kind rays, the term needs one of kind camera"):
        build(folder, 2)


def test_three_dimensional_term_is_rejected(tmp_path):
    own = "import torch\ndef flat(env):\n    return torch.zeros(env.num_envs, 2, 3)\n"
    task = edited(TASK, observations={"policy": {"flat": {"func": "flat"}}})
    with pytest.raises(ConfigError, match=r"a tensor of shape \(2, 2, 3\)"):
        build(write(tmp_path / "task", task, model_xml=MODEL, terms_py=own), 2)
