"""Replacement for Isaac Lab's `mdp`: functions for terms, and configuration classes of actions and commands.

In a configuration, a function stands for rlcli's built-in term, or for a copy of Isaac Lab's term in `lab_terms`. The
user's own terms may also call the function: `mdp.joint_pos_rel(env, asset_cfg)` returns the value of the term.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

import torch
from torch import Tensor

from rlcli.config.term_signatures import SECTIONS, Parameter, builtin_terms
from rlcli.errors import did_you_mean
from rlcli_isaaclab.config_class import MISSING, config_subclass, configclass
from rlcli_isaaclab.curricula import modify_env_param, modify_term_cfg
from rlcli_isaaclab.lab_terms import LAB_TERMS
from rlcli_isaaclab.managers import ActionTermCfg, CommandTermCfg, SceneEntityCfg
from rlcli_isaaclab.missing_names import absent_class, absent_value
from rlcli_isaaclab.term_counterparts import TERMS, Entry
from rlcli_isaaclab.utils.math import sample_gaussian, sample_log_uniform, sample_uniform


class MdpFunction:
    """Built-in term of rlcli under its name in Isaac Lab, which can be configured or called."""

    def __init__(self, name: str) -> None:
        self.__name__ = self.__qualname__ = name

    def __deepcopy__(self, memo: Any) -> MdpFunction:
        return self

    def __mro_entries__(self, bases: tuple[Any, ...]) -> tuple[type, ...]:
        """Return the base of a class that derives from the term: such a class raises an error when it is used."""
        return (absent_class(f"a subclass of mdp.{self.__name__}"),)

    def __repr__(self) -> str:
        return f"mdp.{self.__name__}"

    def __call__(self, env: Any, *args: Any, **params: Any) -> Any:
        """Return the value of the built-in term for the parameters of Isaac Lab's term.

        Raises:
            TypeError: if the term has a state or changes the simulation.
        """
        section, builtin_name = find_term(self.__name__)
        signature = builtin_terms(section)[builtin_name]
        if signature.is_class or section == "events":
            name = f"mdp.{self.__name__}"
            what = f"{name} has a state or changes the simulation, so it cannot be called"
            raise TypeError(f"{what}; use it as `func` in the configuration")
        module = importlib.import_module(signature.module)
        entry = TERMS.get(section, {}).get(self.__name__, Entry())
        by_name = {p.name: p for p in signature.parameters}
        by_alias: dict[str, str] = {}
        """Kind of parameter (Entity, Joints, ...) -> name of the first parameter of that kind."""
        for p in signature.parameters:
            by_alias.setdefault(p.alias or "", p.name)
        positional = iter([p.name for p in signature.parameters if p.alias is None])
        values: dict[str, Any] = {}
        for name, value in [*(("", value) for value in args), *params.items()]:
            if isinstance(value, SceneEntityCfg):
                values |= _elements(env, name, value, by_name, by_alias)
            elif name == "command_name" or (not name and isinstance(value, str) and "Command" in by_alias):
                values[by_alias["Command"]] = env.command_manager.get_term(value)
            elif name:
                target = entry.params.get(name, name)
                values |= target(value) if callable(target) else {target: value}
            else:
                values[next(positional)] = value
        for p in signature.parameters:
            if p.name not in values and not p.required:
                values[p.name] = _default(env, p)
        return getattr(module, signature.attribute)(env.managed, **values)


def _default(env: Any, parameter: Parameter) -> Any:
    """Return the default of a parameter in the form that a term receives: an entity, or a slice of all elements."""
    if parameter.alias == "Entity":
        return env.entities[parameter.default]
    return slice(None) if parameter.alias in ("Joints", "Bodies", "Sites", "Actuators") else parameter.default


def _elements(
    env: Any, name: str, value: SceneEntityCfg, by_name: dict[str, Any], by_alias: dict[str, str]
) -> dict[str, Any]:
    """Return the parameters of a built-in term for the joints, bodies, ... that a `SceneEntityCfg` selects."""
    sensor = next((by_alias[kind] for kind in ("ContactSensor", "RaySensor") if kind in by_alias), None)
    if sensor is not None and value.name not in env.entities:
        whole = env.managed.sensors[value.name]
        return {sensor: whole if isinstance(value.body_ids, slice) else SensorPart(whole, value.body_ids)}
    stem = name.removesuffix("_cfg")
    entity = stem if stem in by_name and by_name[stem].alias == "Entity" else by_alias.get("Entity")
    selected = {} if entity is None else {entity: env.entities[value.name]}
    for kind, index in (("Joints", value.joint_ids), ("Bodies", value.body_ids)):
        if kind in by_alias:
            selected[by_alias[kind]] = index
    return selected


class SensorPart:
    """Contact sensor whose tensors have only the columns of some of its bodies."""

    def __init__(self, whole: Any, ids: Any) -> None:
        self._whole, self._ids = whole, ids
        self.names = [whole.names[i] for i in ids.tolist()]

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._whole, name)
        return value[:, :, self._ids] if name == "force_history" else value[:, self._ids]


def find_term(name: str) -> tuple[str, str]:
    """Return (section, name) of the term of rlcli that replaces a term of Isaac Lab.

    Raises:
        KeyError: if rlcli has no counterpart.
    """
    for section in SECTIONS:
        entry = TERMS.get(section, {}).get(name)
        ours = (entry.name if entry else None) or name
        if section not in ("actions", "success") and ours in builtin_terms(section):
            return section, ours
    raise KeyError(f"Isaac Lab's term '{name}' has no counterpart in rlcli")


def _randomize_prop_by_op(
    data: Tensor, distribution_parameters: Any, dim_0_ids: Any, dim_1_ids: Any, operation: str, distribution: str
) -> Tensor:
    """Change some rows and columns of `data` in place to sampled values; return `data`. The user's events call this.

    Args:
        data: values to change. (rows, columns)
        distribution_parameters: low and high, or mean and standard deviation.
        dim_0_ids: indices of the rows; None: all rows.
        dim_1_ids: indices or slice of the columns.
        operation: `add`, `scale` or `abs`, which replaces the old value.
        distribution: `uniform`, `log_uniform` or `gaussian`.

    Raises:
        NotImplementedError: for another operation or distribution.
    """
    samplers: dict[str, Any] = {
        "uniform": sample_uniform,
        "log_uniform": sample_log_uniform,
        "gaussian": sample_gaussian,
    }
    if operation not in ("add", "scale", "abs") or distribution not in samplers:
        what = f"unknown operation '{operation}' or distribution '{distribution}'"
        raise NotImplementedError(f"{what}; use add, scale or abs, and uniform, log_uniform or gaussian")
    rows = torch.arange(len(data), device=data.device) if dim_0_ids is None else torch.as_tensor(dim_0_ids)
    columns = torch.arange(data.shape[1], device=data.device)[dim_1_ids]
    drawn = samplers[distribution](*distribution_parameters, (len(rows), len(columns)), device=data.device)
    rows = rows.to(data.device)[:, None]
    old = data[rows, columns]
    data[rows, columns] = {"add": old + drawn, "scale": old * drawn, "abs": drawn}[operation]
    return data


@functools.cache
def _function(name: str) -> MdpFunction:
    return MdpFunction(name)


def _names() -> list[str]:
    names = {name for terms in TERMS.values() for name in terms}
    for section in SECTIONS:
        if section not in ("actions", "commands", "success"):
            names |= set(builtin_terms(section))
    return sorted(name for name in names if _has_counterpart(name))


@functools.cache
def _has_counterpart(name: str) -> bool:
    try:
        return bool(find_term(name))
    except KeyError:
        return False


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(name)
    if not _has_counterpart(name) and name in LAB_TERMS:
        return LAB_TERMS[name].function
    if not _has_counterpart(name):
        raise _UnknownTermError(name)
    return _function(name)


class _UnknownTermError(AttributeError):
    """Error for a name that this module lacks. The slow search for similar names runs only if the error is printed."""

    def __str__(self) -> str:
        near = did_you_mean(self.args[0], _names()) or "docs/reference/isaac-lab-terms.md lists the terms"
        return f"rlcli_isaaclab.mdp has no '{self.args[0]}'; {near}"


@configclass
class JointActionCfg(ActionTermCfg):
    """Settings of all joint actions.

    A number applies to all joints; a mapping goes from regular expressions of joint names to numbers.
    """

    joint_names: Any = MISSING
    scale: Any = 1.0
    offset: Any = 0.0
    preserve_order: bool = False


JointEffortActionCfg = config_subclass("JointEffortAction", "Efforts [N or N m].", JointActionCfg)
JointPositionActionCfg = config_subclass(
    "JointPositionAction", "Position targets [m or rad].", JointActionCfg, use_default_offset=True
)
RelativeJointPositionActionCfg = config_subclass(
    "RelativeJointPositionAction", "Position targets relative to the current joint positions [m or rad].",
    JointActionCfg, use_zero_offset=True,
)  # fmt: skip
JointVelocityActionCfg = config_subclass(
    "JointVelocityAction", "Velocity targets [m/s or rad/s].", JointActionCfg, use_default_offset=True
)


@configclass
class JointPositionToLimitsActionCfg(ActionTermCfg):
    """Position targets; [-1, 1] is mapped to the soft limits."""

    class_type: Any = "JointPositionToLimitsAction"
    joint_names: Any = MISSING
    scale: Any = 1.0
    rescale_to_limits: bool = True
    preserve_order: bool = False


EMAJointPositionToLimitsActionCfg = config_subclass(
    "EMAJointPositionToLimitsAction", "Position targets, smoothed by an exponential moving average.",
    JointPositionToLimitsActionCfg, alpha=1.0,
)  # fmt: skip


@configclass
class BinaryJointActionCfg(ActionTermCfg):
    """Base configuration of a gripper action, which opens or closes joints."""

    joint_names: Any = MISSING
    open_command_expr: Any = MISSING
    close_command_expr: Any = MISSING


BinaryJointPositionActionCfg = config_subclass(
    "BinaryJointPositionAction", "Open or closed positions [m or rad].", BinaryJointActionCfg
)
AbsBinaryJointPositionActionCfg = config_subclass(
    "AbsBinaryJointPositionAction",
    "Open or closed positions [m or rad]; the action is compared with a threshold.",
    BinaryJointActionCfg, threshold=0.5, positive_threshold=True,
)  # fmt: skip
BinaryJointVelocityActionCfg = config_subclass(
    "BinaryJointVelocityAction", "Opening or closing velocities [m/s or rad/s].", BinaryJointActionCfg
)


@configclass
class DifferentialInverseKinematicsActionCfg(ActionTermCfg):
    """Joint position targets that move a body to a pose, by differential inverse kinematics."""

    @configclass
    class OffsetCfg:
        """Pose of the controlled frame in the frame of the body."""

        pos: Any = (0.0, 0.0, 0.0)
        rot: Any = (1.0, 0.0, 0.0, 0.0)

    class_type: Any = "DifferentialInverseKinematicsAction"
    joint_names: Any = MISSING
    body_name: str = MISSING
    body_offset: Any = None
    scale: Any = 1.0
    controller: Any = MISSING


NullCommandCfg = config_subclass(
    "NullCommand", "A command without values.", CommandTermCfg, resampling_time_range=(float("inf"), float("inf"))
)


@configclass
class UniformVelocityCommandCfg(CommandTermCfg):
    """Configuration of a command: a velocity of the root, sampled from uniform distributions."""

    @configclass
    class Ranges:
        """[low, high] of each component: velocities [m/s, rad/s] and heading [rad]."""

        lin_vel_x: Any = MISSING
        lin_vel_y: Any = MISSING
        ang_vel_z: Any = MISSING
        heading: Any = None

    class_type: Any = "UniformVelocityCommand"
    goal_vel_visualizer_cfg: Any = absent_value("isaaclab.markers.config.GREEN_ARROW_X_MARKER_CFG")
    current_vel_visualizer_cfg: Any = absent_value("isaaclab.markers.config.BLUE_ARROW_X_MARKER_CFG")
    asset_name: str = MISSING
    heading_command: bool = False
    heading_control_stiffness: float = 1.0
    rel_standing_envs: float = 0.0
    rel_heading_envs: float = 1.0
    ranges: Any = MISSING


@configclass
class NormalVelocityCommandCfg(UniformVelocityCommandCfg):
    """Configuration of a command: a velocity of the root, sampled from normal distributions."""

    @configclass
    class Ranges:
        """Mean, standard deviation and probability of zero for x, y [m/s] and yaw [rad/s]."""

        mean_vel: Any = MISSING
        std_vel: Any = MISSING
        zero_prob: Any = MISSING

    class_type: Any = "NormalVelocityCommand"


@configclass
class UniformPoseCommandCfg(CommandTermCfg):
    """Configuration of a command: a pose of a body in the root's frame."""

    @configclass
    class Ranges:
        """[low, high] of each component: positions [m] and angles [rad]."""

        pos_x: Any = MISSING
        pos_y: Any = MISSING
        pos_z: Any = MISSING
        roll: Any = MISSING
        pitch: Any = MISSING
        yaw: Any = MISSING

    class_type: Any = "UniformPoseCommand"
    goal_pose_visualizer_cfg: Any = absent_value("isaaclab.markers.config.FRAME_MARKER_CFG")
    current_pose_visualizer_cfg: Any = absent_value("isaaclab.markers.config.FRAME_MARKER_CFG")
    asset_name: str = MISSING
    body_name: str = MISSING
    make_quat_unique: bool = False
    ranges: Any = MISSING


@configclass
class UniformPose2dCommandCfg(CommandTermCfg):
    """Configuration of a command: a position and heading on the ground."""

    @configclass
    class Ranges:
        """[low, high] of each component: positions [m] and angles [rad]."""

        pos_x: Any = MISSING
        pos_y: Any = MISSING
        heading: Any = MISSING

    class_type: Any = "UniformPose2dCommand"
    goal_pose_visualizer_cfg: Any = absent_value("isaaclab.markers.config.GREEN_ARROW_X_MARKER_CFG")
    asset_name: str = MISSING
    simple_heading: bool = MISSING
    ranges: Any = MISSING


__all__ = [
    "modify_env_param",
    "modify_term_cfg",
    *(name for name in dict(globals()) if name.endswith("Cfg")),
    *_names(),
]
