"""Randomisation of actuators, and of any model field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import torch

from rlcli.mdp.randomization_base import (
    DrawingTerm,
    FieldRandomization,
    RangeKeys,
    matching_elements,
    on_host,
    require_able,
)
from rlcli.mdp.term import ActuatorTerm, JointTerm
from rlcli.scene.joint_setup import model_actuator_kind
from rlcli.scene.model_fields import FIELDS, ModelField
from rlcli.scene.names import NameProblem
from rlcli.sim.selection import Columns, Selection
from rlcli.task import Entity


@dataclass(kw_only=True, eq=False)
class RandomizeActuatorGains(DrawingTerm, ActuatorTerm):
    """Gains of MuJoCo's own actuators: kp of position [N/m or N m/rad], kv of position and velocity ones [x s]."""

    derives = False

    kp: tuple[float, float] | None = None
    kv: tuple[float, float] | None = None
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "scale"
    shared: bool = False

    def __post_init__(self) -> None:
        if self.kp is None and self.kv is None:
            raise NameProblem("nothing to randomise", "give kp, kv or both")
        kinds = _kinds(self.entity)
        can_kp = [kind == "position" for kind in kinds]
        can_kv = [kind in ("position", "velocity") for kind in kinds]
        if self.kp is not None:
            require_able(self.entity, "Actuators", self.actuators, can_kp, "has no kp", "kp is a position actuator's")
        if self.kv is not None:
            require_able(
                self.entity, "Actuators", self.actuators, can_kv, "has no kv", "kv is a position or velocity actuator's"
            )
        self._gain = ModelField(self.entity, "actuator_gainprm", self.actuators, [0])
        self._bias = ModelField(self.entity, "actuator_biasprm", self.actuators, [1, 2])
        is_position = torch.tensor(can_kp)[on_host(self.actuators)]
        self._is_position = is_position[:, None].to(self.env.device)
        shape = (self._gain.shape[0], 1)
        self._kp, self._kv = (
            None if pair is None else self.new_draw(pair, shape, lowest=0.0) for pair in (self.kp, self.kv)
        )

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        bias = self._bias.read(selection)
        stiffness, damping = -bias[:, :, :1], -bias[:, :, 1:]
        if self._kp is not None:
            stiffness = self._kp(selection, -self._bias.original[:, :1]).to(bias.dtype)
        if self._kv is not None:
            damping = self._kv(selection, -self._bias.original[:, 1:]).to(bias.dtype)
        self._gain.write(selection, torch.where(self._is_position, stiffness, damping))
        self._bias.write(selection, torch.cat([-stiffness, -damping], dim=2))


@dataclass(kw_only=True, eq=False)
class RandomizePdGains(DrawingTerm, JointTerm):
    """Actuator models (`scene.entities.*.actuators`): stiffness, damping [x s], effort limit [N or N m] of joints."""

    derives = False

    stiffness: tuple[float, float] | None = None
    damping: tuple[float, float] | None = None
    effort_limit: tuple[float, float] | None = None
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "scale"
    shared: bool = False

    def __post_init__(self) -> None:
        pairs = {"stiffness": self.stiffness, "damping": self.damping, "effort_limit": self.effort_limit}
        if not any(pair is not None for pair in pairs.values()):
            raise NameProblem("nothing to randomise", "give stiffness, damping, effort_limit or several")
        driven = {joint: (model, place) for model in self.entity.actuators for place, joint in enumerate(model.joints)}
        good = [joint in driven for joint in range(len(self.entity.joint_names))]
        require_able(
            self.entity,
            "Joints",
            self.joints,
            good,
            "has no actuator model",
            "randomize_actuator_gains has MuJoCo's own",
        )
        chosen = torch.arange(len(good))[on_host(self.joints)].tolist()
        self._parts = [(*driven[joint], number) for number, joint in enumerate(chosen)]
        self._draws = []
        for name, pair in pairs.items():
            if pair is not None:
                own = [getattr(model, name)[0, place] for model, place, _ in self._parts]
                draw = self.new_draw(pair, (len(chosen), 1), lowest=0.0)
                self._draws.append((name, torch.stack(own)[:, None], draw))

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        for name, original, draw in self._draws:
            values = draw(selection, original)
            for model, place, number in self._parts:
                selection.write(getattr(model, name), values[:, number], slice(place, place + 1))


@dataclass(kw_only=True, eq=False)
class RandomizeEffortLimit(RangeKeys, ActuatorTerm):
    """Largest force of MuJoCo's own actuators on their joints, to both sides [N or N m]."""

    derives = False

    def __post_init__(self) -> None:
        limited = self.env.engine.model.actuator_forcelimited[self.entity.actuator_ids].astype(bool).tolist()
        require_able(
            self.entity, "Actuators", self.actuators, limited, "has no effort limit", "give its joint an effort_limit"
        )
        self._field = ModelField(self.entity, "actuator_forcerange", self.actuators)
        gear = self.env.engine.model.actuator_gear[self.entity.actuator_ids, 0]
        chosen = torch.as_tensor(gear).abs()[on_host(self.actuators)]
        self._gear = torch.where(chosen > 0, chosen, 1.0)[:, None].to(self.env.device, self._field.original.dtype)
        self._effort = self._field.original[:, 1:] * self._gear
        shape = (self._field.shape[0], 1)
        self._draw = self.new_draw(self.range, shape, lowest=0.0)

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        force = self._draw(selection, self._effort) / self._gear
        self._field.write(selection, torch.cat([-force, force], dim=2))


@dataclass(kw_only=True, eq=False)
class RandomizeModelField(FieldRandomization):
    """Any number of the model that may differ between environments, by its name in MuJoCo's MjModel."""

    entity: Entity = "robot"
    field: str
    names: str | list[str] = ".*"
    axes: list[int] | None = None
    range: tuple[float, float] | list[tuple[float, float]]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "scale"
    shared: bool = False

    def __post_init__(self) -> None:
        self.model_field = self.field
        super().__post_init__()

    def selected(self) -> Columns | None:
        """Return the elements called `names`."""
        kind = FIELDS.get(self.field)
        return self.entity.select(kind, self.names)[0] if kind else None

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Have MuJoCo compile bodies whose mass is moved or turned as ones where it may lie anyhow."""
        if params["field"] in ("body_ipos", "body_iquat"):
            for body in matching_elements(spec.bodies, params, "names", "body"):
                body.simple = 0


def _kinds(entity: Entity) -> list[str]:
    return [model_actuator_kind(entity.engine.model, a) for a in entity.actuator_ids.tolist()]
