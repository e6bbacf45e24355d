"""Import hooks that are active while a task's files are imported: module names that installed formats stand in for."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

from rlcli.registry.formats import format_aliases, is_framework


@contextlib.contextmanager
def aliases_resolved() -> Iterator[None]:
    """Let the aliases of installed formats resolve as module names.

    A module that was imported by its alias stays known under it, so that an import in a function of the task, which
    runs later, finds it.
    """
    if _SUBMODULES in sys.meta_path:
        yield
        return
    sys.meta_path.insert(0, _SUBMODULES)
    sys.meta_path.append(_ALIASES)
    try:
        yield
    finally:
        sys.meta_path.remove(_SUBMODULES)
        sys.meta_path.remove(_ALIASES)


class _AliasFinder(MetaPathFinder):
    """Finder of a module by its alias, asked last: for a name that nothing else has, the formats are looked up."""

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of an alias; None for any other name."""
        module = format_aliases().get(name)
        return None if module is None else _spec(name, module)


class _SubmoduleFinder(MetaPathFinder):
    """Finder of the modules below an alias, asked first: the path of the package has them too, as second copies."""

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of a module below an alias; None for any other name."""
        package, _, last = name.rpartition(".")
        real = str(getattr(sys.modules.get(package), "__name__", package))
        return _spec(name, f"{real}.{last}") if real != package and is_framework(real) else None


class _AliasLoader(Loader):
    """Loader that returns a module which has another name."""

    def __init__(self, real: str) -> None:
        self.real = real

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Import the module under its own name."""
        module = importlib.import_module(self.real)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give the module its own spec back, which the import system has replaced."""
        module.__spec__ = self.spec


def _spec(alias: str, module: str) -> ModuleSpec | None:
    found = importlib.util.find_spec(module)
    if found is None:
        return None
    return ModuleSpec(alias, _AliasLoader(module), is_package=found.submodule_search_locations is not None)


_SUBMODULES, _ALIASES = _SubmoduleFinder(), _AliasFinder()
