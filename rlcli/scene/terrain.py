"""Terrain of a scene: generate its patches, add them to the model, and assign start positions to environments.

Curriculum terms move environments to harder patches by the class `Terrain`.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli import random
from rlcli.config import schema
from rlcli.config.schema import TerrainConfig
from rlcli.scene.entity import Entity
from rlcli.scene.sub_terrains import Block, Heights, Patch, PatchSite, make_patch, ring, shifted
from rlcli.sim.env_selection import Selection
from rlcli.sim.saved_tensors import require_in_range

TERRAIN_BODY = "terrain"
"""Name of the MuJoCo body that has the geoms of the terrain."""
_MAX_HEIGHTS = 1 << 24
"""Largest number of heights of a height field."""
_MAX_HEADER = 10_000
"""Largest header of a NumPy file [bytes]."""
_MAX_PARTS = 2000
"""Largest number of steps, cells or random heights along one edge of a patch."""
_START, _MOVE = random.stream("terrain.start"), random.stream("terrain.move")
_SCATTER = random.stream("terrain.scatter")
_SPAWN_HALF_WIDTH = 0.5
"""Half the edge of the square in the middle of a patch whose highest point is the height of the start position [m]."""
_THICKNESS = 0.5
"""Thickness of the ground below its lowest point [m]."""
_BOX, _HFIELD = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_HFIELD

TerrainProblem = tuple[tuple[str, ...], str, str | None]
"""Mistake in a terrain's configuration: (key below scene.terrain, message, hint)."""


@dataclass(frozen=True, slots=True)
class Ground:
    """A generated terrain before it is added to a model: its height field, its blocks, and the origin of each patch."""

    heights: Heights
    """Heights of the height field, x along the first axis, its middle at the world's origin [m]."""
    resolution: float
    """Distance between two heights [m]."""
    border: float
    """Width of the flat ground around the height field [m]."""
    friction: float
    """Sliding friction."""
    blocks: tuple[Block, ...]
    """Blocks in world coordinates."""
    origins: NDArray[np.float32]
    """Origins of the patches. (rows, columns, 3) [m]"""
    patch: tuple[float, float]
    """Extent of a patch along x and y [m]."""


def terrain_problems(config: TerrainConfig, root: Path) -> Iterator[TerrainProblem]:
    """Yield the mistakes in a terrain's configuration.

    `root` is the task's folder, to which the path in the terrain's key `file` is relative.
    """
    if isinstance(config, schema.TerrainHeightsConfig):
        yield from _file_problems(config, root)
        return
    cells = [edge / config.resolution for edge in config.patch]
    if any(abs(n - round(n)) > 1e-6 or n < 2 for n in cells):
        edges = " x ".join(f"{edge:g}" for edge in config.patch)
        message = f"a patch of {edges} m is not a whole number of cells of {config.resolution:g} m, at least two"
        yield ("patch",), message, "change patch or resolution"
        return
    count = round(cells[0]) * config.rows * round(cells[1]) * config.columns
    if count > _MAX_HEIGHTS:
        hint = "set fewer or smaller patches, or a larger resolution"
        yield ("resolution",), f"the height field has {count:,} heights, more than {_MAX_HEIGHTS:,}", hint
    if config.max_start_level is not None and config.max_start_level >= config.rows:
        yield ("max_start_level",), f"level {config.max_start_level} does not exist", f"levels: 0 to {config.rows - 1}"
    for name, patch in config.sub_terrains.items():
        edge = min(config.patch) - 2.0 * round(patch.border / config.resolution) * config.resolution
        if edge < 2.0 * config.resolution - 1e-6:
            where = ("sub_terrains", name, "border")
            message = f"a border of {patch.border:g} m leaves less than two cells of the patch"
            yield where, message, f"set at most {min(config.patch) / 2 - config.resolution:g}"
            continue
        for key, text, advice in _patch_problems(patch, edge, config.resolution):
            yield ("sub_terrains", name, key), text, advice


def make_ground(config: TerrainConfig, root: Path) -> Ground:
    """Generate a terrain, or read its heights from a file in `root`; the same configuration gives the same ground."""
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
            blocks += [shifted(block, (float(low[0]), float(low[1]))) for block in patch.blocks]
            origins[row, column] = (*(low + np.array(size) / 2), _spawn_height(patch.heights, config.resolution))
    return Ground(heights, config.resolution, config.border, config.friction, tuple(blocks), origins, size)


