"""Search for names that a task's file imports from `rlcli_oige` and that another file of the task defines."""

from __future__ import annotations

import ast
import builtins
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rlcli.errors import did_you_mean
from rlcli.registry import load_module
from rlcli.registry.framework_imports import TaskFileLoader
from rlcli_oige.task_class import parse_file
from rlcli_oige.task_yaml import is_oige_file


def find(name: str, known: Iterable[str]) -> Any:
    """Return the object that another file of the task defines under a name.

    Raises:
        AttributeError: if no file defines it; an import statement turns this into an ImportError.
    """
    importer = _importer()
    for file in _other_files(importer) if importer else ():
        if name in _definitions(file):
            return getattr(load_module(str(file)), name)
    near = did_you_mean(name, known)
    raise AttributeError(f"rlcli_oige has no name '{name}'; {near or 'rlcli_oige.vocabulary.NAMES lists the names'}")


def used_names(known: Iterable[str]) -> list[str]:
    """Return the names that the importing file uses but does not define, and that another file of the task defines."""
    importer = _importer()
    if importer is None:
        return []
    names = {node.id for node in ast.walk(parse_file(importer)) if isinstance(node, ast.Name)}
    missing = names - _definitions(importer) - set(known) - set(dir(builtins))
    return sorted(missing & {name for file in _other_files(importer) for name in _definitions(file)})


def _other_files(importer: Path) -> Iterator[Path]:
    """Yield the task's other Python files: those in the folders of `_search_folders` and below them.

    `importer` is the file whose import statement is running.
    """
    seen = {importer}
    for folder in _search_folders(importer.parent):
        for file in sorted(folder.rglob("*.py"))[:500]:
            if file not in seen:
                seen.add(file)
                yield file


def _search_folders(folder: Path) -> list[Path]:
    """Return the folders of a task's Python files: a folder and its parents up to the folder of the task's YAML."""
    above = [folder, *list(folder.parents)[:3]]
    home = next((depth for depth, parent in enumerate(above) if any(map(_is_task, _yamls(parent)))), None)
    if home is not None:
        return above[: home + 1]
    # no YAML was found: search the parent packages too, because the folder of views may lie beside that of tasks
    return [folder, *(parent for parent in above[1:3] if (parent / "__init__.py").is_file())]


def _is_task(file: Path) -> bool:
    return file.name == "task.yaml" or is_oige_file(file)


def _yamls(folder: Path) -> Iterator[Path]:
    yield from sorted(folder.glob("*.yaml"))
    yield from sorted(folder.glob("cfg/task/*.yaml"))


def _importer() -> Path | None:
    """Return the file whose import statement is running; None if the import is inside a function."""
    frame = sys._getframe(1)
    while frame is not None:
        if isinstance(frame.f_globals.get("__loader__"), TaskFileLoader):
            return Path(frame.f_code.co_filename).resolve() if frame.f_code.co_name == "<module>" else None
        frame = frame.f_back  # type: ignore[assignment]
    return None


def _definitions(file: Path) -> set[str]:
    return {node.name for node in parse_file(file).body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
