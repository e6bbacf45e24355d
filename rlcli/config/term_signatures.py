"""Term signatures, read from source text with `ast`: files are checked without importing a stranger's code.

A term is a public function whose first parameter is `env`, or a class whose `__init__` takes `(self, env, *, ...)`
(named in YAML by its class name in snake_case). Its keyword-only parameters are its YAML keys. A class may inherit its
`__init__` from a base in the same file, in another file of the task or in `rlcli.mdp`, or have it from `@dataclass`.
"""

from __future__ import annotations

import ast
import functools
import inspect
import re
import textwrap
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Union

from pydantic import ConfigDict, Field, create_model

from rlcli.config.schema import (
    ActionConfig,
    CommandConfig,
    CurriculumConfig,
    EventConfig,
    Names,
    Number,
    ObservationConfig,
    Range,
    RewardConfig,
    StrictModel,
    SuccessConfig,
    TermConfig,
    TerminationConfig,
)
from rlcli.config.source_classes import SourceClass, constructor, last_name, nested_lineage, parse

SECTIONS: dict[str, type[TermConfig]] = {
    "actions": ActionConfig,
    "commands": CommandConfig,
    "observations": ObservationConfig,
    "events": EventConfig,
    "rewards": RewardConfig,
    "terminations": TerminationConfig,
    "curriculum": CurriculumConfig,
    "success": SuccessConfig,
}
"""Section of the YAML -> what its terms have in common."""

SELECTORS = ("Joints", "Bodies", "Sites", "Sensors", "Actuators", "Geoms", "Tendons", "Pairs")
"""Aliases of `rlcli.task` that pick elements of the term's `entity`."""

NAMED = ("Entity", "Command", "Address", "ContactSensor", "RaySensor", "CameraSensor")
"""Aliases of `rlcli.task` that name one thing."""

_TYPES: dict[str, Any] = {
    "float": Number,
    "int": int,
    "bool": bool,
    "str": str,
    "None": None,
    "Range": Range,
    **dict.fromkeys(NAMED, str),
    **dict.fromkeys(SELECTORS, Names),
}
_MDP = Path(__file__).resolve().parent.parent / "mdp"


class SignatureError(ValueError):
    """A term's signature uses something that YAML cannot express."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One keyword-only parameter: its YAML type, its default, and the selector alias it was written with."""

    name: str
    type: Any
    default: Any
    required: bool
    alias: str | None


@dataclass(frozen=True, slots=True)
class Signature:
    """A term as its source declares it."""

    name: str
    attribute: str
    is_class: bool
    file: Path
    line: int
    summary: str
    parameters: tuple[Parameter, ...]
    error: str | None = None
    target: Any = None
    """What to call, where a configuration in Python holds it; None: `attribute` of the file."""
    description: str = ""
    """The first paragraph of its docstring, on one line."""

    @property
    def module(self) -> str:
        """The module of a built-in term."""
        return ".".join(("rlcli", "mdp", *self.file.relative_to(_MDP).with_suffix("").parts))


@dataclass(slots=True)
class Vocabulary:
    """The terms that a task's YAML may name: its own first, then those of `rlcli.mdp` for the section."""

    own: dict[str, Signature] = field(default_factory=dict)

    @classmethod
    def of(cls, files: tuple[Path, ...]) -> Vocabulary:
        """Read the task's own term files; a later file wins."""
        own: dict[str, Signature] = {}
        for file in files:
            own.update(read_terms(file))
        return cls(own)

    def find(self, section: str, name: str) -> Signature | None:
        """The term `name` of a section, or None."""
        return self.own.get(name) or builtin_terms(section).get(name)

    def names(self, section: str) -> list[str]:
        """Every name that may stand in `func` in a section."""
        return sorted({*self.own, *builtin_terms(section)})

    def other_section(self, section: str, name: str) -> str | None:
        """Another section that has a built-in term of this name."""
        return next((other for other in SECTIONS if other != section and name in builtin_terms(other)), None)


@functools.cache
def builtin_terms(section: str) -> dict[str, Signature]:
    """The terms of `rlcli.mdp` for a section of the YAML."""
    modules = ("randomization", "events") if section == "events" else (section,)
    files = [file for module in modules for file in (_MDP / f"{module}.py", *sorted((_MDP / module).glob("*.py")))]
    return {name: term for file in files if file.exists() for name, term in read_terms(file).items()}


