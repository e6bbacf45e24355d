"""Tasks as a command line names them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from rlcli.errors import TaskError
from rlcli.registry.entries import TASKS, catalog, find_entry
from rlcli.registry.folders import folder_task, python_task
from rlcli.registry.formats import find_in_formats, require_format
from rlcli.registry.packages import installed_task, task_of_file
from rlcli.registry.source import TaskSource


def find_task(name: str) -> TaskSource:
    """A task by name, by `distribution:name`, by the path of its folder, or, in Python, as `file.py:attribute`.

    A name is looked up among the installed tasks first: a folder of the same name needs a slash, `./cartpole`.

    Raises:
        TaskError: unknown, ambiguous, broken, or built for a newer rlcli.
    """
    place, _, attribute = name.rpartition(":")
    if place.endswith(".py") or (attribute and os.sep not in attribute and "/" in place and Path(place).is_dir()):
        return python_task(name)
    if name in (".", "..") or any(mark in name for mark in ("/", os.sep)):
        path = Path(name)
        if path.suffix == ".yaml" and path.is_file():
            if find_in_formats(path) is not None:
                return folder_task(path.parent, path.name)
            require_format(path)
        return folder_task(path)
    try:
        entry = find_entry(TASKS, name, what="task")
    except TaskError:
        if name and Path(name).is_dir() and not _offered(name):
            return folder_task(Path(name))
        if "=" in name:
            raise TaskError(f"no task '{name}'", hint="overrides come after the task: TASK key.path=value") from None
        raise
    return installed_task(entry)


def _offered(name: str) -> bool:
    return any(entry.name == name for entry in catalog()[0])


def task_source(target: str) -> TaskSource:
    """Find a task by its name, its folder, or any YAML file that describes one.

    Raises:
        TaskError: if there is none.
    """
    file = Path(target)
    if file.suffix not in (".yaml", ".yml"):
        return find_task(target)
    if not file.is_file():
        raise TaskError(f"no file '{target}'")
    # a YAML of an installed task keeps that task's terms and class
    return task_of_file(file) or replace(folder_task(file.parent, file.name), name=file.stem)
