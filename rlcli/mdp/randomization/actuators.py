"""Event terms that randomise gains, effort limits and strength of actuators, or any field of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import torch

from rlcli.mdp.randomization_base import (
    Draw,
    DrawingTerm,
    DrawKeys,
    FieldRandomization,
    RangeKeys,
    require_supported,
    unset_simple,
)
from rlcli.mdp.term import ActuatorTerm, JointTerm
from rlcli.mdp.term_helpers import column_numbers, on_host
from rlcli.scene.joint_and_actuator_setup import model_actuator_kind
from rlcli.scene.model_fields import FIELDS, ModelField
from rlcli.scene.names import NameProblem
from rlcli.sim.column_views import as_index
from rlcli.sim.env_selection import Columns, Selection
from rlcli.task import Entity


@dataclass(kw_only=True, eq=False)
class RandomizeActuatorGains(DrawKeys, ActuatorTerm):
    """Random gains of MuJoCo's own actuators: kp [N/m or N m/rad] and kv [N s/m or N m s/rad].

    kp belongs to position actuators, kv to position and velocity actuators. Give one or both ranges.
    """

    derives = False

    kp: tuple[float, float] | None = None
    kv: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.kp is None and self.kv is None:
            raise NameProblem("no gain is given (kp or kv), so the term changes nothing", "give kp, kv or both")
        model = self.env.engine.model
        kinds = [model_actuator_kind(model, number) for number in self.entity.actuator_ids.tolist()]
        has_kp = [kind == "position" for kind in kinds]
        has_kv = [kind in ("position", "velocity") for kind in kinds]
        if self.kp is not None:
            hint = "only position actuators have kp"
            require_supported(self.entity, "Actuators", self.actuators, has_kp, "without kp", hint)
        if self.kv is not None:
            hint = "only position and velocity actuators have kv"
            require_supported(self.entity, "Actuators", self.actuators, has_kv, "without kv", hint)
        self._gain = ModelField(self.entity, "actuator_gainprm", self.actuators, [0])
        self._bias = ModelField(self.entity, "actuator_biasprm", self.actuators, [1, 2])
        is_position = torch.tensor(has_kp)[on_host(self.actuators)]
        self._is_position = is_position[:, None].to(self.env.device)
        shape = (self._gain.shape[0], 1)
        self._kp, self._kv = (
            None if pair is None else Draw(self, pair, shape, lowest=0.0) for pair in (self.kp, self.kv)
        )

    def __call__(self, selection: Selection) -> None:
        """Draw new gains for the selected environments."""
        # MuJoCo: force = gainprm[0] ctrl + biasprm[1] length + biasprm[2] velocity; biasprm holds -kp and -kv, and
        # gainprm[0] is kp for a position actuator, kv for a velocity actuator
        bias = self._bias.read(selection)
        stiffness, damping = -bias[:, :, :1], -bias[:, :, 1:]
        if self._kp is not None:
            stiffness = self._kp(selection, -self._bias.original[:, :1]).to(bias.dtype)
        if self._kv is not None:
            damping = self._kv(selection, -self._bias.original[:, 1:]).to(bias.dtype)
        self._gain.write(selection, torch.where(self._is_position, stiffness, damping))
        self._bias.write(selection, torch.cat([-stiffness, -damping], dim=2))


@dataclass(kw_only=True, eq=False)
class RandomizePdGains(DrawKeys, JointTerm):
    """Random stiffness, damping and effort limit of joints with an actuator model (`scene.entities.*.actuators`).

    stiffness [N/m or N m/rad], damping [N s/m or N m s/rad], effort_limit [N or N m]; give at least one range.
    """

    derives = False

    stiffness: tuple[float, float] | None = None
    damping: tuple[float, float] | None = None
    effort_limit: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        pairs = {"stiffness": self.stiffness, "damping": self.damping, "effort_limit": self.effort_limit}
        if not any(pair is not None for pair in pairs.values()):
            missing = "neither stiffness, damping nor effort_limit is given, so the term changes nothing"
            raise NameProblem(missing, "give a range for one or more of them")
        driven = {
            joint: (model, column) for model in self.entity.actuators for column, joint in enumerate(model.joints)
        }
        supported = [joint in driven for joint in range(len(self.entity.joint_names))]
        hint = "randomize_actuator_gains changes MuJoCo's own actuators"
        require_supported(self.entity, "Joints", self.joints, supported, "without an actuator model", hint)
        chosen = column_numbers(self.joints, len(supported))
        self._parts = [(*driven[joint], number) for number, joint in enumerate(chosen)]
        self._draws = []
        for name, pair in pairs.items():
            if pair is not None:
                original = [getattr(model, name)[0, column] for model, column, _ in self._parts]
                draw = Draw(self, pair, (len(chosen), 1), lowest=0.0)
                self._draws.append((name, torch.stack(original)[:, None], draw))

    def __call__(self, selection: Selection) -> None:
        """Draw new gains for the selected environments."""
        for name, original, draw in self._draws:
            values = draw(selection, original)
            for model, column, number in self._parts:
                selection.write(getattr(model, name), values[:, number], slice(column, column + 1))


@dataclass(kw_only=True, eq=False)
class RandomizeEffortLimit(RangeKeys, ActuatorTerm):
    """Random effort limits of actuators, the same in both directions of the joint [N or N m].

    For a joint with an actuator model (`kind: pd` or `dc_motor`), the effort limit of the model is drawn.
    """

    derives = False

    def __post_init__(self) -> None:
        entity, model = self.entity, self.env.engine.model
        ids = entity.actuator_ids
        driven = {id: joint for joint, id in entity.actuators_of("motor")}
        places = {j: (each, column) for each in entity.actuators for column, j in enumerate(each.joints)}
        modelled = [places.get(driven.get(int(id), -1)) for id in ids]
        limited = [
            bool(model.actuator_forcelimited[id] if place is None else place[0].effort_limit[0, place[1]].isfinite())
            for id, place in zip(ids, modelled, strict=True)
        ]
        hint = "give the joint of the actuator an effort_limit"
        require_supported(entity, "Actuators", self.actuators, limited, "without an effort limit", hint)
        chosen = column_numbers(self.actuators, len(ids))
        own = [row for row, number in enumerate(chosen) if modelled[number] is None]
        self._own = as_index(own, self.env.device)
        self._field = ModelField(entity, "actuator_forcerange", as_index([chosen[row] for row in own]))
        self._modelled = [(*place, row) for row, number in enumerate(chosen) if (place := modelled[number]) is not None]
        gear = torch.as_tensor(model.actuator_gear[ids, 0]).abs()[[chosen[row] for row in own]]
        self._gear = torch.where(gear > 0, gear, 1.0)[:, None].to(self.env.device, self._field.original.dtype)
        self._effort = torch.zeros(len(chosen), 1, dtype=self._field.original.dtype, device=self.env.device)
        self._effort[self._own] = self._field.original[:, 1:] * self._gear
        for actuator, column, row in self._modelled:
            self._effort[row] = actuator.effort_limit[0, column]
        self._draw = Draw(self, self.range, (len(chosen), 1), lowest=0.0)

    def __call__(self, selection: Selection) -> None:
        """Draw new limits for the selected environments."""
        effort = self._draw(selection, self._effort)
        if self._field.shape[0]:
            force = effort[:, self._own] / self._gear
            self._field.write(selection, torch.cat([-force, force], dim=2))
        for actuator, column, row in self._modelled:
            values = effort[:, row].to(actuator.effort_limit.dtype)
            selection.write(actuator.effort_limit, values, slice(column, column + 1))


@dataclass(kw_only=True, eq=False)
class RandomizeActuatorStrength(DrawingTerm, ActuatorTerm):
    """Random strength of actuators: a factor on their effort and its limits; 0.9 is a motor that is 10 % too weak.

    The term supports MuJoCo's own actuators whose force is linear, and actuator models. `applied_effort` of an actuator
    model is the effort before the factor. No other event may change gains or effort limits in the task.
    """

    derives = False

    range: tuple[float, float]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    shared: bool = False

    def __post_init__(self) -> None:
        model, ids = self.env.engine.model, self.entity.actuator_ids
        gain, bias = model.actuator_gaintype[ids], model.actuator_biastype[ids]
        is_linear = (gain <= int(mujoco.mjtGain.mjGAIN_AFFINE)) & (bias <= int(mujoco.mjtBias.mjBIAS_AFFINE))
        linear = is_linear.tolist()
        require_supported(self.entity, "Actuators", self.actuators, linear, "with nonlinear force", "select no muscles")
        events = getattr(self.env, "config").events.items()  # noqa: B009 (events exist in managed environments only)
        others = [name for name, event in events if event is not None and _changes_actuators(event)]
        if others:
            raise NameProblem(
                f"events.{others[0]} changes the same fields of the model, so each event overwrites the other's values",
                "remove one of the two events",
            )
        fields = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
        self._fields = [ModelField(self.entity, name, self.actuators, _AXES.get(name)) for name in fields]
        self._draw = Draw(self, self.range, (self._fields[0].shape[0], 1), lowest=0.0)

    def __call__(self, selection: Selection) -> None:
        """Draw new factors for the selected environments."""
        one = torch.ones_like(self._fields[0].original[:, :1])
        factor = self._draw(selection, one)
        for field in self._fields:
            field.write(selection, field.original * factor)


_AXES = {"actuator_gainprm": [0, 1, 2], "actuator_biasprm": [0, 1, 2]}
"""Field of MjModel -> its columns for actuators with a linear force; the further columns belong to muscles."""


def _changes_actuators(event: Any) -> bool:
    """Return whether an event changes a field that `randomize_actuator_strength` changes."""
    if event.func == "randomize_model_field":
        return str(event.params["field"]) in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
    return event.func in ("randomize_actuator_gains", "randomize_effort_limit")


@dataclass(kw_only=True, eq=False)
class RandomizeModelField(DrawKeys, FieldRandomization):
    """Random values of any field of MuJoCo's MjModel that may differ between environments.

    field: name of the field in MjModel. names: the elements (bodies, joints, ...) to change. axes: the columns of an
    element to change; null: all.
    """

    entity: Entity = "robot"
    field: str
    names: str | list[str] = ".*"
    axes: list[int] | None = None
    range: tuple[float, float] | list[tuple[float, float]]

    def __post_init__(self) -> None:
        self.model_field = self.field
        super().__post_init__()

    def selected(self) -> Columns | None:
        """Return the index of the elements that match `names`; None for a field without named elements."""
        kind = FIELDS.get(self.field)
        return self.entity.select(kind, self.names)[0] if kind else None

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Clear the `simple` flag of bodies whose inertial frame changes: with it, MuJoCo ignores this frame."""
        if params["field"] in ("body_ipos", "body_iquat"):
            unset_simple(spec, params, "names")
