"""A resolved configuration as YAML that reads back as the same configuration."""

from __future__ import annotations

from typing import Any

import yaml

from rlcli.config import strict_yaml
from rlcli.config.load import Resolved
from rlcli.config.schema import TaskConfig
from rlcli.config.strict_yaml import Path
from rlcli.config.terms import SECTIONS, Vocabulary, params_model


class _Dumper(yaml.SafeDumper):
    pass


def _text(dumper: _Dumper, value: str) -> yaml.Node:
    try:
        plain = strict_yaml.load_value(value) == value and "\n" not in value
    except strict_yaml.YamlError:
        plain = False
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=None if plain else '"')


def _number(dumper: _Dumper, value: float) -> yaml.Node:
    text = repr(value)
    if "." not in text and "e" in text:  # YAML 1.1 takes 1e-05 for a string
        text = text.replace("e", ".0e")
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


def _sequence(dumper: _Dumper, value: list[Any]) -> yaml.Node:
    flat = not any(isinstance(item, dict | list) for item in value)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=flat)


_Dumper.add_representer(str, _text)
_Dumper.add_representer(float, _number)
_Dumper.add_representer(list, _sequence)


def to_data(resolved: Resolved) -> dict[str, Any]:
    """The whole configuration as plain data: patches applied, defaults filled in, one agent."""
    data = resolved.task.model_dump(mode="json", exclude={"agents"})
    data["play"] = resolved.layers.data.get("play", {})
    if resolved.agent is not None:
        agent = resolved.agent.model_dump(mode="json", exclude={"task"})
        data["agents"] = {"default": resolved.agent_name, resolved.agent_name: agent}
    if resolved.source.task is None:
        data.pop("params", None)
    return data


def to_yaml(data: dict[str, Any]) -> str:
    """Plain data as YAML that `strict_yaml` reads back unchanged."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=110, allow_unicode=True)


def to_yaml_with_origins(resolved: Resolved) -> str:
    """The configuration as YAML, every value followed by where it comes from."""
    lines: list[str] = []
    _annotate(to_data(resolved), (), resolved, lines)
    return "\n".join(lines) + "\n"


def json_schema(vocabulary: Vocabulary) -> dict[str, Any]:
    """JSON Schema of a task file, for editors: the terms' parameters included."""
    schema = TaskConfig.model_json_schema()
    definitions = schema.setdefault("$defs", {})
    for section in SECTIONS:
        choices = []
        for name in vocabulary.names(section):
            signature = vocabulary.find(section, name)
            if signature is None or signature.error:
                continue
            entry = params_model(signature, section).model_json_schema(ref_template="#/$defs/{model}")
            definitions.update(entry.pop("$defs", {}))
            entry["properties"]["func"] = {"const": name, "description": signature.summary}
            choices.append(entry)
        term = {"anyOf": [*choices, {"type": "null"}]}
        if section == "success":
            schema["properties"][section] = term
        else:
            mapping = {"type": "object", "additionalProperties": term}
            nested = {"type": "object", "additionalProperties": mapping} if section == "observations" else mapping
            schema["properties"][section] = {
                **nested,
                "description": TaskConfig.model_fields[section].description,
            }
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return schema


def _annotate(value: Any, path: Path, resolved: Resolved, lines: list[str]) -> None:
    indent = "  " * len(path)
    for key, item in value.items():
        below = (*path, key)
        name = to_yaml({key: 0}).rpartition(":")[0]
        if isinstance(item, dict) and item:
            lines.append(f"{indent}{name}:")
            _annotate(item, below, resolved, lines)
        else:
            text = yaml.dump({key: item}, Dumper=_Dumper, default_flow_style=True, width=10**6).strip()[1:-1]
            lines.append(f"{indent}{text}".ljust(60) + f"  # {_origin(resolved, below)}")


def _origin(resolved: Resolved, path: Path) -> str:
    origin = resolved.layers.origins.get(path)
    if origin is None:
        return "default"
    return origin.where if origin.layer in ("task", "override", "flag") else f"{origin.layer}: {origin.where}"
