"""Patterns of rays for ray sensors: start points and directions.

A task of Isaac Lab that imports a name from `isaaclab.sensors.patterns` gets the object of this name from here.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.config_class import MISSING, configclass


def grid_pattern(cfg: Any, device: Any) -> tuple[Tensor, Tensor]:
    """Return start points [m] and directions of parallel rays that start on a grid, sensor frame. (rays, 3) each"""
    x, y = (torch.arange(-size / 2, size / 2 + 1e-9, cfg.resolution, device=device) for size in cfg.size)
    across, along = torch.meshgrid(x, y, indexing=cfg.ordering if cfg.ordering == "xy" else "ij")
    starts = torch.stack([across.flatten(), along.flatten(), torch.zeros_like(across).flatten()], dim=1)
    return starts, torch.tensor([cfg.direction], device=device).float().expand_as(starts)


def lidar_pattern(cfg: Any, device: Any) -> tuple[Tensor, Tensor]:
    """Return start points (all zero) and directions of a lidar's rays, channel by channel. (rays, 3) each"""
    low, high = cfg.horizontal_fov_range
    count = math.ceil((high - low) / cfg.horizontal_res) + 1
    heading = torch.linspace(low, high, count)
    heading = heading[:-1] if abs(high - low - 360.0) < 1e-6 else heading  # the last ray equals the first one
    elevation = torch.linspace(cfg.vertical_fov_range[0], cfg.vertical_fov_range[1], cfg.channels)
    up, turn = torch.meshgrid(elevation.deg2rad(), heading.deg2rad(), indexing="ij")
    rays = torch.stack([up.cos() * turn.cos(), up.cos() * turn.sin(), up.sin()], dim=-1).flatten(0, 1).to(device)
    return torch.zeros_like(rays), rays


def bpearl_pattern(cfg: Any, device: Any) -> tuple[Tensor, Tensor]:
    """Return start points (all zero) and directions of the rays of the lidar RS-Bpearl, by heading. (rays, 3) each"""
    heading = torch.arange(-cfg.horizontal_fov / 2, cfg.horizontal_fov / 2, cfg.horizontal_res, device=device)
    up = torch.tensor(list(cfg.vertical_ray_angles), device=device)
    turn, up = torch.meshgrid(heading.deg2rad(), up.deg2rad(), indexing="ij")
    rays = torch.stack([-up.cos() * turn.cos(), -up.cos() * turn.sin(), up.sin()], dim=-1).flatten(0, 1)
    return torch.zeros_like(rays), rays


@configclass
class GridPatternCfg:
    """Settings of parallel rays that start on a grid."""

    func: Any = grid_pattern
    resolution: float = MISSING
    size: Any = MISSING
    direction: Any = (0.0, 0.0, -1.0)
    ordering: str = "xy"


@configclass
class LidarPatternCfg:
    """Settings of the rays of a lidar, which start in one point."""

    func: Any = lidar_pattern
    channels: int = MISSING
    vertical_fov_range: Any = MISSING
    horizontal_fov_range: Any = MISSING
    horizontal_res: float = MISSING


@configclass
class BpearlPatternCfg:
    """Settings of the rays of the lidar RS-Bpearl, which start in one point."""

    func: Any = bpearl_pattern
    horizontal_fov: float = 360.0
    horizontal_res: float = 10.0
    vertical_ray_angles: Any = tuple(89.5 - 2.8125 * i for i in range(32))
