"""Tests of terrains: heights of the patches, start positions of environments, and changes of level."""

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import CRITTER_TASK, actions, build, critter, edited, results_of_env, run, same

from rlcli.config.schema import TerrainGeneratorConfig
from rlcli.errors import ConfigError
from rlcli.scene.height_lookup import HeightTable
from rlcli.scene.terrain import make_ground

torch.set_num_threads(1)

ENGINES = pytest.mark.parametrize("engine", ["batch", pytest.param("warp", marks=pytest.mark.slow)])
KINDS = ["flat", "noise", "slope", "waves", "obstacles", "stones", "stairs", "grid"]


def generator(**changes):
    return {"kind": "generator", "rows": 3, "columns": 2, "patch": [4.0, 6.0], "border": 2.0, "resolution": 0.1,
            "sub_terrains": {"hills": {"kind": "noise"}}, **changes}  # fmt: skip


def ground(**changes):
    changes = {key: tuple(value) if isinstance(value, list) else value for key, value in changes.items()}
    data = {**generator(), "patch": (4.0, 6.0), **changes}
    return make_ground(TerrainGeneratorConfig.model_validate(data), None)


def patch_heights(difficulty, **patch):
    """Return the heights of a single patch of 6 m x 6 m with cells of 0.1 m."""
    level = (difficulty, difficulty)
    return ground(rows=1, columns=1, patch=(6.0, 6.0), difficulty=level, sub_terrains={"it": patch}).heights


# --- patches ---


@pytest.mark.parametrize("inverted", [False, True])
def test_slope_rises_from_edges_to_platform(inverted):
    heights = patch_heights(0.5, kind="slope", slope=(0.0, 0.4), platform=2.0, inverted=inverted) * (
        -1 if inverted else 1
    )
    # slope 0.2, halfway between 0 and 0.4, over the 2 m to the platform
    assert heights[30, 30] == pytest.approx(0.4)
    assert heights[10, 30] == pytest.approx(0.2)
    assert heights[30, 50] == pytest.approx(0.2)
    assert np.allclose(heights[20:41, 20:41], 0.4)
    assert heights.max() == pytest.approx(0.4)
    assert heights.min() == 0.0


@pytest.mark.parametrize("inverted", [False, True])
def test_stairs_have_step_height_of_difficulty(inverted):
    patch = {"kind": "stairs", "step_height": (0.1, 0.2), "step_width": 0.5, "platform": 2.0, "inverted": inverted}
    heights = patch_heights(1.0, **patch) * (-1 if inverted else 1)
    # four rings of 0.5 m with heights 0, 0.2, 0.4 and 0.6, then the platform
    middles = [heights[30, int(10 * (0.25 + 0.5 * ring))] for ring in range(4)]
    assert middles == pytest.approx([0.0, 0.2, 0.4, 0.6])
    assert heights[30, 30] == pytest.approx(0.8)
    assert np.allclose(heights, heights.T)
    assert np.allclose(heights, heights[::-1])


def test_waves_have_configured_amplitude_and_count():
    heights = patch_heights(1.0, kind="waves", amplitude=(0.0, 0.3), count=3)
    x = np.arange(61) * 0.1
    expected = 0.15 * (np.sin(x)[:, None] * 0 + np.sin(2 * np.pi * 3 * x / 6)[:, None] + np.sin(2 * np.pi * 3 * x / 6))
    assert np.allclose(heights[1:-1, 1:-1], expected[1:-1, 1:-1])


def test_noise_is_bounded_and_linear_between_points():
    heights = patch_heights(0.5, kind="noise", height=(0.0, 0.2), spacing=0.5)
    assert 0.08 < heights.max() <= 0.1
    assert -0.08 > heights.min() >= -0.1
    inner = heights[5:11, 10]
    assert np.allclose(np.diff(inner, 2), 0.0)


