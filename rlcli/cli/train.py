"""`rlcli train TASK`: configuration -> run folder -> environment and trainer -> the loop."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import (
    MAX_SEED,
    Agent,
    ConfigFile,
    Debug,
    Device,
    Headless,
    Json,
    NumEnvs,
    Overrides,
    Quiet,
    RunsDir,
    Verbose,
    choose_device,
    draw_seed,
    flags,
    tell_notes,
)

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.registry import TaskSource
    from rlcli.rl.run import Run
    from rlcli.rl.stop import StopRequest


def command(
    task: Annotated[
        str | None, typer.Argument(help="A task's name, distribution:name, or a folder with a task.yaml.")
    ] = None,
    overrides: Overrides = None,
    agent: Agent = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=-1, max=MAX_SEED, help="Seed of everything random; -1 draws one; default 42."),
    ] = None,
    num_envs: NumEnvs = None,
    max_iterations: Annotated[int | None, typer.Option("--max-iterations", help="Iterations to train for.")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", help="Environment steps to train for.")] = None,
    device: Device = "auto",
    gpus: Annotated[
        int | None, typer.Option("--gpus", min=1, help="Processes on this machine, a GPU each; num_envs is of each.")
    ] = None,
    logger: Annotated[list[str] | None, typer.Option("--logger", help="tensorboard or none; repeatable.")] = None,
    config: ConfigFile = None,
    resume: Annotated[
        str | None, typer.Option("--resume", help="Go on with a run: RUN, RUN@step:N or latest. Needs no TASK.")
    ] = None,
    init_from: Annotated[
        str | None, typer.Option("--init-from", help="Start a new run from a checkpoint's weights.")
    ] = None,
    runs_dir: RunsDir = None,
    name: Annotated[str | None, typer.Option("--name", help="Part of the run folder's name.")] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
    headless: Headless = True,
) -> None:
    """Train a policy."""
    from rlcli.config.load import resolve
    from rlcli.errors import Stopped, UsageError
    from rlcli.rl import distributed
    from rlcli.rl.run import default_runs_dir
    from rlcli.rl.stop import StopRequest
    from rlcli.rl.trust import named_task

    console.quiet, console.verbose = quiet, verbose
    # libgomp's threads spin while they wait; on a busy machine that makes an update ten times slower
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    console.follows = not distributed.leads()
    runs, budget = runs_dir or default_runs_dir(), _budget(max_iterations, max_steps)
    wanted, device = device, _device(device, gpus)
    fixed = {
        "--agent": agent,
        "--seed": seed,
        "--num-envs": num_envs,
        "--config": config,
        "--init-from": init_from,
        "--name": name,
    }
    named = None if task is None or (resume is not None and "=" in task) else named_task(task)
    resolved, stop = None, StopRequest(ends_process=console.owns_process)
    if resume is not None:
        _refuse_changes([task, *(overrides or [])], fixed)
    elif named is None:
        raise UsageError("which task?", hint="rlcli train TASK (rlcli list-tasks shows them), or --resume RUN")
    else:
        with stop, stop.before_training():
            resolved = resolve(
                named,
                agent=agent,
                device=device,
                config_file=config,
                overrides=overrides or [],
                flags={**flags(scene__num_envs=num_envs), **budget},
            )
        tell_notes(resolved)
        _require_parallel(resolved, gpus or 1)
        device = _fitting(resolved, device, wanted)
    if gpus is not None and gpus > 1 and not distributed.launched():
        raise typer.Exit(distributed.launch(gpus, sys.argv[1:]))

    def begin() -> _Job | None:
        if resolved is None:
            assert resume is not None
            return _resumed(resume, runs, named, budget, logger)
        record = {"seed": draw_seed(42 if seed is None else seed), "device": device}
        return _created(resolved, runs, name, record, logger, init_from)

    with stop:
        try:
            job = _together(begin, resolved, named, budget, device)
            if job is not None:
                _train(job, device, stop)
        except KeyboardInterrupt:  # the second one, wherever it came
            raise Stopped("stopped at once", exit_code=stop.exit_code) from None
        finally:
            distributed.leave()


@dataclass(slots=True)
class _Job:
    """A locked run with what it trains."""

    run: Run
    resolved: Resolved
    loggers: list[str]
    resume_from: Any = None
    """The checkpoint to go on from exactly."""
    created: bool = True
    """Whether the run's folder was made for this job; one that was killed before its first checkpoint begins again."""
    init_from: Any = None
    """The checkpoint folder to take weights from."""
    stages: list[int] = field(default_factory=list)
    """Iterations to save at, the last one to end at, instead of the agent's budget and what it keeps."""
    config: str | None = None
    """The configuration of a run that goes on, where its budget changes."""
    writes: bool = True
    """Whether this process writes the run."""
    begin: float = field(default_factory=time.monotonic)

    def word(self) -> dict[str, Any]:
        """What other processes need to know of it."""
        return {
            "run": str(self.run.folder),
            "record": self.run.record,
            "resume_from": None if self.resume_from is None else str(self.resume_from.folder),
            "created": self.created,
            "init_from": self.init_from,
        }


