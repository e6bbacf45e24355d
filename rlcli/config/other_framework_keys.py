"""Support for task files in another framework's format: their additional top-level keys, and translated files.

Such a file may have a key that only the environment class of the format reads, named after the format. In the file the
key is at the top level; in a `TaskConfig` it is below the key `foreign`.
"""

from collections.abc import Callable, Mapping
from typing import Any

from rlcli.config.layers import Layers, Origin
from rlcli.config.schema import TaskConfig
from rlcli.config.strict_yaml import Path
from rlcli.formats import Translation
from rlcli.registry import Entry
from rlcli.registry.formats import format_keys
from rlcli.registry.plugin_imports import wrong_result


def foreign_keys(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the top-level keys of a task file that rlcli's own format does not have, with their values."""
    return {key: value for key, value in data.items() if key not in TaskConfig.model_fields}


def move_foreign_keys(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a task file with the keys of other frameworks' formats moved into `foreign`."""
    unknown = foreign_keys(data).keys()
    keys = format_keys() & unknown if unknown else set()
    if not keys:
        return dict(data)
    own = {key: value for key, value in data.items() if key not in keys}
    return {**own, "foreign": {key: data[key] for key in sorted(keys) if data[key] != {}}}


def merge_translation(layers: Layers, found: Translation, entry: Entry) -> None:
    """Add the translation of another framework's task file to the layers of a configuration.

    Args:
        layers: the configuration so far.
        found: the result of the plugin's function `read`: the translated data, and functions that return the origin
            (file and line) of each value.
        entry: the plugin's entry point, for messages.

    Raises:
        PluginError: if one of these functions returns something else than an `Origin`.
    """

    def checked(origin: Callable[[Path], Origin]) -> Callable[[Path], Origin]:
        def place(path: Path) -> Origin:
            value = origin(path)
            if not isinstance(value, Origin):
                raise wrong_result(entry, "origin of a Translation", value, "an Origin")
            return value

        return place

    layers.merge(found.data, checked(found.origin))
    if found.agents_origin is not None:
        layers.merge(found.agents, checked(found.agents_origin))