def test_obstacles_have_height_of_difficulty_and_free_platform():
    heights = patch_heights(1.0, kind="obstacles", height=(0.0, 0.2), width=(0.3, 0.8), count=30, platform=2.0)
    assert np.all(heights[20:41, 20:41] == 0.0)
    assert set(np.unique(np.round(heights, 9))) == {-0.2, -0.1, 0.0, 0.1, 0.2}


def test_stones_have_height_0_and_gaps_grow_with_difficulty():
    easy = patch_heights(0.0, kind="stones", width=(0.4, 1.0), gap=(0.1, 0.5), depth=2.0, platform=1.5)
    hard = patch_heights(1.0, kind="stones", width=(0.4, 1.0), gap=(0.1, 0.5), depth=2.0, platform=1.5)
    for heights in (easy, hard):
        assert set(np.unique(heights)) <= {-2.0, 0.0}
        assert np.all(heights[23:38, 23:38] == 0.0)
    assert (hard < 0).mean() > (easy < 0).mean()


def test_grid_has_bounded_cells_of_configured_edge():
    heights = patch_heights(1.0, kind="grid", cell=1.0, height=(0.0, 0.3), platform=1.0)
    cells = heights[5::10, 5::10]
    assert cells.shape == (6, 6)
    assert len(np.unique(cells)) >= 30
    assert np.abs(heights).max() <= 0.3
    assert np.allclose(heights[2:9, 12:19], heights[5, 15])


@pytest.mark.parametrize("kind", KINDS)
def test_patch_with_border_is_the_smaller_patch_in_flat_ground(kind):
    level = (1.0, 1.0)
    size = {"rows": 1, "columns": 1, "difficulty": level, "sub_terrains": {"it": {"kind": kind, "border": 0.54}}}
    heights = ground(patch=(6.0, 6.0), **size).heights
    inner = ground(patch=(5.0, 5.0), **{**size, "sub_terrains": {"it": {"kind": kind}}}).heights
    assert np.array_equal(heights[5:-5, 5:-5], inner)
    heights[5:-5, 5:-5] = 0.0
    assert not heights.any()


@pytest.mark.parametrize("kind", KINDS)
def test_patch_has_zero_edges_and_grows_with_difficulty(kind):
    heights = ground(sub_terrains={"it": {"kind": kind}}, rows=4, difficulty=[0.1, 1.0]).heights
    assert not heights[::40].any()
    assert not heights[:, ::60].any()
    rough = [np.abs(np.diff(heights[40 * row : 40 * row + 41], axis=0)).mean() for row in range(4)]
    assert rough[0] < rough[3] or kind == "flat"


# --- whole terrain ---


def test_curriculum_assigns_columns_by_proportion_and_rows_by_difficulty():
    made = ground(columns=8, sub_terrains={
        "up": {"kind": "slope", "slope": (0.1, 0.4), "platform": 2.0, "proportion": 3.0},
        "none": {"kind": "flat", "proportion": 0.0},
        "down": {"kind": "slope", "slope": (0.1, 0.4), "platform": 2.0, "inverted": True},
    })  # fmt: skip
    top = made.origins[:, :, 2]
    # 1 m from the edge to the platform, slopes 0.1, 0.25 and 0.4
    expected = np.outer([0.1, 0.25, 0.4], [1, 1, 1, 1, 1, 1, -1, -1])
    assert np.allclose(top, expected, atol=1e-6)
    assert made.origins[:, 0, 0].tolist() == [-4.0, 0.0, 4.0]
    assert made.origins[0, :, 1].tolist() == [-21.0, -15.0, -9.0, -3.0, 3.0, 9.0, 15.0, 21.0]


def test_without_curriculum_kinds_and_difficulties_are_random():
    kinds = {"up": {"kind": "slope", "slope": (0.1, 0.4)}, "down": {"kind": "slope", "inverted": True}}
    tops = ground(rows=10, columns=10, curriculum=False, sub_terrains=kinds).origins[:, :, 2]
    assert 30 < (tops > 0).sum() < 70
    assert len(np.unique(tops)) > 80


