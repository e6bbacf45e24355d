"""Sub-terrains: the heights of one patch, or the blocks it is built of.

A patch is an array of heights [m] at the corners of its cells, x along the first axis. Its outermost heights are 0, so
that any two patches fit together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlcli.config import schema

Heights = NDArray[np.float64]
_EPS = 1e-6


@dataclass(frozen=True, slots=True)
class Block:
    """An upright block: its corners in the patch, and the height of its top [m]."""

    low: tuple[float, float]
    high: tuple[float, float]
    top: float


@dataclass(frozen=True, slots=True)
class PatchSite:
    """Size, resolution and difficulty of a patch to make."""

    size: tuple[float, float]
    """Along x and y [m]."""
    resolution: float
    """Between two heights [m]."""
    difficulty: float
    """In [0, 1]."""
    random: np.random.Generator

    def flat(self) -> Heights:
        """Heights of 0."""
        nx, ny = (round(edge / self.resolution) + 1 for edge in self.size)
        return np.zeros((nx, ny))

    def axes(self) -> tuple[Heights, Heights]:
        """Coordinates of the heights along x, as a column, and along y, as a row [m]."""
        nx, ny = self.flat().shape
        x, y = (np.arange(n, dtype=np.float64) * self.resolution for n in (nx, ny))
        return x[:, None], y[None]

    def at_difficulty(self, ends: tuple[float, float]) -> float:
        """The value between those of difficulty 0 and 1."""
        return ends[0] + (ends[1] - ends[0]) * self.difficulty


@dataclass(frozen=True, slots=True)
class Patch:
    """A finished patch."""

    heights: Heights
    """Of its surface, blocks included; 0 along the edges."""
    blocks: tuple[Block, ...] = ()
    """What is to be built of boxes instead of a height field."""


def make_patch(config: schema.PatchConfig, plot: PatchSite) -> Patch:
    """A sub-terrain of some difficulty."""
    made = _MAKERS[type(config)](config, plot)
    if isinstance(made, np.ndarray):
        return Patch(_with_zero_edges(made))
    heights = plot.flat()
    for block in made:
        _raise_to_block(heights, plot, block)
    return Patch(_with_zero_edges(heights), tuple(made) if config.boxes else ())  # type: ignore[attr-defined]


def _flat(config: schema.FlatPatchConfig, plot: PatchSite) -> Heights:
    return plot.flat()


def _noise(config: schema.NoisePatchConfig, plot: PatchSite) -> Heights:
    bound = plot.at_difficulty(config.height)
    coarse = [np.linspace(0.0, edge, max(2, round(edge / config.spacing) + 1)) for edge in plot.size]
    drawn = plot.random.uniform(-bound, bound, (len(coarse[0]), len(coarse[1])))
    x, y = plot.axes()
    along_x = np.stack([np.interp(x[:, 0], coarse[0], column) for column in drawn.T], axis=1)
    return np.stack([np.interp(y[0], coarse[1], row) for row in along_x])


def _slope(config: schema.SlopePatchConfig, plot: PatchSite) -> Heights:
    run = np.minimum(_edge_distance(plot), (min(plot.size) - config.platform) / 2)
    return run * plot.at_difficulty(config.slope) * (-1.0 if config.inverted else 1.0)


def _waves(config: schema.WavesPatchConfig, plot: PatchSite) -> Heights:
    x, y = (2.0 * np.pi * config.count * axis / edge for axis, edge in zip(plot.axes(), plot.size, strict=True))
    return 0.5 * plot.at_difficulty(config.amplitude) * (np.sin(x) + np.sin(y))


def _obstacles(config: schema.ObstaclesPatchConfig, plot: PatchSite) -> Heights:
    heights, draw = plot.flat(), plot.random
    for _ in range(config.count):
        edges = draw.uniform(*config.width, 2)
        low = draw.uniform(0.0, 1.0, 2) * (np.array(plot.size) - edges)
        top = plot.at_difficulty(config.height) * draw.choice([-1.0, -0.5, 0.5, 1.0])
        _raise_to_block(heights, plot, Block(tuple(low), tuple(low + edges), top))
    _raise_to_block(heights, plot, _platform_block(config.platform, plot, 0.0))
    return heights


def _stones(config: schema.StonesPatchConfig, plot: PatchSite) -> Heights:
    """Rows of stones, each row shifted at random; the gaps are what lies between them."""
    heights = plot.flat() - config.depth
    width, gap = plot.at_difficulty((config.width[1], config.width[0])), plot.at_difficulty(config.gap)
    x = 0.0
    while x < plot.size[0] - _EPS:
        y = -plot.random.uniform(0.0, width)
        while y < plot.size[1] - _EPS:
            _raise_to_block(heights, plot, Block((x, y), (x + width, y + width), 0.0))
            y += width + gap
        x += width + gap
    _raise_to_block(heights, plot, _platform_block(config.platform, plot, 0.0))
    return heights


def _stairs(config: schema.StairsPatchConfig, plot: PatchSite) -> list[Block]:
    """Rings of four blocks each, from the outside inwards, and the platform."""
    rise = plot.at_difficulty(config.step_height) * (-1.0 if config.inverted else 1.0)
    steps = int((min(plot.size) - config.platform) / 2 / config.step_width + _EPS)
    blocks = []
    for step in range(steps):
        near = step * config.step_width
        blocks += _ring(near, near + config.step_width, plot.size, step * rise)
    rest = steps * config.step_width
    high = (plot.size[0] - rest, plot.size[1] - rest)
    return [*blocks, Block((rest, rest), high, steps * rise)]


def _grid(config: schema.GridPatchConfig, plot: PatchSite) -> list[Block]:
    bound = plot.at_difficulty(config.height)
    nx, ny = (max(1, int(edge / config.cell + _EPS)) for edge in plot.size)
    dx, dy = plot.size[0] / nx, plot.size[1] / ny
    tops = plot.random.uniform(-bound, bound, (nx, ny))
    x, y = ((np.arange(n) + 0.5) * d - edge / 2 for n, d, edge in ((nx, dx, plot.size[0]), (ny, dy, plot.size[1])))
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


def _edge_distance(plot: PatchSite) -> Heights:
    """Distance of every height from the nearest edge [m]."""
    x, y = plot.axes()
    return np.minimum(np.minimum(x, plot.size[0] - x), np.minimum(y, plot.size[1] - y))


def _platform_block(platform: float, plot: PatchSite, top: float) -> Block:
    low, high = (tuple((edge + sign * platform) / 2 for edge in plot.size) for sign in (-1, 1))
    return Block(low, high, top)  # type: ignore[arg-type]


def _ring(near: float, far: float, size: tuple[float, float], top: float) -> list[Block]:
    x, y = size
    return [
        Block((near, near), (x - near, far), top),
        Block((near, y - far), (x - near, y - near), top),
        Block((near, far), (far, y - far), top),
        Block((x - far, far), (x - near, y - far), top),
    ]


def _raise_to_block(heights: Heights, plot: PatchSite, block: Block) -> None:
    """Set the heights that a block covers to that of its top."""
    x, y = plot.axes()
    inside_x = (x[:, 0] >= block.low[0] - _EPS) & (x[:, 0] <= block.high[0] + _EPS)
    inside_y = (y[0] >= block.low[1] - _EPS) & (y[0] <= block.high[1] + _EPS)
    heights[np.ix_(inside_x, inside_y)] = block.top


def _with_zero_edges(heights: Heights) -> Heights:
    heights[[0, -1]] = 0.0
    heights[:, [0, -1]] = 0.0
    return heights
