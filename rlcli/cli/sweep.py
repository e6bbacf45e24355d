"""`rlcli sweep TASK --param KEY=RANGE`: trials of one training, shared by as many processes as run the same command."""

from __future__ import annotations

from typing import Annotated

import typer

from rlcli.cli.completion import tasks
from rlcli.cli.console import console
from rlcli.cli.options import (
    MAX_SEED,
    Agent,
    ConfigFile,
    Debug,
    Device,
    Json,
    NumEnvs,
    Overrides,
    Quiet,
    RunsDir,
    Verbose,
    flags,
)

_LOOKS = {"task", "overrides", "storage", "runs_dir", "json", "quiet", "verbose", "debug"}
_COMPARES = {"seeds", "until", "episodes", "max_iterations", "max_steps", "device"}
_ONLY = {"show": _LOOKS | {"plot"}, "compare": _LOOKS | _COMPARES}
"""What may be said with `sweep show` and `sweep compare`; the rest is of a sweep's beginning."""
_NOT_OF_A_SWEEP = {"plot": "sweep show", "seeds": "sweep compare", "until": "sweep compare"}


def command(
    ctx: typer.Context,
    task: Annotated[
        str | None,
        typer.Argument(
            autocompletion=tasks, help="A task; or `show` or `compare`, and a sweep's folder or name (else the newest)."
        ),
    ] = None,
    overrides: Overrides = None,
    param: Annotated[
        list[str] | None,
        typer.Option("--param", help="KEY=LOW:HIGH, KEY=log:LOW:HIGH or KEY=A,B,C; repeatable."),
    ] = None,
    trials: Annotated[int, typer.Option("--trials", min=1, max=100_000, help="Trials in all, of all processes.")] = 20,
    objective: Annotated[
        str,
        typer.Option(
            "--objective",
            help="return, success, length, reward_terms.NAME or terminations.NAME of the trained policy; @30s: of the"
            " policy after 30 s of training; @1e6: after so many steps.",
        ),
    ] = "return",
    minimize: Annotated[bool, typer.Option("--minimize", help="Less is better.")] = False,
    episodes: Annotated[
        int, typer.Option("--episodes", min=1, help="Episodes that judge a trial; with compare: a policy.")
    ] = 200,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Trials at a time in this process.")] = 1,
    pruner: Annotated[
        str, typer.Option("--pruner", help="median: stop trials that learn worse than most; none.")
    ] = "median",
    storage: Annotated[
        str | None,
        typer.Option("--storage", help="URL of a database that several machines share; else a journal file."),
    ] = None,
    name: Annotated[
        str, typer.Option("--name", help="Of the sweep: the same command again goes on with it, or helps with it.")
    ] = "sweep",
    plot: Annotated[bool, typer.Option("--plot", help="With show: draw it into the sweep's folder.")] = False,
    seeds: Annotated[str, typer.Option("--seeds", help="With compare: of the trainings, 0..2 or 1,5,9.")] = "0..2",
    until: Annotated[
        str | None,
        typer.Option(
            "--until", help="With compare: success=X, return=X or length=X, which ends a training; success=0.99."
        ),
    ] = None,
    agent: Agent = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=MAX_SEED, help="Of every trial, and of what is drawn.")
    ] = 42,
    num_envs: NumEnvs = None,
    max_iterations: Annotated[int | None, typer.Option("--max-iterations", help="Iterations of a trial.")] = None,
    max_steps: Annotated[int | None, typer.Option("--max-steps", help="Environment steps of a trial.")] = None,
    device: Device = "auto",
    config: ConfigFile = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Search settings that learn best; `sweep show` lists them."""
    from rlcli.cli.sweep_show import draw, find, report
    from rlcli.errors import Stopped, UsageError
    from rlcli.rl.run import default_runs_dir, require_name
    from rlcli.rl.search import open_search
    from rlcli.rl.space import HINT, read_objective, read_parameters
    from rlcli.rl.stop import StopRequest
    from rlcli.rl.storage import check_optuna, hidden, reached

    runs = runs_dir or default_runs_dir()
    _require_fitting(ctx, task)
    budget = {"agent.max_iterations": max_iterations, "agent.max_steps": max_steps}
    stop = StopRequest(ends_process=console.owns_process)
    if task == "show":
        check_optuna()
        with reached(storage):
            search = find(overrides or [], runs, storage)
            if plot:
                draw(search)
            report(search)
        return
    if task == "compare":
        from rlcli.cli.sweep_compare import compare
        from rlcli.rl.study import read_seeds

        check_optuna()
        words = [word for word in overrides or [] if "=" not in word]
        changes = [word for word in overrides or [] if "=" in word]
        longest = budget if any(budget.values()) else {}
        with reached(storage):
            search = find(words, runs, storage)
            compare(search, read_seeds(seeds), until, changes, longest, episodes, device, runs, stop)
        return
    if task is None:
        raise UsageError("which task?", hint="rlcli sweep TASK --param agent.learning_rate=log:1e-4:1e-2")
    if not param:
        raise UsageError("nothing is to be varied", hint=f"--param {HINT}")
    require_name(name)
    goal, parameters = read_objective(objective), read_parameters(param)
    if goal.steps is not None:
        if any(budget.values()):
            raise UsageError(f"--objective {objective} says how long a trial trains", hint="leave out --max-...")
        budget["agent.max_steps"] = goal.steps
    check_optuna()

    from rlcli.cli.sweep_trials import Base, Worker
    from rlcli.rl.trust import named_task

    base = Base(
        named_task(task),
        agent,
        device,
        config,
        list(overrides or []),
        seed,
        runs,
        flags=dict(flags(scene__num_envs=num_envs)),
        budget=budget if any(budget.values()) else {},
    )
    resolved = base.check(parameters, goal)
    settings = {
        "task": resolved.source.name,
        "name": name,
        "agent": resolved.agent_name,
        "overrides": base.overrides,
        "flags": base.flags,
        "budget": base.budget,
        "config": None if config is None else config.read_text(encoding="utf-8"),
        "params": list(param),
        "objective": objective,
        "direction": "minimize" if minimize else "maximize",
        "episodes": episodes,
        "pruner": pruner,
        "seed": seed,
        "trials": trials,
        "storage": None if storage is None else hidden(storage).rpartition("@")[2],
    }
    source = {key: value for key, value in resolved.source.record().items() if key != "version"}
    with reached(storage):
        search = open_search(runs / resolved.source.name / f"sweep-{name}", settings, source, parameters, storage)
        console.info(f"sweep {search.folder}: {len(search.ended())} of {trials} trials have ended")
        try:
            with stop:
                Worker(search, base, goal, jobs, stop).run()
        finally:
            search.let_go()
        if stop.signal is not None and len(search.ended()) < trials:
            raise Stopped("stopped on request", exit_code=stop.exit_code, hint="the same command again goes on")
        base.keep_preset(search)
        report(search)


def _require_fitting(ctx: typer.Context, task: str | None) -> None:
    """Refuse options that mean nothing here.

    Raises:
        UsageError: naming the first of them.
    """
    from rlcli.errors import UsageError, did_you_mean

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
    pruner = ctx.params["pruner"]
    if pruner not in ("median", "none"):
        raise UsageError(f"no --pruner '{pruner}'", hint=did_you_mean(pruner, ["median", "none"]) or "median or none")


def _is_given(ctx: typer.Context, name: str) -> bool:
    source = ctx.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
