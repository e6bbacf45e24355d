"""Compute the efforts that actuators would have on an entity's joints without limits, and the limits.

Terms that penalise saturated actuators use these efforts.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from rlcli.scene.entity import Entity


class JointEfforts:
    """Efforts on an entity's joints, from actuator models and from simple actuators of MuJoCo.

    A simple actuator has a fixed gain, no bias or an affine one, and no dynamics of its own: its force is
    gain x control + constant + k1 x length + k2 x velocity, where length and velocity are gear x those of the joint.
    """

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
        self._force_limited = torch.tensor(model.actuator_forcelimited[ids], dtype=torch.bool, device=device)
        self._control_limited = torch.tensor(model.actuator_ctrllimited[ids], dtype=torch.bool, device=device)
        largest = np.abs(model.jnt_actfrcrange[entity.joint_ids]).max(axis=1)
        limits = np.where(model.jnt_actfrclimited[entity.joint_ids], largest, math.inf)
        self._joint_limits = torch.tensor(limits, dtype=torch.float32, device=device)
        self._driven = torch.zeros(len(columns), dtype=torch.bool, device=device)
        self._driven[self._columns] = True
        self._no_range = torch.tensor([-math.inf, math.inf], device=device)
        self._clamped = (self._control_limited & ~self._is_motor)[:, None]

    def without_limits(self) -> Tensor:
        """Return the effort of the actuators on each joint before limits. (num_envs, k) [N or N m]"""
        entity = self._entity
        gear, q, v = self._gear, entity.data.joint_pos[:, self._columns], entity.data.joint_vel[:, self._columns]
        gain, bias = self._current("actuator_gainprm"), self._current("actuator_biasprm")
        low, high = torch.where(self._clamped, self._current("actuator_ctrlrange"), self._no_range).unbind(-1)
        control = entity.engine.field("ctrl")[:, self._ids].float().clamp(low, high)
        affine = torch.where(self._is_motor, 0.0, bias[..., 0] + bias[..., 1] * gear * q + bias[..., 2] * gear * v)
        efforts = self._sum_by_joint(gear * (gain[..., 0] * control + affine))
        for model in entity.actuators:
            efforts[:, model.columns] = model.computed_effort
        return efforts

    def removed_by_limits(self) -> Tensor:
        """Return how much limits reduce the magnitude of each joint's effort, at least 0. (num_envs, k) [N or N m]"""
        data = self._entity.data
        excess = (data.computed_effort.abs() - data.joint_effort_limits).clamp_(min=0.0)
        for model in self._entity.actuators:
            excess[:, model.columns] = (model.computed_effort - model.applied_effort).abs_()
        return excess

    def limits(self) -> Tensor:
        """Return the largest effort on each joint; infinite without a limit. (1 or num_envs, k) [N or N m]"""
        gain, force = self._current("actuator_gainprm")[..., 0], self._current("actuator_forcerange")
        largest = torch.where(self._force_limited, force.abs().amax(dim=-1), math.inf)
        control = (gain[..., None] * self._current("actuator_ctrlrange")).abs().amax(dim=-1)
        largest = torch.where(self._control_limited & self._is_motor, torch.minimum(largest, control), largest)
        of_actuators = torch.where(self._driven, self._sum_by_joint(self._gear.abs() * largest), math.inf)
        limits = torch.minimum(of_actuators, self._joint_limits)
        if self._entity.actuators:
            limits = limits.expand(self._entity.engine.num_envs, -1).clone()
        for model in self._entity.actuators:
            limits[:, model.columns] = model.effort_limit
        return limits

    def _sum_by_joint(self, values: Tensor) -> Tensor:
        """Return, for each joint, the sum of the values of its actuators. (n, actuators) -> (n, k)"""
        total = torch.zeros(len(values), len(self._joint_limits), device=values.device)
        return total.index_add_(1, self._columns, values)

    def _current(self, name: str) -> Tensor:
        """Return the model field `name` of the actuators, with its randomisation. (1 or num_envs, actuators, n)"""
        own = self._entity.engine.expanded(name)
        return self._constant[name] if own is None else own[:, self._ids].float()
