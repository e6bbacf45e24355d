"""Import hooks for the module aliases of installed formats, active while the files of a task are imported."""

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
    """Make the aliases of installed formats importable inside the `with` block.

    A module that was imported by its alias stays in `sys.modules` under the alias, so that an import inside a function
    of the task, which runs later, finds the module.
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
    """Import finder for aliases. It is the last finder, so it is used only for names that no installed module has."""

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the module spec of an alias; None for any other name."""
        module = format_aliases().get(name)
        return None if module is None else _spec(name, module)


class _SubmoduleFinder(MetaPathFinder):
    """Import finder for the modules below an alias.

    It is the first finder: the usual one would also find these modules through `__path__` and import second copies.
    """

    def find_spec(self, name: str, path: object = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the module spec of a module below an alias; None for any other name."""
        package, _, last = name.rpartition(".")
        real = str(getattr(sys.modules.get(package), "__name__", package))
        return _spec(name, f"{real}.{last}") if real != package and is_framework(real) else None


class _AliasLoader(Loader):
    """Loader that returns an existing module which has another name."""

    def __init__(self, real: str) -> None:
        self.real = real

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Import the module under its real name and return it."""
        module = importlib.import_module(self.real)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the module's own spec, which the import system has replaced by the one of the alias."""
        module.__spec__ = self.spec


def _spec(alias: str, module: str) -> ModuleSpec | None:
    found = importlib.util.find_spec(module)
    if found is None:
        return None
    return ModuleSpec(alias, _AliasLoader(module), is_package=found.submodule_search_locations is not None)


_SUBMODULES, _ALIASES = _SubmoduleFinder(), _AliasFinder()
