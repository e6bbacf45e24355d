"""Base class of objects whose state is saved as named tensors in checkpoints, and checks of saved tensors.

Managers, terms with a state and sensors derive from the base class.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


class TensorState:
    """Base class of objects whose state consists of tensors, which are restored in place."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors themselves, not copies, by their names in a checkpoint."""
        raise NotImplementedError

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors, by name."""
        return {name: tensor.clone() for name, tensor in self.tensors().items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""
        for name, tensor in self.tensors().items():
            tensor.copy_(state[name])


def mean_of(values: Tensor) -> Tensor:
    """Return the mean of all values; if all values are equal, exactly this value, without rounding. (scalar)"""
    values = values.flatten().float()
    return torch.where((values == values[0]).all(), values[0], values.mean())


def means(values: Mapping[str, Tensor]) -> dict[str, float]:
    """Return the mean of the values of each tensor as a float, by the same names."""
    return {name: float(mean_of(value)) if value.dim() else float(value) for name, value in values.items()}


def substate(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with a prefix, by their names without the prefix."""
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def require_matching_tensors(saved: Mapping[str, Tensor], own: Mapping[str, Tensor], what: str) -> None:
    """Check that saved tensors have the shapes and types of their targets: `copy_` would broadcast or round them.

    Args:
        saved: tensors of the file.
        own: tensors to which the saved ones will be copied; names that only one of the two has are ignored.
        what: the part of the file, for the message.

    Raises:
        ValueError: if a shape or type differs; the message names the first such tensor.
    """
    for name, value in own.items():
        found = saved.get(name)
        if found is not None and (found.shape != value.shape or found.dtype != value.dtype):
            raise ValueError(f"{what}: the saved '{name}' is {_text(found)}, the present task needs {_text(value)}")


def require_in_range(value: Tensor, low: int, high: int, what: str) -> None:
    """Check that saved integers are between `low` and `high`; `what` is their name in the file, for the message.

    Raises:
        ValueError: if a value is outside; the message has the smallest and the largest value.
    """
    if value.numel() and not bool(((value >= low) & (value <= high)).all()):
        found = f"{int(value.min())} to {int(value.max())}"
        raise ValueError(f"the saved '{what}' has values {found}, but must be {low} to {high}: the file is damaged")


def _text(value: Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
