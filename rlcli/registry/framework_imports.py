"""Import system for task files of another framework: imports of the framework's modules get modules of a plugin.

For example, `import isaaclab.envs` in a task file imports a module of the plugin. The files of a task are executed with
their own `__import__`, also when their functions import something later. No other code uses this `__import__`, and
`sys.modules` never has an entry for another framework: the framework itself, if it is installed, is not imported for a
task, and other code can still import it.
"""

import builtins
import contextlib
import functools
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

from rlcli.registry.formats import Format, aliasing_formats
from rlcli.registry.module_names import OWN_NAMES

_MOST_FILES = 200
"""Largest number of files of a task in which imports of formats are counted."""
_python_import = builtins.__import__
_roots: list[Path] = []
"""Folders whose modules are executed as files of a task."""
_by_file: dict[str, ModuleType] = {}
"""Path of a task file -> the module that was imported from it."""
_known_paths: list[frozenset[str]] = []
"""The entries of `sys.path` before the task file that is being executed; an empty list if no file is executed."""


class TaskFileLoader(SourceFileLoader):
    """Loader of one Python file of a task, whose imports of another framework get the plugin's modules."""

    def exec_module(self, module: ModuleType) -> None:
        """Execute the file with the `__import__` of task files."""
        _by_file[self.path] = module
        vars(module)["__builtins__"] = {**vars(builtins), "__import__": _import}
        outermost = not _known_paths
        if outermost:
            _known_paths.append(frozenset(sys.path))
        try:
            with _without_gpu(self.path):
                super().exec_module(module)
        finally:
            if outermost:
                _add_own_paths()
                _known_paths.clear()


def _without_gpu(file: str) -> contextlib.AbstractContextManager[Any]:
    """Return the context manager in which a task file is executed.

    If the file names the device `cuda` and this machine has no GPU, the context uses the CPU in its place.
    """
    if b"cuda" in Path(file).read_bytes():
        import torch

        from rlcli.machine.device_names import CudaAsCpu

        if not torch.cuda.is_available():
            return CudaAsCpu()
    return contextlib.nullcontext()


def executed_files() -> list[str]:
    """Return the paths of the task files that this process has executed, in order."""
    return list(_by_file)


class _KnownFileLoader(Loader):
    """Loader for a task file that was imported before under another name; it returns the same module object again."""

    def __init__(self, known: ModuleType) -> None:
        self._known, self._spec = known, known.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module object of the earlier import."""
        return self._known

    def exec_module(self, module: ModuleType) -> None:
        """Restore the attribute `__spec__` of the module, which the import system has changed; run no code."""
        module.__spec__ = self._spec


def register_package(module: str, folder: Path, own_name: str) -> None:
    """Register a folder of task files, so that its modules are executed as task files.

    Args:
        module: name of the folder's package in `sys.modules`.
        folder: the folder.
        own_name: name of the package in the import statements of its files.
    """
    OWN_NAMES[module] = own_name
    if folder not in _roots:
        _roots.append(folder)
    if _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)


@contextlib.contextmanager
def files_below(folder: Path) -> Iterator[None]:
    """Treat the modules in a folder as files of a task while the `with` block imports them."""
    added = folder not in _roots
    register_package("", folder, "")
    try:
        yield
    finally:
        if added:
            _roots.remove(folder)


def is_task_package(name: str) -> bool:
    """Return whether a top-level package is executed as files of a task."""
    return name in OWN_NAMES


def is_alias(name: str) -> bool:
    """Return whether an installed format replaces modules of the package with this top-level name."""
    return bool(_formats_for(name, ""))


def import_by_name(name: str) -> Any:
    """Import a module by the name that a task file writes in its import statement.

    The folders of task files that are imported already are searched first.
    """
    tree = next((module for module, own in OWN_NAMES.items() if own == name.partition(".")[0] != module), "")
    module, _ = _resolve(name, {"__name__": tree})
    return importlib.import_module(name) if module is None else module


class _TaskFinder(MetaPathFinder):
    """Import finder (an entry of `sys.meta_path`) for the registered folders of task files."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: Any = None) -> ModuleSpec | None:
        """Return the `ModuleSpec` of a file in a registered folder, with a loader for task files; None for others."""
        if path is None:
            _add_own_paths()
        if path is not None and name.partition(".")[0] not in OWN_NAMES:
            return None
        spec = PathFinder.find_spec(name, path)
        if spec is None or not isinstance(spec.loader, SourceFileLoader) or spec.origin is None:
            return None
        if not any(Path(spec.origin).is_relative_to(root) for root in (*_roots, *_folders_above())):
            return None
        if path is None:
            OWN_NAMES.setdefault(name, name)  # the package's modules are files of the task, too
        known = _by_file.get(spec.origin)
        if known is not None and sys.modules.get(known.__name__) is known:
            spec.loader = _KnownFileLoader(known)
        else:
            spec.loader = TaskFileLoader(spec.loader.name, spec.loader.path)
        return spec


