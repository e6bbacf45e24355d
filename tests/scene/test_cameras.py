"""Tests of camera sensors on boxes with known positions, sizes and colours."""

import math
import os
import subprocess
import sys
import threading

import pytest
import torch
from support.worlds import build, dump, edited, write

from rlcli.errors import ConfigError, MachineError

torch.set_num_threads(1)

BOXES = """
<mujoco>
  <default><geom contype="0" conaffinity="0" density="1000"/></default>
  <worldbody>
    <body name="slab" pos="2.05 0 1"><geom name="slab" type="box" size="0.05 0.4 0.2" rgba="1 0 0 1"/></body>
    <body name="up" pos="4 0 3"><geom type="box" size="0.1 0.1 0.1" rgba="0 1 0 1"/></body>
    <body name="left" pos="4 2 1"><geom type="box" size="0.1 0.1 0.1" rgba="0 0 1 1"/></body>
    <body name="cart" pos="0 0 5"><joint name="slide" type="slide" axis="0 1 0"/>
      <geom name="cart" type="sphere" size="0.2" rgba="1 1 1 1"/>
      <camera name="ahead" xyaxes="0 -1 0 0 0 1" fovy="60"/></body>
  </worldbody>
</mujoco>
"""
TASK = {
    "decimation": 2,
    "episode_length_s": 0.06,
    "sim": {"dt": 0.01, "gravity": [0.0, 0.0, 0.0]},
    "scene": {"num_envs": 3, "ground": None, "entities": {"robot": {"model": "boxes.xml"}}},
    "actions": {"push": {"func": "joint_effort"}},
    "observations": {"policy": {"pos": {"func": "joint_pos"}}},
    "events": {
        "start": {"func": "reset_joints_by_offset", "mode": "reset", "position": [-0.5, 0.5], "velocity": [0.5, 2.0]}
    },
    "rewards": {"alive": {"func": "is_alive", "weight": 1.0}},
    "terminations": {"time_out": {"func": "time_out", "time_out": True}},
}
FRONT = {
    "kind": "camera",
    "data": "depth",
    "width": 41,
    "height": 31,
    "eye": [0, 0, 1],
    "lookat": [1, 0, 1],
    "fov": 60.0,
}
CART = {"kind": "camera", "data": "depth", "width": 64, "height": 24, "eye": [-3, 0, 5], "lookat": [0, 0, 5]}


@pytest.fixture
def boxes(tmp_path):
    """Make environments with cameras, which are closed after the test."""
    made = []

    def make(sensors, *overrides, num_envs=3, **changes):
        folder = tmp_path / f"boxes{len(made)}"
        task = edited(dump(TASK), scene={"sensors": sensors}, **changes)
        env = build(write(folder, task, boxes_xml=BOXES), num_envs, *overrides)
        made.append(env)
        env.reset(seed=1)
        return env

    yield make
    for env in made:
        env.close()


def read_image(env, name="camera"):
    return env.sensors[name].image


def step(env, count=1):
    for _ in range(count):
        result = env.step(torch.zeros(env.num_envs, 1))
    return result


# --- images ---


def test_depth_is_along_camera_axis_and_0_without_hit(boxes):
    depth = read_image(boxes({"camera": FRONT}))[0, :, :, 0]
    assert depth.shape == (31, 41)
    assert depth[15, 20].item() == pytest.approx(2.0, abs=1e-4)  # the face of the slab
    assert depth[0, 0].item() == 0.0
    # 15.5 pixels from the middle are tan(30 degrees): the slab of 0.8 x 0.4 m at 2 m is 10.7 pixels wide and 5.4 high
    slab = (depth - 2.0).abs() < 1e-3
    assert slab.any(dim=0).sum() == 11
    assert slab.any(dim=1).sum() == 5


def test_distance_is_along_ray_from_camera(boxes):
    env = boxes({"depth": FRONT, "distance": {**FRONT, "data": "distance"}})
    depth, distance = read_image(env, "depth")[0, :, :, 0], read_image(env, "distance")[0, :, :, 0]
    pixel = math.tan(math.radians(30.0)) / 15.5
    rows, columns = torch.meshgrid(torch.arange(31) - 15, torch.arange(41) - 20, indexing="ij")
    along = torch.sqrt(1.0 + (pixel * rows) ** 2 + (pixel * columns) ** 2)
    torch.testing.assert_close(distance, depth * along, rtol=1e-5, atol=0.0)
    assert distance.max() > depth.max() > 0.0


