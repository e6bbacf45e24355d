"""Curriculum terms: schedules by training steps (classes with `advance`), and terms that use the ended episodes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Address, Command
from rlcli.mdp.term import EntityTerm, Term
from rlcli.sim.env_selection import Selection


@dataclass(kw_only=True, eq=False)
class Stages(Term):
    """Schedule that changes a setting (`address`) in stages: at step number `steps[i]` the setting becomes `values[i]`.

    address: path of the setting, such as `rewards.alive.weight`. Before step `steps[0]` the setting has its configured
    value. `steps` are numbers of calls of `env.step` since the training began, in rising order. Isaac Lab:
    modify_reward_weight, modify_env_param, modify_term_cfg; mjlab: reward_curriculum, termination_curriculum,
    commands_vel.
    """

    address: Address
    steps: list[int]
    values: list[float] | list[list[float]] | list[list[list[float]]]

    def __post_init__(self) -> None:
        if len(self.steps) != len(self.values) or not self.steps or sorted(self.steps) != self.steps:
            raise ValueError("give steps and values as lists of equal length, with steps in rising order")
        self._steps = torch.tensor(self.steps, device=self.env.device)
        table = torch.tensor(self.values, dtype=torch.float32, device=self.env.device)
        _require_shape("each value", table.shape[1:], self.address)
        self._values = torch.cat([self.address[None].clone(), table])

    def advance(self, step: Tensor) -> Tensor:
        """Set the setting at `address` to its value at this training step, and return the value. step () int64"""
        number = torch.bucketize(step, self._steps, right=True)
        # index_select: indexing with a tensor would read the number on the host
        self.address.copy_(self._values.index_select(0, number[None])[0])
        return self.address


@dataclass(kw_only=True, eq=False)
class Interpolate(Term):
    """Schedule that moves a setting (`address`) linearly from its configured value to `to`.

    address: path of the setting, such as `rewards.alive.weight`. The change starts at step `begin` and is complete at
    step `end`, both counted in calls of `env.step` since the training began. Lists are interpolated element by element.
    """

    address: Address
    to: float | list[float] | list[list[float]]
    begin: int = 0
    end: int

    def __post_init__(self) -> None:
        if self.end <= self.begin:
            raise ValueError(f"end ({self.end}) must be above begin ({self.begin}): raise end")
        self._from = self.address.clone()
        self._to = torch.tensor(self.to, dtype=torch.float32, device=self.env.device)
        _require_shape("'to'", self._to.shape, self.address)

    def advance(self, step: Tensor) -> Tensor:
        """Set the setting at `address` to its value at this training step, and return the value. step () int64"""
        fraction = ((step - self.begin).float() / (self.end - self.begin)).clamp(0.0, 1.0)
        self.address.copy_(self._from + fraction * (self._to - self._from))
        return self.address


@dataclass(kw_only=True, eq=False)
class TerrainLevels(EntityTerm):
    """Terrain difficulty (level): robots that walk far move up, those that walk little down. -> levels (num_envs,)

    d is the horizontal distance of the robot from the environment's origin at the end of an episode. The robot moves up
    one level if d exceeds half the length of a terrain patch along x. Else the robot moves down if d is below half of
    commanded speed x episode_length_s (`command`: a velocity, x and y first), or without a command below `least` [m]. A
    robot that moves up from the last level gets a random level.

    Isaac Lab: terrain_levels_vel.
    """

    command: Command | None = None
    least: float = 0.0

    def __post_init__(self) -> None:
        if self.env.terrain is None:
            raise ValueError("the scene has no terrain; add scene.terrain")
        self._terrain = self.env.terrain
        self._half_patch = 0.5 * self._terrain.patch[0]
        self._half_episode = 0.5 * self.env.max_episode_length * self.env.step_dt

    def __call__(self, selection: Selection) -> Tensor:
        """Change the levels of the selected environments, whose episodes end. -> levels (num_envs,)"""
        offset = selection.read_view(self.entity.data.root_pos_w) - selection.read_view(self.env.origins)
        distance = _length_xy(offset)
        up = distance > self._half_patch
        if self.command is None:
            down = distance < self.least
        else:
            down = distance < _length_xy(selection.read_view(self.command.command)) * self._half_episode
        self._terrain.move(selection, up, down)
        return self._terrain.levels


def _require_shape(what: str, shape: torch.Size, address: Tensor) -> None:
    if shape != address.shape:
        wanted = tuple(address.shape)
        raise ValueError(f"{what} has shape {tuple(shape)}; give shape {wanted}, the shape of the setting at `address`")


def _length_xy(vector: Tensor) -> Tensor:
    x, y = vector[:, 0], vector[:, 1]
    return (x * x + y * y).sqrt()
