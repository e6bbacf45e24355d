"""Sabotaged trainings: which of them does a health check name within a quarter of the budget?

`python benchmarks/sabotage.py --seed 7 --jobs 2` runs the twelve sabotages, each with the trainers `ppo` and `sb3`, on
tasks drawn by lot. It prints a Markdown table: sabotage, task, trainer, the checks that name it with the share of the
budget, and the success rate at a quarter of the budget.

`python benchmarks/sabotage.py --seed 7 --healthy 20` runs healthy trainings instead: those of the pages, and trainings
of built-in tasks with agents, lengths and seeds drawn by lot. It prints the findings of each.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

QUARTER = 0.25
TASKS = ("cartpole", "cartpole-direct")
AGENTS = {"ppo": "ppo", "sb3": "sb3-ppo"}
RATES = {"ppo": 1e-3, "sb3": 2e-3}
"""Learning rates of the agents."""
TERMS = ("alive", "terminating", "pole_pos", "cart_vel", "pole_vel")
WEIGHTS = (1.0, -2.0, -1.0, -0.01, -0.005)
SPEED = "joints: [slider_to_cart]"

Patch = Callable[[], None]
Words = list[str]
"""Arguments of `rlcli train`."""

REPOSITORY = Path(__file__).parents[1]
PAGES = {
    "README.md": ["./my_task"],
    "docs/tutorials/first-task.md": ["./my_task"],
    "docs/tutorials/direct-task.md": ["./my_arm"],
    "docs/tutorials/first-plugin.md": ["./my-arm/my_arm"],
    "docs/guides/gymnasium-and-sb3.md": ["./pole"],
    "docs/guides/isaac-lab.md": ["./swing/swing_env_cfg.py:SwingEnvCfg", "--max-iterations", "50"],
    "docs/tutorials/quickstart.md": ["cartpole"],
}
"""Page -> the training that it shows."""
BUILT_IN = (
    *[("cartpole", agent) for agent in ("sb3-ppo", "ppo", "sac", "td3", "rsl-rl")],
    *[("cartpole-direct", agent) for agent in ("sb3-ppo", "ppo", "sac", "rl-games")],
    *[("cart-double-pendulum", "ppo-1024"), ("ball-balance", "ppo-cpu"), ("quadcopter", "ppo-512")],
    *[("crazyflie", "ppo-512"), ("ingenuity", "ppo-1024"), ("reach", "ppo-512"), ("reach-ik", "ppo-512")],
    *[("ant", "sb3-ppo"), ("ant-direct", "sb3-ppo"), ("quadruped-flat", "ppo"), ("humanoid", "ppo")],
)
"""Built-in tasks and their agents."""


def overrides(name: str, task: str, trainer: str) -> list[str]:
    """Return the overrides of a sabotage; what no setting expresses is in `patch`."""
    rate = RATES[trainer]
    entropy = "entropy_coef" if trainer == "ppo" else "ent_coef"
    managed = task == "cartpole"
    std = "agent.init_std=10.0" if trainer == "ppo" else "agent.policy.init_std=10.0"
    pos = "observations.policy.joint_pos_rel.clip=[-0.01,0.01]"
    clip = [pos, "observations.policy.joint_vel_rel.clip=[-0.01,0.01]"] if managed else ["clip_observations=0.01"]
    return {
        "zero rewards": [f"rewards.{term}.weight=0.0" for term in TERMS] if managed else [],
        "sign turned": [f"rewards.{t}.weight={-w}" for t, w in zip(TERMS, WEIGHTS, strict=True)] if managed else [],
        "learning rate x 100": [f"agent.learning_rate={100 * rate}"],
        "learning rate x 1e-4": [f"agent.learning_rate={1e-4 * rate}"],
        "entropy 1": [f"agent.{entropy}=1.0"],
        "clipped observations": clip,
        "action scale 1e-3": ["actions.joint_effort.scale=0.1"] if managed else ["params.max_effort=0.4"],
        "termination in step one": [
            f"terminations.first={{func: joint_vel_out_of_manual_limit, {SPEED}, max_velocity: 1e-6}}"
        ]
        if managed
        else [],
        "constant observation": ["observations.policy.joint_pos_rel.scale=0.0"] if managed else [],
        "unreachable success": ["success.pole.at_most=0.0"],
        "noise x 10": [std],
        "frozen normaliser": ["agent.normalize_observations=true"],
    }[name]


def patch(name: str, task: str) -> None:
    """Change the code of this process for sabotages that no setting expresses."""
    import torch

    from rlcli.rl import policy
    from rlcli_tasks.cartpole.task import CartpoleTask

    if name == "frozen normaliser":
        stale = torch.full((), 100.0, dtype=torch.float64)  # statistics of another task: far from these observations

        def freeze(self: Any, *_: Any) -> None:
            self.mean.fill_(stale)
            self.var.fill_(1e-4)

        policy.Normalizer.merge = freeze  # type: ignore[method-assign]
    if task != "cartpole-direct":
        return
    metrics, observe, done = CartpoleTask.calculate_metrics, CartpoleTask.get_observations, CartpoleTask.is_done
    factor = {"zero rewards": 0.0, "sign turned": -1.0}.get(name)
    if factor is not None:

        def calculate_metrics(self: CartpoleTask) -> None:
            metrics(self)
            self.rew_buf.mul_(factor)

        CartpoleTask.calculate_metrics = calculate_metrics  # type: ignore[method-assign]
    if name == "termination in step one":

        def is_done(self: CartpoleTask) -> None:
            done(self)
            self.reset_buf.fill_(1)

        CartpoleTask.is_done = is_done  # type: ignore[method-assign]
    if name == "constant observation":

        def get_observations(self: CartpoleTask) -> Any:
            result = observe(self)
            self.obs_buf[:, 2] = 0.0
            return result

        CartpoleTask.get_observations = get_observations  # type: ignore[method-assign]


NAMES = (
    *("zero rewards", "sign turned", "learning rate x 100", "learning rate x 1e-4", "entropy 1"),
    *("clipped observations", "action scale 1e-3", "termination in step one", "constant observation"),
    *("unreachable success", "noise x 10", "frozen normaliser"),
)


def train(name: str, task: str, trainer: str, seed: int, until: float) -> dict[str, Any]:
    """Train until a share of the budget is done; return findings and metrics."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, __file__, "--child", name, task, trainer, str(seed), folder]
        with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
            run: Path | None = None
            total, rows = 1, 0
            while process.poll() is None and rows < until * total:
                time.sleep(0.5)
                run = next(Path(folder).glob("*/*/run.json"), None)
                if run is not None and (run.parent / "metrics.jsonl").exists():
                    total = json.loads(run.read_text()).get("iterations", 10**9)
                    rows = len((run.parent / "metrics.jsonl").read_text().splitlines())
            if process.poll() is None:
                process.terminate()
            error = process.communicate()[1]
        if run is None:
            return {"error": error[-500:], "named": {}, "success": None}
        record = json.loads(run.read_text())
        last = json.loads((run.parent / "metrics.jsonl").read_text().splitlines()[-1])
        every = max(1, total // 40)
        named = {each["check"]: (each["iteration"] + every) / total for each in record.get("health", [])}
        texts = [each["message"] for each in record.get("health", [])]
        return {"named": named, "success": last.get("Train/success_rate"), "texts": texts, "done": rows / total}


def child(name: str, task: str, trainer: str, seed: str, folder: str) -> None:
    """Train in this process."""
    from rlcli.cli.app import main

    changes = [] if name == "none" else overrides(name, task, trainer)
    if name != "none":
        patch(name, task)
    options = ["--agent", AGENTS[trainer], "--seed", seed, "--device", "cpu", "--runs-dir", folder, "--logger", "none"]
    sys.argv = ["rlcli", "train", task, *changes, "scene.num_envs=512", *options]
    main()


def table(seed: int, jobs: int, until: float) -> None:
    """Draw the tasks, run all trainings, and print the table."""
    draw = random.Random(seed)
    cases = [(name, draw.choice(TASKS), trainer) for name in NAMES for trainer in AGENTS]
    healthy = [("none", task, trainer) for task in TASKS for trainer in AGENTS]
    print(
        f"| sabotage (seed {seed}) | task | trainer | named, at share of the budget | success |\n|---|---|---|---|---|"
    )
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(train, *case, seed, 1.0 if case[0] == "none" else until) for case in cases + healthy]
        for (name, task, trainer), future in zip(cases + healthy, futures, strict=True):
            result = future.result()
            named = ", ".join(f"{check} {share:.2f}" for check, share in result["named"].items()) or "-"
            success = "-" if result["success"] is None else f"{result['success']:.1%}"
            print(f"| {name} | {task} | {trainer} | {result.get('error') or named} | {success} |", flush=True)


