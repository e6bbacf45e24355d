"""Run every task that Isaac Lab registers, unchanged, and report how far it gets: imports, validates, steps, trains.

Usage: python corpus.py [ID ...] [--stage NAME] [--processes N] [--out FILE.jsonl], with the environment variable
ISAACLAB_SOURCE at the folder `source` of Isaac Lab 2.3.2, or of its unpacked wheel. Each robot gets a stand-in model
(`standins.py`). With `--package PATH` it runs the tasks that another package or file registers. When a task ends, FILE
gets one line of JSON; tasks that have a line are not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from standins import write

sys.path.insert(0, str(Path(__file__).parents[3] / "tests"))
from support.task_lists import LONGEST, add_result, faulty_messages, read_results, results_of

SOURCE = "ISAACLAB_SOURCE"
STAGES = ("imports", "validates", "steps", "trains")
ENVS, STEPS, ITERATIONS = 16, 200, 3
LIMIT_S = 3600
"""Time for one task [s]; the slowest reset an inverse kinematics of their own for each episode."""
SHORT = {"GearAssembly": ("agent.num_steps=2",)}
"""Part of an ID -> overrides of an agent whose own rollouts take too long on a CPU.

The rollouts of GearAssembly have 512 steps. With stand-ins each episode ends after a step, so that every step computes
an inverse kinematics of ten iterations in Python.
"""
OUTSIDE = ("pick_place",)
"""Packages that Isaac Lab does not import by default."""


def tasks(package: Path) -> dict[str, dict[str, Any]]:
    """Return ID -> arguments of every task that a package registers."""
    from rlcli.registry.failed_imports import take_failures
    from rlcli.registry.task_imports import import_file, registrations

    import_file(package / "__init__.py" if package.is_dir() else package)
    for file in sorted(package.rglob("__init__.py")):
        if any(word in str(file) for word in OUTSIDE):
            try:
                import_file(file)
            except Exception as error:
                print(f"{file}: {type(error).__name__}: {error}")
    print(*take_failures(), sep="\n", flush=True)
    return dict(sorted(registrations.items()))


def is_direct(entry: Any) -> bool:
    """Return whether a registered environment is not the manager-based one."""
    return "ManagerBasedRLEnv" not in str(entry)


def run(
    name: str, kwargs: dict[str, Any], package: Path, folder: Path, last: str, steps: int
) -> tuple[int, str, dict[str, Any]]:
    """Return the number of stages that a task passes, the reason why it stops, and facts about it."""
    from rlcli.errors import RlcliError

    stage, facts = 0, {}
    try:
        import torch

        from rlcli.config.load import resolve
        from rlcli.envs.make import make_env
        from rlcli.registry import python_task
        from rlcli.registry.task_imports import load_object

        torch.set_num_threads(1)
        entry = kwargs["env_cfg_entry_point"]
        value = load_object(entry) if isinstance(entry, str) else entry
        value = value() if callable(value) else value
        stage = 1
        if last == "imports":
            return stage, "", facts
        write(settings_of(value, kwargs), folder)
        os.environ["RLCLI_MODELS"] = str(folder)
        source = python_task(f"{package}:{name}")
        resolved = resolve(source)
        facts["agents"] = [n for n in (resolved.layers.get(("agents",)) or {}) if n != "default"]
        facts["lost"] = [str(note) for note in resolved.notes if note.status in ("ignored", "approximated")]
        stage = 2
        if last == "validates":
            return stage, "", facts
        env = make_env(resolved.with_num_envs(ENVS), seed=1)
        env.reset()
        generator = torch.Generator().manual_seed(0)
        for _ in range(steps):
            result = env.step(torch.rand(ENVS, env.layout.action_size, generator=generator) * 2 - 1)
            assert bool(result.reward.isfinite().all())
        facts["diverged"] = env.causes
        env.close()
        stage = 3
        if last == "steps" or not facts["agents"]:
            return stage, "no agent" if last != "steps" else "", facts
        is_symmetric = getattr(resolved.agent, "symmetry", None) is None
        short = [word for part, words in SHORT.items() if part in name for word in words]
        train(f"{package}:{name}", folder, [*short, *([] if is_symmetric else ["agent.symmetry=null"])])
        stage = 4
    except BaseException as error:
        text = " ".join(str(error).split())
        problems = getattr(error, "problems", None)
        if problems:
            text = " || ".join(map(str, problems[:6]))
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if f.filename.startswith(str(package))] or frames
        is_bug = own and not isinstance(error, RlcliError)
        at = f" [{own[-1].filename.rpartition('/')[2]}:{own[-1].lineno}]" if is_bug else ""
        return stage, f"{type(error).__name__}: {text[:LONGEST]}{at}", facts
    return stage, "", facts


def settings_of(value: Any, kwargs: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of an environment as nested dicts, with the assets that a direct task creates."""
    from rlcli_isaaclab.config_class import to_dict
    from rlcli_isaaclab.direct_env import DirectRLEnvCfg, _environment_class, record

    if not isinstance(value, DirectRLEnvCfg):
        return to_dict(value)
    from rlcli_isaaclab.direct_convert import _names

    value.__rlcli_environment__(kwargs["entry_point"])
    setup, env = record(_environment_class(value), value)
    made = zip(_names(setup, env), setup.created, strict=True)
    scene = {name: to_dict(cfg) for name, (_, cfg) in made}
    scene |= {f"spawned_{i}": {"prim_path": path, "spawn": to_dict(c)} for i, (path, c, _) in enumerate(setup.spawned)}
    return {"scene": scene, "rest": to_dict(value)}


