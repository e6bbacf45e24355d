"""`configclass`: a dataclass that also takes members without annotations, and gives every object its own defaults."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, dataclass_transform

MISSING: Any = dataclasses.MISSING
"""Stands for a value that must be given."""

T = TypeVar("T")


@dataclass_transform()
def configclass(cls: type[T]) -> type[T]:
    """Make a class of settings: a member is what is annotated or assigned, except methods and nested classes."""
    own = inspect.get_annotations(cls)
    assigned = [name for name, value in vars(cls).items() if name in own or _is_setting(cls, name, value)]
    names = [*(name for name in own if name not in assigned), *assigned]
    cls.__annotations__ = {name: own.get(name, Any) for name in names}
    for name in names:
        value = vars(cls).get(name, MISSING)
        if not isinstance(value, dataclasses.Field):
            setattr(cls, name, dataclasses.field(default_factory=_fresh(value)))
    for name, method in (("to_dict", to_dict), ("replace", _replace), ("copy", _copy), ("from_dict", _from_dict)):
        if name not in vars(cls):
            setattr(cls, name, method)
    return dataclasses.dataclass(cls)


def is_missing(value: Any) -> bool:
    """Whether a value has not been given; a copy of MISSING says so too."""
    return isinstance(value, type(MISSING))


def to_dict(value: Any) -> Any:
    """Settings as nested dicts; functions, numbers and text stay what they are."""
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


def _fresh(value: Any) -> Callable[[], Any]:
    return lambda: value if is_missing(value) else copy.deepcopy(value)


def _replace(self: Any, **changes: Any) -> Any:
    """A copy with some members changed."""
    made = copy.deepcopy(self)
    for name, value in changes.items():
        if name not in vars(made):
            raise TypeError(f"{type(self).__name__} has no '{name}'; it has {', '.join(vars(made))}")
        setattr(made, name, value)
    return made


def _copy(self: Any, **changes: Any) -> Any:
    """A copy that shares nothing."""
    return _replace(self, **changes)


def _from_dict(self: Any, data: Mapping[str, Any]) -> None:
    """Set members from a mapping, nested ones within."""
    for name, value in data.items():
        if name not in vars(self):
            raise KeyError(f"{type(self).__name__} has no '{name}'")
        member = getattr(self, name)
        if isinstance(value, Mapping) and hasattr(member, "from_dict"):
            member.from_dict(value)
        else:
            setattr(self, name, value)
