"""Lookup of tasks that are not installed: a folder with a YAML file, or a configuration in Python.

`rlcli.registry.find` calls this module for the path of a folder or file.
"""

import ast
import itertools
import os
import re
from pathlib import Path

from rlcli.errors import TaskError, listing
from rlcli.registry.formats import find_in_formats, require_format
from rlcli.registry.task_location import TaskSource


def folder_task(folder: Path, file: str = "task.yaml") -> TaskSource:
    """Return the task of a folder.

    The folder has one of these:
    - a `task.yaml`, and optionally `terms.py` and `task.py` (with a class `Task`),
    - a task file in another framework's format whose plugin is installed,
    - a configuration in Python: `TASK` in `task.py`, or a task that the package registers with Gymnasium.

    Args:
        folder: the folder.
        file: name of the YAML file in the folder.

    Raises:
        TaskError: if the folder has no task, or several tasks.
        DependencyError: if the task has a known format whose plugin is not installed.
    """
    root = folder.resolve()
    config = root / file
    if (root / "run.json").exists():
        raise TaskError(f"'{folder}' is a run, not a task", hint=f"use --checkpoint {folder}")
    if root.exists() and not root.is_dir():
        hint = f"did you mean '{folder.parent}'?" if root.is_file() else "give a folder with a task.yaml"
        raise TaskError(
            f"'{folder}' is a {'file' if root.is_file() else 'device or pipe'}, not a task's folder", hint=hint
        )
    if os.path.lexists(config) and not config.is_file():
        raise TaskError(f"'{config}' is not a regular file; put the task's YAML in its place")
    other = None
    if config.is_file():
        other = find_in_formats(config)
    elif file == "task.yaml" and root.is_dir():
        other = find_in_formats(root) or python_config(root)
    if other is not None:
        return other
    if not config.is_file():
        require_format(root)
        inside = sorted(root.iterdir()) if root.is_dir() else []
        tasks = [repr(str(folder / path.name)) for path in inside if (path / file).is_file()]
        found = listing(path.name for path in inside) if root.is_dir() else "no such folder"
        remedy = f"did you mean {' or '.join(tasks[:3])}?" if tasks else None
        if (root / "__init__.py").is_file() and (ids := _registered_ids(root)):
            remedy = f"the package registers tasks; write {folder}:ID with one of these IDs: {listing(ids)}"
        raise TaskError(f"'{folder}' is not a task, because it has no {file}; found: {found}", hint=remedy)
    terms, task = root / "terms.py", root / "task.py"
    return TaskSource(
        name=root.name,
        root=root,
        config=config,
        term_files=(terms,) if terms.is_file() else (),
        term_modules=(str(terms),) if terms.is_file() else (),
        task=f"{task}:Task" if task.is_file() else None,
        task_file=task if task.is_file() else None,
    )


def _registered_ids(root: Path) -> list[str]:
    """Return the IDs that the files of a package register with Gymnasium, found in their text without an import."""
    files = itertools.islice(sorted(root.rglob("*.py")), _MOST_FILES)
    texts = (file.read_bytes() for file in files if file.is_file() and not file.is_symlink())
    found = (match.decode(errors="replace") for text in texts for match in _REGISTERED.findall(text))
    return list(dict.fromkeys(found))


def _package_below(folder: Path, task: str) -> Path | None:
    """Return the package below a folder whose `__init__.py` registers the ID of a task; None if there is none."""
    for place, _, files in itertools.islice(os.walk(folder), _MOST_FILES):
        start = Path(place, "__init__.py")
        if start.name in files and start.is_file() and task.encode() in _REGISTERED.findall(start.read_bytes()):
            return start.parent
    return None


_MOST_FILES = 2000
_REGISTERED = re.compile(rb"""register\(\s*(?:id\s*=\s*)?["']([\w./:-]{1,200})["']""")


def python_config(root: Path) -> TaskSource | None:
    """Return the task of a folder without a YAML file; None if the folder has no task.

    The configuration is `TASK` in the folder's `task.py`, or the one that the package registers with Gymnasium.
    """
    if _defines(root / "task.py", "TASK"):
        return python_task(f"{root / 'task.py'}:TASK", root.name)
    if (root / "__init__.py").is_file() and b"register(" in (root / "__init__.py").read_bytes():
        return python_task(str(root))
    return None


def python_task(reference: str, name: str | None = None) -> TaskSource:
    """Return a task whose configuration is a Python object.

    `reference` is `file.py:attribute`, or the folder of a package: `folder` or `folder:ID`. The configuration of a
    package is the one that the package registers with Gymnasium under `ID`; without `ID`, the only registered one.

    Raises:
        TaskError: if there is no such file.
    """
    path, attribute = python_place(reference)
    if path.is_dir():
        file, label = path / "__init__.py", attribute or path.name
    else:
        file, label = path, path.stem
    if not file.is_file():
        package = _package_below(path, attribute) if attribute else None
        hint = f"{package} registers the task; write {package}:{attribute}" if package else None
        raise TaskError(f"there is no file '{file}'; check the path", hint=hint)
    if file == path and not attribute:
        raise TaskError(
            f"'{reference}' names no task in the file",
            hint=f"write {reference}:NAME, with the class, function or variable that is the task's configuration",
        )
    return TaskSource(
        name=name or re.sub(r"[^A-Za-z0-9_.-]", "-", label),
        root=file.parent,
        config=file,
        python=f"{path}:{attribute}" if attribute else str(path),
    )


def python_place(reference: str) -> tuple[Path, str]:
    """Split a reference such as `FILE.py:NAME` into the real path of the file or folder, and the name.

    The name is empty if the reference has none.
    """
    path, _, attribute = reference.rpartition(":")
    if not path or Path(reference).exists():
        return Path(reference).resolve(), ""
    return Path(path).resolve(), attribute


def _defines(file: Path, name: str) -> bool:
    """Return whether a Python file has a top-level assignment or definition of this name."""
    try:
        body = ast.parse(file.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return False
    for node in body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if getattr(node, "name", None) == name or any(isinstance(t, ast.Name) and t.id == name for t in targets):
            return True
    return False
