"""`configclass`, a decorator for dataclasses: members need no annotations, and each object gets copies of defaults."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, dataclass_transform

MISSING: Any = dataclasses.MISSING
"""Value of a setting that the user must set."""

T = TypeVar("T")


@dataclass_transform()
def configclass(cls: type[T]) -> type[T]:
    """Turn a class into a dataclass: all names except methods and nested classes become fields."""
    own = inspect.get_annotations(cls)
    inherited = {name for base in cls.__mro__[1:] for name in getattr(base, "__dataclass_fields__", ())}
    assigned = [
        name
        for name, value in vars(cls).items()
        if name in own or _is_setting(cls, name, value) or (name in inherited and inspect.isfunction(value))
    ]
    if hasattr(cls, "__settings__"):  # a subclass of a class that accepts settings of any name (sim.py)
        cls._fixed = {**cls._fixed, **{name: vars(cls)[name] for name in assigned}}  # type: ignore[attr-defined]
        return cls
    names = [*(name for name in own if name not in assigned), *assigned]
    cls.__annotations__ = {name: own.get(name, Any) for name in names}
    for name in names:
        value = vars(cls).get(name, MISSING)
        if not isinstance(value, dataclasses.Field):
            setattr(cls, name, dataclasses.field(default_factory=_copier(value)))
    for name, method in (("to_dict", to_dict), ("replace", _replace), ("copy", _copy), ("from_dict", _from_dict)):
        if name not in vars(cls):
            setattr(cls, name, method)
    if not hasattr(cls, "__post_init__"):
        cls.__post_init__ = _post_init  # type: ignore[attr-defined]
    return dataclasses.dataclass(cls)


def _post_init(self: Any) -> None:
    """Do nothing; the method exists so that a subclass can call `super().__post_init__()`."""


def make_config_class(name: str, doc: str, bases: tuple[type, ...] = (), **members: Any) -> Any:
    """Return a new configuration class; `members` are its fields with their defaults, `doc` its docstring."""
    module = bases[0].__module__ if bases else __name__
    return configclass(type(name, bases, {"__doc__": doc, "__module__": module, "__annotations__": {}, **members}))


def config_subclass(class_type: str, doc: str, base: type, **members: Any) -> Any:
    """Return a configuration class named `{class_type}Cfg` that derives from `base`."""
    return make_config_class(f"{class_type}Cfg", doc, (base,), class_type=class_type, **members)


def is_missing(value: Any) -> bool:
    """Return whether a value is MISSING or a copy of MISSING, which means that the user must set it."""
    return isinstance(value, type(MISSING))


def fill_missing(cfg: Any, values: Mapping[tuple[str, ...], Any]) -> list[tuple[str, ...]]:
    """Set the missing settings for which `values` (path of the setting -> value) has a value; return their paths."""
    filled = []
    for path, value in values.items():
        owner: Any = {"": cfg}
        for part in ("", *path[:-1]):
            owner = owner.get(part) if isinstance(owner, Mapping) else getattr(owner, part, None)
        is_mapping = isinstance(owner, dict)
        if not is_missing(owner.get(path[-1]) if is_mapping else getattr(owner, path[-1], None)):
            continue
        if is_mapping:
            owner[path[-1]] = value
        else:
            setattr(owner, path[-1], value)
        filled.append(path)
    return filled


def to_dict(value: Any) -> Any:
    """Return settings as nested dicts; functions, numbers and strings stay unchanged."""
    if isinstance(value, type):
        return value
    if dataclasses.is_dataclass(value) or hasattr(value, "__settings__"):
        return {name: to_dict(item) for name, item in vars(value).items() if not name.startswith("_")}
    if isinstance(value, Mapping):
        return {key: to_dict(item) for key, item in value.items()}
    return type(value)(to_dict(item) for item in value) if type(value) in (list, tuple) else value


def _is_setting(cls: type, name: str, value: Any) -> bool:
    if name.startswith("__") or inspect.isroutine(value) or isinstance(value, property | classmethod | staticmethod):
        return False
    return not (isinstance(value, type) and value.__qualname__.startswith(f"{cls.__qualname__}."))


def _copier(value: Any) -> Callable[[], Any]:
    """Return a function that copies a default, so that objects do not share it."""
    return lambda: value if is_missing(value) else copy.deepcopy(value)


def _replace(self: Any, **changes: Any) -> Any:
    """Return a copy with some members changed."""
    changed = copy.deepcopy(self)
    for name, value in changes.items():
        if name not in vars(changed):
            raise TypeError(f"{type(self).__name__} has no setting '{name}'; settings: {', '.join(vars(changed))}")
        setattr(changed, name, value)
    return changed


def _copy(self: Any, **changes: Any) -> Any:
    """Return a deep copy with some members changed."""
    return _replace(self, **changes)


def _from_dict(self: Any, data: Mapping[str, Any]) -> None:
    """Set members from a mapping, and nested members from nested mappings."""
    for name, value in data.items():
        if name not in vars(self):
            raise KeyError(f"{type(self).__name__} has no setting '{name}'; settings: {', '.join(vars(self))}")
        member = getattr(self, name)
        if isinstance(value, Mapping) and hasattr(member, "from_dict"):
            member.from_dict(value)
        else:
            setattr(self, name, value)
