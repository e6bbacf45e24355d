"""Save and load the state of optimisers as named tensors, for checkpoints; and a variant of Adam that imports fast."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

import torch
from torch import Tensor

_SLOTS = {  # names of the tensors that the state of each optimiser has for a parameter
    "Adam": {"step", "exp_avg", "exp_avg_sq"},
    "AdamW": {"step", "exp_avg", "exp_avg_sq"},
    "RMSprop": {"step", "square_avg"},
    "SGD": {"momentum_buffer"},
}


class Adam(torch.optim.Adam):
    """torch's Adam, with the same results, that does not import torch's compiler.

    The first instance of torch's own class imports the compiler to exclude five methods from compilation. That import
    takes as long as importing torch. rlcli never compiles these methods, so here they are not wrapped.
    """

    step = torch.no_grad()(inspect.unwrap(torch.optim.Adam.step))
    zero_grad = inspect.unwrap(torch.optim.Adam.zero_grad)
    state_dict = inspect.unwrap(torch.optim.Adam.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Adam.load_state_dict)
    add_param_group = inspect.unwrap(torch.optim.Adam.add_param_group)


def tensors_with_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names start with `prefix`, by their names without the prefix."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def optimizer_tensors(optimizer: torch.optim.Optimizer, prefix: str) -> dict[str, Tensor]:
    """Return a copy of an optimiser's state as tensors by name.

    A name is the prefix, the index of a parameter, and the name of a value that the optimiser keeps for the parameter,
    such as `0.exp_avg` of Adam.
    """
    return {
        f"{prefix}{number}.{slot}": torch.as_tensor(value).clone()
        for number, slots in optimizer.state_dict()["state"].items()
        for slot, value in slots.items()
        if value is not None
    }


def load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], prefix: str) -> None:
    """Restore an optimiser's state from the tensors of a checkpoint; settings such as the learning rate do not change.

    Raises:
        ValueError: if a tensor is missing, has another shape, or is of a parameter that the optimiser does not have.
    """
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors_with_prefix(tensors, prefix).items():
        number, slot = name.split(".")
        state.setdefault(int(number), {})[slot] = value.clone()
    _require_slots(optimizer, state)
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def _require_slots(optimizer: torch.optim.Optimizer, state: Mapping[int, Mapping[str, Tensor]]) -> None:
    """Check the shapes of an optimiser's state; torch checks them only in the next step."""
    owned = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for number, slots in state.items():
        if not 0 <= number < len(owned):
            raise ValueError(
                f"trainer: the saved optimiser state has an entry for parameter {number} (counted from 0), but the"
                f" agent has only {len(owned)} parameters: the file is damaged, or the agent has changed"
            )
        parameter = owned[number]
        missing = _SLOTS.get(type(optimizer).__name__, set()) - set(slots)
        if missing:
            raise ValueError(
                f"trainer: the saved optimiser state of parameter {number} lacks {sorted(missing)[0]}: the file"
                " is damaged"
            )
        for name, value in slots.items():
            expected = () if name == "step" else tuple(parameter.shape)
            if tuple(value.shape) != expected or not value.is_floating_point():
                raise ValueError(
                    f"trainer: the saved optimiser state {name} of parameter {number} is {value.dtype}"
                    f" {tuple(value.shape)}, but the agent needs {expected}: the agent's networks have changed"
                )
