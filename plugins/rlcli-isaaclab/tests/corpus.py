"""Run every task that Isaac Lab registers, unchanged, and report how far it gets: imports, validates, steps, trains.

Usage: python corpus.py [--only WORD] [--stage NAME] [--out FILE.json], with the environment variable ISAACLAB_SOURCE at
the folder `source` of Isaac Lab 2.3.2, or of its unpacked wheel. Each robot gets a stand-in model (`standins.py`).
With `--package FOLDER` it runs the tasks that another package registers.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from standins import write

SOURCE = "ISAACLAB_SOURCE"
STAGES = ("imports", "validates", "steps", "trains")
ENVS, STEPS, ITERATIONS = 16, 200, 3
LIMIT_S = 3600
"""Time for one task [s]; the slowest reset an inverse kinematics of their own for each episode."""
OUTSIDE = ("pick_place",)
"""Packages that Isaac Lab does not import by default."""


def tasks(package: Path) -> dict[str, dict[str, Any]]:
    """Return ID -> arguments of every task that a package registers."""
    from rlcli.registry.failed_imports import take_failures
    from rlcli.registry.task_imports import import_file, registrations

    import_file(package / "__init__.py")
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
        value = (load_object(entry) if isinstance(entry, str) else entry)()
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
        train(f"{package}:{name}", folder, [] if is_symmetric else ["agent.symmetry=null"])
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
        return stage, f"{type(error).__name__}: {text[:600]}{at}", facts
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


def isolated(limit_s: float, function: Any, *arguments: Any) -> Any:
    """Call a function in a child process and return its result; a failure tuple if the child dies or takes too long."""
    reader, writer = os.pipe()
    child = os.fork()
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
    os.close(writer)
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
    """Write the table of the documentation from the results. Rows of tasks that were not run stay."""
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
        reason = re.sub(r"/\S*/", "", row["reason"]).replace("|", ";")[:300] if stops else lost(row.get("lost", ()))
        lines[name] = f"| `{name}` | {' | '.join(marks)} | {reason} |"
    before, after = text.partition(start)[0], text.partition(end)[2]
    ordered = [*head, *(lines[name] for name in sorted(lines))]
    page.write_text(before + start + "\n".join(ordered) + "\n" + end + after, encoding="utf-8")


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
    parser.add_argument("--only", default="")
    parser.add_argument("--kind", choices=("manager", "direct", "all"), default="all")
    parser.add_argument("--stage", choices=STAGES, default="trains")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--steps", type=int, default=STEPS, help="steps of the stage `steps`")
    parser.add_argument("--page", type=Path, help="page whose table is written from the results")
    parser.add_argument("--merge", type=Path, nargs="*", help="write the page from files of --out, and run nothing")
    parser.add_argument("--part", default="0/1", help="i/n: every n-th task")
    parser.add_argument("--package", type=Path, help="folder of another package that registers tasks")
    options = parser.parse_args()
    rows: dict[str, Any]
    if options.merge:
        rows = {name: row for file in options.merge for name, row in json.loads(file.read_text()).items()}
        write_page(rows, options.page)
        count(rows)
        return
    source = Path(os.environ[SOURCE])
    import torch  # noqa: F401  (imported once, before the forks)

    import rlcli.envs.managed  # noqa: F401

    os.environ.setdefault("RLCLI_ISAACLAB", str(source))
    package = (options.package or source / "isaaclab_tasks" / "isaaclab_tasks").resolve()
    found = tasks(package)
    part, parts = map(int, options.part.split("/"))
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        wanted = [n for n in found if re.search(options.only, n)]
        for number, name in enumerate(wanted):
            direct = is_direct(found[name]["entry_point"])
            if number % parts != part or options.kind == ("manager" if direct else "direct"):
                continue
            stage, reason, facts = isolated(
                LIMIT_S, run, name, found[name], package, Path(folder) / name, options.stage, options.steps
            )
            with_agent = any(
                key.endswith("_cfg_entry_point") and key not in ("env_cfg_entry_point",) and "robomimic" not in key
                for key in found[name]
            )
            rows[name] = {
                "direct": direct,
                "stage": stage,
                "reason": reason,
                "agent": with_agent,
                "last": STAGES.index(options.stage) + 1,
                **facts,
            }
            print(f"{stage} {name}: {reason[:400]}", flush=True)
            if options.out:
                options.out.write_text(json.dumps(rows, indent=1))
    if options.page:
        write_page(rows, options.page)
    count(rows)


def count(rows: dict[str, Any]) -> None:
    """Print how many tasks pass each stage."""
    for direct in (False, True):
        kind = [row for row in rows.values() if row["direct"] == direct]
        counts = {stage: sum(row["stage"] > i for row in kind) for i, stage in enumerate(STAGES)}
        print("direct" if direct else "manager-based", len(kind), "with agent", sum(r["agent"] for r in kind), counts)


if __name__ == "__main__":
    main_()
