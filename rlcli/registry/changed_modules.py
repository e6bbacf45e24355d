"""Detection and removal of changes that the code of a task or plugin makes to modules of Python and of libraries.

An example of such a change is `time.time = None`. `ModuleCopies` restores what rlcli needs to report an error.
`change_of_module` searches the code for the line that makes the change, and returns an error that names the line.
"""

import ast
import builtins
import contextlib
import gc
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from rlcli.errors import TaskError, listing, short_error
from rlcli.registry.framework_imports import executed_files
from rlcli.registry.task_code_monitor import is_task_file

_MAX_BYTES = 1_000_000
"""Largest file that is searched for changes [bytes]."""
_CHANGING = ("clear", "pop", "popitem", "update", "__setitem__", "__delitem__")
"""Methods of dictionaries that delete or replace names, as in `sys.modules.clear()`."""


class ModuleCopies:
    """Copies of the modules that rlcli needs to report an error; create the object before the code of a task runs.

    After `restore`, `lost_modules` has the names that were missing or replaced in `sys.modules`.
    """

    def __init__(self) -> None:
        self._loaded = sys.modules
        self._modules = sys.modules.copy()
        self._built_in, self._built_in_before = vars(builtins), vars(builtins).copy()
        self.lost_modules: list[str] = []
        self._others = [(vars(module), vars(module).copy()) for module in (os, threading, time)]

    def restore(self, is_callable: type = callable) -> TaskError | None:  # type: ignore[assignment]
        """Restore what code of a task has deleted or replaced; return an error if these were built-in functions.

        The method restores all built-in functions, functions of other modules that are missing or replaced by a value,
        and modules that are missing in `sys.modules` or have another value there. It calls no built-in function before
        it has restored them.

        Args:
            is_callable: the built-in `callable`.
        """
        before, present = self._built_in_before, self._built_in
        changed = [name for name in before if present.get(name) is not before[name]]
        present.update(before)
        self._restore_modules()
        for present, before in self._others:
            for name in before:
                if is_callable(before[name]) and not is_callable(present.get(name)):
                    present[name] = before[name]
        if not changed:
            return None
        place = next((place for place, name in _changes() if name.startswith("builtins")), "")
        return TaskError(
            f"{place}code of the task has deleted or replaced the built-in functions {listing(changed, limit=3)}",
            hint="remove the assignment to `builtins` from the task's code; --debug shows the traceback",
        )

    def _restore_modules(self) -> None:
        """Restore the entries of `sys.modules` that are missing or hold something else than the module of that name."""
        sys.modules = loaded = self._loaded
        known = self._modules
        self.lost_modules = [name for name in known if _is_other(loaded.get(name), known[name])]
        loaded.update((name, known[name]) for name in self.lost_modules)
        if not self.lost_modules and not any(module is None for module in loaded.values()):
            return
        # modules that were imported later: without them, `import` would execute a library a second time
        for module in gc.get_objects():
            if issubclass(type(module), ModuleType):
                name = _entry(module, "__name__")
                if type(name) is str and _entry(module, "__spec__") and _is_other(loaded.get(name), module):
                    self.lost_modules.append(name)
                    loaded[name] = module
        if self.lost_modules:
            for name in [name for name, value in loaded.items() if _is_no_module(value)]:
                del loaded[name]

    def error_of_lost_modules(self, error: BaseException) -> TaskError | None:
        """Return an error for `error` if `restore` has found modules that code had removed or replaced, else None."""
        if not self.lost_modules:
            return None
        names = listing(self.lost_modules, limit=3)
        place = next((place for file, tree in _executed_trees() for place in _uses_of_modules(file, tree)), "")
        return TaskError(
            f"{place}code of the task has removed or replaced {names} in sys.modules, which is probably the reason for"
            f" {short_error(error)}",
            hint="remove changes of `sys.modules` from the task's code; --debug shows the traceback",
        )


def _is_other(value: object, module: ModuleType) -> bool:
    """Return whether a value of `sys.modules` cannot be what the import of a module has put there."""
    if not issubclass(type(value), ModuleType):
        return _is_no_module(value)
    return value is not module and _entry(value, "__name__") != _entry(module, "__name__")


def _is_no_module(value: object) -> bool:
    kind = type(value)
    return kind.__module__ == "builtins" and not issubclass(kind, ModuleType)  # libraries have objects as modules


def _entry(module: object, name: str) -> object:
    """Return a value of a module's namespace, or None, without an import that the module delays."""
    return ModuleType.__getattribute__(module, "__dict__").get(name)


def change_of_module(error: BaseException) -> TaskError | None:
    """Return an error that names the first line of a task's code that changes a module; None if there is no such line.

    The change is probably the reason for `error`.
    """
    for place, name in _changes():
        return TaskError(
            f"{place}code of the task changes {name}, which is probably the reason for {short_error(error)}",
            hint="remove the change; if the error remains, report it with the traceback that --debug shows",
        )
    return None


