"""Which of the tensors that a learner computes one after the other is the first that is not finite."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from rlcli.errors import DivergedError
from rlcli.rl.policy import Normalizer
from rlcli.sim.state import is_finite

LEARNER_HINT = "lower learning_rate or max_grad_norm; the last good checkpoint is kept"


def require_finite(tensors: Iterable[tuple[str, Tensor]], iteration: int, axes: tuple[str, ...] = ()) -> None:
    """Stop at the first tensor, in causal order, with a value that is not finite.

    Args:
        tensors: what each is called, and its values.
        iteration: for the message.
        axes: what the leading axes count: `("step", "environment")`.

    Raises:
        DivergedError: naming the tensor and the place of the first such value.
    """
    for name, values in tensors:
        if is_finite(values):
            continue
        bad = ~values.isfinite()
        place = bad.nonzero()[0].tolist() if bad.dim() else []
        where = ", ".join(f"{axis} {index}" for axis, index in zip(axes, place, strict=False))
        where = where or (f"first at [{', '.join(map(str, place))}]" if place else "")
        count = f" in {int(bad.sum())} of {bad.numel()} values" if bad.numel() > 1 else ""
        raise DivergedError(
            f"{name} is not finite{count}{f' ({where})' if where else ''}, in iteration {iteration}; what comes before"
            " it is",
            hint=LEARNER_HINT,
        )


def moments(normalizers: Iterable[tuple[str, Normalizer | None]]) -> list[tuple[str, Tensor]]:
    """What normalisers have learned, by name."""
    return [
        (f"the {name} normaliser's {moment}", getattr(normalizer, moment))
        for name, normalizer in normalizers
        if normalizer is not None
        for moment in ("mean", "var", "count")
    ]


class GradientWatch:
    """Notes the first gradient that is not finite, and keeps it from the weights.

    Args:
        module: whose parameters are watched.
        optimizers: that step them.
    """

    def __init__(self, module: nn.Module, optimizers: Iterable[torch.optim.Optimizer]) -> None:
        self.first: str | None = None
        """Name of the parameter that had it; gradients come from the outputs backwards."""
        for name, parameter in module.named_parameters():
            if parameter.requires_grad:
                parameter.register_post_accumulate_grad_hook(lambda p, name=name: self._see(name, p))
        for optimizer in optimizers:
            optimizer.register_step_pre_hook(self._before_step)

    def _see(self, name: str, parameter: Tensor) -> None:
        if self.first is None and parameter.grad is not None and not is_finite(parameter.grad):
            self.first = name

    def _before_step(self, optimizer: torch.optim.Optimizer, args: object, kwargs: object) -> None:
        if self.first is not None:
            optimizer.zero_grad(set_to_none=True)  # the run ends; the weights stay those that gave it
