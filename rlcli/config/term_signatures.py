"""Signatures of terms, read from source text with `ast`, so that files are checked without importing untrusted code.

A term is a public function whose first parameter is `env`, or a class whose `__init__` takes `(self, env, *, ...)`. The
YAML name of a class is its name in snake_case. The keyword-only parameters are the YAML keys of the term. A class may
inherit its `__init__` from a base in the same file, in another file of the task or in `rlcli.mdp`, or get it from
`@dataclass`.
"""

import ast
import functools
import inspect
import re
import textwrap
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self, Union

from pydantic import ConfigDict, Field, create_model

from rlcli.config import schema
from rlcli.config.class_search import ClassSearch, SourceClass, constructor, last_name, parse
from rlcli.config.strict_yaml import Path as KeyPath

SECTIONS: dict[str, type[schema.TermConfig]] = {
    "actions": schema.ActionConfig,
    "commands": schema.CommandConfig,
    "observations": schema.ObservationConfig,
    "events": schema.EventConfig,
    "rewards": schema.RewardConfig,
    "terminations": schema.TerminationConfig,
    "curriculum": schema.CurriculumConfig,
    "success": schema.SuccessConfig,
}
"""Section of a task file, such as rewards -> pydantic model of the keys that all its terms share."""

SELECTORS = ("Joints", "Bodies", "Sites", "Sensors", "Actuators", "Geoms", "Tendons", "Pairs")
"""Names in `rlcli.task` for annotations of parameters whose value selects elements of the term's `entity` by name."""

NAMED = ("Entity", "Command", "Address", "ContactSensor", "RaySensor", "CameraSensor")
"""Names in `rlcli.task` for annotations of parameters whose value is the name of one object."""

_TYPES: dict[str, Any] = {
    "float": schema.Number,
    "int": int,
    "bool": bool,
    "str": str,
    "None": None,
    "Range": schema.Range,
    **dict.fromkeys(NAMED, str),
    **dict.fromkeys(SELECTORS, schema.Names),
}
_MDP = Path(__file__).resolve().parent.parent / "mdp"


class SignatureError(ValueError):
    """Error for a function that cannot be a term, because a YAML file could not set its parameters."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A keyword-only parameter of a term, which is a key of the term in YAML.

    `alias` is the name from `rlcli.task` in its annotation, such as `Joints`; None if there is no such name.
    """

    name: str
    type: Any
    default: Any
    required: bool
    alias: str | None


@dataclass(frozen=True, slots=True)
class Signature:
    """Name, parameters and location of a term, as read from its source file.

    A term is a function or class that a task file names with `func`, for example a reward.
    """

    name: str
    """Name in YAML."""
    attribute: str
    """Name of the function or class in the file."""
    is_class: bool
    file: Path
    line: int
    summary: str
    """First line of the docstring."""
    parameters: tuple[Parameter, ...]
    error: str | None = None
    """Reason why the function cannot be used as a term; None if there is no obstacle."""
    target: Any = None
    """The function or class itself, if it comes from a configuration in Python; None: `attribute` of the file."""
    description: str = ""
    """The first paragraph of the docstring, on one line."""

    @property
    def module(self) -> str:
        """The module name of a built-in term."""
        return ".".join(("rlcli", "mdp", *self.file.relative_to(_MDP).with_suffix("").parts))


@dataclass(slots=True)
class Vocabulary:
    """The terms that the YAML of a task may name: first the task's own terms (`own`), then the terms of `rlcli.mdp`.

    A section is a key of the task that has terms, such as `rewards`. A task's own term fits every section.
    """

    own: dict[str, Signature] = field(default_factory=dict)

    @classmethod
    def of(cls, files: tuple[Path, ...]) -> Self:
        """Read the task's own term files. If two files define a term, the later file wins."""
        own: dict[str, Signature] = {}
        for file in files:
            own.update(read_terms(file))
        return cls(own)

    def find(self, section: str, name: str) -> Signature | None:
        """Return the signature of the term `name` in a section; None if there is no such term."""
        return self.own.get(name) or builtin_terms(section).get(name)

    def names(self, section: str) -> list[str]:
        """Return every name that `func` may have in a section."""
        return sorted({*self.own, *builtin_terms(section)})

    def other_section(self, section: str, name: str) -> str | None:
        """Return another section with a built-in term of this name, for a hint; None if there is no such section."""
        return next((other for other in SECTIONS if other != section and name in builtin_terms(other)), None)


@functools.cache
def builtin_terms(section: str) -> dict[str, Signature]:
    """Return the terms of `rlcli.mdp` for a section of the YAML, by name."""
    modules = ("randomization", "events") if section == "events" else (section,)
    files = [file for module in modules for file in (_MDP / f"{module}.py", *sorted((_MDP / module).glob("*.py")))]
    return {name: term for file in files if file.exists() for name, term in read_terms(file).items()}


