"""Move top-level keys of a task file that belong to another framework's format into its key `foreign`."""

from collections.abc import Mapping
from typing import Any

from rlcli.config.schema import TaskConfig
from rlcli.registry.formats import format_keys


def move_foreign_keys(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a task file with the keys of other frameworks' formats moved into `foreign`."""
    unknown = data.keys() - TaskConfig.model_fields.keys()
    keys = format_keys() & unknown if unknown else set()
    if not keys:
        return dict(data)
    own = {key: value for key, value in data.items() if key not in keys}
    return {**own, "foreign": {key: data[key] for key in sorted(keys) if data[key] != {}}}
