"""Configuration classes of the terrain.

A task of Isaac Lab that imports a name from `isaaclab.terrains` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass, make_config_class
from rlcli_isaaclab.sensor_facade import TerrainImporter
from rlcli_isaaclab.sim import RigidBodyMaterialCfg


@configclass
class TerrainGeneratorCfg:
    """Settings of a terrain that is a grid of sub-terrains; the difficulty rises from row to row."""

    class_type: Any = "TerrainGenerator"
    seed: Any = None
    curriculum: bool = False
    size: Any = MISSING
    border_width: float = 0.0
    border_height: float = 1.0
    num_rows: int = 1
    num_cols: int = 1
    color_scheme: str = "none"
    horizontal_scale: float = 0.1
    vertical_scale: float = 0.005
    slope_threshold: Any = 0.75
    sub_terrains: Any = MISSING
    difficulty_range: Any = (0.0, 1.0)
    use_cache: bool = False
    cache_dir: str = ""


@configclass
class TerrainImporterCfg:
    """Settings of the ground: a plane, or the terrain of a generator."""

    class_type: Any = TerrainImporter
    collision_group: int = -1
    prim_path: str = MISSING
    num_envs: Any = 1
    terrain_type: str = "generator"
    terrain_generator: Any = None
    usd_path: Any = None
    env_spacing: Any = None
    use_terrain_origins: bool = True
    visual_material: Any = None
    physics_material: Any = RigidBodyMaterialCfg()
    max_init_terrain_level: Any = None
    debug_vis: bool = False


def _sub_terrain(name: str, function: str, **settings: Any) -> Any:
    """Create the configuration class `name` of a sub-terrain.

    `function` is the name of Isaac Lab's terrain function; `settings` are Isaac Lab's names and defaults.
    """
    common: dict[str, Any] = {"function": function, "proportion": 1.0, "size": None, "flat_patch_sampling": None}
    if name.startswith("Hf"):
        common |= {"border_width": 0.0, "horizontal_scale": 0.1, "vertical_scale": 0.005, "slope_threshold": None}
    return make_config_class(name, f"Sub-terrain `{function}`.", **common, **settings)


HfRandomUniformTerrainCfg = _sub_terrain(
    "HfRandomUniformTerrainCfg", "random_uniform_terrain", noise_range=MISSING, noise_step=MISSING,
    downsampled_scale=None,
)  # fmt: skip
HfPyramidSlopedTerrainCfg = _sub_terrain(
    "HfPyramidSlopedTerrainCfg", "pyramid_sloped_terrain", slope_range=MISSING, platform_width=1.0, inverted=False,
)  # fmt: skip
HfInvertedPyramidSlopedTerrainCfg = _sub_terrain(
    "HfInvertedPyramidSlopedTerrainCfg", "pyramid_sloped_terrain", slope_range=MISSING, platform_width=1.0,
    inverted=True,
)  # fmt: skip
HfWaveTerrainCfg = _sub_terrain("HfWaveTerrainCfg", "wave_terrain", amplitude_range=MISSING, num_waves=1)
HfDiscreteObstaclesTerrainCfg = _sub_terrain(
    "HfDiscreteObstaclesTerrainCfg", "discrete_obstacles_terrain", obstacle_height_mode="choice",
    obstacle_width_range=MISSING, obstacle_height_range=MISSING, num_obstacles=MISSING, platform_width=1.0,
)  # fmt: skip
HfSteppingStonesTerrainCfg = _sub_terrain(
    "HfSteppingStonesTerrainCfg", "stepping_stones_terrain", stone_height_max=MISSING, stone_width_range=MISSING,
    stone_distance_range=MISSING, holes_depth=-10.0, platform_width=1.0,
)  # fmt: skip
MeshPlaneTerrainCfg = _sub_terrain("MeshPlaneTerrainCfg", "flat_terrain")
MeshPyramidStairsTerrainCfg = _sub_terrain(
    "MeshPyramidStairsTerrainCfg", "pyramid_stairs_terrain", border_width=0.0, step_height_range=MISSING,
    step_width=MISSING, platform_width=1.0, holes=False,
)  # fmt: skip
MeshInvertedPyramidStairsTerrainCfg = _sub_terrain(
    "MeshInvertedPyramidStairsTerrainCfg", "inverted_pyramid_stairs_terrain", border_width=0.0,
    step_height_range=MISSING, step_width=MISSING, platform_width=1.0, holes=False,
)  # fmt: skip
MeshRandomGridTerrainCfg = _sub_terrain(
    "MeshRandomGridTerrainCfg", "random_grid_terrain", grid_width=MISSING, grid_height_range=MISSING,
    platform_width=1.0, holes=False,
)  # fmt: skip

MeshRepeatedBoxesTerrainCfg = _sub_terrain(
    "MeshRepeatedBoxesTerrainCfg", "repeated_boxes_terrain", object_params_start=MISSING, object_params_end=MISSING,
    platform_width=1.0, object_type=None, max_height_noise=None, abs_height_noise=(0.0, 0.0),
    rel_height_noise=(1.0, 1.0), platform_height=-1.0,
)  # fmt: skip
MeshRepeatedBoxesTerrainCfg.ObjectCfg = make_config_class(
    "ObjectCfg", "Size and number of the boxes.", num_objects=MISSING, height=MISSING, size=MISSING, max_yx_angle=0.0,
    degrees=True,
)  # fmt: skip


def height_field_to_mesh(function: Any) -> Any:
    """Return `function`, a terrain function that the task defines, unchanged.

    Isaac Lab decorates such functions. rlcli does not call them: flat ground replaces the sub-terrain.
    """
    return function


ROUGH_TERRAINS_CFG = TerrainGeneratorCfg(
    size=(8.0, 8.0),
    border_width=20.0,
    num_rows=10,
    num_cols=20,
    sub_terrains={
        "pyramid_stairs": MeshPyramidStairsTerrainCfg(
            proportion=0.2, step_height_range=(0.05, 0.23), step_width=0.3, platform_width=3.0, border_width=1.0
        ),
        "pyramid_stairs_inv": MeshInvertedPyramidStairsTerrainCfg(
            proportion=0.2, step_height_range=(0.05, 0.23), step_width=0.3, platform_width=3.0, border_width=1.0
        ),
        "boxes": MeshRandomGridTerrainCfg(
            proportion=0.2, grid_width=0.45, grid_height_range=(0.05, 0.2), platform_width=2.0
        ),
        "random_rough": HfRandomUniformTerrainCfg(
            proportion=0.2, noise_range=(0.02, 0.10), noise_step=0.02, border_width=0.25
        ),
        "hf_pyramid_slope": HfPyramidSlopedTerrainCfg(
            proportion=0.1, slope_range=(0.0, 0.4), platform_width=2.0, border_width=0.25
        ),
        "hf_pyramid_slope_inv": HfInvertedPyramidSlopedTerrainCfg(
            proportion=0.1, slope_range=(0.0, 0.4), platform_width=2.0, border_width=0.25
        ),
    },
)
"""Terrain generator with stairs, boxes, rough ground and slopes; named as in `isaaclab.terrains.config.rough`."""
