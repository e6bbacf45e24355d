"""The training loop: iterate, report, save, until the budget is spent or somebody asks to stop."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rlcli.errors import DivergedError, Stopped
from rlcli.rl import checkpoint, distributed
from rlcli.rl.loggers import Logger
from rlcli.rl.progress import Progress
from rlcli.rl.run import Run
from rlcli.rl.saving import Saver
from rlcli.rl.stop import Interrupted, StopRequest
from rlcli.rl.trainer import Report, Trainer
from rlcli.rl.trials import Trials

if TYPE_CHECKING:
    from rlcli.viewer.clips import Clips

SAVE_EVERY_S = 60.0
LONG_S = 0.1
"""An iteration that takes longer can be interrupted: its beginning is copied for that."""
DIVERGED_SHARE = 0.01
"""Share of an iteration's environment steps that may diverge before the run stops."""


@dataclass(frozen=True, slots=True)
class Budget:
    """How long to train, in total: a resumed run trains what is left."""

    max_iterations: int | None
    max_steps: int | None

    def spent(self, trainer: Trainer) -> bool:
        """Whether the trainer has had its iterations or its steps."""
        return (self.max_iterations is not None and trainer.iteration >= self.max_iterations) or (
            self.max_steps is not None and trainer.env_steps >= self.max_steps
        )

    def share(self, trainer: Trainer) -> float:
        """How much of the budget is spent, 0 to 1; at a boundary within an iteration, by its beginning."""
        shares = [0.0]
        if self.max_iterations is not None:
            shares.append(trainer.iteration / self.max_iterations)
        if self.max_steps is not None:
            shares.append(trainer.iteration * trainer.steps_per_iteration / self.max_steps)
        return min(1.0, max(shares))

    def iterations(self, trainer: Trainer) -> int:
        """Iterations in all."""
        limits = []
        if self.max_iterations is not None:
            limits.append(self.max_iterations)
        if self.max_steps is not None:
            left = max(0, self.max_steps - trainer.env_steps)
            limits.append(trainer.iteration + -(-left // trainer.steps_per_iteration))
        return min(limits)


def fit(
    trainer: Trainer,
    run: Run,
    budget: Budget,
    saver: Saver,
    *,
    loggers: Sequence[Logger] = (),
    save_interval: int | None = None,
    trials: Trials | None = None,
    clips: Clips | None = None,
    show: Callable[[Progress], None] = lambda _: None,
    tell: Callable[[str], None] = lambda _: None,
    divergences: Callable[[], int] = lambda: 0,
    stop: StopRequest | None = None,
) -> None:
    """Train until the budget is spent. A checkpoint is always of a boundary between iterations.

    Several processes do the same at each boundary; the one that leads writes the checkpoints.

    Raises:
        Stopped: on a signal, after the checkpoint of the last boundary was written; at once on the second.
        DivergedError: if the learner or too much of the simulation diverges; the last good checkpoint is kept.
        MachineError: if the disk refuses.
    """
    peers, stop = distributed.current(), stop or StopRequest()
    boundaries = _Boundaries(trainer, saver, stop, peers)
    try:
        if saver.at is None:
            boundaries.save()
            saver.wait()
        begin, first_step = time.monotonic(), trainer.env_steps
        while not (stopped := _any_asked(stop, peers)) and not budget.spent(trainer):
            before, tried = divergences(), trials is not None and trials.due(trainer.iteration + 1)
            with boundaries.iteration(long=tried):
                report = trainer.iterate()
                if saver.cases is not None:
                    saver.cases.commit(trainer.iteration, trainer.env_steps)
                trial = trials.run(trainer.policy) if trials is not None and tried else {}
                better = trials is not None and trials.improves(trial)
                late = save_interval is None and boundaries.late()
                diverged, overdue, best = peers.total(divergences() - before, late, better)
                _require_stable(diverged, trainer)
            for note in report.notes:
                tell(note)
            metrics = {**_with_rates(report, trainer.steps_per_iteration), **trial}
            for logger in loggers:
                logger.write(trainer.iteration, trainer.env_steps, metrics)
            show(_progress(trainer, budget, report, metrics, time.monotonic() - begin, first_step))
            if best or overdue or saver.asked(trainer.iteration, save_interval):
                boundaries.save()
            if better:
                saver.wait()
                saver.best = trainer.env_steps
                run.update(best=saver.best)
            saver.check()
            if clips is not None and clips.due(trainer.iteration):
                clips.record(trainer.policy, trainer.env_steps)
        boundaries.save()
        saver.wait()
    except Interrupted:
        raise _stopped(f"stopped in iteration {boundaries.number + 1}; resumed, it begins again", run, stop) from None
    except KeyboardInterrupt:
        raise _stopped("stopped at once; what came after the last checkpoint is lost", run, stop) from None
    except BaseException as error:
        with contextlib.suppress(Exception):  # the first error is the one to report
            saver.wait()  # a good checkpoint may be on its way
            if isinstance(error, DivergedError):
                saver.save_cases(boundaries.number + 1, boundaries.step + trainer.steps_per_iteration)
        raise
    if stopped and not budget.spent(trainer):
        raise _stopped(f"stopped at iteration {trainer.iteration}, checkpoint written", run, stop)


class _Boundaries:
    """The moments between iterations: what is saved of them, and what a long iteration can go back to."""

    def __init__(self, trainer: Trainer, saver: Saver, stop: StopRequest, peers: distributed.Peers) -> None:
        self._trainer, self._saver, self._stop, self._peers = trainer, saver, stop, peers
        self._saved_at = time.monotonic()
        self._took = 0.0
        self.number, self.step = trainer.iteration, trainer.env_steps
        """Iterations, and environment steps, before the one that runs."""

    def save(self) -> None:
        """Write this one, unless it is written."""
        at = (self._trainer.iteration, self._trainer.env_steps)
        if self._saver.at != at:
            state = self._trainer.state()  # together: all processes give theirs
            if self._peers.leads:
                self._saver.save(state, *at)
            else:
                self._saver.at = at
        self._saved_at = time.monotonic()

    def late(self) -> bool:
        """Whether the leader has not saved for long."""
        return self._peers.leads and time.monotonic() - self._saved_at > SAVE_EVERY_S

    @contextlib.contextmanager
    def iteration(self, long: bool = False) -> Iterator[None]:
        """Around an iteration: where it takes long, a signal ends it at once, and its beginning is written.

        So it is when the learner diverges. A short one is cheaper finished than copied beforehand; on a GPU and with
        several processes all are.
        """
        at = self._trainer.iteration, self._trainer.env_steps
        self.number, self.step = at
        prompt, saved = self._stop.can_interrupt and self._peers.size == 1, self._saver.at == at
        copied = prompt and not saved and (long or self._took > LONG_S)
        before = self._trainer.state() if copied else None
        begin = time.monotonic()
        try:
            with self._stop.prompt(prompt and (saved or copied)):
                yield
        except (Interrupted, DivergedError):
            if before is not None:
                self._saver.save(before, *at)
            self._saver.wait()
            raise
        self._took = time.monotonic() - begin


def _any_asked(stop: StopRequest, peers: distributed.Peers) -> bool:
    return any(peers.total(stop.signal is not None))


def _stopped(message: str, run: Run, stop: StopRequest) -> Stopped:
    hint = f"rlcli train --resume {shlex.quote(str(run.folder))}"
    return Stopped(message, exit_code=stop.exit_code, hint=hint if checkpoint.steps(run.checkpoints) else None)


def _with_rates(report: Report, steps: int) -> dict[str, float]:
    seconds = report.seconds
    total = max(sum(seconds.values()), 1e-9)
    rates = {
        "Perf/total_fps": steps / total,
        "Perf/collection_time": total - seconds.get("update", 0.0),
        "Perf/learning_time": seconds.get("update", 0.0),
        **{f"Perf/{name}_share": value / total for name, value in seconds.items()},
    }
    return {**report.metrics, **rates}


def _progress(
    trainer: Trainer,
    budget: Budget,
    report: Report,
    metrics: dict[str, float],
    elapsed: float,
    first_step: int,
) -> Progress:
    iterations = budget.iterations(trainer)
    rate = (trainer.env_steps - first_step) / max(elapsed, 1e-9)
    remaining = (iterations - trainer.iteration) * trainer.steps_per_iteration / max(rate, 1e-9)
    return Progress(trainer.iteration, iterations, trainer.env_steps, elapsed, remaining, rate, report.seconds, metrics)


def _require_stable(diverged: float, trainer: Trainer) -> None:
    share = diverged / trainer.steps_per_iteration
    if share > DIVERGED_SHARE:
        raise DivergedError(
            f"the simulation diverged in {share:.1%} of the environment steps of iteration {trainer.iteration}",
            hint="lower sim.dt, limit actuator efforts, add joint damping or armature",
        )
