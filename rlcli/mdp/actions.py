"""Action terms. Each term reads its columns of the policy's action and writes the controls of MuJoCo actuators."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.managers.action import CommandMap
from rlcli.mdp.term import JointTerm
from rlcli.mdp.term_helpers import column_numbers
from rlcli.scene.actuators import JointCommand
from rlcli.scene.jacobian import Jacobian, sums_of_products
from rlcli.scene.names import NameProblem, match_values
from rlcli.sim.env_selection import Selection, one_column
from rlcli.sim.rotations import conjugate, multiply, rotate, rotation_vector
from rlcli.sim.saved_tensors import TensorState
from rlcli.task import Bodies, Joints, Range


@dataclass(kw_only=True, eq=False)
class _JointAction(JointTerm):
    """Base class of actions on joints: the columns of the action become one command for each of the `joints`."""

    actuator: ClassVar[str]
    """Kind of actuator that the scene adds to joints without one."""
    unit: ClassVar[str]
    """Unit of the command."""

    def __post_init__(self) -> None:
        columns = column_numbers(self.joints, len(self.entity.joint_names))
        self.elements = tuple(self.entity.joint_names[c] for c in columns)
        self._drive = JointCommand(self.entity, self.actuator, columns)
        self.sinks = self._drive.sinks
        self.actuators = self._drive.actuators
        """Id of the MuJoCo actuator of each joint; None where an actuator model computes the effort."""
        self.size = len(columns)
        self._clip: tuple[Tensor, Tensor] | None = None
        self.command = torch.zeros(self.env.num_envs, self.size, device=self.env.device)
        """Command after `clip`, before the limits of the actuators. (num_envs, joints)"""

    def process(self, action: Tensor) -> None:
        """Write the controls of this step. action (num_envs, size)"""
        self._compute_command(action)
        if self._clip is not None:
            self.command.clamp_(*self._clip)
        self._drive.write(self.command)

    def _compute_command(self, action: Tensor) -> None:
        """Compute the commands of all joints from the action and write them to `command`."""
        raise NotImplementedError

    def _per_joint(self, mapping: dict[str, float], default: float) -> Tensor:
        """Return a value for each joint from a mapping of names or patterns; `default` where none matches. (joints,)"""
        values = [default if v is None else v for v in match_values(mapping, self.elements, "joint")]
        return torch.tensor(values, dtype=torch.float32, device=self.env.device)

    def _number_or_per_joint(self, value: float | dict[str, float], default: float) -> float | Tensor:
        return self._per_joint(value, default) if isinstance(value, dict) else value


@dataclass(kw_only=True, eq=False)
class _ScaledJointAction(_JointAction):
    """Base class of joint actions with `scale` and `clip`: one value for all joints, or a mapping by joint."""

    scale: float | dict[str, float] = 1.0
    clip: Range | dict[str, Range] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._scale = self._number_or_per_joint(self.scale, 1.0)
        if self.clip is not None:
            ends = self.clip if isinstance(self.clip, dict) else {".*": self.clip}
            low = self._per_joint({pattern: pair[0] for pattern, pair in ends.items()}, -math.inf)
            high = self._per_joint({pattern: pair[1] for pattern, pair in ends.items()}, math.inf)
            self._clip = low, high


@dataclass(kw_only=True, eq=False)
class _AffineJointAction(_ScaledJointAction):
    """Base class of actions of the form action x scale + offset, which exported policies can contain as a formula."""

    offset: float | dict[str, float] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        # torch wraps a Python number into a tensor at each use, which takes as long as the product
        self._factor = torch.as_tensor(self._scale, dtype=torch.float32, device=self.env.device)
        self._offset = self._number_or_per_joint(self.offset, 0.0)
        self._limits = _command_limits(self.entity.engine.model, self.actuators, self.actuator)

    def command_map(self) -> CommandMap:
        """Return the formula of the commands, and the limits of the actuators."""
        scale, offset = (self._each(value) for value in (self._scale, self._offset))
        clip = None if self._clip is None else tuple(zip(*map(self._each, self._clip), strict=True))
        return CommandMap(scale, offset, clip, self._limits)

    def _compute_command(self, action: Tensor) -> None:
        torch.mul(action, self._factor, out=self.command)
        if isinstance(self._offset, Tensor) or self._offset:
            self.command += self._offset

    def _each(self, value: float | Tensor) -> tuple[float, ...]:
        """Return a setting, which is the same in all environments, as one number for each column."""
        if isinstance(value, Tensor):
            return tuple((value[0] if value.dim() == 2 else value).tolist())
        return (value,) * self.size


@dataclass(kw_only=True, eq=False)
class _AffineAboutDefault(_AffineJointAction):
    """Base class of actions of the form action x scale + offset + default value of the joint.

    `use_default_offset: false` omits the default value.
    """

    default: ClassVar[str]
    """Attribute of `entity.data` that holds the default values."""

    use_default_offset: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.use_default_offset:
            self._offset = getattr(self.entity.data, self.default)[:, self.joints] + self._offset


class JointEffort(_AffineJointAction):
    """Efforts of joint motors: action x scale + offset [N or N m]. Isaac Lab: JointEffortAction."""

    actuator = "motor"
    unit = "N or N m"


class JointPosition(_AffineAboutDefault):
    """Targets of position actuators: action x scale + offset + default position [m or rad].

    `use_default_offset: false` omits the default position. Isaac Lab: JointPositionAction.
    """

    actuator = "position"
    unit = "m or rad"
    default = "default_joint_pos"


class JointVelocity(_AffineAboutDefault):
    """Targets of velocity actuators: action x scale + offset + default velocity [m/s or rad/s].

    `use_default_offset: false` omits the default velocity. Isaac Lab: JointVelocityAction.
    """

    actuator = "velocity"
    unit = "m/s or rad/s"
    default = "default_joint_vel"


class RelativeJointPosition(_ScaledJointAction):
    """Targets of position actuators: the current joint position + action x scale [m or rad].

    Isaac Lab: RelativeJointPositionAction.
    """

    actuator = "position"
    unit = "m or rad"

    def _compute_command(self, action: Tensor) -> None:
        torch.add(self.entity.data.joint_pos_of(self.joints), action * self._scale, out=self.command)


@dataclass(kw_only=True, eq=False)
class JointPositionToLimits(_ScaledJointAction):
    """Targets of position actuators: action x scale, clipped to [-1, 1] and mapped to the soft limits [m or rad].

    With `rescale_to_limits: false` action x scale is the target itself, clipped to the soft limits. Isaac Lab:
    JointPositionToLimitsAction.
    """

    actuator = "position"
    unit = "m or rad"

    rescale_to_limits: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        finite = self.entity.data.soft_joint_pos_limits[self.joints].isfinite().all(dim=-1)
        if self.rescale_to_limits and not bool(finite.all()):
            unlimited = self.elements[int((~finite).nonzero()[0, 0])]
            message = f"joint '{unlimited}' has no position limits, to which the action could be scaled"
            raise NameProblem(message, "give the joint a range in the MJCF, or use joint_position")

    def _compute_command(self, action: Tensor) -> None:
        self.command.copy_(self._limited(action))

    def _limited(self, action: Tensor) -> Tensor:
        low, high = self.entity.data.soft_joint_pos_limits[self.joints].unbind(-1)
        raw = action * self._scale
        if not self.rescale_to_limits:
            return raw.clamp(low, high)
        target: Tensor = 0.5 * (raw.clamp(-1.0, 1.0) * (high - low) + high + low)
        return target


@dataclass(kw_only=True, eq=False)
class EmaJointPositionToLimits(JointPositionToLimits, TensorState):
    """Targets of `joint_position_to_limits`, smoothed by an exponential moving average [m or rad].

    Target = alpha x new target + (1 - alpha) x previous target; the first previous target of an episode is the joint
    position. alpha: one number, or a mapping from joint names or patterns to numbers. Isaac Lab:
    EMAJointPositionToLimitsAction.
    """

    alpha: float | dict[str, float] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._alpha = self._number_or_per_joint(self.alpha, 1.0)
        self._before = torch.zeros_like(self.command)
        self._fresh = torch.ones(self.env.num_envs, dtype=torch.bool, device=self.env.device)

    def _compute_command(self, action: Tensor) -> None:
        low, high = self.entity.data.soft_joint_pos_limits[self.joints].unbind(-1)
        before = torch.where(self._fresh[:, None], self.entity.data.joint_pos_of(self.joints), self._before)
        self._before.copy_((self._alpha * self._limited(action) + (1.0 - self._alpha) * before).clamp(low, high))
        self.command.copy_(self._before)
        self._fresh.zero_()

    def reset(self, selection: Selection) -> None:
        """Start the averages of new episodes at their joint positions."""
        selection.write(self._fresh, True)

    def tensors(self) -> dict[str, Tensor]:
        """Return the previous targets, and a mask of the environments without a previous target."""
        return {"before": self._before, "fresh": self._fresh}


@dataclass(kw_only=True, eq=False)
class _BinaryJoint(_JointAction):
    """Base class of actions in which one column opens or closes several joints."""

    joints: Joints = field(kw_only=True)  # required: without `field` it would get the default of `JointTerm`
    open_command: dict[str, float]
    close_command: dict[str, float]
    threshold: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._open = self._for_all_joints(self.open_command, "open_command")
        self._close = self._for_all_joints(self.close_command, "close_command")
        self.elements, self.size = (",".join(self.elements),), 1

    def _compute_command(self, action: Tensor) -> None:
        self.command.copy_(torch.where(action < self.threshold, self._close, self._open))

    def _for_all_joints(self, command: dict[str, float], key: str) -> Tensor:
        values = self._per_joint(command, math.nan)
        if bool(values.isnan().any()):
            name = self.elements[int(values.isnan().nonzero()[0, 0])]
            raise NameProblem(f"{key} has no value for joint '{name}'; add a value")
        return values


class BinaryJointPosition(_BinaryJoint):
    """Gripper positions: `open_command` where the action is at least `threshold`, else `close_command` [m or rad].

    The action has one column. The two commands map joint names or patterns to positions. Isaac Lab:
    BinaryJointPositionAction, and AbsBinaryJointPositionAction with its threshold.
    """

    actuator = "position"
    unit = "m or rad"


class BinaryJointVelocity(_BinaryJoint):
    """Gripper velocities: `open_command` where the action is at least `threshold`, else `close_command` [m/s or rad/s].

    The action has one column. The two commands map joint names or patterns to velocities. Isaac Lab:
    BinaryJointVelocityAction.
    """

    actuator = "velocity"
    unit = "m/s or rad/s"


@dataclass(kw_only=True, eq=False)
class DifferentialInverseKinematics(_ScaledJointAction):
    """Joint position targets that move a frame of a body to a pose, by damped least squares [m or rad].

    Once a step: dq = J^T (J J^T + damping^2 I)^-1 e. J is the geometric Jacobian of the controlled frame, e is its pose
    error.

    mode: `position` takes 3 columns (x, y, z). `pose` takes 7 columns (position, quaternion w x y z), or 6 with
    `relative` (position, axis times angle). Poses are in the root's frame [m, rad].

    relative: action x scale is added to the current pose of the controlled frame; otherwise action x scale is the
    target pose.

    offset_pos, offset_quat: position [m] and quaternion of the controlled frame in the body's frame.

    posture: fraction of the way to the default pose that redundant joints move in a step, without moving the frame:
    dq + (I - J^T (J J^T + damping^2 I)^-1 J) posture (default - q). With 0 an arm of seven joints drifts to its limits.

    Isaac Lab: DifferentialInverseKinematicsAction (ik_method dls); mjlab: posture_weight.
    """

    actuator = "position"
    unit = "m or rad"

    bodies: Bodies
    mode: Literal["position", "pose"] = "pose"
    relative: bool = False
    scale: float = 1.0
    damping: float = 0.01
    posture: float = 0.0
    offset_pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._body = one_column(self.bodies, len(self.entity.body_ids), "bodies")
        self._point = torch.tensor(self.offset_pos, device=self.env.device)
        self._turn = torch.tensor(self.offset_quat, device=self.env.device)
        columns = [self.entity.joint_names.index(name) for name in self.elements]
        self._jacobian = Jacobian(self.entity, columns, self._body)
        self.joint_names = self.elements
        self.elements = ("x", "y", "z")
        if self.mode == "pose":
            self.elements += ("rx", "ry", "rz") if self.relative else ("w", "i", "j", "k")
        self.size = len(self.elements)
        rows = 3 if self.mode == "position" else 6
        self._damped = self.damping**2 * torch.eye(rows, device=self.env.device)[:, :, None]

    def _compute_command(self, action: Tensor) -> None:
        data = self.entity.data
        quat, position = data.body_quat_w[:, self._body], data.body_pos_w[:, self._body]
        if any(self.offset_pos):
            position = position + rotate(quat, self._point.expand(len(quat), 3))
        error = self._pose_error(action * self._scale, position, quat)
        columns = self._jacobian.columns(position)[:, : error.shape[1]]
        joints = data.joint_pos_of(self.joints)
        rest = self.posture * (data.default_joint_pos_of(self.joints) - joints) if self.posture else None
        step = self._least_squares(columns, error, rest)
        torch.add(joints, step if rest is None else rest + step, out=self.command)

    def _least_squares(self, columns: Tensor, error: Tensor, rest: Tensor | None) -> Tensor:
        """Return the joint displacements J^T (J J^T + damping^2 I)^-1 (error - J rest), by damped least squares. (n, k)

        Args:
            columns: columns of the Jacobian J, one for each of the k joints. (k, e, n)
            error: pose error of the controlled frame, with e components. (n, e)
            rest: displacements towards the default pose; None: zero. (n, k)
        """
        size, n = error.shape[1], len(error)
        wanted, others = error, columns
        if rest is not None:
            others = torch.cat([columns, rest.mT[:, None]], dim=1)
        products = sums_of_products(columns, others)  # J J^T, then J rest
        if rest is not None:
            wanted = error - products[:, size].mT
        square = (products[:, :size] + self._damped).view(-1, n).mT.contiguous().view(n, size, size)
        # the matrix is symmetric; LAPACK needs no copy of its transpose. solve_ex: solve would wait for the device to
        # check the result
        solved = torch.linalg.solve_ex(square.mT, wanted[:, :, None])[0]
        return sums_of_products(columns.transpose(0, 1), solved.permute(1, 2, 0).contiguous())[:, 0].mT

    def _pose_error(self, goal: Tensor, position: Tensor, quat: Tensor) -> Tensor:
        """Return the error to the goal pose, world frame: position, and axis times angle. (num_envs, 3 or 6)

        Args:
            goal: the scaled action.
            position: position of the controlled frame, world frame. (num_envs, 3)
            quat: orientation of the body, world frame. (num_envs, 4)
        """
        root = self.entity.data
        if self.relative:  # the columns are vectors in the root's frame
            return rotate(root.root_quat_w[:, None], goal.reshape(len(goal), -1, 3)).flatten(1)
        move: Tensor = root.root_pos_w + rotate(root.root_quat_w, goal[:, :3]) - position
        if self.mode == "position":
            return move
        wanted = multiply(root.root_quat_w, torch.nn.functional.normalize(goal[:, 3:], dim=1))
        now = multiply(quat, self._turn.expand(len(quat), 4))
        return torch.cat([move, rotation_vector(multiply(wanted, conjugate(now)))], dim=1)


def _command_limits(model: mujoco.MjModel, actuators: list[int | None], kind: str) -> tuple[tuple[float, float], ...]:
    """Return the smallest and the largest effective command of each actuator.

    The limits follow from the control range; for motors also from the force limits of the actuator and of the joint.
    """
    limits = []
    for a in actuators:
        if a is None:  # an actuator model limits efforts, not commands
            limits.append((-math.inf, math.inf))
            continue
        gain, gear, joint = model.actuator_gainprm[a, 0], model.actuator_gear[a, 0], model.actuator_trnid[a, 0]
        low, high = model.actuator_ctrlrange[a] if model.actuator_ctrllimited[a] else (-math.inf, math.inf)
        if not gain or not gear:
            low, high = -math.inf, math.inf  # this actuator has no effect
        elif kind != "motor":
            low, high = sorted((low / gear, high / gear))
        else:
            if model.actuator_forcelimited[a]:
                low, high = _overlap((low, high), sorted(model.actuator_forcerange[a] / gain))
            # from here on in joint units: the joint's own force limit is in them
            low, high = sorted((low * gear, high * gear))
            alone = np.count_nonzero(model.actuator_trnid[:, 0] == joint) == 1
            if model.jnt_actfrclimited[joint] and alone:
                low, high = _overlap((low, high), sorted(model.jnt_actfrcrange[joint] / gain))
        limits.append((float(low), float(high)))
    return tuple(limits)


def _overlap(a: Sequence[float], b: Sequence[float]) -> tuple[float, float]:
    return max(a[0], b[0]), min(a[1], b[1])