def _device(wanted: str, gpus: int | None) -> str:
    """The device of this process."""
    from rlcli.errors import DeviceError, UsageError
    from rlcli.rl import distributed

    several = gpus is not None or distributed.launched()
    if gpus is not None and wanted == "auto":
        wanted = "cuda"
    if gpus is not None and wanted != "cuda":
        raise UsageError(f"--gpus {gpus} and --device {wanted} contradict each other", hint="--gpus alone")
    device = choose_device(wanted)
    if not several or device == "cpu" or ":" in wanted:
        return device
    import torch

    number, processes = distributed.local()
    need, have = max(gpus or 1, processes), torch.cuda.device_count()
    if have < need:
        raise DeviceError(f"{need} processes need a GPU each, and torch sees {have}", hint=f"--gpus {have}")
    return f"cuda:{number}"


def _fitting(resolved: Resolved, device: str, wanted: str) -> str:
    """The device, or the CPU where the GPU was not asked for and the trainer cannot use it."""
    from rlcli.errors import UsageError

    assert resolved.agent is not None
    assert resolved.trainer is not None
    if device == "cpu" or resolved.trainer.gpu:
        return device
    if wanted == "auto":
        return "cpu"
    raise UsageError(
        f"agent '{resolved.agent_name}' (trainer {resolved.agent.trainer}) trains on the CPU only, not on '{device}'",
        hint="--device cpu, or an agent whose trainer uses the GPU (trainer: ppo)",
    )


def _require_parallel(resolved: Resolved, gpus: int = 1) -> None:
    from rlcli.errors import UsageError
    from rlcli.rl import distributed

    resolved.require_agent()
    assert resolved.agent is not None
    assert resolved.trainer is not None
    if (gpus > 1 or distributed.launched()) and not resolved.trainer.parallel:
        raise UsageError(
            f"trainer '{resolved.agent.trainer}' of agent '{resolved.agent_name}' trains in one process",
            hint="name an agent of trainer ppo with --agent",
        )


def _together(
    begin: Callable[[], _Job | None],
    resolved: Resolved | None,
    named: TaskSource | None,
    budget: dict[str, Any],
    device: str,
) -> _Job | None:
    """What is to be done: the process that leads says it, the others hear it."""
    from rlcli.rl import distributed

    if not distributed.leads():
        return _followed(distributed.join(device).share(), resolved, named, budget)
    try:
        job = begin()
    except Exception:
        distributed.join(device).share(None)  # the others wait for word
        raise
    try:
        peers = distributed.join(device)
        if job is not None and peers.size > 1 and job.created:
            job.run.update(processes=peers.size)
        peers.share(None if job is None else job.word())
    except BaseException:
        if job is not None and job.created:
            job.run.discard()
        raise
    return job


def _followed(
    word: dict[str, Any] | None, resolved: Resolved | None, named: TaskSource | None, budget: dict[str, Any]
) -> _Job | None:
    """The job of a process that does not lead: nothing of it is written."""
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.load import resolve_run
    from rlcli.rl.run import Run, open_run

    if word is None:
        return None
    folder = Path(word["run"])
    if resolved is not None:
        return _Job(Run(folder, word["record"]), resolved, [], init_from=word["init_from"], writes=False)
    run = open_run(folder)
    resolved = resolve_run(run, play=False, flags=budget, named=named)
    saved = None if word["resume_from"] is None else open_checkpoint(Path(word["resume_from"]))
    return _Job(
        run, resolved, [], resume_from=saved, created=word["created"], init_from=word["init_from"], writes=False
    )


def _budget(max_iterations: int | None, max_steps: int | None) -> dict[str, Any]:
    """A budget on the command line replaces the agent's whole budget."""
    if max_iterations is None and max_steps is None:
        return {}
    return {"agent.max_iterations": max_iterations, "agent.max_steps": max_steps}


def _refuse_changes(words: Sequence[str | None], fixed: dict[str, Any]) -> None:
    from rlcli.errors import UsageError

    changes = [word for word in words if word and "=" in word]
    changes += [flag for flag, value in fixed.items() if value is not None]
    if changes:
        raise UsageError(
            f"a resumed run keeps its configuration: {', '.join(changes)} cannot be given with --resume"
            " (--max-iterations and --max-steps can)",
            hint="--init-from starts a new run from its weights",
        )