def add_ground(spec: mujoco.MjSpec, ground: Ground, material: str) -> None:
    """Add a terrain to a model: a height field, boxes, and a flat border, all of the material named `material`."""
    body, prefix = spec.worldbody.add_body(name=TERRAIN_BODY), f"//{TERRAIN_BODY}"
    add_geom = functools.partial(body.add_geom, material=material, friction=[ground.friction, 0.005, 0.0001])
    nx, ny = ground.heights.shape
    half = [0.5 * (n - 1) * ground.resolution for n in (nx, ny)]
    lowest, span = float(ground.heights.min()), float(np.ptp(ground.heights))
    if span < 1e-9:  # MuJoCo refuses a height field without a height difference
        add_geom(name=f"{prefix}/flat", type=_BOX, size=[*half, _THICKNESS], pos=[0.0, 0.0, lowest - _THICKNESS])
    else:
        values = ground.heights.T.astype(np.float32).ravel()  # MuJoCo's rows are along y
        spec.add_hfield(name=TERRAIN_BODY, nrow=ny, ncol=nx, size=[*half, span, _THICKNESS], userdata=values)
        add_geom(name=f"{prefix}/heights", type=_HFIELD, hfieldname=TERRAIN_BODY, pos=[0.0, 0.0, lowest])
    floor = min(lowest, 0.0) - _THICKNESS
    for number, block in enumerate([*ground.blocks, *_border(half, ground.border)]):
        size = [*((block.high[i] - block.low[i]) / 2 for i in (0, 1)), (block.top - floor) / 2]
        middle = [*((block.high[i] + block.low[i]) / 2 for i in (0, 1)), (block.top + floor) / 2]
        add_geom(name=f"{prefix}/box_{number}", type=_BOX, size=size, pos=middle)


