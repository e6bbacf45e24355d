"""Action terms. Each takes its columns of the policy's vector and writes controls of MuJoCo actuators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.managers.action import CommandMap
from rlcli.mdp.parameters import Entity
from rlcli.scene.actuators import JointCommand
from rlcli.scene.kinematics import Jacobian
from rlcli.scene.names import NameProblem, match_values
from rlcli.sim.rotations import conjugate, multiply, rotate, rotation_vector
from rlcli.sim.selection import Selection, one_column
from rlcli.sim.tensor_state import TensorState
from rlcli.task import Bodies, Joints, Range

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


class _JointAction:
    """Some columns become a command, which is clipped and given to what drives `joints`, in the order written."""

    actuator: ClassVar[str]
    """What the scene gives joints that nothing of the kind drives."""
    unit: str

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        scale: float | dict[str, float] = 1.0,
        clip: Range | dict[str, Range] | None = None,
    ) -> None:
        self._entity, self._joints = entity, joints
        columns = torch.arange(len(entity.joint_names))[joints if isinstance(joints, slice) else joints.cpu()].tolist()
        self.elements = tuple(entity.joint_names[c] for c in columns)
        self._drive = JointCommand(entity, self.actuator, columns)
        self.sinks = self._drive.sinks
        self.actuators = self._drive.actuators
        """MuJoCo's actuator behind each joint; None where an actuator model drives it."""
        self.size = len(columns)
        self._scale = self._by_joint(scale, 1.0, env)
        self._clip = self._bounds(clip, env)
        self.command = torch.zeros(env.num_envs, self.size, device=env.device)
        """What reaches the actuators, before their own limits. (num_envs, joints)"""

    def process(self, action: Tensor) -> None:
        """Write the controls of this step. (num_envs, size)"""
        self._target(action)
        if self._clip is not None:
            self.command.clamp_(*self._clip)
        self._drive.write(self.command)

    def _target(self, action: Tensor) -> None:
        """Fill `command`."""
        raise NotImplementedError

    def _by_joint(self, value: float | dict[str, float], default: float, env: ManagedEnv) -> float | Tensor:
        """A number, or one for each column; a mapping leaves joints that it does not name at `default`."""
        if not isinstance(value, dict):
            return value
        values = [default if v is None else v for v in match_values(value, self.elements, "joint")]
        return torch.tensor(values, dtype=torch.float32, device=env.device)

    def _bounds(self, clip: Range | dict[str, Range] | None, env: ManagedEnv) -> tuple[Tensor, Tensor] | None:
        if clip is None:
            return None
        ends = {".*": clip} if not isinstance(clip, dict) else clip
        low = self._by_joint({pattern: pair[0] for pattern, pair in ends.items()}, -math.inf, env)
        high = self._by_joint({pattern: pair[1] for pattern, pair in ends.items()}, math.inf, env)
        assert isinstance(low, Tensor)
        assert isinstance(high, Tensor)
        return low, high


class _AffineJointAction(_JointAction):
    """raw x scale + offset: an exported policy can contain it."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        scale: float | dict[str, float] = 1.0,
        offset: float | dict[str, float] = 0.0,
        clip: Range | dict[str, Range] | None = None,
    ) -> None:
        super().__init__(env, entity=entity, joints=joints, scale=scale, clip=clip)
        # a number is wrapped into a tensor at each use, which costs as much as the product
        self._factor = torch.as_tensor(self._scale, dtype=torch.float32, device=env.device)
        self._offset = self._by_joint(offset, 0.0, env)
        self._limits = _command_limits(entity.engine.model, self._drive.actuators, self.actuator)

    def command_map(self) -> CommandMap:
        """What `process` computes, and the limits of the actuators behind it."""
        scale, offset = (self._each(value) for value in (self._scale, self._offset))
        clip = None if self._clip is None else tuple(zip(*map(self._each, self._clip), strict=True))
        return CommandMap(scale, offset, clip, self._limits)

    def _target(self, action: Tensor) -> None:
        torch.mul(action, self._factor, out=self.command)
        if isinstance(self._offset, Tensor) or self._offset:
            self.command += self._offset

    def _each(self, value: float | Tensor) -> tuple[float, ...]:
        """One number a column, which all environments share."""
        if isinstance(value, Tensor):
            return tuple((value[0] if value.dim() == 2 else value).tolist())
        return (value,) * self.size


class _AffineAboutDefault(_AffineJointAction):
    """raw x scale + offset, about the default of the quantity unless told otherwise."""

    default: ClassVar[str]
    """The defaults' name among an entity's data."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        scale: float | dict[str, float] = 1.0,
        offset: float | dict[str, float] = 0.0,
        use_default_offset: bool = True,
        clip: Range | dict[str, Range] | None = None,
    ) -> None:
        super().__init__(env, entity=entity, joints=joints, scale=scale, offset=offset, clip=clip)
        if use_default_offset:
            self._offset = getattr(entity.data, self.default)[:, joints] + self._offset


