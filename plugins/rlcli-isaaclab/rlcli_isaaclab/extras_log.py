"""Values that a task logs in `env.extras["log"]`, as Isaac Lab's tasks do, as metrics of rlcli."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli_isaaclab.missing_names import report_once

_KEYS = ("log", "episode")
"""Keys of `extras` whose values the runners of RSL-RL log."""
_NOT_LOGGED = ("time_outs", "observations")
"""Other keys of `extras` that have a meaning in Isaac Lab; rlcli has these values already."""
_OWN_GROUPS = ("Train", "Eval", "Sim", "Loss", "Perf", "Policy", "Success", "Success_Value", "Curriculum")
"""Groups of metrics that rlcli computes itself."""


class ExtrasLog:
    """Logged values of one environment: means over the steps of a training iteration, as RSL-RL's runner logs them.

    A value that `_reset_idx` or a reset event writes describes the episodes that have just ended. All other values
    describe the step.

    Args:
        extras: function that returns the task's `extras`.
        own: names of metrics that rlcli computes for this task.
    """

    def __init__(self, extras: Callable[[], Mapping[str, Any]], own: tuple[str, ...] = ()) -> None:
        self._extras, self._own = extras, own
        self._sums: dict[str, Tensor] = {}
        self._counts: dict[str, int] = {}
        self._of_reset: set[str] = set()

    def call_reset(self, reset: Callable[[], Any]) -> Any:
        """Call a function that resets environments; return its result, and note which values it logs."""
        before = dict(self._raw())
        result = reset()
        self._of_reset |= {name for name, value in self._raw() if before.get(name) is not value}
        return result

    def end_step(self) -> None:
        """Add the present values to the means of this iteration."""
        for name, value in self._values().items():
            mean = value.detach().float().mean()
            self._sums[name] = self._sums[name] + mean if name in self._sums else mean
            self._counts[name] = self._counts.get(name, 0) + 1

    def iteration_means(self) -> dict[str, Tensor]:
        """Return the means over the steps since the last call, by the name of the metric. () each"""
        found = {name: total / self._counts[name] for name, total in self._sums.items()}
        self._sums, self._counts = {}, {}
        return found

    def step_values(self, num_envs: int) -> dict[str, Tensor]:
        """Return the values of this step for each environment, without those that a reset logs. (num_envs,) each"""
        return {name: _rows(value, num_envs) for name, value in self._values().items() if name not in self._of_reset}

    def reset_values(self, num_envs: int) -> dict[str, Tensor]:
        """Return the values that the last reset logged, for each environment. (num_envs,) each"""
        return {name: _rows(value, num_envs) for name, value in self._values().items() if name in self._of_reset}

    def _raw(self) -> Iterator[tuple[str, Any]]:
        """Yield the logged values by the name of the metric; report other entries of `extras` once."""
        for key, content in self._extras().items():
            if key in _KEYS and isinstance(content, Mapping):
                for name, value in content.items():
                    yield str(name) if "/" in str(name) else f"Episode/{name}", value
            elif key not in _NOT_LOGGED:
                report_once(f"env.extras['{key}'] is ignored: only the numbers in env.extras['log'] are logged")

    def _values(self) -> dict[str, Tensor]:
        """Return the logged numbers and tensors by the name of the metric; report others once."""
        found = {}
        for name, value in self._raw():
            if name in self._own or name.partition("/")[0] in _OWN_GROUPS:
                report_once(f"env.extras['log']['{name}'] is ignored: rlcli computes a metric of this name")
            elif isinstance(value, bool | int | float | np.number):
                found[name] = torch.tensor(float(value))
            elif isinstance(value, Tensor) and value.numel():
                found[name] = value
            elif not isinstance(value, Tensor):
                kind = type(value).__name__
                report_once(f"env.extras['log']['{name}'] is ignored: expected a number or a tensor, found a {kind}")
        return found


def _rows(value: Tensor, num_envs: int) -> Tensor:
    """Return a value as one number for each environment. (num_envs,)"""
    value = value.detach().float()
    if value.shape[:1] == (num_envs,):
        return value.reshape(num_envs, -1).mean(dim=1)
    return value.mean().expand(num_envs)
