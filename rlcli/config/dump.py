"""Conversion of a resolved configuration to text: YAML, which rlcli reads back unchanged, and JSON Schema.

The YAML can have comments with the origin of each value. `rlcli show` prints these texts.
"""

import re
from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

import yaml
from pydantic import BaseModel

from rlcli.config import messages, strict_yaml
from rlcli.config.layers import Origin, leaves
from rlcli.config.load import Resolved
from rlcli.config.schema import ObservationGroupConfig, TaskConfig
from rlcli.config.strict_yaml import Path
from rlcli.config.term_signatures import SECTIONS, SignatureError, Vocabulary, params_model
from rlcli.errors import UsageError, did_you_mean, listing

_ORIGIN_FILE = re.compile(r"  # (?:\w+: )?(\S*/\S*?):[0-9]+(?::[0-9]+)?$")
"""Comment with the origin of a value, at the end of a line of YAML; group 1 is the file."""
_TAGS = {type(None): "null", bool: "bool", int: "int", float: "float", str: "str"}


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]  # PyYAML has no types
    def resolve(self, kind: type[yaml.Node], value: Any, implicit: tuple[bool, bool]) -> str:
        """Return the YAML type (tag) that rlcli's strict reader gives to a scalar without quotes.

        PyYAML puts a string in quotes if this type is not the string type. Without quotes, the strict reader would
        read a text such as `1e3` as a number.
        """
        if kind is not yaml.ScalarNode or not implicit[0]:
            return str(super().resolve(kind, value, implicit))
        if value == "<<":  # `<<` without quotes would be a merge key
            return "not a plain scalar"
        try:
            return f"tag:yaml.org,2002:{_TAGS[type(strict_yaml.load_value(value))]}"
        except (strict_yaml.YamlError, KeyError):
            return "not a plain scalar"


def _text(dumper: _Dumper, value: str) -> yaml.Node:
    # in double quotes the text stays on one line
    style = '"' if len(value.splitlines()) > 1 or value[-1:].isspace() else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


def _number(dumper: _Dumper, value: float) -> yaml.Node:
    text = repr(value)
    if "." not in text and "e" in text:  # YAML 1.1 reads 1e-05 as a string
        text = text.replace("e", ".0e")
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


def _sequence(dumper: _Dumper, value: list[Any]) -> yaml.Node:
    flat = not any(isinstance(item, dict | list) for item in value)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=flat)


_Dumper.add_representer(str, _text)
_Dumper.add_representer(float, _number)
_Dumper.add_representer(list, _sequence)


def to_data(resolved: Resolved) -> dict[str, Any]:
    """Return the whole configuration as plain data: mappings, lists, texts, numbers, true/false and null.

    All defaults are written out, and all changes are applied. Of the agents, the data has only the chosen one.
    """
    data = resolved.task.model_dump(mode="json", exclude={"agents"})
    data |= data.pop("foreign")
    data["play"] = resolved.layers.data.get("play", {})
    if resolved.agent is not None:
        agent = resolved.agent.model_dump(mode="json", exclude={"task"})
        data["agents"] = {"default": resolved.agent_name, resolved.agent_name: agent}
    if resolved.source.task is None and not data["params"]:
        del data["params"]  # only direct tasks have parameters
    return data


def to_yaml(data: dict[str, Any]) -> str:
    """Return plain data as YAML that `strict_yaml` reads back unchanged."""
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=110, allow_unicode=True))


