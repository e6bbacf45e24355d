"""Messages about methods of a task's own asset, sensor and environment classes, which rlcli does not run."""

from __future__ import annotations

import functools
from collections.abc import Collection
from typing import Any

from rlcli.config.code_place import class_place
from rlcli.registry import is_framework
from rlcli_isaaclab.missing_names import report_once
from rlcli_isaaclab.settings import Node

_DRAWING = ("set_debug_vis", "_set_debug_vis_impl", "_debug_vis_callback", "__str__", "__repr__")
"""Methods that only draw or print."""
WORKFLOW = ("step", "reset", "_reset_idx", "load_managers")
"""Methods of Isaac Lab's environment class that decide what an environment step does."""


def own_methods(kind: type, only: Collection[str] = ()) -> list[str]:
    """Return the names of the methods and properties that a class of a task and its own bases define.

    Args:
        kind: the class. Its bases that belong to rlcli or a plugin, and their bases, are not searched.
        only: the names to return; empty: all.
    """
    known = [base for base in kind.__mro__ if is_framework(base.__module__)]
    own = [base for base in kind.__mro__ if base is not object and not any(issubclass(each, base) for each in known)]
    members = {
        name: value for base in reversed(own) for name, value in vars(base).items() if name not in ("cfg", *_DRAWING)
    }
    return [
        name
        for name, value in members.items()
        if (callable(value) or isinstance(value, property | functools.cached_property | staticmethod | classmethod))
        and not isinstance(value, type)
        and (name in only if only else True)
    ]


def warn_of_methods(what: str, kind: Any, only: Collection[str] = ()) -> str:
    """Log a warning if a task's own class has methods that rlcli does not run, and return its text; else return "".

    Args:
        what: what the class is for, such as `scene.robot`.
        kind: the class.
        only: the names of the methods that matter; empty: all.
    """
    names = own_methods(kind, only) if isinstance(kind, type) else []
    if not names:
        return ""
    place = class_place(kind)
    methods = f"method {names[0]}" if len(names) == 1 else f"methods {', '.join(names)}"
    text = f"{place}: {what}: " if place else f"{what}: "
    text += f"rlcli does not run the {methods} of the class {kind.__name__}"
    report_once(f"{text}; rewards, resets or observations may differ from Isaac Lab's")
    return text


def note_own_class(item: Node, kind: str) -> None:
    """Note that an asset or sensor of a task's own class is read as Isaac Lab's class `kind`."""
    methods = warn_of_methods(".".join(item.key), item.data["class_type"])
    item.note("approximated", "class_type", f"read as {kind}; {methods or 'the class has no methods'}")
