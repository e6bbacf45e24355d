"""Texts of the user's files, and what a model needs for the calls in them."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco

from rlcli.registry import is_framework


def file_text(function: Any) -> str:
    """Return the text of the file that defines a function."""
    file = getattr(sys.modules.get(function.__module__), "__file__", None)
    return _text(file) if file and file.endswith(".py") and not is_framework(function.__module__) else ""


@functools.cache
def _text(file: str) -> str:
    return Path(file).read_text(encoding="utf-8", errors="replace")


def source_text(function: Any) -> str:
    """Return the text of a function; empty if it is unknown."""
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):
        return ""


def unset_simple(spec: mujoco.MjSpec, params: Mapping[str, Any]) -> None:
    """Clear the `simple` flag of all bodies, with which MuJoCo assumes the centre of mass at the frame's origin."""
    for body in spec.bodies:
        body.simple = 0
