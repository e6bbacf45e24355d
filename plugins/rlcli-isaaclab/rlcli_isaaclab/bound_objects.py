"""Objects of the user's classes, such as commands, as terms of rlcli in one environment."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rlcli.sim.env_selection import Selection
from rlcli_isaaclab.utils.buffers import set_tensors, tensors_of


class BoundObject:
    """Base class of terms in one environment that have an object of the user's class, and save its tensors."""

    term: Any

    def reset(self, selection: Selection) -> None:
        """Reset the user's object in the environments whose episode starts."""
        if hasattr(self.term, "reset"):
            self.term.reset(selection.env_ids())

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors of the user's object, by the path of the attribute."""
        return {name: value.clone() for name, value in tensors_of(self.term).items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        set_tensors(self.term, state)


class BoundCommand(BoundObject):
    """Command term in one environment that runs an object of the user's class, a `CommandTerm`."""

    def __init__(self, term: Any, managed: Any, name: str) -> None:
        self.term, self._managed, self._name = term, managed, name
        self.command, self._has_command = term.command.clone().float(), False
        self.elements, self.units = getattr(term, "elements", None), getattr(term, "units", ())
        self._counted = term.time_left.clone()
        self._is_new = torch.zeros_like(self._counted, dtype=torch.bool)

    @property
    def limits(self) -> Any:
        """Usual [low, high] of each column of the command, if the user's class has them."""
        return getattr(self.term, "limits", ())

    def reset(self, selection: Selection) -> None:
        """Call the user's `reset`, which samples the first commands of new episodes."""
        env_ids = selection.env_ids()
        self.term.rlcli_draws_time = True
        found = self.term.reset(env_ids)
        if isinstance(found, dict) and found.keys() - self.term.metrics.keys():
            self._managed.task_log.call_reset(lambda: self._log(found))
        self._is_new[env_ids] = True

    def _log(self, found: dict[str, Any]) -> None:
        """Log the values that the user's `reset` returned in addition to the metrics."""
        log = self.term._env.extras.setdefault("log", {})
        new = {name: value for name, value in found.items() if name not in self.term.metrics}
        log.update({f"Metrics/{self._name}/{name}": value for name, value in new.items()})

    def resample(self, selection: Selection) -> None:
        """Sample new commands in the selected environments, except those that `reset` has just sampled."""
        if not self.term.rlcli_draws_time:
            self.term.rlcli_draws_time = True
            self.term._resample(selection.env_ids())
        self.term.rlcli_draws_time = False
        self._read_time()
        self.command.copy_(self.term.command)
        self._has_command = True

    def compute(self, count: Callable[[], None]) -> None:
        """Call the user's `compute` once per environment step; `count` counts the step and resamples."""
        self.term.rlcli_timer = functools.partial(self._run_timer, count)
        self.term.compute(self._managed.step_dt)
        self._write_time()
        self.command.copy_(self.term.command)

    def _run_timer(self, count: Callable[[], None]) -> None:
        self._write_time()
        if self._is_new.any():
            self._update_new_metrics()
        count()
        self._read_time()

    def _update_new_metrics(self) -> None:
        """Update the metrics of the episodes that have just begun; `metrics` has updated those of the others."""
        before = {name: value.clone() for name, value in self._tensors().items()}
        self.term._update_metrics()
        for name, now in self._tensors().items():
            value = before.get(name, now)
            if value is not now and value.shape == now.shape:
                by_env = value.dim() > 0 and len(value) == len(self._is_new)
                rows = self._is_new.view(-1, *[1] * (value.dim() - 1)) if by_env else self._is_new[:0].any()
                now.copy_(torch.where(rows, now, value))
        self._is_new.zero_()

    def _tensors(self) -> dict[str, Tensor]:
        metrics = {f"metrics.{name}": value for name, value in self.term.metrics.items() if isinstance(value, Tensor)}
        return tensors_of(self.term) | metrics

    def _read_time(self) -> None:
        self.term.time_left = self._managed.command_manager.time_left(self._name).float()
        self._counted = self.term.time_left.clone()

    def _write_time(self) -> None:
        """Copy times that the user's code has written to `time_left` to the command manager."""
        is_written = self.term.time_left != self._counted
        self._managed.command_manager.set_time_left(self._name, is_written, self.term.time_left)
        self._counted = self.term.time_left.clone()

    def metrics(self) -> dict[str, Tensor]:
        """Return the metrics that the user's class computes, by name. (num_envs,) each"""
        if self._has_command:  # before the first command is sampled, the metrics have no meaning
            self.term._update_metrics()
        return dict(self.term.metrics)

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        super().load_state_dict(state)
        self._counted = self.term.time_left.clone()
        self._has_command = True