def read_terms(file: Path) -> dict[str, Signature]:
    """The terms that a Python file defines, by YAML name.

    Raises:
        SyntaxError: if the file is not Python.
    """
    tree = parse(file)
    trees = {file: tree}
    terms: dict[str, Signature] = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and _takes_env(node.args, 0) and not node.name.startswith("_"):
            terms[node.name] = _signature(node, node, node.name, file)
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            init = constructor(SourceClass(file, node), trees)
            if init is not None and _takes_env(init.args, 1):
                name = snake_case(node.name)
                terms[name] = _signature(node, init, name, file)
    return terms


def signature_of(term: Any, name: str) -> Signature:
    """The signature of a term given as an object: a function or class in `rlcli.mdp`'s form.

    Raises:
        SignatureError: if it is not in that form, or its source cannot be read.
    """
    try:
        file, source = inspect.getsourcefile(term), inspect.getsource(term)
        node = ast.parse(textwrap.dedent(source)).body[0]
    except (OSError, TypeError, SyntaxError, IndexError):
        raise SignatureError("its source cannot be read; define it at the top of a file") from None
    call: ast.stmt | None = node
    if isinstance(node, ast.ClassDef):
        call = constructor(SourceClass(Path(file or "?"), node), {})
    if not isinstance(node, ast.FunctionDef | ast.ClassDef) or not isinstance(call, ast.FunctionDef):
        raise SignatureError("a term is a function (env, *, ...), or a class whose __init__ takes (self, env, *, ...)")
    if not _takes_env(call.args, 1 if isinstance(node, ast.ClassDef) else 0):
        raise SignatureError("its first parameter must be 'env'")
    return replace(_signature(node, call, name, Path(file or "?")), target=term)


def read_params(file: Path, class_name: str) -> type[StrictModel] | None:
    """The `Params` model of a direct task's class, its own or inherited, rebuilt from its source; None without one.

    Raises:
        SyntaxError: if a file is not Python.
        SignatureError: if a field is not one that YAML can express.
    """
    params = nested_lineage(file, class_name, "Params")
    if not params:
        return None
    fields: dict[str, Any] = {}
    for source in reversed(params):  # its own come last and win
        for node in source.node.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                try:
                    fields[node.target.id] = (annotation_type(node.annotation), _field_default(node.value))
                except SignatureError as error:
                    raise SignatureError(f"line {node.lineno}: '{node.target.id}': {error}") from None
    return _model("Params", StrictModel, fields)


def params_model(signature: Signature, section: str) -> type[TermConfig]:
    """The model of a term's YAML entry: the section's own keys and the function's parameters, nothing else.

    Raises:
        SignatureError: if the function cannot be a term of this section.
    """
    if signature.error:
        raise SignatureError(signature.error)
    if taken := [p.name for p in signature.parameters if p.name in (*SECTIONS[section].model_fields, "params")]:
        raise SignatureError(f"parameter '{taken[0]}': every term of {section} has a key of this name already")
    fields: dict[str, Any] = {p.name: (p.type, ... if p.required else p.default) for p in signature.parameters}
    return _model(signature.name, _closed(section), fields)


