"""Base classes of terms that are dataclasses: their fields are the keys of the YAML, in the order of the fields.

A dataclass has the fields of its last base first, so that the base that selects elements stands last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from rlcli.task import Actuators, Bodies, Entity, Geoms, Joints, Pairs, Sites, Tendons

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv
    from rlcli.sim.selection import Columns


@dataclass(eq=False)
class Term:
    """Base of terms that are dataclasses."""

    elements_key: ClassVar[str | None] = None
    """The key that selects elements of the entity; None: there is none."""

    env: ManagedEnv

    def selected(self) -> Columns | None:
        """Return the index of the selected elements, or None for a term that selects none."""
        return None if self.elements_key is None else getattr(self, self.elements_key)


@dataclass(kw_only=True, eq=False)
class JointTerm(Term):
    """Base of terms of some joints."""

    elements_key = "joints"

    entity: Entity = "robot"
    joints: Joints = ".*"


@dataclass(kw_only=True, eq=False)
class ActuatorTerm(Term):
    """Base of terms of some actuators."""

    elements_key = "actuators"

    entity: Entity = "robot"
    actuators: Actuators = ".*"


@dataclass(kw_only=True, eq=False)
class BodyTerm(Term):
    """Base of terms of some bodies."""

    elements_key = "bodies"

    entity: Entity = "robot"
    bodies: Bodies = ".*"


@dataclass(kw_only=True, eq=False)
class GeomTerm(Term):
    """Base of terms of some geoms."""

    elements_key = "geoms"

    entity: Entity = "robot"
    geoms: Geoms = ".*"


@dataclass(kw_only=True, eq=False)
class SiteTerm(Term):
    """Base of terms of some sites."""

    elements_key = "sites"

    entity: Entity = "robot"
    sites: Sites = ".*"


@dataclass(kw_only=True, eq=False)
class TendonTerm(Term):
    """Base of terms of some tendons."""

    elements_key = "tendons"

    entity: Entity = "robot"
    tendons: Tendons = ".*"


@dataclass(kw_only=True, eq=False)
class PairTerm(Term):
    """Base of terms of some contact pairs."""

    elements_key = "pairs"

    entity: Entity = "robot"
    pairs: Pairs = ".*"
