"""`rlcli sweep TASK --param KEY=RANGE`: trials of one training, shared by as many processes as run the same command."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import tasks
from rlcli.cli.console import console
from rlcli.cli.options import (
    MAX_SEED,
    Agent,
    ConfigFile,
    Debug,
    Device,
    Json,
    NumEnvs,
    Overrides,
    Quiet,
    RunsDir,
    Verbose,
    flags,
)

if TYPE_CHECKING:
    from rlcli.cli.children import Child
    from rlcli.registry import TaskSource
    from rlcli.rl.search import Search, Trial
    from rlcli.rl.space import Objective
    from rlcli.rl.stop import StopRequest

_LOOK_S = 0.1
_TELL_EVERY_S = 1.0
"""Between two looks at how a trial learns."""
_STEPS = 100
"""Of the axis on which trials are compared before they end: percent of their budget."""
_HOPELESS = 3
"""Trials that fail one after the other before the first succeeds: the sweep's own mistake."""
PICTURE = "sweep.svg"


def command(
    task: Annotated[
        str | None, typer.Argument(autocompletion=tasks, help="A task; or `show`, and a sweep's folder or name.")
    ] = None,
    overrides: Overrides = None,
    param: Annotated[
        list[str] | None,
        typer.Option("--param", help="KEY=LOW:HIGH, KEY=log:LOW:HIGH or KEY=A,B,C; repeatable."),
    ] = None,
    trials: Annotated[int, typer.Option("--trials", min=1, max=100_000, help="Trials in all, of all processes.")] = 20,
    objective: Annotated[
        str,
        typer.Option(
            "--objective",
            help="return, success, length, reward_terms.NAME or terminations.NAME of the trained policy; @30s: of the"
            " policy after 30 s of training; @1e6: after so many steps.",
        ),
    ] = "return",
    minimize: Annotated[bool, typer.Option("--minimize", help="Less is better.")] = False,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Episodes that judge a trial.")] = 200,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Trials at a time in this process.")] = 1,
    pruner: Annotated[
        str, typer.Option("--pruner", help="median: stop trials that learn worse than most; none.")
    ] = "median",
    storage: Annotated[
        str | None,
        typer.Option("--storage", help="URL of a database that several machines share; else a journal file."),
    ] = None,
    name: Annotated[
        str, typer.Option("--name", help="Of the sweep: the same command again goes on with it, or helps with it.")
    ] = "sweep",
    plot: Annotated[bool, typer.Option("--plot", help="With show: draw it into the sweep's folder.")] = False,
    agent: Agent = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=MAX_SEED, help="Of every trial, and of what is drawn.")
    ] = 42,
    num_envs: NumEnvs = None,
    max_iterations: Annotated[int | None, typer.Option("--max-iterations", help="Iterations of a trial.")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", help="Environment steps of a trial.")] = None,
    device: Device = "auto",
    config: ConfigFile = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Search settings that learn best. `sweep show` tells how far it is."""
    from rlcli.errors import Stopped, UsageError, did_you_mean
    from rlcli.rl.run import default_runs_dir, require_name
    from rlcli.rl.search import check_optuna, open_search
    from rlcli.rl.space import HINT, read_objective, read_parameters
    from rlcli.rl.stop import StopRequest

    runs = runs_dir or default_runs_dir()
    if task == "show":
        check_optuna()
        _show(overrides or [], runs, storage, plot)
        return
    if task is None:
        raise UsageError("which task?", hint="rlcli sweep TASK --param agent.learning_rate=log:1e-4:1e-2")
    if pruner not in ("median", "none"):
        raise UsageError(f"no --pruner '{pruner}'", hint=did_you_mean(pruner, ["median", "none"]) or "median or none")
    if not param:
        raise UsageError("nothing is to be varied", hint=f"--param {HINT}")
    require_name(name)
    goal, parameters = read_objective(objective), read_parameters(param)
    if goal.steps is not None and (max_steps is not None or max_iterations is not None):
        raise UsageError(f"--objective {objective} says how long a trial trains", hint="leave out --max-...")
    check_optuna()
    budget = {"agent.max_iterations": max_iterations, "agent.max_steps": max_steps or goal.steps}
    given = dict(flags(scene__num_envs=num_envs))
    if any(value is not None for value in budget.values()):
        given |= budget
    base = _Base(task, agent, device, config, list(overrides or []), given, seed, runs)
    source = base.check(parameters, goal)
    settings = {
        "task": source.name,
        "name": name,
        "agent": agent,
        "overrides": base.overrides,
        "flags": base.flags,
        "config": None if config is None else config.read_text(encoding="utf-8"),
        "params": list(param),
        "objective": objective,
        "direction": "minimize" if minimize else "maximize",
        "episodes": episodes,
        "seed": seed,
        "trials": trials,
        "storage": None if storage is None else storage.rpartition("@")[2],
    }
    folder = runs / source.name / f"sweep-{name}"
    search = open_search(folder, settings, parameters, storage, pruner)
    console.info(f"sweep {folder}: {len(search.ended())} of {trials} trials have ended")
    stop = StopRequest(ends_process=console.owns_process)
    try:
        with stop:
            _Worker(search, base, goal, jobs, stop).run()
    finally:
        search.let_go()
    if stop.signal is not None and len(search.ended()) < trials:
        raise Stopped("stopped on request", exit_code=stop.exit_code, hint="the same command again goes on")
    _report(search)


@dataclass(slots=True)
class _Base:
    """What all trials have in common."""

    task: str
    agent: str | None
    device: str
    config: Path | None
    overrides: list[str]
    flags: dict[str, Any]
    seed: int
    runs: Path

    def resolve(self, changes: Sequence[str]) -> Any:
        """The configuration of a trial."""
        from rlcli.cli.jobs import fitting_device, process_device, require_parallel
        from rlcli.config.load import resolve
        from rlcli.rl.trust import named_task

        device = process_device(self.device, None)
        resolved = resolve(
            named_task(self.task),
            agent=self.agent,
            device=device,
            config_file=self.config,
            overrides=[*self.overrides, *changes],
            flags=self.flags,
        )
        require_parallel(resolved)
        return resolved, fitting_device(resolved, device, self.device)

    def check(self, parameters: Sequence[Any], goal: Objective) -> TaskSource:
        """Refuse what no trial could be trained with, before anything is written.

        Raises:
            ConfigError: for a key that is not there, or an end of a range that its key cannot have.
            UsageError: if success is the objective of a task without one.
        """
        from rlcli.cli.eval import require_success

        longest = max(len(parameter.bounds) for parameter in parameters)
        for place in range(longest):
            bounds = [p.override(p.bounds[min(place, len(p.bounds) - 1)]) for p in parameters]
            resolved, _ = self.resolve(bounds)
        require_success(resolved, {goal.key: 0.0})
        return resolved.source


class _Worker:
    """Takes trials, trains each in a process of its own, judges it, and tells the storage."""

    def __init__(self, search: Search, base: _Base, goal: Objective, jobs: int, stop: StopRequest) -> None:
        self._search, self._base, self._goal, self._jobs, self._stop = search, base, goal, jobs, stop
        self._active: list[_Step] = []
        self._failed = 0

    def run(self) -> None:
        """Until there is no trial left to take, or somebody asks to stop."""
        try:
            while True:
                asked = self._stop.signal is not None
                while not asked and len(self._active) < self._jobs:
                    trial = self._search.claim()
                    if trial is None:
                        break
                    self._active.append(self._begin(trial))
                if not self._active:
                    return
                for step in list(self._active):
                    if asked:
                        step.child.stop()
                    if step.child.has_ended():
                        self._active.remove(step)
                        self._ended(step, asked)
                    elif not asked:
                        self._watch(step)
                time.sleep(_LOOK_S)
        finally:
            for step in self._active:
                step.child.process.kill()

    def _begin(self, trial: Trial) -> _Step:
        """Train a trial, go on training one that was left, or judge one that was trained."""
        from rlcli.cli.children import train
        from rlcli.cli.jobs import begun
        from rlcli.config.dump import to_data, to_yaml
        from rlcli.rl.overview import overview
        from rlcli.rl.run import RECORD, WAITING, begin_run

        changes = self._search.overrides(trial.values)
        console.info(f"trial {trial.number}: {', '.join(changes)}")
        resolved, device = self._base.resolve(changes)
        if not (trial.folder / RECORD).is_file():
            for file in ("config.yaml", "checkpoints"):  # of a process that was killed while it wrote them
                shutil.rmtree(trial.folder / file, ignore_errors=True)
            record = begun(resolved, self._base.runs, {"seed": self._base.seed, "device": device}, ["none"], None, None)
            begin_run(trial.folder, to_yaml(to_data(resolved)), {**record, "state": WAITING}).unlock()
        seen = overview(trial.folder)
        if seen.state == "finished" or self._is_over(seen.duration_s or 0.0):
            return _Step(trial, self._judge(trial), judges=True)
        return _Step(trial, train(trial.folder, device))

    def _judge(self, trial: Trial) -> Child:
        from rlcli.cli.children import start

        episodes, seed = self._search.settings["episodes"], self._search.settings["seed"]
        words = ["eval", "--checkpoint", str(trial.folder), "--episodes", str(episodes), "--seed", str(seed)]
        return start(trial.folder, words)

    def _is_over(self, trained_s: float) -> bool:
        return self._goal.seconds is not None and trained_s >= self._goal.seconds

    def _watch(self, step: _Step) -> None:
        """Stop a trial whose time is over, or that learns worse than most."""
        from rlcli.rl.overview import overview

        if step.judges or step.child.asked:
            return
        now = time.monotonic()
        if self._goal.seconds is None and now < step.next_look:
            return
        step.next_look = now + _TELL_EVERY_S
        rows = _rows(step.trial.folder)
        if not rows:
            return
        seen = overview(step.trial.folder)
        share = 0.0
        if self._goal.seconds is not None:
            trained = _trained(rows, step)
            share = trained / self._goal.seconds
            if share >= 1.0:
                step.child.stop()
                return
        elif seen.iterations:
            share = (seen.iteration or 0) / seen.iterations
        at = int(_STEPS * share)
        if self._goal.told is None or self._goal.told not in seen.last or at <= step.told:
            return
        step.told = at
        step.trial.trial.report(seen.last[self._goal.told], at)
        if step.trial.trial.should_prune():
            step.pruned = True
            step.child.stop()

    def _ended(self, step: _Step, asked: bool) -> None:
        trial, child = step.trial, step.child
        if step.judges and child.exit_code == 0:
            value = self._goal.read(child.document)
            self._tell(trial, value)
            return
        if step.pruned:
            self._search.tell(trial, state="PRUNED")
            console.info(f"trial {trial.number}: pruned")
            return
        if asked:
            return  # it is there for whoever goes on
        if not step.judges and (child.exit_code == 0 or child.asked):
            self._active.append(_Step(trial, self._judge(trial), judges=True))
            return
        self._failed += 1
        self._search.tell(trial, state="FAIL", why=child.why)
        console.warn(f"trial {trial.number}: {child.why}")
        if self._failed >= _HOPELESS and self._search.best() is None:
            from rlcli.errors import RlcliError

            error = RlcliError(f"the first {self._failed} trials failed: {child.why}")
            error.exit_code = child.exit_code
            raise error

    def _tell(self, trial: Trial, value: float) -> None:
        from rlcli.rl.overview import overview
        from rlcli.rl.run import open_run
        from rlcli.rl.search import PRESET, preset
        from rlcli.rl.study import write_summary

        seen = overview(trial.folder)
        self._search.tell(trial, value, seconds=seen.duration_s, step=seen.step)
        run = open_run(trial.folder)
        console.info(
            f"trial {trial.number}: {self._search.settings['objective']} = {value:.6g} ({run.record['state']})"
        )
        text = preset(self._search, self._base.overrides)
        if text is not None:
            write_summary(self._search.folder, PRESET, text)


@dataclass(slots=True)
class _Step:
    """What is being done for a trial."""

    trial: Trial
    child: Child
    judges: bool = False
    pruned: bool = False
    told: int = 0
    next_look: float = 0.0
    trained_s: float = 0.0
    counted: int = 0
    """Iterations that `trained_s` holds."""


def _rows(folder: Path) -> list[dict[str, Any]]:
    from rlcli.rl.overview import newest_rows
    from rlcli.rl.run import Run

    return newest_rows(Run(folder))


def _trained(rows: Sequence[Mapping[str, Any]], step: _Step) -> float:
    """For how long a trial has trained [s]: its rollouts and updates, added up as they come."""
    from rlcli.rl.overview import overview

    fresh = [row for row in rows if row["iteration"] > step.counted]
    if fresh and fresh[0]["iteration"] > step.counted + 1:  # rows were missed, or it was resumed
        step.trained_s = max(step.trained_s, overview(step.trial.folder).duration_s or 0.0)
    for row in fresh:
        step.trained_s += row.get("Perf/collection_time", 0.0) + row.get("Perf/learning_time", 0.0)
    if fresh:
        step.counted = fresh[-1]["iteration"]
    return step.trained_s


def _report(search: Search) -> None:
    """The trials and the best one, as a table and as a document."""
    from rlcli.rl.search import PRESET

    settings, best = search.settings, search.best()
    rows, listed = [], []
    for trial in search.trials():
        values = search.values(trial)
        folder = search.place(trial.number)
        listed.append(
            {
                "trial": trial.number,
                "state": trial.state.name.lower(),
                "value": trial.value if trial.state.name == "COMPLETE" else None,
                "params": values,
                "run": str(folder) if folder.is_dir() else None,
                "seconds": trial.user_attrs.get("seconds"),
                "step": trial.user_attrs.get("step"),
            }
        )
        shown = "-" if listed[-1]["value"] is None else f"{trial.value:.6g}"
        mark = "best" if best is not None and trial.number == best.number else ""
        rows.append(
            [
                str(trial.number),
                listed[-1]["state"],
                shown,
                *(_cell(values.get(p.key)) for p in search.parameters),
                mark,
            ]
        )
    console.table(["TRIAL", "STATE", settings["objective"].upper(), *(p.key for p in search.parameters), ""], rows)
    file = search.folder / PRESET
    if best is not None:
        run = search.place(best.number)
        console.info(f"best: trial {best.number}; its run {run}; rlcli train {settings['task']} --config {file}")
    console.document(
        "sweep",
        sweep=str(search.folder),
        task=settings["task"],
        objective=settings["objective"],
        direction=settings["direction"],
        ended=len(search.ended()),
        wanted=settings["trials"],
        best=None if best is None else listed[best.number],
        preset=str(file) if file.is_file() else None,
        trials=listed,
    )


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _show(words: Sequence[str], runs: Path, storage: str | None, plot: bool) -> None:
    from rlcli.errors import CheckpointError, UsageError
    from rlcli.rl.run import STUDY
    from rlcli.rl.search import read_search

    if len(words) > 1:
        raise UsageError("sweep show takes one sweep", hint="its folder or its name")
    known = sorted(file.parent for file in runs.glob(f"*/sweep-*/{STUDY}"))
    if words:
        places = [Path(words[0]), *(folder for folder in known if folder.name in (words[0], f"sweep-{words[0]}"))]
    else:
        places = sorted(known, key=lambda folder: (folder / STUDY).stat().st_mtime)[-1:]
    folder = next((place for place in places if (place / STUDY).is_file()), None)
    if folder is None:
        from rlcli.errors import listing

        have = f"sweeps: {listing(map(str, known))}" if known else "rlcli sweep TASK --param ... makes one"
        raise CheckpointError(f"no sweep{f' {words[0]!r}' if words else ''} in {runs}", hint=have)
    search = read_search(folder, storage)
    if plot:
        from rlcli.rl.figures import check_drawing, scatter
        from rlcli.rl.study import write_summary

        check_drawing()
        done = [trial for trial in search.trials() if trial.state.name == "COMPLETE"]
        if not done:
            raise UsageError("there is nothing to draw: no trial has ended yet")
        drawn = [("trial", [trial.number for trial in done], False)]
        drawn += [(p.key, [search.values(trial)[p.key] for trial in done], p.log) for p in search.parameters]
        picture = scatter(drawn, [trial.value for trial in done], search.settings["objective"], title=folder.name)
        console.data(str(write_summary(folder, PICTURE, picture)))
    _report(search)
