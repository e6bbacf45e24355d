"""Efforts of the actuators on an entity's joints, with and without their limits."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.sim.column_views import as_index
from rlcli.sim.selection import Columns

if TYPE_CHECKING:
    from rlcli.scene.actuators import ActuatorModel
    from rlcli.scene.entity import Entity


class JointEfforts:
    """The actuators on an entity's joints whose force is gain x control + an affine function of the joint's state."""

    def __init__(self, entity: Entity) -> None:
        self._entity = entity
        model, device = entity.engine.model, entity.engine.device
        columns = {int(joint): column for column, joint in enumerate(entity.joint_ids)}
        ids = [
            a
            for a in range(model.nu)
            if int(model.actuator_trnid[a, 0]) in columns
            and model.actuator_gear[a, 0]
            and model.actuator_trntype[a] == int(mujoco.mjtTrn.mjTRN_JOINT)
            and model.actuator_dyntype[a] == int(mujoco.mjtDyn.mjDYN_NONE)
            and model.actuator_gaintype[a] == int(mujoco.mjtGain.mjGAIN_FIXED)
            and model.actuator_biastype[a] in (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
        ]
        self._ids = torch.tensor(ids, dtype=torch.int64, device=device)
        self._columns = torch.tensor([columns[int(model.actuator_trnid[a, 0])] for a in ids], device=device).long()
        self._gear = torch.tensor(model.actuator_gear[ids, 0], dtype=torch.float32, device=device)
        self._is_motor = torch.tensor(model.actuator_biastype[ids] == int(mujoco.mjtBias.mjBIAS_NONE), device=device)
        self._constant = {
            name: torch.tensor(getattr(model, name)[ids][None], dtype=torch.float32, device=device)
            for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_ctrlrange")
        }
        self._force_limited, self._control_limited = (
            torch.tensor(values[ids], dtype=torch.bool, device=device)
            for values in (model.actuator_forcelimited, model.actuator_ctrllimited)
        )
        self._joint_limits = torch.full((len(columns),), math.inf, device=device)
        limited = np.flatnonzero(model.jnt_actfrclimited[entity.joint_ids])
        for column in limited:
            high = np.abs(model.jnt_actfrcrange[entity.joint_ids[column]]).max()
            self._joint_limits[int(column)] = float(high)
        self._driven = torch.zeros(len(columns), dtype=torch.bool, device=device)
        self._driven[self._columns] = True
        self._no_range = torch.tensor([-math.inf, math.inf], device=device)
        self._clamped = (self._control_limited & ~self._is_motor)[:, None]
        self._columns_of_models: list[tuple[ActuatorModel, Columns]] = []

    def without_limits(self) -> Tensor:
        """Return the efforts before limits. (num_envs, k)"""
        entity = self._entity
        gear, q, v = self._gear, entity.data.joint_pos[:, self._columns], entity.data.joint_vel[:, self._columns]
        gain, bias = self._now("actuator_gainprm"), self._now("actuator_biasprm")
        low, high = torch.where(self._clamped, self._now("actuator_ctrlrange"), self._no_range).unbind(-1)
        control = entity.engine.field("ctrl")[:, self._ids].float().clamp(low, high)
        affine = torch.where(self._is_motor, 0.0, bias[..., 0] + bias[..., 1] * gear * q + bias[..., 2] * gear * v)
        efforts = self._by_joint(gear * (gain[..., 0] * control + affine))
        for model, columns in self._models():
            efforts[:, columns] = model.computed_effort
        return efforts

    def removed_by_limits(self) -> Tensor:
        """Return how much limits reduce the efforts. (num_envs, k)"""
        data = self._entity.data
        beyond = (data.computed_effort.abs() - data.joint_effort_limits).clamp_(min=0.0)
        for model, columns in self._models():
            beyond[:, columns] = (model.computed_effort - model.applied_effort).abs_()
        return beyond

    def limits(self) -> Tensor:
        """Return the largest efforts. (1 or num_envs, k)"""
        gain, force = self._now("actuator_gainprm")[..., 0], self._now("actuator_forcerange")
        largest = torch.where(self._force_limited, force.abs().amax(dim=-1), math.inf)
        control = (gain[..., None] * self._now("actuator_ctrlrange")).abs().amax(dim=-1)
        largest = torch.where(self._control_limited & self._is_motor, torch.minimum(largest, control), largest)
        limits = torch.minimum(
            torch.where(self._driven, self._by_joint(self._gear.abs() * largest), math.inf), self._joint_limits
        )
        if self._entity.actuators:
            limits = limits.expand(self._entity.engine.num_envs, -1).clone()
        for model, columns in self._models():
            limits[:, columns] = model.effort_limit
        return limits

    def _models(self) -> list[tuple[ActuatorModel, Columns]]:
        """The entity's actuator models, which are made after it, with the joints that they drive."""
        if len(self._columns_of_models) != len(self._entity.actuators):
            device = self._entity.engine.device
            self._columns_of_models = [(m, as_index(m.joints, device)) for m in self._entity.actuators]
        return self._columns_of_models

    def _by_joint(self, values: Tensor) -> Tensor:
        total = torch.zeros(len(values), len(self._joint_limits), device=values.device)
        return total.index_add_(1, self._columns, values)

    def _now(self, name: str) -> Tensor:
        own = self._entity.engine.expanded(name)
        return self._constant[name] if own is None else own[:, self._ids].float()