def _folders_above() -> list[Path]:
    """Return the folders of PYTHONPATH that contain a task's folder, such as the root of its repository."""
    given = (Path(entry).resolve() for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry)
    return [folder for folder in given if any(root.is_relative_to(folder) for root in _roots)]


def _add_own_paths() -> None:
    """Register folders that a task's files have added to `sys.path` as folders of the task.

    Folders of installed packages and of Python itself are not registered.
    """
    for entry in sys.path if _known_paths else ():
        folder = Path(entry).resolve()
        installed = {"site-packages", "dist-packages"} & set(folder.parts) or Path(sys.prefix).is_relative_to(folder)
        if entry and entry not in _known_paths[0] and folder not in _roots and not installed:
            _roots.append(folder)


def _import(
    name: str,
    module_globals: Mapping[str, Any] | None = None,
    module_locals: Mapping[str, Any] | None = None,
    fromlist: Sequence[str] | None = (),
    level: int = 0,
) -> Any:
    """Import a module for a file of a task. The parameters are those of the built-in `__import__`.

    If the import of one task fails in the `__init__.py` of a package, a `FailedImport` takes its place, so that the
    package's other tasks can still be used.
    """
    try:
        return _import_module(name, module_globals, module_locals, fromlist, level)
    except Exception as error:
        # imported here: every command imports this module, but hardly any has a failing import
        from rlcli.registry.failed_imports import can_be_left_out, failed_import

        scope = module_globals or {}
        package, file = str(scope.get("__package__")), Path(str(scope.get("__file__", "")))
        top = package.partition(".")[0]
        own = level > 0 or name.partition(".")[0] in (top, OWN_NAMES.get(top))
        if level and not name and fromlist and len(fromlist) > 1:
            members = {part: getattr(_import(name, scope, {}, (part,), level), part) for part in fromlist}
            return _with_members(sys.modules[package], members)
        part = name or "".join(fromlist or ())
        if not own or not can_be_left_out(part, level, file):
            raise
        failed = failed_import(f"{package}.{part}" if level else name, error, _running_line(file))
        return failed if name else _with_members(sys.modules[package], {part: failed})


def _running_line(file: Path) -> str:
    """Return `file:line` of the innermost line of a file that is running."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and frame.f_code.co_filename != str(file):
        frame = frame.f_back
    return f"{file}:{frame.f_lineno}" if frame is not None else str(file)


def _import_module(
    name: str,
    module_globals: Mapping[str, Any] | None = None,
    module_locals: Mapping[str, Any] | None = None,
    fromlist: Sequence[str] | None = (),
    level: int = 0,
) -> Any:
    """Import a module for a file of a task: the plugin's module if a format replaces it, else the real one."""
    scope = module_globals or {}
    module, top = _resolve(name, scope) if level == 0 else (None, None)
    if module is None:
        found = _python_import(name, scope, module_locals or {}, fromlist or (), level)
        below = {part: _resolve(f"{name}.{part}", scope)[0] for part in fromlist or () if level == 0 and is_alias(name)}
        return _with_members(found, {part: alias for part, alias in below.items() if alias is not None})
    for part in fromlist or ():
        if part != "*" and not hasattr(module, part) and module.__spec__ is not None:
            inner = f"{module.__name__}.{part}"
            try:
                importlib.import_module(inner)
            except ModuleNotFoundError as error:
                if error.name != inner:
                    raise
    return module if fromlist else top


def _with_members(module: ModuleType, members: Mapping[str, Any]) -> ModuleType:
    """Return a copy of a module with these members added or replaced; the module itself if there are no members."""
    if not members:
        return module
    copy = ModuleType(module.__name__)
    vars(copy).update({**vars(module), **members})
    return copy


def _resolve(name: str, scope: Mapping[str, Any]) -> tuple[Any, Any]:
    """Find the module that an import statement in a task file means.

    Args:
        name: name of the module, `a.b.c`.
        scope: globals of the task file.

    Returns:
        The module, and the module of the first part, `a`; (None, None) if Python's own import has to find them.
    """
    first, _, rest = name.partition(".")
    own = str(scope.get("__name__", "")).partition(".")[0]
    in_tree = OWN_NAMES.get(own) == first and own != first and _has_member(sys.modules[own], rest.partition(".")[0])
    file = str(scope.get("__file__", ""))
    for form in _formats_for(first, file):
        module = _alias_module(form, name, file, below_top=in_tree)
        if module is not None:
            return module, _top_of(form, name, file)
    if in_tree:
        return importlib.import_module(f"{own}.{rest}" if rest else own), sys.modules[own]
    if first not in sys.modules:
        import_package(first, rest, Path(file))
    return None, None


def _has_member(package: ModuleType, name: str) -> bool:
    """Return whether a package of a task has a module; the package may have the name of a package of a framework."""
    folders = [Path(place) for place in getattr(package, "__path__", ())]
    return not name or any((place / name).is_dir() or (place / f"{name}.py").is_file() for place in folders)