def _created(
    resolved: Resolved,
    runs: Path,
    name: str | None,
    record: dict[str, Any],
    logger: list[str] | None,
    init_from: str | None,
) -> _Job:
    """A new run, its folder written before anything heavy is imported."""
    from rlcli.config.dump import given, to_data, to_yaml
    from rlcli.rl.environment import environment_record, file_digest
    from rlcli.rl.loggers import check_loggers
    from rlcli.rl.run import create_run, find_checkpoint

    loggers = check_loggers(logger)
    initial = None
    if init_from is not None:
        _, initial, why = find_checkpoint(init_from, runs, tell=console.warn)
        console.info(f"weights of {initial} ({why})")
    record |= {
        "task": resolved.source.record() | {"file": resolved.source.config.name},
        "agent": resolved.agent_name,
        "loggers": loggers,
        "init_from": str(initial) if initial else None,
        "init_from_sha256": file_digest(initial / "policy.safetensors") if initial else None,
        "given": given(resolved),
        **environment_record(resolved, *_threads(resolved)),
    }
    run = create_run(runs, resolved.source.name, name, to_yaml(to_data(resolved)), record)
    console.info(f"run {run.folder}")
    return _Job(run, resolved, loggers, init_from=initial)


def _resumed(
    reference: str, runs: Path, named: TaskSource | None, budget: dict[str, Any], logger: list[str] | None
) -> _Job | None:
    """A run to go on with; None if there is nothing left to do."""
    from rlcli.config.dump import to_data, to_yaml
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.load import resolve_run
    from rlcli.rl.loggers import check_loggers
    from rlcli.rl.run import require_own

    run, folder, why = _where_to_begin(reference, runs, None if named is None else named.name)
    if run.record.get("state") == "finished" and not budget and folder is not None:
        console.info(f"{run.folder} ({why}) is finished; --max-iterations N trains on")
        console.data(str(run.folder))
        step = open_checkpoint(folder).step
        console.document("train", run=str(run.folder), state="finished", checkpoint=str(folder), step=step)
        return None
    resolved = resolve_run(run, play=False, flags=budget, named=named)
    _require_parallel(resolved)
    loggers = check_loggers(logger or run.record.get("loggers") or ["none"])
    require_own(run, ".")
    run.lock()
    try:
        from rlcli.rl.saving import clean

        clean(run.checkpoints)
        saved = None if folder is None else open_checkpoint(folder)
    except BaseException:
        run.unlock()
        raise
    if folder is None:
        console.info(f"{run.folder} ({why}) ended before its first checkpoint: it begins again")
    else:
        console.info(f"resuming {folder} ({why})")
    initial = run.record.get("init_from") if folder is None else None
    config = to_yaml(to_data(resolved)) if budget else None
    return _Job(
        run,
        resolved,
        loggers,
        resume_from=saved,
        created=False,
        init_from=Path(initial) if initial else None,
        config=config,
    )


def _where_to_begin(reference: str, runs: Path, task: str | None) -> tuple[Run, Path | None, str]:
    """A run, the checkpoint to go on from, and why; no checkpoint if the run ended before it wrote one."""
    from rlcli.errors import CheckpointError, UsageError
    from rlcli.rl.run import find_checkpoint, find_run

    try:
        return find_checkpoint(reference, runs, task, whole=True, tell=console.warn)
    except CheckpointError:
        try:
            run, why = find_run(reference, runs, task)
        except (CheckpointError, UsageError):
            run = None
        if run is None or not _never_began(run):
            raise
        return run, None, why


def _never_began(run: Run) -> bool:
    """Whether a run's process was killed before the first checkpoint; one that has lost its checkpoints is damaged."""
    from rlcli.rl.checkpoint import steps

    return run.checkpoints.is_dir() and not steps(run.checkpoints) and "step" not in run.record


def _train(job: _Job, device: str, stop: StopRequest) -> None:
    from rlcli.rl import distributed

    run, new = job.run, job.created
    try:
        with stop.before_training(prompt=not distributed.launched()):
            trainer, env = _build(job, device)
    except BaseException:
        if new and job.writes:
            run.discard()
        run.unlock()
        raise
    console.detail(f"built in {time.monotonic() - job.begin:.1f} s")
    size, actions = env.layout.size(), env.layout.action_size
    console.info(
        f"{job.resolved.source.name}: {env.num_envs} environments, {size} observations, {actions} actions,"
        f" {env.engine.threads} engine threads, agent {job.resolved.agent_name}, seed {run.record['seed']}"
    )
    if job.writes:
        from rlcli.rl.dump import Watch

        Watch(env, run.folder / "dumps", console.warn)
    try:
        _fit(job, trainer, env, stop)
    finally:
        run.unlock()
        env.close()
    _warn_physics(env)
    if job.writes:
        _report(job, trainer)


