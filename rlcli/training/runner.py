"""Function `run_training`, which runs a prepared training to its end.

The function opens loggers and checkpoints, runs the training loop, and records in run.json how the training ended.
"""

from __future__ import annotations

import contextlib
import logging
import shlex
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from rlcli.config.dump import to_data
from rlcli.deploy.env_description import describe
from rlcli.envs.environment_protocol import Environment
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import DivergedError, RlcliError, Stopped, error_with_type
from rlcli.random import derive
from rlcli.replay.crash_dump import CrashDumper
from rlcli.replay.failure_recorder import open_failure_recorder
from rlcli.rl.budget import Budget
from rlcli.rl.trainer import Trainer
from rlcli.runs.checkpoint_reader import steps
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.provenance import built_record, differences, environment_record
from rlcli.runs.recorded_task import resolve_run
from rlcli.runs.run import Run
from rlcli.training.checkpoint_writer import CheckpointWriter, KeepRule, manifest_entries
from rlcli.training.health import Health
from rlcli.training.job import Job, TrainingResult
from rlcli.training.loggers import open_loggers
from rlcli.training.loop import TrainLoop
from rlcli.training.periodic_eval import PeriodicEval
from rlcli.training.progress import Progress
from rlcli.training.signals import StopRequest
from rlcli.training.time_to_threshold import read_threshold, training_s

if TYPE_CHECKING:
    from rlcli.training.trackers import Logger
    from rlcli.viewer.training_video_recorder import TrainingVideos

_log = logging.getLogger(__name__)


class ProgressView(contextlib.AbstractContextManager[Any], Protocol):
    """Context manager that displays the progress of a training."""

    def show(self, progress: Progress) -> None:
        """Display the progress after an iteration."""


def run_training(
    job: Job, trainer: Trainer, env: Environment, stop: StopRequest, view: ProgressView
) -> TrainingResult | None:
    """Train until the budget of a job is spent; an error is recorded in run.json and raised again.

    Args:
        job: run and settings of the training; the run is unlocked at the end.
        trainer: the trainer, in the state in which training starts.
        env: the trainer's environment; it is closed at the end.
        stop: stores whether a signal has requested a stop.
        view: display of the progress.

    Returns:
        The result; None on a rank that does not write the run.

    Raises:
        Stopped, DivergedError, MachineError: see `TrainLoop.train`.
    """
    run, resolved = job.run, job.resolved
    _log.debug("environment and trainer built in %.1f s", time.monotonic() - job.begin)
    size, actions = env.layout.size(), env.layout.action_size
    workers = f" in {env.workers} processes" if env.workers > 1 else ""
    _log.info(
        f"{resolved.source.name}: {env.num_envs} environments, {size} observations, {actions} actions,"
        f" {env.engine.threads} engine threads{workers}, agent {resolved.agent_name}, seed {run.record['seed']}"
    )
    if job.writes:
        CrashDumper(env, run.folder / "dumps")
    first_step = trainer.env_steps
    try:
        loop = _train(job, trainer, env, stop, view)
    finally:
        run.unlock()
        env.close()
    _warn_of_physics(env)
    if not job.writes:
        return None
    newest = Run(run.shown).checkpoints / f"{steps(run.checkpoints)[-1]:012d}"
    elapsed, step, new_steps = time.monotonic() - job.begin, trainer.env_steps, trainer.env_steps - first_step
    ended = loop.metrics, run.record["state"]
    return TrainingResult(run.shown, newest, step, trainer.iteration, elapsed, run.record["seed"], new_steps, *ended)


