"""Curriculum terms: by the clock of training (classes with `advance`), or by the episodes that end (functions)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.mdp.parameters import Address, Command, Entity

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv
    from rlcli.sim.selection import Selection


class Stages:
    """The number at `address` takes each value once its step has come; before the first it is what the task says.

    `steps` are environment steps since training began, in rising order. Isaac Lab: modify_reward_weight,
    modify_env_param, modify_term_cfg; mjlab: reward_curriculum, termination_curriculum, commands_vel.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        address: Address,
        steps: list[int],
        values: list[float] | list[list[float]] | list[list[list[float]]],
    ) -> None:
        if len(steps) != len(values) or not steps or sorted(steps) != steps:
            raise ValueError("steps and values are lists of equal length, steps in rising order")
        self._live = address
        self._steps = torch.tensor(steps, device=env.device)
        table = torch.tensor(values, dtype=torch.float32, device=env.device)
        if table.shape[1:] != address.shape:
            raise ValueError(f"each value has shape {tuple(table.shape[1:])}, at the address is {tuple(address.shape)}")
        self._values = torch.cat([address[None].clone(), table])

    def advance(self, step: Tensor) -> Tensor:
        """Set the value of this step. -> the value"""
        number = torch.bucketize(step, self._steps, right=True)
        self._live.copy_(self._values.index_select(0, number[None])[0])
        return self._live


class Interpolate:
    """The number at `address` moves linearly to `to` between two steps, from what the task says. Lists do so item-wise.

    `begin` and `end` are environment steps since training began.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        address: Address,
        to: float | list[float] | list[list[float]],
        begin: int = 0,
        end: int,
    ) -> None:
        if end <= begin:
            raise ValueError("end must be above begin")
        target = torch.tensor(to, dtype=torch.float32, device=env.device)
        if target.shape != address.shape:
            raise ValueError(f"'to' has shape {tuple(target.shape)}, at the address is {tuple(address.shape)}")
        self._live, self._from, self._to = address, address.clone(), target
        self._begin, self._end = begin, end

    def advance(self, step: Tensor) -> Tensor:
        """Set the value of this step. -> the value"""
        share = ((step - self._begin).float() / (self._end - self._begin)).clamp(0.0, 1.0)
        self._live.copy_(self._from + share * (self._to - self._from))
        return self._live


class TerrainLevels:
    """A level up for who got off the middle half of its patch, down for who got less far than it should. -> the levels

    Far is half a patch along x. An episode should have covered half of what its `command` (a velocity, x and y first)
    asked for; without a command, `least` [m]. Past the last level comes a random one. Isaac Lab: terrain_levels_vel.
    """

    def __init__(
        self, env: ManagedEnv, *, entity: Entity = "robot", command: Command | None = None, least: float = 0.0
    ) -> None:
        if env.terrain is None:
            raise ValueError("the scene has no terrain; add scene.terrain")
        self._env, self._entity, self._command, self._least = env, entity, command, least
        self._far = 0.5 * env.terrain.patch[0]
        self._asked = 0.5 * env.max_episode_length * env.step_dt

    def __call__(self, selection: Selection) -> Tensor:
        """Move the environments whose episode ends. -> (num_envs,)"""
        terrain = self._env.terrain
        assert terrain is not None
        way = selection.read_view(self._entity.data.root_pos_w) - selection.read_view(self._env.origins)
        distance = _length(way)
        up = distance > self._far
        if self._command is None:
            down = distance < self._least
        else:
            down = distance < _length(selection.read_view(self._command.command)) * self._asked
        terrain.move(selection, up, down)
        return terrain.levels


def _length(vector: Tensor) -> Tensor:
    """Of the first two components."""
    x, y = vector[:, 0], vector[:, 1]
    return (x * x + y * y).sqrt()
