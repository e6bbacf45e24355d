"""`rlcli sweep compare`: whether the best trial's settings learn faster than the task's own, with several seeds."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.console import console
from rlcli.cli.sweep_trials import STOPPED, Base, failure, rows_of

if TYPE_CHECKING:
    from rlcli.errors import RlcliError
    from rlcli.rl.search import Search
    from rlcli.rl.stop import StopRequest
    from rlcli.rl.time_to import Bar, Reached

_LOOK_S = 0.1
_ARMS = ("default", "best")


@dataclass(slots=True)
class _Training:
    """One of the trainings that are compared."""

    arm: str
    seed: int
    folder: Path
    reached: Reached | None = None
    error: RlcliError | None = None

    @property
    def state(self) -> str:
        """reached, not reached, or failed."""
        return "failed" if self.error else "reached" if self.reached else "not reached"


def compare(
    search: Search,
    seeds: Sequence[int],
    until: str | None,
    overrides: Sequence[str],
    budget: Mapping[str, Any],
    episodes: int,
    device: str,
    runs: Path,
    stop: StopRequest,
) -> None:
    """Train with both settings, one after the other, until an evaluation reaches the bar, and print what it took.

    What was trained is kept in the sweep's folder, so that the same command goes on after an interruption.

    Args:
        search: the sweep.
        seeds: of the trainings.
        until: the bar, `success=0.99`.
        overrides: hold for both.
        budget: dotted key -> how long a training may take; empty: as the task's agent says.
        episodes: of an evaluation.
        device: where they train.
        runs: the runs folder.
        stop: whether somebody asks to stop.

    Raises:
        CheckpointError: if no trial has finished.
        Stopped: if somebody asked.
        typer.Exit: with the exit code of the first training that failed, after the others.
    """
    import typer

    from rlcli.cli.eval import require_success
    from rlcli.errors import CheckpointError, Stopped, UsageError
    from rlcli.rl.time_to import read_bar

    best = search.best()
    if best is None:
        raise CheckpointError(f"{search.folder} has no finished trial yet", hint="rlcli sweep show")
    bar = read_bar(until or "success=0.99")
    with _base(search, overrides, budget, device, runs) as base:
        resolved, _ = base.resolve()
        if resolved.task.success is None and until is None:
            raise UsageError("this task defines no success: until what?", hint="--until return=X")
        require_success(resolved, {bar.key: bar.value})
        given = [] if resolved.agent is None or resolved.agent.eval_interval else ["agent.eval_interval=1"]
        base.overrides += [*given, f"agent.eval_episodes={episodes}"]
        changes = {"default": [], "best": search.overrides(search.values(best))}
        trainings = []
        with stop:
            for turn, seed in enumerate(seeds):
                for arm in _ARMS if turn % 2 == 0 else _ARMS[::-1]:  # a machine that slows down slows both
                    if stop.signal is not None:
                        break
                    training = _train(search, replace(base, seed=seed), arm, changes[arm], bar, stop)
                    if training.reached or training.error or stop.signal is None:  # else it was stopped half-way
                        trainings.append(training)
    asked = stop.signal is not None and len(trainings) < len(_ARMS) * len(seeds)
    document = _conclude(search, bar, seeds, trainings, best.number)
    if asked:
        raise Stopped("stopped on request", exit_code=stop.exit_code, hint="the same command again goes on")
    console.document("sweep", **document)
    wrong = next((one.error for one in trainings if one.error is not None), None)
    if wrong is not None:
        raise typer.Exit(wrong.exit_code)


@contextmanager
def _base(
    search: Search, overrides: Sequence[str], budget: Mapping[str, Any], device: str, runs: Path
) -> Iterator[Base]:
    """What the trials of a sweep had in common, but for their budget, as its folder says it."""
    from rlcli.rl.load import recorded_task

    told = search.settings
    source = recorded_task(told["source"], f"the task of {search.folder}")
    with tempfile.TemporaryDirectory() as place:
        config = None
        if told.get("config") is not None:
            config = Path(place) / "config.yaml"
            config.write_text(told["config"], encoding="utf-8")
        words = [*told["overrides"], *overrides]
        yield Base(source, told["agent"], device, config, words, 0, runs, dict(told["flags"]), dict(budget))


def _train(search: Search, base: Base, arm: str, changes: Sequence[str], bar: Bar, stop: StopRequest) -> _Training:
    """Train one of them until it reaches the bar, its budget is spent, or somebody asks to stop."""
    from rlcli.cli.children import train
    from rlcli.errors import DivergedError
    from rlcli.rl.loggers import read_metrics
    from rlcli.rl.overview import overview
    from rlcli.rl.time_to import time_to

    best = search.best()
    name = f"compare-{arm}" if arm == "default" or best is None else f"compare-trial-{best.number:04d}"
    training = _Training(arm, base.seed, _folder(search.folder, f"{name}-seed-{base.seed}", base, changes))
    device = base.prepare(training.folder, changes)
    seen = overview(training.folder)

    def reached() -> Reached | None:
        metrics = training.folder / "metrics.jsonl"
        return time_to(read_metrics(metrics), bar) if metrics.is_file() else None

    training.reached = reached()
    if training.reached is None and seen.state == "diverged":
        training.error = DivergedError(f"{training.folder}: {seen.reason}")
    elif training.reached is None and seen.state != "finished":
        console.info(f"{arm}, seed {base.seed}: {training.folder}")
        child = train(training.folder, device)
        try:
            while not child.has_ended():
                if stop.signal is not None or any(map(bar.reached_by, rows_of(training.folder))):
                    child.stop()
                time.sleep(_LOOK_S)
        finally:
            child.process.kill()
        training.reached = reached()
        if child.exit_code and stop.signal is None and not (child.asked and child.exit_code == STOPPED):
            training.error = failure(child, child.why)
            console.warn(f"{arm}, seed {base.seed}: {child.why}")
    found = training.reached
    took = f" after {found.seconds:.1f} s, {found.step:,} steps" if found is not None else ""
    console.info(f"{arm}, seed {base.seed}: {training.state}{took}")
    return training


def _folder(sweep: Path, name: str, base: Base, changes: Sequence[str]) -> Path:
    """The folder of a training; of one with this name and other settings (another budget, say) it is not."""
    from rlcli.config.dump import to_data, to_yaml
    from rlcli.rl.run import CONFIG

    text = to_yaml(to_data(base.resolve(changes)[0]))
    number = 1
    while True:
        folder = sweep / (name if number == 1 else f"{name}-{number}")
        if not (folder / CONFIG).is_file() or (folder / CONFIG).read_text(encoding="utf-8") == text:
            folder.mkdir(exist_ok=True)
            return folder
        number += 1


def _conclude(
    search: Search, bar: Bar, seeds: Sequence[int], trainings: Sequence[_Training], best: int
) -> dict[str, Any]:
    """Print the table; the same as a document."""
    from rlcli.rl.time_to import median

    by_place = {(one.seed, one.arm): one for one in trainings}
    medians: dict[str, dict[str, float | None]] = {}
    for arm in _ARMS:
        found = [by_place[seed, arm].reached for seed in seeds if (seed, arm) in by_place]
        if len(found) == len(seeds):
            seconds, steps = zip(*((r and r.seconds, r and r.step) for r in found), strict=True)
            medians[arm] = {"seconds": median(seconds), "steps": median(steps)}
    ratios: dict[str, float | None] = {}
    if len(medians) == len(_ARMS):
        for key in ("seconds", "steps"):
            default, own = (medians[arm][key] for arm in _ARMS)
            ratios[key] = None if default is None or own is None else own / default
    rows = []
    for seed in seeds:
        cells = [_cells(by_place.get((seed, arm))) for arm in _ARMS]
        rows.append([str(seed), *cells[0], *cells[1]])
    if medians:
        rows.append(["median", *(cell for arm in _ARMS for cell in _numbers(**medians.get(arm, {})))])
    if ratios:
        shown = ["-" if ratio is None else f"{ratio:.3g} x" for ratio in ratios.values()]
        rows.append(["ratio", "", "", *shown])
    console.info(f"{search.settings['task']}: training until {bar.key} >= {bar.value:g}")
    console.table(["SEED", "DEFAULT S", "STEPS", f"TRIAL {best} S", "STEPS"], rows)
    return {
        "sweep": str(search.folder),
        "task": search.settings["task"],
        "until": {bar.key: bar.value},
        "trial": best,
        "compared": [
            {
                "policy": one.arm,
                "seed": one.seed,
                "run": str(one.folder),
                "state": one.state,
                "seconds": one.reached and one.reached.seconds,
                "steps": one.reached and one.reached.step,
            }
            for one in trainings
        ],
        "medians": medians,
        "ratios": ratios,
    }


def _cells(training: _Training | None) -> list[str]:
    if training is None:
        return ["-", "-"]
    if training.reached is None:
        return [training.state, "-"]
    return _numbers(training.reached.seconds, training.reached.step)


def _numbers(seconds: float | None = None, steps: float | None = None) -> list[str]:
    return ["-" if seconds is None else f"{seconds:.2f}", "-" if steps is None else f"{steps:,.0f}"]