def _train(job: Job, trainer: Trainer, env: Environment, stop: StopRequest, view: ProgressView) -> TrainLoop:
    """Open loggers and checkpoints, run the loop, and record in the run how it ended.

    Returns:
        The loop, after the training.
    """
    run, (agent, _) = job.run, job.resolved.require_agent()
    budgets = [Budget(end, None) for end in job.stages] or [Budget(agent.max_iterations, agent.max_steps)]
    writer = _open_writer(job, env)
    loggers: list[Logger] = []
    trained_before = run.record.get("trained_s", 0.0)

    def close(state: str, reason: str | None = None) -> None:
        # the stack closes all loggers even if one of them fails, then updates the run
        with contextlib.ExitStack() as stack:
            end: dict[str, Any] = {"state": state, "reason": reason}
            if writer.written is not None:  # without a checkpoint the run has no step, and starts again
                end["iteration"], end["step"] = writer.written
                end["trained_s"] = trained_before + time.monotonic() - job.begin
            if job.writes:
                stack.callback(lambda: run.update(**end))
            for logger in loggers:
                stack.callback(logger.close, state)

    try:
        if job.writes:
            _record_begin(job, trainer, env, budgets[-1])
            resume = None if job.created else (trainer.iteration, trainer.env_steps)
            loggers += open_loggers(run, job.loggers, resume=resume, config=to_data(job.resolved))
        loop = TrainLoop(
            trainer,
            run,
            writer,
            loggers,
            save_interval=agent.save_interval,
            periodic_eval=_periodic_eval(job, writer, stop, budgets[-1].iterations(trainer)),
            videos=_training_videos(job, stop),
            health=_health(job, budgets[-1].iterations(trainer)),
            show=view.show,
            count_divergences=lambda: env.divergences,
            stop=stop,
            deadline=None if agent.max_minutes is None else job.begin + 60.0 * agent.max_minutes,
        )
        env.observers.add(stop)
        stop.can_interrupt = not env.engine.asynchronous
        with view:
            for budget in budgets:
                loop.train(budget)
    except BaseException as error:
        with contextlib.suppress(OSError, RlcliError):  # the first error is the one to report
            close(*_end_state(error))
        raise
    is_done = loop.reached or budgets[-1].spent(trainer)
    close("finished" if is_done else "stopped")
    if not is_done:
        again = f"rlcli train --resume {shlex.quote(str(run.shown))} continues the training"
        _log.info(f"stopped after {agent.max_minutes:g} minutes, in iteration {trainer.iteration}; {again}")
    if job.writes and agent.until is not None:
        _report_bar(run, agent.until, loop.reached)
    # after a passed evaluation, the few episodes that ended in training are mostly failures of older policies
    for note in [] if loop.health is None or loop.reached else loop.health.notes(loop.metrics):
        _log.info("%s", note)
    for finding in run.findings() if job.writes else ():
        _log.warning("at the end of the training: %s", finding)
    return loop


def _open_writer(job: Job, env: Environment) -> CheckpointWriter:
    """Return the writer of checkpoints, with the recorder of failed episodes."""
    run, (agent, _) = job.run, job.resolved.require_agent()
    manifest = manifest_entries(run, agent.trainer, env.layout, describe(env.local))
    keep = KeepRule() if job.stages else KeepRule.from_settings(agent.keep_last, agent.keep_every, agent.save_interval)
    cases = None
    if job.writes and not job.stages:
        step = None if job.resume_from is None else job.resume_from.step
        cases = open_failure_recorder(env, agent.autopsy, run.folder, step)
    return CheckpointWriter(run.checkpoints, keep, manifest, resumed=job.resume_from, cases=cases)


def _record_begin(job: Job, trainer: Trainer, env: Environment, budget: Budget) -> None:
    """Write the start of the training into run.json, and the state that no checkpoint can store, if there is any."""
    unsaved = env.unsaved_state()
    if unsaved:
        names = ", ".join(unsaved)
        _log.warning(
            f"a resumed run may differ from a run without interruption, because no checkpoint can store {names}; keep"
            " the state of the task in numbers, containers, tensors or random generators"
        )
    exact = not unsaved and env.device.type == "cpu"
    job.run.update(state="running", since=datetime.now(UTC).isoformat(), iterations=budget.iterations(trainer))
    job.run.update(resumes_exactly=exact, **_provenance(job, trainer, env))


def _provenance(job: Job, trainer: Trainer, env: Environment) -> dict[str, Any]:
    """Return the entries of run.json that describe machine, versions and compiled model.

    For a resumed run, return only the entry `resumed` with the changes since the run was created; an empty dict if
    nothing has changed.
    """
    record, device = job.run.record, str(env.device)
    built = built_record(env.engine.model, device)
    if job.resume_from is None:
        return built
    now = environment_record(job.resolved, env.engine.threads, record.get("torch_threads") or 0) | built
    now["engine_threads"] = record.get("engine_threads")  # not compared: the number of engine threads changes no bit
    same = env.device.type == str(record.get("device", "cpu")).partition(":")[0]
    now["device"] = record.get("device") if same else device
    changed = {name: after for name, _, after in differences(record, now)}
    if not changed:
        return {}
    _log.warning(
        "the run is resumed on another machine or with other versions, so its results may differ in the last bits: %s",
        ", ".join(changed),
    )
    return {"resumed": [*record.get("resumed", []), {"step": trainer.env_steps, "changed": changed}]}


