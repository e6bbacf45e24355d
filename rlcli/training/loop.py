"""Training loop of one run: iterate, log, evaluate and save until the budget is spent or a signal arrives.

`rlcli.training.runner` prepares everything that the loop needs.
"""

from __future__ import annotations

import contextlib
import logging
import shlex
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from rlcli.errors import DivergedError, MachineError, Stopped
from rlcli.rl import distributed
from rlcli.rl.budget import Budget
from rlcli.rl.trainer import Report, Trainer
from rlcli.runs import checkpoint_reader
from rlcli.runs.run import Run
from rlcli.training.checkpoint_writer import CheckpointWriter
from rlcli.training.health import Health, probe
from rlcli.training.periodic_eval import PeriodicEval
from rlcli.training.progress import Progress, progress_from_metrics
from rlcli.training.signals import Interrupted, StopRequest

if TYPE_CHECKING:
    from rlcli.training.trackers import Logger
    from rlcli.viewer.training_video_recorder import TrainingVideos

_log = logging.getLogger(__name__)

SAVE_EVERY_S = 60.0
"""Time between checkpoints without a `save_interval` [s]."""
LONG_S = 0.1
"""If an iteration took longer than this [s], the state is copied before the next one, and a signal can interrupt it."""
RECENT = 100
"""Number of newest iterations from whose mean duration the remaining time is estimated."""
DIVERGED_SHARE = 0.01
"""Fraction of an iteration's environment steps that may diverge; above it the training stops."""


