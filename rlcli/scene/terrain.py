"""The terrain of a scene: patches put together in the model, and where on it each environment stands."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any, TypeAlias

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli import random
from rlcli.config import schema
from rlcli.scene.sub_terrains import Block, Heights, Patch, PatchSite, make_patch
from rlcli.sim.selection import Selection
from rlcli.sim.tensor_state import require_in_range

if TYPE_CHECKING:
    from rlcli.scene.entity import Entity

TERRAIN_BODY = "terrain"
"""The body of the terrain's geoms."""
_MAX_HEIGHTS = 1 << 24
_MAX_HEADER = 10_000
"""Bytes of a NumPy file's header."""
_START, _MOVE = random.stream("terrain.start"), random.stream("terrain.move")
_SCATTER = random.stream("terrain.scatter")
_SPAWN_HALF_WIDTH = 0.5
"""Half the edge of the square in a patch's middle whose highest point is where its origin lies [m]."""
_THICKNESS = 0.5
"""How far ground reaches below its lowest point [m]."""

TerrainConfig: TypeAlias = schema.TerrainGeneratorConfig | schema.TerrainHeightsConfig
TerrainProblem: TypeAlias = tuple[tuple[str, ...], str, str | None]
"""Path below scene.terrain, what is wrong, what to do."""


@dataclass(frozen=True, slots=True)
class Ground:
    """A terrain as numbers."""

    heights: Heights
    """Of the height field, x along the first axis, its middle at the world's origin [m]."""
    resolution: float
    """Between two heights [m]."""
    border: float
    """Flat ground about it [m]."""
    friction: float
    """Sliding friction."""
    blocks: tuple[Block, ...]
    """In world coordinates."""
    origins: NDArray[np.float32]
    """Of the patches. (rows, columns, 3) [m]"""
    patch: tuple[float, float]
    """Extent of a patch along x and y [m]."""


def terrain_problems(config: TerrainConfig, root: Path) -> Iterator[TerrainProblem]:
    """Yield the problems of a terrain's configuration."""
    if isinstance(config, schema.TerrainHeightsConfig):
        yield from _file_problems(config, root)
        return
    cells = [edge / config.resolution for edge in config.patch]
    if any(abs(n - round(n)) > 1e-6 or n < 2 for n in cells):
        edges = " x ".join(f"{edge:g}" for edge in config.patch)
        message = f"a patch of {edges} m is not a whole number of cells of {config.resolution:g} m, two at least"
        yield ("patch",), message, "change patch or resolution"
        return
    count = round(cells[0]) * config.rows * round(cells[1]) * config.columns
    if count > _MAX_HEIGHTS:
        hint = "fewer or smaller patches, or a coarser resolution"
        yield ("resolution",), f"the height field has {count:,} heights, more than {_MAX_HEIGHTS:,}", hint
    if config.max_start_level is not None and config.max_start_level >= config.rows:
        yield ("max_start_level",), f"there is no level {config.max_start_level}", f"the last is {config.rows - 1}"
    for name, patch in config.sub_terrains.items():
        for key, text, advice in _patch_problems(patch, min(config.patch), config.resolution):
            yield ("sub_terrains", name, key), text, advice


