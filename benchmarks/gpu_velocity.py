"""The velocity task of mjlab's Go1 on an NVIDIA GPU: bare physics, our step, mjlab's step, and training with both.

    python benchmarks/gpu_velocity.py --peer-path FOLDER:FOLDER [--only mdp,env,split,train] [--output FILE.json]

The task folder is made at run time from mjlab's own robot, exported from mjlab, and the terms of mjlab's own task
(velocity.yaml). `mdp` compares rewards and observations of given states on a CPU and needs no GPU. `split` measures the
parts of our step. Figures are medians, one JSON line for each measurement.
"""

import argparse
import json
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import gpu
import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

HERE = Path(__file__).parent
TOLERANCE = 2e-3
"""Tolerance relative to the largest value: the peer's release of MuJoCo Warp computes contact forces differently."""
OWN_WAY = {
    "body_ang_vel": "about the body's axes here, about the world's there",
    "foot_swing_height": "a swing's highest point may be that of touching down here, not there",
}
"""Rewards with another definition on each side."""
TERMS = ("lin", "ang", "gravity", "pos", "vel", "action", "command", "foot_height", "foot_air_time", "foot_contact",
         "foot_forces")  # fmt: skip


def prepare(folder, path):
    """Write the task folder."""
    shutil.copy(HERE / "velocity.yaml", folder / "task.yaml")
    before = len(gpu.rows)
    gpu.peer(path, "export", "--device", "cpu", "--output", folder / "go1.xml")
    if any(row["what"] == "peer failed" for row in gpu.rows[before:] if "what" in row):
        sys.exit("mjlab cannot write its robot")


def draw_states(env, states):
    """Return standing and tilted states with some feet on the ground, and their commands."""
    rng, n, model = np.random.default_rng(0), env.num_envs, env.engine.model
    qpos = np.tile(model.qpos0, (states, n, 1))
    qpos[..., 3:7] = np.eye(4)[0] + rng.normal(0.0, 0.05, (states, n, 4))
    qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    qpos[..., 7:] = env.entities["robot"].data.default_joint_pos[0].numpy() + rng.uniform(-0.3, 0.3, (states, n, 12))
    data, feet = mujoco.MjData(model), [model.site(f"robot/{leg}").id for leg in ("FR", "FL", "RR", "RL")]
    for row in qpos.reshape(-1, model.nq):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        row[2] += rng.uniform(0.01, 0.04) - data.site_xpos[feet, 2].min()  # the centre of the lowest foot
    command = rng.uniform([-1.0, -1.0, -0.5], [1.0, 1.0, 0.5], (states, n, 3))
    command[:, ::4] = 0.0
    drawn = {"qpos": qpos, "qvel": rng.normal(0.0, 0.7, (states, n, 18)), "command": command}
    drawn |= {name: rng.normal(0.0, 1.0, (states, n, 12)) for name in ("before", "action")}
    return {name: value.astype(np.float32) for name, value in drawn.items()}


def our_terms(env, states):
    """Return rewards and observations of each state in the format of `gpu_mjlab_velocity.terms`."""
    rows = []
    command = env.command_manager.get_command("twist")
    for number in range(len(states["qpos"])):
        env.reset()
        env.sim.forward_moved()
        for field in ("qpos", "qvel"):
            env.engine.field(field)[:] = torch.as_tensor(states[field][number])
        for action in ("before", "action"):
            env._apply_action(torch.as_tensor(states[action][number]))
        command[:] = torch.as_tensor(states["command"][number])
        env.sim.on_moved(env._select_all())
        env.sim.forward_moved()
        for sensor in env.sensors.values():
            sensor.air_time.fill_(1e-9)  # existing contacts have just started
            sensor.update(env.step_dt)
        row = {f"reward.{term.name}": term.call().float().clone() for term in env.reward_manager.terms}
        groups = {"policy": "actor", "critic": "critic"}
        observed = env._compute_observations()
        rows.append({**row, **{f"observation.{groups[name]}": value.clone() for name, value in observed.items()}})
    return {name: torch.stack([row[name] for row in rows]).numpy() for name in rows[0]}


