"""Search for the class of a task in Python files, which are parsed and never imported."""

from __future__ import annotations

import ast
from pathlib import Path

from rlcli.errors import listing


def find_class(folder: Path, name: str) -> tuple[Path, str]:
    """Return the file and the name of a task's class: from `task.py`, or from any Python file below the folder.

    Raises:
        LookupError: with the classes that were found instead.
    """
    own = folder / "task.py"
    files = [own] if own.is_file() else sorted(folder.rglob("*.py"))
    classes: list[tuple[Path, str, list[str]]] = []
    for file in files[:500]:
        classes += [(file, *found) for found in _classes(file)]
    for class_name in ("Task", f"{name}Task", f"{name}LocomotionTask", name):
        exact = [(file, cls) for file, cls, _ in classes if cls == class_name]
        outer = min((len(file.parts) for file, _ in exact), default=0)
        exact = [found for found in exact if len(found[0].parts) == outer]  # variants of a task are in deeper folders
        if len(exact) == 1:
            return exact[0]
    bases = {base for _, _, all_bases in classes for base in all_bases}
    tasks = [(file, cls) for file, cls, of in classes if cls not in bases and any(base.endswith("Task") for base in of)]
    matching = [found for found in tasks if found[1].lower().startswith(name.lower())]
    for candidates in (matching, tasks):
        if len(candidates) == 1:
            return candidates[0]
    where = "task.py" if own.is_file() else "any Python file of the folder"
    if not tasks:
        raise LookupError(f"no task class in {where}; name the class '{name}Task'")
    found = listing(cls for _, cls in tasks)
    raise LookupError(f"found several task classes in {where}: {found}; rename the right one to '{name}Task'")


def _classes(file: Path) -> list[tuple[str, list[str]]]:
    return [
        (node.name, [ast.unparse(base).rpartition(".")[2] for base in node.bases])
        for node in parse_file(file).body
        if isinstance(node, ast.ClassDef)
    ]


def class_constant(file: Path | None, name: str | None, attribute: str) -> float | None:
    """Return the number that a class assigns to an attribute of `self` in its source; None if there is none.

    Args:
        file: file of the class; None: there is none.
        name: name of the class.
        attribute: name of the attribute, such as `_max_episode_length`.
    """
    if file is None:
        return None
    for owner in parse_file(file).body:
        if not isinstance(owner, ast.ClassDef) or owner.name != name:
            continue
        for node in ast.walk(owner):
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant):
                named = any(isinstance(t, ast.Attribute) and t.attr == attribute for t in node.targets)
                if named and isinstance(node.value.value, int | float):
                    return float(node.value.value)
    return None


def parse_file(file: Path) -> ast.Module:
    """Parse a Python file; return an empty module if it cannot be read or parsed."""
    try:
        return ast.parse(file.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, UnicodeDecodeError):
        return ast.Module([], [])
