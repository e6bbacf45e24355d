"""Cost of a step for different numbers of environments, threads and models, and memory of a training.

    python benchmarks/growth.py

Every setting runs in a separate process, and they run blocks in turn. The cost is that of one environment step, beside
the bare physics of the same model and number of environments.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from machine import cores
from sides import CHECKOUT, HERE, Side, alternate, opened, steps_for
from tables import main, measured_on, table

NAME = "growth"
SIZES = (16, 64, 256, 1024, 4096, 16384)
MODELS = ("cartpole", "ant-direct", "humanoid", "quadruped-flat")
ENVIRONMENT_STEPS = 10_000_000
"""Number of environments of the long training."""


def side(name: str) -> Side:
    """Return a process of rlcli."""
    return Side(f"{NAME}-{name}", [sys.executable, str(HERE / "side_rlcli.py")], environment=CHECKOUT)


def costs(settings: Mapping[str, Mapping[str, Any]], repeats: int, seconds: float) -> list[dict[str, Any]]:
    """Measure the microseconds of an environment step and of bare physics in each setting of `open_env`, and memory."""
    sides = {name: side(name) for name in settings}
    with opened(*sides.values()):
        blocks, steps = {}, {}
        for name, each in sides.items():
            opening = each("open_env", **settings[name])
            each("open_bare")
            blocks[name] = lambda n, each=each: each("step", steps=n)
            blocks[f"{name}/bare"] = lambda n, each=each: each("step_bare", steps=n)
            # until episodes no longer end in the same step, as far as that takes no more than some seconds
            a_step = blocks[name](4) / 4
            blocks[name](max(1, min(2 * opening["max_episode_length"], round(5 * seconds / a_step))))
            steps[name] = steps[f"{name}/bare"] = steps_for(blocks[name], seconds)
        found = alternate(blocks, steps, repeats)
        memory = {name: each("memory_mb")["now"] for name, each in sides.items()}
    rows = []
    for name, setting in settings.items():
        scale = 1e6 / setting["num_envs"]
        ratios = [bare / whole for bare, whole in zip(found[f"{name}/bare"], found[name], strict=True)]
        rows.append(
            {
                **setting,
                "us": scale * statistics.median(found[name]),
                "bare_us": scale * statistics.median(found[f"{name}/bare"]),
                "ratio": statistics.median(ratios),
                "memory_mb": memory[name],
            }
        )
    return rows


def powers(most: int) -> Sequence[int]:
    """Return 1, 2, 4, ... and the largest number."""
    return sorted({*(2**k for k in range(most.bit_length()) if 2**k <= most), most})


def training_memory(agent: str, num_envs: int, environment_steps: int) -> dict[str, Any]:
    """Measure the memory of a training after a tenth of its steps and at its end, and the peak."""
    with opened(side(f"train-{agent}")) as (each,):
        samples = each("open_trainer", agent=agent, num_envs=num_envs)["samples"]
        iterations = max(2, environment_steps // samples)
        first = max(1, iterations // 10)
        each("train", steps=first, timeout=1200)
        early = each("memory_mb")["now"]
        each("train", steps=iterations - first, timeout=1200)
        late = each("memory_mb")
    return {"agent": agent, "num_envs": num_envs, "steps": iterations * samples, "early_mb": early,
            "late_mb": late["now"], "most_mb": late["most"]}  # fmt: skip


def measure(quick: bool) -> dict[str, Any]:
    """Measure everything."""
    repeats, seconds = (1, 0.02) if quick else (7, 0.4)
    sizes, models = ((16, 64), MODELS[:2]) if quick else (SIZES, MODELS)
    of_sizes = {str(n): {"task": "cartpole", "num_envs": n} for n in sizes}
    many = sizes[-1] if quick else 4096
    of_threads = {f"{t}-threads": {"task": "cartpole", "num_envs": many, "threads": t} for t in powers(cores())}
    of_models = {task: {"task": task, "num_envs": 16 if quick else 1024} for task in models}
    steps = 50_000 if quick else ENVIRONMENT_STEPS
    return {
        "num_envs": costs(of_sizes, repeats, seconds),
        "threads": costs(of_threads, repeats, seconds),
        "models": costs(of_models, repeats, seconds),
        "training": [training_memory(agent, 256 if quick else 4096, steps) for agent in ("ppo", "sb3-ppo")],
    }


def markdown(result: dict[str, Any]) -> str:
    """Return the tables in Markdown."""

    def cells(row: dict[str, Any]) -> list[str]:
        costs = [f"{row[key]:.3g}" for key in ("us", "bare_us")]
        return [*costs, f"{row['ratio']:.2f}", f"{row['memory_mb']:.0f} MB"]

    heads = ["rlcli [us per environment step]", "bare `Batch` [us per environment step]", "bare / rlcli", "memory"]
    large = [row["us"] for row in result["num_envs"] if row["num_envs"] >= 1024]
    spread = max(large) / min(large) - 1 if large else 0.0
    parts = [
        measured_on(result),
        table(["cartpoles", *heads], [[f"{row['num_envs']:,}", *cells(row)] for row in result["num_envs"]]),
        f"From 1,024 environments on, rlcli's times differ by at most **{spread:.0%}**." if large else "",
        table(["threads", *heads], [[str(row["threads"]), *cells(row)] for row in result["threads"]]),
        table(
            ["task", "environments", *heads],
            [[f"`{row['task']}`", f"{row['num_envs']:,}", *cells(row)] for row in result["models"]],
        ),
        table(
            ["training", "environments", "steps", "memory after a tenth", "after all", "at its most"],
            [
                [f"`{row['agent']}`", f"{row['num_envs']:,}", f"{row['steps']:,}"]
                + [f"{row[key]:.0f} MB" for key in ("early_mb", "late_mb", "most_mb")]
                for row in result["training"]
            ],
        ),
    ]
    return "\n\n".join(parts)


if __name__ == "__main__":
    main(sys.modules[__name__])
