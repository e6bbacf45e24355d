"""mjlab's own velocity task of the Go1 on flat ground: configuration, robot and reward terms for `gpu_mjlab.py`.

There are three changes to mjlab's task: no share of commands straight ahead, no command curriculum (rlcli's task has
neither), and weights for two terms that mjlab disables, so that a dozen terms are computed.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

STEPS_PER_ENV = 24
WEIGHTS = {"body_ang_vel": -0.05, "angular_momentum": -0.02}


def env_cfg(num_envs: int, seed: int | None = None) -> Any:
    """Return the task."""
    from mjlab.tasks.velocity.config.go1.env_cfgs import unitree_go1_flat_env_cfg

    cfg = unitree_go1_flat_env_cfg()
    cfg.seed = seed
    cfg.scene.num_envs = num_envs
    cfg.commands["twist"].rel_forward_envs = 0.0
    cfg.commands["twist"].debug_vis = False
    cfg.curriculum.pop("command_vel")
    for name, weight in WEIGHTS.items():
        cfg.rewards[name].weight = weight
    return cfg


def ppo_cfg(seed: int) -> Any:
    """Return the agent."""
    from mjlab.tasks.velocity.config.go1.rl_cfg import unitree_go1_ppo_runner_cfg

    cfg = unitree_go1_ppo_runner_cfg()
    cfg.seed = seed
    cfg.upload_model = False
    return cfg


def export(options: argparse.Namespace, num_envs: int) -> dict[str, Any]:
    """Write mjlab's robot to an MJCF: its collisions, actuators and solver options."""
    import mujoco
    from mjlab.asset_zoo.robots.unitree_go1 import go1_constants
    from mjlab.entity import Entity

    cfg = env_cfg(1)
    robot = Entity(cfg.scene.entities["robot"]).spec
    for key in list(robot.keys):
        robot.delete(key)
    robot.meshdir = str(go1_constants.GO1_XML.parent / "assets")
    given = cfg.sim.mujoco
    robot.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    robot.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name in ("impratio", "iterations", "ls_iterations", "ls_tolerance", "tolerance", "ccd_iterations"):
        setattr(robot.option, name, getattr(given, name))
    assert (given.cone, given.integrator, given.solver) == ("elliptic", "implicitfast", "newton")
    options.output.write_text(robot.to_xml())
    return {"output": str(options.output), "njmax": cfg.sim.njmax}


def terms(options: argparse.Namespace, num_envs: int) -> dict[str, Any]:
    """Write rewards and observations of given states, without noise, for comparison. The states are at rest."""
    import numpy as np
    import torch
    from mjlab.envs import ManagerBasedRlEnv

    given = np.load(options.states)
    tensors = {name: torch.as_tensor(given[name], device=options.device) for name in given.files}
    rows = []
    cfg = env_cfg(given["qpos"].shape[1], options.seed)
    cfg.events = {}
    cfg.observations["actor"].enable_corruption = False
    environment = ManagerBasedRlEnv(cfg, device=options.device)
    robot, command = environment.scene["robot"], environment.command_manager.get_term("twist")
    for qpos, qvel, asked, before, action in zip(
        *(tensors[k] for k in ("qpos", "qvel", "command", "before", "action")), strict=True
    ):
        environment.reset()
        robot.data.data.qpos[:] = qpos
        robot.data.data.qvel[:] = qvel
        command.vel_command_b[:] = asked
        environment.action_manager.process_action(before)
        environment.action_manager.process_action(action)
        environment.action_manager.apply_action()
        environment.scene.write_data_to_sim()
        environment.sim.forward()
        environment.sim.sense()
        environment.scene.update(dt=environment.step_dt)
        environment.sim.sense()
        manager = environment.reward_manager
        row = {}
        for name, term in zip(manager._term_names, manager._term_cfgs, strict=True):
            row[f"reward.{name}"] = term.func(environment, **term.params).float().clone()
        for group, values in environment.observation_manager.compute(update_history=True).items():
            row[f"observation.{group}"] = values.clone()
        rows.append(row)
    found = {name: torch.stack([row[name] for row in rows]).cpu().numpy() for name in rows[0]}
    np.savez(options.output, **found)
    return {"num_envs": environment.num_envs, "states": len(rows), "output": str(options.output)}


def add_commands(command: Any) -> None:
    """Add the commands of this task to those of `gpu_mjlab.py`."""
    writing = command(export)
    writing.add_argument("--output", type=Path, required=True)
    comparing = command(terms)
    comparing.add_argument("--states", type=Path, required=True, help="npz: qpos, qvel, command, before, action")
    comparing.add_argument("--output", type=Path, required=True)
