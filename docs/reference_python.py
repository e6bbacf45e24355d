"""Generator of the reference pages of the Python API, from signatures and Google-style docstrings."""

from __future__ import annotations

import importlib
import inspect
import json
import re
from collections.abc import Iterator
from typing import Any

import griffe

MODULES = {
    "rlcli.task": "Task plugins and type aliases of terms",
    "rlcli.trainers": "Trainer plugins",
    "rlcli.formats": "Plugins that read other task formats",
    "rlcli.errors": "Exceptions",
    "rlcli.gym": "Gymnasium registration",
    "rlcli.random": "Seeds",
    "rlcli.registry": "Find tasks and trainers",
    "rlcli.config.load": "Resolve a configuration",
    "rlcli.config.schema": "Configuration models",
    "rlcli.reporting.task_card": "Task cards",
    "rlcli.envs.environment_protocol": "Interface of environments",
    "rlcli.envs.vec_env": "Vectorised environments",
    "rlcli.envs.make": "Make an environment",
    "rlcli.envs.build": "Build a simulation",
    "rlcli.envs.direct": "Direct tasks",
    "rlcli.envs.articulation": "Articulations of direct tasks",
    "rlcli.envs.step_result": "Step results",
    "rlcli.envs.observers": "Observers of the step",
    "rlcli.scene.entity": "Entities",
    "rlcli.scene.entity_data": "State of entities",
    "rlcli.sim.markers": "Markers in viewers",
    "rlcli.sim.env_selection": "Selections of environments",
    "rlcli.sim.rotations": "Rotations",
    "rlcli.rl.trainer": "Trainers",
    "rlcli.rl.trainer_base": "Base class of trainers",
    "rlcli.rl.budget": "Budget of a training",
    "rlcli.rl.nan_check": "Checks for NaN and infinity",
    "rlcli.rl.policy": "Policies",
    "rlcli.rl.episode_statistics": "Episode statistics",
    "rlcli.rl.optimizers": "Optimisers",
    "rlcli.rl.rng": "Random generators",
    "rlcli.adapters.gymnasium": "Gymnasium environments",
    "rlcli.adapters.sb3": "Stable-Baselines3 environments",
    "rlcli.adapters.rsl_rl": "RSL-RL environments",
    "rlcli.testing": "Contract checks",
}
"""Modules with public names -> titles of their pages."""


def public_names(module_name: str) -> list[str]:
    """Return the public names of a module: its `__all__`, else the classes and functions that it defines."""
    module = importlib.import_module(module_name)
    listed = getattr(module, "__all__", None)
    if listed is not None:
        return sorted(listed)
    return sorted(
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and _defined_in(value, module_name)
        and (inspect.isclass(value) or inspect.isfunction(value))
    )


def _defined_in(value: Any, module_name: str) -> bool:
    """Return whether a module, or a module of this package, defines the value."""
    module = str(getattr(value, "__module__", ""))
    return module == module_name or module.startswith(f"{module_name}.")


def slug(heading: str) -> str:
    """Return the anchor of a heading."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def file_name(module: str) -> str:
    """Return the file name of the page of a module."""
    return f"{module.removeprefix('rlcli.')}.md"


def python_index() -> Iterator[str]:
    """Yield the page that lists all public names."""
    yield "# Python API\n"
    yield "After reading this page you can find every public class and function."
    yield "[Use rlcli from Python](../../guides/python-api.md) shows how they work together. Before version 1.0 a minor"
    yield "version may change a public name; the changelog lists such changes.\n"
    yield (
        "```{toctree}\n:hidden:\n\n"
        + "\n".join(file_name(module).removesuffix(".md") for module in MODULES)
        + "\n```\n"
    )
    yield "| module | contents | names |\n| --- | --- | --- |"
    for module, title in MODULES.items():
        page = file_name(module)
        names = ", ".join(f"[`{name}`]({page}#{slug(name)})" for name in public_names(module))
        yield f"| [`{module}`]({page}) | {title} | {names} |"


def python_page(package: griffe.Object | griffe.Alias, module_name: str) -> Iterator[str]:
    """Yield the page of one module; `package` is griffe's tree of rlcli."""
    module = package[module_name.removeprefix("rlcli.")]
    yield f"# {MODULES[module_name]}\n"
    yield f"Module `{module_name}`.\n"
    yield from docstring_parts(module.docstring)
    members = {name: _resolved(module.all_members[name]) for name in public_names(module_name)}
    for name, member in members.items():
        yield from _member(member, name, "##")
    aliases = _aliases(module)
    if aliases:
        rows = (f"| `{alias.name}` | {cell(one_line(alias.docstring.value))} |" for alias in aliases)
        yield "## Type aliases\n"
        yield "\n".join(["| alias | meaning |", "| --- | --- |", *rows]) + "\n"
    yield from _types(package, [*members.values(), *aliases])


