"""Run a command of a library and end it after the first call of one of its methods.

    python benchmarks/first_call.py MODULE:CLASS.METHOD MODULE:FUNCTION ARGUMENT...

The duration of this program is the time that a user waits for that call. It imports nothing that the command does not
import.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
from types import ModuleType
from typing import Any


class Ender(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Importer that loads a module as usual, and then makes one of its methods end the process."""

    def __init__(self, place: str) -> None:
        self.module, _, method = place.partition(":")
        self.owner, _, self.method = method.partition(".")

    def find_spec(self, name: str, path: Any, target: Any = None) -> importlib.machinery.ModuleSpec | None:
        if name != self.module:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        assert spec is not None
        self.loader, spec.loader = spec.loader, self
        return spec

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        assert self.loader is not None
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        assert self.loader is not None
        self.loader.exec_module(module)
        owner = getattr(module, self.owner)
        whole = getattr(owner, self.method)

        def once(*given: Any, **named: Any) -> None:
            whole(*given, **named)
            os._exit(0)

        setattr(owner, self.method, once)


def main() -> None:
    place, command, *arguments = sys.argv[1:]
    sys.meta_path.insert(0, Ender(place))
    module, _, function = command.partition(":")
    sys.argv = [module, *arguments]
    getattr(importlib.import_module(module), function)()
    raise SystemExit(f"{place} was not called")


if __name__ == "__main__":
    main()
