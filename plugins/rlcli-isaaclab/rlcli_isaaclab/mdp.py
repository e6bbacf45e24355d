"""Terms and actions under Isaac Lab's names: every term of `rlcli.mdp` that has a counterpart there.

In a configuration such a function stands for the built-in term. Called from a term of your own it gives that term's
value: `mdp.joint_pos_rel(env, asset_cfg)`.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

from rlcli.config.term_signatures import SECTIONS, builtin_terms
from rlcli.errors import did_you_mean
from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.managers import ActionTermCfg, CommandTermCfg, SceneEntityCfg
from rlcli_isaaclab.table import TERMS, Entry


class MdpFunction:
    """A built-in term under its name in Isaac Lab."""

    def __init__(self, name: str) -> None:
        self.__name__ = self.__qualname__ = name

    def __deepcopy__(self, memo: Any) -> MdpFunction:
        return self

    def __repr__(self) -> str:
        return f"mdp.{self.__name__}"

    def __call__(self, env: Any, *args: Any, **params: Any) -> Any:
        """The term's value."""
        section, ours = found(self.__name__)
        signature = builtin_terms(section)[ours]
        if signature.is_class or section == "events":
            raise TypeError(f"mdp.{self.__name__} has a memory or changes the simulation: name it in the configuration")
        module = importlib.import_module(signature.module)
        entry = TERMS.get(section, {}).get(self.__name__, Entry())
        known = {p.name: p for p in signature.parameters}
        first: dict[str, str] = {}
        for p in signature.parameters:
            first.setdefault(p.alias or "", p.name)
        plain = iter([p.name for p in signature.parameters if p.alias is None])
        named = [("", value) for value in args] + list(params.items())
        given: dict[str, Any] = {}
        for name, value in named:
            if isinstance(value, SceneEntityCfg):
                given |= _elements(env, name, value, known, first)
            elif name == "command_name" or (not name and isinstance(value, str) and "Command" in first):
                given[first["Command"]] = env.command_manager.get_term(value)
            elif name:
                to = entry.params.get(name, name)
                given |= to(value) if callable(to) else {to: value}
            else:
                given[next(plain)] = value
        for p in signature.parameters:
            if p.name not in given and not p.required:
                whole = {"Entity": lambda default: env.entities[default]}.get(p.alias or "")
                every = slice(None) if p.alias in ("Joints", "Bodies", "Sites", "Actuators") else p.default
                given[p.name] = whole(p.default) if whole else every
        return getattr(module, signature.attribute)(env.managed, **given)


def _elements(
    env: Any, name: str, value: SceneEntityCfg, known: dict[str, Any], first: dict[str, str]
) -> dict[str, Any]:
    """What a `SceneEntityCfg` picks, as a built-in term takes it."""
    sensor = next((first[kind] for kind in ("ContactSensor", "RaySensor") if kind in first), None)
    if sensor is not None and value.name not in env.entities:
        whole = env.managed.sensors[value.name]
        every = isinstance(value.body_ids, slice)
        return {sensor: whole if every else SensorPart(whole, value.body_ids)}
    stem = name.removesuffix("_cfg")
    entity = stem if stem in known and known[stem].alias == "Entity" else first.get("Entity")
    made = {} if entity is None else {entity: env.entities[value.name]}
    for kind, index in (("Joints", value.joint_ids), ("Bodies", value.body_ids)):
        if kind in first:
            made[first[kind]] = index
    return made


class SensorPart:
    """Some bodies of a contact sensor."""

    def __init__(self, whole: Any, ids: Any) -> None:
        self._whole, self._ids = whole, ids
        self.names = [whole.names[i] for i in ids.tolist()]

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._whole, name)
        return value[:, :, self._ids] if name == "force_history" else value[:, self._ids]


def found(name: str) -> tuple[str, str]:
    """The section and the name here of one of Isaac Lab's terms.

    Raises:
        KeyError: if rlcli has none.
    """
    for section in SECTIONS:
        entry = TERMS.get(section, {}).get(name)
        ours = (entry.name if entry else None) or name
        if section not in ("actions", "success") and ours in builtin_terms(section):
            return section, ours
    raise KeyError(name)


@functools.cache
def _function(name: str) -> MdpFunction:
    return MdpFunction(name)


def _names() -> list[str]:
    names = {name for terms in TERMS.values() for name in terms}
    for section in SECTIONS:
        if section not in ("actions", "commands", "success"):
            names |= set(builtin_terms(section))
    return sorted(name for name in names if _known(name))


def _known(name: str) -> bool:
    try:
        return bool(found(name))
    except KeyError:
        return False


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(name)
    if not _known(name):
        near = did_you_mean(name, _names())
        raise AttributeError(
            f"rlcli_isaaclab.mdp has no '{name}'; {near or 'docs/reference/isaac-lab-terms.md says which there are'}"
        )
    return _function(name)


@configclass
class JointActionCfg(ActionTermCfg):
    """What all joint actions have; a number is for all joints, a mapping for regexes."""

    joint_names: Any = MISSING
    scale: Any = 1.0
    offset: Any = 0.0
    preserve_order: bool = False