def import_package(name: str, inner: str, file: Path) -> None:
    """Import the folder of a task's repository that an import statement `import name.inner` means, as a package.

    The folder is one of the folders above the importing file, or `name` or `name/name` in one of these folders. Task
    files can therefore import modules by their path in the repository (`source.robot.mdp`), from a distribution of the
    repository that is not installed (`source/robot_assets/robot_assets`), and from a package beside their own. An
    installed package of the name is imported instead, as a package of the task if its files import the framework of an
    installed format.

    Args:
        name: first part of the imported module's name.
        inner: the rest of the name; empty if there is none.
        file: the importing file.
    """
    found = [parent for parent in file.parents if parent.name == name]
    if not found:
        beside = (folder for parent in file.parents for folder in (parent / name / name, parent / name))
        module = f"{inner.replace('.', '/')}.py" if inner else "__init__.py"
        found = [folder for folder in beside if any((folder / part).is_file() for part in ("__init__.py", module))]
    spec = importlib.util.find_spec(name)
    installed = [Path(place) for place in (spec.submodule_search_locations or ())] if spec is not None else []
    usable = [place for place in found if spec is None or place in installed]
    libraries = {library for form in aliasing_formats() for library in form.spec.libraries}
    usable = usable[:1] or [place for place in installed if name not in libraries and _is_for_a_framework(place)]
    if not usable:
        return
    folder = usable[0]
    register_package(name, folder, name)
    sys.path.append(str(folder.parent))
    try:
        importlib.import_module(name)
    finally:
        sys.path.remove(str(folder.parent))


def _is_for_a_framework(folder: Path) -> bool:
    """Return whether files of a package import the framework of an installed format."""
    names = tuple(n for form in aliasing_formats() for n in form.spec.aliases if n not in form.spec.libraries)
    return any(_imports(str(path), names) for path in sorted(folder.rglob("*.py"))[:_MOST_FILES])


def _top_of(form: Format, name: str, file: str) -> Any:
    """Return what `import a.b.c` binds to the name `a`, if a format replaces `a.b`.

    If the package `a` has no `b`, the result is a copy of `a` in which the format's module is `a.b`. Then the format
    does not replace `a`, or `a` is a package of the task that has the name of a framework's package.

    Args:
        form: the format that replaces the module.
        name: full name of the module, `a.b.c`.
        file: the importing file.
    """
    first, _, rest = name.partition(".")
    second = rest.partition(".")[0]
    top = _alias_module(form, first, file) or sys.modules[first]
    if not second or hasattr(top, second):
        return top
    return _with_members(top, {second: _alias_module(form, f"{first}.{second}", file)})


def _alias_module(form: Format, name: str, file: str, below_top: bool = False) -> Any:
    """Return the module with which a format replaces the module of a name; None if the format has no replacement.

    Args:
        form: the format.
        name: full name of the module.
        file: the importing file.
        below_top: only use aliases of submodules, which replace modules of the task's own package.
    """
    for alias, target in form.spec.aliases.items():
        if (name != alias and not name.startswith(f"{alias}.")) or (below_top and "." not in alias):
            continue
        if ":" in target:
            return form.load(target)(name, file)
        return importlib.import_module(f"{target}{name.removeprefix(alias)}")
    return None


@functools.cache
def _formats_for(first: str, file: str) -> tuple[Format, ...]:
    """Return the formats that replace modules of the package `first`. If there are several, choose by the imports.

    The chosen format is the one whose other modules the importing file imports most often. If the file favours none,
    the imports of all files of its task are counted.
    """
    forms = [
        form for form in aliasing_formats() if any(alias.partition(".")[0] == first for alias in form.spec.aliases)
    ]
    if len(forms) < 2 or not file.endswith(".py"):
        return tuple(forms)
    shared = set.intersection(*(set(form.spec.aliases) for form in forms))
    own = {form.name: tuple(set(form.spec.aliases) - shared - set(form.spec.libraries)) for form in forms}
    counts = {name: _imports(file, aliases) for name, aliases in own.items()}
    if len(set(counts.values())) == 1:
        root = next((root for root in _roots if Path(file).is_relative_to(root)), Path(file).parent)
        files = sorted(root.rglob("*.py"))[:_MOST_FILES]
        counts = {name: sum(_imports(str(path), aliases) for path in files) for name, aliases in own.items()}
    most = max(counts.values())  # only this format can belong to the task
    return tuple(form for form in forms if counts[form.name] == most)


@functools.cache
def _imports(file: str, modules: tuple[str, ...]) -> int:
    """Return the number of import statements of a file that import one of the modules."""
    text = Path(file).read_text(encoding="utf-8", errors="replace")
    names = "|".join(re.escape(name) for name in modules)
    return len(re.findall(rf"^[ \t]*(?:from|import)[ \t]+(?:{names})\b", text, re.MULTILINE))


_FINDER = _TaskFinder()
