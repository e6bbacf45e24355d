"""The state of optimisers and other parts of a learner as the flat tensors of a checkpoint; for authors of trainers."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

import torch
from torch import Tensor

_SLOTS = {
    "Adam": {"step", "exp_avg", "exp_avg_sq"},
    "AdamW": {"step", "exp_avg", "exp_avg_sq"},
    "RMSprop": {"step", "square_avg"},
    "SGD": {"momentum_buffer"},
}


class Adam(torch.optim.Adam):
    """torch's Adam, number for number; but the first of torch's own imports torch's compiler, which takes as long as
    torch itself, to keep it out of four methods and to break its graphs around the step. Nobody compiles these.
    """

    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)


def below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names begin so, without the beginning."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def optimizer_tensors(optimizer: torch.optim.Optimizer, prefix: str) -> dict[str, Tensor]:
    """A copy of an optimiser's state: PREFIX + number of the parameter + what it is."""
    return {
        f"{prefix}{number}.{slot}": torch.as_tensor(value).clone()
        for number, slots in optimizer.state_dict()["state"].items()
        for slot, value in slots.items()
        if value is not None
    }


def load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], prefix: str) -> None:
    """Give an optimiser its state back, out of the tensors of a checkpoint; its settings stay.

    Raises:
        ValueError: naming the first value that is missing or of another shape.
    """
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in below(tensors, prefix).items():
        number, slot = name.split(".")
        state.setdefault(int(number), {})[slot] = value.clone()
    _require_slots(optimizer, state)
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def _require_slots(optimizer: torch.optim.Optimizer, state: Mapping[int, Mapping[str, Tensor]]) -> None:
    """What an optimiser is given back must be what it steps with: it looks only when it steps."""
    owned = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for number, slots in state.items():
        if not 0 <= number < len(owned):
            raise ValueError(f"trainer: the optimiser has no parameter {number}")
        parameter = owned[number]
        missing = _SLOTS.get(type(optimizer).__name__, set()) - set(slots)
        if missing:
            raise ValueError(f"trainer: the optimiser's state of parameter {number} has no {sorted(missing)[0]}")
        for name, value in slots.items():
            expected = () if name == "step" else tuple(parameter.shape)
            if tuple(value.shape) != expected or not value.is_floating_point():
                raise ValueError(
                    f"trainer: the optimiser's {name} of parameter {number} is {value.dtype} {tuple(value.shape)},"
                    f" expected {expected}"
                )
