"""Generate one patch (rectangular piece) of a terrain with a kind of ground: stairs, slopes, waves, and so on.

A patch is an array of heights [m] at the corners of its cells, with x along the first axis. The heights along its edges
are 0, so that any two patches fit together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlcli.config import schema

Heights = NDArray[np.float64]
_EPS = 1e-6


@dataclass(frozen=True, slots=True)
class Block:
    """Upright block of terrain: x and y of two opposite corners, and the height of its top [m]."""

    low: tuple[float, float]
    high: tuple[float, float]
    top: float


@dataclass(frozen=True, slots=True)
class PatchSite:
    """Size, resolution, difficulty and random generator of one patch of terrain, for any kind of ground."""

    size: tuple[float, float]
    """Extent along x and y [m]."""
    resolution: float
    """Distance between two heights [m]."""
    difficulty: float
    """Difficulty in [0, 1]."""
    random: np.random.Generator
    """Generator of the patch's random numbers."""

    def flat(self) -> Heights:
        """Return the heights of a flat patch, all 0 [m]."""
        nx, ny = (round(edge / self.resolution) + 1 for edge in self.size)
        return np.zeros((nx, ny))

    def axes(self) -> tuple[Heights, Heights]:
        """Return the coordinates of the heights along x, as a column, and along y, as a row [m]."""
        nx, ny = self.flat().shape
        x, y = (np.arange(n, dtype=np.float64) * self.resolution for n in (nx, ny))
        return x[:, None], y[None]

    def at_difficulty(self, ends: tuple[float, float]) -> float:
        """Interpolate a parameter at the patch's difficulty; `ends` are its values at difficulty 0 and 1."""
        return ends[0] + (ends[1] - ends[0]) * self.difficulty


@dataclass(frozen=True, slots=True)
class Patch:
    """A generated patch of terrain: its heights, and its blocks."""

    heights: Heights
    """Heights of the patch's surface, blocks included; 0 along the edges [m]."""
    blocks: tuple[Block, ...] = ()
    """Blocks that become boxes instead of a part of the height field."""


def make_patch(config: schema.PatchConfig, site: PatchSite) -> Patch:
    """Return a patch of terrain: the kind of ground that `config` describes, with the size and difficulty of `site`."""
    cells = round(config.border / site.resolution)
    if cells:
        return _with_border(config, site, cells)
    heights_or_blocks = _MAKERS[type(config)](config, site)
    if isinstance(heights_or_blocks, np.ndarray):
        return Patch(_with_zero_edges(heights_or_blocks))
    heights = site.flat()
    for block in heights_or_blocks:
        _cover_with_block(heights, site, block)
    return Patch(_with_zero_edges(heights), tuple(heights_or_blocks) if config.boxes else ())  # type: ignore[attr-defined]


def _with_border(config: schema.PatchConfig, site: PatchSite, cells: int) -> Patch:
    """Return a patch with a flat edge, which is `cells` cells wide."""
    width = cells * site.resolution
    size = (site.size[0] - 2.0 * width, site.size[1] - 2.0 * width)
    inner = make_patch(config.model_copy(update={"border": 0.0}), replace(site, size=size))
    heights = site.flat()
    heights[cells:-cells, cells:-cells] = inner.heights
    if not inner.blocks:
        return Patch(heights)
    blocks = [shifted(block, (width, width)) for block in inner.blocks]
    edge = ring(Block((0.0, 0.0), site.size, 0.0), Block((width, width), (width + size[0], width + size[1]), 0.0))
    return Patch(heights, (*edge, *blocks))


def shifted(block: Block, offset: tuple[float, float]) -> Block:
    """Return a block moved by `offset`, (x, y) [m]."""
    x, y = offset
    return Block((block.low[0] + x, block.low[1] + y), (block.high[0] + x, block.high[1] + y), block.top)


def ring(outer: Block, inner: Block) -> list[Block]:
    """Return four blocks that fill the area between two rectangles; the blocks have the height of `outer`."""
    (x0, y0), (x1, y1) = outer.low, outer.high
    (left, front), (right, back) = inner.low, inner.high
    return [
        Block((x0, y0), (x1, front), outer.top),
        Block((x0, back), (x1, y1), outer.top),
        Block((x0, front), (left, back), outer.top),
        Block((right, front), (x1, back), outer.top),
    ]


def _flat(config: schema.FlatPatchConfig, site: PatchSite) -> Heights:
    return site.flat()


def _noise(config: schema.NoisePatchConfig, site: PatchSite) -> Heights:
    bound = site.at_difficulty(config.height)
    coarse = [np.linspace(0.0, edge, max(2, round(edge / config.spacing) + 1)) for edge in site.size]
    drawn = site.random.uniform(-bound, bound, (len(coarse[0]), len(coarse[1])))
    x, y = site.axes()
    # bilinear interpolation: first along x, then along y
    along_x = np.stack([np.interp(x[:, 0], coarse[0], column) for column in drawn.T], axis=1)
    return np.stack([np.interp(y[0], coarse[1], row) for row in along_x])


