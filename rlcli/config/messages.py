"""Conversion of pydantic's validation errors to messages for users.

A message names the wrong key, the value found and the allowed values; a hint may name a similar key.
"""

import functools
import json
import operator
import types
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from rlcli.config import strict_yaml
from rlcli.config.strict_yaml import Path
from rlcli.errors import Problem, did_you_mean, listing
from rlcli.safe_text import shorten

_EXPECTED = {
    "float": "a number",
    **dict.fromkeys(("int", "int_from_float"), "a whole number"),
    "finite_number": "a finite number",
    "string": "text",
    "bool": "true or false",
    **dict.fromkeys(("dict", "model", "model_attributes"), "a mapping"),
    **dict.fromkeys(("list", "tuple"), "a list"),
    "none": "null",
}
_BOUNDS = {
    "greater_than": (">", "gt"),
    "greater_than_equal": (">=", "ge"),
    "less_than": ("<", "lt"),
    "less_than_equal": ("<=", "le"),
}

KeyLocations = Mapping[str, list[str]]
"""Key, such as `num_envs` -> the dotted paths at which a task file may have it, such as `scene.num_envs`."""


def problems(
    error: ValidationError,
    model: type[BaseModel],
    data: object,
    place: Callable[[Path], str],
    prefix: Path = (),
    locations: KeyLocations | None = None,
) -> Iterator[Problem]:
    """Yield pydantic's errors as `Problem`s: with the location in the file, and in words for users.

    Args:
        error: the error that pydantic raised.
        model: the model that validated the data.
        data: the data that was validated.
        place: returns the location of the value at a path, such as `file:line:column`.
        prefix: path of the data in the whole configuration.
        locations: where each key belongs in the whole schema, for hints about misplaced keys.
    """
    grouped: dict[Path, list[Any]] = {}
    for item in error.errors(include_url=False):
        path = _data_path(item, data)
        if item["type"] == "missing" and isinstance(path[-1], int):
            path = path[:-1]  # a tuple that is too short: report the list, not the missing item
        grouped.setdefault(path, []).append(item)
    outer = {path[:length] for path in grouped for length in range(len(path))}
    for path, items in grouped.items():
        if path in outer:
            # the error belongs to one alternative of a union; the error of another alternative is more precise
            continue
        message, hint, at = _message(path, items, model, data, locations or {}, top=not prefix)
        yield Problem(place(prefix + at), dotted(prefix + at), message, hint)


def dotted(path: Path) -> str:
    """Return the dotted key of a path: `('rewards', 'alive', 0)` -> `rewards.alive.0`. A key with a dot is quoted."""
    return ".".join(f'"{part}"' if isinstance(part, str) and "." in part else str(part) for part in path)


def format_value(value: object) -> str:
    """Return a value as text for a message, cut to 60 characters; a mapping becomes the words `a mapping`."""
    if isinstance(value, dict):
        return "a mapping"
    return shorten(repr(value) if isinstance(value, str) else json.dumps(value, default=repr), 60)


def key_locations(models: Mapping[str, type[BaseModel]]) -> dict[str, list[str]]:
    """Return, for each key of some pydantic models, the dotted paths at which a task file may have the key.

    `models` maps the dotted path of a model in the configuration to the model; the path of the task's model is ''.
    """
    found: dict[str, list[str]] = {}
    for prefix, model in models.items():
        for key, location in _keys(model, prefix):
            found.setdefault(key, []).append(location)
    return found


def _message(
    path: Path, items: list[Any], model: type[BaseModel], data: object, locations: KeyLocations, top: bool
) -> tuple[str, str | None, Path]:
    """Return the message, the hint and the path for `items`, all errors of pydantic at one path of the data.

    `top` is True if `model` describes a whole file.
    """
    kind, found = items[0]["type"], items[0]["input"]
    if kind == "extra_forbidden":
        return f"unknown key '{path[-1]}'", _suggest_key(str(path[-1]), _fields(model, path[:-1]), locations), path
    if kind == "union_tag_not_found":
        return "missing key 'kind'", f"allowed: {listing(_tags(model, path))}", path
    if kind == "union_tag_invalid":
        tag, expected = items[0]["ctx"]["tag"], items[0]["ctx"]["expected_tags"].replace(", ", " or ")
        similar = did_you_mean(tag, _tags(model, path))
        return f"expected {expected}, found {format_value(tag)}", similar, (*path, "kind")
    refused = [item for item in items if item["type"] == "value_error"]  # a validator of a union's member failed
    if refused:
        return str(refused[0]["ctx"]["error"]), None, path
    if kind == "missing" and isinstance(items[0]["loc"][-1], str):
        where = " at the top level" if top and len(path) == 1 else ""
        own = "a new term needs 'func'; `rlcli terms` lists the functions" if path[-1] == "func" else None
        return f"missing key '{path[-1]}'{where}", own, path[:-1]
    length = _length(model, path)
    if length is not None and kind in ("missing", "too_short", "too_long"):
        value: Any = functools.reduce(operator.getitem, path, data)  # type: ignore[arg-type]
        return f"expected a list of {length} values, found {format_value(value)}", None, path
    hint = None
    if isinstance(found, str):
        choices = [word.strip("'") for item in items for word in _choices(item)]
        hint = did_you_mean(found, choices) or _unquoted(found, items)
    elif isinstance(found, dict) and found and all(key.isdecimal() for key in found):
        # an override of one item, such as `size.0=1`, created a mapping
        hint = "the default is not a list, so no single item can change; give the whole list"
    return expected_and_found(items), hint, path