def test_terrain_depends_only_on_seed():
    kinds = {kind: {"kind": kind} for kind in KINDS}
    first, again, other = (ground(columns=8, sub_terrains=kinds, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.heights, again.heights)
    assert np.array_equal(first.origins, again.origins)
    assert not np.array_equal(first.heights, other.heights)


def on_terrain(tmp_path, terrain, num_envs=6, *overrides, seed=42, folder="t", **changes):
    changes = {"terminations": {"tilt": None, "low": None}, **changes}
    task = edited(CRITTER_TASK, scene={"terrain": terrain, **changes.pop("scene", {})}, **changes)
    return build(critter(tmp_path / folder, task), num_envs, *overrides, seed=seed)


def height_at(model, x, y):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground_only = np.array([0, 1, 0, 0, 0, 0], dtype=np.uint8)
    geom = np.zeros(1, dtype=np.int32)
    for g in range(model.ngeom):
        model.geom_group[g] = int(model.body(model.geom_bodyid[g]).name == "terrain")
    down = mujoco.mj_ray(
        model, data, np.array([x, y, 50.0]), np.array([0.0, 0.0, -1.0]), ground_only, 1, -1, geom, None
    )
    return 50.0 - down


@pytest.mark.parametrize("kind", KINDS)
def test_model_has_heights_of_ground(tmp_path, kind):
    patch = {"it": {"kind": kind}}
    model = on_terrain(tmp_path, generator(sub_terrains=patch), 1).engine.model
    made = ground(sub_terrains=patch)
    draw = np.random.default_rng(0)
    for _ in range(20):
        i, j = int(draw.integers(1, 120)), int(draw.integers(1, 120))
        x, y = i * 0.1 - 6.0, j * 0.1 - 6.0
        assert height_at(model, x + 1e-6, y + 2e-6) == pytest.approx(made.heights[i, j], abs=1e-4)
    assert height_at(model, 7.5, 0.0) == pytest.approx(0.0, abs=1e-9)  # the border
    assert height_at(model, 0.0, -7.5) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("kind", ["stairs", "grid"])
@pytest.mark.parametrize("inverted", [False, True])
def test_boxes_equal_height_field_with_upright_faces(tmp_path, kind, inverted):
    if kind == "grid" and inverted:
        patch = {"it": {"kind": "grid", "cell": 1.0, "height": [0.1, 0.3]}}
    else:
        turned = {"inverted": inverted} if kind == "stairs" else {}
        patch = {"it": {"kind": kind, **({"step_width": 0.5} if kind == "stairs" else {"cell": 0.5}), **turned}}
    patch["it"]["border"] = 0.5
    boxes = {"it": {**patch["it"], "boxes": True}}
    model = on_terrain(tmp_path, generator(sub_terrains=boxes, rows=1, columns=1), 1).engine.model
    terrain = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == "terrain"]
    assert sum(model.geom_type[terrain] == int(mujoco.mjtGeom.mjGEOM_BOX)) > 8
    lists = {k: tuple(v) if isinstance(v, list) else v for k, v in patch["it"].items()}
    made = ground(sub_terrains={"it": lists}, rows=1, columns=1)
    for i in range(5, 36, 5):
        for j in range(5, 56, 5):
            x, y = i * 0.1 - 2.0 + 0.21, j * 0.1 - 3.0 + 0.21  # inside cells and steps
            expected = made.heights[round((x + 2.0) * 10), round((y + 3.0) * 10)]
            assert height_at(model, x, y) == pytest.approx(expected, abs=1e-6), (x, y)


# --- environments ---

HILLS = generator(rows=4, columns=3, sub_terrains={"hill": {"kind": "slope", "slope": [0.1, 0.4], "platform": 2.0}})


