"""Action terms. Each takes its columns of the policy's vector and writes controls of MuJoCo actuators."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

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
        columns = torch.arange(len(entity.joint_names))[joints].tolist()
        driven = dict(entity.actuators_of(self.actuator))
        self.elements = tuple(entity.joint_names[c] for c in columns)
        missing = [name for name, c in zip(self.elements, columns, strict=True) if c not in driven]
        if missing:
            raise NameProblem(f"no {self.actuator} actuator drives {', '.join(missing)}")
        self.actuators = actuators = [driven[c] for c in columns]
        self.size = len(columns)
        self._scale, self._offset, self._clip = scale, offset, clip
        gear = torch.tensor(entity.engine.model.actuator_gear[actuators, 0], dtype=torch.float32)
        self._factor = 1.0 / gear if self.actuator == "motor" else gear
        self._geared = bool((gear != 1.0).any())
        self._ctrl = entity.engine.field("ctrl")
        self._columns = as_index(actuators)
        # consecutive controls: a view of the engine's own, made once
        self._target = self._ctrl[:, self._columns] if isinstance(self._columns, slice) else None
        self.command = torch.zeros(env.num_envs, self.size, device=env.device)
        """What reaches the actuators, before their own limits. (num_envs, size)"""

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
