"""Import of the Python files of tasks, by module name or by path.

Files of different tasks with the same name, such as `task.py`, become different modules.
"""

import contextlib
import hashlib
import importlib
import importlib.util
import operator
import sys
from collections.abc import Iterable, Iterator, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

from rlcli.registry.failed_imports import FailedImport
from rlcli.registry.framework_imports import (
    TaskFileLoader,
    files_below,
    import_by_name,
    import_package,
    is_alias,
    register_package,
)
from rlcli.registry.module_names import IMPORTED_NAME
from rlcli.registry.plugin_imports import contain_side_effects

CONFIGURATION = "env_cfg_entry_point"
"""Argument of a registration with Gymnasium that names the configuration of a task."""

ENVIRONMENT = "entry_point"
"""Key under which `registrations` has the environment class of a task."""

registrations: dict[str, dict[str, Any]] = {}
"""Tasks that imported files have registered with Gymnasium: ID of the task -> arguments of the registration."""

_imported: dict[tuple[Path, str], None] = {}
"""Ordered set of the imported task files: (file, name of the function that imported it) -> None."""


def load_object(reference: str) -> Any:
    """Import and return the object of a reference `package.module:Name` or `/path/file.py:Name`."""
    module_name, _, attribute = reference.rpartition(":")
    return operator.attrgetter(attribute)(load_module(module_name))


def load_module(name: str) -> Any:
    """Import a module by its dotted name, or a file of a task folder by its path; output of its code goes to stderr.

    The module name of a file is derived from its path, so that `task.py` of two folders are two modules.
    """
    with contain_side_effects(), _registrations_kept():
        if not name.endswith(".py"):
            return import_by_name(name)
        file = Path(name)
        digest = hashlib.blake2b(str(file.resolve()).encode(), digest_size=8).hexdigest()
        alias = f"{IMPORTED_NAME}task_{digest}_{file.stem}"
        if alias not in sys.modules:
            spec = importlib.util.spec_from_file_location(alias, file, loader=TaskFileLoader(alias, str(file)))
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules[alias] = module
            try:
                with _sibling_modules(file.resolve().parent):
                    spec.loader.exec_module(module)
            except BaseException:
                del sys.modules[alias]
                raise
            _imported[file.resolve(), load_module.__name__] = None
        return sys.modules[alias]


def registered_object(entry: object) -> Any:
    """Return the object that an argument of a registration with Gymnasium refers to.

    For `module:name` this is the imported object, and for `module:file.yaml` the path of the file. An argument that is
    not a string is returned unchanged.
    """
    if isinstance(entry, FailedImport):
        return entry()  # raises the error of the import
    if not isinstance(entry, str):
        return entry
    if not entry.endswith((".yaml", ".yml", ".json")):
        return load_object(entry)
    module, _, file = entry.rpartition(":")
    return Path(str(load_module(module).__file__)).parent / file if module else Path(file)


def missing_module_hint(error: BaseException, package: Path, task: str) -> str | None:
    """Return what to do about a module of the user that was not found; None for other errors and for other modules.

    Args:
        error: the error of the import.
        package: the package, a folder, that registers the task.
        task: the ID of the task.
    """
    name = str(error.name) if isinstance(error, ModuleNotFoundError) else ""
    if not name or all(folder.name != name.partition(".")[0] for folder in (package, *package.parents)):
        return None
    files = files_that_register(package, task)
    return f"{files[0]} registers the task with this module; correct the module's name" if files else None


def import_packages_above(entries: Iterable[object], package: Path) -> None:
    """Import the folders above a package that its registrations name, such as `farm` of `farm.tasks.reach.cfg:Cfg`.

    Thus the entries of a repository can be imported if it is not installed and its folders have no `__init__.py`.

    Args:
        entries: arguments of a registration with Gymnasium.
        package: the package, a folder, that registers the task.
    """
    for entry in entries:
        name, colon, _ = entry.partition(":") if isinstance(entry, str) else ("", "", "")
        top, *inner = name.split(".")
        if not colon or top in sys.modules or is_alias(top):
            continue
        folders = [folder for folder in package.parents if folder.name == top]
        folders = [folder for folder in folders if (folder / "/".join(inner[:1])).exists()] or folders
        if folders:
            import_folder(folders[0])


def import_folder(folder: Path) -> None:
    """Import a folder as a package by its own name, also without an `__init__.py`; prefer an installed package."""
    with contain_side_effects(), _registrations_kept():
        import_package(folder.name, "", folder / "__init__.py")
    _imported[folder, import_folder.__name__] = None


