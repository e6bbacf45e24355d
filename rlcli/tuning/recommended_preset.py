"""Text of the preset that `rlcli bench` writes: a file for `--config` with the recommended settings.

The comments of the file are the measurements that led to the recommendation.
"""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from rlcli.config.dump import preset_of, put, to_yaml
from rlcli.config.load import Resolved
from rlcli.tuning.bench import Findings, Trained


def bench_preset(
    resolved: Resolved, changes: Mapping[str, Any], findings: Findings, machine: Mapping[str, Any], agent_named: bool
) -> str:
    """Return YAML with the user's changes, the recommended settings, and comments with the measurements.

    Args:
        resolved: the task's configuration with the changes of the command line.
        changes: the recommended settings: dotted key -> value.
        findings: the measurements.
        machine: properties of the machine: `cpu` (its name), `cores` (their number), `versions` (package -> version).
        agent_named: whether the command line names the agent; the preset then makes that agent the default.
    """
    data = preset_of(resolved, agent_named)
    for key, value in changes.items():
        put(data, tuple(key.split(".")), value)
    title = f"{resolved.source.name}, agent {resolved.agent_name}: measured by `rlcli bench`"
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    lines = [
        f"{title} on {datetime.now(UTC).date().isoformat()}",
        f"{machine['cpu']}, {machine['cores']} cores; {versions}",
        *explanation(findings),
    ]
    return "".join(f"# {' '.join(line.split())}\n" for line in lines) + to_yaml(data)


def explanation(findings: Findings) -> list[str]:
    """Return the recommendation and its reason as lines of text, for the terminal and the comments of the preset.

    The list is empty before the benchmark has finished.
    """
    present, best = findings.present, findings.recommended
    if present is None or best is None:
        return []
    if best is present:
        reason = "the present sizes and threads are the fastest of all settings that learn equally per iteration:"
        lines = [f"{reason} {_describe(present)}"]
    else:
        lines = [f"{_describe(best)},", f"instead of {_describe(present)}, measured in alternation"]
    lines.append("all compared settings have the same number of samples and gradient steps per iteration")
    if findings.unsteady:
        lines.append("the measurements vary because the machine is busy: end other programs and measure again")
    return lines


def _describe(row: Trained) -> str:
    """Return a measured row as text: time per iteration, speed, shares of the parts, spread."""
    assert row.seconds is not None
    assert row.steps_per_s is not None
    shares = ", ".join(f"{name} {share:.0%}" for name, share in row.shares.items())
    return (
        f"{1e3 * row.seconds:.3g} ms per iteration of {row.samples:,} samples ({row.steps_per_s:,.0f} steps/s;"
        f" {shares}; spread {row.spread or 0.0:.0%})"
    )
