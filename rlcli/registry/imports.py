"""Import of plugins: what their code prints and raises is contained."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from typing import Any

from rlcli.errors import DependencyError, TaskError
from rlcli.registry.entries import Entry


def load_entry(entry: Entry, kind: type) -> Any:
    """Import what an entry point names; whatever the plugin raises is said with its owner."""
    try:
        value = import_object(entry.value)
    except DependencyError:
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise TaskError(
            f"plugin {entry.distribution} {entry.version} is broken: '{entry.name}' = {entry.value}:"
            f" {said}{place_of(error)}",
            hint=_newer_rlcli(entry),
        ) from error
    if not isinstance(value, kind):
        raise TaskError(
            f"plugin {entry.distribution} {entry.version} is broken: '{entry.name}' = {entry.value} is a"
            f" {type(value).__name__}, not a {kind.__name__}"
        )
    return value


def import_object(reference: str) -> Any:
    """Return the object of `package.module:Name`. What the import prints goes to stderr."""
    name, _, attributes = reference.rpartition(":")
    with contained():
        value: Any = importlib.import_module(name)
    for attribute in attributes.split("."):
        value = getattr(value, attribute)
    return value


@contextlib.contextmanager
def contained() -> Iterator[None]:
    """What a plugin prints while it is imported, from C too, goes to stderr; where it went with chdir is undone."""
    folder = _folder_now()
    with contextlib.redirect_stdout(sys.stderr), _descriptor_to_stderr():
        try:
            yield
        finally:
            if folder is not None and _folder_now() != folder:
                os.chdir(folder)


def place_of(error: BaseException) -> str:
    """The line of code that raised, in brackets; nothing where the message has it already."""
    traceback = error.__traceback__
    last = None
    while traceback is not None:
        last = (traceback.tb_frame.f_code.co_filename, traceback.tb_lineno)
        traceback = traceback.tb_next
    own = isinstance(error, SyntaxError) or last is None or last[0].startswith("<frozen")
    return "" if own or last is None else f" ({last[0]}:{last[1]})"


def _newer_rlcli(entry: Entry) -> str | None:
    """What to do about a plugin that asks for a newer rlcli in its metadata."""
    import rlcli

    requirements: list[str] = []
    with contextlib.suppress(Exception):  # malformed metadata
        requirements = metadata.requires(entry.distribution) or []
    for line in requirements:
        wanted = re.match(r"rlcli\s*(?:\[[^]]*\])?\s*\(?(?:>=|==|~=|>)\s*([0-9]+(?:\.[0-9]+)*)", line)
        if wanted and _numbers(wanted[1]) > _numbers(rlcli.__version__):
            return f"it asks for rlcli {wanted[1]}, this is {rlcli.__version__}: pip install --upgrade rlcli"
    return None


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"[0-9]+", version)]


def _folder_now() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # it was removed
        return None


@contextlib.contextmanager
def _descriptor_to_stderr() -> Iterator[None]:
    """For what writes to file descriptor 1 without asking Python."""
    try:
        if sys.__stdout__ is not None:
            sys.__stdout__.flush()
        kept = os.dup(1)
        os.dup2(2, 1)
    except (OSError, ValueError):  # one of them is closed
        yield
        return
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
