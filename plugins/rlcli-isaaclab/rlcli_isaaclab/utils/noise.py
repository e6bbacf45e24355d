"""Observation noise: functions, noise models and their settings.

A task of Isaac Lab that imports a name from `isaaclab.utils.noise` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.config_class import MISSING, configclass


def constant_noise(data: Tensor, cfg: Any) -> Tensor:
    """Return the observation with a constant offset. (num_envs, ...)"""
    return _combined(data, torch.zeros_like(data) + cfg.bias, cfg)


def uniform_noise(data: Tensor, cfg: Any) -> Tensor:
    """Return the observation with uniform noise. (num_envs, ...)"""
    return _combined(data, torch.rand_like(data) * (cfg.n_max - cfg.n_min) + cfg.n_min, cfg)


def gaussian_noise(data: Tensor, cfg: Any) -> Tensor:
    """Return the observation with normally distributed noise. (num_envs, ...)"""
    return _combined(data, cfg.mean + cfg.std * torch.randn_like(data), cfg)


def _combined(data: Tensor, noise: Tensor, cfg: Any) -> Tensor:
    return {"add": data + noise, "scale": data * noise, "abs": noise}[cfg.operation]


@configclass
class NoiseCfg:
    """Settings that every kind of noise has; `operation` is `add`, `scale` or `abs` (replace the value)."""

    func: Any = "noise"
    operation: str = "add"


@configclass
class ConstantNoiseCfg(NoiseCfg):
    """Settings of a constant offset: the same value in every step."""

    func: Any = constant_noise
    bias: Any = 0.0


@configclass
class UniformNoiseCfg(NoiseCfg):
    """Settings of uniform noise in [n_min, n_max)."""

    func: Any = uniform_noise
    n_min: Any = -1.0
    n_max: Any = 1.0


@configclass
class GaussianNoiseCfg(NoiseCfg):
    """Settings of normally distributed noise."""

    func: Any = gaussian_noise
    mean: Any = 0.0
    std: Any = 1.0


class NoiseModel:
    """Noise that is sampled in every step; a task may subclass it."""

    def __init__(self, noise_model_cfg: Any, num_envs: int, device: Any) -> None:
        self._noise_model_cfg, self._num_envs, self._device = noise_model_cfg, num_envs, device

    def reset(self, env_ids: Any = None) -> None:
        """Do nothing: this noise has no state. A subclass resets its state in the environments `env_ids`; None: all."""

    def __call__(self, data: Tensor) -> Tensor:
        """Return the observation with noise. (num_envs, ...)"""
        return self._noise_model_cfg.noise_cfg.func(data, self._noise_model_cfg.noise_cfg)


class NoiseModelWithAdditiveBias(NoiseModel):
    """Noise in every step, plus a bias that is sampled at the start of an episode."""

    def __init__(self, noise_model_cfg: Any, num_envs: int, device: Any) -> None:
        super().__init__(noise_model_cfg, num_envs, device)
        self._bias_noise_cfg = noise_model_cfg.bias_noise_cfg
        self._bias = torch.zeros(num_envs, 1, device=device)
        self._sample_bias_per_component = noise_model_cfg.sample_bias_per_component

    def reset(self, env_ids: Any = None) -> None:
        """Sample new biases in the environments `env_ids`; None: in all environments."""
        rows = slice(None) if env_ids is None else env_ids
        self._bias[rows] = self._bias_noise_cfg.func(self._bias[rows], self._bias_noise_cfg)

    def __call__(self, data: Tensor) -> Tensor:
        """Return the observation with noise and bias. (num_envs, ..., d)"""
        if self._sample_bias_per_component and self._bias.shape[1] != data.shape[-1]:
            self._bias = self._bias.repeat(1, data.shape[-1])
            self.reset()
        return super().__call__(data) + self._bias


@configclass
class NoiseModelCfg:
    """Settings of a noise model: noise that is sampled in every step."""

    class_type: Any = NoiseModel
    func: Any = None
    noise_cfg: Any = MISSING


@configclass
class NoiseModelWithAdditiveBiasCfg(NoiseModelCfg):
    """Settings of a noise model: noise in every step, plus a bias that is sampled at the start of an episode."""

    class_type: Any = NoiseModelWithAdditiveBias
    bias_noise_cfg: Any = MISSING
    sample_bias_per_component: bool = True


AdditiveUniformNoiseCfg, AdditiveGaussianNoiseCfg = UniformNoiseCfg, GaussianNoiseCfg
ConstantBiasNoiseCfg = ConstantNoiseCfg