def _slope(config: schema.SlopePatchConfig, site: PatchSite) -> Heights:
    run = np.minimum(_edge_distance(site), (min(site.size) - config.platform) / 2)
    return run * site.at_difficulty(config.slope) * (-1.0 if config.inverted else 1.0)


def _waves(config: schema.WavesPatchConfig, site: PatchSite) -> Heights:
    x, y = (2.0 * np.pi * config.count * axis / edge for axis, edge in zip(site.axes(), site.size, strict=True))
    return 0.5 * site.at_difficulty(config.amplitude) * (np.sin(x) + np.sin(y))


def _obstacles(config: schema.ObstaclesPatchConfig, site: PatchSite) -> Heights:
    heights, draw = site.flat(), site.random
    for _ in range(config.count):
        edges = draw.uniform(*config.width, 2)
        low = draw.uniform(0.0, 1.0, 2) * (np.array(site.size) - edges)
        top = site.at_difficulty(config.height) * draw.choice([-1.0, -0.5, 0.5, 1.0])
        _cover_with_block(heights, site, Block(tuple(low), tuple(low + edges), top))
    _cover_with_block(heights, site, _platform_block(config.platform, site))
    return heights


def _stones(config: schema.StonesPatchConfig, site: PatchSite) -> Heights:
    """Return the heights of rows of stepping stones over a pit; each row is shifted at random."""
    heights = site.flat() - config.depth
    width, gap = site.at_difficulty((config.width[1], config.width[0])), site.at_difficulty(config.gap)
    x = 0.0
    while x < site.size[0] - _EPS:
        y = -site.random.uniform(0.0, width)
        while y < site.size[1] - _EPS:
            _cover_with_block(heights, site, Block((x, y), (x + width, y + width), 0.0))
            y += width + gap
        x += width + gap
    _cover_with_block(heights, site, _platform_block(config.platform, site))
    return heights


def _stairs(config: schema.StairsPatchConfig, site: PatchSite) -> list[Block]:
    """Return the blocks of stairs on four sides: a ring of four for each step, from outside inwards, and a platform."""
    rise = site.at_difficulty(config.step_height) * (-1.0 if config.inverted else 1.0)
    steps = int((min(site.size) - config.platform) / 2 / config.step_width + _EPS)

    def inset(margin: float, top: float) -> Block:
        return Block((margin, margin), (site.size[0] - margin, site.size[1] - margin), top)

    blocks = []
    for step in range(steps):
        margin, top = step * config.step_width, step * rise
        blocks += ring(inset(margin, top), inset(margin + config.step_width, top))
    return [*blocks, inset(steps * config.step_width, steps * rise)]


def _grid(config: schema.GridPatchConfig, site: PatchSite) -> list[Block]:
    bound = site.at_difficulty(config.height)
    nx, ny = (max(1, int(edge / config.cell + _EPS)) for edge in site.size)
    dx, dy = site.size[0] / nx, site.size[1] / ny
    tops = site.random.uniform(-bound, bound, (nx, ny))
    x, y = ((np.arange(n) + 0.5) * d - edge / 2 for n, d, edge in ((nx, dx, site.size[0]), (ny, dy, site.size[1])))
    reach = config.platform / 2
    tops[(abs(x)[:, None] < reach) & (abs(y)[None] < reach)] = 0.0
    return [
        Block((i * dx, j * dy), ((i + 1) * dx, (j + 1) * dy), float(tops[i, j])) for i in range(nx) for j in range(ny)
    ]


_MAKERS: dict[type[schema.PatchConfig], Callable[[Any, PatchSite], Heights | list[Block]]] = {
    schema.FlatPatchConfig: _flat,
    schema.NoisePatchConfig: _noise,
    schema.SlopePatchConfig: _slope,
    schema.WavesPatchConfig: _waves,
    schema.ObstaclesPatchConfig: _obstacles,
    schema.StonesPatchConfig: _stones,
    schema.StairsPatchConfig: _stairs,
    schema.GridPatchConfig: _grid,
}


def _edge_distance(site: PatchSite) -> Heights:
    """Return the distance of every point of a patch from the patch's nearest edge [m]. (nx, ny)"""
    x, y = site.axes()
    return np.minimum(np.minimum(x, site.size[0] - x), np.minimum(y, site.size[1] - y))


def _platform_block(platform: float, site: PatchSite) -> Block:
    """Return a square block of height 0 in the middle of a patch; `platform` is its edge length [m]."""
    low, high = (tuple((edge + sign * platform) / 2 for edge in site.size) for sign in (-1, 1))
    return Block(low, high, 0.0)  # type: ignore[arg-type]


def _cover_with_block(heights: Heights, site: PatchSite, block: Block) -> None:
    """Set the heights of the points that a block covers to the height of the block's top, in place."""
    x, y = site.axes()
    inside_x = (x[:, 0] >= block.low[0] - _EPS) & (x[:, 0] <= block.high[0] + _EPS)
    inside_y = (y[0] >= block.low[1] - _EPS) & (y[0] <= block.high[1] + _EPS)
    heights[np.ix_(inside_x, inside_y)] = block.top


def _with_zero_edges(heights: Heights) -> Heights:
    heights[[0, -1]] = 0.0
    heights[:, [0, -1]] = 0.0
    return heights
