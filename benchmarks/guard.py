"""Cost of the divergence guard in an environment step, including its history: `python benchmarks/guard.py`.

Each part of the guard is timed inside the step, with the settings of trainers. The share is the median of blocks.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from machine import describe

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.replay.crash_dump import CrashDumper


class Stopwatch:
    """Timer that sums the seconds of methods."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def time(self, owner: Any, method: str, name: str) -> None:
        """Start to time a method of an object."""
        call: Callable = getattr(owner, method)
        self.seconds[name] = 0.0

        def timed(*args: Any, **kwargs: Any) -> Any:
            begin = time.perf_counter()
            result = call(*args, **kwargs)
            self.seconds[name] += time.perf_counter() - begin
            return result

        setattr(owner, method, timed)


def measure(task: str, num_envs: int, blocks: int, steps: int) -> dict[str, Any]:
    """Return one row of the table."""
    env = make_env(resolve(find_task(task), flags={"scene.num_envs": num_envs}), seed=0)
    env.final_obs_of = "truncated"
    CrashDumper(env, Path(tempfile.gettempdir()))
    env.reset(seed=0)
    watch = Stopwatch()
    history: Any = env.engine.history  # type: ignore[attr-defined]
    watch.time(history, "record", "history")
    watch.time(env.engine, "diverged", "warnings and states")
    watch.time(env._guard, "quarantine_out_of_bounds", "resets and events")
    watch.time(env.sim, "save_good_state", "last good state")
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(16, num_envs, env.layout.action_size, generator=generator) * 2.0 - 1.0
    shares, parts, durations = [], [], []
    with torch.inference_mode():
        for block in range(blocks + 1):
            watch.seconds.update(dict.fromkeys(watch.seconds, 0.0))
            begin = time.perf_counter()
            for step in range(steps):
                env.step(actions[step % 16])
            duration = time.perf_counter() - begin
            if block:  # the first warms up
                kept_twice = watch.seconds["last good state"] / 2  # one of two lies within `resets and events`
                shares.append((sum(watch.seconds.values()) - kept_twice) / duration)
                durations.append(duration / steps)
                parts.append({name: seconds / steps for name, seconds in watch.seconds.items()})
    return {
        "task": task,
        "num_envs": num_envs,
        "share": statistics.median(shares),
        "share_min": min(shares),
        "share_max": max(shares),
        "step_us": 1e6 * statistics.median(durations),
        "calls_kept": history.calls,
        "parts_us": {name: 1e6 * statistics.median(part[name] for part in parts) for name in watch.seconds},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["cartpole", "cartpole-direct"])
    parser.add_argument("--num-envs", nargs="+", type=int, default=[64, 4096])
    parser.add_argument("--blocks", type=int, default=9)
    parser.add_argument("--steps", type=int, default=50, help="length of a block")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measure(t, n, options.blocks, options.steps) for t in options.tasks for n in options.num_envs]
    if options.json:
        print(json.dumps({"machine": describe(), "rows": rows}, indent=2))
        return
    print(describe())
    for row in rows:
        parts = ", ".join(f"{name} {us:.0f} us" for name, us in row["parts_us"].items())
        spread = f"{row['share_min']:.2%} .. {row['share_max']:.2%}"
        print(f"{row['task']} x {row['num_envs']}: {row['share']:.2%} ({spread}) of {row['step_us']:.0f} us: {parts}")


if __name__ == "__main__":
    main()
