"""Data class `Check`: the result of one check of `rlcli doctor`."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check: its name, its state, what was found, and how to repair it (`hint`)."""

    name: str
    state: str
    """ok: works; absent: an optional extra is not installed, which is not a fault; warning: something will not work, or
    will work badly; broken: something that is installed or configured does not work."""
    found: str
    hint: str | None = None
    details: dict[str, Any] = field(default_factory=dict)
    """Exact values of what was found, such as versions or bytes, as JSON data for `rlcli doctor --json`."""
