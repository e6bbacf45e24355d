"""`rlcli sweep compare`: time to a threshold, with the settings of a sweep's best trial and with the task's own ones.

The threshold is a value of a metric of the evaluation, such as `success=0.99`.
"""

import logging
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rlcli.config.dump import to_data, to_yaml
from rlcli.config.strict_yaml import MAX_BYTES
from rlcli.errors import CheckpointError, DivergedError, RlcliError, UsageError
from rlcli.evaluation.limits import require_success
from rlcli.progress import track
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.overview import newest_rows, overview
from rlcli.runs.run import CONFIG, Run
from rlcli.runs.safe_io import read_file
from rlcli.training.signals import StopRequest
from rlcli.training.start_run import TrainingRequest, prepare_run
from rlcli.training.time_to_threshold import Threshold, TimeToThreshold, median, read_threshold, time_to_threshold
from rlcli.training.train_commands import POLL_S, start_training
from rlcli.tuning.sweep import Sweep

_log = logging.getLogger(__name__)

ARMS = {"default": "the task's own settings", "best": "best trial"}
"""The two kinds of settings that are compared: name in JSON documents -> name in messages."""


@dataclass(slots=True)
class Training:
    """One training of `sweep compare`: with one seed, and with the task's own or the best trial's settings."""

    arm: str
    """Which settings the training has: `default` (the task's own) or `best` (the best trial's)."""
    seed: int
    folder: Path
    """Folder of the training's run, inside the sweep's folder."""
    reached: TimeToThreshold | None = None
    """When the training reached the threshold; None: not reached."""
    error: RlcliError | None = None
    """Why the training failed; None: not failed."""

    @property
    def state(self) -> str:
        """How the training ended: `reached` (the threshold), `not reached` or `failed`."""
        return "failed" if self.error else "reached" if self.reached else "not reached"

    def time(self) -> dict[str, float | None]:
        """Return `seconds` (training time) and `steps` (environment steps) to the threshold; None: not reached."""
        if self.reached is None:
            return {"seconds": None, "steps": None}
        return {"seconds": self.reached.seconds, "steps": self.reached.step}


@dataclass(slots=True)
class Comparison:
    """Trainings with the task's own settings and with those of the best trial, and their times to the threshold."""

    sweep: Path
    """Folder of the sweep."""
    task: str
    """Name of the task."""
    threshold: Threshold
    trial: int
    """Index of the best trial."""
    seeds: Sequence[int]
    trainings: list[Training] = field(default_factory=list)
    stop_code: int | None = None
    """Exit code for the signal that stopped the comparison before its end; None: not stopped."""

    @property
    def exit_code(self) -> int:
        """Exit code of the first training that failed; 0 if no training has failed."""
        return next((one.error.exit_code for one in self.trainings if one.error is not None), 0)

    def training(self, seed: int, arm: str) -> Training | None:
        """Return the training with a seed and settings (`default` or `best`); None if that training has not run."""
        return next((one for one in self.trainings if (one.seed, one.arm) == (seed, arm)), None)

    def medians(self) -> dict[str, dict[str, float | None]]:
        """Return the medians of the times to the threshold over seeds: `default`, `best` -> {seconds, steps}.

        Settings that were not yet trained with all seeds are left out.
        """
        medians = {}
        for arm in ARMS:
            times = [one.time() for one in self.trainings if one.arm == arm]
            if len(times) == len(self.seeds):
                medians[arm] = {key: median([time[key] for time in times]) for key in ("seconds", "steps")}
        return medians

    def ratios(self) -> dict[str, float | None]:
        """Return the medians of the best trial's settings divided by those of the task's own: {seconds, steps}.

        The result is empty until both were trained with all seeds; a ratio is None without a median.
        """
        medians = self.medians()
        if len(medians) < len(ARMS):
            return {}
        ratios: dict[str, float | None] = {}
        for key in ("seconds", "steps"):
            default, best = (medians[arm][key] for arm in ARMS)
            ratios[key] = None if default is None or best is None else best / default
        return ratios

    def document(self) -> dict[str, Any]:
        """Return the comparison as JSON data."""
        return {
            "sweep": str(self.sweep),
            "task": self.task,
            "until": {self.threshold.key: self.threshold.value},
            "trial": self.trial,
            "compared": [
                {"policy": one.arm, "seed": one.seed, "run": str(one.folder), "state": one.state, **one.time()}
                for one in self.trainings
            ],
            "medians": self.medians(),
            "ratios": self.ratios(),
        }


