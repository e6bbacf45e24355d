"""Several environments in one picture, on the grid."""

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import CRITTER_TASK, build, critter, edited

from rlcli.config.load import resolve
from rlcli.envs.build import grid
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.viewer.env_grid import EnvGrid
from rlcli.viewer.offscreen import Renderer, free_camera


@pytest.fixture(scope="module")
def env():
    made = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=6", "scene.env_spacing=4"]))
    made.reset(seed=1)
    return made


def scene_of(env, count, shown=0):
    model, data = env.world(shown)
    scene = mujoco.MjvScene(model, maxgeom=1000)
    everything = int(mujoco.mjtCatBit.mjCAT_ALL)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, free_camera(env.config.viewer), everything, scene)
    alone = scene.ngeom
    EnvGrid(env, count).add(scene, shown, mujoco.MjvOption())
    return scene, alone


def test_environments_are_drawn_on_grid(env):
    scene, alone = scene_of(env, 4)
    ground = sum(geom.type == mujoco.mjtGeom.mjGEOM_PLANE for geom in scene.geoms[:alone])
    each = alone - ground
    assert ground == 1
    assert scene.ngeom == alone + 3 * each
    places = grid(4, 4.0).double().numpy()
    own = {int(geom.objid): geom for geom in scene.geoms[:alone]}
    seen = np.zeros(4, int)
    for geom in scene.geoms[alone : scene.ngeom]:
        assert geom.type != mujoco.mjtGeom.mjGEOM_PLANE
        moved = np.array([geom.pos - env.world(number)[1].geom_xpos[geom.objid] for number in range(4)])
        (number,) = [k for k in range(1, 4) if np.allclose(moved[k], places[k] - places[0], atol=1e-5)]
        seen[number] += 1
        assert geom.rgba == pytest.approx(own[int(geom.objid)].rgba)
        assert geom.size == pytest.approx(own[int(geom.objid)].size)
    assert seen.tolist() == [0, each, each, each]


def test_shown_environment_is_first_and_others_wrap_around(env):
    assert EnvGrid(env, 3).others(5) == [0, 1]
    assert EnvGrid(env, 1).others(2) == []
    assert scene_of(env, 1)[0].ngeom == scene_of(env, 1)[1]


def test_geoms_are_copies(env):
    env_grid, scene = EnvGrid(env, 3), mujoco.MjvScene(env.engine.model, maxgeom=1000)
    first = list(env_grid.geoms(scene, 0, mujoco.MjvOption()))
    kept = [geom.pos.copy() for geom in first]
    env.step(torch.ones(6, env.layout.action_size))
    list(env_grid.geoms(scene, 0, mujoco.MjvOption()))
    assert [geom.pos.tolist() for geom in first] == [pos.tolist() for pos in kept]
    assert len(first) > 0
    assert list(EnvGrid(env, 1).geoms(scene, 0, mujoco.MjvOption())) == []


def test_geoms_are_limited_by_scene_size(env, monkeypatch):
    scene = mujoco.MjvScene(env.engine.model, maxgeom=4)
    assert len(list(EnvGrid(env, 6).geoms(scene, 0, mujoco.MjvOption()))) <= 4


def test_camera_distance_shows_all_environments(env):
    one, four = (EnvGrid(env, count).fit_camera(free_camera(env.config.viewer)) for count in (1, 4))
    assert four.distance > one.distance + 4.0
    assert four.lookat - one.lookat == pytest.approx(EnvGrid(env, 4).offsets().mean(axis=0))
    assert (one.azimuth, one.elevation) == (four.azimuth, four.elevation)


def test_terrain_uses_true_positions_and_one_ground(tmp_path):
    terrain = {
        "kind": "generator",
        "rows": 2,
        "columns": 3,
        "patch": [4.0, 4.0],
        "sub_terrains": {"it": {"kind": "flat"}},
    }
    env = build(critter(tmp_path / "t", edited(CRITTER_TASK, scene={"num_envs": 3, "terrain": terrain})))
    env.reset(seed=1)
    apart = env.origins[1:] - env.origins[0]
    assert float(apart.norm(dim=1).min()) > 3.0
    scene, alone = scene_of(env, 3)
    of_robot = [g for g in range(env.engine.model.ngeom) if "robot" in env.engine.model.geom(g).name]
    added = [geom for geom in scene.geoms[alone : scene.ngeom] if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM]
    assert [int(geom.objid) for geom in added] == 2 * of_robot
    for place, geom in enumerate(added):
        world = env.world(1 + place // len(of_robot))[1]
        np.testing.assert_allclose(geom.pos, world.geom_xpos[geom.objid], atol=1e-5)
    camera = EnvGrid(env, 3).fit_camera(free_camera(env.config.viewer))
    middle = env.origins - env.origins[0]
    middle = (middle.amin(dim=0) + middle.amax(dim=0)) / 2
    assert camera.lookat - free_camera(env.config.viewer).lookat == pytest.approx(middle.double().numpy(), abs=1e-5)


@pytest.mark.slow
def test_rendered_picture_shows_four_poles(env, monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    pictures = {}
    for count in (1, 4):
        with Renderer(env.engine.model, env.config.viewer, EnvGrid(env, count)) as renderer:
            pictures[count] = renderer.image(env).astype(int)
    blue = {count: (seen[..., 2] - seen[..., 0] > 60) & (seen[..., 1] < 120) for count, seen in pictures.items()}
    columns = {count: np.flatnonzero(found[120:].any(axis=0)) for count, found in blue.items()}
    groups = {count: 1 + int((np.diff(found) > 20).sum()) for count, found in columns.items()}
    assert groups[1] == 1
    assert groups[4] >= 2
