"""Data class `Finding`, a violation found by a check of `rlcli check`, and exception of a check that does not apply."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

from rlcli.errors import error_with_type
from rlcli.machine.memory import memory_error


@dataclass(frozen=True, slots=True)
class Finding:
    """Violation of a requirement that `rlcli check` tests: the check, the place, what was found, and what to do."""

    check: str
    """Name of the check."""
    severity: Literal["error", "warning"]
    """error: `rlcli check` ends with an exit code other than 0; warning: it does not."""
    where: str
    """Part of the task, such as a term or a column."""
    message: str
    """What was found."""
    hint: str
    """What to do."""

    def __str__(self) -> str:
        """Return the finding as one line."""
        return f"{self.severity}: {self.check}: {self.where}: {self.message}; {self.hint}"


error_at = partial(Finding, "", "error")
"""Function (where, message, hint) -> finding of severity error; `rlcli.testing.checks` adds the check's name."""
warning_at = partial(Finding, "", "warning")
"""Function (where, message, hint) -> finding of severity warning; `rlcli.testing.checks` adds the check's name."""


class NotRunError(Exception):
    """Exception of a check that does not apply to this task or this machine; the message is the reason."""


def task_error_text(error: Exception) -> str:
    """Return the type and the message of an error that a task raised in a check, as one line for a finding.

    Raises:
        MachineError: if the error is due to too little memory, which is not a defect of the task.
    """
    if too_little := memory_error(error):
        raise too_little from error
    return " ".join(error_with_type(error).split())
