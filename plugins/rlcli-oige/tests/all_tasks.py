"""Run every task that OmniIsaacGymEnvs registers, as it stands, and report how far each gets.

    python plugins/rlcli-oige/tests/all_tasks.py CHECKOUT [TASK ...] [--processes N] [--out FILE.jsonl]
                                                 [--page docs/guides/omniisaacgymenvs.md]

CHECKOUT is a copy of OmniIsaacGymEnvs' repository; no file of it is changed. Robots without a built-in model get the
stand-ins of `stand_ins.py`. Each task runs in processes of its own: `rlcli validate`, 200 steps of 16 environments with
random actions, and `rlcli train` for 3 iterations with the task's own rl_games YAML. The report is one line of JSON for
each task, on stdout and in FILE; tasks that have a line in FILE are not run again. `--page` writes the table of the
page.
"""

import argparse
import ast
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import stand_ins

sys.path.insert(0, str(Path(__file__).parents[3] / "tests"))
from support.task_lists import add_result, faulty_messages, read_results, results_of

NUM_ENVS, STEPS, ITERATIONS = 16, 200, 3
START, END = "<!-- table of all tasks: plugins/rlcli-oige/tests/all_tasks.py -->", "<!-- end of the table -->"
LIMIT_S = 600
_FEW = ["agent.num_steps=8", "agent.minibatch_size=null"]
SHORT = {
    "CartpoleCamera": _FEW,
    "TargetFollowing": ["oige.env.cameraWidth=64", "oige.env.cameraHeight=64", *_FEW],
}
"""Overrides of tasks whose own rollouts take too long on a CPU: 256 or 512 images of each environment."""


def registered(checkout: Path) -> list[str]:
    """Return the tasks of `task_map` in the checkout's `task_util.py`, which is parsed and not imported."""
    tree = ast.parse((checkout / "omniisaacgymenvs" / "utils" / "task_util.py").read_text(encoding="utf-8"))
    tables = [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "task_map"
    ]
    return [key.value for table in tables if isinstance(table, ast.Dict) for key in table.keys]


def run(words: list[str], folder: Path) -> tuple[bool, str]:
    """Run a Python process, and return whether it succeeded, and what it printed."""
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    try:
        done = subprocess.run([sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True,
                              timeout=LIMIT_S, check=False)  # fmt: skip
    except subprocess.TimeoutExpired:
        return False, f"error: no result after {LIMIT_S} s"
    return done.returncode == 0, done.stdout + done.stderr


def reason(output: str) -> str:
    """Return the error of a process."""
    lines = [line for line in output.splitlines() if re.match(r"error: |\w*(?:\.\w+)*Error: ", line)]
    return lines[-1].removeprefix("error: ") if lines else output.strip().splitlines()[-1]


def step(name: str, config: str, models: list[str]) -> None:
    """Step a task; this is the body of one process."""
    import logging

    import torch

    from rlcli.config.load import resolve
    from rlcli.config.model_option import MODELS, read_models
    from rlcli.envs.make import make_env
    from rlcli.registry import task_source

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    words = [f'{MODELS}."{key}"="{file}"' for key, file in read_models(models).items()]
    words += [word for word in SHORT.get(name, []) if not word.startswith("agent.")]
    resolved = resolve(task_source(config), overrides=words, flags={"scene.num_envs": NUM_ENVS})
    env = make_env(resolved, seed=0)
    env.reset(seed=0)
    generator = torch.Generator().manual_seed(0)
    for _ in range(STEPS):
        action = torch.rand(NUM_ENVS, env.layout.action_size, generator=generator) * 2.0 - 1.0
        result = env.step(action)
        assert result.reward.isfinite().all()
    print(f"stepped {name}: {STEPS} x {NUM_ENVS}, {sum(env.causes.values())} diverged")


def examine(name: str, checkout: Path, folder: Path, models: dict[str, Path]) -> dict[str, object]:
    """Return the row of one task: what works, the first reason why something does not, and what is not simulated."""
    config = str(checkout / "omniisaacgymenvs" / "cfg" / "task" / f"{name}.yaml")
    options = [word for key, file in models.items() for word in ("--model", f"{key}={file}")]
    stages = {
        "validates": ["-m", "rlcli", "validate", config, *options],
        "builds": ["-m", "rlcli", "validate", config, "--deep", *options],
        "steps": [__file__, "--step", name, config, *(f"{key}={file}" for key, file in models.items())],
        "trains": ["-m", "rlcli", "train", config, *options, "--num-envs", str(NUM_ENVS), "--max-iterations",
                   str(ITERATIONS), "--runs-dir", str(folder), "--logger", "none", "--device", "cpu",
                   *SHORT.get(name, [])],
    }  # fmt: skip
    row: dict[str, object] = {"task": name, "reason": "", "lost": []}
    for stage, words in stages.items():
        row[stage], output = run(words, folder)
        if not row[stage] and not row["reason"]:
            row["reason"] = reason(output)
        lost = [
            line.removeprefix("not simulated: ") for line in output.splitlines() if line.startswith("not simulated")
        ]
        parts = {part for line in lost for part in re.findall(r"(?:^|; )([^;[]+) \[", line)}
        row["lost"] = row["lost"] or sorted(parts)
        if stage in ("builds", "steps") and not row[stage]:
            row["steps"] = row["trains"] = False
            break
    return row


def table(rows: list[dict[str, object]], checkout: Path, old: str = "") -> str:
    """Return the rows as a Markdown table. Paths are relative to the checkout; other tasks keep their row of `old`."""
    yes = {True: "yes", False: "no"}
    head = [
        "| Task | validates | builds | steps | trains | not simulated, or the reason |",
        "|---|---|---|---|---|---|",
    ]
    lines = {line.split("|")[1].strip(): line for line in old.strip().splitlines()[len(head) :]}
    for row in rows:
        text = str(row["reason"]).replace(f"{checkout}/omniisaacgymenvs/", "") or ", ".join(
            f"`{part}`" for part in row["lost"]
        )  # type: ignore[attr-defined]
        cells = [str(row["task"]), *(yes[bool(row[key])] for key in ("validates", "builds", "steps", "trains")), text]
        lines[str(row["task"])] = f"| {' | '.join(cells)} |"
    return "\n".join([*head, *lines.values()])


def main(words: list[str]) -> None:
    """Run the script."""
    if words[0] == "--step":
        step(words[1], words[2], words[3:])
        return
    parser = argparse.ArgumentParser()
    parser.add_argument("checkout", type=Path)
    parser.add_argument("tasks", nargs="*")
    parser.add_argument("--page", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args(words)
    checkout = options.checkout.resolve()
    rows = read_results(options.out)
    known = {row["task"] for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        models = stand_ins.write(Path(folder))
        names = [name for name in options.tasks or registered(checkout) if name not in known]
        calls = [(name, checkout, Path(folder), models) for name in names]
        for row in results_of(examine, calls, options.processes):
            rows.append(row)
            print(json.dumps(row), flush=True)
            add_result(options.out, row)
    for message in faulty_messages({row["task"]: row["reason"] for row in rows}):
        print(f"faulty message: {message}")
    page = options.page
    if page is not None:
        before, _, rest = page.read_text(encoding="utf-8").partition(START)
        old, _, after = rest.partition(END)
        page.write_text(f"{before}{START}\n{table(rows, checkout, old)}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
