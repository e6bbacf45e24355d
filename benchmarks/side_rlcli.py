"""rlcli's side of the comparisons: environment steps, training iterations, memory (see sides.py)."""

from __future__ import annotations

import os
from typing import Any

os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # as `rlcli train` sets it
from machine import describe, memory_mb
from sides import clock, serve

SEED_SIZES = {
    "ppo": ["agent.num_steps=16", "agent.num_epochs=5", "agent.num_minibatches=4"],
    "sb3-ppo": ["agent.n_steps=16", "agent.n_epochs=5", "agent.num_minibatches=4"],
}
"""4,096 x 16 samples, 5 epochs, 4 minibatches; the networks of cartpole's agents are 32-32 ELU already."""
ours: dict[str, Any] = {}


def machine() -> str:
    """Return processor and versions."""
    return describe()


def open_env(task: str, num_envs: int, threads: int = 0, overrides: list[str] | None = None) -> dict[str, Any]:
    """Make an environment and uniform random actions within its limits."""
    import torch

    from rlcli.config.load import resolve
    from rlcli.envs.make import make_env
    from rlcli.registry import find_task

    close()
    torch.set_num_threads(1)
    changes = [*(overrides or []), *([f"sim.engine_threads={threads}"] if threads else [])]
    resolved = resolve(find_task(task), overrides=changes, flags={"scene.num_envs": num_envs})
    env = make_env(resolved, seed=0)
    env.final_obs_of = "truncated"  # what a trainer asks for
    env.reset(seed=0)
    columns = env.layout.action_size
    limits = getattr(getattr(env, "task", None), "action_limits", ()) or ((-1.0, 1.0),) * columns
    low, high = torch.tensor(limits).T
    unit = torch.rand(16, num_envs, columns, generator=torch.Generator().manual_seed(0))
    ours.update(env=env, actions=low + (high - low) * unit)
    return {
        "physics_steps": env.config.decimation,
        "max_episode_length": env.max_episode_length,
    }


def step(steps: int) -> float:
    """Return the seconds of `steps` environment steps."""
    import torch

    env, actions = ours["env"], ours["actions"]
    begin = clock()
    with torch.inference_mode():
        for index in range(steps):
            env.step(actions[index % len(actions)])
    return clock() - begin


def physics() -> float:
    """Return the engine's share of the time of the environment's steps so far."""
    return ours["env"].seconds["physics"] / ours["env"].seconds["step"]


def differs(path: str) -> list[str]:
    """Return the physics fields in which a compiled model file differs from the environment's model."""
    import mujoco
    import numpy as np

    def numbers(model: Any, fields: tuple[str, ...]) -> dict[str, Any]:
        values = {name: getattr(model, name) for name in dir(model) if name.startswith(fields)}
        return {name: value for name, value in values.items() if isinstance(value, int | float | np.ndarray)}

    physical = ("body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "jnt_", "dof_", "geom_size",
                "geom_pos", "geom_con", "geom_friction", "geom_sol", "geom_margin", "actuator_", "eq_",
                "tendon_")  # fmt: skip
    model, other = ours["env"].engine.model, mujoco.MjModel.from_xml_path(path)
    pairs = [(numbers(model, physical), numbers(other, physical))]
    options = ("timestep", "gravity", "density", "viscosity", "integrator", "solver", "cone", "iterations", "tolerance",
               "ls_", "o_", "impratio", "disableflags", "enableflags")  # fmt: skip
    pairs.append((numbers(model.opt, options), numbers(other.opt, options)))
    return [name for own, given in pairs for name in own if not np.array_equal(own[name], given[name])]


def open_bare() -> None:
    """Open only the physics of the environment, with the same number of threads."""
    from mujoco.batch import Batch

    env = ours["env"]
    low, high = env.engine.model.actuator_ctrlrange.T
    limited = env.engine.model.actuator_ctrllimited.astype(bool)
    unit = ours["actions"].double().numpy()
    controls = unit.clip(low, high) if limited.all() else 100.0 * unit
    ours.update(batch=Batch(env.engine.model, env.num_envs, env.engine.threads), controls=controls)


def step_bare(steps: int) -> float:
    """Return the seconds of `steps` steps of bare physics, from the default state on."""
    batch, controls = ours["batch"], ours["controls"]
    substeps, ctrl = ours["env"].config.decimation, batch.bind("ctrl")
    batch.reset()
    begin = clock()
    for index in range(steps):
        ctrl[:] = controls[index % len(controls)]
        batch.step(nstep=substeps)
    return clock() - begin


def open_trainer(agent: str, num_envs: int) -> dict[str, Any]:
    """Make a trainer of the cartpole with the common sizes."""
    from rlcli.config.load import resolve
    from rlcli.envs.make import make_env
    from rlcli.machine.cores import available_cores
    from rlcli.registry import find_task, load_object

    close()
    resolved = resolve(
        find_task("cartpole"), agent=agent, overrides=SEED_SIZES[agent], flags={"scene.num_envs": num_envs}
    )
    env = make_env(resolved, seed=0)
    assert resolved.agent is not None
    assert resolved.trainer is not None
    trainer = load_object(resolved.trainer.trainer)(
        env, resolved.agent, seed=0, device="cpu", torch_threads=min(4, available_cores())
    )
    trainer.start()
    ours.update(env=env, trainer=trainer)
    return {"samples": 16 * num_envs}


def train(steps: int) -> float:
    """Return the seconds of `iterations` iterations."""
    begin = clock()
    for _ in range(steps):
        ours["trainer"].iterate()
    return clock() - begin


def close() -> None:
    """Close everything that was opened."""
    if "env" in ours:
        ours["env"].close()
    ours.clear()


if __name__ == "__main__":
    serve(
        {
            f.__name__: f
            for f in (
                machine,
                open_env,
                step,
                physics,
                differs,
                open_bare,
                step_bare,
                open_trainer,
                train,
                memory_mb,
                close,
            )
        }
    )
