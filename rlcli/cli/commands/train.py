"""Command `rlcli train`: training of a policy, or of several policies with different seeds.

The command starts a new run or resumes one, and shows the progress.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui import options
from rlcli.cli.ui.completion import checkpoints, runs
from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import choice
from rlcli.errors import Stopped, UsageError
from rlcli.formats import log_notes
from rlcli.safe_text import MAX_SEED

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.registry import TaskSource
    from rlcli.training.job import TrainingResult
    from rlcli.training.signals import StopRequest
    from rlcli.training.start_run import TrainingRequest

_GOOD = 0.95
"""Success rate below which the end of a training suggests a comparison with zero actions."""


def command(
    task: options.OptionalTask = None,
    overrides: options.Overrides = None,
    agent: options.Agent = None,
    seed: Annotated[int | None, typer.Option(min=-1, max=MAX_SEED)] = None,
    seeds: Annotated[str | None, typer.Option(metavar="SEEDS")] = None,
    jobs: Annotated[int | None, typer.Option(min=1)] = None,
    num_envs: options.NumEnvs = None,
    max_iterations: options.MaxIterations = None,
    max_steps: options.MaxSteps = None,
    max_minutes: options.MaxMinutes = None,
    until: Annotated[str | None, typer.Option(metavar="KEY=X")] = None,
    device: options.Device = "auto",
    gpus: Annotated[int | None, typer.Option(min=1)] = None,
    logger: Annotated[list[str] | None, choice("LOGGER", "tensorboard", "wandb", "mlflow", "trackio", "none")] = None,
    video_every: Annotated[int | None, typer.Option(min=0)] = None,
    config: options.ConfigFile = None,
    resume: Annotated[str | None, typer.Option(autocompletion=runs, metavar="RUN")] = None,
    init_from: Annotated[str | None, typer.Option(autocompletion=checkpoints, metavar="CHECKPOINT")] = None,
    runs_dir: options.RunsDir = None,
    name: options.RunName = None,
    headless: options.Headless = True,
) -> None:
    """Train a policy.

    Options:
        seed: Seed of all random numbers; -1 picks a random one and records it. [default: 42]
        seeds: Train one run for each of several seeds, in one study folder: 0..4 or 1,5,9.
        jobs: With --seeds: number of trainings at a time. [default: 1]
        until: Stop when success, return or length reaches X with 95 % confidence in an evaluation between iterations,
            as in success=0.97. [default: train the whole budget]
        gpus: Number of processes on this machine, one GPU each; each has its own num_envs environments. [default: 1
            process]
        logger: Where metrics are logged: tensorboard, wandb, mlflow, trackio or none; repeatable. [default: the
            settings' loggers, or tensorboard]
        video_every: Film an episode every N iterations, in a separate environment, into RUN/videos; 0: never.
            [default: 0, or the value of the resumed run]
        resume: Resume a run: RUN, RUN@step:N or latest. Needs no TASK.
        init_from: Start a new run with the weights of a checkpoint.

    Examples:
        rlcli train cartpole --num-envs 64 agent.gamma=0.95
            Train cartpole in 64 environments, with a changed setting of the agent.
        rlcli train --resume latest --max-iterations 500
            Resume the newest run until iteration 500.
    """
    from rlcli.config.layers import flags
    from rlcli.machine.processes import limit_openmp_spinning
    from rlcli.rl import distributed
    from rlcli.runs.run_ref import default_runs_dir
    from rlcli.training.signals import StopRequest
    from rlcli.training.start_run import TrainingRequest, process_device
    from rlcli.training.train_commands import stop_with_parent

    stop_with_parent()
    limit_openmp_spinning()
    console.muted = not distributed.is_rank_zero()
    request = TrainingRequest(runs_dir or default_runs_dir(), None, resume, agent, device, gpus, config)
    request.overrides, request.flags = overrides or [], flags(scene__num_envs=num_envs)
    request.budget = options.budget_keys(max_iterations, max_steps, until, max_minutes)
    request.seed = options.random_if_minus_one(42 if seed is None else seed)
    request.loggers, request.init_from, request.video_every, request.name = logger, init_from, video_every, name
    study = _study(request, seeds, jobs, seed)
    process = process_device(device, gpus)
    request.source = _source(task, request, seed, seeds)
    resolved, stop = None, StopRequest(ends_process=console.owns_process)
    if resume is None:
        with stop, stop.before_training():
            resolved, process = request.resolve()
        log_notes(resolved.notes)
    if gpus is not None and gpus > 1 and not distributed.launched():
        raise typer.Exit(distributed.launch(gpus, sys.argv[1:]))
    if study is not None:
        _train_seeds(study, request, resolved, process, jobs or 1, stop)
    else:
        _train(request, resolved, process, stop)


def _study(request: TrainingRequest, seeds: str | None, jobs: int | None, seed: int | None) -> list[int] | Path | None:
    """Return the seeds of a new study, or the folder of a study to resume; None for a single training.

    A study is a folder with one run for each seed of --seeds.

    Raises:
        UsageError: for options that contradict each other, such as --seed and --seeds.
    """
    from rlcli.rl import distributed
    from rlcli.runs.run import STUDY
    from rlcli.runs.study import read_seeds

    study = None
    if request.resume is not None:
        folders = (Path(request.resume), request.runs / request.resume)
        study = next((folder for folder in folders if (folder / STUDY).is_file()), None)
    if seeds is None and study is None:
        if jobs is not None:
            raise UsageError(
                "--jobs sets how many trainings run at once, but there is only one training",
                hint="add --seeds, as in --seeds 0..4 --jobs 2, or leave out --jobs",
            )
        return None
    given = "--seed" if seed is not None else None if request.gpus is None else "--gpus"
    if given is not None and seeds is not None:
        raise UsageError(f"{given} cannot be combined with --seeds", hint=f"leave out {given}")
    if given is not None:
        own = "its own seeds" if given == "--seed" else "one process per seed"
        raise UsageError(f"{study} is a study with {own}", hint=f"leave out {given}")
    if distributed.launched():
        raise UsageError(
            "--seeds starts one process for each seed, so rlcli itself must be a single process",
            hint="start rlcli without torchrun",
        )
    return study if seeds is None else read_seeds(seeds)


def _source(task: str | None, request: TrainingRequest, seed: int | None, seeds: str | None) -> TaskSource | None:
    """Return the task to train; None if a run is resumed and no task is named.

    Raises:
        UsageError: without a task, or if --resume is combined with changes of the configuration.
    """
    from rlcli.runs.trusted_tasks import named_task

    if request.resume is None:
        if task is None:
            raise UsageError("no task given", hint="name a task (`rlcli list-tasks` shows all), or give --resume RUN")
        return named_task(task)
    source = None if task is None or "=" in task else named_task(task)
    changes = [word for word in [task, *request.overrides] if word and "=" in word]
    num_envs = request.flags.get("scene.num_envs")
    only_new = {"--agent": request.agent, "--seed": seed, "--seeds": seeds, "--num-envs": num_envs}
    only_new |= {"--config": request.config, "--init-from": request.init_from, "--name": request.name}
    changes += [option for option, value in only_new.items() if value is not None]
    if changes:
        raise UsageError(
            f"a resumed run keeps its configuration: {', '.join(changes)} cannot be given with --resume"
            " (--max-iterations, --max-steps, --max-minutes and --until can)",
            hint="to change them, start a new run with the old run's weights: --init-from RUN",
        )
    return source


def _train(request: TrainingRequest, resolved: Resolved | None, device: str, stop: StopRequest) -> None:
    """Train one run, in one process or as one rank of several."""
    from rlcli.cli.ui.progress_view import TrainingView
    from rlcli.rl import distributed
    from rlcli.training.job import Job
    from rlcli.training.start_run import broadcast_job, setup_job

    with stop:
        try:
            result = broadcast_job(request, resolved, device)
            if isinstance(result, Job):
                job = result
                trainer, env = setup_job(job, device, stop)
                from rlcli.training.runner import run_training

                view = TrainingView(f"rlcli train {job.resolved.source.name}")
                result = run_training(job, trainer, env, stop, view)
            if result is not None:
                _print(result)
        except KeyboardInterrupt:  # a second signal, at any point of the training
            raise Stopped(
                "stopped without a new checkpoint; --resume continues from the last one", exit_code=stop.exit_code
            ) from None
        finally:
            distributed.leave()


def _print(result: TrainingResult) -> None:
    if result.elapsed_s is not None:
        total = "" if result.new_steps == result.step else f", {result.step:,} in the whole run"
        console.info(
            f"trained {result.new_steps:,} steps in {result.elapsed_s:.1f} s{total};"
            f" next: rlcli play --checkpoint {result.run}"
        )
    for line in _next_steps(result):
        console.info(line)
    console.data(str(result.run))
    training = {"iteration": result.iteration, "elapsed_s": result.elapsed_s, "seed": result.seed}
    console.document(
        "train",
        run=str(result.run),
        state=result.state,
        checkpoint=str(result.checkpoint),
        step=result.step,
        **{name: value for name, value in training.items() if value is not None},
    )


def _next_steps(result: TrainingResult) -> list[str]:
    """Return messages with the last success rate or return, and with the commands that evaluate the policy."""
    from rlcli.runs.overview import newest_rows
    from rlcli.runs.run import Run
    from rlcli.training.progress import no_episode_note

    kind = "Eval" if "Eval/mean_reward" in result.metrics else "Train"  # Eval: the last iteration was evaluated
    success, mean_return = (result.metrics.get(f"{kind}/{name}") for name in ("success_rate", "mean_reward"))
    if mean_return is None:
        return []
    figure = f"return {mean_return:.4g}" if success is None else f"success {success:.1%}"
    run = shlex.quote(str(result.run))
    if kind == "Eval":
        lines = [f"{figure} in the last evaluation, without exploration noise; repeat: rlcli eval --checkpoint {run}"]
    else:
        old = no_episode_note(newest_rows(Run(result.run)) or [result.metrics])
        counts = f"counts the last episodes of the training{old and f' ({old})'}, with exploration noise"
        lines = [f"{figure} {counts}; without noise: rlcli eval --checkpoint {run}"]
    if success is None or success < _GOOD:
        lines.append(f"to compare the policy with zero actions: rlcli eval --compare {run} zero")
    return lines


def _train_seeds(
    study: list[int] | Path,
    request: TrainingRequest,
    resolved: Resolved | None,
    device: str,
    jobs: int,
    stop: StopRequest,
) -> None:
    """Train the runs of a new study, or the unfinished runs of a resumed one."""
    from rlcli.cli.ui.several_trainings import SeedsView, print_study
    from rlcli.tuning.train_seeds import new_study, resume_options, train_seeds

    if isinstance(study, Path):
        chosen = None if request.device == "auto" else device
        result = train_seeds(study, chosen, jobs, stop, SeedsView, bool(request.budget), resume_options(request))
    else:
        assert resolved is not None
        result = train_seeds(new_study(request, resolved, device, study), device, jobs, stop, SeedsView)
    print_study(result)
    if result.exit_code:
        raise typer.Exit(result.exit_code)
