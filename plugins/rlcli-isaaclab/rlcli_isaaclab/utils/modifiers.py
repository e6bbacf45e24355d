"""Modifiers, which change an observation before noise is added.

A task of Isaac Lab that imports a name from `isaaclab.utils.modifiers` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.config_class import MISSING, configclass


def scale(data: Tensor, multiplier: Any) -> Tensor:
    """Return the observation multiplied by a factor. (num_envs, ...)"""
    return data * multiplier


def clip(data: Tensor, bounds: Any) -> Tensor:
    """Return the observation clipped to `bounds`, lowest and highest value; None: no bound. (num_envs, ...)"""
    return data.clip(min=bounds[0], max=bounds[1])


def bias(data: Tensor, value: Any) -> Tensor:
    """Return the observation with a value added. (num_envs, ...)"""
    return data + value


class ModifierBase:
    """Base class of modifiers with a state: created as `Name(cfg, shape, device)`, called once per step."""

    def __init__(self, cfg: Any, data_dim: tuple[int, ...], device: Any) -> None:
        self._cfg, self._data_dim, self._device = cfg, data_dim, device

    def reset(self, env_ids: Any = None) -> None:
        """Reset the state of environments (None: all) at the start of their episodes."""
        raise NotImplementedError(f"class {type(self).__name__} has no method reset; implement it")

    def __call__(self, data: Tensor) -> Tensor:
        """Return the changed observation. (num_envs, ...)"""
        raise NotImplementedError(f"class {type(self).__name__} has no method __call__; implement it")


class DigitalFilter(ModifierBase):
    """Linear filter: weights `B` of the inputs, the newest first, minus weights `A` of past outputs."""

    def __init__(self, cfg: Any, data_dim: tuple[int, ...], device: Any) -> None:
        super().__init__(cfg, data_dim, device)
        self.A, self.B = (torch.tensor(weights, dtype=torch.float32, device=device) for weights in (cfg.A, cfg.B))
        self.x_n = torch.zeros(*data_dim, len(self.B), device=device)
        self.y_n = torch.zeros(*data_dim, len(self.A), device=device)

    def reset(self, env_ids: Any = None) -> None:
        """Set past inputs and outputs of the environments `env_ids` to 0; None: of all environments."""
        for past in (self.x_n, self.y_n):
            past[slice(None) if env_ids is None else env_ids] = 0.0

    def __call__(self, data: Tensor) -> Tensor:
        """Return the output of the filter for the observation `data`. (num_envs, ...) each"""
        self.x_n = torch.cat([data.unsqueeze(-1), self.x_n[..., :-1]], dim=-1)
        output = self.x_n @ self.B - self.y_n @ self.A
        self.y_n = torch.cat([output.unsqueeze(-1), self.y_n[..., :-1]], dim=-1)
        return output


class Integrator(ModifierBase):
    """Integral over the episode by the trapezoidal rule, with the time step `dt` [s]."""

    def __init__(self, cfg: Any, data_dim: tuple[int, ...], device: Any) -> None:
        super().__init__(cfg, data_dim, device)
        self.integral, self.y_prev = (torch.zeros(data_dim, device=device) for _ in range(2))

    def reset(self, env_ids: Any = None) -> None:
        """Set the integral and the last input of the environments `env_ids` to 0; None: of all environments."""
        for state in (self.integral, self.y_prev):
            state[slice(None) if env_ids is None else env_ids] = 0.0

    def __call__(self, data: Tensor) -> Tensor:
        """Add the observation `data` to the integral, and return the integral. (num_envs, ...) each"""
        self.integral = self.integral + 0.5 * (data + self.y_prev) * self._cfg.dt
        self.y_prev = data.clone()
        return self.integral


@configclass
class ModifierCfg:
    """Settings of a modifier: a function and its parameters, or a subclass of `ModifierBase`.

    The parameters are `multiplier` for `scale`, `bounds` for `clip`, and `value` for `bias`.
    """

    func: Any = MISSING
    params: dict[str, Any] = {}  # noqa: RUF012  (configclass copies it for each object)


@configclass
class DigitalFilterCfg(ModifierCfg):
    """Settings of a linear filter: weights `A` of past outputs, weights `B` of the inputs."""

    func: Any = DigitalFilter
    A: Any = MISSING
    B: Any = MISSING


@configclass
class IntegratorCfg(ModifierCfg):
    """Settings of a modifier that integrates the observation over the episode, with the time step `dt` [s]."""

    func: Any = Integrator
    dt: float = MISSING
