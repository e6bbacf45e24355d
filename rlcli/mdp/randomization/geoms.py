"""Randomisation of geoms, sites and contact pairs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import mujoco

from rlcli.mdp.parameters import Entity
from rlcli.mdp.randomization_base import (
    SMALLEST,
    AxisRandomization,
    OrientationRandomization,
    matching_elements,
    require_able,
)
from rlcli.mdp.term import GeomTerm, PairTerm, SiteTerm
from rlcli.sim.selection import Columns


@dataclass(kw_only=True, eq=False)
class RandomizeGeomFriction(AxisRandomization, GeomTerm):
    """Friction of geoms: axis 0 slides, 1 spins [m], 2 rolls [m]; it prevails over that of what they touch.

    MuJoCo takes the larger friction of two geoms of equal priority, so that a lower one would change nothing: the
    chosen geoms get a higher priority than all others, unless `prevail` is false. With it their `condim`, `solref` and
    `solimp` hold, too.
    """

    model_field = "geom_friction"
    lowest = 0.0

    axes: list[int] = field(default_factory=lambda: [0])
    operation: Literal["add", "scale", "set"] = "scale"
    prevail: bool = True

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Raise the priority of the chosen geoms."""
        if params["prevail"]:
            chosen = matching_elements(spec.geoms, params, "geoms", "geom")
            names = {geom.name for geom in chosen}
            others = max((int(geom.priority) for geom in spec.geoms if geom.name not in names), default=0)
            for geom in chosen:
                geom.priority = max(int(geom.priority), others + 1)


@dataclass(kw_only=True, eq=False)
class RandomizeGeomSize(AxisRandomization, GeomTerm):
    """Sizes of geoms [m], the values of a geom by one draw; meshes, height fields and planes have none."""

    model_field = "geom_size"
    lowest = SMALLEST
    same_for_axes = True

    operation: Literal["add", "scale", "set"] = "scale"

    def __post_init__(self) -> None:
        _require_sized(self.entity, self.geoms)
        super().__post_init__()


@dataclass(kw_only=True, eq=False)
class RandomizeGeomPos(AxisRandomization, GeomTerm):
    """Positions of geoms, in the frame of the body they belong to [m]."""

    model_field = "geom_pos"


@dataclass(kw_only=True, eq=False)
class RandomizeGeomQuat(OrientationRandomization, GeomTerm):
    """Orientations of geoms, turned about their own axes by roll, pitch and yaw [rad]."""

    model_field = "geom_quat"


@dataclass(kw_only=True, eq=False)
class RandomizeSitePos(AxisRandomization, SiteTerm):
    """Positions of sites, in the frame of the body they belong to [m]."""

    model_field = "site_pos"


@dataclass(kw_only=True, eq=False)
class RandomizeSiteQuat(OrientationRandomization, SiteTerm):
    """Orientations of sites, turned about their own axes by roll, pitch and yaw [rad]."""

    model_field = "site_quat"


@dataclass(kw_only=True, eq=False)
class RandomizePairFriction(AxisRandomization, PairTerm):
    """Friction of contact pairs that the MJCF names: axes 0 and 1 slide, 2 spins [m], 3 and 4 roll [m]."""

    model_field = "pair_friction"
    lowest = 0.0

    axes: list[int] = field(default_factory=lambda: [0, 1])
    operation: Literal["add", "scale", "set"] = "scale"


def _require_sized(entity: Entity, geoms: Columns) -> None:
    shapeless = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_MESH)
    types = entity.engine.model.geom_type[entity.geom_ids]
    good = [int(kind) not in map(int, shapeless) for kind in types]
    require_able(entity, "Geoms", geoms, good, "cannot change its size", "boxes, spheres, capsules, ... can")
