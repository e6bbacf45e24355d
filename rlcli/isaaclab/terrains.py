"""The ground. Names as in `isaaclab.terrains`; the terrains of a generator keep their own settings' names."""

from __future__ import annotations

from typing import Any

from rlcli.isaaclab.configclass import MISSING, configclass
from rlcli.isaaclab.sim import RigidBodyMaterialCfg


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
