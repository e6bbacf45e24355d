"""Randomisation of actuators, and of any model field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import torch

from rlcli.mdp.randomization_base import Draw, DrawKeys, FieldRandomization, RangeKeys, require_supported, unset_simple
from rlcli.mdp.term import ActuatorTerm, JointTerm
from rlcli.mdp.term_helpers import column_numbers, on_host
from rlcli.scene.joint_and_actuator_setup import model_actuator_kind
from rlcli.scene.model_fields import FIELDS, ModelField
from rlcli.scene.names import NameProblem
from rlcli.sim.selection import Columns, Selection
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
            raise NameProblem("no gain is given, so the term changes nothing", "give kp, kv or both")
        model = self.env.engine.model
        kinds = [model_actuator_kind(model, number) for number in self.entity.actuator_ids.tolist()]
        has_kp = [kind == "position" for kind in kinds]
        has_kv = [kind in ("position", "velocity") for kind in kinds]
        if self.kp is not None:
            hint = "only position actuators have kp"
            require_supported(self.entity, "Actuators", self.actuators, has_kp, "has no kp", hint)
        if self.kv is not None:
            hint = "only position and velocity actuators have kv"
            require_supported(self.entity, "Actuators", self.actuators, has_kv, "has no kv", hint)
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
            raise NameProblem("the term changes nothing", "give stiffness, damping or effort_limit")
        driven = {
            joint: (model, column) for model in self.entity.actuators for column, joint in enumerate(model.joints)
        }
        supported = [joint in driven for joint in range(len(self.entity.joint_names))]
        hint = "randomize_actuator_gains changes MuJoCo's own actuators"
        require_supported(self.entity, "Joints", self.joints, supported, "has no actuator model", hint)
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
    """Random effort limits of MuJoCo's own actuators, the same in both directions of the joint [N or N m]."""

    derives = False

    def __post_init__(self) -> None:
        limited = self.env.engine.model.actuator_forcelimited[self.entity.actuator_ids].astype(bool).tolist()
        hint = "give its joint an effort_limit"
        require_supported(self.entity, "Actuators", self.actuators, limited, "has no effort limit", hint)
        self._field = ModelField(self.entity, "actuator_forcerange", self.actuators)
        gear = self.env.engine.model.actuator_gear[self.entity.actuator_ids, 0]
        chosen = torch.as_tensor(gear).abs()[on_host(self.actuators)]
        self._gear = torch.where(chosen > 0, chosen, 1.0)[:, None].to(self.env.device, self._field.original.dtype)
        self._effort = self._field.original[:, 1:] * self._gear
        self._draw = Draw(self, self.range, (self._field.shape[0], 1), lowest=0.0)

    def __call__(self, selection: Selection) -> None:
        """Draw new limits for the selected environments."""
        force = self._draw(selection, self._effort) / self._gear
        self._field.write(selection, torch.cat([-force, force], dim=2))


@dataclass(kw_only=True, eq=False)
class RandomizeModelField(DrawKeys, FieldRandomization):
    """Random values of any field of MuJoCo's MjModel that may differ between environments.

    field: its name in MjModel. names: the elements to change. axes: the columns of an element to change; default all.
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
        """Return the index of the elements that match `names`."""
        kind = FIELDS.get(self.field)
        return self.entity.select(kind, self.names)[0] if kind else None

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Clear the `simple` flag of bodies whose inertial frame changes: it fixes that frame to the body's."""
        if params["field"] in ("body_ipos", "body_iquat"):
            unset_simple(spec, params, "names")
