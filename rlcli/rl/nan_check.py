"""Checks for NaN and infinity in a trainer's tensors.

Tensors are checked in the order in which they are computed. The error names the first tensor that is not finite,
because that tensor is the cause: NaN spreads to all tensors that are computed from it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping

import torch
from torch import Tensor, nn

from rlcli.errors import DivergedError
from rlcli.rl.policy import Normalizer
from rlcli.sim.state_cache import is_finite

LEARNER_HINT = "lower learning_rate or max_grad_norm; the last good checkpoint is kept"


def require_finite(
    tensors: Iterable[tuple[str, Tensor]], iteration: int, axes: tuple[str, ...] = (), hint: str = LEARNER_HINT
) -> None:
    """Check that all tensors are finite.

    Args:
        tensors: names and values, each tensor after those from which it is computed.
        iteration: index of the iteration, for the message.
        axes: names of the leading axes, for the message, such as `("step", "environment")`.
        hint: what the user can do.

    Raises:
        DivergedError: with the first tensor that is not finite, and the index of its first value that is not finite.
    """
    for name, values in tensors:
        if is_finite(values):
            continue
        bad = ~values.isfinite()
        index = bad.nonzero()[0].tolist() if bad.dim() else []
        where = ", ".join(f"{axis} {number}" for axis, number in zip(axes, index, strict=False))
        where = where or (f"first at [{', '.join(map(str, index))}]" if index else "")
        count = f" in {int(bad.sum())} of {bad.numel()} values" if bad.numel() > 1 else ""
        raise DivergedError(
            f"{name} is not finite{count}{f' ({where})' if where else ''}, in iteration {iteration}; all tensors"
            " that were computed earlier are finite",
            hint=hint,
        )


def moments(normalizers: Iterable[tuple[str, Normalizer | None]]) -> list[tuple[str, Tensor]]:
    """Return (name, value) of mean, variance and count of each normaliser, for `require_finite`.

    `normalizers` are (name, normaliser); None is skipped.
    """
    return [
        (f"the {name} normaliser's {moment}", getattr(normalizer, moment))
        for name, normalizer in normalizers
        if normalizer is not None
        for moment in ("mean", "var", "count")
    ]


def require_finite_learner(
    metrics: Mapping[str, float], modules: Mapping[str, nn.Module], iteration: int, hint: str = LEARNER_HINT
) -> None:
    """Check that the metrics of an update and all weights are finite, after the update.

    Args:
        metrics: metrics that must be finite, by name.
        modules: modules whose weights are checked, by the name for the message.
        iteration: index of the iteration, for the message.
        hint: what the user can do.

    Raises:
        DivergedError: with the first metric or weight that is not finite.
    """
    bad = [name for name, value in metrics.items() if not math.isfinite(value)]
    for part, module in modules.items():
        bad += [f"weight '{part}.{name}'" for name, value in module.named_parameters() if not is_finite(value)]
    if bad:
        raise DivergedError(f"{bad[0]} is not finite in iteration {iteration}", hint=hint)


class GradientWatch:
    """Hooks that find the first gradient that is not finite, and keep it from changing the weights.

    Args:
        module: the module whose gradients are checked.
        optimizers: optimisers of the parameters.
    """

    def __init__(self, module: nn.Module, optimizers: Iterable[torch.optim.Optimizer]) -> None:
        self.first: str | None = None
        """Name of the first parameter whose gradient was not finite, in the order of the backward pass; None: none."""
        for name, parameter in module.named_parameters():
            if parameter.requires_grad:
                hook = functools.partial(self._check, name)
                parameter.register_post_accumulate_grad_hook(hook)  # type: ignore[no-untyped-call]  # torch has no type here
        for optimizer in optimizers:
            optimizer.register_step_pre_hook(self._before_step)

    def _check(self, name: str, parameter: Tensor) -> None:
        if self.first is None and parameter.grad is not None and not is_finite(parameter.grad):
            self.first = name

    def _before_step(self, optimizer: torch.optim.Optimizer, args: object, kwargs: object) -> None:
        if self.first is not None:
            optimizer.zero_grad(set_to_none=True)  # without gradients the step changes no weight
