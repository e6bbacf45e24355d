"""The cartpole of `tasks/rlcli_tasks/cartpole/task.yaml` on mjlab and rsl_rl: the peer in `benchmarks/gpu.py`'s table.

It needs only mjlab's packages (mjlab, mujoco, mujoco_warp, warp-lang, rsl-rl-lib, torch) and imports nothing of rlcli,
so that each side has the versions that it requires. Every measurement is one line of JSON on stdout; messages of mjlab,
Warp and rsl_rl go to stderr.

    python benchmarks/gpu_mjlab.py version
    python benchmarks/gpu_mjlab.py env   --num-envs 4096 16384 --steps 300 --device cuda:0
    python benchmarks/gpu_mjlab.py train --num-envs 4096 16384 --iterations 30 --device cuda:0
    python benchmarks/gpu_mjlab.py solve --num-envs 4096 --seed 0 --budget-s 300 --device cuda:0
    python benchmarks/gpu_mjlab.py trace --states states.npz --output steps.npz     (see gpu_mdp_check.py)

`env` and `train` take `--task velocity`: mjlab's own task of a Go1 (gpu_mjlab_velocity.py, gpu_velocity.py).

mjlab is configured like its own cartpole: its own terms where they exist, CUDA graphs on, contacts off, no terrain, no
sensors, its torch settings (TF32), episodes that start at random ages. Other choices are the faster ones: memory for
the model's single constraint, one observation group for actor and critic, and no log writer, episode sums and
checkpoints of rsl_rl (`--logs` turns the first two on). rsl_rl's check for NaN is on, its default. `gpu_mdp_check.py`
checks that the task equals ours.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import importlib
import json
import math
import os
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

import gpu_mjlab_velocity as velocity

LOADED = time.time()
MODEL = Path(__file__).resolve().parents[1] / "tasks" / "rlcli_tasks" / "cartpole" / "cartpole.xml"
CART, POLE = "slider_to_cart", "cart_to_pole"
BOUND = 3.0  # [m], beyond which the cart is out
TOLERANCE, HOLD_S = 0.1, 1.0  # [rad], [s]: success
QUARTER_PI = 0.785398163
STEPS_PER_ENV = 16
PACKAGES = ("mjlab", "mujoco", "mujoco-warp", "warp-lang", "rsl-rl-lib", "tensordict", "torch")


# The MDP.


def cartpole_cfg(num_envs: int, seed: int | None = None) -> Any:
    """Return the task as mjlab's configuration."""
    from mjlab.actuator import BuiltinMotorActuatorCfg
    from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
    from mjlab.envs import ManagerBasedRlEnvCfg, mdp
    from mjlab.managers.event_manager import EventTermCfg
    from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
    from mjlab.managers.reward_manager import RewardTermCfg
    from mjlab.managers.scene_entity_config import SceneEntityCfg
    from mjlab.managers.termination_manager import TerminationTermCfg
    from mjlab.scene import SceneCfg
    from mjlab.sim import MujocoCfg, SimulationCfg

    def joint(name: str) -> SceneEntityCfg:
        return SceneEntityCfg("robot", joint_names=(name,))

    def reset(name: str, position: float, velocity: float) -> EventTermCfg:
        ranges = {"position_range": (-position, position), "velocity_range": (-velocity, velocity)}
        return EventTermCfg(func=mdp.reset_joints_by_offset, mode="reset", params={**ranges, "asset_cfg": joint(name)})

    motor = BuiltinMotorActuatorCfg(target_names_expr=(CART,), effort_limit=400.0, viscous_damping=10.0)
    robot = EntityCfg(
        spec_fn=_read_model,
        articulation=EntityArticulationInfoCfg(actuators=(motor,)),
        init_state=EntityCfg.InitialStateCfg(pos=(0.0, 0.0, 2.0)),
    )
    return ManagerBasedRlEnvCfg(
        seed=seed,
        decimation=2,
        episode_length_s=5.0,
        sim=SimulationCfg(
            nconmax=1,
            njmax=2,
            mujoco=MujocoCfg(timestep=1 / 120, integrator="euler", disableflags=("contact",)),
        ),
        scene=SceneCfg(num_envs=num_envs, env_spacing=4.0, entities={"robot": robot}),
        actions={
            "joint_effort": mdp.JointEffortActionCfg(entity_name="robot", actuator_names=(CART,), scale=100.0),
        },
        observations={
            "policy": ObservationGroupCfg(
                {
                    "joint_pos_rel": ObservationTermCfg(func=mdp.joint_pos_rel),
                    "joint_vel_rel": ObservationTermCfg(func=mdp.joint_vel_rel),
                }
            )
        },
        events={"reset_cart": reset(CART, 1.0, 0.5), "reset_pole": reset(POLE, QUARTER_PI, QUARTER_PI)},
        rewards={
            "alive": RewardTermCfg(func=mdp.is_alive, weight=1.0),
            "terminating": RewardTermCfg(func=mdp.is_terminated, weight=-2.0),
            "pole_pos": RewardTermCfg(func=joint_pos_target_l2, weight=-1.0, params={"asset_cfg": joint(POLE)}),
            "cart_vel": RewardTermCfg(func=joint_vel_l1, weight=-0.01, params={"asset_cfg": joint(CART)}),
            "pole_vel": RewardTermCfg(func=joint_vel_l1, weight=-0.005, params={"asset_cfg": joint(POLE)}),
        },
        terminations={
            "time_out": TerminationTermCfg(func=mdp.time_out, time_out=True),
            "cart_out_of_bounds": TerminationTermCfg(func=joint_out_of_bounds, params={"asset_cfg": joint(CART)}),
        },
    )


