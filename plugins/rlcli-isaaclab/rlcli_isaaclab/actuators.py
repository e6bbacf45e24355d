"""What drives joints. Names as in `isaaclab.actuators`."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass


@configclass
class ActuatorBaseCfg:
    """What all actuators have; a number is for all joints, a mapping for regexes."""

    class_type: Any = "ActuatorBase"
    joint_names_expr: Any = MISSING
    effort_limit: Any = None
    velocity_limit: Any = None
    effort_limit_sim: Any = None
    velocity_limit_sim: Any = None
    stiffness: Any = None
    damping: Any = None
    armature: Any = None
    friction: Any = None
    dynamic_friction: Any = None
    viscous_friction: Any = None


@configclass
class ImplicitActuatorCfg(ActuatorBaseCfg):
    """A PD controller that the simulator integrates: MuJoCo's own actuators."""

    class_type: Any = "ImplicitActuator"


@configclass
class IdealPDActuatorCfg(ActuatorBaseCfg):
    """A PD controller, computed before every physics step."""

    class_type: Any = "IdealPDActuator"


@configclass
class DCMotorCfg(IdealPDActuatorCfg):
    """The same behind a motor with a torque-speed curve."""

    class_type: Any = "DCMotor"
    saturation_effort: float = MISSING


@configclass
class DelayedPDActuatorCfg(IdealPDActuatorCfg):
    """The same with commands that arrive some physics steps late."""

    class_type: Any = "DelayedPDActuator"
    min_delay: int = 0
    max_delay: int = 0