def _aliases(module: Any) -> list[Any]:
    """Return the type aliases of a module that have a docstring."""
    attributes = (member for member in module.members.values() if not member.is_alias and member.is_attribute)
    return [member for member in attributes if str(member.annotation) == "TypeAlias" and member.docstring]


_PARAGRAPH = "\n\n"
"""What separates the first paragraph of a docstring from the others."""


def _resolved(member: Any) -> Any:
    """Return a member of a module, or what an import of it stands for."""
    return member.final_target if member.is_alias else member


def _types(package: griffe.Object | griffe.Alias, members: list[Any]) -> Iterator[str]:
    """Yield what the types of rlcli in signatures of a page are; members of the page itself are left out."""
    public = {
        _resolved(package[module.removeprefix("rlcli.")].all_members[name]).path: f"{file_name(module)}#{slug(name)}"
        for module in MODULES
        for name in public_names(module)
    }
    rows: dict[str, str] = {}
    for path in dict.fromkeys(path for member in members for path in _annotated_types(member)):
        name = path.rpartition(".")[2]
        if not path.startswith("rlcli.") or name.startswith("_"):
            continue
        found = _resolved(package[path.removeprefix("rlcli.")])
        if found in members:
            continue
        text = f"[`{name}`]({public[found.path]})" if found.path in public else f"`{name}` (`{found.module.path}`)"
        if found.docstring:
            rows[name] = f"- {text}: {_escaped(one_line(found.docstring.value.partition(_PARAGRAPH)[0]))}"
        elif found.is_attribute and found.value is not None:
            rows[name] = f"- {text}: `{found.value}`"
    if rows:
        yield "## Types in the signatures\n"
        yield "\n".join(rows[name] for name in sorted(rows)) + "\n"


def _annotated_types(member: Any) -> Iterator[str]:
    """Yield the paths of the types in the annotations of a function, an attribute, or the members of a class."""
    annotations = []
    if member.is_function:
        annotations = [*(parameter.annotation for parameter in member.parameters), member.returns]
    elif member.is_attribute:
        annotations = [member.annotation]
    elif member.is_class:
        for name, inner in member.members.items():
            if not inner.is_alias and (not name.startswith("_") or name == "__init__"):
                yield from _annotated_types(inner)
    for annotation in annotations:
        if isinstance(annotation, griffe.Expr):
            yield from (part.canonical_path for part in annotation if isinstance(part, griffe.ExprName))


def _member(member: Any, name: str, level: str) -> Iterator[str]:
    yield f"{level} {name}\n"
    if member.is_function:
        yield f"```python\n{_signature(member, name)}\n```\n"
        yield from docstring_parts(member.docstring)
    elif member.is_class:
        constructor = member.all_members.get("__init__")
        if constructor is not None and constructor.is_function and not constructor.inherited:
            yield f"```python\n{_signature(constructor, name)}\n```\n"
        yield from docstring_parts(member.docstring)
        exit_code = member.all_members.get("exit_code")
        if exit_code is not None and exit_code.value is not None:
            yield f"[Exit code](../exit-codes.md) of the command line: {_exit_code(member)}.\n"
        yield from _attributes(member)
        for inner_name, inner in member.members.items():
            if not inner_name.startswith("_") and inner.is_function:
                yield from _member(inner, f"{name}.{inner_name}", "###")
    else:
        if member.value is not None:
            yield f"```python\n{name} = {member.value}\n```\n"
        yield from docstring_parts(member.docstring)


