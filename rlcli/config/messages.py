"""Validation errors of pydantic, said as a user reads them: the key, what was found, what is allowed, the near key."""

from __future__ import annotations

import json
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from rlcli.config import strict_yaml
from rlcli.config.strict_yaml import Path
from rlcli.errors import Problem, did_you_mean, listing

_EXPECTED = {
    "float": "a number",
    "int": "a whole number",
    "int_from_float": "a whole number",
    "finite_number": "a finite number",
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

Homes = Mapping[str, list[str]]
"""Key -> the dotted places in the whole schema where it belongs."""


def problems(
    error: ValidationError,
    model: type[BaseModel],
    data: object,
    place: Callable[[Path], str],
    prefix: Path = (),
    homes: Homes | None = None,
) -> list[Problem]:
    """Every error as a Problem; `data` is what was validated, `place` tells where a path was written."""
    grouped: dict[Path, list[Any]] = {}
    for item in error.errors(include_url=False):
        path = _data_path(item, data)
        if item["type"] == "missing" and isinstance(path[-1], int):
            path = path[:-1]  # a list that is too short
        grouped.setdefault(path, []).append(item)
    found = []
    for path, items in grouped.items():
        if any(len(other) > len(path) and other[: len(path)] == path for other in grouped):
            continue  # an arm of a union that did not fit; another one got further
        message, hint, at = _message(path, items, model, data, homes or {})
        found.append(Problem(place(prefix + at), dotted(prefix + at), message, hint))
    return found


def dotted(path: Path) -> str:
    """`('rewards', 'alive', 0)` -> `rewards.alive.0`; a key with a dot is quoted."""
    return ".".join(f'"{part}"' if isinstance(part, str) and "." in part else str(part) for part in path)


def shown(value: object) -> str:
    """A value as it would be written in YAML, cut short."""
    if isinstance(value, dict):
        return "a mapping"
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=repr)
    return text if len(text) <= 60 else text[:57] + "..."


def homes(models: Mapping[str, type[BaseModel]]) -> dict[str, list[str]]:
    """Where each key belongs, in models that stand at dotted prefixes (the whole task stands at '')."""
    found: dict[str, list[str]] = {}
    for prefix, model in models.items():
        for key, place in _keys(model, prefix):
            found.setdefault(key, []).append(place)
    return found


def _message(
    path: Path, items: list[Any], model: type[BaseModel], data: object, homes: Homes
) -> tuple[str, str | None, Path]:
    """What to say, what to do, and at which path."""
    kind, found = items[0]["type"], items[0]["input"]
    if kind == "extra_forbidden":
        return f"unknown key '{path[-1]}'", _right_key(str(path[-1]), _fields(model, path[:-1]), homes), path
    if kind == "union_tag_not_found":
        return "missing key 'kind'", f"one of {listing(_tags(model, path))}", path
    if kind == "union_tag_invalid":
        tag = items[0]["ctx"]["tag"]
        near = did_you_mean(tag, _tags(model, path))
        return (
            f"expected {items[0]['ctx']['expected_tags'].replace(', ', ' or ')}, found {shown(tag)}",
            near,
            (*path, "kind"),
        )
    if kind == "value_error":
        return str(items[0]["ctx"]["error"]), None, path
    if kind == "missing" and isinstance(items[0]["loc"][-1], str):
        return f"missing key '{path[-1]}'", None, path[:-1]
    length = _length(model, path)
    if length is not None and kind in ("missing", "too_short", "too_long"):
        return f"expected a list of {length}, found {shown(_value_at(data, path))}", None, path
    hint = None
    if isinstance(found, str):
        choices = [word.strip("'") for item in items for word in _choices(item)]
        hint = did_you_mean(found, choices) or _unquoted(found, items)
    elif isinstance(found, dict) and found and all(key.isdecimal() for key in found):
        hint = "its default has no items to change; give the whole list"
    return f"expected {' or '.join(dict.fromkeys(map(_expected, items)))}, found {shown(found)}", hint, path


_OTHER_PLACES = {
    "env": ("scene", "leave 'env.' out: the task's settings stand at the top, as scene.num_envs"),
    "params": ("func", "the parameters of a term stand beside its 'func'"),
    "device": ("dt", "it is an option: --device cpu"),
}
"""Key -> a key that stands where it is looked for, and what to write instead."""


