"""Bare loop of `mj_step` on one thread (see sides.py), to compare versions of MuJoCo."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from sides import clock, serve

world: dict[str, Any] = {}


def version() -> dict[str, str]:
    """Return the version of MuJoCo."""
    return {"mujoco": mujoco.__version__}


def open_model(path: str, physics_steps: int) -> None:
    """Load a model in its default state, with a number of physics steps for each step."""
    model = mujoco.MjModel.from_xml_path(path)
    low, high = model.actuator_ctrlrange.T
    controls = np.random.default_rng(0).uniform(low, high, (256, model.nu))
    world.update(model=model, data=mujoco.MjData(model), controls=controls, physics_steps=physics_steps)


def step(steps: int) -> float:
    """Return the seconds of `steps` steps of the task; the state is reset every 100 steps."""
    model, data, controls, nstep = (world[key] for key in ("model", "data", "controls", "physics_steps"))
    begin = clock()
    for index in range(steps):
        if index % 100 == 0:
            mujoco.mj_resetData(model, data)
        data.ctrl[:] = controls[index % 256]
        mujoco.mj_step(model, data, nstep)
    return clock() - begin


if __name__ == "__main__":
    serve({f.__name__: f for f in (version, open_model, step)})
