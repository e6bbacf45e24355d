"""How a line may go on, for a shell that asks. Nothing heavy is imported, and no plugin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import typer

Offer = tuple[str, str]
"""A word, and what it is."""

_MOST_RUNS = 50


def words(*choices: str) -> Callable[[str], list[str]]:
    """Offers one of a few words."""

    def offer(incomplete: str) -> list[str]:
        return [choice for choice in choices if choice.startswith(incomplete)]

    return offer


def tasks(incomplete: str) -> list[Offer]:
    """The installed tasks; a folder is for the shell to complete."""
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
    """The newest runs by name, and `latest`; a path is for the shell to complete."""
    if "/" in incomplete:
        return []
    return _starting([("latest", "the newest run"), *_runs(ctx)], incomplete)


def checkpoints(ctx: typer.Context, incomplete: str) -> list[Offer]:
    """Runs, `shipped`, and after a run's name its best checkpoint and its steps."""
    run, at, _ = incomplete.partition("@")
    if at:
        return _starting([(f"{run}@{what}", "") for what in _saved(ctx, run)], incomplete)
    return _starting([("shipped", "the task's own policy")], incomplete) + runs(ctx, incomplete)


def runs_and_tasks(ctx: typer.Context, incomplete: str) -> list[Offer]:
    """What a run or a task is called."""
    return tasks(incomplete) + runs(ctx, incomplete)


def agents(ctx: typer.Context, incomplete: str) -> list[Offer]:
    """The agents of the task that stands on the line."""
    named = [ctx.params[key] for key in ("task", "subject", "target") if ctx.params.get(key)]
    named += ctx.args  # a line that ends with --agent could not be read to its end
    try:
        found = _agents(str(named[0])) if named else []
    except Exception:  # whatever is wrong with a task is said when it is used
        found = []
    return _starting([(name, "") for name in found], incomplete)


def _starting(offers: list[Offer], incomplete: str) -> list[Offer]:
    return [offer for offer in offers if offer[0].startswith(incomplete)]


def _runs_dir(ctx: typer.Context) -> Path:
    from rlcli.runs.run_ref import default_runs_dir

    return Path(ctx.params.get("runs_dir") or default_runs_dir())


def _runs(ctx: typer.Context) -> Iterator[Offer]:
    """Names of the newest runs, by when their folders were last changed."""
    from rlcli.runs.run import RECORD

    place = _runs_dir(ctx)
    try:
        folders = [file.parent for pattern in ("*/*", "*/*/*") for file in place.glob(f"{pattern}/{RECORD}")]
        folders.sort(key=lambda folder: folder.stat().st_mtime, reverse=True)
    except OSError:
        return
    for folder in folders[:_MOST_RUNS]:
        yield folder.name, folder.relative_to(place).parts[0]


def _saved(ctx: typer.Context, run: str) -> list[str]:
    from rlcli.runs.checkpoint import steps
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

    if not any(mark in task for mark in ("/", "\\")) and not (Path(task) / "task.yaml").is_file():
        entry = find_entry(TASKS, task, what="task")
        if entry.distribution != OWN:  # its file is found by importing it, which is not done for a key press
            known = cached_details([entry]).get(entry.qualified)
            return [known.agent] if known and known.agent else []
    source = find_task(task)
    if source.config.suffix not in (".yaml", ".yml"):
        return []
    found = read(source.config).data.get("agents")
    return [name for name in found if name != "default"] if isinstance(found, dict) else []