def _build(job: _Job, device: str) -> Any:
    """The environment and the trainer, at the boundary where training begins."""
    from rlcli.envs.vec_env import make_env
    from rlcli.errors import CheckpointError
    from rlcli.random import derive
    from rlcli.registry import load_object
    from rlcli.rl import distributed
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.files import write_atomic
    from rlcli.rl.load import require_fit, require_same_policy, require_trainer
    from rlcli.rl.rng import seed_generators
    from rlcli.rl.saving import drop_after

    resolved, record = job.resolved, job.run.record
    assert resolved.trainer is not None
    assert resolved.agent is not None
    peers, saved = distributed.current(), job.resume_from
    state = None
    if saved is not None:  # what a stranger's files hold shows before anything is built
        require_trainer(saved, resolved.agent.trainer)
        state = saved.state()
    seed_generators(peers.seed(derive(record["seed"], "task"), "task"))  # some tasks draw from them as they are built
    env = make_env(resolved, seed=peers.seed(record["seed"], "environments"), device=device)
    threads = int(record.get("torch_threads") or _threads(resolved)[1])
    make = load_object(resolved.trainer.trainer)
    trainer = make(env, resolved.agent, seed=record["seed"], device=device, torch_threads=threads)
    if saved is None or state is None:
        if job.init_from is not None:
            initial = open_checkpoint(job.init_from)
            require_fit(initial, env.layout)
            require_same_policy(initial, trainer.policy(), resolved.agent.trainer)
            _take(initial, lambda: trainer.load_weights(initial.tensors("policy")), "its weights do not fit the agent")
        if job.config is not None:
            write_atomic(job.run.config, job.config)
        trainer.start()
        return trainer, env
    require_fit(saved, env.layout)
    _take(saved, lambda: trainer.load(state), "it cannot be resumed")
    if (trainer.iteration, trainer.env_steps) != (saved.iteration, saved.step):
        raise CheckpointError(f"{saved.folder} cannot be resumed: its manifest and its state name different steps")
    processes = state.values.get("processes", 1)
    if processes != peers.size:
        console.info(
            f"saved by {processes} processes, going on in {peers.size}: every environment begins a new episode"
        )
    if job.config is not None:  # only now is it sure that the run goes on
        write_atomic(job.run.config, job.config)
    dropped = drop_after(job.run.checkpoints, saved.step) if job.writes else []
    if dropped:
        console.info(f"removed {len(dropped)} later checkpoints: they are not what comes next")
    return trainer, env


def _take(saved: Any, load: Any, failure: str) -> None:
    from rlcli.errors import CheckpointError, RlcliError

    try:
        load()
    except RlcliError:
        raise
    except Exception as error:  # whatever a stranger's numbers lead to
        raise CheckpointError(f"{saved.folder}: {failure}: {' '.join(str(error).split())}") from error


