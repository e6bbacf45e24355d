"""What a bench recommends, as a file for `--config` that says where its numbers are from."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from rlcli.config.dump import to_yaml
from rlcli.config.load import Resolved
from rlcli.rl.bench import Findings, Trained

_GIVEN = ("config", "override", "flag")


def preset(
    resolved: Resolved, changes: Mapping[str, Any], findings: Findings, machine: Mapping[str, Any], agent_named: bool
) -> str:
    """YAML: what the user changed, what is recommended, and comments with what was measured.

    Args:
        resolved: the configuration as it was asked for.
        changes: what is recommended: dotted key -> value.
        findings: the measurements.
        machine: what they were made on.
        agent_named: whether the agent is to be the default, because it was asked for.
    """
    data = _given(resolved)
    if agent_named:
        data.setdefault("agents", {})["default"] = resolved.agent_name
    for key, value in changes.items():
        _put(data, tuple(key.split(".")), value)
    title = f"{resolved.source.name}, agent {resolved.agent_name}: measured by `rlcli bench`"
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    lines = [
        f"{title} on {datetime.now(UTC).date().isoformat()}",
        f"{machine['cpu']}, {machine['cores']} cores; {versions}",
        *explanation(findings),
    ]
    return "".join(f"# {' '.join(line.split())}\n" for line in lines) + to_yaml(data)


def explanation(findings: Findings) -> list[str]:
    """What is recommended and why, in sentences."""
    present, best = findings.present, findings.recommended
    if present is None or best is None:
        return []
    if best is present:
        said = "nothing that learns alike is faster than the present sizes and threads:"
        lines = [f"{said} {_told(present)}"]
    else:
        lines = [f"{_told(best)},", f"instead of {_told(present)}, measured in turn"]
    lines.append("compared at as many samples and gradient steps an iteration, so that it learns alike")
    if findings.unsteady:
        lines.append("the machine was busy: the figures are not steady")
    return lines


def _told(row: Trained) -> str:
    assert row.seconds is not None
    assert row.steps_per_s is not None
    shares = ", ".join(f"{name} {share:.0%}" for name, share in row.shares.items())
    return (
        f"{1e3 * row.seconds:.3g} ms an iteration of {row.samples:,} samples ({row.steps_per_s:,.0f} steps/s;"
        f" {shares}; spread {row.spread or 0.0:.0%})"
    )


def _given(resolved: Resolved) -> dict[str, Any]:
    """What stands on the command line and in its `--config` file, as such a file would hold it."""
    found: dict[str, Any] = {}
    chosen = ("agents", resolved.agent_name)
    for path, origin in resolved.layers.origins.items():
        if not path or origin.layer not in _GIVEN:
            continue
        inner, value = _until_list(resolved.layers.data, path)
        if isinstance(value, dict) and value:
            continue  # what is in it has paths of its own
        _put(found, ("agent", *inner[2:]) if inner[:2] == chosen else inner, value)
    return found


def _until_list(data: Any, path: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
    """A path as far as mappings go, and what stands there: a file cannot change a member of a list."""
    for depth, step in enumerate(path):
        if not isinstance(data, dict):
            return path[:depth], data
        data = data.get(step)
    return path, data


def _put(data: dict[str, Any], path: tuple[Any, ...], value: Any) -> None:
    for key in path[:-1]:
        inner = data.get(key)
        if not isinstance(inner, dict):
            inner = data[key] = {}
        data = inner
    data[path[-1]] = value
