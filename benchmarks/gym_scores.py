"""Scores of PPO after a million steps of Gymnasium's tasks, beside rl-zoo3's: `python benchmarks/gym_scores.py -j 4`.

It trains the agent `ppo-1m` of each task with each seed, `-j` at a time, evaluates 100 episodes of each final policy
without exploration noise, and prints a table of both scores. `--output FILE` writes it as JSON, `--page FILE` into a
page. It needs the plugin `plugins/rlcli-gymnasium`. Finished runs in `--runs-dir` are not trained again.

rl-zoo3 publishes scores of v3 tasks. A second evaluation of the same policy applies the rules of v3 that differ from
v5: v3 gives `healthy_reward` also in the step that fails, so a failing episode has a higher return; mujoco-py, which
simulated v3, leaves the ant's contact forces at 0, so their cost is 0; v3's walker has one foot with friction 0.9, and
is trained with it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from machine import describe

AGENT, STEPS = "ppo-1m", 1_000_000


class Score(NamedTuple):
    """Scores of PPO in rl-zoo3's benchmark.md: one run of 1 M steps, v3."""

    mean: float
    std: float
    episodes: int


THEIRS = {
    "gym-half-cheetah": Score(5819.099, 663.530, 150),
    "gym-walker2d": Score(3478.798, 821.708, 171),
    "gym-hopper": Score(2410.435, 10.026, 150),
    "gym-ant": Score(1327.158, 451.577, 175),
    "gym-swimmer": Score(281.561, 9.671, 150),
}
ASSETS = "package:gymnasium/envs/mujoco/assets"
V3_OVERRIDES = {
    "gym-walker2d": [f"scene.entities.robot.model={ASSETS}/walker2d.xml"],
    "gym-ant": ["params.contact_cost_weight=0"],
}
V5_OVERRIDES = {"gym-walker2d": [f"scene.entities.robot.model={ASSETS}/walker2d_v5.xml"]}
TRAINED_AS_V3 = ("gym-walker2d",)
"""Tasks whose v3 must be trained separately; the others are trained as v5."""
V3_FAILURE_PAYS = {"gym-walker2d": 1.0, "gym-hopper": 1.0, "gym-ant": 1.0}
"""`healthy_reward` of the tasks that can fail."""


