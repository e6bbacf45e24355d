"""Tasks of no installed package: a folder with a YAML, or a configuration in a Python file or package."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from rlcli.errors import TaskError, listing
from rlcli.registry.formats import find_in_formats, require_format
from rlcli.registry.source import TaskSource


def folder_task(folder: Path, file: str = "task.yaml") -> TaskSource:
    """Return the task of a folder: a `task.yaml`, and optionally `terms.py` and `task.py` (a class `Task`).

    Or a task in another format that is installed. Without either the configuration is in Python: `TASK` in `task.py`,
    or what the package registers.

    Raises:
        TaskError: if it is none, or holds several.
        DependencyError: if it has a known format whose plugin is not installed.
    """
    root = folder.resolve()
    config = root / file
    if (root / "run.json").exists():
        raise TaskError(f"'{folder}' is a run, not a task", hint=f"--checkpoint {folder}")
    if root.is_file():
        raise TaskError(f"'{folder}' is a file, not a task's folder", hint=f"did you mean '{folder.parent}'?")
    other = None
    if config.is_file():
        other = find_in_formats(config)
    elif file == "task.yaml" and root.is_dir():
        other = find_in_formats(root) or python_config(root)
    if other is not None:
        return other
    if not config.is_file():
        require_format(root)
        found = listing(sorted(p.name for p in root.iterdir())) if root.is_dir() else "no such folder"
        raise TaskError(f"'{folder}' is not a task: it has no {file} ({found})")
    terms, task = root / "terms.py", root / "task.py"
    return TaskSource(
        name=root.name,
        root=root,
        config=config,
        distribution=None,
        version=None,
        term_files=(terms,) if terms.is_file() else (),
        term_modules=(str(terms),) if terms.is_file() else (),
        task=f"{task}:Task" if task.is_file() else None,
        task_file=task if task.is_file() else None,
    )


def python_config(root: Path) -> TaskSource | None:
    """Return the task of a folder without a YAML: `TASK` in its `task.py`, or what the package registers."""
    if _defines(root / "task.py", "TASK"):
        return python_task(f"{root / 'task.py'}:TASK", root.name)
    if (root / "__init__.py").is_file() and b"register(" in (root / "__init__.py").read_bytes():
        return python_task(str(root))
    return None


def python_task(reference: str, name: str | None = None) -> TaskSource:
    """A task whose configuration is a Python object: `file.py:attribute`, or a package's `folder` or `folder:ID`.

    Of a package the configuration is the `TASK` of its `task.py`, or what it registered with gymnasium (as `ID`).

    Raises:
        TaskError: if there is no such file.
    """
    path, attribute = python_place(reference)
    if path.is_dir():
        file, label = path / "__init__.py", attribute or path.name
    else:
        file, label = path, path.stem
    if not file.is_file():
        raise TaskError(f"there is no file '{file}'")
    if file == path and not attribute:
        raise TaskError(f"'{reference}' does not say which object", hint=f"{reference}:TASK, for example")
    return TaskSource(
        name=name or re.sub(r"[^A-Za-z0-9_.-]", "-", label),
        root=file.parent,
        config=file,
        distribution=None,
        version=None,
        term_files=(),
        term_modules=(),
        task=None,
        task_file=None,
        python=f"{path}:{attribute}" if attribute else str(path),
    )


def python_place(reference: str) -> tuple[Path, str]:
    """The file or folder of a configuration in Python, links resolved, and the name in it ('' if it has none)."""
    place, _, attribute = reference.rpartition(":")
    if not place or Path(reference).exists():
        return Path(reference).resolve(), ""
    return Path(place).resolve(), attribute


def _defines(file: Path, name: str) -> bool:
    """Whether a Python file has a top-level assignment or definition of this name."""
    for node in _body(file):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if getattr(node, "name", None) == name or any(isinstance(t, ast.Name) and t.id == name for t in targets):
            return True
    return False


def _body(file: Path) -> list[ast.stmt]:
    try:
        return ast.parse(file.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return []