def read_terms(file: Path) -> dict[str, Signature]:
    """Return the terms that a Python file defines, by YAML name.

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
            init = constructor(SourceClass(file, node), ClassSearch(trees))
            if init is not None and _takes_env(init.args, 1):
                name = snake_case(node.name)
                terms[name] = _signature(node, init, name, file)
    return terms


def signature_of(term: Any, name: str) -> Signature:
    """Return the signature of a function or class in memory as a term with this name.

    Raises:
        SignatureError: if the object does not have the form of a term, or its source cannot be read.
    """
    try:
        file, source = inspect.getsourcefile(term), inspect.getsource(term)
        node = ast.parse(textwrap.dedent(source)).body[0]
    except (OSError, TypeError, SyntaxError, IndexError):
        raise SignatureError(
            "the source code of a term cannot be read; define the term in a .py file, at module level"
        ) from None
    call: ast.stmt | None = node
    if is_class := isinstance(node, ast.ClassDef):
        call = constructor(SourceClass(Path(file or "?"), node), ClassSearch())
    if not isinstance(node, ast.FunctionDef | ast.ClassDef) or not isinstance(call, ast.FunctionDef):
        found = "a class without __init__" if is_class else f"an object of type {type(term).__name__}"
        allowed = "a function (env, *, ...), or a class whose __init__ takes (self, env, *, ...)"
        raise SignatureError(f"found {found}; a term is {allowed}")
    if not _takes_env(call.args, 1 if is_class else 0):
        found = ", ".join(argument.arg for argument in call.args.args) or "no parameters"
        first, allowed = ("of __init__ after 'self'", "self, env") if is_class else ("of a term", "env")
        raise SignatureError(f"the first parameter {first} must be 'env', found ({found}); write ({allowed}, *, ...)")
    return replace(_signature(node, call, name, Path(file or "?")), target=term)


def read_params(file: Path, class_name: str) -> type[schema.StrictModel] | None:
    """Return a pydantic model with the fields of a direct task's class `Params`, read from source code.

    `Params` is inside of the task's class or of one of its base classes; if there is no `Params`, return None.

    Raises:
        SyntaxError: if a file is not Python.
        SignatureError: if YAML cannot express the type of a field.
    """
    params = ClassSearch().nested_lineage(file, class_name, "Params")
    if not params:
        return None
    fields: dict[str, Any] = {}
    for source in reversed(params):  # the own fields come last and override those of the bases
        for node in source.node.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                try:
                    fields[node.target.id] = (annotation_type(node.annotation), _field_default(node.value))
                except SignatureError as error:
                    raise SignatureError(f"line {node.lineno}: '{node.target.id}': {error}") from None
    return _model("Params", schema.StrictModel, fields)


def params_model(signature: Signature, section: str) -> type[schema.TermConfig]:
    """Return the pydantic model of a term's YAML entry: the keys of its section, and the parameters of its function.

    Raises:
        SignatureError: if the function cannot be a term of this section.
    """
    if builtin_terms(section).get(signature.name) is signature:
        return _builtin_params_model(signature.name, section)
    return _params_model(signature, section)


@functools.cache
def _builtin_params_model(name: str, section: str) -> type[schema.TermConfig]:
    """Return the pydantic model of a built-in term's keys; it is cached, because building one takes milliseconds."""
    return _params_model(builtin_terms(section)[name], section)


def _params_model(signature: Signature, section: str) -> type[schema.TermConfig]:
    if signature.error:
        raise SignatureError(signature.error)
    reserved = (*SECTIONS[section].model_fields, "params")
    if taken := [p.name for p in signature.parameters if p.name in reserved]:
        raise SignatureError(
            f"the parameter '{taken[0]}' must be renamed: every term of {section} has a key of this name"
        )
    fields: dict[str, Any] = {p.name: (p.type, ... if p.required else p.default) for p in signature.parameters}
    return _model(signature.name, _closed(section), fields)


def snake_case(name: str) -> str:
    """Convert a class name to snake case: `JointEffort` -> `joint_effort`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def annotation_type(node: ast.expr) -> Any:
    """Return the YAML type of an annotation.

    Raises:
        SignatureError: for types other than float, int, bool, str, Literal, tuple, list, dict, `X | None` and the
            aliases of `rlcli.task`.
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
        f"YAML cannot express the annotation '{ast.unparse(node)}'; use float, int, bool, str, Literal, tuple,"
        f" list, dict[str, X] or X | None, or an annotation of rlcli.task: Range, {', '.join((*NAMED, *SELECTORS))}"
    )


def _model(name: str, base: type[schema.StrictModel], fields: dict[str, Any]) -> type[Any]:
    with warnings.catch_warnings(action="ignore"):  # a parameter may have the name of a pydantic method
        return create_model(name, __base__=base, **fields)


@functools.cache
def _closed(section: str) -> type[schema.TermConfig]:
    """Return a pydantic model with the keys that all terms of a section share; it refuses unknown keys.

    The models of single terms are subclasses, which add the parameters of the terms' functions.
    """
    base = SECTIONS[section]
    config = ConfigDict(extra="forbid", protected_namespaces=())  # a parameter may start with `model_`
    return type(base.__name__, (base,), {"model_config": config, "__module__": __name__})