class Terrain:
    """Start positions of the environments on a terrain. A level is a row of patches, a type is a column of patches.

    Args:
        ground: the terrain in the model.
        config: configuration of the terrain.
        origins: start positions of the environments; this object updates them. (num_envs, 3) [m]
        seed: seed of the start levels.
        streams: index of the random stream of each environment; environments with equal indices start on the same
            patch. (num_envs,)
    """

    def __init__(
        self, ground: Ground, config: TerrainConfig, origins: Tensor, seed: int, streams: NDArray[np.int64]
    ) -> None:
        device, count = origins.device, len(origins)
        self.origins = torch.from_numpy(ground.origins).to(device)
        """Start position on each patch, world frame. (rows, columns, 3) [m]"""
        self._streams = streams
        self.types = torch.from_numpy(streams).to(device) % self.origins.shape[1]
        """Terrain type (column of patches) of each environment. (num_envs,) int64"""
        self.levels = torch.zeros(count, dtype=torch.int64, device=device)
        """Terrain level (row of patches) of each environment. (num_envs,) int64"""
        self.patch = ground.patch
        """Extent of a patch along x and y [m]."""
        rows = len(self.origins)
        last = config.max_start_level if isinstance(config, schema.TerrainGeneratorConfig) else None
        self._start_levels = rows if last is None else last + 1
        self._env_origins = origins
        self.start(seed)

    @property
    def rows(self) -> int:
        """Number of levels of difficulty, which are the rows of patches."""
        return len(self.origins)

    def start(self, seed: int) -> None:
        """Move every environment to its start level, which depends only on the seed and the environment's stream."""
        keys = random.row_keys(seed, self._streams, np.zeros_like(self._streams))
        self.levels.copy_(torch.from_numpy(random.integers(keys, _START, 0, 1, self._start_levels)[:, 0]))
        self._env_origins.copy_(self.origins[self.levels, self.types])

    def move(self, selection: Selection, up: Tensor, down: Tensor) -> None:
        """Move environments a level up or down; an environment above the last level gets a random level.

        Args:
            selection: the environments.
            up: whether each selected environment moves up. (rows,) bool
            down: whether each selected environment moves down; not used where `up` is true. (rows,) bool
        """
        levels = selection.read(self.levels) + up.long() - (down & ~up).long()
        drawn = selection.stream(_MOVE).choice(self.rows)
        self._set_levels(selection, torch.where(levels >= self.rows, drawn, levels.clamp(min=0)))

    def scatter(self, selection: Selection) -> None:
        """Move environments to random levels; their kind of ground (column of patches) does not change."""
        self._set_levels(selection, selection.stream(_SCATTER).choice(self.rows))

    def _set_levels(self, selection: Selection, levels: Tensor) -> None:
        selection.write(self.levels, levels)
        selection.write(self._env_origins, self.origins[levels, selection.read_view(self.types)])

    def place_entities(self, entities: Iterable[Entity], selection: Selection) -> None:
        """Set the root poses of entities to their default pose, moved to the patch of the environment.

        Entities whose root is fixed to the world are left out.
        """
        for entity in entities:
            if entity.is_floating or entity.mocap >= 0:
                default = selection.read_view(entity.data.default_root_state)
                position = default[:, :3] + selection.read_view(self._env_origins)
                entity.write_root_pose(selection, position, default[:, 3:7])

    def state_dict(self) -> dict[str, Tensor]:
        """Return the state to save: a copy of the terrain level of each environment."""
        return {"levels": self.levels.clone()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""
        require_in_range(state["levels"], 0, self.rows - 1, "terrain.levels")
        self.levels.copy_(state["levels"])
        self._env_origins.copy_(self.origins[self.levels, self.types])


def _choose_patch(
    config: schema.TerrainGeneratorConfig, row: int, column: int, draw: np.random.Generator
) -> tuple[schema.PatchConfig, float]:
    """Return the kind of ground and the difficulty (0 to 1) of the patch at a row and a column.

    `draw` is the generator of random numbers.
    """
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
    """Return the height of the origin of a patch [m]: the largest of its heights near the patch's middle."""
    reach = round(_SPAWN_HALF_WIDTH / resolution)
    x, y = (n // 2 for n in heights.shape)
    return float(heights[max(0, x - reach) : x + reach + 1, max(0, y - reach) : y + reach + 1].max())


def _heights_below_blocks(patch: Patch) -> Heights:
    """Return the heights of the height field below the boxes of a patch [m]."""
    lowest = min(block.top for block in patch.blocks)
    inside = np.zeros_like(patch.heights)
    # 5 cm lower than the blocks, so that no two surfaces are in one plane
    inside[1:-1, 1:-1] = lowest - 0.05 if lowest < 0.0 else 0.0
    return inside


def _border(half: list[float], width: float) -> list[Block]:
    """Return the blocks of the flat ground around a height field.

    `half` is half of the height field's extent along x and y, `width` the width of the flat ground [m].
    """
    if width == 0.0:
        return []
    x, y = half
    return ring(Block((-x - width, -y - width), (x + width, y + width), 0.0), Block((-x, -y), (x, y), 0.0))


def _patch_problems(patch: schema.PatchConfig, edge: float, resolution: float) -> Iterator[tuple[str, str, str | None]]:
    """Yield key, message and hint for each mistake in the settings of one kind of ground.

    `edge` is the shorter edge of a patch, `resolution` the distance between two heights [m].
    """
    platform = getattr(patch, "platform", 0.0)
    if platform >= edge:
        message = f"a platform of {platform:g} m does not fit in a patch of {edge:g} m"
        yield "platform", message, "set a smaller platform"
    for key in ("spacing", "step_width", "cell"):
        if (part := getattr(patch, key, edge)) * _MAX_PARTS < edge:
            yield (
                key,
                f"a {key} of {part:g} m divides a patch of {edge:g} m into more than {_MAX_PARTS} parts",
                f"set a larger {key}",
            )
    fine = "set a smaller resolution, or boxes: true"
    if isinstance(patch, schema.StairsPatchConfig) and not patch.boxes and patch.step_width < 2 * resolution:
        needed = f"a resolution of at most {patch.step_width / 2:g} m"
        yield "step_width", f"a step of {patch.step_width:g} m needs {needed}, found {resolution:g} m", fine
    if isinstance(patch, schema.GridPatchConfig) and not patch.boxes and patch.cell < 2 * resolution:
        needed = f"a resolution of at most {patch.cell / 2:g} m"
        yield "cell", f"a cell of {patch.cell:g} m needs {needed}, found {resolution:g} m", fine
    if isinstance(patch, schema.ObstaclesPatchConfig | schema.StonesPatchConfig):
        if patch.width[1] > edge:
            message = f"a width of {patch.width[1]:g} m does not fit in a patch of {edge:g} m"
            yield "width", message, "set a smaller width"
        if patch.width[0] < resolution:
            yield (
                "width",
                f"a width of {patch.width[0]:g} m is less than a cell of {resolution:g} m",
                "set a smaller resolution",
            )


def _read_heights(file: Path) -> NDArray[Any]:
    """Return the array of an untrusted NumPy file.

    Raises:
        ValueError: if the file is not a NumPy file, or has more heights than a height field can have.
    """
    with file.open("rb") as opened:
        size = os.fstat(opened.fileno()).st_size
        if size > _MAX_HEIGHTS * 8 + _MAX_HEADER:
            raise ValueError(f"the file is too large ({size:,} bytes); give at most {_MAX_HEIGHTS:,} heights")
        try:
            return np.asarray(np.lib.format.read_array(opened, allow_pickle=False, max_header_size=_MAX_HEADER))
        except (MemoryError, RecursionError, SyntaxError, TokenError) as error:  # errors of a malicious header
            raise ValueError(f"the header of the file is malformed ({type(error).__name__}); use numpy.save") from None


def _file_problems(config: schema.TerrainHeightsConfig, root: Path) -> Iterator[TerrainProblem]:
    """Yield the mistakes in the configuration of a terrain from a file, and in the file, which is in `root`."""
    file = (root / config.file).resolve()
    if not file.is_relative_to(root.resolve()):
        yield ("file",), f"'{config.file}' lies outside the task's folder {root}", "move the file into the folder"
        return
    if not file.is_file():
        files = ", ".join(sorted(str(p.relative_to(root)) for p in root.rglob("*.npy"))) or "none"
        yield ("file",), f"no file '{config.file}' in {root}", f"NumPy files there: {files}"
        return
    try:
        heights = _read_heights(file)
    except (ValueError, OSError) as error:
        yield ("file",), f"'{config.file}' is not a NumPy file: {error}", "write the file with numpy.save"
        return
    if heights.ndim != 2 or min(heights.shape) < 2:
        found = f"found shape {heights.shape}"
        yield ("file",), f"'{config.file}' must contain a table of heights, at least 2 by 2; {found}", None
    elif heights.dtype.kind not in "fiu" or not np.isfinite(heights).all():
        yield ("file",), f"'{config.file}' must contain finite numbers; found {heights.dtype}", None