def train(reference: str, folder: Path, overrides: Sequence[str]) -> None:
    """Train a few iterations with the command line. Stand-ins have no symmetry that an agent could use."""
    from rlcli.cli.app import main

    words = ["train", reference, "--num-envs", str(ENVS), "--max-iterations", str(ITERATIONS), "--name", "t"]
    (folder / "here").mkdir()
    os.chdir(folder / "here")
    sys.argv = ["rlcli", *words, *overrides, "--quiet", "--device", "cpu"]
    log = folder / "train.log"
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    try:
        code = main()
    except SystemExit as end:
        code = end.code
    if code:
        raise RuntimeError(f"rlcli train ended with {code}: {log.read_text()[-500:]}")


_FORK = threading.Lock()


def isolated(limit_s: float, function: Any, *arguments: Any) -> Any:
    """Call a function in a child process and return its result; a failure tuple if the child dies or takes too long."""
    with _FORK:  # a child of another thread must not inherit the writer: the reader would not see its end
        reader, writer = os.pipe()
        child = os.fork()
        if child:
            os.close(writer)
    if child == 0:
        os.close(reader)
        if not os.environ.get("CORPUS_VERBOSE"):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            os.dup2(null, 2)
        result = function(*arguments)
        with os.fdopen(writer, "w") as pipe:
            json.dump(result, pipe)
        os._exit(0)
    start = time.time()
    import select

    with os.fdopen(reader) as pipe:
        ready, _, _ = select.select([pipe], [], [], limit_s)
        text = pipe.read() if ready else ""
    if not ready:
        os.kill(child, 9)
    _, status = os.waitpid(child, 0)
    return json.loads(text) if text else (0, f"died with status {status} after {time.time() - start:.0f} s", {})


