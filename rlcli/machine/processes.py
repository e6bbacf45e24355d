"""Helpers for processes: command of a Python subprocess, numbers set by launchers such as torchrun, OpenMP setting."""

import os
import sys

from rlcli.errors import UsageError
from rlcli.safe_text import read_number


def python_command(*arguments: str) -> list[str]:
    """Return the command that starts this Python with arguments, and with `-P`: no imports from the current folder."""
    return [sys.executable, "-P", *arguments]


def launcher_number(name: str, default: int, least: int = 0) -> int:
    """Return the number in an environment variable that a launcher such as torchrun sets; `default` if it is not set.

    Raises:
        UsageError: if the variable is not a whole number, or is below `least`.
    """
    text = os.environ.get(name) or str(default)
    number = read_number(text)
    if not isinstance(number, int) or number < least:
        message = f"the environment variable {name} is '{text}', not a whole number >= {least}"
        raise UsageError(message, hint=f"unset {name}; only launchers such as torchrun set it")
    return number


def limit_openmp_spinning() -> None:
    """Let OpenMP threads spin only briefly while they wait, unless the user set GOMP_SPINCOUNT.

    Call this function before torch is imported. On a busy machine libgomp's long spinning makes the update of a policy
    ten times slower.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
