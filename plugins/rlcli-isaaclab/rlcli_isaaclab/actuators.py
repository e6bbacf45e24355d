"""Configuration classes of actuators.

A task of Isaac Lab that imports a name from `isaaclab.actuators` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, config_subclass, configclass


@configclass
class ActuatorBaseCfg:
    """Settings of all kinds of actuators.

    A number applies to all joints; a mapping goes from regular expressions of joint names to numbers.
    """

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


ImplicitActuatorCfg = config_subclass(
    "ImplicitActuator", "A PD controller inside the simulator: MuJoCo's own actuators.", ActuatorBaseCfg
)
IdealPDActuatorCfg = config_subclass(
    "IdealPDActuator", "A PD controller, computed before every physics step.", ActuatorBaseCfg
)
DCMotorCfg = config_subclass(
    "DCMotor", "A PD controller whose effort a torque-speed curve limits.", IdealPDActuatorCfg,
    saturation_effort=MISSING,
)  # fmt: skip
DelayedPDActuatorCfg = config_subclass(
    "DelayedPDActuator", "A PD controller whose commands arrive some physics steps late.", IdealPDActuatorCfg,
    min_delay=0, max_delay=0,
)  # fmt: skip