@ENGINES
def test_environments_start_on_their_patches(tmp_path, engine):
    still = {"push": None, "shove": None, "joints": None}
    quiet = {"func": "reset_root_state_uniform", "mode": "reset", "z": [0.0, 0.0]}
    env = on_terrain(tmp_path, HILLS, 6, f"sim.engine={engine}", events={**still, "root": quiet})
    env.reset()
    terrain, robot = env.terrain, env.entities["robot"].data
    assert terrain.types.tolist() == [0, 1, 2, 0, 1, 2]
    assert torch.equal(env.origins, terrain.origins[terrain.levels, terrain.types])
    torch.testing.assert_close(robot.root_pos_w - env.origins, robot.default_root_state[:, :3], atol=1e-5, rtol=0)
    for _ in range(30):
        env.step(torch.zeros(6, 4))
    height = (robot.root_pos_w - env.origins)[:, 2]
    assert ((height > 0.2) & (height < 0.4)).all(), height


def test_default_state_is_on_patch_without_events(tmp_path):
    none = dict.fromkeys(("root", "joints", "push", "shove"))
    ball = {"robot": {"model": "critter.xml", "joints": {".*": {"kp": 20.0, "kv": 0.5}}},
            "ball": {"shape": "sphere", "size": [0.1], "pos": [0.5, 0.0, 1.0], "free": True},
            "gate": {"shape": "box", "size": [0.1, 1.0, 1.0], "pos": [1.5, 0.0, 0.5], "mocap": True}}  # fmt: skip
    env = on_terrain(tmp_path, HILLS, 4, events=none, scene={"entities": ball})
    env.reset()
    for name, place in (("robot", [0.0, 0.0, 0.35]), ("ball", [0.5, 0.0, 1.0]), ("gate", [1.5, 0.0, 0.5])):
        found = env.entities[name].data.root_pos_w - env.origins
        torch.testing.assert_close(found, torch.tensor([place] * 4), atol=1e-5, rtol=0)


def test_reset_scene_to_default_places_entities_on_patch(tmp_path):
    events = {**dict.fromkeys(("root", "joints", "push", "shove")),
              "all": {"func": "reset_scene_to_default", "mode": "reset"}}  # fmt: skip
    env = on_terrain(tmp_path, HILLS, 4, events=events)
    env.reset()
    found = env.entities["robot"].data.root_pos_w - env.origins
    torch.testing.assert_close(found, torch.tensor([[0.0, 0.0, 0.35]] * 4), atol=1e-5, rtol=0)


@ENGINES
def test_move_changes_levels_of_selected_environments(tmp_path, engine):
    env = on_terrain(tmp_path, HILLS, 5, f"sim.engine={engine}")
    terrain = env.terrain
    terrain.levels.copy_(torch.tensor([0, 1, 3, 3, 2]))
    origins = env.origins.clone()
    chosen = env._select(torch.tensor([True, True, True, False, False]))
    up, down = torch.tensor([False, True, True, True, True]), torch.tensor([True, True, False, False, True])
    terrain.move(chosen, chosen.read(up), chosen.read(down))
    assert terrain.levels[[0, 1, 3, 4]].tolist() == [0, 2, 3, 2]  # if both are set, `up` applies
    assert 0 <= int(terrain.levels[2]) < 4
    moved = terrain.origins[terrain.levels, terrain.types]
    assert torch.equal(env.origins[:3], moved[:3])
    assert torch.equal(env.origins[3:], origins[3:])
    down_only = env._select(torch.ones(5, dtype=torch.bool))
    terrain.move(down_only, torch.zeros(5, dtype=torch.bool), torch.ones(5, dtype=torch.bool))
    assert terrain.levels[[0, 1, 3, 4]].tolist() == [0, 1, 2, 1]


