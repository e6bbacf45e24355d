"""Schema of uneven ground: a grid of generated patches (square pieces of ground), or a height field from a file.

A patch has one kind of ground, such as stairs, and a difficulty from 0 to 1.
"""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from rlcli.config.schema.base import Count, NotNegative, Positive, Range, ShareRange, StrictModel


class PatchConfig(StrictModel):
    """Keys that all kinds of generated ground share."""

    proportion: NotNegative = 1.0
    """Share of the grid's columns (with `curriculum: false` of its patches) that have this kind of ground, relative to
    the other sub-terrains."""
    border: NotNegative = 0.0
    """Width of the flat edge of the patch [m], rounded to whole cells of the height field."""


class FlatPatchConfig(PatchConfig):
    """Flat ground."""

    kind: Literal["flat"]
    """Kind of ground: always flat."""


class NoisePatchConfig(PatchConfig):
    """Uneven ground with uniform random heights."""

    kind: Literal["noise"]
    """Kind of ground: always noise."""
    height: Range = (0.02, 0.1)
    """Largest random height above and below the mean [m]: [at difficulty 0, at difficulty 1]."""
    spacing: Positive = 0.2
    """Distance between two random heights [m]; heights between them are interpolated linearly."""


class SlopePatchConfig(PatchConfig):
    """A pyramid of four slopes."""

    kind: Literal["slope"]
    """Kind of ground: always slope."""
    slope: Range = (0.0, 0.4)
    """Rise divided by run, [at difficulty 0, at difficulty 1]."""
    platform: NotNegative = 2.0
    """Edge length of the flat square in the middle [m]."""
    inverted: bool = False
    """true: the slopes go down to the middle; false: up."""


class WavesPatchConfig(PatchConfig):
    """Sine waves along x and y."""

    kind: Literal["waves"]
    """Kind of ground: always waves."""
    amplitude: Range = (0.05, 0.2)
    """Half of the height between trough and crest [m], [at difficulty 0, at difficulty 1]."""
    count: Count = 2
    """Number of waves along an edge."""


class ObstaclesPatchConfig(PatchConfig):
    """Low blocks and pits at random positions."""

    kind: Literal["obstacles"]
    """Kind of ground: always obstacles."""
    height: Range = (0.05, 0.2)
    """Height of blocks and depth of pits [m], [at difficulty 0, at difficulty 1]; each obstacle has the
    whole or half of this height."""
    width: Range = (0.25, 1.0)
    """[smallest, largest] edge length of an obstacle [m]."""
    count: Count = 40
    """Number of obstacles in a patch."""
    platform: NotNegative = 2.0
    """Edge length of the flat square in the middle [m]."""


class StonesPatchConfig(PatchConfig):
    """Stepping stones over a pit."""

    kind: Literal["stones"]
    """Kind of ground: always stones."""
    width: Range = (0.25, 1.0)
    """[smallest, largest] edge length of a stone [m]; the stones of difficulty 0 are the largest."""
    gap: Range = (0.05, 0.3)
    """Distance between stones [m], [at difficulty 0, at difficulty 1]."""
    depth: Positive = 1.0
    """Depth of the pit [m]."""
    platform: NotNegative = 2.0
    """Edge length of the flat square in the middle [m]."""


class StairsPatchConfig(PatchConfig):
    """Stairs on four sides."""

    kind: Literal["stairs"]
    """Kind of ground: always stairs."""
    step_height: Range = (0.05, 0.2)
    """Height of a step [m], [at difficulty 0, at difficulty 1]."""
    step_width: Positive = 0.3
    """Depth of a step [m]."""
    platform: NotNegative = 2.0
    """Edge length of the flat square in the middle [m]."""
    inverted: bool = False
    """true: the stairs go down to the middle; false: up."""
    boxes: bool = False
    """true: boxes with vertical faces, which are slower to simulate; false: part of the height field, whose faces are
    inclined by one cell."""


class GridPatchConfig(PatchConfig):
    """A grid of square cells with random heights."""

    kind: Literal["grid"]
    """Kind of ground: always grid."""
    cell: Positive = 0.5
    """Edge length of a cell [m]."""
    height: Range = (0.02, 0.15)
    """Largest random height above and below the mean [m]: [at difficulty 0, at difficulty 1]."""
    platform: NotNegative = 2.0
    """Edge length of the flat square in the middle [m]."""
    boxes: bool = False
    """true: boxes with vertical faces, which are slower to simulate; false: part of the height field, whose faces are
    inclined by one cell."""


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
"""Ground on a patch of a generated terrain; the key `kind` selects flat, noise, stairs and so on."""


class TerrainGeneratorConfig(StrictModel):
    """Terrain generator: a grid of patches, each with a kind of ground and a difficulty.

    Difficulty rises by row, and each column has one kind of ground. Environments start in the middle of a patch.
    """

    kind: Literal["generator"]
    """Kind of terrain: always generator."""
    rows: Count = 10
    """Number of rows along x, which are the levels of difficulty."""
    columns: Count = 10
    """Number of patches along y; environment i uses column i modulo `columns`."""
    patch: tuple[Positive, Positive] = (8.0, 8.0)
    """Size of a patch along x and y [m]."""
    border: NotNegative = 10.0
    """Width of the flat ground around the patches [m]."""
    resolution: Positive = 0.1
    """Distance between two points of the height field [m]."""
    sub_terrains: Annotated[dict[str, SubTerrainConfig], Field(min_length=1)]
    """Name -> a kind of ground (flat, noise, stairs ...) with its settings."""
    difficulty: ShareRange = (0.0, 1.0)
    """Difficulty of the first and of the last row, in [0, 1]."""
    curriculum: bool = True
    """true: one kind of ground for each column, difficulty by row; false: kind and difficulty are drawn for each
    patch."""
    max_start_level: Annotated[int, Field(ge=0)] | None = None
    """Highest level (row of the grid, from 0) at which environments start; each environment draws its level. null: the
    last level."""
    seed: int = 0
    """Seed of the terrain's random heights."""
    friction: NotNegative = 1.0
    """Coefficient of sliding friction."""

    @field_validator("sub_terrains")
    @classmethod
    def _check_proportions(cls, value: dict[str, SubTerrainConfig]) -> dict[str, SubTerrainConfig]:
        if sum(patch.proportion for patch in value.values()) <= 0.0:
            raise ValueError("the `proportion` of every sub-terrain is 0; set one or more above 0")
        return value


class TerrainHeightsConfig(StrictModel):
    """Terrain from a file: a height field. All environments start in its middle."""

    kind: Literal["heights"]
    """Kind of terrain: always heights."""
    file: str
    """A NumPy file (.npy) in the task's folder: heights [m], an array (x, y)."""
    resolution: Positive
    """Distance between two heights [m]."""
    friction: NotNegative = 1.0
    """Coefficient of sliding friction."""


TerrainConfig = Annotated[TerrainGeneratorConfig | TerrainHeightsConfig, Field(discriminator="kind")]
"""Terrain; the key `kind` selects generated ground (generator) or heights from a file (heights)."""
