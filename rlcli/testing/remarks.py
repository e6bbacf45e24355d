"""Data class `Remark`, the finding of a lint rule, and functions that create remarks."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class Remark:
    """Remark of a lint rule: a property of a task that makes learning hard."""

    rule: str
    """Name of the rule."""
    severity: Literal["error", "warning"]
    """error: `rlcli lint` ends with exit code 9; warning: it does not, except with `--strict`."""
    where: str
    """Part of the task: a term, a column or a setting."""
    message: str
    """What was found."""
    hint: str
    """What to do."""
    numbers: dict[str, float] = field(default_factory=dict)
    """Measured values by name."""

    def __str__(self) -> str:
        """Return the remark as one line."""
        return f"{self.severity}: {self.rule}: {self.where}: {self.message}; {self.hint}"

    def record(self) -> dict[str, Any]:
        """Return the remark as a dictionary for JSON; infinite and NaN numbers become None."""
        numbers = {name: value if math.isfinite(value) else None for name, value in self.numbers.items()}
        return {**asdict(self), "numbers": numbers}


error_at = partial(Remark, "", "error")
"""Function (where, message, hint, numbers) -> remark of severity error; the linter adds the name of the rule."""
warning_at = partial(Remark, "", "warning")
"""Function (where, message, hint, numbers) -> remark of severity warning; the linter adds the name of the rule."""
