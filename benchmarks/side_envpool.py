"""EnvPool's side (see sides.py): Gymnasium's v5 tasks, all environments in every step."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import Any

from sides import clock, serve

theirs: dict[str, Any] = {}


def version() -> dict[str, str]:
    """Return the version of EnvPool."""
    return {"envpool": metadata.version("envpool")}


def open_env(task: str, num_envs: int, threads: int) -> dict[str, Any]:
    """Make a pool and uniform random actions within its limits; return the path of the model for comparison."""
    import envpool
    import numpy as np

    theirs.clear()
    pool = envpool.make_gymnasium(task, num_envs=num_envs, num_threads=threads, seed=0)
    pool.reset()
    space = pool.action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (16, num_envs, *space.shape))
    theirs.update(pool=pool, actions=actions.astype(space.dtype))
    config = dict(zip(pool.spec._config_keys, pool.spec._config_values, strict=True))
    folder, name = Path(config["base_path"]) / "mujoco" / "assets_gym", Path(config["xml_file"]).stem
    return {
        "physics_steps": config["frame_skip"],
        "max_episode_length": config["max_episode_steps"],
        "model": str(folder / f"{name}_envpool.xml"),
    }


def step(steps: int) -> float:
    """Return the seconds of `steps` environment steps, with EnvPool's automatic resets.

    At the end of an episode EnvPool resets an environment instead of a step, and simulates nothing. Such calls are not
    counted as steps: the time is scaled to the requested number of steps.
    """
    pool, actions = theirs["pool"], theirs["actions"]
    begin = clock()
    ages = [pool.step(actions[index % len(actions)])[4]["elapsed_step"] for index in range(steps)]
    seconds = clock() - begin
    simulated = sum(int((age > 0).sum()) for age in ages)
    return seconds * steps * len(ages[0]) / simulated


if __name__ == "__main__":
    serve({f.__name__: f for f in (version, open_env, step)})
