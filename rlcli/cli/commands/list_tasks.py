"""Command `rlcli list-tasks`: table of the installed tasks.

Names come from package metadata, details from a cache. Plugins are imported only in other processes.
"""

from collections import Counter
from typing import Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import ProbeTimeout
from rlcli.errors import did_you_mean
from rlcli.registry import OWN, Entry, catalog, plugins_chosen_by, unknown_wanted
from rlcli.registry.probe import TIMEOUT_S, Details, cached_details, probe


def command(
    pattern: Annotated[str | None, typer.Argument()] = None,
    probe_all: Annotated[bool, typer.Option("--probe")] = False,
    timeout: ProbeTimeout = TIMEOUT_S,
) -> None:
    """List installed tasks.

    A new or changed plugin is loaded once, in another process, and its details are cached.

    Options:
        pattern: Show only tasks whose name or summary contains this text.
        probe_all: Load each listed task again, even if its details are cached.

    Examples:
        rlcli list-tasks
            List all tasks.
        rlcli list-tasks cartpole --probe
            Load the matching tasks again.
    """
    entries, broken = catalog()
    by_name = Counter(entry.name for entry in entries)
    shared = {name for name, count in by_name.items() if count > 1}
    built_in = {entry.name for entry in entries if entry.distribution == OWN}
    details = cached_details(entries)
    if not probe_all:
        details.update(probe([entry for entry in entries if _is_unread(details.get(entry.qualified))], timeout))
    if pattern:
        texts = ((entry, f"{entry.name} {details.get(entry.qualified, Details()).summary}") for entry in entries)
        entries = [entry for entry, text in texts if pattern.lower() in text.lower()]
    if probe_all:
        details.update(probe(entries, timeout))
    rows = [(entry, details.get(entry.qualified, Details())) for entry in entries]
    if rows or not pattern:
        _show(rows, shared)
        for remedy in dict.fromkeys(known.remedy for _, known in rows if known.broken and known.remedy):
            console.info(f"for a broken task: {remedy}")
        if any(known.broken for _, known in rows) and not probe_all:
            console.info("STATUS is from each task's last load; after a repair, load again: rlcli list-tasks --probe")
    else:
        near = did_you_mean(pattern.lower(), by_name)
        console.info(f"no task's name or summary contains '{pattern}'; {near or 'rlcli list-tasks shows all'}")
    for bad in broken:
        console.warn(f"{bad.distribution}: {bad.reason}; its tasks are not listed; see `rlcli doctor`")
    _warn_of_unknown_plugins()
    console.document(
        "list-tasks",
        tasks=[_record(entry, known, ambiguous=entry.name in shared - built_in) for entry, known in rows],
        broken=[{"distribution": bad.distribution, "reason": bad.reason} for bad in broken],
    )


def _warn_of_unknown_plugins() -> None:
    if unknown := unknown_wanted():
        console.warn(
            f"{plugins_chosen_by()} names {unknown}, but no installed distributions of these names have tasks or"
            " trainers; correct the names"
        )


def _record(entry: Entry, known: Details, *, ambiguous: bool) -> dict[str, Any]:
    return {
        "name": entry.name,
        "qualified": entry.qualified,
        "ambiguous": ambiguous,
        "distribution": entry.distribution,
        "version": entry.version,
        "status": known.status,
        **known.record(),
    }


def _show(rows: list[tuple[Entry, Details]], shared: set[str]) -> None:
    console.table(
        ["TASK", "PLUGIN", "WORKFLOW", "OBS", "ACT", "ENVS", "AGENT", "STATUS", "SUMMARY"],
        [
            [
                entry.qualified if entry.name in shared and entry.distribution != OWN else entry.name,
                f"{entry.distribution} {entry.version}",
                known.workflow or "",
                _number(known.observation_size),
                _number(known.action_size),
                _number(known.num_envs),
                known.agent or "",
                known.status,
                known.summary,
            ]
            for entry, known in rows
        ],
    )


def _number(value: int | None) -> str:
    return "" if value is None else str(value)


def _is_unread(known: Details | None) -> bool:
    return known is None or (known.workflow is None and known.broken is None)