class JointEffort(_AffineJointAction):
    """Efforts of joint motors: raw x scale + offset [N or N m]. Isaac Lab: JointEffortAction."""

    actuator = "motor"
    unit = "N or N m"


class JointPosition(_AffineAboutDefault):
    """Targets of position actuators: raw x scale + offset [m or rad], about the default pose unless told otherwise.

    Isaac Lab: JointPositionAction.
    """

    actuator = "position"
    unit = "m or rad"
    default = "default_joint_pos"


class JointVelocity(_AffineAboutDefault):
    """Targets of velocity actuators: raw x scale + offset [m/s or rad/s]. Isaac Lab: JointVelocityAction."""

    actuator = "velocity"
    unit = "m/s or rad/s"
    default = "default_joint_vel"


class RelativeJointPosition(_JointAction):
    """Targets of position actuators: the joint's position of this step + raw x scale [m or rad].

    Isaac Lab: RelativeJointPositionAction.
    """

    actuator = "position"
    unit = "m or rad"

    def _target(self, action: Tensor) -> None:
        torch.add(self._entity.data.joint_pos_of(self._joints), action * self._scale, out=self.command)


class JointPositionToLimits(_JointAction):
    """Targets of position actuators: raw x scale, within [-1, 1], stretched over the soft limits [m or rad].

    With `rescale_to_limits: false` it is the target itself, kept within the limits. Isaac Lab:
    JointPositionToLimitsAction.
    """

    actuator = "position"
    unit = "m or rad"

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        scale: float | dict[str, float] = 1.0,
        rescale_to_limits: bool = True,
        clip: Range | dict[str, Range] | None = None,
    ) -> None:
        super().__init__(env, entity=entity, joints=joints, scale=scale, clip=clip)
        self._rescale = rescale_to_limits
        limits = entity.data.soft_joint_pos_limits[joints]
        if rescale_to_limits and not bool(limits.isfinite().all()):
            unlimited = self.elements[int((~limits.isfinite().all(dim=-1)).nonzero()[0, 0])]
            raise NameProblem(
                f"joint '{unlimited}' has no limits to stretch over", "give it a range, or another action"
            )

    def _target(self, action: Tensor) -> None:
        self.command.copy_(self._asked(action))

    def _asked(self, action: Tensor) -> Tensor:
        low, high = self._entity.data.soft_joint_pos_limits[self._joints].unbind(-1)
        raw = action * self._scale
        if not self._rescale:
            return raw.clamp(low, high)
        return 0.5 * (raw.clamp(-1.0, 1.0) * (high - low) + high + low)


class EmaJointPositionToLimits(JointPositionToLimits, TensorState):
    """The same, averaged over time: alpha x new target + (1 - alpha) x the target before, from the joint's position.

    Isaac Lab: EMAJointPositionToLimitsAction.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        scale: float | dict[str, float] = 1.0,
        rescale_to_limits: bool = True,
        alpha: float | dict[str, float] = 1.0,
        clip: Range | dict[str, Range] | None = None,
    ) -> None:
        super().__init__(env, entity=entity, joints=joints, scale=scale, rescale_to_limits=rescale_to_limits, clip=clip)
        self._alpha = self._by_joint(alpha, 1.0, env)
        self._before = torch.zeros_like(self.command)
        self._fresh = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)

    def _target(self, action: Tensor) -> None:
        low, high = self._entity.data.soft_joint_pos_limits[self._joints].unbind(-1)
        before = torch.where(self._fresh[:, None], self._entity.data.joint_pos_of(self._joints), self._before)
        self._before.copy_((self._alpha * self._asked(action) + (1.0 - self._alpha) * before).clamp(low, high))
        self.command.copy_(self._before)
        self._fresh.zero_()

    def reset(self, selection: Selection) -> None:
        """New episodes average from where their joints start."""
        selection.write(self._fresh, True)

    def tensors(self) -> dict[str, Tensor]:
        """Return the target before."""
        return {"before": self._before, "fresh": self._fresh}


class _BinaryJoint(_JointAction):
    """One column opens or closes several joints."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints,
        open_command: dict[str, float],
        close_command: dict[str, float],
        threshold: float = 0.0,
    ) -> None:
        super().__init__(env, entity=entity, joints=joints)
        self._open, self._close = (self._all(c, w, env) for c, w in ((open_command, "open"), (close_command, "close")))
        self._threshold = threshold
        self.elements, self.size = (",".join(self.elements),), 1

    def _target(self, action: Tensor) -> None:
        self.command.copy_(torch.where(action < self._threshold, self._close, self._open))

    def _all(self, command: dict[str, float], which: str, env: ManagedEnv) -> Tensor:
        values = self._by_joint(command, math.nan, env)
        assert isinstance(values, Tensor)
        if bool(values.isnan().any()):
            name = self.elements[int(values.isnan().nonzero()[0, 0])]
            raise NameProblem(f"{which}_command has no value for joint '{name}'")
        return values


