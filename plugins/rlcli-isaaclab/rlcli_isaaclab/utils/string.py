"""Functions that convert names, and that select names by regexes.

A task of Isaac Lab that imports a name from `isaaclab.utils.string` gets the object of this name from here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from rlcli.scene.names import match, search


def to_camel_case(snake_str: str, to: str = "cC") -> str:
    """Return a snake_case name in camelCase; `to="CC"` starts with a capital."""
    words = snake_str.split("_")
    return "".join([words[0].title() if to == "CC" else words[0], *(word.title() for word in words[1:])])


def to_snake_case(camel_str: str) -> str:
    """Return a CamelCase name in snake_case."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", camel_str).lower()


def resolve_matching_names(
    keys: str | Sequence[str], list_of_strings: Sequence[str], preserve_order: bool = False
) -> tuple[list[int], list[str]]:
    """Return (indices, names) of the strings in `list_of_strings` that match `keys`, names or regexes.

    The order is that of `list_of_strings`, or with `preserve_order` that of `keys`.

    Raises:
        NameProblem: if a key matches no string.
    """
    names = list(list_of_strings)
    found = match([keys] if isinstance(keys, str) else list(keys), names, "name")
    indices = list(found) if preserve_order else sorted(found)
    return indices, [names[index] for index in indices]


def resolve_matching_names_values(
    data: Mapping[str, Any], list_of_strings: Sequence[str], preserve_order: bool = False
) -> tuple[list[int], list[str], list[Any]]:
    """Return (indices, names, values) of the strings in `list_of_strings` that match a key of `data`.

    The keys are names or regexes; the value of a string is the value of the key that matches.

    Raises:
        ValueError: if two keys match one string, or a key matches none.
    """
    names, found = list(list_of_strings), {}
    key_of: dict[int, str] = {}
    for pattern, value in data.items():
        matched = search(pattern, names, "name")
        if not matched:
            raise ValueError(f"no name matches '{pattern}'; names: {', '.join(names)}")
        for index in matched:
            if index in found:
                raise ValueError(
                    f"the keys '{key_of[index]}' and '{pattern}' both match '{names[index]}'; narrow one of them"
                )
            found[index], key_of[index] = value, pattern
    indices = list(found) if preserve_order else sorted(found)
    return indices, [names[index] for index in indices], [found[index] for index in indices]


def string_to_callable(name: str) -> Any:
    """Import the function of a reference `module:name`."""
    from rlcli.registry.task_imports import load_object

    return load_object(name)


def callable_to_string(value: Any) -> str:
    """Return the reference `module:name` of a function."""
    return f"{value.__module__}:{value.__qualname__}"
