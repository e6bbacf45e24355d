"""Noise models of direct tasks: they add noise to all columns of the observations or actions."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from rlcli.errors import TaskError
from rlcli_isaaclab.settings import kind_of
from rlcli_isaaclab.utils import noise


class NoNoise:
    """Noise model without noise."""

    def __call__(self, data: Tensor) -> Tensor:
        """Return the observations or actions `data` unchanged. (num_envs, d)"""
        return data

    def reset(self, env_ids: Any) -> None:
        """Do nothing: this noise model has no state."""


def noise_model(cfg: Any, managed: Any) -> Any:
    """Return the noise model for a configuration, a callable (num_envs, d) -> (num_envs, d); for None `NoNoise`.

    Args:
        cfg: configuration of the noise model, such as `NoiseModelCfg`; or None.
        managed: environment of rlcli.

    Raises:
        TaskError: if rlcli has no such noise model.
    """
    if cfg is None:
        return NoNoise()
    kind = kind_of(cfg.class_type)
    model = cfg.class_type if isinstance(cfg.class_type, type) else getattr(noise, kind, None)
    if model is None:
        raise TaskError(
            f"the noise model '{kind}' has no counterpart in rlcli",
            hint="use NoiseModelCfg or NoiseModelWithAdditiveBiasCfg",
        )
    return model(cfg, managed.num_envs, str(managed.device))
