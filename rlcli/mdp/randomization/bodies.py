"""Event terms that randomise masses, inertias, centres of mass and poses of bodies, and gravity."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco

from rlcli.mdp.randomization_base import (
    SMALLEST,
    AxisRandomization,
    FieldRandomization,
    OrientationRandomization,
    Randomization,
    require_supported,
    unset_simple,
)
from rlcli.mdp.term import BodyTerm
from rlcli.scene.model_fields import ModelField
from rlcli.sim.env_selection import Selection


@dataclass(kw_only=True, eq=False)
class RandomizeBodyMass(Randomization, BodyTerm):
    """Random masses of bodies [kg]. The inertias are scaled by the same factor, unless `with_inertia` is false."""

    model_field = "body_mass"
    lowest = SMALLEST

    with_inertia: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.with_inertia:
            has_mass = (self.entity.engine.model.body_mass[self.entity.body_ids] > 0).tolist()
            hint = "choose bodies with mass, or set with_inertia: false"
            require_supported(self.entity, "Bodies", self.bodies, has_mass, "without mass", hint)
        self._inertia = ModelField(self.entity, "body_inertia", self.bodies) if self.with_inertia else None

    def __call__(self, selection: Selection) -> None:
        """Draw new masses for the selected environments."""
        mass = self.draw(selection, self.target.original)
        self.target.write(selection, mass)
        if self._inertia is not None:
            self._inertia.write(selection, self._inertia.original * (mass / self.target.original))


@dataclass(kw_only=True, eq=False)
class RandomizeBodyCom(AxisRandomization, BodyTerm):
    """Random centres of mass of bodies, in the body's frame [m]."""

    model_field = "body_ipos"

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Clear the bodies' `simple` flag: with it, MuJoCo assumes that the centre of mass is the frame's origin."""
        unset_simple(spec, params, "bodies")


@dataclass(kw_only=True, eq=False)
class RandomizeBodyInertia(FieldRandomization, BodyTerm):
    """Random principal moments of inertia: the model's moments [kg m^2] times one random factor for each body."""

    model_field = "body_inertia"
    lowest = SMALLEST
    same_for_axes = True

    range: tuple[float, float]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    shared: bool = False


@dataclass(kw_only=True, eq=False)
class RandomizeBodyPos(AxisRandomization, BodyTerm):
    """Random positions of bodies, in the frame of their parent [m].

    A floating root is placed by its reset event, not by this term.
    """

    model_field = "body_pos"


@dataclass(kw_only=True, eq=False)
class RandomizeBodyQuat(OrientationRandomization, BodyTerm):
    """Random turns of bodies about their own axes: roll, pitch and yaw [rad]."""

    model_field = "body_quat"


@dataclass(kw_only=True, eq=False)
class RandomizeGravity(FieldRandomization):
    """Random gravity, world frame [m/s^2]. Observations of the direction of gravity use the random value."""

    model_field = "opt.gravity"

    axes: list[int] = field(default_factory=lambda: [2])
    range: tuple[float, float] | list[tuple[float, float]]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "add"

    def __post_init__(self) -> None:
        self.entity = next(iter(self.env.entities.values()))
        super().__post_init__()
