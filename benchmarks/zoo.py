"""The built-in tasks: trained, judged and shown. What each is held to stands in docs/zoo/zoo.yaml.

    python benchmarks/zoo.py learn TASK            train the default agent here, evaluate, compare with the bar
    python benchmarks/zoo.py collect TASK RUN ...  finished runs, from this or another machine, become results and
                                                   curves; --ship also puts the best policy into the package
    python benchmarks/zoo.py picture TASK          a strip of pictures of the shipped policy
    python benchmarks/zoo.py pages                 fill the generated parts of docs/zoo/*.md, and write its index

`learn` exits with 9 where the bar or the minutes are missed, and appends a line to RUNS/learn.jsonl.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import machine
import yaml
import zoo_curves
import zoo_pages

from rlcli.registry import find_task

ZOO = Path(__file__).resolve().parents[1] / "docs" / "zoo"
_LARGEST_PICTURE = 80_000
_FRAMES = 5
_NOT_THE_TRAINING = ("--runs-dir", "--name", "--logger", "--video-every")
"""Flags with a value that say where and how a training is told of."""


@dataclass(frozen=True)
class Entry:
    """What zoo.yaml says of a task."""

    name: str
    tier: str
    device: str
    minutes: float
    bar: dict[str, Any]
    agent: str | None = None
    episodes: int = 1000
    picture: float = 4.0
    seeds: tuple[int, ...] = field(default=())

    def missed(self, evaluation: dict[str, Any]) -> list[str]:
        """Where an evaluation misses the bar, in words."""
        said = []
        for name, bound in self.bar.items():
            value = value_of(evaluation, name)
            highest = bound["max"] if isinstance(bound, dict) else math.inf
            lowest = -math.inf if isinstance(bound, dict) else bound
            if value is None:
                said.append(f"{name} is not known")
            elif not lowest <= value <= highest:
                said.append(f"{name} is {value:.4g}, {'above' if value > highest else 'below'} {bar_text(bound)}")
        return said


def entries() -> dict[str, Entry]:
    """Every task of zoo.yaml, by name."""
    document = yaml.safe_load((ZOO / "zoo.yaml").read_text(encoding="utf-8"))
    seeds = tuple(document["seeds"])
    rows = document["tasks"]
    return {name: Entry(name, seeds=seeds if row["tier"] == "A" else seeds[:1], **row) for name, row in rows.items()}


def bar_text(bound: Any) -> str:
    """A bound as people write it."""
    return f"{bound['max']:g}" if isinstance(bound, dict) else f"{bound:g}"


def value_of(evaluation: dict[str, Any], name: str) -> float | None:
    """A number of an evaluation: success, return, length or a value of the task."""
    from rlcli.cli.eval import value_of as judged
    from rlcli.errors import UsageError

    try:
        return judged(evaluation, name)
    except (UsageError, KeyError):
        return None


# --- learn ---


def learn(task: str, device: str | None, seed: int, runs: Path, episodes: int | None) -> int:
    """Train, evaluate, judge; the exit status."""
    entry = entries()[task]
    device = device or entry.device
    agent = ["--agent", entry.agent] if entry.agent else []
    begin = time.monotonic()
    trained = _rlcli(
        "train", task, *agent, "--device", device, "--seed", str(seed), "--runs-dir", str(runs), "--logger", "none"
    )
    minutes = (time.monotonic() - begin) / 60
    run = Path(trained["run"])
    evaluation = _rlcli("eval", "--checkpoint", str(run), "--episodes", str(episodes or entry.episodes))
    missed = entry.missed(evaluation)
    if minutes > entry.minutes and device == entry.device:
        missed.append(f"it took {minutes:.1f} minutes, more than {entry.minutes:g}")
    line = {
        "task": task,
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
    print(f"{task}: {'; '.join(missed) if missed else 'within its bar'}", file=sys.stderr)
    return 9 if missed else 0


def _rlcli(*arguments: str) -> dict[str, Any]:
    """What a command prints with --json; its messages go on to the terminal."""
    done = subprocess.run([sys.executable, "-m", "rlcli", *arguments, "--json"], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        sys.exit(done.returncode)
    return json.loads(done.stdout)


def _gpu(run: Path) -> str:
    name = (json.loads((run / "run.json").read_text(encoding="utf-8")).get("torch") or {}).get("gpu")
    return f", {name}" if name else ""


# --- collect ---


def collect(task: str, runs: list[Path], hardware: str | None, ship: bool) -> None:
    """Results and curves of finished runs, and, if asked for, the best policy as the one that is shipped."""
    from rlcli.rl.curves import read_history
    from rlcli.rl.run import find_checkpoint, open_run

    entry, rows, histories, found = entries()[task], [], [], []
    for folder in runs:
        run = open_run(folder)
        if run.record["task"]["name"] != task:
            sys.exit(f"{folder} is a run of {run.record['task']['name']}")
        _, checkpoint, _ = find_checkpoint(str(folder), folder.parent)
        evaluation = _evaluated(run, checkpoint, entry.episodes)
        rows.append(_row(run, checkpoint, evaluation, hardware))
        histories.append(read_history(run))
        found.append((rows[-1], checkpoint))
    rows.sort(key=lambda row: row["seed"])
    for folder, name, text in (
        ("results", f"{task}.json", json.dumps(rows, indent=1) + "\n"),
        ("curves", f"{task}.csv", zoo_curves.table(histories)),
        ("curves", f"{task}.svg", zoo_curves.drawing(task, histories)),
    ):
        (ZOO / folder).mkdir(exist_ok=True)
        (ZOO / folder / name).write_text(text, encoding="utf-8")
        print(ZOO / folder / name)
    if ship:
        best = max(found, key=lambda pair: _goodness(entry, pair[0]["evaluation"]))
        target = find_task(task).root / "policies" / task
        _rlcli("export", "--format", "bundle", "--checkpoint", str(best[1]), "--output", str(target))
        print(f"{target} (seed {best[0]['seed']})")


def _evaluated(run: Any, checkpoint: Path, episodes: int) -> dict[str, Any]:
    """The evaluation that the run keeps, or a new one where it is of too few episodes."""
    from rlcli.rl.evaluations import read_evaluation

    kept = read_evaluation(run, checkpoint.name)
    if kept is not None and kept["episodes"] >= episodes and "values" in kept:
        return kept
    return _rlcli("eval", "--checkpoint", str(checkpoint), "--episodes", str(episodes))


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
        "versions": {name: versions[name] for name in ("rlcli", "mujoco", "torch") if name in versions},
        "evaluation": {name: evaluation[name] for name in wanted if evaluation.get(name) is not None},
    }


def _command(words: list[str]) -> str:
    """What was typed, without where it was written to."""
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
    """Larger is better, in the order of the bar; then the return."""
    values = []
    for name, bound in entry.bar.items():
        value = value_of(evaluation, name)
        value = -math.inf if value is None else value
        values.append(-value if isinstance(bound, dict) else value)
    return (*values, evaluation["return"]["mean"])


# --- picture ---


def picture(task: str) -> None:
    """A strip of pictures of the first episode of the shipped policy."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    import numpy as np

    from rlcli.cli.session import open_session
    from rlcli.viewer.video import Renderer

    entry = entries()[task]
    session = open_session(
        task,
        ["viewer.width=320", "viewer.height=240"],
        checkpoint="shipped",
        policy="trained",
        stochastic=False,
        num_envs=1,
        seed=42,
        config=None,
        runs_dir=None,
    )
    env, shown = session.env, []
    last = min(env.max_episode_length - 1, round(entry.picture / env.step_dt))
    wanted = {round(last * number / (_FRAMES - 1)) for number in range(_FRAMES)}
    with Renderer(env.engine.model, env.config.viewer) as renderer:
        obs = env.reset(seed=env.seed)["policy"]
        for step in range(last + 1):
            if step in wanted:
                model, data = env.world(0)
                shown.append(renderer.draw(model, data, env.origins[0].tolist()))
            result = env.step(session.act(obs))
            if bool((result.terminated | result.truncated).any()):
                break
            obs = result.obs["policy"]
    (ZOO / "pictures").mkdir(exist_ok=True)
    file = ZOO / "pictures" / f"{task}.jpg"
    file.write_bytes(_jpeg(np.concatenate(shown, axis=1)))
    print(file)


def _jpeg(pixels: Any) -> bytes:
    """As good as fits."""
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
    learning.add_argument("--device", default=None)
    learning.add_argument("--seed", type=int, default=1)
    learning.add_argument("--runs-dir", type=Path, default=Path("runs"))
    learning.add_argument("--episodes", type=int, default=None)
    collecting = commands.add_parser("collect")
    collecting.add_argument("task", choices=entries())
    collecting.add_argument("runs", nargs="+", type=Path)
    collecting.add_argument("--machine", default=None, help="what it was trained on, if the run does not say it well")
    collecting.add_argument("--ship", action="store_true")
    commands.add_parser("picture").add_argument("task", choices=entries())
    commands.add_parser("pages")
    given = parser.parse_args()
    if given.command == "learn":
        return learn(given.task, given.device or None, given.seed, given.runs_dir, given.episodes)
    if given.command == "collect":
        collect(given.task, given.runs, given.machine, given.ship)
    elif given.command == "picture":
        picture(given.task)
    else:
        zoo_pages.write_all(ZOO, entries())
    return 0


if __name__ == "__main__":
    sys.exit(main())