def test_move_above_last_level_draws_random_level(tmp_path):
    env = on_terrain(tmp_path, HILLS, 200)
    env.terrain.levels.fill_(3)
    everyone, yes = env._select_all(), torch.ones(200, dtype=torch.bool)
    env.terrain.move(everyone, yes, ~yes)
    counts = torch.bincount(env.terrain.levels, minlength=4)
    assert (counts > 25).all()


def test_terrain_curriculum_uses_walked_distance(tmp_path):
    """End an episode in every step; half a patch is 2 m and the required distance is 0.5 m."""
    none = dict.fromkeys(("joints", "push", "shove"))
    terms = {"levels": {"func": "terrain_levels", "least": 0.5}}
    env = on_terrain(tmp_path, HILLS, 4, events={**none, "root": {"func": "reset_scene_to_default", "mode": "reset"}},
                     curriculum=terms, episode_length_s=0.02)  # fmt: skip
    env.reset()
    env.terrain.levels.copy_(torch.tensor([1, 1, 1, 2]))
    env.engine.field("qpos")[:, 0] = env.origins[:, 0].double() + torch.tensor([2.2, 1.0, 0.1, -1.5])
    env.engine.field("qpos")[:, 1] = env.origins[:, 1].double() + torch.tensor([0.0, 0.0, -0.1, -1.5])
    assert env.step(torch.zeros(4, 4)).truncated.all()
    assert env.terrain.levels.tolist() == [2, 1, 0, 3]
    found = env.entities["robot"].data.root_pos_w - env.origins
    torch.testing.assert_close(found, torch.tensor([[0.0, 0.0, 0.35]] * 4), atol=1e-5, rtol=0)
    assert env.extras()["Curriculum/levels"] == pytest.approx(1.5)


@ENGINES
def test_scatter_draws_random_level_in_same_column(tmp_path, engine):
    none = dict.fromkeys(("joints", "push", "shove"))
    events = {**none, "root": None, "level": {"func": "randomize_terrain_level", "mode": "reset"},
              "place": {"func": "reset_root_state_uniform", "mode": "reset"}}  # fmt: skip
    env = on_terrain(tmp_path, {**HILLS, "max_start_level": 0}, 60, f"sim.engine={engine}", events=events,
                     episode_length_s=0.02)  # fmt: skip
    env.reset()
    kinds, seen = env.terrain.types.clone(), [env.terrain.levels.clone()]
    for _ in range(2):
        assert env.step(torch.zeros(60, 4)).truncated.all()
        seen.append(env.terrain.levels.clone())
    assert all((torch.bincount(levels, minlength=4) > 3).all() for levels in seen)
    assert not torch.equal(seen[1], seen[2])
    assert torch.equal(env.terrain.types, kinds)
    assert torch.equal(env.origins, env.terrain.origins[env.terrain.levels, kinds])
    found = env.entities["robot"].data.root_pos_w - env.origins
    torch.testing.assert_close(found, torch.tensor([[0.0, 0.0, 0.35]] * 60), atol=1e-5, rtol=0)


def test_random_levels_without_terrain_are_refused(tmp_path):
    task = edited(CRITTER_TASK, events={"level": {"func": "randomize_terrain_level", "mode": "reset"}})
    with pytest.raises(ConfigError, match=r"events.level: the scene has no terrain"):
        build(critter(tmp_path, task), 1)


def test_terrain_curriculum_without_terrain_is_refused(tmp_path):
    task = edited(CRITTER_TASK, curriculum={"levels": {"func": "terrain_levels"}})
    with pytest.raises(ConfigError, match=r"curriculum.levels: the scene has no terrain"):
        build(critter(tmp_path, task), 1)


def test_start_levels_depend_on_seed_and_are_bounded(tmp_path):
    env = on_terrain(tmp_path, {**HILLS, "max_start_level": 1}, 100)
    first = env.terrain.levels.clone()
    assert set(first.tolist()) == {0, 1}
    env.terrain.levels.fill_(3)
    env.reset(seed=42)
    assert torch.equal(env.terrain.levels, first)
    env.reset(seed=43)
    assert not torch.equal(env.terrain.levels, first)
    assert torch.equal(env.origins, env.terrain.origins[env.terrain.levels, env.terrain.types])


