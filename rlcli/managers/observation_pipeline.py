"""Pipeline of an observation term: operations on its value before the policy receives it.

The order is modifiers, noise, bias, clip, scale, delay, history. Each operation changes the values of all environments
in place. Filters, delays and histories do not advance while a final observation is computed (`advance` is false).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.config import schema
from rlcli.managers.term_binding import BoundTerm, CheckedTerm, EnvContext, resets
from rlcli.sim.env_selection import Selection, in_place

Draws = Callable[[np.uint64], Selection]
"""Function from a random stream to a selection of all environments, with that stream's numbers of the current step."""
Sampler = Callable[[Selection], Tensor]
"""Function that draws random values for a selection, one row for each of its environments."""

_BIAS, _LAG, _REDRAW, _REDRAWN = (np.uint64(0x4F42_5330 + i) for i in range(4))
"""Numbers from which a term gets separate random streams for its bias and its delay: stream xor number."""

_FEW_COLUMNS = 64
"""Largest number of columns for which copying the rows of 512 environments is faster than selecting a few rows."""


class Stage:
    """Base class of the operations on an observation term's value: noise, scale, delay ..."""

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Change the value (num_envs, k) in place.

        Args:
            value: values of all environments.
            draws: function from a random stream to a selection of all environments.
            fresh: environments whose episode has just begun; None: no environment.
            advance: whether histories, delays and filters advance by a step.
        """
        raise NotImplementedError

    def reset(self, selection: Selection) -> None:
        """Clear values of earlier episodes, such as past inputs of a filter, in the selected environments."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that the operation keeps from step to step, by name, to save them."""
        return {}


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
            self._stages.append(_Noise(self._sampler("noise", config.noise), config.noise.operation, term.stream))
        if group.enable_corruption and config.bias is not None:
            sampler = self._sampler("bias", config.bias)
            self._stages.append(_Bias(sampler, config.bias.operation, term.stream, self._zeros(width)))
        if config.clip is not None:
            self._stages.append(_Clip(self._setting("clip", config.clip)))
        if config.scale is not None:
            self._stages.append(_Constant("scale", self._columns("scale", config.scale)))
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
            return _Clip(config.bounds)
        if isinstance(config, schema.IntegratorModifierConfig):
            return _Integrator(self._zeros(2, self.width), self._context.step_dt)
        if isinstance(config, schema.DigitalFilterModifierConfig):
            return _DigitalFilter(self._zeros(len(config.a) + len(config.b) - 1, self.width), config)
        if config.kind == "scale":
            return _Constant("scale", self._columns(f"{key}.factor", config.factor))
        return _Constant("add", self._columns(f"{key}.offset", config.offset))

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


_OPERATIONS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "add": Tensor.add_,
    "scale": Tensor.mul_,
    "set": Tensor.copy_,
}


class _Noise(Stage):
    def __init__(self, sampler: Sampler, operation: str, stream: np.uint64) -> None:
        self._sampler, self._operation, self._stream = sampler, _OPERATIONS[operation], stream

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        self._operation(value, self._sampler(draws(self._stream)))


class _Constant(Stage):
    """Scaling by a factor, or addition of an offset; a curriculum may change this number."""

    def __init__(self, operation: str, operand: Tensor) -> None:
        self._operation, self._operand = _OPERATIONS[operation], operand

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        self._operation(value, self._operand)


class _Bias(_Constant):
    """Bias that is sampled once for each episode, and added to the value (or multiplied with it, ...) in each step."""

    def __init__(self, sampler: Sampler, operation: str, stream: np.uint64, bias: Tensor) -> None:
        super().__init__(operation, bias)
        self._sampler, self._stream = sampler, stream ^ _BIAS

    def reset(self, selection: Selection) -> None:
        selection.write(self._operand, self._sampler(selection.stream(self._stream)))

    def tensors(self) -> dict[str, Tensor]:
        return {"bias": self._operand}


class _Clip(Stage):
    def __init__(self, bounds: Iterable[float] | Tensor) -> None:
        self._bounds = bounds  # a pair, or a tensor of two

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        low, high = self._bounds
        value.clamp_(low, high)