def test_distance_image_equals_ray_casts(boxes):
    """Return the pixels whose neighbours have a similar depth: no edge runs through them."""
    env = boxes({"camera": {**FRONT, "data": "distance"}})
    seen = read_image(env)[:, :, :, 0]
    pixel = math.tan(math.radians(30.0)) / 15.5
    rows, columns = torch.meshgrid(torch.arange(31) - 15, torch.arange(41) - 20, indexing="ij")
    ways = torch.stack([torch.ones(31, 41), -pixel * columns, -pixel * rows], dim=-1).view(1, -1, 3)
    ways = torch.nn.functional.normalize(ways, dim=2).expand(3, -1, -1)
    points = torch.tensor([0.0, 0.0, 1.0]).expand(ways.shape)
    rays = env.engine.rays(points, ways, groups=None, exclude=-1, selection=None).view(3, 31, 41).clamp(min=0.0)
    far = torch.nn.functional.max_pool2d(rays[:, None], 3, 1, 1)[:, 0]
    near = -torch.nn.functional.max_pool2d(-rays[:, None], 3, 1, 1)[:, 0]
    plain = (far - near) < 0.05
    assert (plain & (rays > 0.0)).sum() > 30
    torch.testing.assert_close(seen[plain], rays[plain], rtol=1e-3, atol=1e-3)


def test_segmentation_has_the_ids_of_bodies(boxes):
    env = boxes({"eye": {**FRONT, "data": "segmentation"}})
    env.reset()
    seen = env.sensors["eye"].image[..., 0]
    depth = boxes({"eye": FRONT})
    depth.reset()
    ids = {name: env.engine.model.body(f"robot/{name}").id for name in ("slab", "up", "left")}
    assert set(seen.unique().tolist()) <= {-1.0, *map(float, ids.values())}
    assert bool((seen[:, 15, 20] == ids["slab"]).all())  # the middle of the image
    assert torch.equal(seen == -1.0, depth.sensors["eye"].image[..., 0] == 0.0)


def test_image_has_top_row_and_left_column_first(boxes):
    colours = read_image(boxes({"camera": {**FRONT, "data": "rgb", "fov": 80.0}}))[0].int()
    assert colours.shape == (31, 41, 3)
    green = (colours[..., 1] > colours[..., 0] + 40).nonzero()
    blue = (colours[..., 2] > colours[..., 0] + 40).nonzero()
    red = (colours[..., 0] > colours[..., 1] + 40).nonzero()
    assert green[:, 0].max() < 10  # above the middle row, 15
    assert green[:, 1].float().mean().item() == pytest.approx(20.0, abs=0.6)
    assert blue[:, 1].max() < 14  # to the left of the middle column, 20
    assert blue[:, 0].float().mean().item() == pytest.approx(15.0, abs=0.6)
    assert red.float().mean(dim=0).tolist() == pytest.approx([15.0, 20.0], abs=0.6)
    assert colours[0, 0].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("clip", "seen"),
    [([0.01, 20.0], {2.0, 3.9}), ([0.01, 3.0], {2.0}), ([2.5, 20.0], {3.9}), ([0.5, 1.5], set())],
)
def test_clip_planes_hide_near_and_far_geoms(boxes, clip, seen):
    depth = read_image(boxes({"camera": {**FRONT, "fov": 80.0, "clip": clip}}))[0]
    values = depth[depth > 0.0]
    found = {2.0: ((values - 2.0).abs() < 1e-2).any(), 3.9: ((values - 3.9).abs() < 1e-2).any()}
    assert {metres for metres, there in found.items() if there} == seen
    assert bool(((depth == 0.0) | ((depth >= clip[0] - 1e-3) & (depth <= clip[1]))).all())


@pytest.mark.parametrize("data", ["depth", "rgb"])
def test_pixel_is_mean_of_samples(boxes, data):
    soft = {**FRONT, "data": data, "width": 12, "height": 9, "samples": 3}
    fine = {**soft, "width": 36, "height": 27, "samples": 1}
    env = boxes({"soft": soft, "fine": fine})
    blocks = read_image(env, "fine").float().unflatten(2, (12, 3)).unflatten(1, (9, 3)).mean(dim=(2, 4))
    assert len(blocks.unique()) > 4  # some edges run through pixels
    torch.testing.assert_close(read_image(env, "soft").float(), blocks, rtol=1e-5, atol=0.51 if data == "rgb" else 1e-5)


