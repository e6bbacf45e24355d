"""Command `rlcli terms`: list of the terms that a task file can use, with their keys, types and defaults.

A term is a function for an observation, an action, a reward, a termination, an event and so on.
"""

from __future__ import annotations

from shlex import quote
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.console import console

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlcli.config.term_docs import KeyEntry, TermEntry


def command(
    pattern: Annotated[str | None, typer.Argument()] = None,
    task: Annotated[str | None, typer.Option("--task", metavar="TASK")] = None,
) -> None:
    """List the terms that a task file can use: functions for observations, actions, rewards, events and more.

    The list has the name of each term, and its keys, types and defaults. An exact name prints the meaning of each
    key, with its unit, and an example.

    Options:
        pattern: Text in the name, section or summary of the terms, the name of a key that all terms of a section have,
            such as `delay`, or a pattern of names such as `root_*`.
            [default: all terms]
        task: Add the terms of this task.

    Examples:
        rlcli terms track_lin_vel
            List the terms whose name or summary contains `track_lin_vel`.
        rlcli terms joint_vel_l1
            Describe one term with its keys.
    """
    from rlcli.config.term_docs import section_keys, term_entries
    from rlcli.config.term_signatures import SECTIONS
    from rlcli.errors import did_you_mean
    from rlcli.registry import find_task

    term_files = find_task(task).term_files if task else ()
    entries = term_entries(pattern or "", term_files)
    exact = [entry for entry in entries if entry.name == pattern]
    for entry in exact:
        _print_details(entry)
    if not exact:
        _print_lines(entries)
    shared = {section: key for section in SECTIONS for key in section_keys(section) if key.name == pattern}
    for section, key in shared.items():
        _print_keys(f"key of every term in {section}:", [key])
    if not entries and not shared:
        keys = {key.name for section in SECTIONS for key in section_keys(section)}
        near = did_you_mean(pattern or "", [*(entry.name for entry in term_entries("", term_files)), *sorted(keys)])
        console.info(f"no term's name or summary contains '{pattern}'; {near or 'run `rlcli terms` to list all terms'}")
        if task is None:
            console.info(
                f"a task's own terms are listed only with --task: rlcli terms {quote(pattern or '')} --task TASK"
            )
    console.document("terms", terms=[entry.document() for entry in exact or entries])


def _print_lines(entries: list[TermEntry]) -> None:
    section = ""
    for entry in entries:
        if entry.section != section:
            section = entry.section
            console.data(f"{section}:")
        keys = ", ".join(_signature(entry))
        console.data(f"  {entry.name}({keys})")


def _signature(entry: TermEntry) -> list[str]:
    from rlcli.config.term_docs import yaml_text

    return [f"{key.name}: {key.type}" + ("" if key.required else f" = {yaml_text(key.default)}") for key in entry.keys]


def _print_details(entry: TermEntry) -> None:
    from rlcli.config.term_docs import section_keys
    from rlcli.config.term_signatures import SECTIONS

    console.data(f"{entry.name} ({entry.section})", entry.summary, "")
    _print_keys("", entry.keys)
    shared = [key.name for key in section_keys(entry.section)] if entry.section in SECTIONS else []
    if shared:
        console.data("", f"keys of every term in {entry.section}: {', '.join(shared)}")
    console.data("", f"example: {entry.example}")


def _print_keys(title: str, keys: Sequence[KeyEntry]) -> None:
    from rlcli.config.term_docs import yaml_text

    rows = [
        [key.name, key.type, "required" if key.required else yaml_text(key.default), key.description] for key in keys
    ]
    if title:
        console.data(title)
    if rows:
        console.table(["key", "type", "default", "meaning"], rows)
