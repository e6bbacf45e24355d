"""Table of the fields of MjData, with the stage of a physics step that computes each field, for the GPU engine.

The GPU engine computes only the stages whose fields a task reads.
"""

from __future__ import annotations

import mujoco

from rlcli.sim.acceleration_fields import ACCELERATION_FIELDS, force_sensor_columns

STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl", "act", "time")
"""Fields of the state, which every reset restores."""
INPUTS = ("qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata")
"""Further fields of the state, which keep the model's values until code requests them with `field`."""
_KINEMATIC_FIELDS = {
    *("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat", "site_xpos"),
    *("site_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir", "subtree_com", "ten_length", "cinert"),
}
"""Derived fields of the position stage that need only kinematics."""
_MOTION_FIELDS = frozenset(["cvel", "cdof", "cdof_dot"])
"""Derived fields of the velocity stage that need only the motion of bodies: no inertias, contacts and constraints."""
_MOTION_SENSORS = frozenset(
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in (
        *("MAGNETOMETER", "CAMPROJECTION", "RANGEFINDER", "JOINTPOS", "TENDONPOS", "BALLQUAT", "FRAMEPOS", "FRAMEQUAT"),
        *("FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS", "SUBTREECOM", "CLOCK", "INSIDESITE", "VELOCIMETER", "GYRO"),
        *("JOINTVEL", "BALLANGVEL", "FRAMELINVEL", "FRAMEANGVEL", "SUBTREELINVEL", "SUBTREEANGMOM"),
    )
)
"""Sensors of the position and velocity stages that need only the motion of bodies."""
KINEMATICS, VELOCITY, FORCE = range(3)
"""Stages of a physics step that compute derived fields: from positions, from velocities, and forces."""


class FieldStages:
    """Lookup of the stages of a physics step that compute each MjData field of a model."""

    def __init__(self, model: mujoco.MjModel) -> None:
        force_columns = force_sensor_columns(model)
        self._sensor_stages = {FORCE} if force_columns else set()
        if len(force_columns) < model.nsensordata:
            self._sensor_stages.add(VELOCITY)
        other_sensors = model.sensor_type[model.sensor_needstage < int(mujoco.mjtStage.mjSTAGE_ACC)]
        self._sensors_need_only_motion = _MOTION_SENSORS.issuperset(other_sensors.tolist())

    def stages_of(self, name: str) -> set[int]:
        """Return the stages that compute a field (KINEMATICS, VELOCITY, FORCE); the empty set for state fields."""
        if name in (*STATE, *INPUTS):
            return set()
        if name == "sensordata":
            return self._sensor_stages
        return {KINEMATICS if name in _KINEMATIC_FIELDS else FORCE if name in ACCELERATION_FIELDS else VELOCITY}

    def needs_only_motion(self, name: str) -> bool:
        """Return whether a field can be derived from positions and velocities, without contacts and inertias."""
        if name == "sensordata":
            return self._sensors_need_only_motion
        return VELOCITY not in self.stages_of(name) or name in _MOTION_FIELDS
