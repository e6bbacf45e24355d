"""Import of task files: modules by name or path, with the aliases of installed formats."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from rlcli.registry.aliases import aliases_resolved
from rlcli.registry.imports import contained


def load_object(reference: str) -> Any:
    """`package.module:Name` or `/path/file.py:Name` -> the object."""
    module_name, _, attribute = reference.rpartition(":")
    value: Any = load_module(module_name)
    for part in attribute.split("."):
        value = getattr(value, part)
    return value


def load_module(name: str) -> Any:
    """Import a module by its dotted name, or a file of a task folder by its path. Its prints go to stderr."""
    with contained(), aliases_resolved():
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
                with _sibling_modules(file.resolve().parent):
                    spec.loader.exec_module(module)
            except BaseException:
                del sys.modules[alias]
                raise
        return sys.modules[alias]


def import_file(file: Path) -> Any:
    """Import a file as part of the package that its folder is, so that its relative imports work.

    Modules beside a file of no package are importable too, as for a script.
    """
    with contained(), aliases_resolved():
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
def _sibling_modules(folder: Path) -> Iterator[None]:
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
