"""Saved tensors on their way back to where they came from."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor


def require_alike(saved: Mapping[str, Tensor], own: Mapping[str, Tensor], what: str) -> None:
    """What is copied must be of the shape and the type of where it goes: `copy_` would repeat or round it.

    Args:
        saved: what was read.
        own: where it goes; names that only one of both has are passed over.
        what: the part that was read, for the message.

    Raises:
        ValueError: naming the first tensor that differs.
    """
    for name, value in own.items():
        found = saved.get(name)
        if found is not None and (found.shape != value.shape or found.dtype != value.dtype):
            raise ValueError(f"{what}: '{name}' is {_text(found)}, expected {_text(value)}")


def require_within(value: Tensor, low: int, high: int, what: str) -> None:
    """Integers that select something must select what is there.

    Raises:
        ValueError: naming them.
    """
    if value.numel() and not bool(((value >= low) & (value <= high)).all()):
        raise ValueError(f"'{what}' is {int(value.min())} to {int(value.max())}, allowed is {low} to {high}")


def _text(value: Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
