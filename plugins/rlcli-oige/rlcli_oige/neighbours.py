"""Names that a task's file imports from `rlcli_oige` and that another file of the task defines."""

from __future__ import annotations

import ast
import builtins
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from rlcli.errors import did_you_mean
from rlcli.registry import load_module
from rlcli_oige.task_yaml import is_oige_file


def find(name: str, known: Iterable[str]) -> Any:
    """What another file of the task defines under a name.

    Raises:
        AttributeError: if none does; an import statement makes an ImportError of it.
    """
    importer = _importer()
    for file in _neighbours(importer) if importer else ():
        if name in _definitions(file):
            return getattr(load_module(str(file)), name)
    near = did_you_mean(name, known)
    raise AttributeError(f"rlcli_oige has no '{name}'{f'; {near}' if near else ''}")


def used(known: Iterable[str]) -> list[str]:
    """Names that the importing file uses, that it does not define itself, and that another file of the task defines."""
    importer = _importer()
    if importer is None:
        return []
    names = {node.id for node in ast.walk(_tree(importer)) if isinstance(node, ast.Name)}
    wanted = names - _definitions(importer) - set(known) - set(dir(builtins))
    return sorted(wanted & {name for file in _neighbours(importer) for name in _definitions(file)})


def _neighbours(importer: Path) -> Iterator[Path]:
    """The other Python files beside a file and below, and of what lies above up to the folder of the task's YAML."""
    seen = {importer}
    for place in _places(importer.parent):
        for file in sorted(place.rglob("*.py"))[:500]:
            if file not in seen:
                seen.add(file)
                yield file


def _places(folder: Path) -> list[Path]:
    above = [folder, *list(folder.parents)[:3]]
    home = next((depth for depth, place in enumerate(above) if any(map(_is_task, _yamls(place)))), None)
    if home is not None:
        return above[: home + 1]
    # a folder of views lies beside the folder of tasks: look a little further up, as long as it is a package
    return [folder, *(place for place in above[1:3] if (place / "__init__.py").is_file())]


def _is_task(file: Path) -> bool:
    return file.name == "task.yaml" or is_oige_file(file)


def _yamls(place: Path) -> Iterator[Path]:
    yield from sorted(place.glob("*.yaml"))
    yield from sorted(place.glob("cfg/task/*.yaml"))


def _importer() -> Path | None:
    """The file whose import statement is running."""
    frame = sys._getframe(1)
    own = Path(__file__).parent
    while frame is not None:
        file = frame.f_code.co_filename
        if not file.startswith("<") and Path(file).parent != own:
            return Path(file).resolve() if frame.f_code.co_name == "<module>" else None
        frame = frame.f_back  # type: ignore[assignment]
    return None


def _definitions(file: Path) -> set[str]:
    return {node.name for node in _tree(file).body if isinstance(node, ast.ClassDef | ast.FunctionDef)}


def _tree(file: Path) -> ast.Module:
    try:
        return ast.parse(file.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, UnicodeDecodeError):
        return ast.Module([], [])
