"""Tasks of installed packages: where their files lie, and which files and modules are theirs."""

from __future__ import annotations

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

from rlcli.errors import TaskError
from rlcli.registry.entries import GROUPS, Entry, catalog
from rlcli.registry.imports import contained, load_entry, place_of
from rlcli.registry.source import TaskSource
from rlcli.task import API_VERSION, TaskSpec


def installed_task(entry: Entry) -> TaskSource:
    """The task of an entry point, imported as far as its `TaskSpec`.

    Raises:
        TaskError: broken, or built for a newer rlcli.
    """
    spec = load_entry(entry, TaskSpec)
    if spec.api > API_VERSION:
        raise TaskError(
            f"task '{entry.qualified}' ({entry.version}) needs plugin API {spec.api}; this rlcli has {API_VERSION}",
            hint="pip install --upgrade rlcli",
        )
    return packaged_task(entry, spec)


def packaged_task(entry: Entry, spec: TaskSpec) -> TaskSource:
    """The files of a task in an installed package."""
    root = _folder(spec.package, entry)
    in_python = ":" in spec.config
    config = _module_file(spec.config.partition(":")[0], entry) if in_python else root / spec.config
    if not config.is_file():
        raise TaskError(f"task '{entry.qualified}' is broken: {config} does not exist")
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
    """The installed task that a YAML file belongs to; only plugins whose package holds the file are imported."""
    for entry in catalog()[0]:
        package = package_folder(entry)
        if package is not None and file.resolve().is_relative_to(package.resolve()):
            try:
                source = installed_task(entry)
            except TaskError:
                continue
            if source.config.resolve() == file.resolve():
                return source
    return None


def package_folder(entry: Entry) -> Path | None:
    """Where the top-level package of an entry point lies, without importing it."""
    try:
        found = importlib.util.find_spec(entry.value.partition(":")[0].partition(".")[0])
    except (ImportError, ValueError):
        return None
    places = list(found.submodule_search_locations or ()) if found else []
    return Path(places[0]) if places else None


def is_offered(module: str, source: TaskSource) -> bool:
    """Whether a configuration may name a module: one of a task's own package, or of an installed plugin's.

    Nothing is imported: a configuration is data, and may be a stranger's.
    """
    top = module.partition(".")[0]
    if not top.isidentifier():
        return False
    entries = [entry for group in GROUPS for entry in catalog(group)[0]]
    if top in {entry.value.partition(":")[0].partition(".")[0] for entry in entries}:
        return True
    try:
        found = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return False
    places = [Path(place).resolve() for place in (found.submodule_search_locations or ())] if found else []
    return any(source.root.resolve().is_relative_to(place) for place in places)


def _folder(package: str, entry: Entry) -> Path:
    found = _find(package, entry)
    if found is None or not found.submodule_search_locations:
        raise TaskError(f"task '{entry.qualified}' is broken: '{package}' is not a package")
    return Path(next(iter(found.submodule_search_locations)))


def _module_file(module: str, entry: Entry) -> Path:
    found = _find(module, entry)
    if found is None or not found.origin:
        raise TaskError(f"task '{entry.qualified}' is broken: there is no module '{module}'")
    return Path(found.origin)


def _find(module: str, entry: Entry) -> ModuleSpec | None:
    """Where a module lies; its parent packages are imported for that."""
    try:
        with contained():
            return importlib.util.find_spec(module)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise TaskError(
            f"task '{entry.qualified}' is broken: {type(error).__name__}: {error}{place_of(error)}"
        ) from error