def _signature(node: ast.FunctionDef | ast.ClassDef, call: ast.FunctionDef, name: str, file: Path) -> Signature:
    """Return the signature of a term.

    Args:
        node: the function or class.
        call: the function, or the `__init__` of the class.
        name: name of the term in YAML.
        file: file of the term.
    """
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
    """Return the first paragraph of a docstring on one line."""
    return " ".join(re.split(r"\n\s*\n", docstring.strip())[0].split())


def _positional_error(call: ast.FunctionDef, is_class: bool) -> str | None:
    extra = [a.arg for a in call.args.args[2 if is_class else 1 :] if a.arg != "selection"]
    return f"the parameter '{extra[0]}' must be keyword-only: put it after a '*'" if extra else None


def _selector_error(parameters: list[Parameter]) -> str | None:
    selectors = [p.name for p in parameters if p.alias in SELECTORS]
    if selectors and not any(p.name == "entity" and p.alias == "Entity" for p in parameters):
        return f"the parameter '{selectors[0]}' selects elements of an entity; add a parameter 'entity: Entity'"
    return None


def _parameter(argument: ast.arg, default: ast.expr | None) -> Parameter:
    if argument.annotation is None:
        raise SignatureError("every parameter needs an annotation; write one, as in `scale: float`")
    if argument.arg.startswith("_"):
        raise SignatureError(
            "the name of a parameter is a key in YAML, so it must not start with an underscore; rename the parameter"
        )
    return Parameter(
        argument.arg,
        annotation_type(argument.annotation),
        None if default is None else _literal(default),
        default is None,
        _alias(argument.annotation),
    )


def _alias(node: ast.expr) -> str | None:
    """Return the name from `rlcli.task` in an annotation, such as `Joints` in `Joints | None`; else None."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return _alias(_quoted(node.value))
    if isinstance(node, ast.BinOp):
        return _alias(node.left) or _alias(node.right)
    name = last_name(node)
    return name if name in (*SELECTORS, *NAMED) else None


def _quoted(text: str) -> ast.expr:
    """Parse an annotation that is written in quotes."""
    try:
        return ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError):
        raise SignatureError(f"annotation '{text}' is not valid Python; write a type, as in 'float'") from None


def _literal(node: ast.expr) -> Any:
    """Return the value of a literal in source text."""
    try:
        return ast.literal_eval(node)
    except (ValueError, TypeError):
        message = f"the default '{ast.unparse(node)}' is not a literal; write a number, text, list or mapping"
        raise SignatureError(message) from None


def _field_default(node: ast.expr | None) -> Any:
    """Return the default of a field of `Params` as pydantic's `create_model` takes it: `...` for a required field."""
    if node is None:
        return ...
    if isinstance(node, ast.Call) and last_name(node.func) == "Field":
        arguments = [_literal(argument) for argument in node.args]
        keywords = {k.arg: _literal(k.value) for k in node.keywords if k.arg}
        return Field(*arguments, **keywords)
    return _literal(node)


def _takes_env(arguments: ast.arguments, position: int) -> bool:
    return len(arguments.args) > position and arguments.args[position].arg == "env"


def term_entries(data: dict[str, Any]) -> list[tuple[str, KeyPath, dict[str, Any]]]:
    """Return every term of a configuration that is not validated yet, as (section, path of the term, its mapping)."""
    found: list[tuple[str, KeyPath, dict[str, Any]]] = []
    for section in SECTIONS:
        content = data.get(section)
        if not isinstance(content, dict):
            continue
        if section == "observations":
            for group, terms in content.items():
                found += [
                    (section, (section, group, n), t)
                    for n, t in (terms.items() if isinstance(terms, dict) else ())
                    if isinstance(t, dict)
                ]
        else:
            found += [(section, (section, n), t) for n, t in content.items() if isinstance(t, dict)]
    return found


def with_terms(
    task: schema.TaskConfig, terms: Mapping[KeyPath, schema.TermConfig | None], params: dict[str, Any] | None
) -> schema.TaskConfig:
    """Return a copy of a task with its validated terms and parameters.

    Args:
        task: the validated task, which has None instead of its terms.
        terms: path of a term, such as `("rewards", "alive")` -> the validated term; None removes the term.
        params: validated parameters of a direct task; None: the task keeps its own.
    """
    update: dict[str, Any] = {} if params is None else {"params": params}
    for section in SECTIONS:
        if section == "observations":
            update[section] = {
                name: group.model_copy(update=_kept_terms(terms, (section, name), group.terms), deep=False)
                for name, group in task.observations.items()
            }
        else:
            update[section] = _kept_terms(terms, (section,), getattr(task, section))
    return task.model_copy(update=update)


def _kept_terms(
    terms: Mapping[KeyPath, schema.TermConfig | None], at: KeyPath, names: Iterable[str]
) -> dict[str, schema.TermConfig]:
    found = {name: terms.get((*at, name)) for name in names}
    return {name: term for name, term in found.items() if term is not None}