def select(data: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """Return a configuration with these dotted keys only, such as `sim.dt`; without keys the whole configuration.

    Raises:
        UsageError: for a key that the configuration does not have.
    """
    found: dict[str, Any] = {} if keys else data
    for key in keys:
        value, target, steps = data, found, key.split(".")
        for number, step in enumerate(steps):
            if not isinstance(value, dict) or step not in value:
                known = listing(value, 40) if isinstance(value, dict) else None
                where = f" in {'.'.join(steps[:number])}" if number else ""
                hint = did_you_mean(step, value if known else ()) or (f"keys{where}: {known}" if known else None)
                raise UsageError(f"the configuration has no key '{key}'", hint=hint)
            value = value[step]
            if number < len(steps) - 1:
                target = target.setdefault(step, {})
        target[steps[-1]] = value
    return found


def to_yaml_with_origins(resolved: Resolved, data: dict[str, Any] | None = None) -> str:
    """Return a configuration as YAML. A comment names the origin of each value: the file and line that set it.

    The comments have short names of files; the first lines of the YAML list the full paths.

    Args:
        resolved: the configuration.
        data: the part of the configuration to write, as `select` returns it; None: the whole configuration.
    """
    lines: list[str] = []
    _annotate(to_data(resolved) if data is None else data, (), resolved, lines)
    files = {PurePath(match[1]) for line in lines if (match := _ORIGIN_FILE.search(line))}
    depth = 1
    while len({file.parts[-depth:] for file in files}) < len(files):
        depth += 1
    short = {str(file): "/".join(file.parts[-depth:]) for file in sorted(files)}
    for file, name in short.items():
        lines = [line.replace(f"{file}:", f"{name}:") for line in lines]
    return "\n".join([*(f"# {name}: {file}" for file, name in short.items()), *lines]) + "\n"


def origins(resolved: Resolved, data: dict[str, Any] | None = None) -> dict[str, str]:
    """Return the origin of each value, by dotted key: file and line, an override, a flag, or `default`.

    Args:
        resolved: the configuration.
        data: the part of the configuration to look at, as `select` returns it; None: the whole configuration.
    """
    return {
        messages.dotted(path): _origin(resolved, path)
        for path, _ in leaves(to_data(resolved) if data is None else data)
    }


def explicit_values(resolved: Resolved) -> dict[str, str]:
    """Return the origins, by dotted key, of only those values that the command line or a `--config` file sets."""
    return {messages.dotted(path): _location(origin) for path, origin in _explicit_origins(resolved)}


def preset_of(resolved: Resolved, names_agent: bool) -> dict[str, Any]:
    """Return the values that the command line or a `--config` file sets, in the form of a `--config` file.

    Args:
        resolved: the configuration.
        names_agent: whether the preset also sets `agents.default` to the chosen agent.
    """
    preset: dict[str, Any] = {}
    agent = ("agents", resolved.agent_name)
    for path, _ in _explicit_origins(resolved):
        inner, value = _until_list(resolved.layers.data, path)
        if isinstance(value, dict) and value:
            continue  # an agent's entries have their own paths
        put(preset, ("agent", *inner[2:]) if inner[:2] == agent else inner, value)
    if names_agent:
        put(preset, ("agents", "default"), resolved.agent_name)
    return preset


def put(data: dict[str, Any], path: tuple[Any, ...], value: object) -> None:
    """Set a value in nested mappings; create missing mappings."""
    for key in path[:-1]:
        inner = data.get(key)
        if not isinstance(inner, dict):
            inner = data[key] = {}
        data = inner
    data[path[-1]] = value


def json_schema(vocabulary: Vocabulary, params: type[BaseModel] | None = None) -> dict[str, Any]:
    """Return the JSON Schema of a task file, for editors.

    Args:
        vocabulary: the terms that the file may name; their parameters are part of the schema.
        params: the model of a direct task's parameters; None: the schema does not describe parameters.
    """
    schema = TaskConfig.model_json_schema()
    definitions = schema.setdefault("$defs", {})

    def model_schema(model: type[BaseModel]) -> dict[str, Any]:
        """Return the schema of a model, and move its definitions to the definitions of the whole schema."""
        part = model.model_json_schema()
        definitions.update(part.pop("$defs", {}))
        return part

    for section in SECTIONS:
        choices = []
        for name in vocabulary.names(section):
            signature = vocabulary.find(section, name)
            assert signature is not None
            try:
                entry = model_schema(params_model(signature, section))
            except SignatureError:
                continue  # the term cannot be used in this section
            entry["properties"]["func"] = {"const": name, "description": signature.summary}
            choices.append(entry)
        term: dict[str, Any] = {"anyOf": [*choices, {"type": "null"}]}
        if section == "observations":
            settings = model_schema(ObservationGroupConfig)["properties"]
            term = {"type": "object", "properties": settings, "additionalProperties": term}
        term = {"type": "object", "additionalProperties": term}
        schema["properties"][section] = {**term, "description": schema["properties"][section]["description"]}
    if params is not None:
        schema["properties"]["params"] = model_schema(params)
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return schema


def _annotate(value: Any, path: Path, resolved: Resolved, lines: list[str]) -> None:
    """Append the YAML of the mapping at a path to `lines`, with the origin of each value as a comment."""
    indent = "  " * len(path)
    for key, item in value.items():
        below = (*path, key)
        if isinstance(item, dict) and item:
            lines.append(f"{indent}{_inline(key)}:")
            _annotate(item, below, resolved, lines)
        else:
            text = f"{indent}{_inline(key)}: {_inline(item)}"
            lines.append(f"{text.ljust(60)}  # {_origin(resolved, below)}")


def _inline(value: object) -> str:
    """Return a value as YAML on one line, for example a list as `[1, 2]`."""
    text: str = yaml.dump((value,), Dumper=_Dumper, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.strip()[1:-1]


def _origin(resolved: Resolved, path: Path) -> str:
    """Return the origin of the value at a path as text, such as `task.yaml:3:5`, or `default`.

    For a list, the origins of single items that overrides changed are added.
    """
    known = resolved.layers.origins
    if path not in known:
        return "default"
    items = (o for p, o in known.items() if len(p) > len(path) and p[: len(path)] == path and o.layer == "override")
    return ", ".join(dict.fromkeys(_location(origin) for origin in (known[path], *items)))


def _location(origin: Origin) -> str:
    where = " ".join(origin.where.split())
    return where if origin.layer in ("task", "override", "flag") else f"{origin.layer}: {where}"


def _explicit_origins(resolved: Resolved) -> list[tuple[Path, Origin]]:
    """Return path and origin of every value set on the command line or in a `--config` file."""
    found = resolved.layers.origins.items()
    return [(path, origin) for path, origin in found if path and origin.layer in ("config", "override", "flag")]


def _until_list(data: object, path: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
    """Cut off a path after the first key whose value is a list; return the short path and the list.

    An override can change one item of a list, but a `--config` file can only replace the whole list.
    """
    for depth, step in enumerate(path):
        if not isinstance(data, dict):
            return path[:depth], data
        data = data.get(step)
    return path, data