def _fit(job: _Job, trainer: Any, env: Any, stop: StopRequest) -> None:
    from rlcli.cli.live import TrainingView
    from rlcli.errors import RlcliError, Stopped
    from rlcli.rl.loggers import open_loggers
    from rlcli.rl.saving import Keep, Saver
    from rlcli.rl.train import Budget, fit

    run, agent = job.run, job.resolved.agent
    assert agent is not None
    resume = None if job.created else (trainer.iteration, trainer.env_steps)
    manifest = {
        **{key: run.record[key] for key in ("task", "agent", "seed")},
        "trainer": agent.trainer,
        "layout": env.layout.record(),
        "versions": {"rlcli": run.record["rlcli"], **run.record["versions"]},
    }
    keep = Keep() if job.stages else Keep.of(agent.keep_last, agent.keep_every, agent.save_interval)
    budgets = [Budget(end, None) for end in job.stages] or [Budget(agent.max_iterations, agent.max_steps)]
    cases = None
    if job.writes and not job.stages:
        from rlcli.rl.autopsy import open_keeper

        step = None if job.resume_from is None else job.resume_from.step
        cases = open_keeper(env, agent.autopsy, run.folder, step, console.warn)
    saver = Saver(run.checkpoints, keep, manifest, resumed=job.resume_from, cases=cases)
    sinks: list[Any] = []

    def close(state: str) -> None:
        with contextlib.ExitStack() as stack:
            if job.writes and saver.written is not None:
                iteration, step = saver.written
                stack.callback(lambda: run.update(state=state, iteration=iteration, step=step))
            for sink in sinks:
                stack.callback(sink.close)

    try:
        if job.writes:
            unsaved = env.unsaved()
            if unsaved:
                console.warn(f"a resumed run may differ: no checkpoint can hold {', '.join(unsaved)}")
            exact = not unsaved and env.device.type == "cpu"
            run.update(state="running", resumes_exactly=exact, **_environment(job, env, trainer))
            sinks += open_loggers(run, job.loggers, resume=resume)
        trials = _trials(job, saver, stop)
        env.before_step, stop.can_interrupt = stop.check, not env.engine.asynchronous
        with TrainingView(f"rlcli train {job.resolved.source.name}") as view:
            for budget in budgets:
                fit(
                    trainer,
                    run,
                    budget,
                    saver,
                    loggers=sinks,
                    save_interval=agent.save_interval,
                    trials=trials,
                    show=view.show,
                    tell=console.warn,
                    divergences=lambda: env.divergences,
                    stop=stop,
                )
    except BaseException as error:
        with contextlib.suppress(OSError, RlcliError):  # the first error is the one to report
            close("stopped" if isinstance(error, Stopped | KeyboardInterrupt) else "failed")
        raise
    close("finished")


def _environment(job: _Job, env: Any, trainer: Any) -> dict[str, Any]:
    """What run.json says of where the bits are from; of a resumed run what differs from where it began."""
    from rlcli.rl.environment import built_record, differences, environment_record

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
    console.warn(f"resumed in another environment, the bits may differ: {', '.join(changed)}")
    return {"resumed": [*record.get("resumed", []), {"step": trainer.env_steps, "changed": changed}]}


def _trials(job: _Job, saver: Any, stop: StopRequest) -> Any:
    """What evaluates between iterations, if the agent wants it; one process does."""
    from rlcli.envs.vec_env import make_env
    from rlcli.random import derive
    from rlcli.rl.checkpoint import steps
    from rlcli.rl.load import resolve_run
    from rlcli.rl.loggers import read_metrics
    from rlcli.rl.trials import Trials

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


def _report(job: _Job, trainer: Any) -> None:
    from rlcli.rl.checkpoint import steps

    run, elapsed = job.run, time.monotonic() - job.begin
    newest = run.checkpoints / f"{steps(run.checkpoints)[-1]:012d}"
    console.info(f"trained {trainer.env_steps:,} steps in {elapsed:.1f} s; next: rlcli play --checkpoint {run.folder}")
    console.data(str(run.folder))
    console.document(
        "train",
        run=str(run.folder),
        state="finished",
        checkpoint=str(newest),
        iteration=trainer.iteration,
        step=trainer.env_steps,
        elapsed_s=elapsed,
        seed=run.record["seed"],
    )


def _threads(resolved: Resolved) -> tuple[int, int]:
    """Threads of the engine and of torch's update."""
    from rlcli.machine import available_cores

    assert resolved.agent is not None
    cores = available_cores()
    return resolved.task.sim.engine_threads or cores, resolved.agent.torch_threads or min(4, cores)


def _warn_physics(env: Any) -> None:
    advice = {
        "contact_full": "contacts were dropped; enlarge <size memory=...> in the MJCF",
        "constraint_full": "constraints were dropped; enlarge <size memory=...> in the MJCF",
        "inertia": "a body's inertia is nearly singular; check masses and sizes in the MJCF",
    }
    for name, count in env.engine.warnings.items():
        if count:
            console.warn(f"{count} times: {advice[name]}")


def train_again(
    run: Run, resolved: Resolved, init_from: Path | None, stages: list[int], accept: Callable[[dict[str, Any]], None]
) -> int:
    """Train a run that was created, up to the last of some iterations, saved at each: what `reproduce` does.

    `accept` hears what the environment is like once it is built, and raises if that will not do; a run that never
    began is removed. Returns the environment steps taken.
    """
    from rlcli.rl.environment import built_record
    from rlcli.rl.stop import StopRequest

    job = _Job(run, resolved, [], init_from=init_from, stages=stages)
    with StopRequest() as stop:
        try:
            trainer, env = _build(job, "cpu")
            accept(built_record(env.engine.model, "cpu"))
        except BaseException:
            run.discard()
            raise
        try:
            _fit(job, trainer, env, stop)
        finally:
            run.unlock()
            env.close()
    return int(trainer.env_steps)
