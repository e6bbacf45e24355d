"""Run the trials of a sweep: train and evaluate each trial in subprocesses, and prune trials.

To prune a trial is to stop its training early, because other trials were better after the same share of their budget.
"""

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rlcli.config.dump import preset_of
from rlcli.config.load import Resolved
from rlcli.errors import INTERRUPTED, STOPPED, DivergedError, RlcliError, UsageError, did_you_mean, listing
from rlcli.evaluation.limits import require_success
from rlcli.progress import track
from rlcli.runs.overview import newest_rows, overview
from rlcli.runs.run import Run, open_run
from rlcli.training.signals import StopRequest
from rlcli.training.start_run import TrainingRequest, prepare_run
from rlcli.training.time_to_threshold import training_s
from rlcli.training.train_commands import POLL_S, TrainingProcess, start_command, start_training
from rlcli.tuning.search_space import Objective, Parameter
from rlcli.tuning.sweep import Sweep, Trial

_log = logging.getLogger(__name__)

_REPORT_EVERY_S = 1.0
"""Time between two reports of a trial's progress to Optuna's pruner [s]."""
_PRUNER_STEPS = 100
"""Number of steps into which the budget of a trial is divided; the pruner compares trials at the same step."""
_MAX_FAILURES = 3
"""Number of failed trials after which a sweep ends with an error, if no trial has a result yet."""
_NOT_CAUSED_BY_TRIAL = (7, 8, 10, STOPPED, INTERRUPTED)
"""Exit codes that settings of a trial cannot cause: missing package, missing device, error of the machine, signals."""


def check_parameters(request: TrainingRequest, parameters: Sequence[Parameter], objective: Objective) -> Resolved:
    """Check, before anything is written, that trials can be trained and evaluated.

    Every bound and every choice of the parameters is checked in a configuration of the task.

    Args:
        request: the request for the trainings.
        parameters: the keys that the sweep varies, with their ranges or choices.
        objective: the metric that ranks the trials.

    Returns:
        A configuration with the task and the agent of all trials; each parameter has one of its bounds or choices.

    Raises:
        ConfigError: for an unknown key, or a bound that is not valid for its key.
        UsageError: for an objective that evaluations of this task do not have.
    """
    for index in range(max(len(parameter.bounds) for parameter in parameters)):
        bounds = [p.override(p.bounds[min(index, len(p.bounds) - 1)]) for p in parameters]
        resolved, _ = request.resolve(bounds)
    require_success(resolved, [objective.key], "--objective return")
    group, _, name = objective.key.partition(".")
    task = resolved.task
    groups: dict[str, Mapping[str, Any]] = {"reward_terms": task.rewards, "terminations": task.terminations}
    names = [key for key, term in groups.get(group, {}).items() if term is not None]
    if names and name not in names:
        hint = did_you_mean(name, names) or f"choose from {listing(names)}"
        kind = "reward" if group == "reward_terms" else "termination"
        raise UsageError(f"--objective {objective.key}: the task has no {kind} '{name}'", hint=hint)
    return resolved


