"""Tasks and trainers by name, found in the metadata of installed distributions; plugins are imported when used."""

from __future__ import annotations

import os
from pathlib import Path

from rlcli.errors import TaskError
from rlcli.registry.entries import (
    OWN,
    TASKS,
    TRAINERS,
    Broken,
    Entry,
    catalog,
    find_entry,
    malformed_metadata_ignored,
    plugins_chosen_by,
    unknown_wanted,
    unreadable_distributions,
)
from rlcli.registry.folders import folder_task, python_place, python_task
from rlcli.registry.imports import import_file, load_entry, load_module, load_object
from rlcli.registry.models import chosen_model, model_file
from rlcli.registry.packages import installed_task, is_offered, package_folder, packaged_task, task_of_file
from rlcli.registry.source import TaskSource

__all__ = [
    "OWN",
    "TASKS",
    "TRAINERS",
    "Broken",
    "Entry",
    "TaskSource",
    "catalog",
    "chosen_model",
    "find_entry",
    "find_task",
    "folder_task",
    "import_file",
    "installed_task",
    "is_offered",
    "load_entry",
    "load_module",
    "load_object",
    "malformed_metadata_ignored",
    "model_file",
    "package_folder",
    "packaged_task",
    "plugins_chosen_by",
    "python_place",
    "python_task",
    "task_of_file",
    "unknown_wanted",
    "unreadable_distributions",
]


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
        from rlcli.config import oige

        path = Path(name)
        if path.suffix == ".yaml" and path.is_file() and oige.is_oige_file(path):
            return folder_task(path.parent, path.name)
        return folder_task(path)
    try:
        entry = find_entry(TASKS, name, what="task")
    except TaskError:
        if name and (Path(name) / "task.yaml").is_file() and not _offered(name):
            return folder_task(Path(name))
        if "=" in name:
            raise TaskError(f"no task '{name}'", hint="overrides come after the task: TASK key.path=value") from None
        raise
    return installed_task(entry)


def _offered(name: str) -> bool:
    return any(entry.name == name for entry in catalog()[0])