def test_camera_looks_straight_down(boxes):
    down = {
        "kind": "camera",
        "data": "depth",
        "width": 9,
        "height": 9,
        "eye": [4, 2, 3],
        "lookat": [4, 2, 1],
        "fov": 20.0,
    }
    depth = read_image(boxes({"camera": down}))[0, :, :, 0]
    assert depth[4, 4].item() == pytest.approx(1.9, abs=1e-4)
    assert depth[0, 4].item() == 0.0


def test_mjcf_camera_moves_with_body(boxes):
    """Compare the camera of the cart with a camera that is placed at the same pose in the configuration."""
    own = {"kind": "camera", "data": "depth", "width": 40, "height": 40, "entity": "robot", "camera": "ahead"}
    held = {**own, "camera": None, "body": "cart", "eye": [0, 0, 0], "lookat": [1, 0, 0], "fov": 60.0}
    del held["camera"]
    env = boxes({"own": own, "held": held})
    pictures = read_image(env, "own").clone()
    torch.testing.assert_close(read_image(env, "held"), pictures, rtol=1e-5, atol=1e-5)
    assert pictures.amax(dim=(1, 2, 3)).min() > 0.0
    assert not torch.equal(pictures[0], pictures[1])  # the carts have different positions


# --- time of rendering ---


def test_each_environment_renders_own_state(boxes):
    env = boxes({"camera": CART}, num_envs=5)
    for _ in range(2):
        y = env.entities["robot"].data.joint_pos[:, 0]
        columns = (read_image(env)[..., 0] > 0.0).float().sum(dim=1)
        middle = (columns * torch.arange(64)).sum(dim=1) / columns.sum(dim=1)
        pixel = 24 / (2.0 * 2.9 * math.tan(math.radians(22.5)))  # pixels per metre at the depth of the sphere
        assert (middle - (31.5 - pixel * y)).abs().max() < 0.6
        step(env, 2)


def test_final_obs_has_last_image_of_episode_and_obs_has_first_of_next(boxes):
    observations = {"policy": {"image": {"func": "image", "sensor": "camera"}, "pos": {"func": "joint_pos"}}}
    env = boxes({"camera": CART}, observations=observations)
    env.reset(seed=4)
    step(env, 2)
    ending = step(env)
    assert bool(ending.truncated.all())
    last = ending.final_obs["policy"]
    (pos,) = env.engine.field("qpos").T
    torch.testing.assert_close(ending.obs["policy"][:, -1].double(), pos, rtol=1e-6, atol=1e-6)
    assert (last[:, -1] - ending.obs["policy"][:, -1]).abs().min() > 0.01
    for seen in (last.clone(), ending.obs["policy"].clone()):
        qpos = env.engine.field("qpos")
        qpos[:, 0] = seen[:, -1].double()
        env.sensors["camera"].update(0.02)
        torch.testing.assert_close(seen[:, :-1], read_image(env).flatten(1), rtol=0.0, atol=1e-5)


def test_reset_renders_only_reset_environments(boxes):
    env = boxes({"camera": CART})
    before = read_image(env).clone()
    env.engine.field("qpos")[:, 0] = torch.tensor([0.4, 0.4, 0.4]).double()
    begun = env._select(torch.tensor([False, True, False]))
    env.sensors["camera"].reset(begun)
    after = read_image(env)
    assert torch.equal(after[[0, 2]], before[[0, 2]])
    assert not torch.equal(after[1], before[1])
    env.sensors["camera"].update(0.02)
    assert torch.equal(read_image(env)[0], read_image(env)[1])


def test_image_is_independent_of_thread_count(boxes):
    sensors = {"camera": CART, "colours": {**FRONT, "data": "rgb", "samples": 2}}
    one, four = (boxes(sensors, f"sim.engine_threads={n}", num_envs=7) for n in (1, 4))
    assert (one.sensors["camera"]._renderers.count, four.sensors["camera"]._renderers.count) == (1, 4)
    for _ in range(4):
        for name in sensors:
            assert torch.equal(read_image(one, name), read_image(four, name))
        step(one), step(four)


def test_expanded_model_fields_are_visible_in_images(boxes):
    env = boxes({"camera": CART})
    sizes = env.engine.expand("geom_size")
    sizes[1, env.engine.model.geom("robot/cart").id] = 0.4
    env.sensors["camera"].update(0.02)
    seen = (read_image(env) > 0.0).sum(dim=(1, 2, 3))
    assert seen[1] > 3 * seen[0]
    assert abs(int(seen[0]) - int(seen[2])) < 0.5 * int(seen[0])


