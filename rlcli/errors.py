"""The errors that are the user's to mend, each with its exit code. Everything else is a bug and keeps its traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


class RlcliError(Exception):
    """Something a user can mend: `message` says where and what, `hint` what to do."""

    exit_code = 1
    kind = "error"

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint


class UsageError(RlcliError):
    """The command line does not make sense."""

    exit_code = 2
    kind = "usage"


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake in a configuration.

    `where` is `file:line:column` or the text of an override; `path` is the dotted key.
    """

    where: str
    path: str
    message: str
    hint: str | None = None

    def __str__(self) -> str:
        """One line: where, key, what is wrong, what to do."""
        text = f"{self.where}: {self.path}: {self.message}" if self.path else f"{self.where}: {self.message}"
        return f"{text}; {self.hint}" if self.hint else text


class ConfigError(RlcliError):
    """Invalid configuration; carries every problem of its phase."""

    exit_code = 3
    kind = "config"

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = sorted(dict.fromkeys(problems), key=_by_place)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class ShapeError(ConfigError):
    """What a term gives is nothing that its manager can take."""


class TaskError(RlcliError):
    """A task or plugin is not found or broken."""

    exit_code = 4
    kind = "task"


class MissingModelError(TaskError):
    """A model that the user is to have is not there."""


class CheckpointError(RlcliError):
    """A checkpoint or run is missing, corrupt or does not fit."""

    exit_code = 5
    kind = "checkpoint"


class DivergedError(RlcliError):
    """The simulation or the learner produced values that are not finite."""

    exit_code = 6
    kind = "diverged"


class DependencyError(RlcliError):
    """An optional dependency is missing; the hint holds the pip line."""

    exit_code = 7
    kind = "dependency"


class DeviceError(RlcliError):
    """The requested device is not available."""

    exit_code = 8
    kind = "device"


class VerdictError(RlcliError):
    """The command ran and its verdict is negative."""

    exit_code = 9
    kind = "verdict"


class MachineError(RlcliError):
    """The machine said no: disk, port, GL, storage."""

    exit_code = 10
    kind = "machine"


class Stopped(RlcliError):
    """A run stopped because it was asked to; it can be resumed."""

    kind = "stopped"

    def __init__(self, message: str, *, exit_code: int, hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.exit_code = exit_code


def did_you_mean(name: str, candidates: Iterable[str]) -> str | None:
    """`did you mean 'x'?` for the nearest of `candidates`, or None."""
    close = difflib.get_close_matches(name, dict.fromkeys(candidates), n=3, cutoff=0.6)
    return f"did you mean {' or '.join(repr(match) for match in close)}?" if close else None


def one_line(error: BaseException, limit: int | None = None) -> str:
    """Return the message of an error on one line, cut to a length; its class if it has no message."""
    return " ".join(str(error).split())[:limit] or type(error).__name__


def require_known(name: str, names: Sequence[str], what: str, plural: str) -> None:
    """Check that a name on the command line is one of a few.

    Args:
        name: the name that was given.
        names: the valid names.
        what: the kind of name, as in `no {what} '{name}'`.
        plural: several of that kind, for the hint.

    Raises:
        UsageError: with the nearest name, or else all of them.
    """
    if name not in names:
        raise UsageError(f"no {what} '{name}'", hint=did_you_mean(name, names) or f"{plural}: {', '.join(names)}")


def listing(names: Iterable[str], limit: int = 20) -> str:
    """Comma-separated names for a message, cut after `limit`."""
    names = list(names)
    shown = ", ".join(names[:limit])
    return f"{shown}, ... ({len(names)} in all)" if len(names) > limit else shown or "(none)"


def _by_place(problem: Problem) -> tuple[str, tuple[int, ...], str]:
    file, *numbers = problem.where.rsplit(":", 2)
    place = tuple(int(number) for number in numbers if number.isdecimal() and len(number) < 10)
    return (file if len(place) == 2 else problem.where, place, problem.path)
