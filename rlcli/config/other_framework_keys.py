"""Keys of a task file that only the environment class of another framework's format reads.

In the file such a key is at the top level; in a `TaskConfig` it is below the key `foreign`.
"""

from collections.abc import Mapping
from typing import Any

from rlcli.config.schema import TaskConfig
from rlcli.registry.formats import format_keys


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
