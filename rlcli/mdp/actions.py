"""Action terms. Each takes its columns of the policy's vector and writes controls of MuJoCo actuators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.managers.action import CommandMap
from rlcli.sim.entity import as_index
from rlcli.sim.names import NameProblem
from rlcli.sim.selection import Columns
from rlcli.task import Entity, Joints, Range

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


class _JointAction:
    """raw x scale + offset, then clip, then the actuators of `joints`, in exactly the order written."""

    actuator: ClassVar[str]
    unit: str

    def __init__(
        self,
        env: ManagedEnv,
        entity: Entity,
        joints: Columns,
        scale: float,
        offset: Tensor | float,
        clip: Range | None,
    ) -> None:
        columns = torch.arange(len(entity.joint_names), device=env.device)[joints].tolist()
        driven = dict(entity.actuators_of(self.actuator))
        self.elements = tuple(entity.joint_names[c] for c in columns)
        missing = [name for name, c in zip(self.elements, columns, strict=True) if c not in driven]
        if missing:
            raise NameProblem(f"no {self.actuator} actuator drives {', '.join(missing)}")
        self.actuators = actuators = [driven[c] for c in columns]
        self.size = len(columns)
        self._scale, self._offset, self._clip = scale, offset, clip
        gear = torch.tensor(entity.engine.model.actuator_gear[actuators, 0], dtype=torch.float32, device=env.device)
        self._factor = 1.0 / gear if self.actuator == "motor" else gear
        self._geared = bool((gear != 1.0).any())
        self._limits = _command_limits(entity.engine.model, actuators, self.actuator)
        self._ctrl = entity.engine.field("ctrl")
        self._columns = as_index(actuators, env.device)
        # consecutive controls: a view of the engine's own, made once
        self._target = self._ctrl[:, self._columns] if isinstance(self._columns, slice) else None
        self.command = torch.zeros(env.num_envs, self.size, device=env.device)
        """What reaches the actuators, before their own limits. (num_envs, size)"""

    def command_map(self) -> CommandMap:
        """What `process` computes, and the limits of the actuators behind it."""
        offset = self._offset[0].tolist() if isinstance(self._offset, Tensor) else [self._offset] * self.size
        return CommandMap((self._scale,) * self.size, tuple(offset), self._clip, self._limits)

    def process(self, action: Tensor) -> None:
        """Write the controls of this step. (num_envs, size)"""
        torch.mul(action, self._scale, out=self.command)
        if isinstance(self._offset, Tensor) or self._offset:
            self.command += self._offset
        if self._clip is not None:
            self.command.clamp_(*self._clip)
        command = self.command * self._factor if self._geared else self.command
        if self._target is not None:
            self._target.copy_(command)
        else:
            self._ctrl[:, self._columns] = command.to(self._ctrl.dtype)


class JointEffort(_JointAction):
    """Efforts of joint motors: raw x scale + offset [N or N m]. Isaac Lab: JointEffortAction."""

    actuator = "motor"
    unit = "N or N m"

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        scale: float = 1.0,
        offset: float = 0.0,
        clip: Range | None = None,
    ) -> None:
        super().__init__(env, entity, joints, scale, offset, clip)


class JointPosition(_JointAction):
    """Targets of position actuators: raw x scale + offset [m or rad], about the default pose unless told otherwise.

    Isaac Lab: JointPositionAction.
    """

    actuator = "position"
    unit = "m or rad"

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        scale: float = 1.0,
        offset: float = 0.0,
        use_default_offset: bool = True,
        clip: Range | None = None,
    ) -> None:
        default = entity.data.default_joint_pos[:, joints] + offset if use_default_offset else offset
        super().__init__(env, entity, joints, scale, default, clip)


def _command_limits(model: mujoco.MjModel, actuators: list[int], kind: str) -> tuple[tuple[float, float], ...]:
    """Commands beyond which each actuator gives no more: its control range, and what bounds a motor's force."""
    limits = []
    for a in actuators:
        gain, gear, joint = model.actuator_gainprm[a, 0], model.actuator_gear[a, 0], model.actuator_trnid[a, 0]
        low, high = model.actuator_ctrlrange[a] if model.actuator_ctrllimited[a] else (-math.inf, math.inf)
        if not gain or not gear:
            low, high = -math.inf, math.inf  # it moves nothing
        elif kind != "motor":
            low, high = sorted((low / gear, high / gear))
        else:
            if model.actuator_forcelimited[a]:
                low, high = _overlap((low, high), sorted(model.actuator_forcerange[a] / gain))
            low, high = sorted((low * gear, high * gear))
            alone = np.count_nonzero(model.actuator_trnid[:, 0] == joint) == 1
            if model.jnt_actfrclimited[joint] and alone:
                low, high = _overlap((low, high), sorted(model.jnt_actfrcrange[joint] / gain))
        limits.append((float(low), float(high)))
    return tuple(limits)


def _overlap(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    return max(a[0], b[0]), min(a[1], b[1])