# --- errors ---


def test_gpu_engine_refuses_cameras(boxes):
    with pytest.raises(ConfigError, match="cameras need the CPU engine; the GPU engine cannot render them"):
        boxes({"camera": CART}, "sim.engine=warp")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"entity": "robot", "camera": "ahed"}, "no camera 'ahed' in the MJCF of 'robot'; did you mean 'ahead'"),
        ({"entity": "robot", "body": "wing"}, "wing"),
        ({"entity": "car"}, "no entity 'car' in the scene"),
        ({"camera": "ahead"}, "need the key entity: set it"),
        ({"entity": "robot", "camera": "ahead", "fov": 30.0}, "has its own position and field of view: remove fov"),
        ({"clip": [2.0, 1.0]}, "near, 2, is not below far, 1"),
        ({"eye": [1, 0, 1]}, "eye and lookat are the same point"),
        ({"data": "colour"}, "data"),
    ],
)
def test_invalid_camera_raises_config_error_with_key(boxes, change, expected):
    camera = {**FRONT, **change}
    if "camera" in change and "entity" in change:
        camera = {key: value for key, value in camera.items() if key not in ("eye", "lookat", "fov")} | change
    with pytest.raises(ConfigError) as refused:
        boxes({"camera": camera})
    (problem,) = refused.value.problems
    assert problem.path.startswith("scene.sensors.camera")
    assert expected in f"{problem.message}; {problem.hint} {problem.path}"


def test_close_ends_threads_and_rendering(boxes):
    before = threading.active_count()
    env = boxes({"camera": CART}, "sim.engine_threads=2")
    assert threading.active_count() == before + 2
    env.close()
    env.close()
    assert threading.active_count() == before
    env.sensors["camera"].update(0.02)
    with pytest.raises(MachineError, match="the environment is closed"):
        read_image(env)


def test_error_in_render_thread_is_raised_by_run(boxes):
    env = boxes({"camera": CART})
    renderers = env.sensors["camera"]._renderers

    def fail(renderer):
        raise ValueError("out of paint")

    with pytest.raises(ValueError, match="out of paint"):
        renderers.run([fail])
    env.sensors["camera"].update(0.02)
    assert read_image(env).max() > 0.0  # the threads still work


PROGRAM = """
import os, sys, torch
from support.worlds import build
from rlcli.errors import RlcliError
env = build(sys.argv[1], 2)
env.reset()
assert env.sensors["camera"].image.max() > 0
if sys.argv[2] == "fork":
    child = os.fork()
    if child == 0:
        env.sensors["camera"].update(0.1)
        try:
            env.sensors["camera"].image
        except RlcliError as error:
            print(type(error).__name__, error.message)
            sys.stdout.flush()
            os._exit(0)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
if sys.argv[2] == "raise":
    raise SystemExit(3)
"""


def program(tmp_path, way, **variables):
    folder = write(tmp_path / "task", edited(dump(TASK), scene={"sensors": {"camera": CART}}), boxes_xml=BOXES)
    tests = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    path = os.pathsep.join([tests, os.environ.get("PYTHONPATH", "")])
    env = {
        k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY", "PYOPENGL_PLATFORM")
    }
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", PROGRAM, str(folder), way]
    return subprocess.run(command, env={**env, "PYTHONPATH": path, **variables}, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(("way", "code"), [("end", 0), ("raise", 3)])
@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_process_with_open_cameras_exits_without_error(tmp_path, way, code, backend):
    done = program(tmp_path, way, MUJOCO_GL=backend)
    assert (done.returncode, done.stderr) == (code, "")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_rendering_in_forked_process_raises_machine_error(tmp_path):
    done = program(tmp_path, "fork")
    assert done.returncode == 0, done.stderr
    assert "MachineError cameras render only in the process that created the environment" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("command", ["check", "lint", "eval"])
def test_camera_without_opengl_exits_with_machine_error(tmp_path, command):
    folder = write(tmp_path / "task", edited(dump(TASK), scene={"sensors": {"camera": CART}}), boxes_xml=BOXES)
    arguments = [sys.executable, "-m", "rlcli", command, str(folder), *(["--policy", "zero"] * (command == "eval"))]
    done = subprocess.run(arguments, env={**os.environ, "MUJOCO_GL": "disabled"}, capture_output=True, text=True)
    assert done.returncode == 10
    assert "rendering is disabled by MUJOCO_GL=disabled" in done.stderr
    assert "Traceback" not in done.stderr
