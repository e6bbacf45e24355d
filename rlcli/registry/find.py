"""Lookup of a task by the word that the user typed: a name, a folder or a file.

Installed tasks are searched first.
"""

import os
from dataclasses import replace
from pathlib import Path

from rlcli.errors import TaskError
from rlcli.registry.entries import TASKS, catalog, find_entry
from rlcli.registry.formats import find_in_formats, require_format
from rlcli.registry.local_tasks import folder_task, python_task
from rlcli.registry.locate_installed_tasks import installed_task, task_of_file
from rlcli.registry.task_location import TaskSource

KEYWORDS = ("latest", "shipped")
"""Keywords for the newest run (`latest`) and for the policy that a task ships (`shipped`); they never name a folder."""


def path_of(word: str) -> Path:
    """Return the path that a word of the command line names.

    A keyword (`latest`, also in `latest@best`) never names a file: the returned path does not exist. Write `./latest`
    for a folder called `latest`.
    """
    return Path(os.devnull, word) if word.partition("@")[0] in KEYWORDS else Path(word)


def find_task(name: str) -> TaskSource:
    """Return a task by name, by `distribution:name`, by the path of its folder, or as `file.py:attribute`.

    Installed tasks are searched first: a folder with the name of an installed task needs a slash, `./cartpole`. A
    folder with the name of a keyword also needs a slash, `./latest`.

    Raises:
        TaskError: if the task is unknown, ambiguous, broken, or needs a newer rlcli.
    """
    path_part, _, attribute = name.rpartition(":")
    is_package = attribute and os.sep not in attribute and "/" in path_part and Path(path_part).is_dir()
    if path_part.endswith(".py") or is_package:
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
        if name and path_of(name).is_dir() and all(entry.name != name for entry in catalog()[0]):
            return folder_task(Path(name))
        if name in KEYWORDS and Path(name).is_dir():
            raise TaskError(f"no task '{name}'", hint=f"write ./{name} for the folder") from None
        if "=" in name:
            raise TaskError(f"no task '{name}'", hint="overrides come after the task: TASK key.path=value") from None
        raise
    return installed_task(entry)


def task_source(target: str) -> TaskSource:
    """Return a task by its name, its folder, or any YAML file that describes a task.

    Raises:
        TaskError: if there is no such task.
    """
    file = Path(target)
    if file.suffix not in (".yaml", ".yml"):
        return find_task(target)
    if not file.is_file():
        raise TaskError(f"no file '{target}'; check the path")
    # for a YAML file of an installed task return that task: a folder task would not have its terms and its class
    return task_of_file(file) or replace(folder_task(file.parent, file.name), name=file.stem)