def joint_pos_target_l2(env, asset_cfg):
    """Squared joint position, wrapped [rad^2]. (num_envs,)"""
    position = env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids]
    return wrap_to_pi(position).square().sum(dim=1)


def joint_vel_l1(env, asset_cfg):
    """Absolute joint velocity [rad/s]. (num_envs,)"""
    return env.scene[asset_cfg.name].data.joint_vel[:, asset_cfg.joint_ids].abs().sum(dim=1)


def joint_out_of_bounds(env, asset_cfg):
    """The joint is further than `BOUND` from zero. (num_envs,)"""
    return (env.scene[asset_cfg.name].data.joint_pos[:, asset_cfg.joint_ids].abs() > BOUND).any(dim=1)


def wrap_to_pi(angle):
    """Wrap an angle to [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def ppo_cfg(seed: int) -> Any:
    """Return the agent as mjlab's configuration of rsl_rl."""
    from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg

    gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}
    return RslRlOnPolicyRunnerCfg(
        seed=seed,
        num_steps_per_env=STEPS_PER_ENV,
        obs_groups={"actor": ("policy",), "critic": ("policy",)},
        actor=RslRlModelCfg(hidden_dims=(32, 32), activation="elu", distribution_cfg=gaussian),
        critic=RslRlModelCfg(hidden_dims=(32, 32), activation="elu"),
        algorithm=RslRlPpoAlgorithmCfg(
            num_learning_epochs=5,
            num_mini_batches=4,
            learning_rate=1e-3,
            schedule="adaptive",
            desired_kl=0.01,
            gamma=0.99,
            lam=0.95,
            clip_param=0.2,
            entropy_coef=0.005,
            value_loss_coef=1.0,
            max_grad_norm=1.0,
        ),
        upload_model=False,
    )


def make_env(num_envs: int, device: str, seed: int | None = None, endless: bool = False, task: str = "cartpole") -> Any:
    """Return the environment; with `endless`, episodes neither end nor reset, for evaluations."""
    from mjlab.envs import ManagerBasedRlEnv

    cfg = velocity.env_cfg(num_envs, seed) if task == "velocity" else cartpole_cfg(num_envs, seed)
    if endless:
        cfg.terminations = {}
    return ManagerBasedRlEnv(cfg, device=device)


