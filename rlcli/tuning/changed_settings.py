"""Presets: the settings of a training that differ from its task's own, in the form of a `--config` file."""

from typing import Any

from rlcli.config.load import Resolved

_LAYERS = ("config", "override", "flag")


def preset_of(resolved: Resolved, names_agent: bool) -> dict[str, Any]:
    """Return the values of a configuration that come from the command line and its `--config` file.

    Args:
        resolved: the configuration.
        names_agent: whether the preset makes the chosen agent the default.
    """
    preset: dict[str, Any] = {}
    agent = ("agents", resolved.agent_name)
    for path, origin in resolved.layers.origins.items():
        if not path or origin.layer not in _LAYERS:
            continue
        inner, value = _until_list(resolved.layers.data, path)
        if isinstance(value, dict) and value:
            continue  # its entries have their own paths
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


def _until_list(data: object, path: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
    """Return the path up to the first list, and the value there, because a file can only replace a whole list."""
    for depth, step in enumerate(path):
        if not isinstance(data, dict):
            return path[:depth], data
        data = data.get(step)
    return path, data
