"""What stands below the settings in a model's source, as descriptions in its JSON Schema."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from pydantic import BaseModel


def describe(schema: dict[str, Any], model: type[BaseModel]) -> None:
    """Put the docstrings of a model's fields into its schema, where they have no description of their own."""
    properties = schema.get("properties", {})
    for each in model.__mro__:
        module = each.__dict__.get("_defined_in")
        texts = {} if module is None else _class_docstrings(module).get(each.__qualname__, {})
        for name, field in model.model_fields.items():
            for key in {name, field.alias, field.serialization_alias} & properties.keys():
                if name in texts:
                    properties[key].setdefault("description", texts[name])


@functools.cache
def _class_docstrings(module: ModuleType) -> dict[str, dict[str, str]]:
    """Class, by its qualified name -> field -> the string that follows it. Two classes of one name say nothing."""
    try:
        tree = ast.parse(inspect.getsource(module))
    except (OSError, TypeError, SyntaxError, ValueError):  # built in, or typed into a prompt
        return {}
    found: dict[str, dict[str, str]] = {}
    for name, body in _classes(tree, ""):
        found[name] = {} if name in found else dict(_field_docstrings(body))
    return found


def _classes(node: ast.AST, outside: str) -> Iterator[tuple[str, list[ast.stmt]]]:
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.ClassDef):
            yield outside + inner.name, inner.body
            yield from _classes(inner, f"{outside}{inner.name}.")
        elif isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _classes(inner, f"{outside}{inner.name}.<locals>.")
        elif not isinstance(inner, ast.expr):  # an `if`, a `try` and what belongs to it
            yield from _classes(inner, outside)


def _field_docstrings(body: list[ast.stmt]) -> Iterator[tuple[str, str]]:
    for field, text in itertools.pairwise(body):
        match field, text:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(said))):
                yield name, inspect.cleandoc(said)
