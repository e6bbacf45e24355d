"""What stands below the settings in a model's source, as descriptions in its JSON Schema."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import sys
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel


def describe(schema: dict[str, Any], model: type[BaseModel]) -> None:
    """Put the docstrings of a model's fields into its schema, where they have no description of their own."""
    for each in model.__mro__:
        texts = _texts(each.__module__).get(each.__qualname__, {})
        for name in texts.keys() & schema.get("properties", {}).keys():
            schema["properties"][name].setdefault("description", texts[name])


@functools.cache
def _texts(module: str) -> dict[str, dict[str, str]]:
    """Class, by its qualified name -> field -> the string that follows it."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (KeyError, OSError, TypeError, SyntaxError, ValueError):  # built in, or typed into a prompt
        return {}
    return {name: dict(_followed(found.body)) for name, found in _classes(tree, "")}


def _classes(node: ast.AST, outside: str) -> Iterator[tuple[str, ast.ClassDef]]:
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.ClassDef):
            yield outside + inner.name, inner
            yield from _classes(inner, f"{outside}{inner.name}.")
        elif isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _classes(inner, f"{outside}{inner.name}.<locals>.")
        elif isinstance(inner, ast.stmt):  # an `if`, a `try`
            yield from _classes(inner, outside)


def _followed(body: list[ast.stmt]) -> Iterator[tuple[str, str]]:
    for field, text in itertools.pairwise(body):
        match field, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(said))):
                yield name, inspect.cleandoc(said)