def make_runner(env: Any, options: argparse.Namespace) -> Any:
    """Return rsl_rl's runner as in mjlab's `train`, without a log folder unless one is given."""
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper

    agent = velocity.ppo_cfg(options.seed) if _task(options) == "velocity" else ppo_cfg(options.seed)
    cfg = {**asdict(agent), "torch_compile_mode": options.torch_compile, "logger": "tensorboard"}
    folder = tempfile.mkdtemp() if getattr(options, "logs", False) else None
    runner = MjlabOnPolicyRunner(RslRlVecEnvWrapper(env), cfg, folder, options.device)
    runner.logger.git_status_repos = []
    runner.save = lambda *given, **named: None  # its checkpoints do not count against it
    return runner


# The measurements: one row each.


def version(options: argparse.Namespace, num_envs: int) -> dict[str, Any]:
    """Print packages and device."""
    import torch

    row = {"python": platform.python_version(), **{name: metadata.version(name) for name in PACKAGES}}
    if options.device.startswith("cuda"):
        row |= {"cuda": torch.version.cuda, "gpu": torch.cuda.get_device_name(options.device)}
    return row


def env(options: argparse.Namespace, num_envs: int) -> dict[str, Any]:
    """Measure environment steps under random actions, with automatic resets."""
    import torch

    begin = time.perf_counter()
    environment = make_env(num_envs, options.device, options.seed, task=options.task)
    environment.reset()
    ages = environment.episode_length_buf
    environment.episode_length_buf = torch.randint_like(ages, int(environment.max_episode_length))
    columns = environment.action_manager.total_action_dim
    actions = torch.rand(16, num_envs, columns, device=options.device) * 2.0 - 1.0

    def block(steps: int) -> None:
        with torch.inference_mode():
            for step in range(steps):
                environment.step(actions[step % 16])

    _timed(options.device, lambda: block(options.warm_up))
    ready = time.perf_counter() - begin
    seconds = [_timed(options.device, lambda: block(options.steps))[1] for _ in range(options.repeats)]
    return {
        "task": options.task,
        "num_envs": num_envs,
        "env_steps_per_s": num_envs * options.steps / statistics.median(seconds),
        "env_steps_per_s_min": num_envs * options.steps / max(seconds),
        "env_steps_per_s_max": num_envs * options.steps / min(seconds),
        "step_ms": 1e3 * statistics.median(seconds) / options.steps,
        "steps": options.steps,
        "repeats": options.repeats,
        "setup_s": ready,
        "cuda_graph": environment.sim.use_cuda_graph,
    }


def train(options: argparse.Namespace, num_envs: int) -> dict[str, Any]:
    """Measure training iterations by rsl_rl's own times."""
    begin = time.perf_counter()
    environment = make_env(num_envs, options.device, options.seed, task=options.task)
    runner = make_runner(environment, options)
    times: list[tuple[float, float]] = []
    ends: list[float] = []
    write = runner.logger.log

    def log(**report: Any) -> None:
        times.append((report["collect_time"], report["learn_time"]))
        if options.logs:
            write(**report)
        ends.append(time.perf_counter())

    runner.logger.log = log
    runner.learn(options.warm_up, init_at_random_ep_len=True)
    _synchronize(options.device)
    ready = time.perf_counter() - begin
    times.clear()
    ends.clear()
    runner.learn(options.iterations)
    whole = [collect + learn for collect, learn in times]
    if options.logs:  # what writing the logs takes counts too
        whole = [after - before for before, after in pairwise(ends)]
    steps = velocity.STEPS_PER_ENV if options.task == "velocity" else STEPS_PER_ENV
    rates = [steps * num_envs / seconds for seconds in whole]
    return {
        "task": options.task,
        "num_envs": num_envs,
        "env_steps_per_s": statistics.median(rates),
        "env_steps_per_s_min": min(rates),
        "env_steps_per_s_max": max(rates),
        "iteration_s": statistics.median(whole),
        "logs": options.logs,
        "collection_s": statistics.median(collect for collect, _ in times),
        "learning_s": statistics.median(learn for _, learn in times),
        "iterations": len(times),
        "setup_s": ready,
        "cuda_graph": environment.sim.use_cuda_graph,
        "torch_compile": options.torch_compile,
    }


