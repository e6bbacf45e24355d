"""Training, evaluation and documentation of the built-in tasks. Their bars are in docs/reference/zoo/zoo.yaml.

    python benchmarks/zoo.py learn TASK            train the default agent, evaluate, compare with the goal
    python benchmarks/zoo.py collect TASK RUN ...  write results and curves of finished runs from any machine; --ship
                                                   also puts the best policy into the package, and draws its picture
    python benchmarks/zoo.py collect --all FOLDER  do this for every task with runs below a folder, and write the pages;
                                                   uses documents of `rlcli eval --json` in that folder
    python benchmarks/zoo.py adopt TASK OTHER      ship the policy of the task's other form, evaluated in this form
    python benchmarks/zoo.py picture TASK          draw a strip of pictures of the shipped policy
    python benchmarks/zoo.py pages                 fill the generated parts of docs/reference/zoo/*.md, and its index

`learn` exits with 9 if the required result or the time limit is missed, and appends a line to RUNS/learn.jsonl.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import machine
import yaml
import zoo_curves
import zoo_pages

from rlcli.registry import find_task

ZOO = Path(__file__).resolve().parents[1] / "docs" / "reference" / "zoo"
_LARGEST_PICTURE = 80_000
_FRAMES = 5
_NOT_THE_TRAINING = ("--runs-dir", "--name", "--logger", "--video-every")
"""Options with a value that only change where a training is written or how it is reported."""


@dataclass(frozen=True)
class Entry:
    """Entry of a task in zoo.yaml."""

    name: str
    tier: str
    device: str
    minutes: float
    bar: dict[str, Any]
    agent: str | None = None
    episodes: int = 1000
    envs: int = 200
    picture: float = 4.0
    seeds: tuple[int, ...] = field(default=())

    def missed(self, evaluation: dict[str, Any]) -> list[str]:
        """Return the values of an evaluation that miss the required result, as text."""
        misses = []
        for name, bound in self.bar.items():
            value = value_of(evaluation, name)
            highest = bound["max"] if isinstance(bound, dict) else math.inf
            lowest = -math.inf if isinstance(bound, dict) else bound
            if value is None:
                misses.append(f"{name} is unknown")
            elif not lowest <= value <= highest:
                misses.append(f"{name} is {value:.4g}, {'above' if value > highest else 'below'} {bar_text(bound)}")
        return misses


def entries() -> dict[str, Entry]:
    """Return every task of zoo.yaml by name."""
    document = yaml.safe_load((ZOO / "zoo.yaml").read_text(encoding="utf-8"))
    seeds = tuple(document["seeds"])
    rows = document["tasks"]
    return {name: Entry(name, seeds=seeds if row["tier"] == "A" else seeds[:1], **row) for name, row in rows.items()}


def bar_text(bound: Any) -> str:
    """Return a bound as text."""
    return f"{bound['max']:g}" if isinstance(bound, dict) else f"{bound:g}"


def value_of(evaluation: dict[str, Any], name: str) -> float | None:
    """Return a number of an evaluation: success, return, length or a value of the task."""
    from rlcli.errors import UsageError
    from rlcli.evaluation.limits import Limit

    try:
        return Limit(name, 0.0).value_in(evaluation)
    except (UsageError, KeyError):
        return None


# --- learn ---


def learn(task: str, overrides: list[str], device: str | None, seed: int, runs: Path) -> int:
    """Train, evaluate and compare with the required result; return the exit status."""
    entry = entries()[task]
    device = device or entry.device
    agent = ["--agent", entry.agent] if entry.agent else []
    begin = time.monotonic()
    trained = _rlcli(
        "train",
        task,
        *overrides,
        *agent,
        "--device",
        device,
        "--seed",
        str(seed),
        "--runs-dir",
        str(runs),
        "--logger",
        "none",
    )
    minutes = (time.monotonic() - begin) / 60
    run = Path(trained["run"])
    evaluation = _evaluate(run, entry)
    missed = entry.missed(evaluation)
    if minutes > entry.minutes and device == entry.device:
        missed.append(f"it took {minutes:.1f} minutes, more than {entry.minutes:g}")
    line = {
        "task": task,
        "overrides": overrides,
        "seed": seed,
        "device": device,
        "minutes": round(minutes, 2),
        "steps": trained["step"],
        "run": run.name,
        **{name: value_of(evaluation, name) for name in entry.bar},
        "return": evaluation["return"]["mean"],
        "missed": missed,
        "machine": machine.describe() + _gpu(run),
    }
    runs.mkdir(parents=True, exist_ok=True)
    with (runs / "learn.jsonl").open("a", encoding="utf-8") as log:
        log.write(json.dumps(line) + "\n")
    print(json.dumps(line, indent=1))
    print(f"{task}: {'; '.join(missed) if missed else 'required result reached'}", file=sys.stderr)
    return 9 if missed else 0


def _rlcli(*arguments: str) -> dict[str, Any]:
    """Run rlcli with --json and return its document; its messages go to the terminal."""
    done = subprocess.run([sys.executable, "-m", "rlcli", *arguments, "--json"], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(done.returncode)
    return json.loads(done.stdout)


def _gpu(run: Path) -> str:
    name = (json.loads((run / "run.json").read_text(encoding="utf-8")).get("torch") or {}).get("gpu")
    return f", {name}" if name else ""


# --- collect ---


def collect_all(folder: Path, hardware: str | None, ship: bool) -> None:
    """Collect every run below a folder, task by task; with `ship` also draw the pictures and write the pages."""
    from rlcli.errors import RlcliError

    found: dict[str, list[Path]] = {}
    for file in sorted(folder.rglob("run.json")):
        found.setdefault(json.loads(file.read_text(encoding="utf-8"))["task"]["name"], []).append(file.parent)
    for task, runs in found.items():
        if task not in entries():
            continue
        try:
            collect(task, runs, hardware, ship, _documents(folder))
        except (RlcliError, OSError, subprocess.CalledProcessError) as error:
            print(f"{task}: not collected: {error}", file=sys.stderr)
    zoo_pages.write_all(ZOO, entries())


def collect(task: str, runs: list[Path], hardware: str | None, ship: bool, known: dict[str, Any]) -> None:
    """Write results and curves of finished runs; with `ship`, put the best policy into the package."""
    from rlcli.reporting.curves import read_history
    from rlcli.runs.run_ref import find_checkpoint

    entry, found = entries()[task], []
    for run in _of_one_agent(entry, runs):
        _, checkpoint, _ = find_checkpoint(str(run.folder), run.folder.parent)
        evaluation = _evaluated(run, checkpoint, entry, known)
        found.append((run, checkpoint, evaluation, _row(run, checkpoint, evaluation, hardware)))
    if not found:
        return
    histories = [read_history(run) for run, *_ in found]
    rows = sorted((row for *_, row in found), key=lambda row: row["seed"])
    for folder, name, text in (
        ("results", f"{task}.json", json.dumps(rows, indent=1) + "\n"),
        ("curves", f"{task}.csv", zoo_curves.table(histories)),
        ("curves", f"{task}.svg", zoo_curves.drawing(task, histories)),
    ):
        (ZOO / folder).mkdir(exist_ok=True)
        (ZOO / folder / name).write_text(text, encoding="utf-8")
    for row in rows:
        missed = "; ".join(entry.missed(row["evaluation"])) or "required result reached"
        print(f"{task}, seed {row['seed']}: {missed}; {row['minutes']:g} min")
    if ship:
        run, checkpoint, evaluation, row = max(found, key=lambda one: _goodness(entry, one[2]))
        _ship(task, run, checkpoint, evaluation)
        print(f"{task}: seed {row['seed']} is shipped")
        subprocess.run([sys.executable, __file__, "picture", task], check=True)


def _ship(task: str, run: Any, checkpoint: Path, evaluation: dict[str, Any]) -> None:
    from rlcli.runs.checkpoint_reader import open_checkpoint
    from rlcli.runs.policy_bundle import write_bundle

    write_bundle(open_checkpoint(checkpoint), find_task(task).root / "policies" / task, run, evaluation)


def _results(task: str) -> list[dict[str, Any]]:
    return list(json.loads((ZOO / "results" / f"{task}.json").read_text(encoding="utf-8")))


def adopt(task: str, other: str) -> None:
    """Ship the policy of the task's other form, evaluated in this form; both forms step alike, column by column."""
    from rlcli.config.load import resolve
    from rlcli.deploy.env_description import describe
    from rlcli.envs.make import make_env
    from rlcli.runs.atomic_io import to_json
    from rlcli.runs.checkpoint_reader import open_checkpoint
    from rlcli.runs.policy_bundle import write_bundle

    entry, source = entries()[task], find_task(task)
    given = open_checkpoint(find_task(other).root / "policies" / other)
    env = make_env(resolve(source, overrides=["scene.num_envs=1"]), seed=0)
    layout, theirs = env.layout.record(), given.manifest["layout"]
    moved = [[action["elements"] for action in each["actions"]] for each in (layout, theirs)]
    if env.layout.size() != given.policy().spec.observation_size or moved[0] != moved[1]:
        raise SystemExit(f"{task} and {other} do not observe and act alike")
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "policy"
        shutil.copytree(given.folder, copy)
        about = {"task": {**given.manifest["task"], "name": task}, "layout": layout, "deployment": describe(env)}
        (copy / "manifest.json").write_text(to_json({**given.manifest, **about}), encoding="utf-8")
        env.close()
        evaluation = _evaluate(copy, entry)
        write_bundle(open_checkpoint(copy), source.root / "policies" / task, None, evaluation)
    (row,) = [row for row in _results(other) if row["seed"] == given.manifest["seed"]]
    evaluated = {name: evaluation[name] for name in row["evaluation"] if evaluation.get(name) is not None}
    values = {"values": evaluation["values"]} if evaluation.get("values") else {}
    command = f"{row['command']} (the other form)"
    rows = [{**row, "command": command, "evaluation": {**evaluated, **values}}]
    (ZOO / "results" / f"{task}.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    for kind in ("csv", "svg"):
        shutil.copy(ZOO / "curves" / f"{other}.{kind}", ZOO / "curves" / f"{task}.{kind}")
    missed = "; ".join(entry.missed(evaluation)) or "required result reached"
    print(f"{task}, the policy of {other}: {missed}")
    subprocess.run([sys.executable, __file__, "picture", task], check=True)


def _of_one_agent(entry: Entry, folders: list[Path]) -> list[Any]:
    """Return the newest run of each seed with the agent of the required result; without such an agent, of any agent."""
    from rlcli.config.load import resolve
    from rlcli.runs.run import open_run

    wanted = entry.agent or resolve(find_task(entry.name), device=entry.device).agent_name
    opened = sorted((open_run(folder) for folder in folders), key=lambda run: run.record["started"])
    of_task = [run for run in opened if run.record["task"]["name"] == entry.name]
    chosen = [run for run in of_task if run.record["agent"] == wanted] or of_task
    for run in opened:
        if run not in chosen:
            print(f"{run.folder.name} is left out: it is of {run.record['task']['name']}, {run.record['agent']}")
    runs = {run.record["seed"]: run for run in chosen}
    return [runs[seed] for seed in sorted(runs)]


def _documents(folder: Path) -> dict[str, Any]:
    """Return the documents of `rlcli eval --json` in this folder by RUN/STEP of the checkpoint."""
    found = {}
    for file in folder.rglob("*.json"):
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
        except ValueError:
            continue
        if isinstance(record, dict) and record.get("command") == "eval" and isinstance(record.get("checkpoint"), str):
            run, _, step = Path(record["checkpoint"]).parts[-3:]
            found[f"{run}/{step}"] = record
    return found


def _evaluate(policy: Path, entry: Entry) -> dict[str, Any]:
    """Evaluate again with many environments: the few of `play:` would take longer."""
    several = ("--num-envs", str(min(entry.episodes, entry.envs)))
    return _rlcli("eval", "--checkpoint", str(policy), "--episodes", str(entry.episodes), *several)


def _evaluated(run: Any, checkpoint: Path, entry: Entry, known: dict[str, Any]) -> dict[str, Any]:
    """Return a stored evaluation of the run or of `known`; evaluate again if it has too few episodes."""
    from rlcli.runs.eval_store import read_evaluation

    records = [read_evaluation(run, checkpoint.name), known.get(f"{run.folder.name}/{checkpoint.name}")]
    for record in records:
        if record is None or "values" not in record:
            continue
        if record["episodes"] >= entry.episodes and not record["stochastic"]:
            return record
    return _evaluate(checkpoint, entry)


def _row(run: Any, checkpoint: Path, evaluation: dict[str, Any], hardware: str | None) -> dict[str, Any]:
    record = run.record
    gpu = (record.get("torch") or {}).get("gpu")
    cores = record.get("engine_threads")
    cpu = f"{cores} core{'s' * (cores != 1)} of an {(record.get('cpu') or {}).get('model')}"
    versions = {"rlcli": record["rlcli"], **record["versions"]}
    wanted = ("episodes", "seed", "num_envs", "success", "return", "length", "values", "terminations", "diverged")
    return {
        "seed": record["seed"],
        "agent": record["agent"],
        "device": str(record.get("device", "cpu")).partition(":")[0],
        "machine": hardware or gpu or cpu,
        "command": _command(record.get("command") or []),
        "steps": int(checkpoint.name),
        "minutes": round(float(record.get("trained_s") or 0.0) / 60, 2),
        **({"until": record["until"]} if record.get("until") else {}),
        "versions": {name: versions[name] for name in ("rlcli", "mujoco", "torch") if name in versions},
        "evaluation": {name: evaluation[name] for name in wanted if evaluation.get(name) is not None},
    }


def _command(words: list[str]) -> str:
    """Return the command line without output paths."""
    kept, skip = [], False
    for word in words[1:]:
        if skip or word in ("--json", "--quiet", "-q", "--headless"):
            skip = False
            continue
        if word.partition("=")[0] in _NOT_THE_TRAINING:
            skip = "=" not in word
            continue
        kept.append(word)
    return " ".join(["rlcli", *kept])


def _goodness(entry: Entry, evaluation: dict[str, Any]) -> tuple[float, ...]:
    """Return a sort key: larger is better, in the order of the required values, then by return."""
    values = []
    for name, bound in entry.bar.items():
        value = value_of(evaluation, name)
        value = -math.inf if value is None else value
        values.append(-value if isinstance(bound, dict) else value)
    return (*values, evaluation["return"]["mean"])


# --- picture ---


def picture(task: str) -> None:
    """Write a strip of pictures of the first episode of the shipped policy."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    import numpy as np

    from rlcli.evaluation.session import PolicyRequest, open_session
    from rlcli.viewer.offscreen import Renderer

    entry = entries()[task]
    size = ["viewer.width=320", "viewer.height=240"]
    session = open_session(PolicyRequest(task, size, checkpoint="shipped", num_envs=1))
    env, shown = session.env, []
    last = min(env.max_episode_length - 1, round(entry.picture / env.step_dt))
    wanted = {round(last * number / (_FRAMES - 1)) for number in range(_FRAMES)}
    with Renderer(env.engine.model, env.config.viewer) as renderer:
        obs = env.reset(seed=env.seed)["policy"]
        for step in range(last + 1):
            if step in wanted:
                shown.append(renderer.image(env))
            result = env.step(session.act(obs))
            if bool((result.terminated | result.truncated).any()):
                break
            obs = result.obs["policy"]
    (ZOO / "pictures").mkdir(exist_ok=True)
    file = ZOO / "pictures" / f"{task}.jpg"
    file.write_bytes(_jpeg(np.concatenate(shown, axis=1)))
    print(file)


def _jpeg(pixels: Any) -> bytes:
    """Return a JPEG with the best quality that fits the size limit."""
    import io

    from PIL import Image

    for quality in range(90, 20, -5):
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, "JPEG", quality=quality, optimize=True)
        if data.tell() < _LARGEST_PICTURE:
            return data.getvalue()
    sys.exit("the pictures do not fit")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    learning = commands.add_parser("learn")
    learning.add_argument("task", choices=entries())
    learning.add_argument("overrides", nargs="*", metavar="key.path=value")
    learning.add_argument("--device", default=None)
    learning.add_argument("--seed", type=int, default=1)
    learning.add_argument("--runs-dir", type=Path, default=Path("runs"))
    collecting = commands.add_parser("collect")
    collecting.add_argument("--all", type=Path, default=None, metavar="FOLDER")
    collecting.add_argument("task", nargs="?", choices=entries())
    collecting.add_argument("runs", nargs="*", type=Path)
    collecting.add_argument("--machine", default=None, help="machine of the training, for the table")
    collecting.add_argument("--ship", action="store_true")
    adopting = commands.add_parser("adopt")
    adopting.add_argument("task", choices=entries())
    adopting.add_argument("other", choices=entries())
    commands.add_parser("picture").add_argument("task", choices=entries())
    commands.add_parser("pages")
    given = parser.parse_args()
    if given.command == "learn":
        return learn(given.task, given.overrides, given.device or None, given.seed, given.runs_dir)
    if given.command == "collect":
        if (given.all is None) == (given.task is None):
            parser.error("collect TASK RUN ..., or collect --all FOLDER")
        if given.all is not None:
            collect_all(given.all, given.machine, given.ship)
        else:
            collect(given.task, given.runs, given.machine, given.ship, {})
    elif given.command == "adopt":
        adopt(given.task, given.other)
    elif given.command == "picture":
        picture(given.task)
    else:
        zoo_pages.write_all(ZOO, entries())
    return 0


if __name__ == "__main__":
    sys.exit(main())
