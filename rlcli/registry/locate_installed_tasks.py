"""Lookup of the tasks of installed packages and their files, and of modules that a configuration may name.

Packages are located without importing them where possible.
"""

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

from rlcli.errors import TaskError, short_error
from rlcli.registry.entries import GROUPS, Entry, catalog
from rlcli.registry.plugin_imports import contain_side_effects, error_location, load_spec
from rlcli.registry.task_location import TaskSource
from rlcli.task import TaskSpec


def installed_task(entry: Entry) -> TaskSource:
    """Return the task of an installed package by its entry point. Only the module of its `TaskSpec` is imported.

    Raises:
        TaskError: if the task is broken, or needs a newer rlcli.
    """
    return packaged_task(entry, load_spec(entry, TaskSpec, "task"))


def packaged_task(entry: Entry, spec: TaskSpec) -> TaskSource:
    """Return the task of an installed package: the files and modules that its `TaskSpec` names.

    Raises:
        TaskError: if a file or module of the task does not exist.
    """
    root = _folder(spec.package, entry)
    in_python = ":" in spec.config
    config = _module_file(spec.config.partition(":")[0], entry) if in_python else root / spec.config
    if not config.is_file():
        raise TaskError(f"task '{entry.qualified}' is broken: {config} does not exist; reinstall its package")
    task_module = spec.task.partition(":")[0] if spec.task else None
    policy = root / spec.policies / entry.name
    return TaskSource(
        name=entry.name,
        root=root,
        config=config,
        distribution=entry.distribution,
        version=entry.version,
        term_files=tuple(_module_file(module, entry) for module in spec.terms),
        term_modules=spec.terms,
        task=spec.task,
        task_file=_module_file(task_module, entry) if task_module else None,
        python=spec.config if in_python else None,
        agents=tuple(spec.agents.items()),
        policy=policy if (policy / "manifest.json").is_file() else None,
    )


def task_of_file(file: Path) -> TaskSource | None:
    """Return the installed task whose configuration is this YAML file; None if there is none."""
    for entry in catalog()[0]:
        package = package_folder(entry)  # plugins whose package does not contain the file are not imported
        if package is not None and file.resolve().is_relative_to(package.resolve()):
            try:
                source = installed_task(entry)
            except TaskError:
                continue
            if source.config.resolve() == file.resolve():
                return source
    return None


def package_folder(entry: Entry) -> Path | None:
    """Return the folder of the top-level package of an entry point, without importing it; None if there is none."""
    return next(iter(package_folders(entry.package)), None)


def package_folders(package: str) -> list[Path]:
    """Return the folders of a top-level package, without importing it: one, or several of a namespace package."""
    try:
        found = importlib.util.find_spec(package) if package.isidentifier() else None
    except (ImportError, ValueError):
        return []
    return [Path(folder) for folder in (found.submodule_search_locations or ())] if found else []


def is_offered(module: str, source: TaskSource) -> bool:
    """Return whether a configuration may name a module, because it is in the task's own package or in a plugin.

    The module is not imported, because the configuration may come from an untrusted file.
    """
    top = module.partition(".")[0]
    if top in {entry.package for group in GROUPS for entry in catalog(group)[0]}:
        return top.isidentifier()
    return any(source.root.resolve().is_relative_to(folder.resolve()) for folder in package_folders(top))


def _folder(package: str, entry: Entry) -> Path:
    found = _find(package, entry)
    if found is None or not found.submodule_search_locations:
        raise TaskError(f"task '{entry.qualified}' is broken: '{package}' is not a package; correct its TaskSpec")
    return Path(next(iter(found.submodule_search_locations)))


def _module_file(module: str, entry: Entry) -> Path:
    found = _find(module, entry)
    if found is None or not found.origin:
        raise TaskError(f"task '{entry.qualified}' is broken: there is no module '{module}'; correct its TaskSpec")
    return Path(found.origin)


def _find(module: str, entry: Entry) -> ModuleSpec | None:
    """Return importlib's `ModuleSpec` (the location) of a module; None if there is no such module.

    The parent packages of the module are imported.

    Args:
        module: dotted name of the module.
        entry: entry point of the task, for the message of an error.

    Raises:
        TaskError: if the import of a parent package fails.
    """
    try:
        with contain_side_effects():
            return importlib.util.find_spec(module)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise TaskError(f"task '{entry.qualified}' is broken: {short_error(error)}{error_location(error)}") from error
