"""Training and stepping on an NVIDIA GPU: rlcli, bare MuJoCo Warp and mjlab with rsl_rl, in one run on one machine.

    python benchmarks/gpu.py [--peer-path FOLDER:FOLDER] [--only env,train,features,ant,solve] [--output FILE.json]

Equal networks (32-32), horizon (16), epochs (5) and minibatches (4) everywhere. `--peer-path` is the PYTHONPATH that
mjlab runs under; without it the peer's rows are left out. Figures are medians; one JSON line a measurement.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mujoco_warp as mjw
import torch
import warp as wp

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.rl.ppo.trainer import PpoTrainer

DEVICE = "cuda"
REPEATS = 7
ENVS = (4096, 16384)
STEPS = 32
"""Number of environment steps in one captured graph."""
EQUAL = {
    "num_steps": 16, "num_epochs": 5, "num_minibatches": 4, "entropy_coef": 0.005, "max_iterations": 100000,
    "schedule": "adaptive", "desired_kl": 0.01, "actor.hidden": [32, 32], "critic.hidden": [32, 32],
}  # fmt: skip
HERE = Path(__file__).parent
rows = []


def report(**row):
    rows.append(row)
    print(json.dumps(row), flush=True)


def seconds(work, repeats=REPEATS, times=1):
    """Return the seconds of one run of `work`: median of several blocks, measured by device events."""
    found = []
    for _ in range(repeats):
        begin, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        begin.record()
        for _ in range(times):
            work()
        end.record()
        end.synchronize()
        found.append(begin.elapsed_time(end) / 1e3 / times)
    return statistics.median(found)


def recorded(work):
    """Return `work` as a CUDA graph of torch and Warp."""
    work()
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    torch.cuda.synchronize()
    with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
        on = wp.stream_from_torch(stream)
        wp.set_stream(on, wp.get_device(DEVICE))
        wp.capture_begin(stream=on, external=True)
        work()
        kept = wp.capture_end(stream=on), on
    torch.cuda.synchronize()
    return lambda kept=(kept, work): graph.replay()


def environment(task, num_envs, **flags):
    resolved = resolve(find_task(task), device=DEVICE, flags={"scene.num_envs": num_envs, **flags})
    return make_env(resolved, seed=1, device=DEVICE)


def bare(env, controls):
    """Return MuJoCo Warp alone with the environment's model, memory and controls, without resets and task.

    Returns:
        The recorded work, and a function that restores the current states of the environment.
    """
    engine = env.engine
    with wp.ScopedDevice(DEVICE):
        model = mjw.put_model(engine.model)
        for name in engine.expanded_fields():  # what is randomised differs between the worlds here, too
            theirs, attribute = engine._owner(name)
            setattr(model.opt if name.startswith("opt.") else model, attribute, getattr(theirs, attribute))
        model.opt.warn_overflow = 0
        room = engine.capacity
        data = mjw.make_data(engine.model, nworld=env.num_envs, nconmax=room.contacts, njmax=room.constraints)
    names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "act", "time")
    fields = {name: wp.to_torch(getattr(data, name)) for name in names}
    saved = {name: engine.field(name).clone() for name in names}

    def work():
        for control in controls:
            fields["ctrl"].copy_(control)
            for _ in range(env.config.decimation):
                mjw.step(model, data)

    def start():
        for name, value in saved.items():
            fields[name].copy_(value)

    start()
    return recorded(work), start


def measure_env(task, num_envs):
    """Measure bare physics and whole steps from the same states under the same actions, in turn."""
    env = environment(task, num_envs)
    env.reset()

    def actions(steps):
        return torch.rand(steps, num_envs, env.layout.action_size, device=DEVICE) * 2.0 - 1.0

    for action in actions(200):  # episodes of all ages
        env.step(action)
    saved, plan = env.state_dict(), actions(STEPS)
    controls = []
    for action in plan:
        env.step(action)
        controls.append(env.engine.field("ctrl").clone())
    env.load_state_dict(saved)
    physics, physics_start = bare(env, controls)
    whole = recorded(lambda: [env.step(action) for action in plan])
    pairs = []
    for _ in range(REPEATS):
        physics_start()
        bare_s = seconds(physics, 1)
        env.load_state_dict(saved)
        pairs.append((bare_s, seconds(whole, 1)))
    bare_s, ours_s = (statistics.median(column) / STEPS for column in zip(*pairs, strict=True))
    env.check()
    rates = {"bare_steps_per_s": num_envs / bare_s, "steps_per_s": num_envs / ours_s, "ratio": bare_s / ours_s}
    report(what="env", task=task, num_envs=num_envs, **rates, bare_us=bare_s * 1e6, step_us=ours_s * 1e6)
    env.close()


def measure_train(
    num_envs, name="all on", task="cartpole", iterations=40, change=lambda trainer: None, equal=EQUAL, **flags
):
    settings = {f"agent.{key}": value for key, value in {**equal, **flags}.items()}
    settings["scene.num_envs"] = num_envs
    resolved = resolve(find_task(task), agent="ppo", device=DEVICE, flags=settings)
    env = make_env(resolved, seed=1, device=DEVICE)
    begin = time.perf_counter()
    trainer = PpoTrainer(env, resolved.agent, seed=1, device=DEVICE, torch_threads=1)
    change(trainer)
    trainer.start()
    trainer.iterate()
    first = time.perf_counter() - begin
    trainer.iterate()
    reports, walls = [], []
    for _ in range(iterations):
        begin = time.perf_counter()
        reports.append(trainer.iterate())
        walls.append(time.perf_counter() - begin)
    wall = statistics.median(walls)
    parts = {key: statistics.median(r.seconds[key] for r in reports) for key in reports[0].seconds}
    report(what="train", task=task, feature=name, num_envs=num_envs, steps_per_s=trainer.steps_per_iteration / wall,
           iteration_ms=wall * 1e3, first_iteration_s=first,
           **{f"{key}_ms": value * 1e3 for key, value in parts.items()})  # fmt: skip
    env.close()


def without(part):
    """Switch off everything that the environment or the trainer does besides learning."""

    def change(trainer):
        if part == "statistics":
            trainer.statistics.add = lambda episodes: None
        elif part == "guard":
            trainer.env.engine.diverged = lambda: torch.zeros(trainer.env.num_envs, dtype=torch.bool, device=DEVICE)
        elif part == "finite":
            trainer.env.engine.check_finite = lambda values, what: None

    return change


FEATURES = {
    "all on": {},
    "bootstrap from the state before, not from final_obs": {"bootstrap": "pre_step"},
    "update not compiled": {"compile": False},
    "update compiled and tuned": {"compile": "tuned"},
    "update without TF32": {"tf32": False},
    "constant learning rate": {"schedule": "constant", "desired_kl": None},
    "no episode statistics": {"change": without("statistics")},
    "no divergence guard": {"change": without("guard")},
    "no finiteness checks": {"change": without("finite")},
    "observations normalised": {"normalize_observations": True},
}


def alone(what, *arguments):
    """Run a measurement in a separate process, so that it does not share GPU memory with another."""
    command = [sys.executable, str(HERE / "gpu.py"), "--one", json.dumps([what, *arguments])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not found:
        report(what="failed", arguments=[what, *arguments], error=done.stderr[-1500:])
    for row in found:
        report(**row)


def peer(path, *arguments):
    environ = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": "disabled"}
    command = [sys.executable, str(HERE / "gpu_mjlab.py"), *map(str, arguments)]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, check=False)
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if done.returncode or not found:
        report(what="peer failed", arguments=[str(a) for a in arguments], error=done.stderr[-1500:])
    for row in found:
        report(**{**row, "peer": "mjlab"})


def rlcli(*arguments):
    command = ["timeout", "100", sys.executable, "-m", "rlcli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def measure_scaling(num_envs, most):
    """Measure weak scaling: the same number of environments for each GPU."""
    single = None
    for gpus in [n for n in (1, 2, 4, 8) if n <= most]:
        with tempfile.TemporaryDirectory() as runs:
            options = ["--gpus", str(gpus), "--num-envs", str(num_envs), "--runs-dir", runs, "--max-iterations", "120"]
            done = rlcli("train", "cartpole", *options, "--agent", "ppo", "--logger", "none", "--json")
            if done.returncode:
                report(what="scaling failed", gpus=gpus, error=(done.stderr + done.stdout)[-1500:])
                continue
            lines = (Path(json.loads(done.stdout)["run"]) / "metrics.jsonl").read_text().splitlines()
        rate = statistics.median(json.loads(line)["Perf/total_fps"] for line in lines[20:])
        single = single or rate
        report(what="scaling", gpus=gpus, num_envs_each=num_envs, steps_per_s=rate, of_linear=rate / (gpus * single))


def measure_solve(seeds):
    """Measure the wall-clock time of `rlcli train cartpole` from process start to end, and evaluate the policy."""
    for seed in seeds:
        with tempfile.TemporaryDirectory() as runs:
            begin = time.time()
            trained = rlcli("train", "cartpole", "--device", "cuda", "--seed", str(seed), "--runs-dir", runs, "--json")
            wall = time.time() - begin
            if trained.returncode:
                report(what="solve failed", error=(trained.stderr + trained.stdout)[-1500:])
                continue
            run = json.loads(trained.stdout)["run"]
            evaluated = rlcli("eval", "--checkpoint", run, "--episodes", "1000", "--json")
            try:
                success = json.loads(evaluated.stdout)["success"]["rate"]
            except (ValueError, KeyError):
                success = (evaluated.stdout + evaluated.stderr)[-600:]
            report(what="solve", seed=seed, seconds=wall, success=success)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peer-path", help="PYTHONPATH of mjlab's processes: its packages and their dependencies")
    parser.add_argument("--only", default="env,train,ant,features,solve")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--num-envs", default=",".join(map(str, ENVS)))
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        _, num_envs, *name = json.loads(args.one)
        chosen = name[0] if name else "all on"
        measure_train(num_envs, chosen, **FEATURES[chosen])
        return
    parts, sizes = args.only.split(","), [int(n) for n in args.num_envs.split(",")]
    seeds = [int(s) for s in args.seeds.split(",")]
    versions = {"torch": torch.__version__, "warp": wp.__version__, "mujoco_warp": mjw.__version__}
    report(what="machine", gpu=torch.cuda.get_device_name(), python=platform.python_version(), **versions)
    try:
        if "env" in parts:
            for n in sizes:
                measure_env("cartpole", n)
            if args.peer_path:
                peer(args.peer_path, "env", "--num-envs", *sizes)
        if "ant" in parts:
            measure_env("ant-direct", 4096)
        if "train" in parts:
            for n in sizes:
                alone("train-one", n)
                alone("train-one", n, "update compiled and tuned")
            if args.peer_path:
                peer(args.peer_path, "train", "--num-envs", *sizes)
                peer(args.peer_path, "train", "--num-envs", *sizes, "--logs")
        if "features" in parts:
            for name in FEATURES:
                alone("train-one", sizes[0], name)
        if "scaling" in parts:
            measure_scaling(sizes[-1], torch.cuda.device_count())
        if "solve" in parts:
            measure_solve(seeds)
            if args.peer_path:
                for seed in seeds:
                    peer(args.peer_path, "solve", "--seed", seed, "--num-envs", 4096, "--budget-s", 120)
    finally:
        if args.output:
            args.output.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
