"""Training a job: its run is opened for writing, the loop runs, and the run says how it ended."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rlcli.config.dump import to_data
from rlcli.envs.deployment import describe
from rlcli.envs.vec_env import make_env
from rlcli.errors import DivergedError, RlcliError, Stopped
from rlcli.random import derive
from rlcli.rl.autopsy import open_keeper
from rlcli.rl.build import build
from rlcli.rl.checkpoint import steps
from rlcli.rl.environment import built_record, differences, environment_record
from rlcli.rl.job import Job
from rlcli.rl.load import resolve_run
from rlcli.rl.loggers import open_loggers, read_metrics
from rlcli.rl.progress import Progress
from rlcli.rl.run import Run
from rlcli.rl.saving import Keep, Saver
from rlcli.rl.stop import StopRequest
from rlcli.rl.train import Budget, fit
from rlcli.rl.trials import Trials

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.rl.trainer import Trainer
    from rlcli.viewer.clips import Clips


class View(Protocol):
    """Shows how training goes on; used as a context."""

    def show(self, progress: Progress) -> None:
        """Take in one iteration."""
        ...

    def __enter__(self) -> Any: ...

    def __exit__(self, *_: Any) -> None: ...


def conduct(job: Job, trainer: Trainer, env: Any, stop: StopRequest, view: View, tell: Callable[[str], None]) -> None:
    """Train until the job's budget is spent; what `fit` raises is noted in the run first.

    Args:
        job: what is trained.
        trainer: its trainer, at the boundary where training begins.
        env: where it learns.
        stop: whether somebody asks to stop.
        view: shows each iteration.
        tell: hears what the user should know, but what stops nothing.
    """
    run, agent = job.run, job.resolved.agent
    assert agent is not None
    resume = None if job.created else (trainer.iteration, trainer.env_steps)
    manifest = {
        **{key: run.record[key] for key in ("task", "agent", "seed")},
        "trainer": agent.trainer,
        "layout": env.layout.record(),
        "deployment": describe(env),
        "versions": {"rlcli": run.record["rlcli"], **run.record["versions"]},
    }
    keep = Keep() if job.stages else Keep.of(agent.keep_last, agent.keep_every, agent.save_interval)
    budgets = [Budget(end, None) for end in job.stages] or [Budget(agent.max_iterations, agent.max_steps)]
    cases = None
    if job.writes and not job.stages:
        begun = None if job.resume_from is None else job.resume_from.step
        cases = open_keeper(env, agent.autopsy, run.folder, begun, tell)
    saver = Saver(run.checkpoints, keep, manifest, resumed=job.resume_from, cases=cases)
    sinks: list[Any] = []
    trained = run.record.get("trained_s", 0.0)

    def close(state: str, reason: str | None = None) -> None:
        with contextlib.ExitStack() as stack:
            if job.writes and saver.written is not None:
                iteration, step = saver.written
                ended = {"state": state, "reason": reason, "trained_s": trained + time.monotonic() - job.begin}
                stack.callback(lambda: run.update(**ended, iteration=iteration, step=step))
            for sink in sinks:
                stack.callback(sink.close, state)

    try:
        if job.writes:
            unsaved = env.unsaved()
            if unsaved:
                tell(f"a resumed run may differ: no checkpoint can hold {', '.join(unsaved)}")
            exact = not unsaved and env.device.type == "cpu"
            run.update(state="running", since=datetime.now(UTC).isoformat(), iterations=budgets[-1].iterations(trainer))
            run.update(resumes_exactly=exact, **_environment(job, env, trainer, tell))
            sinks += open_loggers(run, job.loggers, resume=resume, config=to_data(job.resolved), tell=tell)
        trials = _trials(job, saver, stop)
        clips = _clips(job, stop, tell)
        env.before_step, stop.can_interrupt = stop.check, not env.engine.asynchronous
        with view:
            for budget in budgets:
                fit(
                    trainer,
                    run,
                    budget,
                    saver,
                    loggers=sinks,
                    save_interval=agent.save_interval,
                    trials=trials,
                    clips=clips,
                    show=view.show,
                    tell=tell,
                    divergences=lambda: env.divergences,
                    stop=stop,
                )
    except BaseException as error:
        with contextlib.suppress(OSError, RlcliError):  # the first error is the one to report
            close(*_ending(error))
        raise
    close("finished")


def _ending(error: BaseException) -> tuple[str, str | None]:
    """The state that an error leaves a run in, and the reason."""
    if isinstance(error, Stopped | KeyboardInterrupt):
        return "stopped", None
    said = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
    return "diverged" if isinstance(error, DivergedError) else "failed", " ".join(said.split())[:500]


def _environment(job: Job, env: Any, trainer: Trainer, tell: Callable[[str], None]) -> dict[str, Any]:
    """What run.json says of where the bits are from; of a resumed run what differs from where it began."""
    record, device = job.run.record, str(env.device)
    built = built_record(env.engine.model, device)
    if job.resume_from is None:
        return built
    now = environment_record(job.resolved, env.engine.threads, record.get("torch_threads") or 0) | built
    now["engine_threads"] = record.get("engine_threads")  # as many as there are; they change no bit
    same = env.device.type == str(record.get("device", "cpu")).partition(":")[0]
    now["device"] = record.get("device") if same else device
    changed = {name: after for name, _, after in differences(record, now)}
    if not changed:
        return {}
    tell(f"resumed in another environment, the bits may differ: {', '.join(changed)}")
    return {"resumed": [*record.get("resumed", []), {"step": trainer.env_steps, "changed": changed}]}


def _trials(job: Job, saver: Saver, stop: StopRequest) -> Trials | None:
    """What evaluates between iterations, if the agent wants it; one process does."""
    run, agent = job.run, job.resolved.agent
    assert agent is not None
    if agent.eval_interval is None or not job.writes:
        return None

    def make() -> Any:
        num_envs = min(agent.eval_episodes, job.resolved.task.scene.num_envs)
        resolved = resolve_run(run, play=True, flags={"scene.num_envs": num_envs}, named=job.resolved.source)
        env = make_env(resolved, seed=derive(run.record["seed"], "evaluation"))
        env.before_step = stop.check
        return env

    trials = Trials(make, agent.eval_episodes, agent.eval_interval, read_metrics(run.metrics))
    saver.best = trials.best if trials.best in steps(run.checkpoints) else None
    if run.record.get("best") != saver.best:  # killed in between, or resumed from before it
        run.update(best=saver.best)
    return trials


def _clips(job: Job, stop: StopRequest, tell: Callable[[str], None]) -> Clips | None:
    """What films between iterations, if the user wants it; one process does."""
    run, interval = job.run, job.video_every
    if not interval or not job.writes:
        return None
    from rlcli.viewer.clips import Clips  # nothing of drawing is read otherwise

    def make() -> Any:
        alone = {"scene.num_envs": 1, "sim.engine_threads": 1}
        resolved = resolve_run(run, play=True, flags=alone, named=job.resolved.source)
        return make_env(resolved, seed=derive(run.record["seed"], "video"))

    return Clips(make, run.folder / "videos", interval, tell, lambda: stop.signal is not None)


def train_again(
    run: Run,
    resolved: Resolved,
    init_from: Path | None,
    stages: list[int],
    accept: Callable[[dict[str, Any]], None],
    view: View,
    tell: Callable[[str], None],
) -> int:
    """Train a run that was created, up to the last of some iterations, saved at each: what `reproduce` does.

    `accept` hears what the environment is like once it is built, and raises if that will not do; a run that never
    began is removed. Returns the environment steps taken.
    """
    job = Job(run, resolved, [], init_from=init_from, stages=stages)
    with StopRequest() as stop:
        try:
            trainer, env = build(job, "cpu")
            accept(built_record(env.engine.model, "cpu"))
        except BaseException:
            run.discard()
            raise
        try:
            conduct(job, trainer, env, stop, view, tell)
        finally:
            run.unlock()
            env.close()
    return int(trainer.env_steps)
