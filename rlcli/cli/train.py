"""`rlcli train TASK`: configuration -> run folder -> environment and trainer -> the loop."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import checkpoints, runs, tasks, words
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
    draw_seed,
    flags,
    tell_notes,
)

if TYPE_CHECKING:
    from rlcli.rl.job import Job
    from rlcli.rl.stop import StopRequest


def command(
    task: Annotated[
        str | None,
        typer.Argument(autocompletion=tasks, help="A task's name, distribution:name, or a folder with a task.yaml."),
    ] = None,
    overrides: Overrides = None,
    agent: Agent = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=-1, max=MAX_SEED, help="Seed of everything random; -1 draws one; default 42."),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option("--seeds", help="Several seeds, a run each, in one study folder: 0..4 or 1,5,9.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", min=1, help="With --seeds: trainings at a time; default 1.")
    ] = None,
    num_envs: NumEnvs = None,
    max_iterations: Annotated[int | None, typer.Option("--max-iterations", help="Iterations to train for.")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", help="Environment steps to train for.")] = None,
    device: Device = "auto",
    gpus: Annotated[
        int | None, typer.Option("--gpus", min=1, help="Processes on this machine, a GPU each; num_envs is of each.")
    ] = None,
    logger: Annotated[
        list[str] | None,
        typer.Option(
            "--logger",
            autocompletion=words("tensorboard", "wandb", "mlflow", "trackio", "none"),
            help="tensorboard, wandb, mlflow, trackio or none; repeatable.",
        ),
    ] = None,
    video_every: Annotated[
        int | None,
        typer.Option(
            "--video-every",
            min=0,
            help="Film an episode every N iterations, in an environment of its own, into RUN/videos; 0: never.",
        ),
    ] = None,
    config: ConfigFile = None,
    resume: Annotated[
        str | None,
        typer.Option(
            "--resume", autocompletion=runs, help="Go on with a run: RUN, RUN@step:N or latest. Needs no TASK."
        ),
    ] = None,
    init_from: Annotated[
        str | None,
        typer.Option("--init-from", autocompletion=checkpoints, help="Start a new run from a checkpoint's weights."),
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
    from rlcli.cli.children import on_leash
    from rlcli.cli.jobs import agree, created, fitting_device, process_device, require_parallel, resumed
    from rlcli.config.load import resolve
    from rlcli.errors import Stopped, UsageError
    from rlcli.machine import wait_calmly
    from rlcli.rl import distributed
    from rlcli.rl.run import default_runs_dir
    from rlcli.rl.stop import StopRequest
    from rlcli.rl.trust import named_task

    on_leash()
    wait_calmly()
    console.follows = not distributed.leads()
    runs, budget = runs_dir or default_runs_dir(), _budget(max_iterations, max_steps)
    several = _several(seeds, jobs, seed, gpus, resume, runs)
    wanted, device = device, process_device(device, gpus)
    fixed = {
        "--agent": agent,
        "--seed": seed,
        "--seeds": seeds,
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
        require_parallel(resolved, gpus or 1)
        device = fitting_device(resolved, device, wanted)
    if gpus is not None and gpus > 1 and not distributed.launched():
        raise typer.Exit(distributed.launch(gpus, sys.argv[1:]))

    if isinstance(several, Path):
        from rlcli.cli.seeds import train_all

        more = {"--max-iterations": max_iterations, "--max-steps": max_steps, "--video-every": video_every}
        words = [word for flag, value in more.items() if value is not None for word in (flag, str(value))]
        words += [word for one in logger or [] for word in ("--logger", one)]
        place = None if wanted == "auto" else device
        train_all(several, place, jobs or 1, stop, longer=bool(budget), words=words)
        return
    if several is not None:
        from rlcli.cli.seeds import create, train_all

        assert resolved is not None  # --seeds begins a study; one that goes on is a folder
        how = {"logger": logger, "init_from": init_from, "video_every": video_every}
        folder = create(resolved, runs, name, {"device": device}, several, **how)
        train_all(folder, device, jobs or 1, stop)
        return

    def begin() -> Job | None:
        if resolved is None:
            assert resume is not None
            return resumed(resume, runs, named, budget, logger, video_every)
        record = {"seed": draw_seed(42 if seed is None else seed), "device": device}
        return created(resolved, runs, name, record, logger, init_from, video_every)

    with stop:
        try:
            job = agree(begin, resolved, named, budget, device)
            if job is not None:
                _train(job, device, stop)
        except KeyboardInterrupt:  # the second one, wherever it came
            raise Stopped("stopped at once", exit_code=stop.exit_code) from None
        finally:
            distributed.leave()


def _several(
    seeds: str | None, jobs: int | None, seed: int | None, gpus: int | None, resume: str | None, runs: Path
) -> list[int] | Path | None:
    """The seeds of a new study, or the folder of one that goes on; None for a single training."""
    from rlcli.errors import UsageError
    from rlcli.rl import distributed
    from rlcli.rl.run import STUDY
    from rlcli.rl.study import read_seeds

    study = None
    if resume is not None:
        study = next((place for place in (Path(resume), runs / resume) if (place / STUDY).is_file()), None)
    if seeds is None and study is None:
        if jobs is not None:
            raise UsageError("--jobs is of several trainings", hint="--seeds 0..4 --jobs 2")
        return None
    if seed is not None or gpus is not None or distributed.launched():
        other = "--seed" if seed is not None else "--gpus"
        raise UsageError(f"--seeds and {other} contradict each other", hint=f"leave out {other}")
    return study if seeds is None else read_seeds(seeds)


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


def _train(job: Job, device: str, stop: StopRequest) -> None:
    from rlcli.cli.live import TrainingView
    from rlcli.rl import distributed

    run = job.run
    try:
        with stop.before_training(prompt=not distributed.launched()):
            from rlcli.rl.build import build
            from rlcli.rl.conduct import conduct
            from rlcli.rl.dump import Watch

            trainer, env = build(job, device, console.info)
    except BaseException:
        if job.created and job.writes:
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
        Watch(env, run.folder / "dumps", console.warn)
    try:
        conduct(job, trainer, env, stop, TrainingView(f"rlcli train {job.resolved.source.name}"), console.warn)
    finally:
        run.unlock()
        env.close()
    _warn_physics(env)
    if job.writes:
        _report(job, trainer)


def _report(job: Job, trainer: Any) -> None:
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


def _warn_physics(env: Any) -> None:
    advice = {
        "contact_full": "contacts were dropped; enlarge <size memory=...> in the MJCF",
        "constraint_full": "constraints were dropped; enlarge <size memory=...> in the MJCF",
        "inertia": "a body's inertia is nearly singular; check masses and sizes in the MJCF",
    }
    for name, count in env.engine.warnings.items():
        if count:
            console.warn(f"{count} times: {advice[name]}")