def _exit_code(error: Any) -> int:
    value = getattr(importlib.import_module(error.module.path), error.name).exit_code
    return int(value)


def _attributes(member: Any) -> Iterator[str]:
    """Yield the table of the public attributes and properties of a class that have a docstring."""
    rows = [
        f"| `{name}` | {cell(_code(attribute.annotation))} | {cell(one_line(attribute.docstring.value))} |"
        for name, attribute in member.members.items()
        if not name.startswith("_") and attribute.is_attribute and attribute.docstring
    ]
    if rows:
        yield "\n".join(["| attribute | type | meaning |", "| --- | --- | --- |", *rows]) + "\n"


def _signature(function: Any, name: str) -> str:
    """Return the signature of a function, one parameter a line where it is long."""
    parts, keyword_only = [], False
    for parameter in function.parameters:
        if parameter.name in ("self", "cls"):
            continue
        kind = parameter.kind.value
        if kind == "keyword-only" and not keyword_only:
            keyword_only = True
            parts.append("*")
        stars = {"variadic positional": "*", "variadic keyword": "**"}.get(kind, "")
        keyword_only |= stars == "*"
        text = f"{stars}{parameter.name}" + (f": {parameter.annotation}" if parameter.annotation else "")
        parts.append(
            text + (f" = {_default(function, parameter)}" if parameter.default is not None and not stars else "")
        )
    returns = f" -> {function.returns}" if function.returns and function.name != "__init__" else ""
    line = f"{name}({', '.join(parts)}){returns}"
    return line if len(line) <= 100 else f"{name}(\n    " + ",\n    ".join(parts) + f",\n){returns}"


def _default(function: Any, parameter: Any) -> str:
    """Return the default of a parameter as code; for the name of a constant, its value if that is short."""
    text = str(parameter.default)
    if text.isidentifier():
        value = getattr(importlib.import_module(function.module.path), text, None)
        if type(value) in (int, float, str) and len(repr(value)) <= 30:
            return json.dumps(value)
    return text


def docstring_parts(docstring: griffe.Docstring | None) -> Iterator[str]:
    """Yield the sections of a Google-style docstring as Markdown."""
    if docstring is None:
        return
    for section in docstring.parse("google", warnings=False):
        kind = section.kind.value
        if kind == "text":
            yield _escaped(section.value) + "\n"
        elif kind in ("parameters", "attributes"):
            yield (
                "\n".join(f"- `{item.name}`: {_escaped(one_line(item.description))}" for item in section.value) + "\n"
            )
        elif kind == "raises":
            lines = (f"- `{item.annotation}`: {_escaped(one_line(item.description))}" for item in section.value)
            yield "Raises:\n\n" + "\n".join(lines) + "\n"
        elif kind in ("returns", "yields"):
            text = " ".join(_escaped(one_line(item.description)) for item in section.value)
            yield f"{kind.capitalize()}: {text}\n"
        elif kind == "admonition":
            yield f"{section.title}: {_escaped(section.value.description)}\n"
        else:
            yield "\n".join(f"```python\n{text}\n```" for _, text in section.value) + "\n"


def _escaped(text: str) -> str:
    """Return text of a docstring as Markdown: `<` and stars outside of code stay what they are."""
    parts = re.split(r"(```.*?```|`[^`]*`)", text, flags=re.DOTALL)
    parts[::2] = [part.replace("<", "&lt;").replace("*", "\\*").replace("|", "\\|") for part in parts[::2]]
    return "".join(parts)


def _code(value: Any) -> str:
    return f"`{value}`" if value is not None else ""


def one_line(text: str) -> str:
    """Return a text without line breaks."""
    return " ".join(text.split())


def cell(text: str) -> str:
    """Return a text as the cell of a Markdown table."""
    return re.sub(r"(?<!\\)\|", r"\\|", text).replace("<", "&lt;")
