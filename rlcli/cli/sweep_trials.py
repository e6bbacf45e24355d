"""What a sweep trains: the configuration of each trial, its run, and the processes that train and judge it."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.console import console

if TYPE_CHECKING:
    from rlcli.cli.children import Child
    from rlcli.config.load import Resolved
    from rlcli.errors import RlcliError
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
STOPPED = 75
_NOT_ITS_FAULT = (7, 8, 10, STOPPED, 130)
"""Exit codes of a training that another setting would not change: what is missing here, the machine, a signal."""


@dataclass(slots=True)
class Base:
    """What all trials have in common."""

    source: TaskSource
    agent: str | None
    device: str
    config: Path | None
    overrides: list[str]
    seed: int
    runs: Path
    flags: dict[str, Any] = field(default_factory=dict)
    """Dotted key -> value of what else the command line sets."""
    budget: dict[str, Any] = field(default_factory=dict)
    """How long a trial trains, likewise; no part of what is found."""

    def resolve(self, changes: Sequence[str] = ()) -> tuple[Resolved, str]:
        """The configuration with some changes, and the device it trains on."""
        from rlcli.cli.jobs import fitting_device, process_device, require_parallel
        from rlcli.config.load import resolve

        device = process_device(self.device, None)
        resolved = resolve(
            self.source,
            agent=self.agent,
            device=device,
            config_file=self.config,
            overrides=[*self.overrides, *changes],
            flags={**self.flags, **self.budget},
        )
        require_parallel(resolved)
        return resolved, fitting_device(resolved, device, self.device)

    def check(self, parameters: Sequence[Any], goal: Objective) -> Resolved:
        """Refuse what no trial could be trained with, before anything is written.

        Raises:
            ConfigError: for a key that is not there, or an end of a range that its key cannot have.
            UsageError: for an objective that no evaluation of this task tells.
        """
        from rlcli.cli.eval import require_success
        from rlcli.errors import UsageError, did_you_mean, listing

        longest = max(len(parameter.bounds) for parameter in parameters)
        for place in range(longest):
            bounds = [p.override(p.bounds[min(place, len(p.bounds) - 1)]) for p in parameters]
            resolved, _ = self.resolve(bounds)
        resolved.require_agent()
        require_success(resolved, {goal.key: 0.0})
        group, _, name = goal.key.partition(".")
        groups: dict[str, Mapping[str, Any]] = {
            "reward_terms": resolved.task.rewards,
            "terminations": resolved.task.terminations,
        }
        terms = groups.get(group, {})
        have = [key for key, term in terms.items() if term is not None]
        if have and name not in have:
            hint = did_you_mean(name, have) or f"there are: {listing(have)}"
            raise UsageError(f"--objective {goal.key}: the task has none of that name", hint=hint)
        return resolved

    def preset(self, changes: Sequence[str]) -> dict[str, Any]:
        """All that sets a training with these changes apart from the task's own, as a `--config` file holds it."""
        from rlcli.config.layers import Layers, Origin, read
        from rlcli.rl.space import nested

        resolved, _ = self.resolve(changes)

        def whole(path: Any) -> Any:
            start = ("agents", resolved.agent_name) if path[0] == "agent" else path[:1]
            return resolved.layers.get((*start, *path[1:]))

        found = Layers()

        def origin(_: Any) -> Origin:
            return Origin("config", "")

        found.merge({"agents": {"default": resolved.agent_name}}, origin)
        if self.config is not None:
            found.merge(read(self.config).data, origin)
        found.merge(nested([*self.overrides, *changes], whole), origin)
        for key, value in self.flags.items():
            found.set(tuple(key.split(".")), value, origin(()))
        return found.data

    def keep_preset(self, search: Search) -> None:
        """Write the best trial's preset into the sweep's folder."""
        search.keep_preset(lambda values: self.preset(search.overrides(values)))

    def prepare(self, folder: Path, changes: Sequence[str] = ()) -> str:
        """Make the run of a folder, which waits for its training, unless it is there; the device it trains on.

        Raises:
            UsageError: if it is there, and of other settings.
        """
        from rlcli.cli.jobs import begun
        from rlcli.config.dump import given, to_data, to_yaml
        from rlcli.errors import UsageError
        from rlcli.rl.run import RECORD, WAITING, begin_run, open_run

        resolved, device = self.resolve(changes)
        if (folder / RECORD).is_file():
            known = open_run(folder).record.get("given")
            if known is not None and _drawn(known) != _drawn(given(resolved)):
                raise UsageError(
                    f"{folder} is the run of other settings: its sweep was another", hint="another --name begins anew"
                )
            return device
        for file in ("config.yaml", "checkpoints"):  # of a process that was killed while it wrote them
            path = folder / file
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        record = begun(resolved, self.runs, {"seed": self.seed, "device": device}, ["none"], None, None)
        begin_run(folder, to_yaml(to_data(resolved)), {**record, "state": WAITING}).unlock()
        return device


