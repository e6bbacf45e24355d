"""Configuration classes of observation noise.

A task of Isaac Lab that imports a name from `isaaclab.utils.noise` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass


@configclass
class NoiseCfg:
    """Settings that every kind of noise has; `operation` is `add`, `scale` or `abs` (replace the value)."""

    func: Any = "noise"
    operation: str = "add"


@configclass
class ConstantNoiseCfg(NoiseCfg):
    """Settings of a constant offset: the same value in every step."""

    func: Any = "constant_noise"
    bias: Any = 0.0


@configclass
class UniformNoiseCfg(NoiseCfg):
    """Settings of uniform noise in [n_min, n_max)."""

    func: Any = "uniform_noise"
    n_min: Any = -1.0
    n_max: Any = 1.0


@configclass
class GaussianNoiseCfg(NoiseCfg):
    """Settings of normally distributed noise."""

    func: Any = "gaussian_noise"
    mean: Any = 0.0
    std: Any = 1.0


@configclass
class NoiseModelCfg:
    """Settings of a noise model: noise that is sampled in every step."""

    class_type: Any = "NoiseModel"
    func: Any = None
    noise_cfg: Any = MISSING


@configclass
class NoiseModelWithAdditiveBiasCfg(NoiseModelCfg):
    """Settings of a noise model: noise in every step, plus a bias that is sampled at the start of an episode."""

    class_type: Any = "NoiseModelWithAdditiveBias"
    bias_noise_cfg: Any = MISSING
    sample_bias_per_component: bool = True


AdditiveUniformNoiseCfg, AdditiveGaussianNoiseCfg = UniformNoiseCfg, GaussianNoiseCfg
ConstantBiasNoiseCfg = ConstantNoiseCfg