def _make_play_env(job: Job, purpose: str, flags: dict[str, Any]) -> VecEnv:
    """Return environments of the job's task in play mode (with the task's `play:` changes), with a seed of their own.

    Args:
        job: run and settings of the training.
        purpose: purpose of the environments (`evaluation`, `video`), from which their seed is derived.
        flags: dotted key -> value of further settings.
    """
    resolved = resolve_run(job.run, play=True, flags=flags, named=job.resolved.source)
    return make_env(resolved, seed=derive(job.run.record["seed"], purpose))


def _periodic_eval(job: Job, writer: CheckpointWriter, stop: StopRequest, iterations: int) -> PeriodicEval | None:
    """Return the evaluation every few iterations; None if the agent sets none, and on ranks other than 0."""
    run, (agent, _) = job.run, job.resolved.require_agent()
    until = None if agent.until is None else read_threshold(agent.until)
    if (agent.eval_interval is None and until is None) or not job.writes:
        return None
    interval = agent.eval_interval or max(1, iterations // 20)
    episodes = agent.eval_episodes if until is None else until.episodes(agent.eval_episodes)
    num_envs = min(episodes, job.resolved.task.scene.num_envs)

    def make() -> Environment:
        env = _make_play_env(job, "evaluation", {"scene.num_envs": num_envs})
        env.observers.add(stop)
        return env

    evaluator = PeriodicEval(make, episodes, interval, [*read_rows(run.metrics)], until)
    writer.best = evaluator.best if evaluator.best in steps(run.checkpoints) else None
    # the two differ if the run was killed before it wrote `best`, or is resumed from an earlier step
    if run.record.get("best") != writer.best:
        run.update(best=writer.best)
    return evaluator


def _health(job: Job, iterations: int) -> Health | None:
    """Return the health checks, with the metrics of a resumed run's earlier iterations; None on ranks other than 0."""
    if not job.writes:
        return None
    agent, _ = job.resolved.require_agent()
    health = Health(job.resolved.task, agent, iterations)
    for row in read_rows(job.run.metrics) if job.resume_from is not None else ():
        health.add(row["iteration"], {name: value for name, value in row.items() if "/" in name})
    return health


def _report_bar(run: Run, bar: str, reached: bool) -> None:
    """Log and record the training time and steps until an evaluation reached `bar`, the threshold of `--until`."""
    rows = [*read_rows(run.metrics)]
    seconds, step = sum(map(training_s, rows)), rows[-1]["step"] if rows else 0
    run.update(until={"bar": bar, "reached": reached, "seconds": seconds, "step": step})
    if reached:
        _log.info(f"{bar} reached after {step:,} steps and {seconds:.1f} s of rollouts and updates")
    else:
        why = "in no evaluation was the lower end of the 95 % interval that high"
        _log.warning(f"{bar} was not reached in {step:,} steps: {why}")


def _training_videos(job: Job, stop: StopRequest) -> TrainingVideos | None:
    """Return the recorder of videos; None without `--video-every`, and on ranks other than 0."""
    if not job.video_every or not job.writes:
        return None
    # imported here: most trainings do not need OpenGL and the video modules
    from rlcli.viewer.training_video_recorder import TrainingVideos

    def make() -> VecEnv:
        return _make_play_env(job, "video", {"scene.num_envs": 1, "sim.engine_threads": 1})

    return TrainingVideos(make, job.run.folder / "videos", job.video_every, lambda: stop.signal is not None)


def _end_state(error: BaseException) -> tuple[str, str | None]:
    """Return the state of the run after an error (stopped, diverged or failed), and the reason for run.json."""
    if isinstance(error, Stopped | KeyboardInterrupt):
        return "stopped", None
    message = error_with_type(error)
    return "diverged" if isinstance(error, DivergedError) else "failed", " ".join(message.split())[:500]


def _warn_of_physics(env: Environment) -> None:
    """Log MuJoCo's warnings of the whole training, with advice."""
    advice = {
        "contact_full": "contacts were dropped; enlarge <size memory=...> in the MJCF",
        "constraint_full": "constraints were dropped; enlarge <size memory=...> in the MJCF",
        "inertia": "a body's inertia is nearly singular; check masses and sizes in the MJCF",
    }
    for name, count in env.engine.warnings.items():
        if count:
            _log.warning("MuJoCo warning (%s x): %s", count, advice[name])
