"""Validation errors of pydantic, said as a user reads them: the key, what was found, what is allowed, the near key."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterable
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from rlcli.config.strict_yaml import Path
from rlcli.errors import Problem, did_you_mean, listing

_EXPECTED = {
    "float": "a number",
    "int": "a whole number",
    "string": "text",
    "bool": "true or false",
    "dict": "a mapping",
    "model": "a mapping",
    "model_attributes": "a mapping",
    "list": "a list",
    "tuple": "a list",
    "none": "null",
}
_BOUNDS = {
    "greater_than": (">", "gt"),
    "greater_than_equal": (">=", "ge"),
    "less_than": ("<", "lt"),
    "less_than_equal": ("<=", "le"),
}


def problems(
    error: ValidationError, model: type[BaseModel], data: Any, place: Callable[[Path], str], prefix: Path = ()
) -> list[Problem]:
    """Every error as a Problem; `data` is what was validated, `place` tells where a path was written."""
    grouped: dict[Path, list[dict[str, Any]]] = {}
    for item in error.errors(include_url=False):
        grouped.setdefault(_data_path(item, data), []).append(item)  # type: ignore[arg-type]
    return [_problem(path, items, model, data, place, prefix) for path, items in grouped.items()]


def dotted(path: Path) -> str:
    """`('rewards', 'alive', 0)` -> `rewards.alive.0`; a key with a dot is quoted."""
    return ".".join(f'"{part}"' if isinstance(part, str) and "." in part else str(part) for part in path)


def shown(value: Any) -> str:
    """A value as it would be written in YAML, cut short."""
    text = {True: "true", False: "false", None: "null"}.get(value) if isinstance(value, bool | None) else None
    text = text or ("a mapping" if isinstance(value, dict) else repr(value))
    return text if len(text) <= 60 else text[:57] + "..."


def _problem(
    path: Path,
    items: list[dict[str, Any]],
    model: type[BaseModel],
    data: Any,
    place: Callable[[Path], str],
    prefix: Path,
) -> Problem:
    kind = items[0]["type"]
    where, key = place(prefix + path), dotted(prefix + path)
    if kind == "extra_forbidden":
        fields = _fields(model, path[:-1])
        near = did_you_mean(str(path[-1]), fields)
        return Problem(where, key, f"unknown key '{path[-1]}'", near or f"allowed: {listing(sorted(fields))}")
    if kind == "missing":
        parent = path[:-1]
        return Problem(place(prefix + parent), dotted(prefix + parent), f"missing key '{path[-1]}'")
    if kind == "value_error":
        return Problem(where, key, str(items[0]["ctx"]["error"]))
    allowed, found = _allowed(items), shown(items[0]["input"])
    hint = None
    if kind == "literal_error" and isinstance(items[0]["input"], str):
        hint = did_you_mean(
            items[0]["input"],
            [w.strip("'") for w in items[0]["ctx"]["expected"].replace(" or ", ", ").split(", ")],
        )
    return Problem(where, key, f"expected {allowed}, found {found}", hint)


def _allowed(items: Iterable[dict[str, Any]]) -> str:
    seen: dict[str, None] = {}
    for item in items:
        seen.setdefault(_expected(item))
    return " or ".join(seen)


def _expected(item: dict[str, Any]) -> str:
    kind, context = item["type"], item.get("ctx", {})
    if kind in _BOUNDS:
        sign, key = _BOUNDS[kind]
        return f"a number {sign} {context[key]:g}"
    if kind == "literal_error":
        return context["expected"]
    if kind in ("too_short", "too_long"):
        bound = context.get("min_length", context.get("max_length"))
        return f"{'at least' if kind == 'too_short' else 'at most'} {bound} items"
    if kind == "finite_number":
        return "a finite number"
    if kind == "int_from_float":
        return "a whole number"
    stem = kind.removesuffix("_type").removesuffix("_parsing").removesuffix("_required")
    return _EXPECTED.get(stem, item["msg"])


def _data_path(item: dict[str, Any], data: Any) -> Path:
    """The error's location with pydantic's union tags dropped: only steps that the data can take are kept."""
    path: list[str | int] = []
    location = item["loc"]
    for position, step in enumerate(location):
        last = position == len(location) - 1
        if isinstance(data, dict) and (step in data or (last and item["type"] == "missing")):
            path.append(step)
            data = data.get(step)
        elif isinstance(data, list) and isinstance(step, int):
            path.append(step)
            data = data[step] if step < len(data) else None
    return tuple(path)


def _fields(model: Any, path: Path) -> set[str]:
    """Keys that the mapping at `path` may have, following the model's annotations."""
    current = model
    for step in path:
        current = next(iter(_children(current, step)), None)
    arms = [arm for arm in _arms(current) if isinstance(arm, type) and issubclass(arm, BaseModel)]
    return {name for arm in arms for name in arm.model_fields}


def _children(annotation: Any, step: str | int) -> Iterable[Any]:
    for arm in _arms(annotation):
        if isinstance(arm, type) and issubclass(arm, BaseModel):
            if step in arm.model_fields:
                yield arm.model_fields[str(step)].annotation
        elif get_origin(arm) is dict:
            yield get_args(arm)[1]
        elif get_origin(arm) in (list, tuple):
            yield get_args(arm)[0]


def _arms(annotation: Any) -> Iterable[Any]:
    if get_origin(annotation) in (Union, types.UnionType):
        for arm in get_args(annotation):
            yield from _arms(arm)
    elif hasattr(annotation, "__metadata__"):
        yield from _arms(get_args(annotation)[0])
    elif annotation is not None:
        yield annotation
