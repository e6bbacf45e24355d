"""Reader of the strings below the fields of a pydantic model, which document the fields.

These strings become the descriptions in the JSON Schema, which the reference pages and editors show.
"""

import ast
import functools
import inspect
import itertools
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from pydantic import BaseModel


def describe(schema: dict[str, Any], model: type[BaseModel]) -> None:
    """Add the docstrings of a model's fields to its JSON Schema, as `description`. Existing descriptions are kept."""
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
    """Return the docstrings below the fields of a module's classes: result[qualified class name][field].

    Two classes with the same qualified name are left out, because the right one is unknown.
    """
    try:
        tree = ast.parse(inspect.getsource(module))
    except (OSError, TypeError, SyntaxError, ValueError):  # no source: a built-in module, or an interactive session
        return {}
    found: dict[str, dict[str, str]] = {}
    for name, body in _classes(tree, ""):
        found[name] = {} if name in found else dict(_field_docstrings(body))
    return found


def _classes(node: ast.AST, prefix: str) -> Iterator[tuple[str, list[ast.stmt]]]:
    """Yield qualified name and body of every class in a syntax tree."""
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.ClassDef):
            yield prefix + inner.name, inner.body
            yield from _classes(inner, f"{prefix}{inner.name}.")
        elif isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _classes(inner, f"{prefix}{inner.name}.<locals>.")
        elif not isinstance(inner, ast.expr):  # statements with a body, such as `if` and `try`
            yield from _classes(inner, prefix)


def _field_docstrings(body: list[ast.stmt]) -> Iterator[tuple[str, str]]:
    """Yield name and docstring of every annotated field that a string follows."""
    for field, below in itertools.pairwise(body):
        match field, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                yield name, inspect.cleandoc(text)