def write_preset(sweep: Sweep, request: TrainingRequest) -> None:
    """Write the settings of the best trial into the sweep's folder, as a file for `rlcli train --config`.

    Nothing is written if no trial is finished.
    """

    def preset(values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of the file for the values (key -> value) of a trial."""
        resolved, _ = replace(request, budget={}).resolve(sweep.overrides(values))
        return preset_of(resolved, names_agent=True)

    sweep.write_preset(preset)


@dataclass(slots=True)
class _Stage:
    """Stage of a trial (first training, then evaluation) that runs in a subprocess."""

    trial: Trial
    process: TrainingProcess
    evaluates: bool = False
    """Whether the stage is the evaluation."""
    pruned: bool = False
    """Whether the pruner has stopped the training."""
    reported: int = 0
    """Last step reported to the pruner, in percent of the budget."""
    next_report: float = 0.0
    """Time of the next report to the pruner [s], by `time.monotonic`."""
    trained_s: float = 0.0
    """Training time (rollouts and updates) so far [s]."""
    counted: int = 0
    """Number of iterations that are included in `trained_s`."""

    def add_trained_time(self, rows: Sequence[Mapping[str, Any]]) -> float:
        """Add the durations in rows of `metrics.jsonl` that are not counted yet; return the training time so far [s].

        If earlier rows are missing in `rows`, the duration in the run's record is used, if larger.

        Args:
            rows: the newest rows, in the order of the iterations.
        """
        new_rows = [row for row in rows if row["iteration"] > self.counted]
        if new_rows and new_rows[0]["iteration"] > self.counted + 1:  # rows were missed, or the run was resumed
            self.trained_s = max(self.trained_s, overview(self.trial.folder).duration_s or 0.0)
        self.trained_s += sum(map(training_s, new_rows))
        if new_rows:
            self.counted = new_rows[-1]["iteration"]
        return self.trained_s


class TrialRunner:
    """Trains and evaluates trials of a sweep in subprocesses, and stores their results.

    Args:
        sweep: the sweep.
        request: the request for the trainings.
        objective: the metric that ranks the trials, and the limit of their training.
        jobs: number of trials at a time.
        stop: stores whether a signal has requested a stop.
    """

    def __init__(
        self, sweep: Sweep, request: TrainingRequest, objective: Objective, jobs: int, stop: StopRequest
    ) -> None:
        self._sweep, self._request, self._objective, self._jobs, self._stop = sweep, request, objective, jobs, stop
        self._active: list[_Stage] = []
        self._failures: list[RlcliError] = []

    def run(self) -> None:
        """Run trials until no trial is left or a signal arrives.

        Raises:
            RlcliError: if all trials have failed, or the first three; or for an error that does not depend on the
                trial, such as a full disk.
        """
        before = len(self._sweep.ended())
        try:
            with track("trials", max(1, self._sweep.settings["trials"] - before)) as work:
                stopping = self._run_all(lambda: work.update(len(self._sweep.ended()) - before, 0.0))
        finally:
            for stage in self._active:
                stage.process.process.kill()
        if self._failures and not stopping and self._sweep.best() is None:
            raise self._all_failed()

    def _run_all(self, on_end: Callable[[], None]) -> bool:
        """Run the trials, and return whether a signal has stopped them.

        `on_end` is called after each stage (training, evaluation) of a trial.
        """
        while True:
            stopping = self._stop.signal is not None
            while not stopping and len(self._active) < self._jobs:
                trial = self._sweep.claim()
                if trial is None:
                    break
                self._active.append(self._start(trial))
            if not self._active:
                return stopping
            for stage in list(self._active):
                if stopping:
                    stage.process.stop()
                if stage.process.has_ended():
                    self._active.remove(stage)
                    self._end(stage, stopping)
                    on_end()
                elif not stopping:
                    self._watch(stage)
            time.sleep(POLL_S)

    def _start(self, trial: Trial) -> _Stage:
        """Start or resume the training of a trial; if the training is finished, start the evaluation."""
        changes = self._sweep.overrides(trial.values)
        _log.info("trial %s: %s", trial.number, ", ".join(changes))
        device = prepare_run(trial.folder, self._request, changes)
        run = overview(trial.folder)
        limit_s = self._objective.seconds
        if run.state == "finished" or (limit_s is not None and (run.duration_s or 0.0) >= limit_s):
            return self._evaluate(trial)
        return _Stage(trial, start_training(trial.folder, device))

    def _evaluate(self, trial: Trial) -> _Stage:
        """Start the evaluation of a trial, with `rlcli eval`."""
        episodes, seed = self._sweep.settings["episodes"], self._sweep.settings["seed"]
        words = ["eval", "--checkpoint", str(trial.folder), "--episodes", str(episodes), "--seed", str(seed)]
        return _Stage(trial, start_command(trial.folder, words), evaluates=True)

    def _watch(self, stage: _Stage) -> None:
        """Report the progress of a training to the pruner, and stop the training if it is pruned or out of time."""
        if stage.evaluates or stage.process.stop_requested:
            return
        now, limit_s, metric = time.monotonic(), self._objective.seconds, self._objective.training_metric
        if limit_s is None and now < stage.next_report:
            return
        stage.next_report = now + _REPORT_EVERY_S
        rows = newest_rows(Run(stage.trial.folder))
        if not rows:
            return
        run = overview(stage.trial.folder)
        share = 0.0
        if limit_s is not None:
            share = stage.add_trained_time(rows) / limit_s
            if share >= 1.0:
                stage.process.stop()
                return
        elif run.iterations:
            share = (run.iteration or 0) / run.iterations
        step = int(_PRUNER_STEPS * share)
        if metric is None or metric not in run.last or step <= stage.reported:
            return
        stage.reported = step
        stage.trial.trial.report(run.last[metric], step)
        if stage.trial.trial.should_prune():
            stage.pruned = True
            stage.process.stop()

    def _end(self, stage: _Stage, stopping: bool) -> None:
        """Handle the end of a process: after a training, start the evaluation; else store the trial's result or error.

        `stopping` is whether a signal has stopped the process; the trial can then be resumed.

        Raises:
            RlcliError: for an error that does not depend on the trial, such as a full disk.
        """
        trial, process = stage.trial, stage.process
        if stage.evaluates and process.exit_code == 0:
            self._store_value(trial, self._objective.read(process.document))
        elif stage.pruned:
            self._sweep.tell(trial, state="PRUNED")
            _log.info("trial %s: pruned (stopped early, because other trials learn better)", trial.number)
        elif stopping:
            return  # the trial stays in the storage, to be resumed
        elif not stage.evaluates and not process.has_failed:
            self._active.append(self._evaluate(trial))
        elif process.exit_code in _NOT_CAUSED_BY_TRIAL:
            error = process.error()
            error.message = f"trial {trial.number}: {error.message}"
            error.hint = "run the same command again to continue with this trial"
            raise error
        else:
            self._fail(trial, process.error())

    def _store_value(self, trial: Trial, value: float) -> None:
        """Store the objective of an evaluated trial, and write the preset; a value that is not finite is a failure."""
        if not math.isfinite(value):
            self._fail(trial, DivergedError(f"{self._objective.key} is not finite in the evaluation"))
            return
        run = overview(trial.folder)
        self._sweep.tell(trial, value, seconds=run.duration_s, step=run.step)
        state = open_run(trial.folder).record["state"]
        _log.info("trial %s: %s = %.6g (%s)", trial.number, self._sweep.settings["objective"], value, state)
        write_preset(self._sweep, self._request)

    def _fail(self, trial: Trial, error: RlcliError) -> None:
        """Store that a trial has failed; raise an error if `_MAX_FAILURES` trials have failed and none has a result."""
        self._failures.append(error)
        self._sweep.tell(trial, state="FAIL", why=error.message)
        _log.warning("trial %s: %s", trial.number, error.message)
        if len(self._failures) >= _MAX_FAILURES and self._sweep.best() is None:
            raise self._all_failed()

    def _all_failed(self) -> RlcliError:
        """Return the error of the last failed trial, with the number of failed trials in its message."""
        error, count = self._failures[-1], len(self._failures)
        error.message = f"the first {f'{count} trials' if count > 1 else 'trial'} failed: {error.message}"
        return error
