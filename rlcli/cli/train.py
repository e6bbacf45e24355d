"""`rlcli train TASK`: configuration -> run folder -> environment and trainer -> the loop."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import (
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
    Seed,
    Verbose,
    choose_device,
    draw_seed,
    flags,
)


def command(
    task: Annotated[
        str | None, typer.Argument(help="A task's name, distribution:name, or a folder with a task.yaml.")
    ] = None,
    overrides: Overrides = None,
    agent: Agent = None,
    seed: Seed = 42,
    num_envs: NumEnvs = None,
    max_iterations: Annotated[int | None, typer.Option("--max-iterations", help="Iterations to train for.")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", help="Environment steps to train for.")] = None,
    device: Device = "auto",
    logger: Annotated[list[str] | None, typer.Option("--logger", help="tensorboard or none; repeatable.")] = None,
    config: ConfigFile = None,
    resume: Annotated[
        str | None, typer.Option("--resume", help="Go on with a run: RUN or latest. Needs no TASK.")
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
    from rlcli.errors import UsageError
    from rlcli.rl.run import default_runs_dir

    console.quiet, console.verbose = quiet, verbose
    chosen = choose_device(device)
    folder = runs_dir or default_runs_dir()
    budget = flags(agent__max_iterations=max_iterations, agent__max_steps=max_steps)
    if resume is not None:
        given = [word for word in (*([task] if task and "=" in task else []), *(overrides or ()))]
        if given or config or init_from or agent or num_envs:
            raise UsageError(
                "a resumed run keeps its configuration; only --max-iterations and --max-steps may change",
                hint="--init-from starts a new run from its weights",
            )
        _resume(resume, folder, task, budget, chosen, logger)
        return
    if task is None:
        raise UsageError("which task?", hint="rlcli train TASK (rlcli list-tasks shows them), or --resume RUN")
    started = {**flags(scene__num_envs=num_envs), **budget}
    _start(
        task,
        overrides or [],
        agent,
        draw_seed(seed),
        started,
        chosen,
        logger,
        config,
        init_from,
        folder,
        name,
    )


def _start(
    task: str,
    overrides: list[str],
    agent: str | None,
    seed: int,
    flag_values: Any,
    device: str,
    logger: list[str] | None,
    config: Path | None,
    init_from: str | None,
    runs_dir: Path,
    name: str | None,
) -> None:
    from rlcli.config.dump import to_data, to_yaml
    from rlcli.config.load import resolve
    from rlcli.errors import RlcliError
    from rlcli.registry import find_task
    from rlcli.rl.loggers import check_loggers
    from rlcli.rl.run import create_run, environment_record, find_checkpoint

    begin = time.monotonic()
    resolved = resolve(
        find_task(task),
        agent=agent,
        device=device,
        config_file=config,
        overrides=overrides,
        flags=flag_values,
    )
    resolved.require_agent()
    loggers = check_loggers(logger)
    source, engine_threads, torch_threads = resolved.source, *_threads(resolved)
    initial = find_checkpoint(init_from, runs_dir) if init_from else None
    record = {
        "task": source.record() | {"file": source.config.name},
        "agent": resolved.agent_name,
        "seed": seed,
        "device": device,
        "loggers": loggers,
        "init_from": str(initial[1]) if initial else None,
        **environment_record(engine_threads, torch_threads),
    }
    run = create_run(runs_dir, source.name, name, to_yaml(to_data(resolved)), record)
    console.info(f"run {run.folder}")
    try:
        trainer, env = _build(resolved, seed, device, torch_threads)
        if initial is not None:
            from rlcli.rl.checkpoint import open_checkpoint
            from rlcli.rl.load import require_fit

            checkpoint = open_checkpoint(initial[1])
            require_fit(checkpoint, env.layout)
            trainer.load_weights(checkpoint.tensors("policy"))
            console.info(f"weights of {initial[1]} ({initial[2]})")
        trainer.start()
    except (RlcliError, KeyboardInterrupt):
        run.discard()
        raise
    console.detail(f"built in {time.monotonic() - begin:.1f} s")
    _fit(run, trainer, env, resolved, loggers, None, begin)


def _resume(
    reference: str,
    runs_dir: Path,
    task: str | None,
    budget: Mapping[str, Any],
    device: str,
    logger: list[str] | None,
) -> None:
    from rlcli.errors import CheckpointError
    from rlcli.rl import checkpoint
    from rlcli.rl.load import require_fit, resolve_run
    from rlcli.rl.loggers import check_loggers
    from rlcli.rl.run import find_checkpoint, find_run

    begin = time.monotonic()
    run, why = find_run(reference, runs_dir, task)
    run.lock()
    checkpoint.clean(run.checkpoints)
    _, folder, _ = find_checkpoint(str(run.folder), runs_dir)
    saved = checkpoint.open_checkpoint(folder)
    resolved = resolve_run(run, play=False, flags=budget)
    assert resolved.agent is not None
    if run.record.get("state") == "finished" and not budget:
        console.info(f"{run.folder} ({why}) is finished at step {saved.step}; --max-iterations N trains on")
        console.document("train", run=str(run.folder), state="finished", step=saved.step)
        return
    torch_threads = int(run.record.get("torch_threads") or _threads(resolved)[1])
    trainer, env = _build(resolved, int(run.record["seed"]), device, torch_threads)
    require_fit(saved, env.layout)
    state = saved.state()
    try:
        trainer.load(state)
    except (KeyError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(f"{folder} cannot be resumed: {error}") from error
    console.info(f"resuming {run.folder} ({why}) at iteration {trainer.iteration}")
    run.update(state="running")
    names = check_loggers(logger) if logger else list(run.record.get("loggers", []))
    _fit(run, trainer, env, resolved, names, (trainer.iteration, trainer.env_steps), begin)


def _build(resolved: Any, seed: int, device: str, torch_threads: int) -> Any:
    from rlcli.envs.vec_env import make_env
    from rlcli.registry import load_object

    assert resolved.trainer is not None
    env = make_env(resolved, seed=seed, device=device)
    trainer = load_object(resolved.trainer.trainer)(
        env, resolved.agent, seed=seed, device=device, torch_threads=torch_threads
    )
    return trainer, env


def _fit(run: Any, trainer: Any, env: Any, resolved: Any, loggers: list[str], resume: Any, begin: float) -> None:
    from rlcli.cli.live import TrainingView
    from rlcli.errors import RlcliError
    from rlcli.rl.checkpoint import steps
    from rlcli.rl.loggers import open_loggers
    from rlcli.rl.train import fit

    sinks = open_loggers(run, loggers, resume=resume)
    manifest = {
        "task": run.record["task"],
        "agent": run.record["agent"],
        "seed": run.record["seed"],
        "layout": env.layout.record(),
    }
    size, actions = env.layout.size(), env.layout.action_size
    console.info(
        f"{resolved.source.name}: {env.num_envs} environments, {size} observations, {actions} actions,"
        f" {env.engine.threads} engine threads, agent {resolved.agent_name}, seed {run.record['seed']}"
    )
    state = "stopped"
    try:
        with TrainingView(f"rlcli train {resolved.source.name}") as view:
            fit(
                trainer,
                run,
                _budget(resolved),
                loggers=sinks,
                save_interval=resolved.agent.save_interval,
                manifest=manifest,
                show=view.show,
                divergences=lambda: env.divergences,
            )
        state = "finished"
    except RlcliError as error:
        state = "stopped" if error.kind == "stopped" else "failed"
        raise
    finally:
        for sink in sinks:
            sink.close()
        run.update(state=state, step=trainer.env_steps, iteration=trainer.iteration)
        run.unlock()
    _warn_physics(env)
    newest = run.checkpoints / f"{steps(run.checkpoints)[-1]:012d}"
    elapsed = time.monotonic() - begin
    console.info(f"trained {trainer.env_steps:,} steps in {elapsed:.1f} s; next: rlcli play --checkpoint {run.folder}")
    console.data(str(run.folder))
    console.document(
        "train",
        run=str(run.folder),
        state=state,
        checkpoint=str(newest),
        iteration=trainer.iteration,
        step=trainer.env_steps,
        elapsed_s=elapsed,
        seed=run.record["seed"],
    )


def _budget(resolved: Any) -> Any:
    from rlcli.rl.train import Budget

    return Budget(resolved.agent.max_iterations, resolved.agent.max_steps)


def _threads(resolved: Any) -> tuple[int, int]:
    import os

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
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