def compare(
    sweep: Sweep, request: TrainingRequest, seeds: Sequence[int], until: str | None, episodes: int, stop: StopRequest
) -> Comparison:
    """Train with the task's own settings and with those of the best trial, until an evaluation reaches the threshold.

    The trainings run one after the other, as runs in the sweep's folder; after an interruption, a call with the same
    arguments continues these runs.

    Args:
        sweep: the sweep.
        request: the device, the budget and the overrides of all trainings.
        seeds: the seeds of the trainings.
        until: the threshold, such as `success=0.99`; None: `success=0.99`.
        episodes: number of episodes of an evaluation.
        stop: stores whether a signal has requested a stop; signals are handled while the trainings run.

    Raises:
        CheckpointError: if no trial has finished.
        UsageError: if the task defines no success and `until` is None or names success, or if `until` is not valid.
    """
    best = sweep.best()
    if best is None:
        raise CheckpointError(f"{sweep.folder} has no finished trial yet", hint="see `rlcli sweep show`")
    threshold = read_threshold(until or "success=0.99")
    comparison = Comparison(sweep.folder, sweep.settings["task"], threshold, best.number, seeds)
    with _request_of_sweep(sweep, request) as base:
        resolved, _ = base.resolve()
        if not resolved.task.success and until is None:
            raise UsageError("the task defines no success, so --until is required", hint="add --until return=X")
        require_success(resolved, [threshold.key], "--until return=X")
        if resolved.agent is not None and not resolved.agent.eval_interval:
            base.overrides.append("agent.eval_interval=1")
        base.overrides.append(f"agent.eval_episodes={episodes}")
        count, agent = len(ARMS) * len(seeds), resolved.require_agent()[0]
        budget = f"{agent.max_iterations:,} iterations" if agent.max_iterations else f"{agent.max_steps:,} steps"
        _log.info(f"{count} trainings, each of at most {budget}; fewer --seeds or --max-iterations N shorten them")
        changes: dict[str, list[str]] = {"default": [], "best": sweep.overrides(sweep.values(best))}
        with stop, track("trainings", count) as work:
            for turn, seed in enumerate(seeds):
                # alternate, so that a slow period of the machine affects both settings
                for arm in ARMS if turn % 2 == 0 else reversed(ARMS):
                    if stop.signal is not None:
                        break
                    training = _train(comparison, replace(base, seed=seed), arm, changes[arm], stop)
                    # otherwise a signal has stopped this training
                    if training.reached or training.error or stop.signal is None:
                        comparison.trainings.append(training)
                    work.advance()
    if stop.signal is not None and len(comparison.trainings) < len(ARMS) * len(seeds):
        comparison.stop_code = stop.exit_code
    return comparison


@contextmanager
def _request_of_sweep(sweep: Sweep, request: TrainingRequest) -> Iterator[TrainingRequest]:
    """Return a copy of a training's request for a `with` block, with the settings that all trials of a sweep share.

    The copy keeps the budget, the device and the overrides of the request. During the block, a temporary file has the
    content of the sweep's `--config` file.
    """
    from rlcli.runs.recorded_task import recorded_task

    settings = sweep.settings
    source = recorded_task(settings["source"], f"the task of {sweep.folder}")
    with tempfile.TemporaryDirectory() as folder:
        config = None
        if settings.get("config") is not None:
            config = Path(folder) / "config.yaml"
            config.write_text(settings["config"], encoding="utf-8")
        yield replace(
            request,
            source=source,
            agent=settings["agent"],
            config=config,
            overrides=[*settings["overrides"], *request.overrides],
            flags=dict(settings["flags"]),
        )


def _train(
    comparison: Comparison, request: TrainingRequest, arm: str, changes: Sequence[str], stop: StopRequest
) -> Training:
    """Train with the settings `arm` (`default` or `best`) until the threshold, the end of the budget, or a signal.

    A run with the same settings in the sweep's folder is continued. `changes` are overrides (`KEY=VALUE`).
    """
    seed, threshold = request.seed, comparison.threshold
    name = "compare-default" if arm == "default" else f"compare-trial-{comparison.trial:04d}"
    training = Training(arm, seed, _run_folder(comparison.sweep, f"{name}-seed-{seed}", request, changes))
    device = prepare_run(training.folder, request, changes)
    run = overview(training.folder)

    def time_of_run() -> TimeToThreshold | None:
        return time_to_threshold(read_rows(training.folder / "metrics.jsonl"), threshold)

    training.reached = time_of_run()
    if training.reached is None and run.state == "diverged":
        training.error = DivergedError(f"{training.folder}: {run.reason}")
    elif training.reached is None and run.state != "finished":
        _log.info("%s, seed %s: %s", ARMS[arm], seed, training.folder)
        process = start_training(training.folder, device)
        try:
            while not process.has_ended():
                if stop.signal is not None or any(map(threshold.reached_by, newest_rows(Run(training.folder)))):
                    process.stop()
                time.sleep(POLL_S)
        finally:
            process.process.kill()
        training.reached = time_of_run()
        if process.has_failed and stop.signal is None:
            training.error = process.error()
            _log.warning("%s, seed %s: %s", ARMS[arm], seed, training.error.message)
    reached = training.reached
    time_taken = "" if reached is None else f" after {reached.seconds:.1f} s, {reached.step:,} steps"
    outcome = "training failed" if training.error else f"threshold {training.state}"
    _log.info("%s, seed %s: %s%s", ARMS[arm], seed, outcome, time_taken)
    return training


def _run_folder(sweep: Path, name: str, request: TrainingRequest, changes: Sequence[str]) -> Path:
    """Return the folder for a training: a new folder, or that of an earlier run with exactly the same configuration.

    A number is appended to the name if a run with another configuration has the name already.

    Args:
        sweep: folder of the sweep.
        name: name of the folder.
        request: the request for the training.
        changes: overrides of this training.
    """
    config = to_yaml(to_data(request.resolve(changes)[0]))
    number = 1
    while True:
        folder = sweep / (name if number == 1 else f"{name}-{number}")
        if not (folder / CONFIG).is_file() or read_file(folder / CONFIG, MAX_BYTES) == config.encode():
            folder.mkdir(exist_ok=True)
            return folder
        number += 1
