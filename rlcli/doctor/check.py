"""The form of a finding."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

STATES = ("ok", "absent", "warning", "broken")
"""absent: an extra that is not installed, which is nothing wrong; warning: something will not work, or not
well; broken: what was installed or asked for does not work."""


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at; `hint` is what mends it."""

    name: str
    state: str
    found: str
    hint: str | None = None
    details: dict[str, Any] = field(default_factory=dict)
