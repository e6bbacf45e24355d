"""Classes in their source text, and the bases that can be found beside them: nothing is imported."""

from __future__ import annotations

import ast
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

MOST = 64
"""How many classes one search looks at: a stranger's files may name each other in a circle."""


@dataclass(frozen=True, slots=True)
class SourceClass:
    """A class as a file writes it."""

    file: Path
    node: ast.ClassDef

    def nested(self, name: str) -> SourceClass | None:
        """The class of this name in its body."""
        node = next((n for n in self.node.body if isinstance(n, ast.ClassDef) and n.name == name), None)
        return None if node is None else SourceClass(self.file, node)


def parse(file: Path) -> ast.Module:
    """The syntax tree of a file.

    Raises:
        SyntaxError: if the file is not Python.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ast.parse(file.read_bytes(), filename=str(file))
    except SyntaxError as error:
        error.filename = str(file)  # absent where there is a null byte
        raise
    except (ValueError, RecursionError, MemoryError) as error:
        raise SyntaxError(str(error) or "nested too deeply", (str(file), 1, 1, None)) from None


def lineage(file: Path, name: str) -> list[SourceClass]:
    """A class and those that it inherits from, depth first, each once; empty if the file has no such class.

    Bases are followed where their source is at hand: in the same file, or in another one of the same package.

    Raises:
        SyntaxError: if one of the files is not Python.
    """
    return _Search().lineage(file, name)


def nested_lineage(file: Path, name: str, nested: str) -> list[SourceClass]:
    """The same of a class that is written in the body of another, or of one that the other inherits from.

    Raises:
        SyntaxError: if one of the files is not Python.
    """
    search = _Search()
    found = search.nested(file, name, nested)
    return [] if found is None else list(search.walk(found))


class _Search:
    def __init__(self) -> None:
        self._trees: dict[Path, ast.Module] = {}
        self._left = MOST

    def lineage(self, file: Path, name: str) -> list[SourceClass]:
        first = self._find(file, name)
        return [] if first is None else list(self.walk(first))

    def nested(self, file: Path, outer: str, name: str) -> SourceClass | None:
        found = (owner.nested(name) for owner in self.lineage(file, outer))
        return next((inner for inner in found if inner is not None), None)

    def walk(self, first: SourceClass, seen: set[ast.ClassDef] | None = None) -> Iterator[SourceClass]:
        seen = set() if seen is None else seen
        if first.node in seen or not self._left:
            return
        self._left -= 1
        seen.add(first.node)
        yield first
        for expression in first.node.bases:
            base = self._base(first.file, expression)
            if base is not None:
                yield from self.walk(base, seen)

    def _base(self, file: Path, expression: ast.expr) -> SourceClass | None:
        if isinstance(expression, ast.Name):
            return self._find(file, expression.id)
        if isinstance(expression, ast.Attribute) and isinstance(expression.value, ast.Name):
            return self.nested(file, expression.value.id, expression.attr) if self._left else None
        return None

    def _find(self, file: Path, name: str) -> SourceClass | None:
        """The class that a file defines or imports by this name; None for rlcli's own, and for what is not found."""
        for node in self._tree(file).body:
            if isinstance(node, ast.ClassDef) and node.name == name:
                return SourceClass(file, node)
            if not isinstance(node, ast.ImportFrom):
                continue
            real = next((alias.name for alias in node.names if (alias.asname or alias.name) == name), None)
            parts = (node.module or "").split(".")
            if real is None or parts[0] == "rlcli":
                continue
            roots = file.parents[node.level - 1 : node.level] if node.level else file.parents
            for root in roots:
                for other in (root.joinpath(*parts).with_suffix(".py"), root.joinpath(*parts, "__init__.py")):
                    if other.is_file() and other != file and self._left:
                        self._left -= 1
                        return self._find(other, real)
        return None

    def _tree(self, file: Path) -> ast.Module:
        if file not in self._trees:
            self._trees[file] = parse(file)
        return self._trees[file]