class BinaryJointPosition(_BinaryJoint):
    """A gripper by position: `open_command` where raw >= threshold, else `close_command` [m or rad].

    Isaac Lab: BinaryJointPositionAction, and AbsBinaryJointPositionAction with its threshold.
    """

    actuator = "position"
    unit = "m or rad"


class BinaryJointVelocity(_BinaryJoint):
    """A gripper by velocity: `open_command` where raw >= threshold, else `close_command` [m/s or rad/s].

    Isaac Lab: BinaryJointVelocityAction.
    """

    actuator = "velocity"
    unit = "m/s or rad/s"


class DifferentialInverseKinematics(_JointAction):
    """Joint position targets that move a body's frame to a pose, by damped least squares [m or rad].

    dq = J^T (J J^T + damping^2 I)^-1 e, with J the body's geometric Jacobian and e the error of its pose in the root's
    frame, once a step. `mode` position takes 3 columns, pose 7 (position, quaternion w x y z), or 6 if `relative`
    (position, axis times angle): relative ones are x scale and added to where the body is. The pose is that of a point
    `offset_pos`, `offset_quat` in the body's frame. Joints to spare go `posture` of the way to their default pose in a
    step, as far as the body stays where dq has it: dq + (I - J^T (J J^T + damping^2 I)^-1 J) posture (default - q).
    Without, an arm of seven joints wanders into its limits. Isaac Lab: DifferentialInverseKinematicsAction (ik_method
    dls); mjlab: posture_weight.
    """

    actuator = "position"
    unit = "m or rad"

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        bodies: Bodies,
        mode: Literal["position", "pose"] = "pose",
        relative: bool = False,
        scale: float = 1.0,
        damping: float = 0.01,
        posture: float = 0.0,
        offset_pos: tuple[float, float, float] = (0.0, 0.0, 0.0),
        offset_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
        clip: Range | dict[str, Range] | None = None,
    ) -> None:
        super().__init__(env, entity=entity, joints=joints, scale=scale, clip=clip)
        self._body = one_column(bodies, len(entity.body_ids), "bodies")
        self._mode, self._relative, self._damping, self._posture = mode, relative, damping, posture
        self._point = torch.tensor(offset_pos, device=env.device)
        self._turn = torch.tensor(offset_quat, device=env.device)
        columns = [entity.joint_names.index(name) for name in self.elements]
        self._jacobian = Jacobian(entity, columns, self._body)
        self.joint_names = self.elements
        parts = ["x", "y", "z"] + ([] if mode == "position" else ["rx", "ry", "rz"] if relative else list("wijk"))
        self.elements, self.size = tuple(parts), len(parts)

    def _target(self, action: Tensor) -> None:
        data = self._entity.data
        quat = data.body_quat_w[:, self._body]
        arm = rotate(quat, self._point.expand(len(quat), 3))
        position, quat = data.body_pos_w[:, self._body] + arm, multiply(quat, self._turn.expand(len(quat), 4))
        error = self._error(action * self._scale, position, quat)
        jacobian = self._jacobian(position)[:, : error.shape[1]]
        square = jacobian @ jacobian.mT + self._damping**2 * torch.eye(error.shape[1], device=error.device)
        joints, wanted = data.joint_pos_of(self._joints), error[:, :, None]
        if not self._posture:
            step = jacobian.mT @ torch.linalg.solve_ex(square, wanted)[0]
        else:
            rest = (self._posture * (data.default_joint_pos[:, self._joints] - joints))[:, :, None]
            step = rest + jacobian.mT @ torch.linalg.solve_ex(square, wanted - jacobian @ rest)[0]
        torch.add(joints, step[:, :, 0], out=self.command)

    def _error(self, asked: Tensor, position: Tensor, quat: Tensor) -> Tensor:
        """What is left to the asked pose, world frame: position, and axis times angle. (num_envs, 3 or 6)"""
        root = self._entity.data
        if self._relative:
            move = rotate(root.root_quat_w, asked[:, :3])
            if self._mode == "position":
                return move
            return torch.cat([move, rotate(root.root_quat_w, asked[:, 3:])], dim=1)
        move = root.root_pos_w + rotate(root.root_quat_w, asked[:, :3]) - position
        if self._mode == "position":
            return move
        wanted = multiply(root.root_quat_w, torch.nn.functional.normalize(asked[:, 3:], dim=1))
        return torch.cat([move, rotation_vector(multiply(wanted, conjugate(quat)))], dim=1)


def _command_limits(model: mujoco.MjModel, actuators: list[int | None], kind: str) -> tuple[tuple[float, float], ...]:
    """Commands beyond which each actuator gives no more: its control range, and what bounds a motor's force."""
    limits = []
    for a in actuators:
        if a is None:  # a model limits efforts, not commands
            limits.append((-math.inf, math.inf))
            continue
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
