"""What is done to an observation term's value before the policy sees it.

Modifiers, noise, bias, clip, scale, delay, history: in this order, each in place on the value of all environments.
Whatever has a memory stands still while the last observation of a finished episode is computed (`advance` false).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import (
    ClipModifierConfig,
    ConstantNoiseConfig,
    DelayConfig,
    DigitalFilterModifierConfig,
    GaussianNoiseConfig,
    IntegratorModifierConfig,
    ModifierConfig,
    NoiseConfig,
    ObservationConfig,
    ObservationGroupConfig,
    UniformNoiseConfig,
)
from rlcli.managers.term import BoundTerm, resets
from rlcli.managers.tunable import TunableValues
from rlcli.sim.selection import Selection

Draws = Callable[[np.uint64], Selection]
"""All environments, drawing from a stream by the step's counter."""

_BIAS, _LAG, _REDRAW, _REDRAWN = (np.uint64(0x4F42_5330 + i) for i in range(4))
"""Streams of a term besides its own."""


class Stage:
    """One thing that is done to a term's value."""

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Change the value (num_envs, k) in place.

        `fresh` are the environments whose episode has just begun; None: none, as far as the host knows.
        """
        raise NotImplementedError

    def reset(self, selection: Selection) -> None:
        """Start new episodes."""

    def tensors(self) -> dict[str, Tensor]:
        """Return what the stage carries from step to step; written to in place."""
        return {}


class Pipeline:
    """The stages of one term, and where its columns lie."""

    def __init__(
        self,
        term: BoundTerm,
        shape: tuple[int, ...],
        group: ObservationGroupConfig,
        num_envs: int,
        step_dt: float,
        device: torch.device,
        tunable: TunableValues,
    ) -> None:
        config = term.config
        assert isinstance(config, ObservationConfig)
        self.term = term
        self.shape = shape
        """Of the term's value in one environment; its columns are these numbers row by row."""
        self.width = width = math.prod(shape)
        self.history = group.history or config.history or 1
        make = _Maker(term, width, num_envs, step_dt, device, tunable)
        self._stages: list[Stage] = [make.modifier(number, m) for number, m in enumerate(config.modifiers)]
        if group.enable_corruption and config.noise is not None:
            self._stages.append(make.noise(config.noise))
        if group.enable_corruption and config.bias is not None:
            self._stages.append(make.bias(config.bias))
        if config.clip is not None:
            self._stages.append(_Clip(make.tunable("clip", config.clip)))
        if config.scale is not None:
            self._stages.append(_Scale(make.columns("scale", config.scale)))
        if group.enable_corruption and config.delay is not None and config.delay.steps[1]:
            self._stages.append(_Delay(config.delay, term.stream, num_envs, width, device))
        self._frames = torch.zeros(num_envs, self.history * width, device=device) if self.history > 1 else None
        self._value = torch.zeros(num_envs, width, device=device) if self.history > 1 else None

    @property
    def size(self) -> int:
        """Columns in the group."""
        return self.width * self.history

    @property
    def has_memory(self) -> bool:
        """Whether what it gives depends on earlier steps."""
        return bool(self.tensors())

    def write(self, view: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Compute the term into its columns. view (num_envs, size)"""
        value = view if self._value is None else self._value
        given = self.term.call()
        value.copy_(given if given.dim() == 2 else given.reshape(value.shape))
        for stage in self._stages:
            stage(value, draws, fresh, advance)
        if self._frames is not None:
            view[:, : -self.width].copy_(self._frames[:, self.width :])
            view[:, -self.width :].copy_(value)
            if fresh is not None:
                fresh.write(view, fresh.read_view(value).repeat(1, self.history))
            if advance:
                self._frames.copy_(view)

    @property
    def resets(self) -> list[Callable[[Selection], None]]:
        """What to call with the environments that start a new episode."""
        return [*resets([self.term]), *(stage.reset for stage in self._stages if type(stage).reset is not Stage.reset)]

    def tensors(self) -> dict[str, Tensor]:
        """What it carries from step to step, by name."""
        found = {
            f"{number}.{name}": tensor
            for number, stage in enumerate(self._stages)
            for name, tensor in stage.tensors().items()
        }
        return found if self._frames is None else {**found, "history": self._frames}


class _Maker:
    """Builds the stages of a term; columns are checked against its width."""

    def __init__(
        self, term: BoundTerm, width: int, num_envs: int, step_dt: float, device: torch.device, tunable: TunableValues
    ) -> None:
        self.term, self.width, self.num_envs = term, width, num_envs
        self.step_dt, self.device, self._tunable = step_dt, device, tunable

    def tunable(self, key: str, value: object) -> Any:
        """A setting, or the tensor that a curriculum moves it in."""
        return self._tunable.get((*self.term.path, *key.split(".")), value)

    def columns(self, key: str, value: float | list[float]) -> Tensor:
        """One number for all columns, or one each. () or (width,)"""
        moved = self.tunable(key, value)
        tensor = moved if isinstance(moved, Tensor) else torch.tensor(value, dtype=torch.float32, device=self.device)
        if tensor.dim() == 1 and len(tensor) != self.width:
            raise self.term.error(f"has {len(tensor)} values for {self.width} columns", *key.split("."))
        return tensor

    def noise(self, config: NoiseConfig) -> Stage:
        return _Noise(self._drawn("noise", config), config.operation, self.term.stream)

    def bias(self, config: NoiseConfig) -> Stage:
        bias = torch.zeros(self.num_envs, self.width, device=self.device)
        return _Bias(self._drawn("bias", config), config.operation, self.term.stream, bias)

    def modifier(self, number: int, config: ModifierConfig) -> Stage:
        key = f"modifiers.{number}"
        if isinstance(config, ClipModifierConfig):
            return _Clip(config.bounds)
        if isinstance(config, IntegratorModifierConfig):
            return _Integrator(torch.zeros(self.num_envs, 2, self.width, device=self.device), self.step_dt)
        if isinstance(config, DigitalFilterModifierConfig):
            past = torch.zeros(self.num_envs, len(config.a) + len(config.b) - 1, self.width, device=self.device)
            return _DigitalFilter(past, config)
        if config.kind == "scale":
            return _Scale(self.columns(f"{key}.factor", config.factor))
        return _Shift(self.columns(f"{key}.offset", config.offset))

    def _drawn(self, key: str, config: NoiseConfig) -> Callable[[Selection], Tensor]:
        """A draw of a distribution for the rows of a selection. -> (rows, width)"""
        shape = (self.width,)
        if isinstance(config, UniformNoiseConfig):
            low, high = self.columns(f"{key}.low", config.low), self.columns(f"{key}.high", config.high)
            return lambda selection: selection.uniform(low, high, shape)
        if isinstance(config, GaussianNoiseConfig):
            mean, std = self.columns(f"{key}.mean", config.mean), self.columns(f"{key}.std", config.std)
            return lambda selection: selection.normal(mean, std, shape)
        assert isinstance(config, ConstantNoiseConfig)
        value = self.columns(f"{key}.value", config.value)
        zeros = torch.zeros(self.num_envs, self.width, device=self.device)
        return lambda selection: selection.read_view(zeros) + value


def _apply(operation: str, value: Tensor, drawn: Tensor) -> None:
    if operation == "add":
        value.add_(drawn)
    elif operation == "scale":
        value.mul_(drawn)
    else:
        value.copy_(drawn)


class _Noise(Stage):
    def __init__(self, draw: Callable[[Selection], Tensor], operation: str, stream: np.uint64) -> None:
        self._draw, self._operation, self._stream = draw, operation, stream

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        _apply(self._operation, value, self._draw(draws(self._stream)))


class _Bias(Stage):
    def __init__(self, draw: Callable[[Selection], Tensor], operation: str, stream: np.uint64, bias: Tensor) -> None:
        self._draw, self._operation, self._stream, self._bias = draw, operation, stream ^ _BIAS, bias

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        _apply(self._operation, value, self._bias)

    def reset(self, selection: Selection) -> None:
        selection.write(self._bias, self._draw(selection.stream(self._stream)))

    def tensors(self) -> dict[str, Tensor]:
        return {"bias": self._bias}


class _Clip(Stage):
    def __init__(self, bounds: Iterable[float] | Tensor) -> None:
        self._bounds = bounds  # a pair, or a tensor of two

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        low, high = self._bounds
        value.clamp_(low, high)


class _Scale(Stage):
    def __init__(self, factor: Tensor) -> None:
        self._factor = factor

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        value.mul_(self._factor)


class _Shift(Stage):
    def __init__(self, offset: Tensor) -> None:
        self._offset = offset

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        value.add_(self._offset)


class _DigitalFilter(Stage):
    """`past` holds the inputs before this step, the last one first, then the outputs likewise. (num_envs, m, k)"""

    def __init__(self, past: Tensor, config: DigitalFilterModifierConfig) -> None:
        self._past, self._inputs = past, len(config.b) - 1
        self._now = config.b[0]
        self._weights = [*config.b[1:], *(-a for a in config.a)]

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        given = value.clone()
        value.mul_(self._now)
        for weight, before in zip(self._weights, self._past.unbind(1), strict=True):
            value.add_(before, alpha=weight)
        if advance and self._weights:
            inputs = [given, *self._past[:, : self._inputs].unbind(1)][: self._inputs]
            outputs = [value, *self._past[:, self._inputs :].unbind(1)][: len(self._weights) - self._inputs]
            self._past.copy_(torch.stack([*inputs, *outputs], dim=1))

    def reset(self, selection: Selection) -> None:
        selection.write(self._past, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        return {"past": self._past}


class _Integrator(Stage):
    """`past` holds the integral and the last input. (num_envs, 2, k)"""

    def __init__(self, past: Tensor, step_dt: float) -> None:
        self._past, self._half_step = past, 0.5 * step_dt

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        integral, before = self._past.unbind(1)
        given = value.clone()
        value.add_(before).mul_(self._half_step).add_(integral)
        if advance:
            self._past.copy_(torch.stack([value, given], dim=1))

    def reset(self, selection: Selection) -> None:
        selection.write(self._past, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        return {"past": self._past}


class _Delay(Stage):
    """`frames` holds the last values, the oldest first. (num_envs, n, k)"""

    def __init__(self, config: DelayConfig, stream: np.uint64, num_envs: int, width: int, device: torch.device) -> None:
        self._low, high = config.steps
        self._options, self._redraw, self._stream = high - self._low + 1, config.redraw, stream
        self._frames = torch.zeros(num_envs, high + 1, width, device=device)
        self._lag = torch.full((num_envs,), self._low, dtype=torch.int64, device=device)

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        frames = torch.cat([self._frames[:, 1:], value[:, None]], dim=1)
        if fresh is not None:
            fresh.write(frames, fresh.read_view(value)[:, None].expand(-1, frames.shape[1], -1))
        if advance:
            self._frames.copy_(frames)
            if self._redraw:
                again = draws(self._stream ^ _REDRAW).uniform(0.0, 1.0) < self._redraw
                self._lag.copy_(torch.where(again, self._drawn(draws(self._stream ^ _REDRAWN)), self._lag))
        seen = (frames.shape[1] - 1 - self._lag)[:, None, None].expand(-1, 1, value.shape[1])
        value.copy_(frames.gather(1, seen)[:, 0])

    def _drawn(self, selection: Selection) -> Tensor:
        return selection.choice(self._options) + self._low

    def reset(self, selection: Selection) -> None:
        selection.write(self._lag, self._drawn(selection.stream(self._stream ^ _LAG)))

    def tensors(self) -> dict[str, Tensor]:
        return {"frames": self._frames, "lag": self._lag}
