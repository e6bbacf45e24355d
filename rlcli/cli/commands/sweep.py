"""Command `rlcli sweep`: search for good settings of an agent (hyperparameter search) by many trainings, called trials.

Several processes that run the same command share the trials.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui import options
from rlcli.cli.ui.completion import tasks
from rlcli.cli.ui.console import console
from rlcli.errors import Stopped, UsageError, require_known
from rlcli.safe_text import MAX_SEED

if TYPE_CHECKING:
    from rlcli.training.signals import StopRequest
    from rlcli.training.start_run import TrainingRequest

_READ_OPTIONS = {"task", "overrides", "storage", "runs_dir", "json", "quiet", "verbose", "debug"}
_COMPARE_OPTIONS = {"seeds", "until", "episodes", "max_iterations", "max_steps", "device"}
_OPTIONS = {"show": _READ_OPTIONS | {"plot"}, "compare": _READ_OPTIONS | _COMPARE_OPTIONS}
"""Subcommand (`show` or `compare`) -> the options that it takes."""
_NOT_OF_A_SWEEP = {"plot": "sweep show", "seeds": "sweep compare", "until": "sweep compare"}
"""Option that cannot be used when a new sweep is started -> the command that has this option."""


def command(
    ctx: typer.Context,
    task: Annotated[str | None, typer.Argument(autocompletion=tasks, metavar="TASK|show|compare")] = None,
    overrides: options.Overrides = None,
    param: Annotated[list[str] | None, typer.Option(metavar="KEY=RANGE")] = None,
    trials: Annotated[int, typer.Option(min=1, max=100_000)] = 20,
    objective: Annotated[str, typer.Option(metavar="KEY")] = "return",
    minimize: Annotated[bool, typer.Option("--minimize")] = False,
    episodes: Annotated[int, typer.Option(min=1)] = 200,
    jobs: Annotated[int, typer.Option(min=1)] = 1,
    pruner: Annotated[str, options.choice("PRUNER", "median", "none")] = "median",
    storage: Annotated[str | None, typer.Option(metavar="URL")] = None,
    name: Annotated[str, typer.Option()] = "sweep",
    plot: Annotated[bool, typer.Option("--plot")] = False,
    seeds: Annotated[str, typer.Option(metavar="SEEDS")] = "0..2",
    until: Annotated[str | None, typer.Option(metavar="KEY=X")] = None,
    agent: options.Agent = None,
    seed: Annotated[int, typer.Option(min=0, max=MAX_SEED)] = 42,
    num_envs: options.NumEnvs = None,
    max_iterations: options.MaxIterations = None,
    max_steps: options.MaxSteps = None,
    device: options.Device = "auto",
    config: options.ConfigFile = None,
    runs_dir: options.RunsDir = None,
) -> None:
    """Search for the settings with which an agent learns best; `sweep show` lists trials, `compare` tests the best one.

    Options:
        task: Task to sweep; or `show` or `compare`, followed by the folder or name of a sweep (without it: the newest).
        param: Setting to vary: KEY=LOW:HIGH, KEY=log:LOW:HIGH or KEY=A,B,C; repeatable.
        trials: Number of trials, over all processes of the sweep.
        objective: return, success, length, reward_terms.NAME or terminations.NAME of the trained policy. With
            @30s appended, as in success@30s, each training stops after 30 s; with @1e6, after 1,000,000 steps.
        minimize: Search for the smallest value of the objective.
        episodes: Number of episodes that evaluate a trial; with compare: each policy.
        jobs: Number of trials at a time in this process.
        pruner: median (stop trials that learn worse than most) or none.
        storage: URL of a database that several machines share. [default: a journal file in the sweep's folder]
        name: Name of the sweep; a command with the same name resumes or joins it.
        plot: With show: plot the trials in a file in the sweep's folder.
        seeds: With compare: seeds of the trainings, such as 0..2 or 1,5,9.
        until: With compare: value of success, return or length at which a training ends. [default: success=0.99]
        seed: Seed of each trial and of the search.

    Examples:
        rlcli sweep cartpole --param agent.learning_rate=log:1e-4:1e-2 --trials 8
            Train eight trials with random learning rates.
        rlcli sweep compare --seeds 0..4
            Compare the best trial of the newest sweep with the task's settings.
    """
    from rlcli.config.layers import flags
    from rlcli.runs.run_ref import default_runs_dir
    from rlcli.training.signals import StopRequest
    from rlcli.training.start_run import TrainingRequest
    from rlcli.tuning.optuna_storage import check_optuna, storage_errors
    from rlcli.tuning.search_space import HINT

    _check_options(ctx, task)
    request = TrainingRequest(runs_dir or default_runs_dir(), agent=agent, device=device, config=config, seed=seed)
    request.overrides, request.flags = overrides or [], flags(scene__num_envs=num_envs)
    request.budget, request.loggers = options.budget_keys(max_iterations, max_steps), ["none"]
    stop = StopRequest(ends_process=console.owns_process)
    if task is None:
        raise UsageError("no task given", hint="rlcli sweep TASK --param agent.learning_rate=log:1e-4:1e-2")
    if task not in _OPTIONS and not param:
        raise UsageError("no --param given", hint=HINT)
    check_optuna()
    with storage_errors(storage):
        if task == "show":
            _show(request, storage, plot)
        elif task == "compare":
            _compare(request, seeds, until, episodes, storage, stop)
        else:
            direction = "minimize" if minimize else "maximize"
            settings: dict[str, Any] = {"params": list(param or ()), "objective": objective, "direction": direction}
            settings |= {"name": name, "episodes": episodes, "pruner": pruner, "trials": trials}
            _search(request, task, settings, storage, jobs, stop)


def _show(request: TrainingRequest, storage: str | None, plot: bool) -> None:
    """Run `sweep show`: print the trials of a sweep, and plot them with --plot."""
    from rlcli.cli.ui.several_trainings import print_sweep
    from rlcli.tuning.sweep import draw_sweep, find_sweep

    sweep = find_sweep(request.overrides, request.runs, storage)
    if plot:
        console.data(str(draw_sweep(sweep)))
    print_sweep(sweep)


def _compare(
    request: TrainingRequest, seeds: str, until: str | None, episodes: int, storage: str | None, stop: StopRequest
) -> None:
    """Run `sweep compare`: train with the best trial's settings and with the task's own."""
    from rlcli.cli.ui.several_trainings import print_comparison
    from rlcli.runs.study import read_seeds
    from rlcli.tuning.compare_best_with_default import compare
    from rlcli.tuning.sweep import find_sweep

    names = [word for word in request.overrides if "=" not in word]
    request.overrides = [word for word in request.overrides if "=" in word]
    sweep = find_sweep(names, request.runs, storage)
    comparison = compare(sweep, request, read_seeds(seeds), until, episodes, stop)
    print_comparison(comparison)
    if comparison.exit_code:
        raise typer.Exit(comparison.exit_code)


def _search(
    request: TrainingRequest, task: str, settings: dict[str, Any], storage: str | None, jobs: int, stop: StopRequest
) -> None:
    """Create or join a sweep, and run trials until none is left or a signal arrives."""
    from rlcli.cli.ui.several_trainings import print_sweep
    from rlcli.runs.run import require_name
    from rlcli.runs.trusted_tasks import named_task
    from rlcli.tuning.optuna_storage import without_password
    from rlcli.tuning.run_sweep_trials import TrialRunner, check_parameters, write_preset
    from rlcli.tuning.search_space import read_objective, read_parameters
    from rlcli.tuning.sweep import open_sweep

    require_name(settings["name"])
    objective, parameters = read_objective(settings["objective"]), read_parameters(settings["params"])
    if objective.steps is not None:
        if request.budget:
            message = f"--objective {settings['objective']} limits the length of each training"
            raise UsageError(message, hint="leave out --max-iterations and --max-steps")
        request.budget = {"agent.max_iterations": None, "agent.max_steps": objective.steps}
    request.source = named_task(task)
    resolved = check_parameters(request, parameters, objective)
    settings |= {name: getattr(request, name) for name in ("overrides", "flags", "budget", "seed")}
    settings |= {
        "task": resolved.source.name,
        "agent": resolved.agent_name,
        "config": None if request.config is None else request.config.read_text(encoding="utf-8"),
        "storage": None if storage is None else without_password(storage).rpartition("@")[2],
    }
    source = {key: value for key, value in resolved.source.record().items() if key != "version"}
    folder, wanted = request.runs / resolved.source.name / f"sweep-{settings['name']}", settings["trials"]
    sweep = open_sweep(folder, settings, source, parameters, storage)
    console.info(f"sweep {sweep.folder}: {len(sweep.ended())} of {wanted} trials have ended")
    try:
        with stop:
            TrialRunner(sweep, request, objective, jobs, stop).run()
    finally:
        sweep.release()
    if stop.signal is not None and len(sweep.ended()) < wanted:
        hint = "run the same command again to continue"
        raise Stopped("stopped on request", exit_code=stop.exit_code, hint=hint)
    write_preset(sweep, request)
    print_sweep(sweep)


def _check_options(ctx: typer.Context, task: str | None) -> None:
    """Check that all given options fit the form of the command: `sweep TASK`, `sweep show` or `sweep compare`.

    Raises:
        UsageError: with the first option that does not fit, or for an unknown --pruner.
    """
    sources = {name: ctx.get_parameter_source(name) for name in ctx.params}
    given = [name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"]
    if task in _OPTIONS:
        wrong = next((name for name in given if name not in _OPTIONS[task]), None)
        form, hint = f"sweep {task}", "leave out this option of a new sweep or of another subcommand"
    else:
        wrong = next((name for name in given if name in _NOT_OF_A_SWEEP), None)
        form, hint = "a new sweep", f"leave out this option of rlcli {_NOT_OF_A_SWEEP.get(wrong or '')}"
    if wrong is not None:
        raise UsageError(f"--{wrong.replace('_', '-')} is not an option of {form}", hint=hint)
    require_known(ctx.params["pruner"], ("median", "none"), "--pruner", "pruners")