def solve(options: argparse.Namespace, num_envs: int) -> dict[str, Any]:
    """Measure the wall-clock time from process creation to the first successful evaluation."""
    started, source = process_start(options.started)
    environment = make_env(num_envs, options.device, options.seed)
    runner = make_runner(environment, options)
    _synchronize(options.device)
    setup_s = time.time() - started
    examiner, examiner_s = _timed(options.device, lambda: make_env(options.episodes, options.device, endless=True))
    iterations, training_s, evaluation_s = 0, 0.0, 0.0
    evaluations: list[dict[str, float]] = []
    rate, elapsed = 0.0, 0.0
    while rate < options.success and elapsed < options.budget_s:
        learn = partial(runner.learn, options.every, init_at_random_ep_len=not evaluations)
        training_s += _timed(options.device, learn)[1]
        iterations += options.every
        rate, seconds = _timed(options.device, lambda: success_rate(examiner, runner, options.device))
        evaluation_s += seconds
        elapsed = time.time() - started
        evaluations.append({"iteration": iterations, "seconds": elapsed, "success": rate})
        print(f"iteration {iterations}, {elapsed:.1f} s: success {rate:.3f}", file=sys.stderr)
    return {
        "num_envs": num_envs,
        "seed": options.seed,
        "solved": rate >= options.success,
        "seconds": elapsed,
        "seconds_without_evaluation": elapsed - evaluation_s - examiner_s,
        "setup_s": setup_s,
        "training_s": training_s,
        "evaluation_s": evaluation_s,
        "evaluation_setup_s": examiner_s,
        "iterations": iterations,
        "env_steps": iterations * STEPS_PER_ENV * num_envs,
        "success": rate,
        "episodes": options.episodes,
        "started_from": source,
        "cuda_graph": environment.sim.use_cuda_graph,
        "torch_compile": options.torch_compile,
        "evaluations": evaluations,
    }


def trace(options: argparse.Namespace, num_envs: int) -> dict[str, Any]:
    """Write observations, rewards and ends of steps from given states under given actions."""
    import numpy as np
    import torch

    given = np.load(options.states)
    tensors = {name: torch.as_tensor(given[name], device=options.device) for name in given.files}
    environment = make_env(given["qpos"].shape[1], options.device, options.seed)
    starts, steps = [], []
    for qpos, qvel, age, actions in zip(*(tensors[key] for key in ("qpos", "qvel", "age", "action")), strict=True):
        starts.append(environment.reset()[0]["policy"].clone())
        environment.scene["robot"].write_joint_state_to_sim(qpos, qvel)
        environment.episode_length_buf[:] = age
        for action in actions:
            obs, reward, terminated, truncated, _ = environment.step(action)
            steps.append([value.clone() for value in (obs["policy"], reward, terminated, truncated)])
    columns = dict(zip(("obs", "reward", "terminated", "truncated"), zip(*steps, strict=True), strict=True))
    columns["start"] = tuple(starts)
    np.savez(options.output, **{name: torch.stack(values).cpu().numpy() for name, values in columns.items()})
    return {"num_envs": environment.num_envs, "steps": len(steps), "output": str(options.output)}


def success_rate(environment: Any, runner: Any, device: str) -> float:
    """Return the share of episodes (one per environment) that reach the time limit with the pole up in the last second.

    The environment does not end episodes; states after a cart has left its bounds are ignored.
    """
    import torch
    from tensordict import TensorDict

    policy = runner.get_inference_policy(device)
    hold = math.ceil(HOLD_S / environment.step_dt - 1e-6)
    data = environment.scene["robot"].data
    with torch.inference_mode():
        obs, _ = environment.reset()
        inside = torch.ones(environment.num_envs, dtype=torch.bool, device=device)
        held = torch.zeros(environment.num_envs, dtype=torch.long, device=device)
        for _ in range(environment.max_episode_length):
            obs = environment.step(policy(TensorDict(obs, batch_size=[environment.num_envs])))[0]
            cart, pole = data.joint_pos.unbind(dim=1)
            inside &= cart.abs() <= BOUND
            held = (held + 1) * (wrap_to_pi(pole).abs() < TOLERANCE)
        return float((inside & (held >= hold)).float().mean())