def rlcli(*arguments: str, threads: int) -> str:
    """Return the output of a command on stdout."""
    command = [sys.executable, "-m", "rlcli", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: exit {done.returncode}\n{done.stderr}")
    return done.stdout


def finished(folder: Path, task: str, name: str) -> Path | None:
    """Return the finished run of that name."""
    for run in sorted(folder.glob(f"{task}/*-{name}"), reverse=True):
        if json.loads((run / "run.json").read_text()).get("state") == "finished":
            return run
    return None


def run_name(seed: int, label: str, overrides: list[str]) -> str:
    """Return the name of a training; trainings with other overrides have other names."""
    name = f"seed{seed}{label}"
    return f"{name}-{zlib.crc32(' '.join(sorted(overrides)).encode()):08x}" if overrides else name


def train(task: str, seed: int, options: argparse.Namespace) -> Path:
    """Return the run of a seed; train it if it does not exist."""
    name = run_name(seed, options.label, options.overrides)
    run = finished(options.runs_dir, task, name)
    if run is None:
        begin = time.perf_counter()
        where = ["--runs-dir", str(options.runs_dir), "--name", name, "--device", "cpu", "--quiet"]
        how = ["--agent", AGENT, "--seed", str(seed)]
        if options.steps is not None:
            how += ["--max-steps", str(options.steps)]
        what = V3_OVERRIDES[task] if task in TRAINED_AS_V3 else []
        rlcli("train", task, *how, *where, f"sim.engine_threads={options.threads}", *what, *options.overrides,
              threads=options.threads)  # fmt: skip
        run = finished(options.runs_dir, task, name)
        assert run is not None
        print(f"{task}, seed {seed}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
    return run


def evaluate(task: str, run: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Return the returns of the final policy, by the rules of v5 and of v3."""
    common = ["--checkpoint", str(run), "--episodes", str(options.episodes), "--num-envs", str(options.episodes)]
    common += ["--json", "--quiet", f"sim.engine_threads={options.threads}"]
    v5 = json.loads(rlcli("eval", *common, *V5_OVERRIDES.get(task, []), threads=options.threads))
    v3 = v5
    if task in V3_OVERRIDES:
        v3 = json.loads(rlcli("eval", *common, *V3_OVERRIDES[task], threads=options.threads))
    more = V3_FAILURE_PAYS.get(task, 0.0) * v3["terminations"]["task"]["rate"]
    return {
        "v5": {key: v5["return"][key] for key in ("mean", "std", "low", "high")},
        "v3": {key: v3["return"][key] + (0.0 if key == "std" else more) for key in ("mean", "std", "low", "high")},
        "failed": v5["terminations"]["task"]["rate"],
        "length": v5["length"]["mean"],
    }


def one(task: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Train and evaluate a task; return its row."""
    run = train(task, seed, options)
    return {"task": task, "seed": seed, **evaluate(task, run, options)}


def tabulate(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each task: median, lowest and highest of the seeds, and rl-zoo3's score."""
    table = []
    for task, theirs in THEIRS.items():
        seeds = [row for row in rows if row["task"] == task]
        if not seeds:
            continue
        entry: dict[str, Any] = {"task": task, "seeds": [row["seed"] for row in seeds], "rl_zoo3": theirs._asdict()}
        for count in ("v3", "v5"):
            means = [row[count]["mean"] for row in seeds]
            entry[count] = {"median": statistics.median(means), "low": min(means), "high": max(means)}
        table.append({**entry, "reached": entry["v3"]["median"] >= theirs.mean})
    return table


def markdown(table: list[dict[str, Any]], rows: list[dict[str, Any]]) -> str:
    """Return both tables in Markdown."""
    lines = [
        "| task | rlcli, as v3: median (lowest .. highest seed) | rl-zoo3 | rlcli, as v5 |",
        "| --- | ---: | ---: | ---: |",
    ]
    for entry in table:
        v3, v5, theirs = entry["v3"], entry["v5"], entry["rl_zoo3"]
        ours = f"{v3['median']:.0f} ({v3['low']:.0f} .. {v3['high']:.0f})"
        lines.append(f"| `{entry['task']}` | {ours} | {theirs['mean']:.0f} | {v5['median']:.0f} |")
    lines += ["", "| task | seed | as v3: mean, 95 % interval | as v5: mean, 95 % interval | failed | steps |"]
    lines += ["| --- | ---: | ---: | ---: | ---: | ---: |"]
    for row in rows:
        counts = (f"{row[c]['mean']:.0f}, {row[c]['low']:.0f} to {row[c]['high']:.0f}" for c in ("v3", "v5"))
        numbers = f"{row['failed']:.0%} | {row['length']:.0f}"
        lines.append(f"| `{row['task']}` | {row['seed']} | {' | '.join(counts)} | {numbers} |")
    return "\n".join(lines)


def put(page: Path, text: str) -> None:
    """Replace the text between the marks of a page."""
    before, begin, rest = page.read_text().partition("<!-- scores -->\n")
    _, end, after = rest.partition("<!-- end scores -->")
    if not (begin and end):
        raise SystemExit(f"{page}: no <!-- scores --> and <!-- end scores -->")
    page.write_text(f"{before}{begin}{text}\n{end}{after}")


def main() -> None:
    """Train, evaluate, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(THEIRS), default=list(THEIRS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("-j", "--jobs", type=int, default=1, help="Trainings at a time.")
    parser.add_argument("--threads", type=int, default=1, help="Physics threads of each.")
    parser.add_argument("--steps", type=int, help="Of each training; else the agent's own, just under 1 M.")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--runs-dir", type=Path, default=Path("runs/gym_scores"))
    parser.add_argument("--label", default="", help="Added to the names of the runs: for trials with overrides.")
    parser.add_argument("--output", type=Path, help="JSON file to write.")
    parser.add_argument(
        "--page", type=Path, help="Markdown file to write the tables into, as docs/reference/zoo/peers.md."
    )
    parser.add_argument("overrides", nargs="*", help="agent.gamma=0.98 and the like, for every training.")
    options = parser.parse_intermixed_args()
    todo = [(task, seed) for seed in options.seeds for task in options.tasks]
    with ThreadPoolExecutor(options.jobs) as pool:
        rows = list(pool.map(lambda job: one(*job, options), todo))
    rows.sort(key=lambda row: (list(THEIRS).index(row["task"]), row["seed"]))
    table = tabulate(rows)
    text = markdown(table, rows)
    print(text)
    if options.page:
        put(options.page, text)
    if options.output:
        document = {
            "machine": describe(),
            "agent": AGENT,
            "steps": options.steps or STEPS,
            "episodes": options.episodes,
            "overrides": options.overrides,
        }
        options.output.write_text(json.dumps({**document, "tasks": table, "runs": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
