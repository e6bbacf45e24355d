"""Pipeline of an observation term: operations on its value before the policy receives it.

The order is modifiers, noise, bias, clip, scale, delay, history. Each operation changes the values of all environments
in place. Filters, delays and histories do not advance while a final observation is computed (`advance` is false).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.config import schema
from rlcli.managers import observation_stages as stages
from rlcli.managers.observation_stages import Draws, Sampler, Stage, make_delay
from rlcli.managers.term_binding import BoundTerm, CheckedTerm, EnvContext, resets
from rlcli.sim.env_selection import Selection, in_place

_FEW_COLUMNS = 64
"""Largest number of columns for which copying the rows of 512 environments is faster than selecting a few rows."""


class Pipeline:
    """Operations (stages) on the value of one observation term, and its history."""

    def __init__(
        self,
        term: BoundTerm,
        first: object,
        shape: tuple[int, ...],
        group: schema.ObservationGroupConfig,
        context: EnvContext,
    ) -> None:
        config = term.config
        assert isinstance(config, schema.ObservationConfig)
        self.term = term
        self._read = CheckedTerm(term, first, (context.num_envs, *shape))
        self.shape = shape
        """Shape of the term's value in one environment; the columns are its elements in row-major order."""
        self.width = width = math.prod(shape)
        self.history = group.history or config.history or 1
        self._context, self._zeros = context, context.zeros
        self._stages = [self._modifier(number, modifier) for number, modifier in enumerate(config.modifiers)]
        if group.enable_corruption and config.noise is not None:
            self._stages.append(stages.Noise(self._sampler("noise", config.noise), config.noise.operation, term.stream))
        if group.enable_corruption and config.bias is not None:
            sampler = self._sampler("bias", config.bias)
            self._stages.append(stages.Bias(sampler, config.bias.operation, term.stream, self._zeros(width)))
        if config.clip is not None:
            self._stages.append(stages.Clip(self._setting("clip", config.clip)))
        if config.scale is not None:
            self._stages.append(stages.Constant("scale", self._columns("scale", config.scale)))
        delay = make_delay(term, width, context) if group.enable_corruption else None
        self._stages += [] if delay is None else [delay]
        self._frames = self._zeros(self.history * width) if self.history > 1 else None
        self._value = self._zeros(width) if self.history > 1 else None

    @property
    def size(self) -> int:
        """Number of columns that the term has in its observation group."""
        return self.width * self.history

    @property
    def is_plain(self) -> bool:
        """Whether the pipeline only copies a few columns: to copy all rows is then faster than to select some rows."""
        return not self._stages and self.size <= _FEW_COLUMNS

    @property
    def has_memory(self) -> bool:
        """Whether the term's observation depends on earlier steps."""
        return bool(self.tensors())

    def write(self, view: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Compute the observation of the term and write it to `view`, its columns in the group. (num_envs, size)"""
        value = view if self._value is None else self._value
        raw = self._read()
        value.copy_(raw if raw.dim() == 2 else raw.reshape(value.shape))
        for stage in self._stages:
            stage(value, draws, fresh, advance)
        if self._frames is not None:
            # oldest first: drop the first frame, append the new one
            view[:, : -self.width].copy_(self._frames[:, self.width :])
            view[:, -self.width :].copy_(value)
            if fresh is not None:
                fresh.write(view, fresh.read_view(value).repeat(1, self.history))
            if advance:
                self._frames.copy_(view)

    def write_rows(self, view: Tensor, rows: Selection, salt: np.uint64) -> None:
        """Compute the observation of a term for some environments only; the term must not depend on earlier steps.

        Args:
            view: columns of the term in the observations. (num_envs, size)
            rows: the environments, and their random numbers.
            salt: number that changes the random streams (by xor), so that final observations and ordinary observations
                have different random numbers.
        """
        value = rows.read(self._read().reshape(view.shape)).float()
        for stage in self._stages:
            stage(value, lambda stream: rows.stream(stream ^ salt), None, False)
        rows.write(view, value)

    @property
    def resets(self) -> list[Callable[[Selection], None]]:
        """The functions to call with the environments that start a new episode."""
        return [*resets([self.term]), *(stage.reset for stage in self._stages if type(stage).reset is not Stage.reset)]

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that the pipeline keeps from step to step, by name."""
        found = {
            f"{number}.{name}": tensor
            for number, stage in enumerate(self._stages)
            for name, tensor in stage.tensors().items()
        }
        return found if self._frames is None else {**found, "history": self._frames}

    def _setting(self, key: str, value: object) -> Any:
        """Return `value`, the configured value of a setting; if a curriculum changes the setting, its tensor."""
        return self._context.tunable.get((*self.term.path, *key.split(".")), value)

    def _columns(self, key: str, value: float | list[float]) -> Tensor:
        """Return a setting of the term as a tensor: one value for all columns, or one for each. () or (width,)"""
        setting = self._setting(key, value)
        if not isinstance(setting, Tensor):
            setting = torch.tensor(value, dtype=torch.float32, device=self._context.device)
        if setting.dim() == 1 and len(setting) != self.width:
            raise self.term.error(
                f"{key} has {len(setting)} values; give 1, or one for each of the term's columns ({self.width})",
                *key.split("."),
            )
        return setting

    def _modifier(self, number: int, config: schema.ModifierConfig) -> Stage:
        key = f"modifiers.{number}"
        if isinstance(config, schema.ClipModifierConfig):
            return stages.Clip(config.bounds)
        if isinstance(config, schema.IntegratorModifierConfig):
            return stages.Integrator(self._zeros(2, self.width), self._context.step_dt)
        if isinstance(config, schema.DigitalFilterModifierConfig):
            return stages.DigitalFilter(self._zeros(len(config.a) + len(config.b) - 1, self.width), config)
        if config.kind == "scale":
            return stages.Constant("scale", self._columns(f"{key}.factor", config.factor))
        return stages.Constant("add", self._columns(f"{key}.offset", config.offset))

    def _sampler(self, key: str, config: schema.NoiseConfig) -> Sampler:
        """Return a function that draws noise for a selection of environments. -> (rows, width)"""
        shape = (self.width,)
        if isinstance(config, schema.UniformNoiseConfig):
            low, high = (in_place(self._columns(f"{key}.{end}", getattr(config, end))) for end in ("low", "high"))
            return lambda selection: selection.uniform(low, high, shape)
        if isinstance(config, schema.GaussianNoiseConfig):
            mean, std = self._columns(f"{key}.mean", config.mean), self._columns(f"{key}.std", config.std)
            return lambda selection: selection.normal(mean, std, shape)
        assert isinstance(config, schema.ConstantNoiseConfig)
        value = self._columns(f"{key}.value", config.value)
        zeros = self._zeros(self.width)
        return lambda selection: selection.read_view(zeros) + value
