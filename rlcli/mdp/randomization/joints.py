"""Event terms that randomise joints (damping, armature, friction, limits, default positions, ...) and tendons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rlcli.mdp.randomization_base import Draw, DrawKeys, Randomization, RangeKeys, require_supported
from rlcli.mdp.term import JointTerm, TendonTerm
from rlcli.scene.model_fields import ModelField
from rlcli.sim.env_selection import Selection
from rlcli.sim.saved_tensors import TensorState


@dataclass(kw_only=True, eq=False)
class _JointField(Randomization, JointTerm):
    """Base class of terms that change a joint property that cannot be negative."""

    lowest = 0.0


class RandomizeJointDamping(_JointField):
    """Random viscous damping of joints [N s/m or N m s/rad]."""

    model_field = "dof_damping"


class RandomizeJointArmature(_JointField):
    """Random armature (rotor inertia) of joints [kg or kg m^2]."""

    model_field = "dof_armature"


class RandomizeJointFrictionLoss(_JointField):
    """Random dry friction of joints [N or N m]."""

    model_field = "dof_frictionloss"


class RandomizeJointStiffness(_JointField):
    """Random spring stiffness of joints [N/m or N m/rad]."""

    model_field = "jnt_stiffness"


@dataclass(kw_only=True, eq=False)
class RandomizeJointRange(DrawKeys, JointTerm):
    """Random position limits of joints [m or rad]. Terms that read the limits get the random limits.

    lower, upper: ranges for the two limits; a limit without a range stays.
    """

    derives = False

    lower: tuple[float, float] | None = None
    upper: tuple[float, float] | None = None
    operation: Literal["add", "scale", "set"] = "add"

    def __post_init__(self) -> None:
        limited = self.env.engine.model.jnt_limited[self.entity.joint_ids].astype(bool).tolist()
        hint = "give the joint a range in scene.entities"
        require_supported(self.entity, "Joints", self.joints, limited, "without limits", hint)
        self._field = ModelField(self.entity, "jnt_range", self.joints)
        shape = (self._field.shape[0], 1)
        self._draws = [None if pair is None else Draw(self, pair, shape) for pair in (self.lower, self.upper)]

    def __call__(self, selection: Selection) -> None:
        """Draw new limits for the selected environments."""
        current = self._field.read(selection)
        low, high = (
            current[:, :, end : end + 1] if draw is None else draw(selection, self._field.original[:, end : end + 1])
            for end, draw in enumerate(self._draws)
        )
        self._field.write(selection, torch.cat([torch.minimum(low, high), torch.maximum(low, high)], dim=2))


@dataclass(kw_only=True, eq=False)
class RandomizeDefaultJointPos(RangeKeys, JointTerm, TensorState):
    """Random default joint positions [m or rad], like errors of joint encoders.

    Resets, actions and observations that are relative to the defaults use the random values.
    """

    derives = False

    operation: Literal["add", "scale", "set"] = "add"

    def __post_init__(self) -> None:
        self._default = self.entity.data.default_joint_pos
        self._original = self._default[0, self.joints].clone()[:, None]
        self._draw = Draw(self, self.range, (len(self._original), 1))

    def __call__(self, selection: Selection) -> None:
        """Draw new default positions for the selected environments."""
        selection.write(self._default, self._draw(selection, self._original)[:, :, 0], self.joints)

    def tensors(self) -> dict[str, Tensor]:
        """Return the default positions of all environments."""
        return {"default": self._default}


@dataclass(kw_only=True, eq=False)
class _TendonField(Randomization, TendonTerm):
    """Base class of terms that change a tendon property that cannot be negative."""

    lowest = 0.0


class RandomizeTendonStiffness(_TendonField):
    """Random stiffness of tendons [N/m]."""

    model_field = "tendon_stiffness"


class RandomizeTendonDamping(_TendonField):
    """Random damping of tendons [N s/m]."""

    model_field = "tendon_damping"


class RandomizeTendonFrictionLoss(_TendonField):
    """Random dry friction of tendons [N]."""

    model_field = "tendon_frictionloss"


class RandomizeTendonArmature(_TendonField):
    """Random armature of tendons [kg]."""

    model_field = "tendon_armature"
