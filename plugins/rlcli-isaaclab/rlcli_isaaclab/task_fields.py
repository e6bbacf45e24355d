"""Fields that a task adds to `DirectRLEnvCfg`, such as `rew_scale_alive`: they become the section `params` of rlcli."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError, create_model

from rlcli.config.schema import Number, StrictModel
from rlcli.registry import is_framework
from rlcli_isaaclab.config_class import is_missing

Numeric = int | Number


def own_fields(cfg: Any, base: type) -> tuple[dict[str, Any], type[BaseModel]]:
    """Return (values, pydantic model) of the fields that a configuration adds to those of its base class `base`.

    Only fields with numbers, strings, lists of these, or objects of the task's own configuration classes are included.
    """
    known = {field.name for field in dataclasses.fields(base)}
    values: dict[str, Any] = {}
    types: dict[str, Any] = {}
    for name, value in vars(cfg).items():
        if name in known or name.startswith(("_", "rlcli_")):
            continue
        if isinstance(value, type):  # a field whose value is a class is left out: its members are not settings
            continue
        if dataclasses.is_dataclass(value) and not is_framework(type(value).__module__):
            inner, kind = own_fields(value, _Nothing)
            if inner:
                values[name], types[name] = inner, (kind, kind())
        elif (kind := _type_of(value, type(cfg).__annotations__.get(name))) is not None:
            values[name] = list(value) if isinstance(value, tuple) else value
            types[name] = (kind, values[name])
    return values, create_model("Params", __base__=StrictModel, **types)


def set_own_fields(cfg: Any, values: Mapping[str, Any]) -> None:
    """Set fields of a configuration by name; a mapping sets the fields of the object in a field."""
    for name, value in values.items():
        now = getattr(cfg, name)
        if isinstance(value, Mapping):
            set_own_fields(now, value)
        elif now != value and not (isinstance(now, tuple) and list(now) == value):
            setattr(cfg, name, tuple(value) if isinstance(now, tuple) else value)


def set_valid_fields(cfg: Any, base: type, values: Mapping[tuple[str, ...], Any]) -> None:
    """Set the fields that have a value of the right type at the path `("params", NAME, ...)`.

    rlcli reports other values when it checks the task.
    """
    for path, value in values.items():
        if path[0] != "params":
            continue
        owner, kind = cfg, base
        for part in path[1:-1]:
            owner, kind = getattr(owner, part, None), _Nothing
        field = own_fields(owner, kind)[1].model_fields.get(path[-1]) if dataclasses.is_dataclass(owner) else None
        if field is not None:
            with contextlib.suppress(ValidationError):
                adapter: TypeAdapter[Any] = TypeAdapter(field.annotation or Any)
                set_own_fields(owner, {path[-1]: adapter.validate_python(value, strict=True)})


@dataclasses.dataclass
class _Nothing:
    """Class without fields."""


def _type_of(value: Any, annotation: Any) -> Any:
    """Return the type of a field for the pydantic model; None for a value of a type that `own_fields` leaves out.

    `annotation` is the field's type in the source, an object or text.
    """
    if isinstance(value, bool):
        return bool
    if isinstance(value, int) and annotation in (int, "int"):
        return int
    if isinstance(value, int) or (isinstance(value, float) and math.isfinite(value)):
        return Numeric
    if isinstance(value, str):
        return str
    if value is None and not is_missing(value):
        return Any
    items = [_type_of(item, None) for item in value] if isinstance(value, list | tuple) else []
    return list[items[0]] if items and items[0] in (Numeric, str) and len(set(items)) == 1 else None  # type: ignore[valid-type]
