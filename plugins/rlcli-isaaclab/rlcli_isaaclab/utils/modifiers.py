"""Modifiers, which change an observation before noise is added.

A task of Isaac Lab that imports a name from `isaaclab.utils.modifiers` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass

scale, clip, bias = "scale", "clip", "bias"


@configclass
class ModifierCfg:
    """Settings of a modifier without a state: the function `scale`, `clip` or `bias`, and its parameters.

    The parameters are `multiplier` for `scale`, `bounds` for `clip`, and `value` for `bias`.
    """

    func: Any = MISSING
    params: dict[str, Any] = {}  # noqa: RUF012  (configclass copies it for each object)


@configclass
class DigitalFilterCfg(ModifierCfg):
    """Settings of a linear filter: weights `A` of past outputs, weights `B` of the inputs."""

    func: Any = "DigitalFilter"
    A: Any = MISSING
    B: Any = MISSING


@configclass
class IntegratorCfg(ModifierCfg):
    """Settings of a modifier that integrates the observation over the episode, with the time step `dt` [s]."""

    func: Any = "Integrator"
    dt: float = MISSING
