"""Evaluation of Hydra's interpolations in YAML: `${..seed}`, `${resolve_default:512,${...num_envs}}`.

The module supports the syntax that OmniIsaacGymEnvs uses: relative and absolute references, and four resolvers
(functions such as `resolve_default`). Hydra itself is not used: its current release cannot be installed beside the
current omegaconf, its errors have no line numbers, and its resolvers may read environment variables and import code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from rlcli.config import strict_yaml
from rlcli.config.strict_yaml import Path
from rlcli.errors import did_you_mean, listing

RESOLVERS: Mapping[str, tuple[int, Callable[..., Any]]] = {
    "eq": (2, lambda left, right: str(left).lower() == str(right).lower()),
    "contains": (2, lambda part, whole: str(part).lower() in str(whole).lower()),
    "if": (3, lambda condition, yes, no: yes if condition else no),
    "resolve_default": (2, lambda default, value: default if value in ("", None) else value),
}
"""Name of a resolver, as in `${NAME:...}` -> number of its arguments, and its function."""


class InterpolationError(ValueError):
    """An interpolation that cannot be evaluated; `path` is the key that contains it."""

    def __init__(self, path: Path, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.hint = hint


def evaluate(tree: Mapping[str, Any], at: Path = ()) -> tuple[Any, list[InterpolationError]]:
    """Evaluate all interpolations in a part of a YAML's data.

    Args:
        tree: the whole data, to which interpolations may refer.
        at: path of the part; empty: the whole data.

    Returns:
        The part with evaluated values (None for one that cannot be evaluated), and the errors.
    """
    evaluator = _Evaluator(tree)
    return evaluator.evaluate(at, evaluator.look_up(at)), evaluator.errors


@dataclass(slots=True)
class _Evaluator:
    tree: Mapping[str, Any]
    errors: list[InterpolationError] = field(default_factory=list)
    active: list[Path] = field(default_factory=list)

    def evaluate(self, path: Path, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: self.evaluate((*path, key), item) for key, item in value.items()}
        if isinstance(value, list):
            return [self.evaluate((*path, index), item) for index, item in enumerate(value)]
        if not isinstance(value, str) or "${" not in value:
            return value
        try:
            return self._text(path, value)
        except InterpolationError as error:
            if all(error.path != known.path or str(error) != str(known) for known in self.errors):
                self.errors.append(error)
            return None

    def look_up(self, path: Path) -> Any:
        value: Any = self.tree
        for step in path:
            if isinstance(value, list) and str(step).isdecimal() and int(step) < len(value):
                value = value[int(step)]
            elif isinstance(value, dict) and step in value:
                value = value[step]
            else:
                raise KeyError(step)
        return value

    def _text(self, path: Path, text: str) -> Any:
        """Evaluate the interpolations in a text. If the text is a single interpolation, its value keeps its type."""
        parts: list[Any] = []
        position = 0
        while position < len(text):
            start = text.find("${", position)
            if start < 0:
                parts.append(text[position:])
                break
            if start > position:
                parts.append(text[position:start])
            end = _closing(path, text, start + 2)
            parts.append(self._interpolation(path, text[start + 2 : end]))
            position = end + 1
        return parts[0] if len(parts) == 1 else "".join(str(part) for part in parts)

    def _interpolation(self, path: Path, inner: str) -> Any:
        head, colon, rest = inner.partition(":")
        if colon and "${" not in head:
            return self._resolver(path, head.strip(), rest)
        return self._reference(path, str(self._text(path, inner)).strip())

    def _resolver(self, path: Path, name: str, rest: str) -> Any:
        if name not in RESOLVERS:
            near = did_you_mean(name, RESOLVERS) or f"resolvers: {listing(RESOLVERS)}"
            raise InterpolationError(path, f"unknown resolver '{name}'", near)
        count, function = RESOLVERS[name]
        arguments = [self._argument(path, text.strip()) for text in _split(rest)]
        if len(arguments) != count:
            raise InterpolationError(path, f"resolver '{name}' expects {count} arguments, found {len(arguments)}")
        return function(*arguments)

    def _argument(self, path: Path, text: str) -> Any:
        if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
            return text[1:-1]
        value = self._text(path, text) if "${" in text else text
        if value is not text or not text:
            return value
        try:
            return strict_yaml.load_value(text)
        except strict_yaml.YamlError:
            return text

    def _reference(self, path: Path, text: str) -> Any:
        dots = len(text) - len(text.lstrip("."))
        if dots > len(path):
            raise InterpolationError(
                path, f"'${{{text}}}' points above the top level of the configuration: remove leading dots"
            )
        base = path[: len(path) - dots] if dots else ()
        target: Path = (*base, *(step for step in text[dots:].split(".") if step))
        if target in self.active:
            raise InterpolationError(path, f"'${{{text}}}' refers to itself; write the value")
        try:
            found = self.look_up(target)
        except KeyError as missing:
            step = missing.args[0]
            at = target.index(step)
            known = self.look_up(target[:at])
            names = list(known) if isinstance(known, dict) else []
            where = ".".join(str(part) for part in target[:at]) or "the configuration"
            near = did_you_mean(str(step), names) or f"keys: {listing(names)}"
            raise InterpolationError(path, f"'${{{text}}}': {where} has no '{step}'", near) from None
        self.active.append(target)
        try:
            if isinstance(found, str) and "${" in found:
                return self._text(target, found)
            return self.evaluate(target, found)
        finally:
            self.active.pop()


def _closing(path: Path, text: str, start: int) -> int:
    """Return the position of the brace that closes an interpolation.

    Args:
        path: key of the text, for the error.
        text: the text.
        start: position after the opening `${`.

    Raises:
        InterpolationError: if no brace closes it.
    """
    depth = 1
    for position in range(start, len(text)):
        if text.startswith("${", position) or (text[position] == "{" and text[position - 1] != "$"):
            depth += 1
        elif text[position] == "}":
            depth -= 1
            if not depth:
                return position
    raise InterpolationError(path, f"'{text}' is not closed", "add the closing }")


def _split(text: str) -> list[str]:
    """Split the arguments of a resolver at commas outside of brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter in "{[(":
            depth += 1
        elif letter in "}])":
            depth -= 1
        if letter == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts
