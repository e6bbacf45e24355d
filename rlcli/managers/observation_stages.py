"""Operations on the value of an observation term: modifiers, noise, bias, clip, scale and delay.

`rlcli.managers.observation_pipeline` applies the operations. Each changes the values of all environments in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor

from rlcli.config import schema
from rlcli.managers.term_binding import BoundTerm, EnvContext
from rlcli.sim.env_selection import Selection

Draws = Callable[[np.uint64], Selection]
"""Function from a random stream to a selection of all environments, with that stream's numbers of the current step."""
Sampler = Callable[[Selection], Tensor]
"""Function that draws random values for a selection, one row for each of its environments."""

_BIAS, _LAG, _REDRAW, _REDRAWN = (np.uint64(0x4F42_5330 + i) for i in range(4))
"""Numbers from which a term gets separate random streams for its bias and its delay: stream xor number."""


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


_OPERATIONS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "add": Tensor.add_,
    "scale": Tensor.mul_,
    "set": Tensor.copy_,
}


class Noise(Stage):
    """Noise that is sampled in each step."""

    def __init__(self, sampler: Sampler, operation: str, stream: np.uint64) -> None:
        self._sampler, self._operation, self._stream = sampler, _OPERATIONS[operation], stream

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Add the noise to the value (or multiply with it, ...)."""
        self._operation(value, self._sampler(draws(self._stream)))


class Constant(Stage):
    """Scaling by a factor, or addition of an offset; a curriculum may change this number."""

    def __init__(self, operation: str, operand: Tensor) -> None:
        self._operation, self._operand = _OPERATIONS[operation], operand

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Scale the value, or add the offset."""
        self._operation(value, self._operand)


class Bias(Constant):
    """Bias that is sampled once for each episode, and added to the value (or multiplied with it, ...) in each step."""

    def __init__(self, sampler: Sampler, operation: str, stream: np.uint64, bias: Tensor) -> None:
        super().__init__(operation, bias)
        self._sampler, self._stream = sampler, stream ^ _BIAS

    def reset(self, selection: Selection) -> None:
        """Sample the bias of new episodes."""
        selection.write(self._operand, self._sampler(selection.stream(self._stream)))

    def tensors(self) -> dict[str, Tensor]:
        """Return the bias."""
        return {"bias": self._operand}


class Clip(Stage):
    """Clamp of all values to two bounds."""

    def __init__(self, bounds: Iterable[float] | Tensor) -> None:
        self._bounds = bounds  # a pair, or a tensor of two

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Clamp the value."""
        low, high = self._bounds
        value.clamp_(low, high)


class _Filter(Stage):
    """Base class of filters, with m values of earlier steps: `past` (num_envs, m, k), 0 at the start of an episode."""

    _past: Tensor

    def reset(self, selection: Selection) -> None:
        selection.write(self._past, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        return {"past": self._past}


class DigitalFilter(_Filter):
    """Linear filter. `past`: earlier inputs, then earlier outputs, the newest first in each. (num_envs, m, k)"""

    def __init__(self, past: Tensor, config: schema.DigitalFilterModifierConfig) -> None:
        self._past, self._inputs = past, len(config.b) - 1
        self._now = config.b[0]
        self._weights = [*config.b[1:], *(-a for a in config.a)]

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Replace the value with the output of the filter."""
        raw = value.clone()
        value.mul_(self._now)
        for weight, before in zip(self._weights, self._past.unbind(1), strict=True):
            value.add_(before, alpha=weight)
        if advance and self._weights:
            inputs = [raw, *self._past[:, : self._inputs].unbind(1)][: self._inputs]
            outputs = [value, *self._past[:, self._inputs :].unbind(1)][: len(self._weights) - self._inputs]
            self._past.copy_(torch.stack([*inputs, *outputs], dim=1))


class Integrator(_Filter):
    """Integral by the trapezoidal rule. `past`: the integral and the last input. (num_envs, 2, k)"""

    def __init__(self, past: Tensor, step_dt: float) -> None:
        self._past, self._half_step = past, 0.5 * step_dt

    def __call__(self, value: Tensor, draws: Draws, fresh: Selection | None, advance: bool) -> None:
        """Replace the value with its integral since the start of the episode."""
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
