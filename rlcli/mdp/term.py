"""Base classes of terms that are dataclasses. Their fields are the keys of the term in the YAML.

Among several base classes with fields, a term lists JointTerm, GeomTerm or another class of this module last: a
dataclass collects the fields of its last base first, so `entity` and the selected elements become the first keys.
`TensorState` has no fields and stands after them: `class MyTerm(RangeKeys, JointTerm, TensorState)`.
"""

from __future__ import annotations

from dataclasses import dataclass

from rlcli.mdp.parameter_types import ManagedEnv
from rlcli.sim.env_selection import Columns
from rlcli.task import Actuators, Bodies, Entity, Geoms, Joints, Pairs, Sites, Tendons

_ELEMENT_KEYS = ("joints", "actuators", "bodies", "geoms", "sites", "tendons", "pairs")


@dataclass(eq=False)
class Term:
    """Base class of terms that are dataclasses; `env` is the environment."""

    env: ManagedEnv

    def selected(self) -> Columns | None:
        """Return the index of the selected elements (joints, bodies, ...); None for a term that selects no elements."""
        return next((getattr(self, key) for key in _ELEMENT_KEYS if hasattr(self, key)), None)


@dataclass(kw_only=True, eq=False)
class EntityTerm(Term):
    """Base class of terms that act on, or observe, one entity (a robot or an object)."""

    entity: Entity = "robot"


@dataclass(kw_only=True, eq=False)
class JointTerm(EntityTerm):
    """Base class of terms that select joints."""

    joints: Joints = ".*"


@dataclass(kw_only=True, eq=False)
class ActuatorTerm(EntityTerm):
    """Base class of terms that select actuators."""

    actuators: Actuators = ".*"


@dataclass(kw_only=True, eq=False)
class BodyTerm(EntityTerm):
    """Base class of terms that select bodies."""

    bodies: Bodies = ".*"


@dataclass(kw_only=True, eq=False)
class GeomTerm(EntityTerm):
    """Base class of terms that select geoms."""

    geoms: Geoms = ".*"


@dataclass(kw_only=True, eq=False)
class SiteTerm(EntityTerm):
    """Base class of terms that select sites."""

    sites: Sites = ".*"


@dataclass(kw_only=True, eq=False)
class TendonTerm(EntityTerm):
    """Base class of terms that select tendons."""

    tendons: Tendons = ".*"


@dataclass(kw_only=True, eq=False)
class PairTerm(EntityTerm):
    """Base class of terms that select contact pairs."""

    pairs: Pairs = ".*"
