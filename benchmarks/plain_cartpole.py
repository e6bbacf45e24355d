"""The cartpole of `tasks/rlcli_tasks/cartpole/task.yaml` as a typical Gymnasium environment: `mj_step` in Python."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

MODEL = Path(__file__).resolve().parents[1] / "tasks" / "rlcli_tasks" / "cartpole" / "cartpole.xml"
DT, DECIMATION, STEPS = 1.0 / 120.0, 2, 300
QUARTER_PI = 0.785398163


class PlainCartpole(gymnasium.Env):
    """Cartpole with the model, observations, rewards, ends and start states of the task."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self) -> None:
        spec = mujoco.MjSpec.from_file(str(MODEL))
        motor = spec.add_actuator(name="motor", target="slider_to_cart", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.ctrlrange, motor.ctrllimited = (-400.0, 400.0), True
        spec.joint("slider_to_cart").damping = (10.0, 0.0, 0.0)
        self.model = spec.compile()
        self.model.opt.timestep = DT
        self.data = mujoco.MjData(self.model)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        draw = self.np_random.uniform(-1.0, 1.0, 4)
        self.data.qpos[:] = draw[:2] * (1.0, QUARTER_PI)
        self.data.qvel[:] = draw[2:] * (0.5, QUARTER_PI)
        self.steps = 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Make two physics steps."""
        self.data.ctrl[0] = 100.0 * action[0]
        mujoco.mj_step(self.model, self.data, DECIMATION)
        self.steps += 1
        (cart, pole), (cart_rate, pole_rate) = self.data.qpos, self.data.qvel
        terminated = bool(abs(cart) > 3.0)
        lean = (pole + np.pi) % (2.0 * np.pi) - np.pi
        reward = (not terminated) - 2.0 * terminated - lean * lean - 0.01 * abs(cart_rate) - 0.005 * abs(pole_rate)
        return self.observe(), reward * DT * DECIMATION, terminated, self.steps >= STEPS, {}

    def observe(self) -> np.ndarray:
        """Return positions and velocities."""
        return np.concatenate([self.data.qpos, self.data.qvel]).astype(np.float32)


__all__ = ["PlainCartpole"]
