"""Inspection of the source of the user's functions, and adaptation of functions that are written for a GPU."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco

from rlcli.machine.device_names import on_cpu
from rlcli.registry import is_framework


def code_of(function: Any) -> Any:
    """Return the function or class that contains the code of a callable, which may be a partial or an object."""
    while isinstance(function, functools.partial):
        function = function.func
    return function if inspect.isfunction(function) or inspect.isclass(function) else type(function)


def place_of_code(function: Any) -> tuple[Path, int]:
    """Return the file and the line where the code of a callable begins; (`?`, 1) if its file is not known."""
    try:
        return Path(inspect.getsourcefile(code_of(function)) or "?"), inspect.getsourcelines(code_of(function))[1]
    except (OSError, TypeError):
        return Path("?"), 1


def file_text(function: Any) -> str:
    """Return the text of the file that defines a function; empty if the file does not belong to the user."""
    function = code_of(function)
    file = getattr(sys.modules.get(function.__module__), "__file__", None)
    return _text(file) if file and file.endswith(".py") and not is_framework(function.__module__) else ""


@functools.cache
def _text(file: str) -> str:
    return Path(file).read_text(encoding="utf-8", errors="replace")


def reads_body_forces(text: str) -> bool:
    """Return whether source code names accelerations or joint forces of bodies.

    MuJoCo only computes them on request (`mj_rnePostConstraint`).
    """
    return any(word in text for word in _BODY_FORCES)


def term_reads_body_forces(function: Any) -> bool:
    """Return whether the code of a user's function or class, or of a function that it calls, `reads_body_forces`."""
    found: dict[Any, str] = {}
    waiting = [function]
    while waiting:
        item = waiting.pop()
        item = code_of(item)
        if item in found or is_framework(str(getattr(item, "__module__", ""))):
            continue
        found[item] = source_text(item)
        methods = [m for m in vars(item).values() if inspect.isfunction(m)] if inspect.isclass(item) else [item]
        for method in methods:
            used = (method.__globals__.get(name) for name in method.__code__.co_names)
            waiting += [other for other in used if inspect.isfunction(other)]
        waiting += item.__bases__ if inspect.isclass(item) else ()
    return any(map(reads_body_forces, found.values()))


_BODY_FORCES = (
    *("get_link_incoming_joint_force", "body_incoming_joint_wrench", "body_acc_w", "body_com_acc_w"),
    *("body_lin_acc_w", "body_ang_acc_w", "body_com_lin_acc_w", "body_com_ang_acc_w", "body_link_acc_w"),
)


def adapt_to_device(target: Any, device: Any) -> Any:
    """Return a function or class of the user, adapted so that it runs on `device`.

    If the device is the CPU and the user's file contains `cuda`, the code is run with the CPU in place of `cuda`.
    Otherwise return the function or class unchanged.
    """
    kinds = [kind for kind in reversed(getattr(target, "__mro__", (target,))) if not is_framework(kind.__module__)]
    if str(device) != "cpu" or not any("cuda" in file_text(kind) for kind in kinds):
        return target
    if inspect.isfunction(target):
        return on_cpu(target)
    if not inspect.isclass(target):
        return target
    members = {name: on_cpu(f) for kind in kinds for name, f in vars(kind).items() if inspect.isfunction(f)}
    return type(target.__name__, (target,), {**members, "__module__": target.__module__})


def source_text(function: Any) -> str:
    """Return the source code of a function; empty if it is not known."""
    try:
        return inspect.getsource(code_of(function))
    except (OSError, TypeError):
        return ""


def unset_simple(spec: mujoco.MjSpec, params: Mapping[str, Any]) -> None:
    """Clear the flag `simple` of all bodies before the model is compiled.

    With the flag MuJoCo assumes that the centre of mass stays at the origin of the frame; a user's event may move it.
    """
    for body in spec.bodies:
        body.simple = 0