def draw_healthy(draw: random.Random, count: int) -> list[tuple[str, Words]]:
    """Return the trainings of the pages, then trainings of built-in tasks: the page or task, and the arguments."""
    cases = [(page, [*words, "--seed", str(draw.randrange(10**6))]) for page, words in PAGES.items()]
    for task, agent in draw.sample(BUILT_IN, count - len(cases)):
        words = [task, "--agent", agent, "--seed", str(draw.randrange(10**6))]
        if agent == "rsl-rl" or task in ("quadruped-flat", "humanoid"):
            words += ["--num-envs", "256"]
        steps = round(10 ** draw.uniform(5.0, 6.2), -3)
        short = task not in TASKS or agent in ("sac", "td3") or draw.random() < 0.5
        cases.append((task, words + (["--max-steps", f"{steps:.0f}"] if short else [])))
    return cases


def train_healthy(page: str, words: Words) -> tuple[str, str]:
    """Train in a folder with the files of a page; return the findings and the success rate at the end."""
    with tempfile.TemporaryDirectory() as folder:
        text = (REPOSITORY / page).read_text() if page.endswith(".md") else ""
        for name, content in re.findall(r"^```\w+ file=(\S+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
            (Path(folder) / name).parent.mkdir(parents=True, exist_ok=True)
            (Path(folder) / name).write_text(content)
        command = [sys.executable, "-m", "rlcli", "train", *words, "--device", "cpu", "--logger", "none", "-q"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        run = next(Path(folder).glob("runs/*/*/run.json"), None)
        if done.returncode or run is None:
            return f"error: {done.stderr[-300:]}", "-"
        last = json.loads((run.parent / "metrics.jsonl").read_text().splitlines()[-1])
        findings = json.loads(run.read_text()).get("health", [])
        success = last.get("Train/success_rate")
        named = "; ".join(f"{each['check']} at {each['iteration']}: {each['message']}" for each in findings)
        return named or "-", "-" if success is None else f"{success:.1%}"


def healthy_table(seed: int, jobs: int, count: int) -> None:
    """Run healthy trainings and print what the checks report."""
    cases = draw_healthy(random.Random(seed), count)
    print(f"| healthy training (seed {seed}) | arguments | findings | success |\n|---|---|---|---|", flush=True)
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(train_healthy, *case) for case in cases]
        for (page, words), future in zip(cases, futures, strict=True):
            print(f"| {page} | `{' '.join(words)}` | {' | '.join(future.result())} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(*sys.argv[2:])
    else:
        parser = argparse.ArgumentParser(description=__doc__)
        parser.add_argument("--seed", type=int, default=7, help="seed of the lot and of the trainings")
        parser.add_argument("--jobs", type=int, default=2, help="trainings at a time")
        parser.add_argument("--until", type=float, default=QUARTER, help="share of the budget")
        parser.add_argument("--healthy", type=int, default=0, metavar="N", help="run N healthy trainings instead")
        arguments = parser.parse_args()
        if arguments.healthy:
            healthy_table(arguments.seed, arguments.jobs, arguments.healthy)
        else:
            table(arguments.seed, arguments.jobs, arguments.until)