def write_page(rows: dict[str, Any], page: Path) -> None:
    """Write both tables of the documentation from the results. Rows of tasks that were not run stay."""
    text = page.read_text(encoding="utf-8")
    start, end = "<!-- table -->\n", "<!-- end of table -->"
    head = [
        "| task | imports | validates | steps | trains | what is lost, or why it stops |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    table = text.partition(start)[2].partition(end)[0].splitlines()[len(head) :]
    lines = {line.split("`")[1]: line for line in table}
    for name, row in rows.items():
        marks = ["yes" if row["stage"] > i else "no" for i in range(len(STAGES))]
        if row["stage"] == row["last"] < len(STAGES):
            marks[row["last"] :] = ["not run"] * (len(STAGES) - row["last"])
        if not row["agent"]:
            marks[-1] = "no agent"
        stops = row["stage"] < (row["last"] if row["agent"] else min(row["last"], STAGES.index("trains")))
        short = re.sub(r"[^\s'\"]*/(?=\w)", "", row["reason"]).replace("|", ";")[:300]  # names of files only
        reason = short if stops else lost(row.get("lost", ()))
        lines[name] = f"| `{name}` | {' | '.join(marks)} | {reason} |"
    before, after = text.partition(start)[0], text.partition(end)[2]
    ordered = [*head, *(lines[name] for name in sorted(lines))]
    begin, finish = "<!-- summary -->\n", "<!-- end of summary -->"
    opening, _, rest = before.partition(begin)
    before = opening + begin + "\n".join(summary(lines.values())) + "\n" + finish + rest.partition(finish)[2]
    page.write_text(before + start + "\n".join(ordered) + "\n" + end + after, encoding="utf-8")


def summary(lines: Iterable[str]) -> list[str]:
    """Return a table with the numbers of tasks that pass each stage, from the lines of the table of tasks."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    table = ["| kind | tasks | with an agent | imports | validates | steps | trains |", "| --- |" + " ---: |" * 6]
    for kind in ("manager-based", "direct"):
        marks = [row[1 : 1 + len(STAGES)] for row in rows if ("-Direct" in row[0]) == (kind == "direct")]
        passed = [sum(mark[i] == "yes" for mark in marks) for i in range(len(STAGES))]
        agents = sum(mark[-1] != "no agent" for mark in marks)
        table.append(f"| {kind} | {len(marks)} | {agents} | {' | '.join(map(str, passed))} |")
    return table


USUAL = (
    *("physx", "actuators.damping", "rigid_props", "articulation_props", "collision_props"),
    *("experiment_name", "run_name", "num_envs"),
)
"""Parts of keys that most tasks lose; the page names them once."""


def lost(notes: Sequence[str]) -> str:
    """Return the keys of a task that are ignored or approximated, without those that most tasks lose."""
    keys = []
    for note in notes:
        key, _, rest = re.sub(r"^/\S*?: ", "", note).partition(": ")
        status = rest.partition(":")[0]
        if not any(word in key for word in USUAL) and not key.startswith(
            ("agent", "params", "models", "policy_kwargs")
        ):
            keys.append(f"{'~' if status == 'approximated' else ''}{key}")
    return ", ".join(f"`{key}`" for key in sorted(set(keys)))


def main_() -> None:
    """Print one line per task, and the counts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("ids", nargs="*", help="tasks to run; none: all")
    parser.add_argument("--only", default="", help="pattern that the IDs match")
    parser.add_argument("--kind", choices=("manager", "direct", "all"), default="all")
    parser.add_argument("--stage", choices=STAGES, default="trains")
    parser.add_argument("--out", type=Path, help="file of JSON lines, one for each task; those in it are not run again")
    parser.add_argument("--processes", type=int, default=1, help="number of tasks that run at a time")
    parser.add_argument("--steps", type=int, default=STEPS, help="steps of the stage `steps`")
    parser.add_argument("--page", type=Path, help="page whose table is written from the results")
    parser.add_argument("--merge", type=Path, nargs="*", help="write the page from files of --out, and run nothing")
    parser.add_argument("--package", type=Path, help="another package or file that registers tasks")
    options = parser.parse_args()
    if options.merge:
        rows = rows_of(options.merge)
        write_page(rows, options.page)
        count(rows)
        return
    source = Path(os.environ[SOURCE])
    import torch  # noqa: F401  (imported once, before the forks)

    import rlcli.envs.managed  # noqa: F401

    os.environ.setdefault("RLCLI_ISAACLAB", str(source))
    package = (options.package or source / "isaaclab_tasks" / "isaaclab_tasks").resolve()
    found = tasks(package)
    kinds = {"manager": [False], "direct": [True], "all": [False, True]}[options.kind]
    rows = rows_of([options.out])
    wanted = [
        name
        for name, kwargs in found.items()
        if re.search(options.only, name)
        and name in (options.ids or found)
        and name not in rows
        and is_direct(kwargs["entry_point"]) in kinds
    ]
    if unknown := set(options.ids) - set(found):
        parser.error(f"no task has the ID {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory() as folder:
        calls = [(name, found[name], package, Path(folder) / name, options.stage, options.steps) for name in wanted]
        for name, row in results_of(row_of, calls, options.processes):
            rows[name] = row
            print(f"{row['stage']} {name}: {row['reason'][:400]}", flush=True)
            add_result(options.out, {"task": name, **row})
    if options.page:
        write_page(rows, options.page)
    count(rows)


def rows_of(files: Sequence[Path | None]) -> dict[str, Any]:
    """Return the rows of files of `--out`, by task."""
    return {row.pop("task"): row for file in files for row in read_results(file)}


def row_of(name: str, kwargs: dict[str, Any], *arguments: Any) -> tuple[str, dict[str, Any]]:
    """Run a task in a child process, and return its ID and its row of the report."""
    start = time.time()
    stage, reason, facts = isolated(LIMIT_S, run, name, kwargs, *arguments)
    with_agent = any(
        key.endswith("_cfg_entry_point") and key not in ("env_cfg_entry_point",) and "robomimic" not in key
        for key in kwargs
    )
    last = STAGES.index(arguments[2]) + 1
    direct = is_direct(kwargs["entry_point"])
    row = {"direct": direct, "stage": stage, "reason": reason, "agent": with_agent, "last": last}
    return name, {**row, "seconds": round(time.time() - start), **facts}


def count(rows: dict[str, Any]) -> None:
    """Print how many tasks pass each stage, and the messages that do not help."""
    reasons = {task: row["reason"] for task, row in rows.items() if row["reason"] != "no agent"}
    for message in faulty_messages(reasons):
        print(f"faulty message: {message}")
    for direct in (False, True):
        kind = [row for row in rows.values() if row["direct"] == direct]
        counts = {stage: sum(row["stage"] > i for row in kind) for i, stage in enumerate(STAGES)}
        print("direct" if direct else "manager-based", len(kind), "with agent", sum(r["agent"] for r in kind), counts)


if __name__ == "__main__":
    main_()
