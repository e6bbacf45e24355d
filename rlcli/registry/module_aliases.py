"""Import statements in task files. A module of another framework is replaced by one of an installed format.

The files of a task are executed with their own `__import__`. No other module uses it, and `sys.modules` never has an
entry for another framework: an installed original is neither imported for a task nor hidden from others. Functions of
a task that import something later use the same `__import__`.
"""

import builtins
import contextlib
import functools
import importlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from rlcli.registry.formats import Format, aliasing_formats

_MOST_FILES = 200
"""Most files of a task in which names of formats are counted."""
_python_import = builtins.__import__
_trees: dict[str, str] = {}
"""Module name of an imported package or folder -> name under which its own files import it."""
_roots: list[Path] = []
"""Folders whose modules are executed as files of a task."""


class TaskFileLoader(SourceFileLoader):
    """Loader of one Python file of a task."""

    def exec_module(self, module: ModuleType) -> None:
        """Execute the file with the `__import__` of task files."""
        vars(module)["__builtins__"] = {**vars(builtins), "__import__": _import}
        super().exec_module(module)


def register_package(module: str, folder: Path, own_name: str) -> None:
    """Register a folder of task files: its files import each other as `own_name`, and Python knows them as `module`."""
    _trees[module] = own_name
    if folder not in _roots:
        _roots.append(folder)
    if _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)


@contextlib.contextmanager
def files_below(folder: Path) -> Iterator[None]:
    """Execute modules that are found in a folder as files of a task, inside the `with` block."""
    added = folder not in _roots
    register_package("", folder, "")
    try:
        yield
    finally:
        if added:
            _roots.remove(folder)


def is_alias(name: str) -> bool:
    """Return whether an installed format has modules below a top-level name."""
    return bool(_formats_for(name, ""))


def import_by_name(name: str) -> Any:
    """Import a module by the name that a task file would write. Folders of imported task files come first."""
    tree = next((module for module, own in _trees.items() if own == name.partition(".")[0] != module), "")
    module, _ = _resolve(name, {"__name__": tree})
    return importlib.import_module(name) if module is None else module


class _TaskFinder(MetaPathFinder):
    """Import finder for the registered folders."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of a file in a registered folder; None for any other module."""
        if path is None and not _roots:
            return None
        if path is not None and name.partition(".")[0] not in _trees:
            return None
        spec = PathFinder.find_spec(name, path)
        if spec is None or not isinstance(spec.loader, SourceFileLoader) or spec.origin is None:
            return None
        if not any(Path(spec.origin).is_relative_to(root) for root in _roots):
            return None
        spec.loader = TaskFileLoader(spec.loader.name, spec.loader.path)
        return spec


def _import(
    name: str,
    module_globals: Mapping[str, Any] | None = None,
    module_locals: Mapping[str, Any] | None = None,
    fromlist: Sequence[str] | None = (),
    level: int = 0,
) -> Any:
    """Import a module for a file of a task, as the built-in `__import__` does."""
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
    """Return a module, or a copy of it that has modules of a format as members."""
    if not members:
        return module
    copy = ModuleType(module.__name__)
    vars(copy).update({**vars(module), **members})
    return copy


def _resolve(name: str, scope: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the module of a name and that of its first part; None if Python's own import finds them."""
    first, _, rest = name.partition(".")
    own = str(scope.get("__name__", "")).partition(".")[0]
    in_tree = _trees.get(own) == first and own != first
    file = str(scope.get("__file__", ""))
    for form in _formats_for(first, file):
        module = _alias_module(form, name, file, below_top=in_tree)
        if module is not None:
            return module, _alias_module(form, first, file) or _above_alias(form, name, file)
    if in_tree:
        return importlib.import_module(f"{own}.{rest}" if rest else own), sys.modules[own]
    if first not in sys.modules:
        _import_folder_above(first, Path(file))
    return None, None


def _import_folder_above(name: str, file: Path) -> None:
    """Import a folder above a file as a package, for imports from the repository's root: `source.robot.mdp`."""
    folder = next((parent for parent in file.parents if parent.name == name), None)
    spec = PathFinder.find_spec(name)
    if folder is None or (spec is not None and str(folder) not in (spec.submodule_search_locations or ())):
        return
    register_package(name, folder, name)
    sys.path.append(str(folder.parent))
    try:
        importlib.import_module(name)
    finally:
        sys.path.remove(str(folder.parent))


def _above_alias(form: Format, name: str, file: str) -> Any:
    """Return the package of which an alias is a part, with the alias as a member: `rlcli` of `rlcli.FORMAT.module`."""
    first, second, *_ = name.split(".")
    return _with_members(sys.modules[first], {second: _alias_module(form, f"{first}.{second}", file)})


def _alias_module(form: Format, name: str, file: str, below_top: bool = False) -> Any:
    """Return the module that a format has for a name; None if it has none.

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
    """Return the formats with an alias below a name; first the one whose other aliases the importing file mentions.

    If the file mentions none, the other files of its task decide.
    """
    forms = [
        form for form in aliasing_formats() if any(alias.partition(".")[0] == first for alias in form.spec.aliases)
    ]
    if len(forms) < 2 or not file.endswith(".py"):
        return tuple(forms)
    shared = set.intersection(*(set(form.spec.aliases) for form in forms))
    own = {form.name: tuple(set(form.spec.aliases) - shared) for form in forms}
    counts = {name: _mentions(file, aliases) for name, aliases in own.items()}
    if len(set(counts.values())) == 1:
        root = next((root for root in _roots if Path(file).is_relative_to(root)), Path(file).parent)
        files = sorted(root.rglob("*.py"))[:_MOST_FILES]
        counts = {name: sum(_mentions(str(path), aliases) for path in files) for name, aliases in own.items()}
    return tuple(sorted(forms, key=lambda form: -counts[form.name]))


@functools.cache
def _mentions(file: str, aliases: tuple[str, ...]) -> int:
    """Return how often a file mentions one of the names."""
    text = Path(file).read_text(encoding="utf-8", errors="replace")
    return sum(text.count(alias) for alias in aliases)


_FINDER = _TaskFinder()