def _changes() -> Iterator[tuple[str, str]]:
    """Yield `file:line: ` and dotted name of the changes of modules in the executed files of tasks and plugins."""
    for file, tree in _executed_trees():
        for line, name in sorted(_changes_in(tree)):
            yield f"{file}:{line}: ", name


def _uses_of_modules(file: str, tree: ast.Module) -> list[str]:
    """Return `file:line: ` of the lines that contain `sys.modules`."""
    lines = {
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and _dotted(node) == ("sys", ["modules"])
    }
    return [f"{file}:{line}: " for line in sorted(lines)]


def _executed_trees() -> Iterator[tuple[str, ast.Module]]:
    """Yield name and syntax tree of the executed files of tasks and plugins."""
    files = dict.fromkeys(executed_files())
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if isinstance(file, str) and is_task_file(file, name.partition(".")[0]):
            files[file] = None
    for file in files:
        try:
            source = Path(file).read_bytes()
            tree = ast.parse(source) if len(source) <= _MAX_BYTES else ast.Module([], [])
        except (OSError, ValueError, SyntaxError, RecursionError, MemoryError):
            continue
        yield file, tree


def _changes_in(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of assignments to names of modules that a file imports, and of their deletions.

    Assignments of constants other than None are left out: they are settings, as in `torch.backends.cudnn.enabled`.
    """
    imported = {"__builtins__": "builtins"}
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    for statement in imports:
        if isinstance(statement, ast.Import):
            for each in statement.names:
                top = each.name.partition(".")[0]
                imported[each.asname or top] = each.name if each.asname else top
        elif statement.module and not statement.level:
            imported |= {each.asname or each.name: f"{statement.module}.{each.name}" for each in statement.names}
    imported = {name: module for name, module in imported.items() if not _is_of_task(module.partition(".")[0])}
    for node in ast.walk(tree):
        for target in _changed_expressions(node):
            root, inner = _dotted(target)
            if root in imported and inner:
                yield node.lineno, ".".join((imported[root], *inner))  # type: ignore[attr-defined]
        if (executed := _executed_string(node, imports)) is not None:
            for _, name in _changes_in(executed):
                yield node.lineno, name  # type: ignore[attr-defined]


def _executed_string(node: ast.AST, imports: list[ast.Import | ast.ImportFrom]) -> ast.Module | None:
    """Return the code of a call `exec("CODE")`, with the imports of the file that contains it; None for other nodes."""
    match node:
        case ast.Call(func=ast.Name(id="exec" | "eval"), args=[ast.Constant(value=str(text)), *_]):
            with contextlib.suppress(ValueError, SyntaxError, RecursionError, MemoryError):
                return ast.Module([*imports, *ast.parse(text).body], [])
    return None


def _is_of_task(package: str) -> bool:
    file = getattr(sys.modules.get(package), "__file__", None)
    return isinstance(file, str) and is_task_file(file, package)


def _changed_expressions(node: ast.AST) -> list[ast.expr]:
    """Return the expressions `MODULE.NAME` that a statement or a call changes."""
    match node:
        case ast.Assign(value=ast.Constant(value=value)) if value is not None:
            return []
        case ast.Assign(targets=targets) | ast.Delete(targets=targets):
            flat = [part for each in targets for part in (each.elts if isinstance(each, ast.Tuple) else [each])]
            return [each for each in flat if not isinstance(each, ast.Subscript) or _is_namespace(each.value)]
        case ast.Call(func=ast.Name(id="setattr" | "delattr"), args=[owner, ast.Constant(value=name), *_]):
            return [ast.Attribute(owner, str(name))]
        case ast.Call(func=ast.Name(id="setattr" | "delattr"), args=[owner, *_]):
            return [ast.Attribute(owner, "...")]
        case ast.Call(func=ast.Attribute(value=owner, attr=name)) if name in _CHANGING and _is_namespace(owner):
            return [owner]
    return []


def _is_namespace(node: ast.expr) -> bool:
    """Return whether an expression is the dictionary of a module's names, or `sys.modules`."""
    match node:
        case ast.Name(id="__builtins__") | ast.Attribute(attr="__dict__") | ast.Call(func=ast.Name(id="vars")):
            return True
        case ast.Attribute(value=ast.Name(id="sys"), attr="modules"):
            return True
    return False


def _dotted(node: ast.expr) -> tuple[str, list[str]]:
    """Return the name at the start of an expression and the attributes behind it: `a.b["c"]` -> a, [b]."""
    match node:
        case ast.Name(id=name):
            return name, []
        case ast.Attribute(value=owner, attr=attribute):
            root, inner = _dotted(owner)
            return root, [*inner, attribute]
        case ast.Subscript(value=owner):
            root, inner = _dotted(owner)
            return root, inner or ["__dict__"]
        case ast.Call(func=ast.Name(id="vars"), args=[owner]):
            root, inner = _dotted(owner)
            return root, [*inner, "__dict__"]
    return "", []
