"""The state of optimisers as the flat tensors of a checkpoint; for authors of trainers."""

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
    """torch's Adam with the same results, which does not import torch's compiler.

    The first instance of torch's own class imports the compiler, which takes as long as importing torch, to keep it out
    of four methods and to break its graphs around the step. rlcli compiles none of them.
    """

    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)


def below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names start with `prefix`, under their names without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def optimizer_tensors(optimizer: torch.optim.Optimizer, prefix: str) -> dict[str, Tensor]:
    """Return a copy of an optimiser's state, as PREFIX + index of the parameter + "." + slot."""
    return {
        f"{prefix}{number}.{slot}": torch.as_tensor(value).clone()
        for number, slots in optimizer.state_dict()["state"].items()
        for slot, value in slots.items()
        if value is not None
    }


def load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], prefix: str) -> None:
    """Restore an optimiser's state from the tensors of a checkpoint; its settings stay.

    Raises:
        ValueError: with the first value that is missing or of another shape.
    """
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in below(tensors, prefix).items():
        number, slot = name.split(".")
        state.setdefault(int(number), {})[slot] = value.clone()
    _require_slots(optimizer, state)
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def _require_slots(optimizer: torch.optim.Optimizer, state: Mapping[int, Mapping[str, Tensor]]) -> None:
    """Check the shapes of an optimiser's state, which torch itself checks only in the next step."""
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
