"""Uneven ground: a generator of patches, or a height field from a file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from rlcli.config.schema.base import Count, NotNegative, Positive, Range, ShareRange, StrictModel


class PatchConfig(StrictModel):
    """What all sub-terrains have in common. Pairs of values are those of difficulty 0 and of difficulty 1."""

    proportion: NotNegative = 1.0
    """Share of the columns (without curriculum: of the patches), relative to the other sub-terrains."""


class FlatPatchConfig(PatchConfig):
    """Flat ground."""

    kind: Literal["flat"]
    """flat."""


class NoisePatchConfig(PatchConfig):
    """Uneven ground: uniform random heights."""

    kind: Literal["noise"]
    """noise."""
    height: Range = (0.02, 0.1)
    """Heights lie within +-this [m]."""
    spacing: Positive = 0.2
    """Distance between two random heights; between them the ground is straight [m]."""


class SlopePatchConfig(PatchConfig):
    """A pyramid of four slopes."""

    kind: Literal["slope"]
    """slope."""
    slope: Range = (0.0, 0.4)
    """Rise over run."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""
    inverted: bool = False
    """Down to the middle instead of up."""


class WavesPatchConfig(PatchConfig):
    """Sine waves along x and y."""

    kind: Literal["waves"]
    """waves."""
    amplitude: Range = (0.05, 0.2)
    """Half the height from trough to crest [m]."""
    count: Count = 2
    """Waves along an edge."""


class ObstaclesPatchConfig(PatchConfig):
    """Low blocks and pits in random places."""

    kind: Literal["obstacles"]
    """obstacles."""
    height: Range = (0.05, 0.2)
    """Height of blocks, depth of pits [m]."""
    width: Range = (0.25, 1.0)
    """[narrowest, widest] edge of an obstacle [m]."""
    count: Count = 40
    """Obstacles in a patch."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""


class StonesPatchConfig(PatchConfig):
    """Stepping stones over a pit."""

    kind: Literal["stones"]
    """stones."""
    width: Range = (0.25, 1.0)
    """[narrowest, widest] edge of a stone [m]; at difficulty 0 stones are wide."""
    gap: Range = (0.05, 0.3)
    """Distance between stones [m]."""
    depth: Positive = 1.0
    """Depth of the pit [m]."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""


class StairsPatchConfig(PatchConfig):
    """Stairs on four sides."""

    kind: Literal["stairs"]
    """stairs."""
    step_height: Range = (0.05, 0.2)
    """Height of a step [m]."""
    step_width: Positive = 0.3
    """Depth of a step [m]."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""
    inverted: bool = False
    """Down to the middle instead of up."""
    boxes: bool = False
    """Boxes with upright faces; false: part of the height field, whose faces lean by one cell. Boxes cost time."""


class GridPatchConfig(PatchConfig):
    """A grid of cells of random heights."""

    kind: Literal["grid"]
    """grid."""
    cell: Positive = 0.5
    """Edge of a cell [m]."""
    height: Range = (0.02, 0.15)
    """Heights lie within +-this [m]."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""
    boxes: bool = False
    """Boxes with upright faces; false: part of the height field, whose faces lean by one cell. Boxes cost time."""


SubTerrainConfig = Annotated[
    FlatPatchConfig
    | NoisePatchConfig
    | SlopePatchConfig
    | WavesPatchConfig
    | ObstaclesPatchConfig
    | StonesPatchConfig
    | StairsPatchConfig
    | GridPatchConfig,
    Field(discriminator="kind"),
]


class TerrainGeneratorConfig(StrictModel):
    """Patches in rows of rising difficulty, a kind of ground in each column; environments start in their middles."""

    kind: Literal["generator"]
    """generator."""
    rows: Count = 10
    """Levels of difficulty, along x."""
    columns: Count = 10
    """Patches of a level, along y; environment i has column i modulo this."""
    patch: tuple[Positive, Positive] = (8.0, 8.0)
    """Extent of a patch along x and y [m]."""
    border: NotNegative = 10.0
    """Flat ground about the patches [m]."""
    resolution: Positive = 0.1
    """Distance between two heights of the height field [m]."""
    sub_terrains: Annotated[dict[str, SubTerrainConfig], Field(min_length=1)]
    """Name -> a kind of ground."""
    difficulty: ShareRange = (0.0, 1.0)
    """Difficulty of the first and of the last row, in [0, 1]."""
    curriculum: bool = True
    """A kind of ground for each column, difficulty by row; false: both are drawn for each patch."""
    max_start_level: Annotated[int, Field(ge=0)] | None = None
    """Environments begin at random levels up to this one; null: the last."""
    seed: int = 0
    """Of the terrain's random heights."""
    friction: NotNegative = 1.0
    """Sliding friction."""

    @field_validator("sub_terrains")
    @classmethod
    def _some_ground(cls, value: dict[str, SubTerrainConfig]) -> dict[str, SubTerrainConfig]:
        if sum(patch.proportion for patch in value.values()) <= 0.0:
            raise ValueError("the proportions of the sub-terrains sum to 0; one must be above 0")
        return value


class TerrainHeightsConfig(StrictModel):
    """Ground of one's own: a height field from a file. All environments start in its middle."""

    kind: Literal["heights"]
    """heights."""
    file: str
    """A NumPy file (.npy) in the task's folder: heights [m], one row along y for each x."""
    resolution: Positive
    """Distance between two heights [m]."""
    friction: NotNegative = 1.0
    """Sliding friction."""


TerrainConfig = Annotated[TerrainGeneratorConfig | TerrainHeightsConfig, Field(discriminator="kind")]