def import_file(file: Path) -> Any:
    """Import a file as a module of its folder's package, so that its relative imports work.

    If the folder is not a package, the file can import the modules beside it, as a script can.
    """
    with contain_side_effects(), _registrations_kept():
        top = file.parent
        while (top.parent / "__init__.py").is_file() and (top / "__init__.py").is_file():
            top = top.parent
        name = _package(top)
        inner = file.parent.relative_to(top).parts + (() if file.stem == "__init__" else (file.stem,))
        _imported[file, import_file.__name__] = None
        with _siblings_importable(top):
            return importlib.import_module(".".join((name, *inner)))


def files_that_register(root: Path, task: str, name: str = "*.py") -> list[Path]:
    """Return the Python files below a folder whose text registers tasks with Gymnasium and has the ID of a task.

    Args:
        root: the folder.
        task: the ID of the task.
        name: the name of the files, or a pattern.
    """
    texts = {file: file.read_bytes() for file in sorted(root.rglob(name)) if file.is_file()}
    return [file for file, text in texts.items() if b"register(" in text and task.encode() in text]


def import_from(package: Path, inner: str, *, run_start: bool = True) -> Any:
    """Import a module of a package by the package's folder.

    Args:
        package: folder of the package.
        inner: name of the module in the package, for example `robots.arm`; empty: the package itself.
        run_start: whether the package's `__init__.py` is executed.
    """
    with contain_side_effects(), _registrations_kept():
        name = _package(package, run_start)
        return importlib.import_module(f"{name}.{inner}" if inner else name)


def imported_files() -> list[tuple[Path, str]]:
    """Return the imported task files and folders, each with the name of the function that imported it.

    `import_again` imports them in another process.
    """
    return list(_imported)


def import_again(files: Sequence[tuple[Path, str]]) -> None:
    """Import the files that another process has imported (its `imported_files`), under the same module names."""
    for file, how in files:
        if how == load_module.__name__:
            load_module(str(file))
        else:
            (import_folder if how == import_folder.__name__ else import_file)(file)


@contextlib.contextmanager
def _sibling_modules(folder: Path) -> Iterator[None]:
    """Let a file of a task folder, imported in the `with` block, import the files beside it.

    Afterwards the imported files are removed from `sys.modules`, because another task may have files of the same names.
    """
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        with files_below(folder):
            yield
    finally:
        sys.path.remove(str(folder))
        for name in set(sys.modules) - before:
            file = getattr(sys.modules[name], "__file__", None)
            if file and Path(file).is_relative_to(folder) and not name.startswith(f"{IMPORTED_NAME}task_"):
                del sys.modules[name]


def _package(folder: Path, run_start: bool = True) -> str:
    """Import a folder as a package and return the package's name: the folder's name, or a unique name if it is taken.

    With `run_start` false, the folder's `__init__.py` is not executed.
    """
    digest = hashlib.blake2b(str(folder).encode(), digest_size=8).hexdigest()
    name = f"{IMPORTED_NAME}{digest}"
    if folder.name.isidentifier() and not is_alias(folder.name):
        existing = sys.modules.get(folder.name)
        is_folder = existing is not None and str(folder) in list(getattr(existing, "__path__", ()))
        if is_folder or (existing is None and importlib.util.find_spec(folder.name) is None):
            name = folder.name
    if name in sys.modules:
        return name
    register_package(name, folder, folder.name)
    start = folder / "__init__.py"
    if start.is_file() and run_start:
        loader = TaskFileLoader(name, str(start))
        spec = importlib.util.spec_from_file_location(
            name, start, loader=loader, submodule_search_locations=[str(folder)]
        )
    else:
        spec = ModuleSpec(name, None, is_package=True)
        spec.submodule_search_locations = [str(folder)]
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    if spec.loader is not None:
        try:
            with _siblings_importable(folder):
                spec.loader.exec_module(module)
        except BaseException:
            for imported in [m for m in sys.modules if m == name or m.startswith(f"{name}.")]:
                del sys.modules[imported]
            raise
    return name


@contextlib.contextmanager
def _siblings_importable(folder: Path) -> Iterator[None]:
    """Let the files of a folder, imported in the `with` block, import each other by name.

    An installed module of the same name is preferred.
    """
    sys.path.append(str(folder))
    try:
        with files_below(folder):
            yield
    finally:
        sys.path.remove(str(folder))


@contextlib.contextmanager
def _registrations_kept() -> Iterator[None]:
    """Copy the tasks that the `with` block registers with Gymnasium to `registrations`."""
    try:
        yield
    finally:
        gymnasium = sys.modules.get("gymnasium")
        registry = gymnasium.envs.registry if gymnasium is not None else {}
        for name, spec in list(registry.items()):
            cfg = spec.kwargs.get(CONFIGURATION, spec.kwargs.get("cfg"))  # `cfg`: an argument of the environment class
            if CONFIGURATION in spec.kwargs or hasattr(cfg, "__rlcli_task__"):
                registrations[name] = {**spec.kwargs, CONFIGURATION: cfg, ENVIRONMENT: spec.entry_point}