@dataclass(slots=True)
class TrainLoop:
    """Training loop of one run: iterate, log, evaluate and save until the budget is spent or a signal arrives.

    A checkpoint is always the state between two iterations (a boundary). All ranks (processes of the training) reach
    each boundary together; rank 0 writes the checkpoints.
    """

    trainer: Trainer
    run: Run
    writer: CheckpointWriter
    loggers: Sequence[Logger] = ()
    save_interval: int | None = None
    """Number of iterations between checkpoints; None: a checkpoint every `SAVE_EVERY_S` seconds."""
    periodic_eval: PeriodicEval | None = None
    """Evaluation every few iterations; None: no evaluations."""
    videos: TrainingVideos | None = None
    """Recorder of videos every few iterations; None: no videos."""
    health: Health | None = None
    """Health checks; None: no checks."""
    show: Callable[[Progress], None] = lambda _: None
    """Function that displays the progress after each iteration."""
    count_divergences: Callable[[], int] = lambda: 0
    """Function that returns the number of environment steps that have diverged since the environment was built."""
    stop: StopRequest = field(default_factory=StopRequest)
    deadline: float | None = None
    """Time at which the training stops, by the monotonic clock [s]; None: no limit."""
    metrics: dict[str, float] = field(init=False, default_factory=dict)
    """Metrics of the newest iteration."""
    reached: bool = field(init=False, default=False)
    """Whether an evaluation has reached the threshold that ends the training (`--until`)."""
    timed_out: bool = field(init=False, default=False)
    """Whether the deadline has passed."""
    _ranks: distributed.ProcessGroup = field(init=False, default_factory=distributed.current)
    _boundary: tuple[int, int] = field(init=False, default=(0, 0))
    """Iteration and environment steps at the beginning of the current iteration."""
    _iteration_s: float = field(init=False, default=0.0)
    """Duration of the last iteration [s]."""
    _recent: deque[dict[str, Any]] = field(init=False, default_factory=lambda: deque(maxlen=RECENT))
    """Rows of the newest iterations, as in `metrics.jsonl`."""
    _saved_at: float = field(init=False, default_factory=time.monotonic)

    def train(self, budget: Budget) -> None:
        """Train until the budget is spent, the threshold of `--until` is reached or the deadline has passed.

        Raises:
            Stopped: on a signal, after a checkpoint between two iterations is written; on a second signal, at once.
            DivergedError: if the learner or too many environment steps diverge; the last good checkpoint is kept.
            MachineError: if the run cannot be written.
        """
        self._boundary = self.trainer.iteration, self.trainer.env_steps
        try:
            self._train(budget)
        except Interrupted:
            number = self._boundary[0] + 1
            raise self._stopped(f"stopped in iteration {number}; a resumed run repeats this iteration") from None
        except KeyboardInterrupt:
            message = "stopped without a new checkpoint; the iterations after the last checkpoint are lost"
            raise self._stopped(message) from None
        except BaseException as error:
            with contextlib.suppress(Exception):  # the first error is the one to report
                self.writer.wait()  # the background thread may be writing a good checkpoint
                if isinstance(error, DivergedError):
                    iteration, step = self._boundary
                    self.writer.save_cases(iteration + 1, step + self.trainer.steps_per_iteration)
            if isinstance(error, MachineError):
                resume = f"then continue with `rlcli train --resume {shlex.quote(str(self.run.shown))}`"
                error.hint = f"{error.hint}; {resume}" if error.hint else f"correct this, {resume}"
            raise

    def _train(self, budget: Budget) -> None:
        trainer, writer = self.trainer, self.writer
        if writer.newest is None:
            self._save()
            writer.wait()
        begin = time.monotonic()
        # a signal on any rank stops all ranks at the same boundary
        while not (stopped := any(self._ranks.sum(self.stop.signal is not None))) and not self._is_over(budget):
            report, evaluation, is_best, must_save = self._iterate()
            self.metrics = metrics = {**_with_rates(report, trainer.steps_per_iteration), **evaluation}
            now = time.monotonic()
            metrics["Perf/iteration_time"], begin = now - begin, now
            for logger in self.loggers:
                logger.write(trainer.iteration, trainer.env_steps, metrics)
            if self.periodic_eval is not None and evaluation:
                _log.info("evaluation after iteration %s: %s", trainer.iteration, self.periodic_eval.text)
            self._check_health(metrics)
            self.show(self._progress(budget, metrics))
            if must_save or writer.is_due(trainer.iteration, self.save_interval):
                self._save()
            if is_best:
                writer.wait()
                writer.best = trainer.env_steps
                self.run.update(best=writer.best)
            writer.check()
            if self.videos is not None and self.videos.due(trainer.iteration):
                self.videos.record(trainer.policy, trainer.env_steps)
        self._save()
        writer.wait()
        if stopped and not self._is_over(budget):
            raise self._stopped(f"stopped at iteration {trainer.iteration}, checkpoint written")

    def _is_over(self, budget: Budget) -> bool:
        return self.reached or self.timed_out or budget.spent(self.trainer)

    def _check_health(self, metrics: dict[str, float]) -> None:
        """Run the health checks if they are due; log new problems, and write all present problems into run.json."""
        health = self.health
        if health is None:
            return
        known = {finding.check for finding in health.findings}
        probed = probe(self.trainer) if health.due(self.trainer.iteration) else {}
        health.add(self.trainer.iteration, metrics | probed)
        if health.findings or "health" in self.run.record:
            self.run.record["health"] = [asdict(finding) for finding in health.findings]
        for finding, text in zip(health.findings, self.run.findings(), strict=True):
            if finding.check not in known:
                self.run.update()
                _log.warning("%s", text)

    def _iterate(self) -> tuple[Report, dict[str, float], bool, bool]:
        """Do one iteration and, if it is due, an evaluation.

        Returns:
            The trainer's report; the metrics of the evaluation, empty if there was none; whether the evaluation is the
            best so far (on the rank that evaluates); whether all ranks must save a checkpoint.

        Raises:
            DivergedError: if too many environment steps diverged.
        """
        trainer, cases, evaluator = self.trainer, self.writer.cases, self.periodic_eval
        diverged_before = self.count_divergences()
        evaluates = evaluator is not None and evaluator.due(trainer.iteration + 1)
        with self._interruptible(is_long=evaluates):
            report = trainer.iterate()
            if cases is not None:
                cases.commit(trainer.iteration, trainer.env_steps)
            evaluation = evaluator.run(trainer.policy) if evaluator is not None and evaluates else {}
            is_best = evaluator is not None and evaluator.improves(evaluation)
            unsaved_s = time.monotonic() - self._saved_at
            is_overdue = self.save_interval is None and self._ranks.is_rank_zero and unsaved_s > SAVE_EVERY_S
            new_divergences = self.count_divergences() - diverged_before
            reached = evaluator is not None and evaluator.reached
            late = self.deadline is not None and time.monotonic() >= self.deadline
            ends = reached, late
            diverged, reached_on, late_on, *must_save = self._ranks.sum(new_divergences, *ends, is_overdue, is_best)
            self.reached, self.timed_out = bool(reached_on), bool(late_on)
            _require_stable(diverged, trainer)
        return report, evaluation, is_best, any(must_save)

    @contextlib.contextmanager
    def _interruptible(self, is_long: bool) -> Iterator[None]:
        """Allow a signal to interrupt the iteration that the `with` block runs, if it is long.

        The trainer's state is copied before the iteration; after a signal or a divergence, this state is saved. A short
        iteration is always finished, because that takes less time than copying the state. On a GPU and with several
        ranks every iteration is finished.
        """
        self._boundary = self.trainer.iteration, self.trainer.env_steps
        interruptible = self.stop.can_interrupt and self._ranks.world_size == 1
        is_saved = self.writer.newest == self._boundary
        copies = interruptible and not is_saved and (is_long or self._iteration_s > LONG_S)
        state = self.trainer.state() if copies else None
        begin = time.monotonic()
        try:
            with self.stop.interruptible(interruptible and (is_saved or copies)):
                yield
        except (Interrupted, DivergedError):
            if state is not None:
                self.writer.save(state, *self._boundary)
            self.writer.wait()
            raise
        self._iteration_s = time.monotonic() - begin

    def _save(self) -> None:
        """Save a checkpoint of the state between two iterations, if this checkpoint does not exist yet."""
        boundary = self.trainer.iteration, self.trainer.env_steps
        if self.writer.newest != boundary:
            state = self.trainer.state()  # a collective operation: every rank must call it
            if self._ranks.is_rank_zero:
                self.writer.save(state, *boundary)
            else:
                self.writer.newest = boundary
        self._saved_at = time.monotonic()

    def _progress(self, budget: Budget, metrics: dict[str, float]) -> Progress:
        """Return the progress after an iteration with these metrics."""
        trainer = self.trainer
        self._recent.append({**metrics, "iteration": trainer.iteration, "step": trainer.env_steps})
        progress = progress_from_metrics([*self._recent], budget.iterations(trainer))
        evaluated = (row for row in reversed(self._recent) if "Eval/mean_reward" in row)
        last_evaluation: dict[str, Any] = next(evaluated, {})
        progress.metrics |= {name: value for name, value in last_evaluation.items() if name.startswith("Eval/")}
        progress.may_end_earlier = self.periodic_eval is not None and self.periodic_eval.until is not None
        progress.notes = [] if self.health is None else [*self.health.notes(metrics), *self.run.findings()]
        return progress

    def _stopped(self, message: str) -> Stopped:
        """Return the error of a stopped run, with the command that resumes it."""
        hint = f"rlcli train --resume {shlex.quote(str(self.run.shown))}"
        have_checkpoint = checkpoint_reader.steps(self.run.checkpoints)
        return Stopped(message, exit_code=self.stop.exit_code, hint=hint if have_checkpoint else None)


def _with_rates(report: Report, steps: int) -> dict[str, float]:
    """Return the metrics in a report, with the iteration's speed and durations as `Perf/*`.

    `steps` is the number of environment steps of the iteration.
    """
    seconds = report.seconds
    total = max(sum(seconds.values()), 1e-9)
    rates = {
        "Perf/total_fps": steps / total,
        "Perf/collection_time": total - seconds.get("update", 0.0),
        "Perf/learning_time": seconds.get("update", 0.0),
        **{f"Perf/{name}_share": value / total for name, value in seconds.items()},
    }
    return {**report.metrics, **rates}


def _require_stable(diverged: float, trainer: Trainer) -> None:
    """Check that at most the share `DIVERGED_SHARE` of an iteration's environment steps has diverged.

    `diverged` is the number of diverged steps in the newest iteration, over all ranks.

    Raises:
        DivergedError: if more steps have diverged.
    """
    share = diverged / trainer.steps_per_iteration
    if share > DIVERGED_SHARE:
        message = f"the simulation diverged in {share:.1%} of the environment steps of iteration {trainer.iteration}"
        raise DivergedError(message, hint="lower sim.dt, limit actuator efforts, add joint damping or armature")
