"""The ground. Names as in `isaaclab.terrains`; the terrains of a generator keep their own settings' names."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.sim import RigidBodyMaterialCfg


@configclass
class TerrainGeneratorCfg:
    """Rows of patches of rising difficulty."""

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
    """A plane, or what a generator makes."""

    class_type: Any = "TerrainImporter"
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


def _patch(name: str, function: str, **settings: Any) -> Any:
    """A kind of ground with its settings."""
    members = {"function": function, "proportion": 1.0, "size": None, "flat_patch_sampling": None, **settings}
    made = type(name, (), {"__doc__": f"{function}.", "__module__": __name__, "__annotations__": {}, **members})
    return configclass(made)


HfRandomUniformTerrainCfg = _patch(
    "HfRandomUniformTerrainCfg", "random_uniform_terrain", noise_range=MISSING, noise_step=MISSING,
    downsampled_scale=None, border_width=0.0,
)  # fmt: skip
HfPyramidSlopedTerrainCfg = _patch(
    "HfPyramidSlopedTerrainCfg", "pyramid_sloped_terrain", slope_range=MISSING, platform_width=1.0, inverted=False,
    border_width=0.0,
)  # fmt: skip
HfInvertedPyramidSlopedTerrainCfg = _patch(
    "HfInvertedPyramidSlopedTerrainCfg", "pyramid_sloped_terrain", slope_range=MISSING, platform_width=1.0,
    inverted=True, border_width=0.0,
)  # fmt: skip
HfWaveTerrainCfg = _patch("HfWaveTerrainCfg", "wave_terrain", amplitude_range=MISSING, num_waves=1, border_width=0.0)
HfDiscreteObstaclesTerrainCfg = _patch(
    "HfDiscreteObstaclesTerrainCfg", "discrete_obstacles_terrain", obstacle_height_mode="choice",
    obstacle_width_range=MISSING, obstacle_height_range=MISSING, num_obstacles=MISSING, platform_width=1.0,
)  # fmt: skip
HfSteppingStonesTerrainCfg = _patch(
    "HfSteppingStonesTerrainCfg", "stepping_stones_terrain", stone_height_max=MISSING, stone_width_range=MISSING,
    stone_distance_range=MISSING, holes_depth=-10.0, platform_width=1.0,
)  # fmt: skip
MeshPlaneTerrainCfg = _patch("MeshPlaneTerrainCfg", "flat_terrain")
MeshPyramidStairsTerrainCfg = _patch(
    "MeshPyramidStairsTerrainCfg", "pyramid_stairs_terrain", border_width=0.0, step_height_range=MISSING,
    step_width=MISSING, platform_width=1.0, holes=False,
)  # fmt: skip
MeshInvertedPyramidStairsTerrainCfg = _patch(
    "MeshInvertedPyramidStairsTerrainCfg", "inverted_pyramid_stairs_terrain", border_width=0.0,
    step_height_range=MISSING, step_width=MISSING, platform_width=1.0, holes=False,
)  # fmt: skip
MeshRandomGridTerrainCfg = _patch(
    "MeshRandomGridTerrainCfg", "random_grid_terrain", grid_width=MISSING, grid_height_range=MISSING,
    platform_width=1.0, holes=False,
)  # fmt: skip
