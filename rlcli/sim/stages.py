"""Fields of the GPU engine's worlds: which are state, and of which stage of a step the others come."""

from __future__ import annotations

import mujoco

from rlcli.sim.engine import force_sensors

STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "act", "time")
"""What every world carries from step to step, and every reset restores."""
INPUTS = ("qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata")
"""Further state, as the model has it unless somebody binds it."""
_KINEMATIC = frozenset(
    [
        *("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat", "site_xpos"),
        *("site_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir", "subtree_com", "ten_length", "cinert"),
    ]
)
"""Derived fields of the position stage that kinematics alone give."""
_ACCELERATION = frozenset(
    [
        *("qacc", "qacc_smooth", "actuator_force", "qfrc_actuator", "qfrc_smooth", "qfrc_constraint", "qfrc_inverse"),
        *("act_dot", "cacc", "cfrc_int", "cfrc_ext"),
    ]
)
"""Fields of the acceleration stage: read as the last substep left them."""
_MOTION = frozenset(["cvel", "cdof", "cdof_dot"])
"""Fields of the velocity stage that the motion of bodies alone gives: no inertias, no contacts, no constraints."""
_SENSORS_OF_MOTION = frozenset(
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in (
        *("MAGNETOMETER", "CAMPROJECTION", "RANGEFINDER", "JOINTPOS", "TENDONPOS", "BALLQUAT", "FRAMEPOS", "FRAMEQUAT"),
        *("FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS", "SUBTREECOM", "CLOCK", "INSIDESITE", "VELOCIMETER", "GYRO"),
        *("JOINTVEL", "BALLANGVEL", "FRAMELINVEL", "FRAMEANGVEL", "SUBTREELINVEL", "SUBTREEANGMOM"),
    )
)
"""Sensors before the acceleration stage that read nothing else."""
KINEMATICS, VELOCITY, FORCE = range(3)
"""Groups of derived fields."""


class Stages:
    """What the fields of a model's worlds derive from."""

    def __init__(self, model: mujoco.MjModel) -> None:
        force_columns = force_sensors(model)
        self._of_sensors = {FORCE} if force_columns else set()
        if len(force_columns) < model.nsensordata:
            self._of_sensors.add(VELOCITY)
        self._senses_motion_alone = _SENSORS_OF_MOTION.issuperset(
            int(kind)
            for kind, stage in zip(model.sensor_type, model.sensor_needstage, strict=True)
            if int(stage) < int(mujoco.mjtStage.mjSTAGE_ACC)
        )

    def of(self, name: str) -> set[int]:
        """What a field derives from."""
        if name in (*STATE, *INPUTS):
            return set()
        if name == "sensordata":
            return self._of_sensors
        return {KINEMATICS if name in _KINEMATIC else FORCE if name in _ACCELERATION else VELOCITY}

    def is_motion(self, name: str) -> bool:
        """Whether a field can be brought up to the state without contacts, constraints and inertias."""
        if name == "sensordata":
            return self._senses_motion_alone
        return VELOCITY not in self.of(name) or name in _MOTION
