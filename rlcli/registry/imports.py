"""Importing code of others: what it prints, raises and leaves behind is kept from everything else."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from rlcli.errors import DependencyError, TaskError
from rlcli.registry.entries import Entry


def load_entry(entry: Entry, kind: type) -> Any:
    """Import what an entry point names; whatever the plugin raises is said with its owner."""
    try:
        value = load_object(entry.value)
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


def load_object(reference: str) -> Any:
    """`package.module:Name` or `/path/file.py:Name` -> the object."""
    module_name, _, attribute = reference.rpartition(":")
    value: Any = load_module(module_name)
    for part in attribute.split("."):
        value = getattr(value, part)
    return value


def load_module(name: str) -> Any:
    """Import a module by its dotted name, or a file of a task folder by its path. Its prints go to stderr."""
    with contained():
        if not name.endswith(".py"):
            return importlib.import_module(name)
        file = Path(name)
        digest = hashlib.blake2b(str(file.resolve()).encode(), digest_size=8).hexdigest()
        alias = f"rlcli_folder_task_{digest}_{file.stem}"
        if alias not in sys.modules:
            spec = importlib.util.spec_from_file_location(alias, file)
            if spec is None or spec.loader is None:
                raise ImportError(f"cannot import {file}")
            module = importlib.util.module_from_spec(spec)
            sys.modules[alias] = module
            try:
                with _neighbours(file.resolve().parent):
                    spec.loader.exec_module(module)
            except BaseException:
                del sys.modules[alias]
                raise
        return sys.modules[alias]


def import_file(file: Path) -> Any:
    """Import a file as part of the package that its folder is, so that its relative imports work.

    Modules beside a file of no package are importable too, as for a script.
    """
    with contained():
        top = file.parent
        while (top.parent / "__init__.py").is_file() and (top / "__init__.py").is_file():
            top = top.parent
        name = _package(top)
        inner = file.parent.relative_to(top).parts + (() if file.stem == "__init__" else (file.stem,))
        sys.path.append(str(top))
        try:
            return importlib.import_module(".".join((name, *inner)))
        finally:
            sys.path.remove(str(top))


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


@contextlib.contextmanager
def _neighbours(folder: Path) -> Iterator[None]:
    """A file of a task folder may import the files beside it, which two tasks may call the same."""
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for name in set(sys.modules) - before:
            place = getattr(sys.modules[name], "__file__", None)
            if place and Path(place).is_relative_to(folder) and not name.startswith("rlcli_folder_task_"):
                del sys.modules[name]


def _package(folder: Path) -> str:
    """The name under which a folder is a package: its own, unless that is taken."""
    digest = hashlib.blake2b(str(folder).encode(), digest_size=8).hexdigest()
    alias = f"rlcli_folder_{digest}"
    name = alias
    if folder.name.isidentifier():
        known = sys.modules.get(folder.name)
        mine = known is not None and str(folder) in list(getattr(known, "__path__", ()))
        if mine or (known is None and importlib.util.find_spec(folder.name) is None):
            name = folder.name
    if name in sys.modules:
        return name
    start = folder / "__init__.py"
    if start.is_file():
        spec = importlib.util.spec_from_file_location(name, start, submodule_search_locations=[str(folder)])
    else:
        spec = ModuleSpec(name, None, is_package=True)
        spec.submodule_search_locations = [str(folder)]
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    if spec.loader is not None and start.is_file():
        sys.path.append(str(folder))
        try:
            spec.loader.exec_module(module)
        except BaseException:
            for known_name in [m for m in sys.modules if m == name or m.startswith(f"{name}.")]:
                del sys.modules[known_name]
            raise
        finally:
            sys.path.remove(str(folder))
    return name


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
