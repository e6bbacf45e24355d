"""Lists of the MjData fields and sensors of forces and accelerations, which MuJoCo computes in a step's last stage.

MuJoCo computes the forces on bodies and their accelerations only if a sensor needs them. If a term reads such a field,
`add_body_forces` adds a sensor to the model.
"""

from __future__ import annotations

import mujoco
import numpy as np

ACCELERATION_FIELDS = {
    *("qacc", "qacc_smooth", "actuator_force", "qfrc_actuator", "qfrc_smooth", "qfrc_constraint", "qfrc_inverse"),
    *("act_dot", "cacc", "cfrc_int", "cfrc_ext"),
}
"""Fields of MjData that the acceleration stage writes. After a step they have the values of the last physics step."""
_BODY_FORCE_SENSORS = [
    int(getattr(mujoco.mjtSensor, f"mjSENS_{kind}"))
    for kind in ("ACCELEROMETER", "FORCE", "TORQUE", "FRAMELINACC", "FRAMEANGACC")
]


def computes_body_forces(model: mujoco.MjModel) -> bool:
    """Return whether MuJoCo computes `cacc`, `cfrc_int`, `cfrc_ext` in a step: only if a sensor needs them."""
    return bool(np.isin(model.sensor_type, _BODY_FORCE_SENSORS).any())


def add_body_forces(spec: mujoco.MjSpec) -> None:
    """Add a dummy sensor to the model, so that MuJoCo computes `cacc`, `cfrc_int` and `cfrc_ext` in each step."""
    kind, body = mujoco.mjtSensor.mjSENS_FRAMEANGACC, mujoco.mjtObj.mjOBJ_BODY
    spec.add_sensor(name="body_forces", type=kind, objtype=body, objname="world")


def force_sensor_columns(model: mujoco.MjModel) -> list[int]:
    """Return the columns of MjData's `sensordata` with readings of forces or accelerations (the acceleration stage)."""
    acceleration = int(mujoco.mjtStage.mjSTAGE_ACC)
    return sensor_columns(model, np.flatnonzero(model.sensor_needstage == acceleration).tolist())


def sensor_columns(model: mujoco.MjModel, sensors: list[int]) -> list[int]:
    """Return the columns of MjData's `sensordata` that belong to the sensors with these ids, in their order."""
    starts, sizes = model.sensor_adr, model.sensor_dim
    return [column for s in sensors for column in range(int(starts[s]), int(starts[s] + sizes[s]))]