class _Filter(Stage):
    """Base class of filters, with m values of earlier steps: `past` (num_envs, m, k), 0 at the start of an episode."""

    _past: Tensor

    def reset(self, selection: Selection) -> None:
        selection.write(self._past, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        return {"past": self._past}


class _DigitalFilter(_Filter):
    """Linear filter. `past`: earlier inputs, then earlier outputs, the newest first in each. (num_envs, m, k)"""

    def __init__(self, past: Tensor, config: schema.DigitalFilterModifierConfig) -> None:
        self._past, self._inputs = past, len(config.b) - 1
        self._now = config.b[0]
        self._weights = [*config.b[1:], *(-a for a in config.a)]

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        raw = value.clone()
        value.mul_(self._now)
        for weight, before in zip(self._weights, self._past.unbind(1), strict=True):
            value.add_(before, alpha=weight)
        if advance and self._weights:
            inputs = [raw, *self._past[:, : self._inputs].unbind(1)][: self._inputs]
            outputs = [value, *self._past[:, self._inputs :].unbind(1)][: len(self._weights) - self._inputs]
            self._past.copy_(torch.stack([*inputs, *outputs], dim=1))


class _Integrator(_Filter):
    """Integral by the trapezoidal rule. `past`: the integral and the last input. (num_envs, 2, k)"""

    def __init__(self, past: Tensor, step_dt: float) -> None:
        self._past, self._half_step = past, 0.5 * step_dt

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        integral, before = self._past.unbind(1)
        raw = value.clone()
        value.add_(before).mul_(self._half_step).add_(integral)
        if advance:
            self._past.copy_(torch.stack([value, raw], dim=1))


class Delay(Stage):
    """Delay of a few steps. `frames`: the last values, the oldest first. (num_envs, n, k)"""

    def __init__(self, steps: tuple[int, int], redraw: float, stream: np.uint64, frames: Tensor) -> None:
        self._low, high = steps
        self._options, self._redraw, self._stream = high - self._low + 1, redraw, stream
        self._frames = frames
        self._lag = torch.full((len(frames),), self._low, dtype=torch.int64, device=frames.device)

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Replace the value with the value from as many steps ago as the delay."""
        frames = torch.cat([self._frames[:, 1:], value[:, None]], dim=1)
        if fresh is not None:
            fresh.write(frames, fresh.read_view(value)[:, None].expand(-1, frames.shape[1], -1))
        if advance:
            self._frames.copy_(frames)
            if self._redraw:
                redrawn = draws(self._stream ^ _REDRAW).uniform(0.0, 1.0) < self._redraw
                self._lag.copy_(torch.where(redrawn, self._sample(draws(self._stream ^ _REDRAWN)), self._lag))
        # the last frame is the newest; `lag` frames before it is what the policy gets
        index = (frames.shape[1] - 1 - self._lag)[:, None, None].expand(-1, 1, value.shape[1])
        value.copy_(frames.gather(1, index)[:, 0])

    def _sample(self, selection: Selection) -> Tensor:
        return selection.choice(self._options) + self._low

    def reset(self, selection: Selection) -> None:
        """Draw the delays of new episodes."""
        selection.write(self._lag, self._sample(selection.stream(self._stream ^ _LAG)))

    def empty(self, selection: Selection) -> None:
        """Start new episodes: draw their delays, and set the past values to 0."""
        self.reset(selection)
        selection.write(self._frames, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the past values and the delays."""
        return {"frames": self._frames, "lag": self._lag}


def make_delay(term: BoundTerm, width: int, context: EnvContext) -> Delay | None:
    """Return the delay of an observation or action term; None if the term has no delay, or a delay of 0 steps.

    Raises:
        ShapeError: for a delay in seconds that is not a multiple of the control period `step_dt` [s].
    """
    config: schema.DelayConfig | None = term.config.delay  # type: ignore[attr-defined]
    if config is None:
        return None
    try:
        steps = config.step_range(context.step_dt)
    except ValueError as error:
        raise term.error(str(error), "delay") from None
    frames = context.zeros(steps[1] + 1, width)
    return Delay(steps, config.redraw, term.stream, frames) if steps[1] else None
