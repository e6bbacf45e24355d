"""Functions that complete words of a command line when the user presses Tab: tasks, runs, checkpoints, agents.

`options` connects each option with one of these functions. The functions are fast: they import no plugin.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import typer

Offer = tuple[str, str]
"""A word that the shell offers as a completion, and the description that the shell shows beside the word."""

_MAX_RUNS = 50


def words(*choices: str) -> Callable[[str], list[str]]:
    """Return a completion function that offers these words."""

    def offer(incomplete: str) -> list[str]:
        return [choice for choice in choices if choice.startswith(incomplete)]

    return offer


def tasks(incomplete: str) -> list[Offer]:
    """Return the names of installed tasks that begin with the incomplete word; the shell itself completes folders."""
    from rlcli.registry import OWN, catalog
    from rlcli.registry.probe import Details, cached_details

    entries, _ = catalog()
    known = cached_details(entries)
    found = []
    for entry in entries:
        shared = entry.distribution != OWN and sum(other.name == entry.name for other in entries) > 1
        name = entry.qualified if shared or ":" in incomplete else entry.name
        found.append((name, known.get(entry.qualified, Details()).summary))
    return _starting(found, incomplete)


def runs(ctx: typer.Context, incomplete: str) -> list[Offer]:
    """Return the names of the newest runs, and `latest`; the shell itself completes paths."""
    if "/" in incomplete:
        return []
    return _starting([("latest", "the newest run"), *_runs(ctx)], incomplete)


def checkpoints(ctx: typer.Context, incomplete: str) -> list[Offer]:
    """Return `shipped`, `latest` and the newest runs; for a word that begins with `RUN@`, the run's checkpoints."""
    run, at, _ = incomplete.partition("@")
    if at:
        return _starting([(f"{run}@{name}", "") for name in _checkpoint_names(ctx, run)], incomplete)
    return _starting([("shipped", "the task's own policy")], incomplete) + runs(ctx, incomplete)


def runs_and_tasks(ctx: typer.Context, incomplete: str) -> list[Offer]:
    """Return the names of tasks and runs."""
    return tasks(incomplete) + runs(ctx, incomplete)


def agents(ctx: typer.Context, incomplete: str) -> list[Offer]:
    """Return the names of the agents of the task that is on the command line."""
    words = [ctx.params[key] for key in ("task", "subject", "target") if ctx.params.get(key)]
    words += ctx.args  # arguments after an incomplete --agent are not parsed into ctx.params
    try:
        found = _agents(str(words[0])) if words else []
    except Exception:  # a broken task is reported when a command uses it
        found = []
    return _starting([(name, "") for name in found], incomplete)


def _starting(offers: list[Offer], incomplete: str) -> list[Offer]:
    return [offer for offer in offers if offer[0].startswith(incomplete)]


def _runs_dir(ctx: typer.Context) -> Path:
    from rlcli.runs.run_ref import default_runs_dir

    return Path(ctx.params.get("runs_dir") or default_runs_dir())


def _runs(ctx: typer.Context) -> Iterator[Offer]:
    """Yield the names of the runs whose folders changed last, each with a description."""
    from rlcli.runs.run import RECORD

    runs_dir = _runs_dir(ctx)
    try:
        folders = [file.parent for pattern in ("*/*", "*/*/*") for file in runs_dir.glob(f"{pattern}/{RECORD}")]
        folders.sort(key=lambda folder: folder.stat().st_mtime, reverse=True)
    except OSError:
        return
    for folder in folders[:_MAX_RUNS]:
        yield folder.name, folder.relative_to(runs_dir).parts[0]


def _checkpoint_names(ctx: typer.Context, run: str) -> list[str]:
    from rlcli.runs.checkpoint_reader import steps
    from rlcli.runs.run_ref import find_run

    try:
        found, _ = find_run(run, _runs_dir(ctx))
        return ["best", *(f"step:{step}" for step in reversed(steps(found.checkpoints)))]
    except Exception:
        return []


def _agents(task: str) -> list[str]:
    from rlcli.config.layers import read
    from rlcli.registry import OWN, TASKS, find_entry, find_task
    from rlcli.registry.probe import cached_details

    if not any(separator in task for separator in ("/", "\\")) and not (Path(task) / "task.yaml").is_file():
        entry = find_entry(TASKS, task, what="task")
        if entry.distribution != OWN:  # reading the task's file imports the plugin, which is too slow for a key press
            known = cached_details([entry]).get(entry.qualified)
            return [known.agent] if known and known.agent else []
    source = find_task(task)
    if source.config.suffix not in (".yaml", ".yml"):
        return []
    found = read(source.config).data.get("agents")
    return [name for name in found if name != "default"] if isinstance(found, dict) else []
