"""Randomisation of bodies and of gravity."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco

from rlcli.errors import listing
from rlcli.mdp.randomization_base import (
    SMALLEST,
    AxisRandomization,
    FieldRandomization,
    OrientationRandomization,
    Randomization,
    element_names,
    matching_elements,
)
from rlcli.mdp.term import BodyTerm
from rlcli.scene.model_fields import ModelField
from rlcli.scene.names import NameProblem
from rlcli.sim.selection import Selection


@dataclass(kw_only=True, eq=False)
class RandomizeBodyMass(Randomization, BodyTerm):
    """Masses of bodies [kg]; their inertias are scaled alike, unless `with_inertia` is false."""

    model_field = "body_mass"
    lowest = SMALLEST

    with_inertia: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        massless = (self.target.original[:, 0] == 0).tolist()
        if self.with_inertia and any(massless):
            bodies = element_names(self.entity, "Bodies", self.bodies)
            names = [name for name, none in zip(bodies, massless, strict=True) if none]
            raise NameProblem(f"no mass to change on {listing(names)}", "choose other bodies, or with_inertia: false")
        self._inertia = ModelField(self.entity, "body_inertia", self.bodies) if self.with_inertia else None

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        mass = self.draw(selection, self.target.original)
        self.target.write(selection, mass)
        if self._inertia is not None:
            self._inertia.write(selection, self._inertia.original * (mass / self.target.original))


@dataclass(kw_only=True, eq=False)
class RandomizeBodyCom(AxisRandomization, BodyTerm):
    """Centres of mass of bodies, in the body's frame [m]."""

    model_field = "body_ipos"

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Have MuJoCo compile the bodies as ones whose mass may lie anywhere."""
        for body in matching_elements(spec.bodies, params, "bodies", "body"):
            body.simple = 0


@dataclass(kw_only=True, eq=False)
class RandomizeBodyInertia(FieldRandomization, BodyTerm):
    """Principal moments of inertia of bodies [kg m^2], the three of a body by one factor."""

    model_field = "body_inertia"
    lowest = SMALLEST
    same_for_axes = True

    range: tuple[float, float]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    shared: bool = False


@dataclass(kw_only=True, eq=False)
class RandomizeBodyPos(AxisRandomization, BodyTerm):
    """Positions of bodies, in the frame of their parent [m]; a floating root's is its reset's."""

    model_field = "body_pos"


@dataclass(kw_only=True, eq=False)
class RandomizeBodyQuat(OrientationRandomization, BodyTerm):
    """Orientations of bodies, turned about their own axes by roll, pitch and yaw [rad]."""

    model_field = "body_quat"


@dataclass(kw_only=True, eq=False)
class RandomizeGravity(FieldRandomization):
    """Gravity, world frame [m/s^2]; the direction that observations see follows."""

    model_field = "opt.gravity"

    axes: list[int] = field(default_factory=lambda: [2])
    range: tuple[float, float] | list[tuple[float, float]]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "add"

    def __post_init__(self) -> None:
        self.entity = next(iter(self.env.entities.values()))
        super().__post_init__()
