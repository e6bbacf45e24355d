"""Import hooks that the command line installs: one checks the memory limit, one protects matplotlib's settings.

Python calls the hooks before it imports a module.
"""

import contextlib
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from rlcli.machine.memory import require_address_space


class AddressSpaceCheck:
    """Import hook that checks the memory limit `ulimit -v` before numpy, mujoco or torch is imported.

    With too low a limit, such a library ends the process without a message.
    """

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        """Check the limit if the module is numpy, mujoco or torch; return None, so that Python searches for the module.

        Raises:
            MachineError: if the limit is too low for this library.
        """
        if name in ("numpy", "mujoco", "torch"):
            require_address_space()


class MatplotlibFinder:
    """Import hook that changes to matplotlib's own folder while matplotlib is imported.

    During its import, matplotlib reads a file `matplotlibrc` of the current folder, if there is one. That file may
    be a pipe without a writer, or belong to another user.
    """

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the specification of matplotlib, whose loader changes the current folder; None for other modules."""
        spec = PathFinder.find_spec(name, path, target) if name == "matplotlib" else None
        if spec is None or spec.loader is None or spec.origin is None:
            return None
        execute, folder = spec.loader.exec_module, Path(spec.origin).parent / "mpl-data"

        def execute_in_folder(module: ModuleType) -> None:
            with contextlib.chdir(folder):
                execute(module)

        spec.loader.exec_module = execute_in_folder  # type: ignore[method-assign]
        return spec