def test_trajectory_on_terrain_is_independent_of_num_envs(tmp_path):
    hills = generator(sub_terrains={"a": {"kind": "noise"}, "b": {"kind": "stairs"}})
    many, few = (run(on_terrain(tmp_path, hills, n, folder=name), 30) for name, n in (("a", 19), ("b", 3)))
    assert all(same(results_of_env(many, env), results_of_env(few, env)) for env in range(3))


def test_state_dict_restores_levels_and_origins(tmp_path):
    env = on_terrain(tmp_path, HILLS, 4)
    env.reset()
    everyone, yes = env._select_all(), torch.ones(4, dtype=torch.bool)
    env.terrain.move(everyone, yes, ~yes)
    env.reset()
    state = env.state_dict()
    draws = actions(30, 4, 4)
    expected = [env.step(a).obs["policy"].clone() for a in draws]
    other = on_terrain(tmp_path, HILLS, 4, seed=5, folder="other")
    other.reset()
    other.load_state_dict(state)
    assert torch.equal(other.terrain.levels, env.terrain.levels)
    assert torch.equal(other.origins, env.origins)
    assert all(torch.equal(a, other.step(b).obs["policy"]) for a, b in zip(expected, draws, strict=True))


def test_sensors_treat_terrain_as_ground(tmp_path):
    grid = {"size": [0.4, 0.4], "resolution": 0.2}
    sensors = {"torso": {"kind": "contact", "bodies": "leg_.*", "against": "ground"},
               "scan": {"kind": "rays", "pattern": grid, "alignment": "yaw"}}  # fmt: skip
    env = on_terrain(tmp_path, HILLS, 4, scene={"sensors": sensors})
    env.reset()
    scan = env.sensors["scan"]
    torch.testing.assert_close(
        scan.hits[..., 2], env.origins[:, 2:].expand(4, 9), atol=1e-4, rtol=0
    )  # all on the platform
    assert not scan.missed.any()
    for _ in range(20):
        env.step(torch.zeros(4, 4))
    weight = env.sensors["torso"].force[..., 2].sum(dim=1)
    assert ((weight > 10.0) & (weight < 150.0)).all(), weight


