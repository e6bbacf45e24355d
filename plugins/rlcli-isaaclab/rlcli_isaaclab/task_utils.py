"""Functions of `isaaclab_tasks.utils` that packages of tasks call when they are imported."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

from rlcli.registry.failed_imports import failed_import
from rlcli_isaaclab.missing_names import user_place


def import_packages(package_name: str, blacklist_pkgs: list[str] | None = None) -> None:
    """Import a package and all its subpackages, except those whose name contains a word of the blacklist.

    A subpackage whose import fails is left out, with a warning.
    """
    package = importlib.import_module(package_name)
    for found in pkgutil.iter_modules(getattr(package, "__path__", []), f"{package_name}."):
        if found.ispkg and not any(word in found.name for word in blacklist_pkgs or ()):
            try:
                import_packages(found.name, blacklist_pkgs)
            except Exception as error:
                failed_import(found.name, error, user_place().removesuffix(": "))


def load_cfg_from_registry(task_name: str, entry_point_key: str) -> Any:
    """Return a configuration object of a task that is registered with Gymnasium.

    Args:
        task_name: id of the task, such as `Isaac-Cartpole-v0`.
        entry_point_key: key of the registration that names the configuration, such as `env_cfg_entry_point`.

    Raises:
        KeyError: if no task has the id, or the registration does not have the key.
    """
    from rlcli.registry.task_imports import load_object, registrations

    entry = registrations[task_name][entry_point_key]
    found = load_object(entry) if isinstance(entry, str) else entry
    return found() if isinstance(found, type) else found