def make_ground(config: TerrainConfig, root: Path) -> Ground:
    """Heights, blocks and origins; the same ones for the same configuration."""
    if isinstance(config, schema.TerrainHeightsConfig):
        heights = _read_heights(root / config.file).astype(np.float64)
        nx, ny = heights.shape
        extent = ((nx - 1) * config.resolution, (ny - 1) * config.resolution)
        origin = np.array([[[0.0, 0.0, heights[nx // 2, ny // 2]]]], dtype=np.float32)
        return Ground(heights, config.resolution, 0.0, config.friction, (), origin, extent)
    size, rows, columns = config.patch, config.rows, config.columns
    nx, ny = (round(edge / config.resolution) for edge in size)
    heights = np.zeros((rows * nx + 1, columns * ny + 1))
    corner = np.array([-0.5 * rows * size[0], -0.5 * columns * size[1]])
    origins = np.zeros((rows, columns, 3), dtype=np.float32)
    blocks: list[Block] = []
    for row in range(rows):
        for column in range(columns):
            draw = np.random.default_rng([config.seed & 0xFFFFFFFFFFFFFFFF, row, column])
            kind, difficulty = _choose_patch(config, row, column, draw)
            patch = make_patch(kind, PatchSite(size, config.resolution, difficulty, draw))
            low = corner + np.array([row * size[0], column * size[1]])
            surface = patch.heights if not patch.blocks else _heights_below_blocks(patch)
            heights[row * nx : (row + 1) * nx + 1, column * ny : (column + 1) * ny + 1] = surface
            blocks += [_shifted(block, low) for block in patch.blocks]
            origins[row, column] = (*(low + np.array(size) / 2), _spawn_height(patch.heights, config.resolution))
    return Ground(heights, config.resolution, config.border, config.friction, tuple(blocks), origins, size)


def add_ground(spec: mujoco.MjSpec, ground: Ground, material: str) -> None:
    """Put a terrain into a model: a height field, boxes, and a border."""
    body, prefix = spec.worldbody.add_body(name=TERRAIN_BODY), f"//{TERRAIN_BODY}"
    friction = [ground.friction, 0.005, 0.0001]
    nx, ny = ground.heights.shape
    half = [0.5 * (n - 1) * ground.resolution for n in (nx, ny)]
    lowest, span = float(ground.heights.min()), float(np.ptp(ground.heights))
    flat = span < 1e-9
    if flat:
        body.add_geom(
            name=f"{prefix}/flat", type=mujoco.mjtGeom.mjGEOM_BOX, size=[*half, _THICKNESS],
            pos=[0.0, 0.0, lowest - _THICKNESS], material=material, friction=friction,
        )  # fmt: skip
    else:
        values = ground.heights.T.astype(np.float32).ravel()
        spec.add_hfield(name=TERRAIN_BODY, nrow=ny, ncol=nx, size=[*half, span, _THICKNESS], userdata=values)
        body.add_geom(
            name=f"{prefix}/heights", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=TERRAIN_BODY,
            pos=[0.0, 0.0, lowest], material=material, friction=friction,
        )  # fmt: skip
    floor = min(lowest, 0.0) - _THICKNESS
    border = _border(half, ground.border)
    for number, block in enumerate([*ground.blocks, *border]):
        size = [(block.high[i] - block.low[i]) / 2 for i in (0, 1)]
        middle = [(block.high[i] + block.low[i]) / 2 for i in (0, 1)]
        body.add_geom(
            name=f"{prefix}/box_{number}", type=mujoco.mjtGeom.mjGEOM_BOX, size=[*size, (block.top - floor) / 2],
            pos=[*middle, (block.top + floor) / 2], material=material, friction=friction,
        )  # fmt: skip


class Terrain:
    """Where each environment stands. A level is a row of patches, a type a column.

    Args:
        ground: the terrain in the model.
        config: its configuration.
        origins: the environments' start places, kept up to date. (num_envs, 3) [m]
        seed: of the start levels.
        shared_streams: environment i stands where i % shared_streams does; 0: each for itself.
    """

    def __init__(
        self,
        ground: Ground,
        config: TerrainConfig,
        origins: Tensor,
        seed: int,
        shared_streams: int = 0,
    ) -> None:
        device, count = origins.device, len(origins)
        self.origins = torch.from_numpy(ground.origins).to(device)
        """Start place on each patch. (rows, columns, 3) [m]"""
        self._names = np.arange(count) % (shared_streams or max(1, count))
        self.types = torch.from_numpy(self._names).to(device) % self.origins.shape[1]
        """Column of each environment. (num_envs,) int64"""
        self.levels = torch.zeros(count, dtype=torch.int64, device=device)
        """Row of each environment. (num_envs,) int64"""
        self.patch = ground.patch
        """Extent of a patch along x and y [m]."""
        rows = len(self.origins)
        last = config.max_start_level if isinstance(config, schema.TerrainGeneratorConfig) else None
        self._start_levels = rows if last is None else last + 1
        self._env_origins = origins
        self.start(seed)

    @property
    def rows(self) -> int:
        """How many levels there are."""
        return len(self.origins)

    def start(self, seed: int) -> None:
        """Put every environment on its start level, which depends on the seed and its number alone."""
        keys = random.row_keys(seed, self._names, np.zeros_like(self._names))
        self.levels.copy_(torch.from_numpy(random.integers(keys, _START, 0, 1, self._start_levels)[:, 0]))
        self._env_origins.copy_(self.origins[self.levels, self.types])

    def move(self, selection: Selection, up: Tensor, down: Tensor) -> None:
        """Move environments a level up or down; who has passed the last level gets a random one. (rows,) bool each"""
        levels = selection.read(self.levels) + up.long() - (down & ~up).long()
        anywhere = selection.stream(_MOVE).choice(self.rows)
        self._set_levels(selection, torch.where(levels >= self.rows, anywhere, levels.clamp(min=0)))

    def scatter(self, selection: Selection) -> None:
        """Put environments on random levels, each on its own kind of ground."""
        self._set_levels(selection, selection.stream(_SCATTER).choice(self.rows))

    def _set_levels(self, selection: Selection, levels: Tensor) -> None:
        selection.write(self.levels, levels)
        selection.write(self._env_origins, self.origins[levels, selection.read_view(self.types)])

    def place_entities(self, entities: Iterable[Entity], selection: Selection) -> None:
        """Move floating and mocap entities from their default place to the environment's start place."""
        for entity in entities:
            if entity.is_floating or entity.mocap >= 0:
                default = selection.read_view(entity.data.default_root_state)
                place = default[:, :3] + selection.read_view(self._env_origins)
                entity.write_root_pose(selection, place, default[:, 3:7])

    def state_dict(self) -> dict[str, Tensor]:
        """The levels."""
        return {"levels": self.levels.clone()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""
        require_in_range(state["levels"], 0, self.rows - 1, "terrain.levels")
        self.levels.copy_(state["levels"])
        self._env_origins.copy_(self.origins[self.levels, self.types])


def _choose_patch(
    config: schema.TerrainGeneratorConfig, row: int, column: int, draw: np.random.Generator
) -> tuple[schema.PatchConfig, float]:
    """Kind and difficulty of a patch."""
    kinds = list(config.sub_terrains.values())
    shares = np.cumsum([kind.proportion for kind in kinds])
    low, high = config.difficulty
    if config.curriculum:
        share = (column + 0.5) / config.columns
        step = row / (config.rows - 1) if config.rows > 1 else 0.5
    else:
        share, step = draw.uniform(0.0, 1.0, 2)
    chosen = int(np.searchsorted(shares, share * shares[-1], side="right"))
    return kinds[min(chosen, len(kinds) - 1)], low + (high - low) * step


def _spawn_height(heights: Heights, resolution: float) -> float:
    """The highest point in the middle of a patch."""
    reach = round(_SPAWN_HALF_WIDTH / resolution)
    x, y = (n // 2 for n in heights.shape)
    return float(heights[max(0, x - reach) : x + reach + 1, max(0, y - reach) : y + reach + 1].max())


def _heights_below_blocks(patch: Patch) -> Heights:
    """Heights that stay below a patch's blocks."""
    lowest = min(block.top for block in patch.blocks)
    inside = np.zeros_like(patch.heights)
    inside[1:-1, 1:-1] = lowest - 0.05 if lowest < 0.0 else 0.0
    return inside


def _shifted(block: Block, by: NDArray[np.float64]) -> Block:
    x, y = by.tolist()
    return Block((block.low[0] + x, block.low[1] + y), (block.high[0] + x, block.high[1] + y), block.top)


def _border(half: list[float], width: float) -> list[Block]:
    if width == 0.0:
        return []
    x, y = half
    return [
        Block((-x - width, -y - width), (x + width, -y), 0.0),
        Block((-x - width, y), (x + width, y + width), 0.0),
        Block((-x - width, -y), (-x, y), 0.0),
        Block((x, -y), (x + width, y), 0.0),
    ]


def _patch_problems(patch: schema.PatchConfig, edge: float, resolution: float) -> Iterator[tuple[str, str, str | None]]:
    platform = getattr(patch, "platform", 0.0)
    if platform >= edge:
        yield "platform", f"a platform of {platform:g} m does not fit in a patch of {edge:g} m", None
    fine = "a finer resolution, or boxes: true"
    if isinstance(patch, schema.StairsPatchConfig) and not patch.boxes and patch.step_width < 2 * resolution:
        yield "step_width", f"steps of {patch.step_width:g} m need cells of half that, not {resolution:g} m", fine
    if isinstance(patch, schema.GridPatchConfig) and not patch.boxes and patch.cell < 2 * resolution:
        yield "cell", f"cells of {patch.cell:g} m need a resolution of half that, not {resolution:g} m", fine
    if isinstance(patch, schema.ObstaclesPatchConfig | schema.StonesPatchConfig):
        if patch.width[1] > edge:
            yield "width", f"{patch.width[1]:g} m does not fit in a patch of {edge:g} m", None
        if patch.width[0] < resolution:
            yield "width", f"{patch.width[0]:g} m is less than a cell of {resolution:g} m", "a finer resolution"


def _read_heights(file: Path) -> NDArray[Any]:
    """Return the array of an untrusted NumPy file.

    Raises:
        ValueError: if it is none, or has more heights than a height field can.
    """
    with file.open("rb") as opened:
        size = os.fstat(opened.fileno()).st_size
        if size > _MAX_HEIGHTS * 8 + _MAX_HEADER:
            raise ValueError(f"it has {size:,} bytes, more than {_MAX_HEIGHTS:,} heights need")
        try:
            return np.asarray(np.lib.format.read_array(opened, allow_pickle=False, max_header_size=_MAX_HEADER))
        except (MemoryError, RecursionError, SyntaxError, TokenError) as error:  # of a header that promises too much
            raise ValueError(f"its header is malformed ({type(error).__name__})") from None


def _file_problems(config: schema.TerrainHeightsConfig, root: Path) -> Iterator[TerrainProblem]:
    file = (root / config.file).resolve()
    if not file.is_relative_to(root.resolve()):
        yield ("file",), f"'{config.file}' lies outside the task's folder {root}", None
        return
    if not file.is_file():
        have = ", ".join(sorted(str(p.relative_to(root)) for p in root.rglob("*.npy"))) or "none"
        yield ("file",), f"no file '{config.file}' in {root}", f"NumPy files there: {have}"
        return
    try:
        heights = _read_heights(file)
    except (ValueError, OSError) as error:
        yield ("file",), f"'{config.file}' is not a NumPy file: {error}", None
        return
    if heights.ndim != 2 or min(heights.shape) < 2:
        found = f"found shape {heights.shape}"
        yield ("file",), f"'{config.file}' must hold a table of heights, two by two at least; {found}", None
    elif heights.dtype.kind not in "fiu" or not np.isfinite(heights).all():
        yield ("file",), f"'{config.file}' must hold finite numbers; found {heights.dtype}", None