def expected_and_found(items: Sequence[Any]) -> str:
    """Return `expected ..., found ...` for `items`, pydantic's errors of one value."""
    wanted = " or ".join(dict.fromkeys(map(_expected, items)))
    return f"expected {wanted}, found {format_value(items[0]['input'])}"


_KEYS_OF_OTHER_FRAMEWORKS = {
    "env": ("scene", "remove 'env.': the keys of a task are at the top level, for example scene.num_envs"),
    "params": ("func", "write the parameters of a term beside its 'func'"),
    "device": ("dt", "the device is an option: --device cpu"),
}
"""Key that users of other frameworks write -> hint about what to write instead, and when this hint applies.

The hint applies if the mapping may have a certain other key; a value is (this other key, hint)."""


def _suggest_key(key: str, fields: Iterable[str], locations: KeyLocations) -> str:
    """Return the hint for an unknown key of a mapping: a similar key, where the key belongs, or the allowed keys.

    Args:
        key: the unknown key.
        fields: the keys that the mapping may have.
        locations: where each key belongs in the whole schema.
    """
    fields = list(fields)
    beside, instead = _KEYS_OF_OTHER_FRAMEWORKS.get(key, ("", ""))
    if beside in fields:
        return instead
    similar = did_you_mean(key, fields)
    elsewhere = [] if "func" in fields else locations.get(key, [])  # the keys of a term have their own meaning
    belongs = f"the key belongs {' or '.join(map(_inside, elsewhere))}" if 0 < len(elsewhere) <= 3 else None
    if similar or belongs:
        return "; ".join(filter(None, (similar, belongs)))
    return f"allowed: {listing(sorted(fields), 40)}"


def _inside(location: str) -> str:
    parent = location.rpartition(".")[0]
    return f"in {parent} ({location})" if parent else "at the top level"


def _expected(item: Any) -> str:
    """Return the allowed values of the key with an error, in words, such as `a number > 0` or `true or false`."""
    kind, context = item["type"], item.get("ctx", {})
    if kind in _BOUNDS:
        sign, key = _BOUNDS[kind]
        bound = context[key]
        whole = "whole " if isinstance(item["input"], int) and not isinstance(bound, float) else ""
        return f"a {whole}number {sign} {bound if isinstance(bound, int) else f'{bound:g}'}"
    if kind == "literal_error":
        return str(context["expected"])
    if kind == "string_pattern_mismatch":
        return f"text like {context['pattern']}"
    if kind.endswith(("too_short", "too_long")):
        bound = "at least" if kind.endswith("short") else "at most"
        length = context.get("min_length", context.get("max_length"))
        if kind.startswith("string"):
            return f"text of {bound} {length} characters"
        return f"{bound} {length} item{'s' if length != 1 else ''}"
    stem = kind.removesuffix("_type").removesuffix("_parsing").removesuffix("_required")
    return _EXPECTED.get(stem) or str(item["msg"])


def _choices(item: Any) -> list[str]:
    return item["ctx"]["expected"].replace(" or ", ", ").split(", ") if item["type"] == "literal_error" else []


def _unquoted(text: str, items: Iterable[Any]) -> str | None:
    """Return a hint to remove the quotes if `text` is a number or true/false in quotes; None for other texts."""
    try:
        value = strict_yaml.load_value(text)
    except strict_yaml.YamlError:
        return None
    wanted = {_expected(item) for item in items}
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if (number and wanted & {"a number", "a whole number"}) or (isinstance(value, bool) and "true or false" in wanted):
        return "remove the quotes"
    return None


def _data_path(item: Any, data: Any) -> Path:
    """Return the path of the wrong value in the data, from one of pydantic's errors (`item`).

    The location in the error also has the names of union members, which are not keys of the data; they are left out.
    """
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


def _fields(model: type[BaseModel], path: Path) -> set[str]:
    """Return the keys that the mapping at a path of a model may have."""
    return {name for arm in _arms_at(model, path) if _is_model(arm) for name in arm.model_fields}


def _tags(model: type[BaseModel], path: Path) -> list[str]:
    """Return the possible values of `kind` of the mapping at a path of a model."""
    kinds = [arm.model_fields["kind"].annotation for arm in _arms_at(model, path) if _is_model(arm)]
    return [tag for kind in kinds for tag in get_args(kind)]


def _length(model: type[BaseModel], path: Path) -> int | None:
    """Return the length of the list at a path of a model; None if the length is not fixed."""
    items = (get_args(arm) for arm in _arms_at(model, path) if get_origin(arm) is tuple)
    return next((len(kinds) for kinds in items if kinds[-1] is not ...), None)


def _arms_at(model: type[BaseModel], path: Path) -> list[Any]:
    """Return the types that a model allows for the value at a path; several for a union, whose members are `arms`."""
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
    """Yield the plain types that an annotation allows: the members of unions, without `Annotated` and None."""
    if get_origin(annotation) in (Union, types.UnionType):
        for arm in get_args(annotation):
            yield from _arms(arm)
    elif hasattr(annotation, "__metadata__"):
        yield from _arms(get_args(annotation)[0])
    elif annotation is not None:
        yield annotation


def _keys(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str]]:
    """Yield (key, dotted path of the key) for every key of a model and of the models inside it.

    `prefix` is the dotted path of the model.
    """
    for name, field in model.model_fields.items():
        location = f"{prefix}.{name}".lstrip(".")
        yield name, location
        for arm in _arms(field.annotation):
            inner, below = arm, location
            while get_origin(inner) is dict:
                inner, below = next(_arms(get_args(inner)[1])), f"{below}.NAME"
            if _is_model(inner):
                yield from _keys(inner, below)


def _is_model(arm: object) -> bool:
    return isinstance(arm, type) and issubclass(arm, BaseModel)
