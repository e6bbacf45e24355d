"""Action terms. Each term reads its columns of the policy's action and computes the commands of actuators.

The base classes are in `rlcli.mdp.joint_action`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import torch
from torch import Tensor

from rlcli.mdp.joint_action import AffineJointAction, JointAction, ScaledJointAction
from rlcli.scene.jacobian import Jacobian, sums_of_products
from rlcli.scene.names import NameProblem
from rlcli.sim.env_selection import Selection, one_column
from rlcli.sim.rotations import conjugate, multiply, rotate, rotation_vector
from rlcli.sim.saved_tensors import TensorState
from rlcli.task import Bodies, Joints


@dataclass(kw_only=True, eq=False)
class _AffineAboutDefault(AffineJointAction):
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


class JointEffort(AffineJointAction):
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


class RelativeJointPosition(ScaledJointAction):
    """Targets of position actuators: the current joint position + action x scale [m or rad].

    Isaac Lab: RelativeJointPositionAction.
    """

    actuator = "position"
    unit = "m or rad"

    def _compute_command(self, action: Tensor) -> None:
        torch.add(self.entity.data.joint_pos_of(self.joints), action * self._scale, out=self.command)


@dataclass(kw_only=True, eq=False)
class JointPositionToLimits(ScaledJointAction):
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
class _BinaryJoint(JointAction):
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
class DifferentialInverseKinematics(ScaledJointAction):
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
