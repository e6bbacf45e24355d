"""Reader of the YAML that Isaac Lab writes and reads, with the limits of rlcli's own YAML.

In contrast to rlcli's own YAML, these files may have anchors and tags of Python objects: PyYAML writes tuples and
slices with tags, and uses an anchor for a value that several settings share. The reader constructs no Python objects.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import yaml
from yaml import MarkedYAMLError

from rlcli.config import strict_yaml
from rlcli.config.strict_yaml import MAX_BYTES, MAX_DEPTH, MAX_ITEMS, YamlError
from rlcli.errors import ConfigError, Problem
from rlcli.machine.plain_files import read_plain

_PYTHON = "tag:yaml.org,2002:python/"
_TAGS = [f"tag:yaml.org,2002:{kind}" for kind in ("bool", "float", "int", "null", "str")]
_MERGE = "tag:yaml.org,2002:merge"


def read(file: Path) -> dict[str, Any]:
    """Read a YAML file of Isaac Lab, whose top level is a mapping.

    Python's tuples and slices are read as such. Functions and classes become text, `module:name`; other Python objects
    become None.

    Raises:
        ConfigError: if the file cannot be read or is not such YAML, with line and column.
    """
    try:
        data = parse(read_plain(file, MAX_BYTES))  # refuses pipes, which would block
    except OSError as error:
        message = f"cannot be read: {error.strerror or error}; check the path"
        raise ConfigError([Problem(str(file), "", message)]) from None
    except YamlError as error:
        position = f"{file}:{error.line}:{error.column}" if error.line else str(file)
        raise ConfigError([Problem(position, "", error.message)]) from None
    if not isinstance(data, dict):
        raise ConfigError([Problem(str(file), "", "the top level must be a mapping (key: value)")])
    return data


def parse(content: bytes) -> Any:
    """Return the value of a YAML document.

    Raises:
        YamlError: with the position of the first mistake.
    """
    text = strict_yaml.decode(content)
    with strict_yaml.syntax_errors(text):
        loader = _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()


class _Loader(strict_yaml.Loader):
    """PyYAML's safe loader with limits, and with constructors for the tags of Python objects."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._items = self._depth = 0
        self._deepest = 0
        """Depth [levels] of the deepest value since the beginning of the value that is read now."""
        self._extents: dict[str, tuple[int, int]] = {}
        """Anchor of a complete value -> its number of values, and its height in levels."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Read a value. Values that aliases repeat count each time, so that a small file cannot become huge."""
        event = self.peek_event()
        anchor, mark = event.anchor, event.start_mark
        if isinstance(event, yaml.AliasEvent):
            items, height = self._extents.get(anchor, (0, 0))
            if anchor in self.anchors and not height:
                raise _error(f"the anchor '{anchor}' contains the alias *{anchor}; replace the alias by a value", mark)
            self._require(self._items + items, self._depth + height, mark)
            return super().compose_node(parent, index)
        first, before = self._items, self._deepest
        self._depth += 1
        self._deepest = 0
        self._require(self._items + 1, self._depth, mark)
        self._check(event)
        node = super().compose_node(parent, index)
        if anchor is not None:
            self._extents[anchor] = (self._items - first, self._deepest - self._depth + 1)
        self._deepest = max(self._deepest, before)
        self._depth -= 1
        return node

    def _require(self, items: int, depth: int, mark: Any) -> None:
        self._items, self._deepest = items, max(self._deepest, depth)
        if items > MAX_ITEMS:
            raise _error(f"the file has more than {MAX_ITEMS} items; make it smaller", mark)
        if depth > MAX_DEPTH + 1:  # the deepest allowed value is inside MAX_DEPTH lists
            raise _error(f"values are nested deeper than {MAX_DEPTH} levels; use fewer levels", mark)

    def _check(self, event: Any) -> None:
        if isinstance(event, yaml.ScalarEvent):
            strict_yaml.check_scalar(event)
        elif not isinstance(event, yaml.CollectionStartEvent):
            return
        if event.tag not in (None, "!", *_TAGS) and not event.tag.startswith(_PYTHON):
            message = f"only tags of scalars and of Python objects are allowed; remove {event.tag[:60]}"
            raise _error(message, event.start_mark)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the value of a node of the YAML; a scalar that Python cannot hold is an error with its position."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError, TypeError) as error:
            kind = node.tag.rpartition(":")[2]
            shown = f"'{node.value[:60]}'" if isinstance(node, yaml.ScalarNode) else "this value"
            message = f"{shown} is not a valid {kind}; correct it, or quote a text"
            raise _error(message, node.start_mark) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Return a mapping; its keys are text as it is written in the file."""
        found: dict[Hashable, Any] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _error("a key must be text, not a list or mapping; write `name: value`", key.start_mark)
            if key.tag == _MERGE:
                raise _error("merge keys (<<) are not allowed; copy the keys and values", key.start_mark)
            if key.value in found:
                raise _error(f"duplicate key '{key.value}'; remove one", key.start_mark)
            found[key.value] = self.construct_object(value, deep)
        return found


def _error(message: str, mark: Any) -> MarkedYAMLError:
    return MarkedYAMLError(problem=message, problem_mark=mark)


def _sequence(kind: Callable[..., Any]) -> Callable[[_Loader, yaml.Node], Any]:
    def construct(loader: _Loader, node: yaml.Node) -> Any:
        if not isinstance(node, yaml.SequenceNode):
            raise _error("the tag needs a list; correct it", node.start_mark)
        return kind(loader.construct_sequence(node, deep=True))

    return construct


def _opaque(_loader: _Loader, suffix: str, _node: yaml.Node) -> Any:
    """Return `module:name` for YAML's tag of a Python function or class; return None for the tag of another object."""
    kind, _, name = suffix.partition(":")
    return ":".join(name.rsplit(".", 1)) if kind == "name" else None


_Loader.add_constructor("tag:yaml.org,2002:timestamp", _Loader.construct_yaml_str)
_Loader.add_constructor(f"{_PYTHON}tuple", _sequence(tuple))
_Loader.add_constructor(f"{_PYTHON}object/apply:builtins.slice", _sequence(lambda items: slice(*items)))
_Loader.add_multi_constructor(_PYTHON, _opaque)
