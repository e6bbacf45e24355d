"""Replacement for USD's schemas: drives, limits, masses and gravity change the model, others are logged as ignored.

A schema is a class with USD's generated methods: `Apply`, `Get`, `Define`, `GetXAttr`, `CreateXAttr`, `CreateXRel`.
"""

from __future__ import annotations

import re
from typing import Any, ClassVar

from rlcli.errors import TaskError
from rlcli_oige.stage import Prim, Stage, get_current_stage
from rlcli_oige.user_code import user_location

_METHOD = re.compile(r"(?:Get|Create)(\w+?)(?:Attr|Rel)")
_APPLIED = {
    "DriveAPI": ("Stiffness", "Damping", "MaxForce", "TargetPosition", "TargetVelocity", "Type"),
    "LimitAPI": ("Low", "High"),
    "MassAPI": ("Mass", "Density"),
    "RigidBodyAPI": ("KinematicEnabled", "RigidBodyEnabled"),
    "CollisionAPI": ("CollisionEnabled",),
    "PhysxRigidBodyAPI": ("DisableGravity",),
    "PhysxArticulationAPI": ("EnabledSelfCollisions",),
    "PhysxJointAPI": ("Armature",),
    "RevoluteJoint": ("LowerLimit", "UpperLimit"),
    "PrismaticJoint": ("LowerLimit", "UpperLimit"),
}
"""Schema -> attributes that act on the model."""
_LOST = {
    "MaxJointVelocity": "MuJoCo's joints have no velocity limit",
    "JointFriction": "PhysX's joint friction is a factor of the joint's load; set frictionloss in the MJCF",
    "LinearDamping": "MuJoCo's bodies have no damping; set <option density viscosity> or joint damping in the MJCF",
    "AngularDamping": "MuJoCo's bodies have no damping; set <option density viscosity> or joint damping in the MJCF",
    "StaticFriction": "set friction in the MJCF",
    "DynamicFriction": "set friction in the MJCF",
    "Restitution": "set solref in the MJCF",
}
"""Attributes that change the motion in PhysX and have no counterpart here."""
_REFUSED = {
    "Deformable": "PhysX simulates deformable bodies on its GPU; rlcli simulates rigid bodies",
    "Particle": "PhysX simulates particles on its GPU; rlcli simulates rigid bodies",
    "Attachment": "attachments belong to deformable bodies, which rlcli does not simulate",
}
"""Part of the name of a schema -> why rlcli raises an error for it."""


class Attribute:
    """Attribute of a prim: its value, and its name in USD (schema, instance of the schema, name)."""

    def __init__(self, prim: Prim, schema: str, instance: str, name: str) -> None:
        self.prim, self.schema, self.instance, self.name = prim, schema, instance, name
        self.value: Any = None

    def Get(self, time: Any = None) -> Any:  # noqa: N802  (USD's names)
        """Return the value; None if it was never set."""
        return self.value

    def Set(self, value: Any, time: Any = None) -> bool:  # noqa: N802
        """Set the value. Record a call whose value has no effect in MuJoCo."""
        self.value = value
        if self.schema and not self.schema.endswith("Joint") and self.name not in _APPLIED.get(self.schema, ()):
            lost = self.name in _LOST and value not in (0, 0.0)
            reason = _LOST[self.name] if lost else "MuJoCo has no such setting"
            self.prim.stage.note_ignored(f"{self.schema}.{self.name}", reason, lost)
        return True

    def SetTargets(self, targets: list[Any]) -> bool:  # noqa: N802
        """Set the targets of a relationship."""
        return self.Set([str(target) for target in targets])

    def AddTarget(self, target: Any) -> bool:  # noqa: N802
        """Add a target of a relationship."""
        return self.Set([*(self.value or []), str(target)])

    def IsValid(self) -> bool:  # noqa: N802
        """Return True: every attribute can be set."""
        return True


class _SchemaClass(type):
    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__") or name == "kind":
            raise AttributeError(name)
        return name  # a constant of the schema, such as a token