def _drawn(given: Any) -> Any:
    """Of what a run was given, the overrides."""
    if not isinstance(given, dict):
        return given
    return {key: where for key, where in given.items() if str(where).startswith("override")}


def failure(child: Child, message: str, hint: str | None = None) -> RlcliError:
    """What went wrong in a process, as this command's own error."""
    from rlcli.errors import RlcliError

    error = RlcliError(message, hint=hint)
    error.exit_code = child.exit_code
    said = child.document.get("error")
    if isinstance(said, dict):
        error.kind = str(said.get("kind"))
    return error


class Worker:
    """Takes trials, trains each in a process of its own, judges it, and tells the storage."""

    def __init__(self, search: Search, base: Base, goal: Objective, jobs: int, stop: StopRequest) -> None:
        self._search, self._base, self._goal, self._jobs, self._stop = search, base, goal, jobs, stop
        self._active: list[_Step] = []
        self._failed: list[RlcliError] = []

    def run(self) -> None:
        """Until there is no trial left to take, or somebody asks to stop.

        Raises:
            RlcliError: if the first trials all fail, or something stands in the way of every trial.
        """
        try:
            while True:
                asked = self._stop.signal is not None
                while not asked and len(self._active) < self._jobs:
                    trial = self._search.claim()
                    if trial is None:
                        break
                    self._active.append(self._begin(trial))
                if not self._active:
                    break
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
        if self._failed and not asked and self._search.best() is None:
            raise self._hopeless()

    def _begin(self, trial: Trial) -> _Step:
        """Train a trial, go on training one that was left, or judge one that was trained."""
        from rlcli.cli.children import train
        from rlcli.rl.overview import overview

        changes = self._search.overrides(trial.values)
        console.info(f"trial {trial.number}: {', '.join(changes)}")
        device = self._base.prepare(trial.folder, changes)
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
        rows = rows_of(step.trial.folder)
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
            self._judged(trial, self._goal.read(child.document))
            return
        if step.pruned:
            self._search.tell(trial, state="PRUNED")
            console.info(f"trial {trial.number}: pruned")
            return
        if asked:
            return  # it is there for whoever goes on
        if not step.judges and (child.exit_code == 0 or (child.asked and child.exit_code == STOPPED)):
            self._active.append(_Step(trial, self._judge(trial), judges=True))
            return
        if child.exit_code in _NOT_ITS_FAULT:
            said = f"trial {trial.number}: {child.why}"
            raise failure(child, said, hint="the same command again goes on with this trial")
        self._fail(trial, failure(child, child.why))

    def _fail(self, trial: Trial, error: RlcliError) -> None:
        self._failed.append(error)
        self._search.tell(trial, state="FAIL", why=error.message)
        console.warn(f"trial {trial.number}: {error.message}")
        if len(self._failed) >= _HOPELESS and self._search.best() is None:
            raise self._hopeless()

    def _hopeless(self) -> RlcliError:
        error, count = self._failed[-1], len(self._failed)
        error.message = f"the first {f'{count} trials' if count > 1 else 'trial'} failed: {error.message}"
        return error

    def _judged(self, trial: Trial, value: float) -> None:
        from rlcli.errors import DivergedError
        from rlcli.rl.overview import overview
        from rlcli.rl.run import open_run

        if not math.isfinite(value):
            self._fail(trial, DivergedError(f"{self._goal.key} of its evaluation is not finite"))
            return
        seen = overview(trial.folder)
        self._search.tell(trial, value, seconds=seen.duration_s, step=seen.step)
        run = open_run(trial.folder)
        console.info(
            f"trial {trial.number}: {self._search.settings['objective']} = {value:.6g} ({run.record['state']})"
        )
        self._base.keep_preset(self._search)


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


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """The newest rows of a run's metrics, oldest first."""
    from rlcli.rl.overview import newest_rows
    from rlcli.rl.run import Run

    return newest_rows(Run(folder))


def _trained(rows: Sequence[Mapping[str, Any]], step: _Step) -> float:
    """For how long a trial has trained [s]: its rollouts and updates, added up as they come."""
    from rlcli.rl.overview import overview
    from rlcli.rl.time_to import training_s

    fresh = [row for row in rows if row["iteration"] > step.counted]
    if fresh and fresh[0]["iteration"] > step.counted + 1:  # rows were missed, or it was resumed
        step.trained_s = max(step.trained_s, overview(step.trial.folder).duration_s or 0.0)
    step.trained_s += sum(map(training_s, fresh))
    if fresh:
        step.counted = fresh[-1]["iteration"]
    return step.trained_s
