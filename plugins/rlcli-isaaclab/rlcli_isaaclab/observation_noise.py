"""Noise models of direct tasks: they add noise to all columns of the observations or actions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli.errors import TaskError
from rlcli_isaaclab.settings import kind_of


class NoNoise:
    """Noise model without noise, and base class of the other noise models."""

    def __call__(self, data: Tensor) -> Tensor:
        """Return the observation `data` unchanged; subclasses return it with noise. (num_envs, d)"""
        return data

    def reset(self, env_ids: Any) -> None:
        """Do nothing: this noise model has no state."""


class NoiseModel(NoNoise):
    """Noise that is sampled in every step."""

    def __init__(self, cfg: Any, managed: Any) -> None:
        self._cfg = cfg

    def __call__(self, data: Tensor) -> Tensor:
        """Return the observation `data` with noise. (num_envs, d)"""
        return _with_noise(self._cfg.noise_cfg, data)


class NoiseModelWithAdditiveBias(NoiseModel):
    """Noise in every step, plus a bias that is sampled at the start of an episode."""

    def __init__(self, cfg: Any, managed: Any) -> None:
        super().__init__(cfg, managed)
        self._bias = torch.zeros(managed.num_envs, 1, device=managed.device)
        self._per_component = bool(getattr(cfg, "sample_bias_per_component", True))

    def __call__(self, data: Tensor) -> Tensor:
        """Return the observation `data` with noise. (num_envs, d)"""
        if self._per_component and self._bias.shape[1] != data.shape[1]:
            self._bias = self._bias.repeat(1, data.shape[1])
            self.reset(slice(None))
        return super().__call__(data) + self._bias

    def reset(self, env_ids: Any) -> None:
        """Sample the biases of new episodes."""
        self._bias[env_ids] = _with_noise(self._cfg.bias_noise_cfg, torch.zeros_like(self._bias[env_ids]))


def noise_model(cfg: Any, managed: Any) -> NoNoise:
    """Return the noise model for a configuration; `cfg` None: `NoNoise`."""
    if cfg is None:
        return NoNoise()
    kind = kind_of(cfg.class_type)
    models = {"NoiseModel": NoiseModel, "NoiseModelWithAdditiveBias": NoiseModelWithAdditiveBias}
    if isinstance(cfg.class_type, type):
        return cfg.class_type(cfg, managed.num_envs, str(managed.device))
    if kind not in models:
        raise TaskError(
            f"the noise model '{kind}' has no counterpart in rlcli",
            hint="use NoiseModelCfg or NoiseModelWithAdditiveBiasCfg",
        )
    return models[kind](cfg, managed)


def _with_noise(cfg: Any, data: Tensor) -> Tensor:
    """Return data with uniform, gaussian or constant noise: data + noise, data x noise, or the noise itself."""
    if hasattr(cfg, "n_min"):
        noise = torch.rand_like(data) * (cfg.n_max - cfg.n_min) + cfg.n_min
    elif hasattr(cfg, "std"):
        noise = cfg.mean + cfg.std * torch.randn_like(data)
    else:
        noise = torch.zeros_like(data) + cfg.bias
    return {"add": data + noise, "scale": data * noise, "abs": noise}[cfg.operation]