def snake_case(name: str) -> str:
    """`JointEffort` -> `joint_effort`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def annotation_type(node: ast.expr) -> Any:
    """The YAML type of an annotation.

    Raises:
        SignatureError: for anything but float, int, bool, str, Literal, tuple, list, dict, `X | None` and the aliases.
    """
    if isinstance(node, ast.Constant) and node.value is None:
        return None
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return annotation_type(_quoted(node.value))
    name = last_name(node)
    if name in _TYPES:
        return _TYPES[name]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr):
        return Union[annotation_type(node.left), annotation_type(node.right)]  # noqa: UP007  (built at run time)
    if isinstance(node, ast.Subscript):
        items = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        outer = last_name(node.value)
        if outer == "Literal":
            return Literal[tuple(_literal(item) for item in items)]
        if outer == "list" and len(items) == 1:
            return list[annotation_type(items[0])]  # type: ignore[misc]
        if outer == "dict" and len(items) == 2 and last_name(items[0]) == "str":
            return dict[str, annotation_type(items[1])]  # type: ignore[misc]
        if outer == "tuple":
            if len(items) == 2 and isinstance(items[1], ast.Constant) and items[1].value is ...:
                return tuple[annotation_type(items[0]), ...]  # type: ignore[misc]
            return tuple[tuple(annotation_type(item) for item in items)]  # type: ignore[misc]
    raise SignatureError(
        f"annotation '{ast.unparse(node)}' is not one that YAML can express; use float, int, bool, str, Literal, tuple,"
        f" list, dict[str, X], X | None, Range, {', '.join(NAMED)} or {' / '.join(SELECTORS)}"
    )


def _model(name: str, base: type[StrictModel], fields: dict[str, Any]) -> type[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a parameter may have the name of a pydantic method
        return create_model(name, __base__=base, **fields)


@functools.cache
def _closed(section: str) -> type[TermConfig]:
    base = SECTIONS[section]
    return type(
        base.__name__,
        (base,),
        {"model_config": ConfigDict(extra="forbid", protected_namespaces=()), "__module__": __name__},
    )


def _signature(node: ast.FunctionDef | ast.ClassDef, call: ast.FunctionDef, name: str, file: Path) -> Signature:
    parameters: list[Parameter] = []
    error = _positional_error(call, isinstance(node, ast.ClassDef))
    for argument, default in zip(call.args.kwonlyargs, call.args.kw_defaults, strict=True):
        try:
            parameters.append(_parameter(argument, default))
        except SignatureError as problem:
            error = error or f"parameter '{argument.arg}': {problem}"
    if error is None:
        error = _selector_error(parameters)
    docstring = ast.get_docstring(node) or ast.get_docstring(call) or ""
    return Signature(
        name,
        node.name,
        isinstance(node, ast.ClassDef),
        file,
        call.lineno,
        docstring.split("\n")[0],
        tuple(parameters),
        error,
        description=first_paragraph(docstring),
    )


def first_paragraph(docstring: str) -> str:
    """What a docstring begins with, on one line."""
    return " ".join(re.split(r"\n\s*\n", docstring.strip())[0].split())


def _positional_error(call: ast.FunctionDef, is_class: bool) -> str | None:
    extra = [a.arg for a in call.args.args[2 if is_class else 1 :] if a.arg != "selection"]
    return f"parameter '{extra[0]}' must be keyword-only: put it after a '*'" if extra else None


def _selector_error(parameters: list[Parameter]) -> str | None:
    selectors = [p.name for p in parameters if p.alias in SELECTORS]
    if selectors and not any(p.name == "entity" and p.alias == "Entity" for p in parameters):
        return f"'{selectors[0]}' selects elements of an entity, so the term also needs 'entity: Entity'"
    return None


def _parameter(argument: ast.arg, default: ast.expr | None) -> Parameter:
    if argument.annotation is None:
        raise SignatureError("has no annotation")
    if argument.arg.startswith("_"):
        raise SignatureError("starts with an underscore, which no key of a YAML does")
    return Parameter(
        argument.arg,
        annotation_type(argument.annotation),
        None if default is None else _literal(default),
        default is None,
        _alias(argument.annotation),
    )


def _alias(node: ast.expr) -> str | None:
    """The alias that an annotation is written with, also as `Joints | None` or in quotes."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return _alias(_quoted(node.value))
    if isinstance(node, ast.BinOp):
        return _alias(node.left) or _alias(node.right)
    name = last_name(node)
    return name if name in (*SELECTORS, *NAMED) else None


def _quoted(text: str) -> ast.expr:
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError):
        raise SignatureError(f"annotation '{text}' is not valid Python") from None


def _literal(node: ast.expr) -> Any:
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        raise SignatureError(
            f"'{ast.unparse(node)}' is not a literal, and files are checked without running them"
        ) from None


def _field_default(node: ast.expr | None) -> Any:
    if node is None:
        return ...
    if isinstance(node, ast.Call) and last_name(node.func) == "Field":
        arguments = [_literal(argument) for argument in node.args]
        keywords = {k.arg: _literal(k.value) for k in node.keywords if k.arg}
        return Field(*arguments, **keywords)
    return _literal(node)


def _takes_env(arguments: ast.arguments, position: int) -> bool:
    return len(arguments.args) > position and arguments.args[position].arg == "env"
