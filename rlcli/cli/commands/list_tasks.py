"""`rlcli list-tasks`: the installed tasks, from package metadata and a cache; imports no plugin."""

from __future__ import annotations

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

    Options:
        pattern: Show only tasks whose name or summary contains this text.
        probe_all: Load each listed task in a subprocess and update its cached details.

    Examples:
        rlcli list-tasks
            List all tasks.
        rlcli list-tasks cartpole --probe
            Load the matching tasks and show their sizes.
    """
    entries, broken = catalog()
    by_name = Counter(entry.name for entry in entries)
    shared = {name for name, count in by_name.items() if count > 1}
    built_in = {entry.name for entry in entries if entry.distribution == OWN}
    details = cached_details(entries)
    if pattern:
        texts = ((entry, f"{entry.name} {details.get(entry.qualified, Details()).summary}") for entry in entries)
        entries = [entry for entry, text in texts if pattern.lower() in text.lower()]
    if probe_all:
        details.update(probe(entries, timeout))
    rows = [(entry, details.get(entry.qualified, Details())) for entry in entries]
    if rows or not pattern:
        _show(rows, shared)
        if any(known.status == "?" for _, known in rows):
            console.info(
                "? marks a value that is known only after the task is loaded;"
                " `rlcli list-tasks --probe` loads the tasks"
            )
    else:
        near = did_you_mean(pattern.lower(), by_name)
        console.info(f"no task's name or summary contains '{pattern}'; {near or 'rlcli list-tasks shows all'}")
    for bad in broken:
        console.warn(f"{bad.distribution}: {bad.reason}; its tasks are not listed; see `rlcli doctor`")
    for name in unknown_wanted():
        console.warn(
            f"{plugins_chosen_by()} names '{name}', but no installed distribution of that name has tasks or trainers;"
            " correct the name"
        )
    console.document(
        "list-tasks",
        tasks=[_record(entry, known, ambiguous=entry.name in shared - built_in) for entry, known in rows],
        broken=[{"distribution": bad.distribution, "reason": bad.reason} for bad in broken],
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
                known.workflow or "?",
                _number(known.observation_size),
                _number(known.action_size),
                _number(known.num_envs),
                known.agent or "",
                known.status,
                known.summary or ("" if known.broken else "(`rlcli list-tasks --probe` shows more)"),
            ]
            for entry, known in rows
        ],
    )


def _number(value: int | None) -> str:
    return "?" if value is None else str(value)
