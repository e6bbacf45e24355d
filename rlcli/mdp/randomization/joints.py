"""Randomisation of joints and tendons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rlcli.mdp.randomization_base import DrawingTerm, Randomization, RangeKeys, require_able
from rlcli.mdp.term import JointTerm, TendonTerm
from rlcli.scene.model_fields import ModelField
from rlcli.sim.selection import Selection
from rlcli.sim.tensor_state import TensorState


@dataclass(kw_only=True, eq=False)
class _JointNumber(Randomization, JointTerm):
    """A number of each joint that cannot be negative."""

    lowest = 0.0


class RandomizeJointDamping(_JointNumber):
    """Viscous damping of joints [N s/m or N m s/rad]."""

    model_field = "dof_damping"


class RandomizeJointArmature(_JointNumber):
    """Rotor inertia of joints [kg or kg m^2]."""

    model_field = "dof_armature"


class RandomizeJointFrictionLoss(_JointNumber):
    """Dry friction of joints [N or N m]."""

    model_field = "dof_frictionloss"


class RandomizeJointStiffness(_JointNumber):
    """Spring stiffness of joints [N/m or N m/rad]."""

    model_field = "jnt_stiffness"


@dataclass(kw_only=True, eq=False)
class RandomizeJointRange(DrawingTerm, JointTerm):
    """Position limits of joints [m or rad]; what reads the limits follows."""

    derives = False

    lower: tuple[float, float] | None = None
    upper: tuple[float, float] | None = None
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "add"
    shared: bool = False

    def __post_init__(self) -> None:
        limited = self.env.engine.model.jnt_limited[self.entity.joint_ids].astype(bool).tolist()
        require_able(self.entity, "Joints", self.joints, limited, "has no limits", "give it a range in scene.entities")
        self._field = ModelField(self.entity, "jnt_range", self.joints)
        shape = (self._field.shape[0], 1)
        self._draws = [None if pair is None else self.new_draw(pair, shape) for pair in (self.lower, self.upper)]

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        now = self._field.read(selection)
        low, high = (
            now[:, :, end : end + 1] if draw is None else draw(selection, self._field.original[:, end : end + 1])
            for end, draw in enumerate(self._draws)
        )
        self._field.write(selection, torch.cat([torch.minimum(low, high), torch.maximum(low, high)], dim=2))


@dataclass(kw_only=True, eq=False)
class RandomizeDefaultJointPos(RangeKeys, JointTerm, TensorState):
    """Default joint positions [m or rad], about which resets, actions and observations are: as if encoders were off."""

    derives = False

    operation: Literal["add", "scale", "set"] = "add"

    def __post_init__(self) -> None:
        self._default = self.entity.data.default_joint_pos
        self._original = self._default[0, self.joints].clone()[:, None]
        self._draw = self.new_draw(self.range, (len(self._original), 1))

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        selection.write(self._default, self._draw(selection, self._original)[:, :, 0], self.joints)

    def tensors(self) -> dict[str, Tensor]:
        """Return the default positions of all environments."""
        return {"default": self._default}


@dataclass(kw_only=True, eq=False)
class _TendonNumber(Randomization, TendonTerm):
    """A number of each tendon that cannot be negative."""

    lowest = 0.0


class RandomizeTendonStiffness(_TendonNumber):
    """Stiffness of tendons [N/m]."""

    model_field = "tendon_stiffness"


class RandomizeTendonDamping(_TendonNumber):
    """Damping of tendons [N s/m]."""

    model_field = "tendon_damping"


class RandomizeTendonFrictionLoss(_TendonNumber):
    """Dry friction of tendons [N]."""

    model_field = "tendon_frictionloss"


class RandomizeTendonArmature(_TendonNumber):
    """Armature of tendons [kg]."""

    model_field = "tendon_armature"