# The rest.


def process_start(given: float | None) -> tuple[float, str]:
    """Return the Unix time at which this process was created, and its source."""
    if given is not None:
        return given, "argument"
    with contextlib.suppress(OSError, ValueError, IndexError):
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        uptime = float(Path("/proc/uptime").read_text().split()[0])
        created = time.time() - uptime + ticks / os.sysconf("SC_CLK_TCK")
        if 0.0 <= LOADED - created < 60.0:  # some sandboxes keep no such account
            return created, "process"
    return LOADED, "script"


def _task(options: argparse.Namespace) -> str:
    return getattr(options, "task", "cartpole")


def _read_model() -> Any:
    import mujoco

    return mujoco.MjSpec.from_file(str(MODEL))


def _timed(device: str, work: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result, and the seconds until the device has finished it."""
    begin = time.perf_counter()
    result = work()
    _synchronize(device)
    return result, time.perf_counter() - begin


def _synchronize(device: str) -> None:
    if device.startswith("cuda"):
        import torch

        torch.cuda.synchronize()


def _prepare() -> None:
    """Apply the settings of mjlab's own `train`, and replace its viewers if they are not installed."""
    os.environ.setdefault("MUJOCO_GL", "disabled")
    with contextlib.suppress(ImportError):
        importlib.import_module("stub_viewers")
    from mjlab.utils.torch import configure_torch_backends

    configure_torch_backends()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)

    def command(measure: Callable[..., dict[str, Any]]) -> argparse.ArgumentParser:
        added = commands.add_parser(measure.__name__, help=measure.__doc__)
        added.set_defaults(measure=measure, num_envs=[0])
        added.add_argument("--device", default="cuda:0" if Path("/dev/nvidia0").exists() else "cpu")
        added.add_argument("--seed", type=int, default=0)
        return added

    command(version)
    stepping = command(env)
    stepping.add_argument("--num-envs", type=int, nargs="+", default=[4096])
    stepping.add_argument("--steps", type=int, default=300)
    stepping.add_argument("--repeats", type=int, default=5)
    stepping.add_argument("--warm-up", type=int, default=50, help="steps before the first block")
    training = command(train)
    training.add_argument("--num-envs", type=int, nargs="+", default=[4096])
    training.add_argument("--iterations", type=int, default=30)
    training.add_argument("--warm-up", type=int, default=5, help="iterations before the first that counts")
    solving = command(solve)
    solving.add_argument("--num-envs", type=int, nargs=1, default=[4096])
    solving.add_argument("--budget-s", type=float, default=300.0)
    solving.add_argument("--every", type=int, default=10, help="iterations between evaluations")
    solving.add_argument("--episodes", type=int, default=1024, help="of an evaluation, all at once")
    solving.add_argument("--success", type=float, default=0.99)
    solving.add_argument("--started", type=float, help="Unix time to count from; default: when the process was created")
    training.add_argument("--logs", action="store_true", help="write rsl_rl's logs, and count the time it takes")
    for either in (stepping, training):
        either.add_argument("--task", choices=["cartpole", "velocity"], default="cartpole")
    for trainer in (training, solving):
        trainer.add_argument("--torch-compile", metavar="MODE", help="rsl_rl's torch_compile_mode; mjlab leaves it off")
    tracing = command(trace)
    tracing.add_argument("--states", type=Path, required=True, help="npz: qpos, qvel, age, action")
    tracing.add_argument("--output", type=Path, required=True)
    velocity.add_commands(command)
    return parser.parse_args()


def main() -> None:
    options = _options()
    stdout = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):
        _prepare()
        for num_envs in options.num_envs:
            row = {"measurement": options.command, "device": options.device, **options.measure(options, num_envs)}
            print(json.dumps(row), file=stdout, flush=True)
            gc.collect()  # the environment of this size, before the next is made


if __name__ == "__main__":
    main()
