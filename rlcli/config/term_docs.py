"""Documentation of terms for `rlcli terms` and the reference pages: keys with types, defaults, meanings, an example.

The signatures come from the source (`term_signatures`), the meanings of the keys from `rlcli/mdp/term_keys.yaml`.
"""

import contextlib
import functools
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from rlcli.config.docstrings import describe
from rlcli.config.strict_yaml import YamlError, load
from rlcli.config.term_signatures import SECTIONS, SELECTORS, Parameter, Signature, Vocabulary, builtin_terms

_KEYS = Path(__file__).resolve().parent.parent / "mdp" / "term_keys.yaml"
_ELEMENTS = {"Bodies": "body", "Sensors": "MJCF sensor", "Pairs": "contact pair"}
_ALIAS_TYPES = {
    "Entity": "entity name",
    "Command": "command name",
    "Address": "dotted key",
    "ContactSensor": "contact sensor name",
    "RaySensor": "ray sensor name",
    "CameraSensor": "camera name",
    **{alias: f"{_ELEMENTS.get(alias, alias[:-1].lower())} names or patterns" for alias in SELECTORS},
}
_SECTION_KEYS: dict[str, dict[str, Any]] = {
    "rewards": {"weight": 1.0},
    "events": {"mode": "reset"},
    "commands": {"resampling_time_s": [4.0, 8.0]},
}
"""Section of a task file -> the required keys that all its terms share, with the values that examples show."""
_BOUNDS = (("minimum", ">="), ("exclusiveMinimum", ">"), ("maximum", "<="), ("exclusiveMaximum", "<"))


@dataclass(frozen=True, slots=True)
class KeyEntry:
    """Documentation of one YAML key of a term."""

    name: str
    type: str
    required: bool
    default: Any
    description: str


@dataclass(frozen=True, slots=True)
class TermEntry:
    """Documentation of one term, as the reference pages and `rlcli terms` show it."""

    section: str
    name: str
    summary: str
    keys: tuple[KeyEntry, ...]
    own: bool
    """Whether the term belongs to a task, and not to `rlcli.mdp`."""
    signature: Signature

    @property
    def example(self) -> str:
        """One YAML line that uses the term with its required keys."""
        texts = _key_texts()
        examples = texts["examples"]
        values: dict[str, Any] = {"func": self.name, **_SECTION_KEYS.get(self.section, {})}
        if self.section == "rewards" and self.name in texts["penalties"]:
            values["weight"] = -1.0
        for key in self.keys:
            if key.required:
                values[key.name] = examples.get(f"{self.name}.{key.name}", examples.get(key.name, "VALUE"))
        values |= texts["term_examples"].get(self.name, {})
        inner = ", ".join(f"{key}: {yaml_text(value)}" for key, value in values.items())
        return f"{self.section}: {{{self.name}: {{{inner}}}}}"

    def document(self) -> dict[str, Any]:
        """Return the entry as JSON data."""
        keys = [asdict(key) for key in self.keys]
        return {"section": self.section, "name": self.name, "summary": self.summary, "own": self.own,
                "keys": keys, "example": self.example}  # fmt: skip


def term_entries(pattern: str = "", term_files: Iterable[Path] = ()) -> list[TermEntry]:
    """Return the terms whose name, section or summary contains the pattern, in the order of sections and names.

    Args:
        pattern: text to look for, or a pattern with `*`, `?` or `[...]` for the whole name; case is ignored.
        term_files: files with a task's own terms, which are listed too.
    """
    own = Vocabulary.of(tuple(term_files)).own
    entries = [_entry(section, term) for section in SECTIONS for term in builtin_terms(section).values()]
    entries += [_entry("own", term, own=True) for term in own.values()]
    text = pattern.lower()
    if any(sign in text for sign in "*?["):
        return [entry for entry in entries if fnmatchcase(entry.name.lower(), text)]
    return [entry for entry in entries if text in f"{entry.name} {entry.section} {entry.summary}".lower()]


@functools.cache
def section_keys(section: str) -> tuple[KeyEntry, ...]:
    """Return the optional keys that every term of a section has, such as `delay` of observations and actions."""
    model = SECTIONS[section]
    schema = model.model_json_schema()
    describe(schema, model)
    mappings = {name: "{" + ", ".join(part["properties"]) + "}" for name, part in schema.get("$defs", {}).items()}
    found = []
    for name, value in schema["properties"].items():
        if name not in ("func", "params", *schema.get("required", ())):
            type_ = re.sub(r"\w+", lambda word: mappings.get(word[0], word[0]), type_text(value))
            meaning = " ".join(value.get("description", "").split())
            found.append(KeyEntry(name, type_, False, value.get("default"), meaning))
    return tuple(found)


def type_text(schema: Mapping[str, Any]) -> str:
    """Return the type of a JSON Schema as text with its range: `number > 0`, `[number >= 0, number] or null`."""
    if "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[-1]
    for union in ("anyOf", "oneOf", "allOf"):
        if union in schema:
            # a number may also be written as a fraction, `1/120`: the pattern for fractions is not shown
            parts = [part for part in schema[union] if "pattern" not in part or len(schema[union]) == 1]
            return " or ".join(dict.fromkeys(map(type_text, parts)))
    if "enum" in schema or "const" in schema:
        return ", ".join(map(str, schema.get("enum", [schema.get("const")])))
    if schema.get("type") == "array":
        items = schema.get("prefixItems") or schema.get("items")
        if isinstance(items, list):
            return "[" + ", ".join(map(type_text, items)) + "]"
        return f"list of {type_text(items)}" if isinstance(items, dict) else "list"
    if schema.get("type") == "object":
        values = schema.get("additionalProperties")
        return f"mapping to {type_text(values)}" if isinstance(values, dict) and values else "mapping"
    bounds = [f"{sign} {schema[word]}" for word, sign in _BOUNDS if word in schema]
    return " ".join([str(schema.get("type", "any")), " and ".join(bounds)]).strip()


def yaml_text(value: Any) -> str:
    """Return a value as one line of YAML, with quotes only where text needs them."""
    with contextlib.suppress(YamlError):
        if isinstance(value, str) and re.fullmatch(r"\w[\w.-]*", value) and load(f"key: {value}").data["key"] == value:
            return value
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{yaml_text(key)}: {yaml_text(each)}" for key, each in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(yaml_text, value)) + "]"
    return json.dumps(value)


def _entry(section: str, term: Signature, own: bool = False) -> TermEntry:
    keys = tuple(_key_entry(term, parameter) for parameter in term.parameters)
    return TermEntry(section, term.name, term.description or term.summary, keys, own, term)


def _key_entry(term: Signature, parameter: Parameter) -> KeyEntry:
    texts = _key_texts()["keys"]
    description = texts.get(f"{term.name}.{parameter.name}", texts.get(parameter.name, ""))
    type_ = _ALIAS_TYPES.get(parameter.alias or "") or type_text(TypeAdapter(parameter.type).json_schema())
    default = None if parameter.required else parameter.default
    return KeyEntry(parameter.name, type_, parameter.required, default, description)


@functools.cache
def _key_texts() -> dict[str, Any]:
    texts: dict[str, Any] = load(_KEYS.read_bytes()).data
    return texts
