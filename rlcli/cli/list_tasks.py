"""`rlcli list-tasks`: what is installed, from metadata and a cache; nothing of a plugin is imported."""

from __future__ import annotations

from typing import Annotated

import typer

from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json, Quiet, Verbose
from rlcli.errors import did_you_mean
from rlcli.probe import TIMEOUT_S, Details, cached, probe
from rlcli.registry import OWN, Entry, catalog, plugins_chosen_by, unknown_wanted


def command(
    pattern: Annotated[str | None, typer.Argument(help="Show only names or summaries that contain this.")] = None,
    probe_all: Annotated[
        bool,
        typer.Option("--probe", help="Load every task shown in a process of its own and refresh what is known of it."),
    ] = False,
    timeout: Annotated[
        float, typer.Option("--probe-timeout", help="Seconds that --probe gives each task.")
    ] = TIMEOUT_S,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """List installed tasks."""
    entries, broken = catalog()
    names = [e.name for e in entries]
    shared = {e.name for e in entries if sum(other.name == e.name for other in entries) > 1}
    built_in = {e.name for e in entries if e.distribution == OWN}
    details = cached(entries)
    if pattern:
        entries = [
            e for e in entries if pattern.lower() in f"{e.name} {details.get(e.qualified, Details()).summary}".lower()
        ]
    if probe_all:
        details.update(probe(entries, timeout))
    rows = [(entry, details.get(entry.qualified, Details())) for entry in entries]
    if rows or not pattern:
        _show(rows, shared)
    else:
        near = did_you_mean(pattern.lower(), names)
        console.info(f"no task's name or summary contains '{pattern}'; {near or 'rlcli list-tasks shows all'}")
    for bad in broken:
        console.warn(f"{bad.distribution}: {bad.reason}; its tasks are not listed")
    for name in unknown_wanted():
        console.warn(f"{plugins_chosen_by()} names '{name}', which is no installed distribution with tasks or trainers")
    console.document(
        "list-tasks",
        tasks=[
            {
                "name": entry.name,
                "qualified": entry.qualified,
                "ambiguous": entry.name in shared - built_in,
                "distribution": entry.distribution,
                "version": entry.version,
                "status": known.status,
                **known.record(),
            }
            for entry, known in rows
        ],
        broken=[{"distribution": bad.distribution, "reason": bad.reason} for bad in broken],
    )


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
                known.summary or ("" if known.broken else "(rlcli list-tasks --probe tells more)"),
            ]
            for entry, known in rows
        ],
    )


def _number(value: int | None) -> str:
    return "?" if value is None else str(value)
