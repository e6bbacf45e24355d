"""Search for classes and their base classes in Python source files, without importing (executing) the files.

The configuration is checked in this way before a task's code is trusted.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

_RLCLI = Path(__file__).resolve().parents[1]
MAX_CLASSES = 64
"""Largest number of classes in one search. The files may be untrusted, and may inherit from each other in a circle."""


@dataclass(frozen=True, slots=True)
class SourceClass:
    """A class in a source file: its file and its syntax tree."""

    file: Path
    node: ast.ClassDef

    def nested(self, name: str) -> SourceClass | None:
        """Return the class of this name that is defined inside of this class; None if there is none."""
        node = next((n for n in self.node.body if isinstance(n, ast.ClassDef) and n.name == name), None)
        return None if node is None else SourceClass(self.file, node)


def parse(file: Path) -> ast.Module:
    """Return the syntax tree of a file.

    Raises:
        SyntaxError: if the file is not Python.
    """
    try:
        with warnings.catch_warnings(action="ignore"):
            return ast.parse(file.read_bytes(), filename=str(file))
    except SyntaxError as error:
        error.filename = str(file)  # Python does not set the name of the file if the file has a null byte
        raise
    except (ValueError, RecursionError, MemoryError) as error:
        raise SyntaxError(str(error) or "nested too deeply", (str(file), 1, 1, None)) from None


class ClassSearch:
    """Search for classes in source files, which stops after `MAX_CLASSES` classes.

    Base classes are found in the same file, in other files of the same package, and in `rlcli.mdp`. `trees` is a cache
    of the syntax trees of files; new files are added to it. Methods raise SyntaxError if a file is not Python.
    """

    def __init__(self, trees: dict[Path, ast.Module] | None = None) -> None:
        self._trees = {} if trees is None else trees
        self._left = MAX_CLASSES

    def lineage(self, file: Path, name: str) -> list[SourceClass]:
        """Return a class and its base classes, depth first, each once; an empty list if the file has no such class."""
        first = self._find(file, name)
        return [] if first is None else list(self.walk(first))

    def nested(self, file: Path, outer: str, name: str) -> SourceClass | None:
        """Return the class `name` inside of the class `outer` or of one of its base classes; None if there is none."""
        found = (owner.nested(name) for owner in self.lineage(file, outer))
        return next((inner for inner in found if inner is not None), None)

    def nested_lineage(self, file: Path, outer: str, name: str) -> list[SourceClass]:
        """Return the class `name` inside of the class `outer` (or of its base classes), and then its own base classes.

        The list is empty if there is no such class.
        """
        found = self.nested(file, outer, name)
        return [] if found is None else list(self.walk(found))

    def walk(self, first: SourceClass, seen: set[ast.ClassDef] | None = None) -> Iterator[SourceClass]:
        """Yield a class and its base classes, depth first, each once."""
        seen = set() if seen is None else seen
        if first.node in seen or not self._left:
            return
        self._left -= 1
        seen.add(first.node)
        yield first
        for expression in first.node.bases:
            base = self._base(first.file, expression)
            if base is not None:
                yield from self.walk(base, seen)

    def bases(self, source: SourceClass) -> list[SourceClass]:
        """Return the direct base classes of a class that are found; an empty list after `MAX_CLASSES` classes."""
        if not self._left:
            return []
        self._left -= 1
        found = (self._base(source.file, expression) for expression in source.node.bases)
        return [base for base in found if base is not None]

    def _base(self, file: Path, expression: ast.expr) -> SourceClass | None:
        """Return the class of an expression `Name` or `Outer.Name`; None if it is not found."""
        if isinstance(expression, ast.Name):
            return self._find(file, expression.id)
        if isinstance(expression, ast.Attribute) and isinstance(expression.value, ast.Name):
            return self.nested(file, expression.value.id, expression.attr) if self._left else None
        return None

    def _find(self, file: Path, name: str) -> SourceClass | None:
        """Return the class that a file defines or imports under a name; None if it is not found."""
        for node in self._tree(file).body:
            if isinstance(node, ast.ClassDef) and node.name == name:
                return SourceClass(file, node)
            if not isinstance(node, ast.ImportFrom):
                continue
            imported = {alias.asname or alias.name: alias.name for alias in node.names}
            real = imported.get(name, name if "*" in imported else None)
            if real is None:
                continue
            for other in _module_files(file, node):
                if other.is_file() and other != file and self._left:
                    self._left -= 1
                    found = self._find(other, real)
                    if found is not None:
                        return found
        return None

    def _tree(self, file: Path) -> ast.Module:
        if file not in self._trees:
            self._trees[file] = parse(file)
        return self._trees[file]


def _module_files(file: Path, node: ast.ImportFrom) -> Iterator[Path]:
    """Yield the files that may define the module of an import statement; some of the files may not exist.

    Args:
        file: the importing file.
        node: its statement `from MODULE import ...`.
    """
    parts = (node.module or "").split(".")
    # an absolute import may start at any folder above the file, because the root of the package is unknown
    roots: Sequence[Path] = file.parents[node.level - 1 : node.level] if node.level else file.parents
    if parts[0] == "rlcli" and not node.level:  # of rlcli itself only `rlcli.mdp` is searched
        roots = (_RLCLI.parent,) if parts[1:2] == ["mdp"] else ()
    for root in roots:
        yield root.joinpath(*parts).with_suffix(".py")
        yield root.joinpath(*parts, "__init__.py")


@dataclass(frozen=True, slots=True)
class _Field:
    """A field of a dataclass, which is a parameter of its `__init__`."""

    argument: ast.arg
    default: ast.expr | None
    keyword_only: bool


def constructor(source: SourceClass, search: ClassSearch) -> ast.FunctionDef | None:
    """Return the `__init__` of a class: defined in the class, generated by `@dataclass`, or inherited; else None.

    Raises:
        SyntaxError: if the file of a base is not Python.
    """
    node = source.node
    own = next((n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"), None)
    if own is not None:
        return own
    if _dataclass_decorator(node) is not None:
        return _dataclass_init(node, list(_fields(source, search).values()))
    inits = (constructor(base, search) for base in search.bases(source))
    return next((init for init in inits if init is not None), None)


def _dataclass_init(node: ast.ClassDef, fields: list[_Field]) -> ast.FunctionDef:
    """Return the syntax tree of the `__init__` that `@dataclass` generates."""
    keywords = [field for field in fields if field.keyword_only]
    arguments = ast.arguments(
        posonlyargs=[],
        args=[ast.arg("self"), *(field.argument for field in fields if not field.keyword_only)],
        kwonlyargs=[field.argument for field in keywords],
        kw_defaults=[field.default for field in keywords],
        defaults=[],
    )
    return ast.FunctionDef("__init__", arguments, body=[], decorator_list=[], lineno=node.lineno)


def _fields(source: SourceClass, search: ClassSearch) -> dict[str, _Field]:
    """Return the fields of a dataclass in the order of its `__init__`: the fields of its last base class first."""
    fields: dict[str, _Field] = {}
    for base in reversed(search.bases(source)):
        fields.update(_fields(base, search))
    decorator = _dataclass_decorator(source.node)
    if decorator is None:  # annotations of a class without @dataclass are not fields
        return fields
    keyword_only = _is_constant(_keywords(decorator).get("kw_only"), True)
    for node in source.node.body:
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        kind = last_name(node.annotation.value if isinstance(node.annotation, ast.Subscript) else node.annotation)
        name = node.target.id
        if kind == "KW_ONLY":
            keyword_only = True
        elif kind == "ClassVar" or _is_constant(_options(node.value).get("init"), False):
            fields.pop(name, None)
        else:
            fields[name] = _Field(ast.arg(name, node.annotation), _default(node.value), keyword_only)
    return fields


def _dataclass_decorator(node: ast.ClassDef) -> ast.expr | None:
    """Return the decorator `@dataclass` or `@dataclass(...)` of a class; None without such a decorator."""
    named = ((last_name(d.func if isinstance(d, ast.Call) else d), d) for d in node.decorator_list)
    return next((decorator for name, decorator in named if name == "dataclass"), None)


def _default(value: ast.expr | None) -> ast.expr | None:
    """Return the default in the value of a dataclass field, also of `field(default_factory=...)`; None without one."""
    options = _options(value)
    factory = options.get("default_factory")
    if factory is not None:
        return factory.body if isinstance(factory, ast.Lambda) else factory
    return options.get("default") if options else value


def _options(value: ast.expr | None) -> dict[str, ast.expr]:
    """Return the keyword arguments of `field(...)`; an empty mapping for any other expression."""
    return _keywords(value) if isinstance(value, ast.Call) and last_name(value.func) == "field" else {}


def _keywords(call: ast.expr | None) -> dict[str, ast.expr]:
    return {k.arg: k.value for k in call.keywords if k.arg} if isinstance(call, ast.Call) else {}


def _is_constant(node: ast.expr | None, value: bool) -> bool:
    return isinstance(node, ast.Constant) and node.value is value


def last_name(node: ast.expr) -> str | None:
    """Return the last name of an expression: `b` for `b` and for `a.b`; None for other expressions."""
    if isinstance(node, ast.Name):
        return node.id
    return node.attr if isinstance(node, ast.Attribute) else None
