"""`rlcli sweep TASK --param KEY=RANGE`: trials of one training, shared by as many processes as run the same command."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui import options
from rlcli.cli.ui.completion import tasks
from rlcli.cli.ui.console import console
from rlcli.errors import Stopped, UsageError, require_known

if TYPE_CHECKING:
    from rlcli.training.launch import TrainingRequest
    from rlcli.training.signals import StopRequest

_LOOKS = {"task", "overrides", "storage", "runs_dir", "json", "quiet", "verbose", "debug"}
_COMPARES = {"seeds", "until", "episodes", "max_iterations", "max_steps", "device"}
_ONLY = {"show": _LOOKS | {"plot"}, "compare": _LOOKS | _COMPARES}
"""Options of `sweep show` and `sweep compare`; all others begin a sweep."""
_NOT_OF_A_SWEEP = {"plot": "sweep show", "seeds": "sweep compare", "until": "sweep compare"}


def command(
    ctx: typer.Context,
    task: Annotated[
        str | None,
        typer.Argument(
            autocompletion=tasks, help="A task; or `show` or `compare`, and a sweep's folder or name (else the newest)."
        ),
    ] = None,
    overrides: options.Overrides = None,
    param: Annotated[
        list[str] | None, typer.Option(help="KEY=LOW:HIGH, KEY=log:LOW:HIGH or KEY=A,B,C; repeatable.")
    ] = None,
    trials: Annotated[int, typer.Option(min=1, max=100_000, help="Trials in all, of all processes.")] = 20,
    objective: Annotated[
        str,
        typer.Option(
            help="return, success, length, reward_terms.NAME or terminations.NAME of the trained policy; @30s: of the"
            " policy after 30 s of training; @1e6: after so many steps."
        ),
    ] = "return",
    minimize: Annotated[bool, typer.Option("--minimize", help="Less is better.")] = False,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes that judge a trial; with compare: a policy.")] = 200,
    jobs: Annotated[int, typer.Option(min=1, help="Trials at a time in this process.")] = 1,
    pruner: Annotated[str, typer.Option(help="median: stop trials that learn worse than most; none.")] = "median",
    storage: Annotated[
        str | None, typer.Option(help="URL of a database that several machines share; else a journal file.")
    ] = None,
    name: Annotated[
        str, typer.Option(help="Of the sweep: the same command again goes on with it, or helps with it.")
    ] = "sweep",
    plot: Annotated[bool, typer.Option("--plot", help="With show: draw it into the sweep's folder.")] = False,
    seeds: Annotated[str, typer.Option(help="With compare: of the trainings, 0..2 or 1,5,9.")] = "0..2",
    until: Annotated[
        str | None,
        typer.Option(help="With compare: success=X, return=X or length=X, which ends a training; success=0.99."),
    ] = None,
    agent: options.Agent = None,
    seed: Annotated[int, typer.Option(min=0, max=options.MAX_SEED, help="Of every trial, and of what is drawn.")] = 42,
    num_envs: options.NumEnvs = None,
    max_iterations: options.MaxIterations = None,
    max_steps: options.MaxSteps = None,
    device: options.Device = "auto",
    config: options.ConfigFile = None,
    runs_dir: options.RunsDir = None,
) -> None:
    """Search settings that learn best; `sweep show` lists them."""
    from rlcli.config.layers import flags
    from rlcli.runs.run_ref import default_runs_dir
    from rlcli.training.launch import TrainingRequest
    from rlcli.training.signals import StopRequest
    from rlcli.tuning.search_space import HINT

    _require_fitting(ctx, task)
    request = TrainingRequest(runs_dir or default_runs_dir(), agent=agent, device=device, config=config, seed=seed)
    request.overrides, request.flags = overrides or [], flags(scene__num_envs=num_envs)
    request.budget, request.loggers = options.budget(max_iterations, max_steps), ["none"]
    stop = StopRequest(ends_process=console.owns_process)
    if task == "show":
        _show(request, storage, plot)
    elif task == "compare":
        _compare(request, seeds, until, episodes, storage, stop)
    elif task is None:
        raise UsageError("which task?", hint="rlcli sweep TASK --param agent.learning_rate=log:1e-4:1e-2")
    elif not param:
        raise UsageError("nothing is to be varied", hint=f"--param {HINT}")
    else:
        direction = "minimize" if minimize else "maximize"
        settings: dict[str, Any] = {"params": list(param), "objective": objective, "direction": direction}
        settings |= {"name": name, "episodes": episodes, "pruner": pruner, "trials": trials}
        _search(request, task, settings, storage, jobs, stop)


def _show(request: TrainingRequest, storage: str | None, plot: bool) -> None:
    """Print the trials of a sweep, and draw them with --plot."""
    from rlcli.cli.ui.sweep_tables import print_sweep
    from rlcli.tuning.optuna_storage import check_optuna, storage_errors
    from rlcli.tuning.sweep import draw_sweep, find_sweep

    check_optuna()
    with storage_errors(storage):
        sweep = find_sweep(request.overrides, request.runs, storage)
        if plot:
            console.data(str(draw_sweep(sweep)))
        print_sweep(sweep)


def _compare(
    request: TrainingRequest, seeds: str, until: str | None, episodes: int, storage: str | None, stop: StopRequest
) -> None:
    """Compare the best trial's settings with the task's own."""
    from rlcli.cli.ui.sweep_tables import print_comparison
    from rlcli.runs.study import read_seeds
    from rlcli.tuning.optuna_storage import check_optuna, storage_errors
    from rlcli.tuning.sweep import find_sweep
    from rlcli.tuning.sweep_compare import compare

    check_optuna()
    names = [word for word in request.overrides if "=" not in word]
    request.overrides = [word for word in request.overrides if "=" in word]
    with storage_errors(storage):
        sweep = find_sweep(names, request.runs, storage)
        comparison = compare(sweep, request, read_seeds(seeds), until, episodes, stop)
    print_comparison(comparison)
    if comparison.exit_code:
        raise typer.Exit(comparison.exit_code)


def _search(
    request: TrainingRequest,
    task: str,
    settings: dict[str, Any],
    storage: str | None,
    jobs: int,
    stop: StopRequest,
) -> None:
    """Begin or join a sweep, and run trials until none is left or a signal arrives."""
    from rlcli.cli.ui.sweep_tables import print_sweep
    from rlcli.runs.run import require_name
    from rlcli.runs.trusted_tasks import named_task
    from rlcli.tuning.optuna_storage import check_optuna, storage_errors, without_password
    from rlcli.tuning.search_space import read_objective, read_parameters
    from rlcli.tuning.sweep import open_sweep
    from rlcli.tuning.sweep_trials import TrialRunner, check_parameters, write_preset

    require_name(settings["name"])
    objective, parameters = read_objective(settings["objective"]), read_parameters(settings["params"])
    if objective.steps is not None:
        if request.budget:
            said = f"--objective {settings['objective']} says how long a trial trains"
            raise UsageError(said, hint="leave out --max-...")
        request.budget = {"agent.max_iterations": None, "agent.max_steps": objective.steps}
    check_optuna()
    request.source = named_task(task)
    resolved = check_parameters(request, parameters, objective)
    settings |= {
        "task": resolved.source.name,
        "agent": resolved.agent_name,
        "overrides": request.overrides,
        "flags": request.flags,
        "budget": request.budget,
        "config": None if request.config is None else request.config.read_text(encoding="utf-8"),
        "seed": request.seed,
        "storage": None if storage is None else without_password(storage).rpartition("@")[2],
    }
    source = {key: value for key, value in resolved.source.record().items() if key != "version"}
    folder, wanted = request.runs / resolved.source.name / f"sweep-{settings['name']}", settings["trials"]
    with storage_errors(storage):
        sweep = open_sweep(folder, settings, source, parameters, storage)
        console.info(f"sweep {sweep.folder}: {len(sweep.ended())} of {wanted} trials have ended")
        try:
            with stop:
                TrialRunner(sweep, request, objective, jobs, stop).run()
        finally:
            sweep.release()
        if stop.signal is not None and len(sweep.ended()) < wanted:
            raise Stopped("stopped on request", exit_code=stop.exit_code, hint="the same command again goes on")
        write_preset(sweep, request)
        print_sweep(sweep)


def _require_fitting(ctx: typer.Context, task: str | None) -> None:
    """Refuse options that mean nothing here.

    Raises:
        UsageError: naming the first of them.
    """
    given = [name for name in ctx.params if _is_given(ctx, name)]
    if task in _ONLY:
        strange = next((name for name in given if name not in _ONLY[task]), None)
        what = f"sweep {task}"
        hint = "it is of a sweep's beginning, or of another of its commands"
    else:
        strange = next((name for name in given if name in _NOT_OF_A_SWEEP), None)
        what, hint = "a sweep", f"it is of rlcli {_NOT_OF_A_SWEEP.get(strange or '')}"
    if strange is not None:
        raise UsageError(f"--{strange.replace('_', '-')} is not of {what}", hint=hint)
    require_known(ctx.params["pruner"], ("median", "none"), "--pruner", "pruners")


def _is_given(ctx: typer.Context, name: str) -> bool:
    source = ctx.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