def compare(folder, path, num_envs=16, states=8):
    """Check that terms of the same name have the same values in the same states."""
    off = {"observations.policy.enable_corruption": False, "sim.engine": "warp", "sim.forces_after_reset": True,
           **{f"events.{name}": None for name in ("slide", "spin", "roll", "com")}}  # fmt: skip
    resolved = resolve(find_task(str(folder)), device="cpu", flags={"scene.num_envs": num_envs, **off})
    env = make_env(resolved, seed=1, device="cpu")
    drawn = draw_states(env, states)
    np.savez(folder / "states.npz", **drawn)
    theirs = folder / "terms.npz"
    gpu.peer(path, "terms", "--device", "cpu", "--states", folder / "states.npz", "--output", theirs)
    ours, peers = our_terms(env, drawn), dict(np.load(theirs))
    split = {"actor": 7, "critic": 11}
    worst = {}
    for name in sorted(ours):
        if name.startswith("observation"):
            group = name.partition(".")[2]
            sizes = [term.size for term in env.layout.observations["policy" if group == "actor" else "critic"]]
            edges = np.cumsum(sizes)[:-1]
            columns = np.split(ours[name], edges, -1), np.split(peers[name], edges, -1)
            for term, mine, other in zip(
                TERMS[: split[group]], *columns, strict=True
            ):  # the force on the foot here, the foot's on the ground there
                worst[f"{name}.{term}"] = apart(mine, -other if term == "foot_forces" else other)
        else:
            worst[name] = apart(ours[name], peers[name])
    differ = [name for name, error in worst.items() if error > TOLERANCE and name.partition(".")[2] not in OWN_WAY]
    gpu.report(what="mdp", states=num_envs * states, apart=worst, differ=differ, own_way=OWN_WAY)
    if differ:
        sys.exit(f"the two tasks differ: {differ}")


def apart(ours, theirs):
    """Return the largest difference relative to the largest value."""
    return float(np.abs(ours - theirs).max() / max(1e-3, np.abs(theirs).max()))


def measure_split(task, num_envs):
    """Measure the parts of a step; each is recorded separately. [us]"""
    env = gpu.environment(task, num_envs)
    env.reset()
    for _ in range(100):
        env.step(torch.rand(num_envs, env.layout.action_size, device=gpu.DEVICE) * 2.0 - 1.0)
    action = torch.zeros(num_envs, env.layout.action_size, device=gpu.DEVICE)
    mask = torch.rand(num_envs, device=gpu.DEVICE) < 0.01
    ended = env._select(mask)
    calm = torch.zeros(num_envs, dtype=torch.bool, device=gpu.DEVICE)

    def derive():
        env.sim.on_moved(ended)
        env.sim.forward_moved()

    parts = {
        "act": lambda: env._apply_action(action),
        "physics": lambda: env.engine.step(env.config.decimation, derive=False),
        "derive": derive,
        "sensors": lambda: [sensor.update(env.step_dt) for sensor in env.sensors.values()],
        "terminations": lambda: env.termination_manager.compute(calm),
        "rewards": env.reward_manager.compute,
        "command metrics": env.command_manager.measure,
        "final observations": env._compute_final_obs,
        "episodes": lambda: env._end_episodes(mask, calm),
        "restart": lambda: (env._before_reset(ended), env._reset_envs(ended), env.sim.forward_moved()),
        "commands and pushes": lambda: (env._update_commands_and_events(), env.sim.forward_moved()),
        "observations": env._compute_observations,
    }
    found = {}
    for name, part in parts.items():

        def many(part=part):
            for _ in range(8):
                env.sim.stamp += 1
                part()

        found[name] = gpu.seconds(gpu.recorded(many), 5) / 8 * 1e6
    gpu.report(what="split", task="velocity", num_envs=num_envs, us=found)
    env.close()


def alone(folder, args, *arguments):
    """Run a measurement in a separate process."""
    same = ["--peer-path", args.peer_path, "--num-envs", str(args.num_envs), "--iterations", str(args.iterations)]
    command = [sys.executable, __file__, *same, "--one", str(folder), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not found:
        gpu.report(what="failed", arguments=arguments, error=done.stderr[-1500:])
    for row in found:
        gpu.report(**row)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer-path", required=True, help="PYTHONPATH of mjlab's packages")
    parser.add_argument("--only", default="mdp,env,split,train")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=15)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        folder, what = args.one
        if what == "env":
            gpu.measure_env(folder, args.num_envs)
        elif what == "split":
            measure_split(folder, args.num_envs)
        else:
            gpu.measure_train(args.num_envs, task=folder, iterations=args.iterations, equal={})
        return
    parts, path = args.only.split(","), args.peer_path
    versions = {"torch": torch.__version__, "warp": wp.__version__, "mujoco_warp": mjw.__version__}
    machine = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    gpu.report(what="machine", gpu=machine, python=platform.python_version(), **versions)
    size = ("--num-envs", str(args.num_envs))
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        try:
            prepare(folder, path)
            if "mdp" in parts:
                compare(folder, path)
            if "env" in parts:
                alone(folder, args, "env")
                gpu.peer(path, "env", "--task", "velocity", *size, "--steps", 50)
            if "split" in parts:
                alone(folder, args, "split")
            if "train" in parts:
                alone(folder, args, "train")
                gpu.peer(path, "train", "--task", "velocity", *size, "--iterations", 8, "--warm-up", 3)
        finally:
            if args.output:
                args.output.write_text(json.dumps(gpu.rows, indent=1))


if __name__ == "__main__":
    main()
