"""Modifiers, which change an observation before noise is added. Names as in `isaaclab.utils.modifiers`."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass

scale, clip, bias = "scale", "clip", "bias"


@configclass
class ModifierCfg:
    """A function with parameters: `scale` (multiplier), `clip` (bounds) or `bias` (value)."""

    func: Any = MISSING
    params: dict[str, Any] = {}  # noqa: RUF012  (configclass copies it for each object)


@configclass
class DigitalFilterCfg(ModifierCfg):
    """A linear filter with weights A of past outputs and B of inputs."""

    func: Any = "DigitalFilter"
    A: Any = MISSING
    B: Any = MISSING


@configclass
class IntegratorCfg(ModifierCfg):
    """Integral of the observation over the episode."""

    func: Any = "Integrator"
    dt: float = MISSING