class Schema(metaclass=_SchemaClass):
    """A USD schema (a group of attributes, such as `MassAPI`), applied to a prim."""

    def __init__(self, prim: Any, instance: str = "") -> None:
        self._prim, self._instance = getattr(prim, "_prim", prim), instance
        name = type(self).__name__
        for part, reason in _REFUSED.items():
            if part in name:
                raise TaskError(f"{user_location()}{name}: {reason}")
        if "SDF" in name:
            self._prim.stage.note_ignored(name, 'set type="sdf" of the mesh geom in the MJCF', lost=True)
        if name in ("DriveAPI", "PhysxJointAPI") and not self._prim.is_joint() and not self._prim.kind:
            owner = self._prim.owner
            owner = next(
                (p for p in owner.stage.prims.values() if self._prim.prim_path.startswith(f"{p.prim_path}/")), owner
            )
            joints = [] if owner.child is None else [joint.name for joint in owner.child.joints]
            hint = f"joints of {owner.label}: {', '.join(filter(None, joints))}" if joints else None
            missing = self._prim.prim_path.rpartition("/")[2]
            raise TaskError(f"{user_location()}the model at '{owner.prim_path}' has no joint '{missing}'", hint=hint)

    @classmethod
    def Apply(cls, prim: Any, instance: str = "") -> Schema:  # noqa: N802
        """Apply the schema to a prim."""
        return cls(prim, instance)

    @classmethod
    def Get(cls, first: Any, second: Any = "") -> Schema:  # noqa: N802
        """Return the schema of a prim: `Get(prim, instance)` or `Get(stage, path)`."""
        return cls(first.GetPrimAtPath(second)) if isinstance(first, Stage) else cls(first, str(second))

    @classmethod
    def Define(cls, stage: Stage, path: Any) -> Schema:  # noqa: N802
        """Add a prim whose type in USD is the name of this schema, and return the schema applied to the prim."""
        prim = stage.DefinePrim(path, cls.__name__)
        where = Attribute(prim, cls.__name__, "", "where")
        where.value = user_location()
        prim.attributes[cls.__name__, "", "where"] = where
        return cls(prim)

    @classmethod
    def is_on(cls, prim: Prim) -> bool:
        """Return whether the schema was applied to a prim, or belongs to the prims of its kind."""
        name = cls.__name__
        if any(schema == name for schema, _, _ in prim.attributes):
            return True
        if name == "DriveAPI":
            child = prim.owner.child
            has_name = prim.is_joint() and child is not None
            return has_name and any(actuator.target == prim.element.name for actuator in child.actuators)  # type: ignore[union-attr]
        if name == "PhysxJointAPI":
            return prim.is_joint()
        if name in ("ArticulationRootAPI", "PhysxArticulationAPI"):
            return prim.owner is prim and prim.child is not None
        return name in ("PhysxRigidBodyAPI", "RigidBodyAPI", "MassAPI", "CollisionAPI") and prim.is_body()

    def GetPrim(self) -> Prim:  # noqa: N802
        """Return the prim that the schema is applied to."""
        prim: Prim = self._prim
        return prim

    def GetPath(self) -> str:  # noqa: N802
        """Return the path of the prim that the schema is applied to."""
        return self.GetPrim().prim_path

    def __bool__(self) -> bool:
        return self._prim.IsValid()

    def __getattr__(self, method: str) -> Any:
        found = _METHOD.fullmatch(method)
        if found is None:
            raise AttributeError(method)
        schema, name = type(self).__name__, found[1]
        key = (schema, self._instance, name)
        attribute = self._prim.attributes.get(key)
        if attribute is None:
            attribute = self._prim.attributes[key] = Attribute(self._prim, schema, self._instance, name)

        def access(value: Any = None, *args: Any) -> Attribute:
            if method.startswith("Create") and value is not None:
                attribute.Set(value)
            return attribute

        return access


class Xformable(Schema):
    """The pose of a prim."""

    def ComputeLocalToWorldTransform(self, time: Any = 0) -> Any:  # noqa: N802
        """Return the pose of the prim in the world, with all joints of its model at 0."""
        from rlcli_oige.usd_names import Transform

        return Transform(self._prim)

    def __getattr__(self, method: str) -> Any:
        found = re.fullmatch(r"Add(\w+)Op", method)
        if found is None:
            return super().__getattr__(method)
        name = f"xformOp:{found[1][0].lower()}{found[1][1:]}"
        return lambda *args, **kwargs: self._prim.attributes.setdefault(
            ("", "", name), Attribute(self._prim, "", "", name)
        )


class Xform(Xformable):
    """Frame (coordinate system) on the stage."""


class SchemaModule:
    """A module of USD's schemas, such as `UsdPhysics`. A schema class is created when its name is used."""

    _classes: ClassVar[dict[str, Any]] = {"Xformable": Xformable, "Xform": Xform}

    def __init__(self, name: str) -> None:
        self.__name__ = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self._classes:
            self._classes[name] = _SchemaClass(name, (Schema,), {})
        return self._classes[name]


def current_prim(path: str) -> Prim:
    """Return the prim at a path of the current stage."""
    return get_current_stage().GetPrimAtPath(path)
