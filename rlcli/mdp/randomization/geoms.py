"""Event terms that randomise frictions, sizes and poses of geoms, poses of sites, and frictions of contact pairs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco

from rlcli.mdp.parameter_types import Entity
from rlcli.mdp.randomization_base import (
    SMALLEST,
    AxisRandomization,
    OrientationRandomization,
    matching_elements,
    require_supported,
)
from rlcli.mdp.term import GeomTerm, PairTerm, SiteTerm
from rlcli.sim.env_selection import Columns


@dataclass(kw_only=True, eq=False)
class RandomizeGeomFriction(AxisRandomization, GeomTerm):
    """Random friction of geoms: axis 0 is sliding, axis 1 torsional [m], axis 2 rolling [m].

    In a contact of two geoms with equal priority MuJoCo uses the larger friction, so a low friction of one geom may
    have no effect. With `prevail` the chosen geoms therefore get a higher priority than all other geoms. In their
    contacts MuJoCo then also uses the `condim`, `solref` and `solimp` of the chosen geoms.
    """

    model_field = "geom_friction"
    lowest = 0.0

    axes: list[int] = field(default_factory=lambda: [0])
    operation: Literal["add", "scale", "set"] = "scale"
    prevail: bool = True

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Raise the priority of the chosen geoms above that of all other geoms."""
        if params["prevail"]:
            chosen = matching_elements(spec.geoms, params, "geoms", "geom")
            names = {geom.name for geom in chosen}
            others = max((int(geom.priority) for geom in spec.geoms if geom.name not in names), default=0)
            for geom in chosen:
                geom.priority = max(int(geom.priority), others + 1)


@dataclass(kw_only=True, eq=False)
class RandomizeGeomSize(AxisRandomization, GeomTerm):
    """Random sizes of geoms [m], one sample for all values of a geom.

    Meshes, height fields and planes have no size to change.
    """

    model_field = "geom_size"
    lowest = SMALLEST
    same_for_axes = True

    operation: Literal["add", "scale", "set"] = "scale"

    def __post_init__(self) -> None:
        _require_sized(self.entity, self.geoms)
        super().__post_init__()


@dataclass(kw_only=True, eq=False)
class RandomizeGeomPos(AxisRandomization, GeomTerm):
    """Random positions of geoms, in the frame of their body [m]."""

    model_field = "geom_pos"


@dataclass(kw_only=True, eq=False)
class RandomizeGeomQuat(OrientationRandomization, GeomTerm):
    """Random turns of geoms about their own axes: roll, pitch and yaw [rad]."""

    model_field = "geom_quat"


@dataclass(kw_only=True, eq=False)
class RandomizeSitePos(AxisRandomization, SiteTerm):
    """Random positions of sites, in the frame of their body [m]."""

    model_field = "site_pos"


@dataclass(kw_only=True, eq=False)
class RandomizeSiteQuat(OrientationRandomization, SiteTerm):
    """Random turns of sites about their own axes: roll, pitch and yaw [rad]."""

    model_field = "site_quat"


@dataclass(kw_only=True, eq=False)
class RandomizePairFriction(AxisRandomization, PairTerm):
    """Random friction of the contact pairs in the MJCF.

    Axes 0 and 1 are sliding, axis 2 is torsional [m], axes 3 and 4 are rolling [m].
    """

    model_field = "pair_friction"
    lowest = 0.0

    axes: list[int] = field(default_factory=lambda: [0, 1])
    operation: Literal["add", "scale", "set"] = "scale"


def _require_sized(entity: Entity, geoms: Columns) -> None:
    shapeless = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_MESH)
    types = entity.engine.model.geom_type[entity.geom_ids]
    sized = [int(kind) not in map(int, shapeless) for kind in types]
    hint = "choose boxes, spheres, capsules, ellipsoids or cylinders"
    require_supported(entity, "Geoms", geoms, sized, "whose size cannot change", hint)