def _right_key(key: str, fields: Iterable[str], homes: Homes) -> str:
    fields = list(fields)
    beside, instead = _OTHER_PLACES.get(key, ("", ""))
    if beside in fields:
        return instead
    near = did_you_mean(key, fields)
    places = homes.get(key, [])
    home = f"it belongs {' or '.join(map(_inside, places))}" if 0 < len(places) <= 3 else None
    if near or home:
        return "; ".join(filter(None, (near, home)))
    return f"allowed: {listing(sorted(fields), 40)}"


def _inside(place: str) -> str:
    parent = place.rpartition(".")[0]
    return f"in {parent} ({place})" if parent else "at the top level"


def _expected(item: Any) -> str:
    kind, context = item["type"], item.get("ctx", {})
    if kind in _BOUNDS:
        sign, key = _BOUNDS[kind]
        bound = context[key]
        whole = "whole " if isinstance(item["input"], int) and not isinstance(bound, float) else ""
        return f"a {whole}number {sign} {bound if isinstance(bound, int) else f'{bound:g}'}"
    if kind == "literal_error":
        return str(context["expected"])
    if kind in ("too_short", "too_long"):
        bound = context.get("min_length", context.get("max_length"))
        return f"{'at least' if kind == 'too_short' else 'at most'} {bound} item{'s' if bound != 1 else ''}"
    if kind == "string_pattern_mismatch":
        return f"text like {context['pattern']}"
    if kind in ("string_too_short", "string_too_long"):
        bound = f"{'at least' if kind == 'string_too_short' else 'at most'}"
        return f"text of {bound} {context.get('min_length', context.get('max_length'))} characters"
    stem = kind.removesuffix("_type").removesuffix("_parsing").removesuffix("_required")
    return _EXPECTED.get(stem) or str(item["msg"])


def _choices(item: Any) -> list[str]:
    return item["ctx"]["expected"].replace(" or ", ", ").split(", ") if item["type"] == "literal_error" else []


def _unquoted(text: str, items: Iterable[Any]) -> str | None:
    """Quotes around a number or a truth value are a common slip."""
    try:
        value = strict_yaml.load_value(text)
    except strict_yaml.YamlError:
        return None
    wanted = {_expected(item) for item in items}
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if (number and wanted & {"a number", "a whole number"}) or (isinstance(value, bool) and "true or false" in wanted):
        return "drop the quotes"
    return None


def _data_path(item: Any, data: Any) -> Path:
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


def _value_at(data: Any, path: Path) -> Any:
    for step in path:
        data = data[step]
    return data


def _fields(model: type[BaseModel], path: Path) -> set[str]:
    """Keys that the mapping at `path` may have, following the model's annotations."""
    return {name for arm in _arms_at(model, path) if _is_model(arm) for name in arm.model_fields}


def _tags(model: type[BaseModel], path: Path) -> list[str]:
    """Values of `kind` that tell the mappings apart which may stand at `path`."""
    kinds = [arm.model_fields["kind"].annotation for arm in _arms_at(model, path) if _is_model(arm)]
    return [tag for kind in kinds for tag in get_args(kind)]


def _length(model: type[BaseModel], path: Path) -> int | None:
    """Items of the list at `path`, where the model says how many."""
    for arm in _arms_at(model, path):
        if get_origin(arm) is tuple and get_args(arm)[-1] is not ...:
            return len(get_args(arm))
    return None


def _arms_at(model: type[BaseModel], path: Path) -> list[Any]:
    arms: list[Any] = [model]
    for step in path:
        arms = [below for arm in arms for child in _children(arm, step) for below in _arms(child)]
    return arms


def _children(arm: Any, step: str | int) -> Iterator[Any]:
    if _is_model(arm):
        if step in arm.model_fields:
            yield arm.model_fields[step].annotation
    elif get_origin(arm) is dict:
        yield get_args(arm)[1]
    elif get_origin(arm) in (list, tuple):
        yield get_args(arm)[0]


def _arms(annotation: object) -> Iterator[Any]:
    if get_origin(annotation) in (Union, types.UnionType):
        for arm in get_args(annotation):
            yield from _arms(arm)
    elif hasattr(annotation, "__metadata__"):
        yield from _arms(get_args(annotation)[0])
    elif annotation is not None:
        yield annotation


def _keys(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str]]:
    for name, field in model.model_fields.items():
        place = f"{prefix}.{name}".lstrip(".")
        yield name, place
        for arm in _arms(field.annotation):
            inner, below = arm, place
            while get_origin(inner) is dict:
                inner, below = next(_arms(get_args(inner)[1])), f"{below}.NAME"
            if _is_model(inner):
                yield from _keys(inner, below)


def _is_model(arm: object) -> bool:
    return isinstance(arm, type) and issubclass(arm, BaseModel)