@ENGINES
def test_height_lookup_equals_ray_casts(tmp_path, engine):
    grid = {"size": [1.6, 1.0], "resolution": 0.1}
    scan = {"kind": "rays", "pattern": grid, "alignment": "yaw", "offset": [0.1, 0.0, 5.0], "max_distance": 9.0}
    grounds = {"rubble": {"kind": "noise", "height": [0.1, 0.3], "spacing": 0.1}, "hill": {"kind": "slope"}}
    uneven = generator(
        rows=3, columns=4, sub_terrains={**grounds, "stairs": {"kind": "stairs"}, "w": {"kind": "waves"}}
    )
    env = on_terrain(tmp_path, uneven, 12, f"sim.engine={engine}",
                     scene={"sensors": {"cast": scan, "table": {**scan, "lookup": True}}})  # fmt: skip
    env.reset()
    draw = torch.Generator().manual_seed(1)
    # four on their patches, four at the edge of the height field, four at the edge of the border, and one beyond
    place = env.origins + torch.rand(12, 3, generator=draw) * torch.tensor([2.0, 2.0, 0.5])
    place[4:8, 0], place[8:, 0] = 5.9, 8.0
    turns = torch.nn.functional.normalize(torch.randn(12, 4, generator=draw), dim=1)
    env.entities["robot"].write_root_pose(env._select_all(), place, turns)
    env.sim.on_moved(env._select_all())
    env.sim.forward_moved()
    cast, table = (env.sensors[name] for name in ("cast", "table"))
    for sensor in (cast, table):
        sensor.update(0.02)
    assert torch.equal(cast.missed, table.missed)
    assert 0 < int(table.missed.sum()) < table.missed.numel() / 3
    torch.testing.assert_close(cast.distance, table.distance, atol=2e-4, rtol=0)
    torch.testing.assert_close(cast.hits, table.hits, atol=2e-4, rtol=0)
    assert table.distance[:4].std() > 0.02
    one = env._select(torch.arange(12) == 3)
    env.entities["robot"].write_root_pose(one, env.origins[3:4] + 0.2, torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    before = table.distance.clone()
    env.sim.on_moved(one)
    table.on_moved(one)
    assert ((table.distance != before).any(dim=1) == (torch.arange(12) == 3)).all()


def test_height_lookup_tells_height_above_ground_and_where_ground_is():
    table = HeightTable(ground(sub_terrains={"flat": {"kind": "flat"}}), torch.device("cpu"))
    points = torch.tensor([[0.3, 0.2, 1.5], [0.3, 0.2, -0.1], [7.9, 0.0, 2.0], [8.1, 0.0, 2.0]])
    height, on_ground = table.depth(*points.unbind(1))
    torch.testing.assert_close(height, points[:, 2])
    assert on_ground.tolist() == [True, True, True, False]


def test_height_lookup_is_refused_for_boxes(tmp_path):
    down = {"kind": "rays", "pattern": [[0.0, 0.0, -1.0]], "alignment": "world", "lookup": True}
    stairs = generator(sub_terrains={"it": {"kind": "stairs", "boxes": True}})
    with pytest.raises(
        ConfigError, match=r"scene.sensors.scan.lookup: heights cannot be looked up: the terrain has boxes"
    ):
        on_terrain(tmp_path, stairs, 1, scene={"sensors": {"scan": down}})


def test_terrain_reads_height_field_from_file(tmp_path):
    x, y = np.meshgrid(np.arange(41) * 0.25 - 5.0, np.arange(21) * 0.25 - 2.5, indexing="ij")
    (tmp_path / "t" / "critter").mkdir(parents=True)
    np.save(tmp_path / "t" / "critter" / "hill.npy", 0.5 + 0.1 * x - 0.05 * y)
    env = on_terrain(tmp_path, {"kind": "heights", "file": "hill.npy", "resolution": 0.25}, 2)
    assert height_at(env.engine.model, 2.0, 1.0) == pytest.approx(0.65, abs=1e-5)
    assert height_at(env.engine.model, -4.0, -2.0) == pytest.approx(0.2, abs=1e-5)
    assert env.origins.tolist() == [pytest.approx([0.0, 0.0, 0.5])] * 2


def test_origins_without_terrain_are_0(tmp_path):
    env = build(critter(tmp_path), 3)
    assert env.terrain is None
    assert env.origins.tolist() == [[0.0] * 3] * 3


# --- errors ---


@pytest.mark.parametrize(
    ("change", "message", "hint"),
    [
        ({"kind": "hills"}, "terrain.kind: expected 'generator' or 'heights', found 'hills'", None),
        ({"sub_terrains": {}}, "terrain.sub_terrains: expected at least 1 item", None),
        (
            {"sub_terrains": {"a": {"kind": "noise", "proportion": 0.0}}},
            "sub_terrains: the `proportion` of every sub-terrain is 0",
            "above 0",
        ),
        ({"sub_terrains": {"a": {"kind": "noise", "proportion": -1.0}}}, "a.proportion: expected a number >= 0", None),
        ({"sub_terrains": {"a": {"kind": "stair"}}}, "sub_terrains.a.kind: expected 'flat'", "did you mean 'stairs'"),
        ({"sub_terrains": {"a": {"height": [0, 1]}}}, "sub_terrains.a: missing key 'kind'", "stairs"),
        ({"sub_terrains": {"a": {"kind": "noise", "hight": [0, 1]}}}, "unknown key 'hight'", "did you mean 'height'"),
        ({"sub_terrains": {"a": {"kind": "slope", "platform": 4.0}}}, "a.platform: a platform of 4 m does", None),
        (
            {"sub_terrains": {"a": {"kind": "stairs", "step_width": 0.1}}},
            "a.step_width: a step of 0.1 m needs",
            "boxes: true",
        ),
        (
            {"sub_terrains": {"a": {"kind": "noise", "border": 1.95}}},
            "a.border: a border of 1.95 m leaves less than two cells",
            "at most 1.9",
        ),
        ({"sub_terrains": {"a": {"kind": "grid", "cell": 0.1}}}, "a.cell: a cell of 0.1 m needs", "boxes: true"),
        (
            {"sub_terrains": {"a": {"kind": "stones", "width": [0.5, 5.0]}}},
            "a.width: a width of 5 m does not fit",
            None,
        ),
        (
            {"sub_terrains": {"a": {"kind": "obstacles", "width": [0.05, 1]}}},
            "a.width: a width of 0.05 m is less",
            "smaller",
        ),
        ({"patch": [4.05, 6.0]}, "terrain.patch: a patch of 4.05 x 6 m is not a whole number of cells", "resolution"),
        ({"resolution": 0.001}, "terrain.resolution: the height field has", "larger resolution"),
        ({"max_start_level": 3}, "terrain.max_start_level: level 3 does not exist", "levels: 0 to 2"),
        ({"difficulty": [0.0, 1.5]}, "terrain.difficulty.1: expected a number <= 1", None),
        ({"difficulty": [0.5, 0.1]}, "terrain.difficulty: the lower end 0.5 is above", None),
        ({"rows": 0}, "terrain.rows: expected a whole number >= 1", None),
    ],
)  # fmt: skip
def test_invalid_terrain_raises_config_error_with_key(tmp_path, change, message, hint):
    with pytest.raises(ConfigError) as error:
        on_terrain(tmp_path, generator(**change), 1)
    assert message in str(error.value)
    assert hint is None or hint in str(error.value)


@pytest.mark.parametrize(
    ("content", "file", "message"),
    [
        (None, "hill.npy", "terrain.file: no file 'hill.npy'"),
        (b"no numbers", "hill.npy", "terrain.file: 'hill.npy' is not a NumPy file"),
        (b"PK\3\4 and no zip", "hill.npy", "terrain.file: 'hill.npy' is not a NumPy file"),
        (b"\x93NUMPY\1\0\x08\0{'descr\n", "hill.npy", "the header of the file is malformed"),
        (
            b"\x93NUMPY\1\0\x4f\0"
            + b"{'descr':'<f8','fortran_order':False,'shape':(1000000000000,1000)}".ljust(78)
            + b"\n",
            "hill.npy",
            "the header of the file is malformed",
        ),
        (np.zeros(5), "hill.npy", "must contain a table of heights, at least 2 by 2; found shape (5,)"),
        (np.full((3, 3), np.nan), "hill.npy", "must contain finite numbers"),
        (np.array([[None, 1], [2, 3]], dtype=object), "hill.npy", "is not a NumPy file"),
        (None, "../hill.npy", "lies outside the task's folder"),
    ],
)
def test_unreadable_height_file_is_refused(tmp_path, content, file, message):
    folder = tmp_path / "t" / "critter"
    folder.mkdir(parents=True)
    if isinstance(content, bytes):
        (folder / "hill.npy").write_bytes(content)
    elif content is not None:
        np.save(folder / "hill.npy", content, allow_pickle=True)
    with pytest.raises(ConfigError) as error:
        on_terrain(tmp_path, {"kind": "heights", "file": file, "resolution": 0.25}, 1)
    assert message in str(error.value)
