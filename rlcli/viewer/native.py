"""A window on one environment, MuJoCo's own passive viewer."""

from __future__ import annotations

import sys
import time

import torch

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import MachineError
from rlcli.rl.rollout import Act
from rlcli.viewer.video import free_camera


def run(env: VecEnv, act: Act, shown: int = 0, obs: torch.Tensor | None = None) -> None:
    """Step the environment in real time until the window is closed. Space pauses.

    Args:
        env: the environment.
        act: what acts in it.
        shown: which of its environments to show.
        obs: what the policy sees, of an environment that goes on from where it is; None: it begins anew.

    Raises:
        MachineError: if no window opens, as on macOS outside mjpython.
    """
    import mujoco.viewer

    model, data = env.world(shown)

    def key(code: int) -> None:
        if code == ord(" "):
            env.pause(env.is_playing())

    try:
        handle = mujoco.viewer.launch_passive(model, data, key_callback=key)
    except RuntimeError as error:
        hint = "start it as: mjpython -m rlcli play ..." if sys.platform == "darwin" else None
        raise MachineError(f"the window cannot be opened: {error}", hint=hint) from error
    with handle as window, torch.no_grad():
        camera = free_camera(env.config.viewer, env.origins[shown].tolist())
        window.cam.lookat[:], window.cam.distance = camera.lookat, camera.distance
        window.cam.azimuth, window.cam.elevation = camera.azimuth, camera.elevation
        obs = env.reset(seed=env.seed)["policy"] if obs is None else obs
        while window.is_running():
            begin = time.perf_counter()
            if env.is_playing():
                obs = env.step(act(obs)).obs["policy"]
                env.world(shown)
            window.sync()
            time.sleep(max(0.0, env.step_dt - (time.perf_counter() - begin)))