@configclass
class JointEffortActionCfg(JointActionCfg):
    """Efforts [N or N m]."""

    class_type: Any = "JointEffortAction"


@configclass
class JointPositionActionCfg(JointActionCfg):
    """Position targets [m or rad]."""

    class_type: Any = "JointPositionAction"
    use_default_offset: bool = True


@configclass
class RelativeJointPositionActionCfg(JointActionCfg):
    """Position targets relative to where the joints are [m or rad]."""

    class_type: Any = "RelativeJointPositionAction"
    use_zero_offset: bool = True


@configclass
class JointVelocityActionCfg(JointActionCfg):
    """Velocity targets [m/s or rad/s]."""

    class_type: Any = "JointVelocityAction"
    use_default_offset: bool = True


@configclass
class JointPositionToLimitsActionCfg(ActionTermCfg):
    """Position targets, [-1, 1] being the soft limits."""

    class_type: Any = "JointPositionToLimitsAction"
    joint_names: Any = MISSING
    scale: Any = 1.0
    rescale_to_limits: bool = True
    preserve_order: bool = False


@configclass
class EMAJointPositionToLimitsActionCfg(JointPositionToLimitsActionCfg):
    """The same as a moving average."""

    class_type: Any = "EMAJointPositionToLimitsAction"
    alpha: Any = 1.0


@configclass
class BinaryJointActionCfg(ActionTermCfg):
    """Open or closed."""

    joint_names: Any = MISSING
    open_command_expr: Any = MISSING
    close_command_expr: Any = MISSING


@configclass
class BinaryJointPositionActionCfg(BinaryJointActionCfg):
    """Open or closed positions [m or rad]."""

    class_type: Any = "BinaryJointPositionAction"


@configclass
class AbsBinaryJointPositionActionCfg(BinaryJointActionCfg):
    """Open or closed positions [m or rad], by the action's value against a threshold."""

    class_type: Any = "AbsBinaryJointPositionAction"
    threshold: float = 0.5
    positive_threshold: bool = True


@configclass
class BinaryJointVelocityActionCfg(BinaryJointActionCfg):
    """Opening or closing velocities [m/s or rad/s]."""

    class_type: Any = "BinaryJointVelocityAction"


@configclass
class DifferentialInverseKinematicsActionCfg(ActionTermCfg):
    """Joint positions that move a body to a pose."""

    @configclass
    class OffsetCfg:
        """Where the moved frame sits in the body's."""

        pos: Any = (0.0, 0.0, 0.0)
        rot: Any = (1.0, 0.0, 0.0, 0.0)

    class_type: Any = "DifferentialInverseKinematicsAction"
    joint_names: Any = MISSING
    body_name: str = MISSING
    body_offset: Any = None
    scale: Any = 1.0
    controller: Any = MISSING


@configclass
class NullCommandCfg(CommandTermCfg):
    """Nothing is asked."""

    class_type: Any = "NullCommand"
    resampling_time_range: Any = (float("inf"), float("inf"))


@configclass
class UniformVelocityCommandCfg(CommandTermCfg):
    """A velocity of the root."""

    @configclass
    class Ranges:
        """[low, high] each [m/s, rad/s, rad]."""

        lin_vel_x: Any = MISSING
        lin_vel_y: Any = MISSING
        ang_vel_z: Any = MISSING
        heading: Any = None

    class_type: Any = "UniformVelocityCommand"
    asset_name: str = MISSING
    heading_command: bool = False
    heading_control_stiffness: float = 1.0
    rel_standing_envs: float = 0.0
    rel_heading_envs: float = 1.0
    ranges: Any = MISSING


@configclass
class NormalVelocityCommandCfg(UniformVelocityCommandCfg):
    """The same drawn from normal distributions."""

    @configclass
    class Ranges:
        """Means, deviations and chances of zero of x, y [m/s] and yaw [rad/s]."""

        mean_vel: Any = MISSING
        std_vel: Any = MISSING
        zero_prob: Any = MISSING

    class_type: Any = "NormalVelocityCommand"


@configclass
class UniformPoseCommandCfg(CommandTermCfg):
    """A pose of a body in the root's frame."""

    @configclass
    class Ranges:
        """[low, high] each [m, rad]."""

        pos_x: Any = MISSING
        pos_y: Any = MISSING
        pos_z: Any = MISSING
        roll: Any = MISSING
        pitch: Any = MISSING
        yaw: Any = MISSING

    class_type: Any = "UniformPoseCommand"
    asset_name: str = MISSING
    body_name: str = MISSING
    make_quat_unique: bool = False
    ranges: Any = MISSING


@configclass
class UniformPose2dCommandCfg(CommandTermCfg):
    """A place on the ground."""

    @configclass
    class Ranges:
        """[low, high] each [m, rad]."""

        pos_x: Any = MISSING
        pos_y: Any = MISSING
        heading: Any = MISSING

    class_type: Any = "UniformPose2dCommand"
    asset_name: str = MISSING
    simple_heading: bool = MISSING
    ranges: Any = MISSING


__all__ = [name for name in dict(globals()) if name.endswith("Cfg")] + _names()
