"""Names that a task's file imports from `rlcli.oige` and that another file of the task defines."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rlcli.errors import did_you_mean
from rlcli.registry import load_module


def find(name: str, known: Iterable[str]) -> Any:
    """What a file beside the importing one defines under a name.

    Raises:
        AttributeError: if none does; an import statement makes an ImportError of it.
    """
    importer = _importer()
    if importer is not None:
        folder = importer.parent
        # a folder of views lies beside the folder of tasks: look a little further up, as long as it is a package
        for place in [folder, *(p for p in list(folder.parents)[:2] if (p / "__init__.py").is_file())]:
            for file in sorted(place.rglob("*.py"))[:500]:
                if file != importer and name in _definitions(file):
                    return getattr(load_module(str(file)), name)
    near = did_you_mean(name, known)
    raise AttributeError(f"rlcli.oige has no '{name}'{f'; {near}' if near else ''}")


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
    try:
        tree = ast.parse(file.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, UnicodeDecodeError):
        return set()
    return {node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
