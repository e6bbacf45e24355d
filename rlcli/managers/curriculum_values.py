"""Settings that a curriculum changes, such as weights, ranges and limits: each is a tensor that terms read at each use.

A curriculum can therefore change the settings on a GPU, also in a step that is captured as a CUDA graph.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli.config.layers import parse_address
from rlcli.config.schema import StrictModel, TaskConfig, TermConfig
from rlcli.config.strict_yaml import Path
from rlcli.errors import did_you_mean, listing
from rlcli.scene.names import NameProblem

_SECTIONS = ("rewards", "terminations", "commands", "events", "observations", "actions")
_FIXED = {
    *("min_steps_between", "axes", "func", "mode", "time_out", "while_alive", "history", "delay", "modifiers"),
    *("interval_range_s", "resampling_time_s"),
}
"""Settings of terms that a curriculum cannot change, because they are read only once."""


class TunableValues:
    """Tensors of the settings that a curriculum changes, by the path of the setting."""

    def __init__(self, task: TaskConfig, device: torch.device) -> None:
        self._task, self._device = task, device
        self._tensors: dict[Path, Tensor] = {}

    def __contains__(self, path: Path) -> bool:
        return path in self._tensors

    def get(self, path: Path, default: object = None) -> Any:
        """Return the tensor of a setting that may change, else `default`."""
        return self._tensors.get(path, default)

    def make_changeable(self, address: str) -> Tensor:
        """Return the float32 tensor that replaces the fixed value of a setting, so that a curriculum can change it.

        The tensor has the shape of the setting: () for a number, (2,) for a range. The tensor of one element is a view
        of shape () into the setting's tensor. Terms that are created after this call read the tensor.

        Args:
            address: dotted path of the setting, such as `rewards.alive.weight`, or of an element, `events.a.range.0`.

        Raises:
            NameProblem: if the address does not name a number, or a list of numbers, that may change.
        """
        path = parse_address(address)
        value: Any = self._task
        for depth, key in enumerate(path):
            names = _names(value)
            if depth == 0:
                names = [name for name in names if name in _SECTIONS]
            elif isinstance(value, TermConfig):
                names = [name for name in names if name not in _FIXED]
            if key not in names:
                where = f"'{'.'.join(path[:depth])}' has" if depth else "the task has"
                names = [name for name in names if _may_change(_member(value, name))]
                near = did_you_mean(key, names)
                have = f"settings that may change there: {listing(names)}" if names else None
                hint = f"{near}; {have}" if near and have else near or have
                raise NameProblem(
                    f"a curriculum cannot change '{address}': {where} no setting '{key}' that may change", hint
                )
            value = _member(value, key)
            if _is_numeric(value):
                try:
                    return self._tensor(path[: depth + 1], value)[tuple(int(index) for index in path[depth + 1 :])]
                except (ValueError, IndexError):
                    rest = ".".join(path[depth + 1 :])
                    message = f"a curriculum cannot change '{address}': the setting has no element '{rest}'"
                    raise NameProblem(message) from None
        raise NameProblem(f"a curriculum cannot change '{address}', which is neither a number nor a list of numbers")

    def _tensor(self, path: Path, value: object) -> Tensor:
        if path not in self._tensors:
            self._tensors[path] = torch.tensor(value, dtype=torch.float32, device=self._device)
        return self._tensors[path]

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors of the changeable settings, by the dotted path of the setting."""
        return {".".join(map(str, path)): tensor for path, tensor in self._tensors.items()}


def _names(value: object) -> list[str]:
    if isinstance(value, StrictModel):
        return [*type(value).model_fields, *(value.model_extra or {})]
    return list(value) if isinstance(value, dict) else []


def _member(value: Any, key: str) -> Any:
    return getattr(value, key) if isinstance(value, StrictModel) else value[key]


def _may_change(value: object) -> bool:
    """Return whether a value is a number or contains one."""
    return _is_numeric(value) or any(_may_change(_member(value, name)) for name in _names(value))


def _is_numeric(value: object) -> bool:
    """Return whether a value is a number or a list of numbers."""
    if isinstance(value, list | tuple):
        return bool(value) and all(_is_numeric(item) for item in value)
    return isinstance(value, int | float) and not isinstance(value, bool)
