"""Exception classes for errors that the user can fix, and functions for the text of error messages.

The command line ends with the exit code of the exception's class. Any other exception is a bug and keeps its traceback.
"""

import difflib
import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rlcli.safe_text import message_line, shorten

INTERRUPTED, STOPPED = 130, 75
"""Exit codes after Ctrl-C (`INTERRUPTED`), and after another signal that stops a run (`STOPPED`)."""
_UNPINNED = ("rlcli[trackio]",)
"""Extras that `pip_install` installs without `constraints.txt`, because of a conflict: trackio needs pillow < 13."""


class RlcliError(Exception):
    """An error that the user can fix.

    Args:
        message: what is wrong and where: one line, or a list of lines.
        hint: what the user can do; None: no hint.
    """

    exit_code = 1
    kind = "error"

    def __init__(self, message: str | Sequence[str], *, hint: str | None = None) -> None:
        self.message = "\n".join(map(message_line, [message] if isinstance(message, str) else message))
        self.hint = hint and message_line(hint)
        super().__init__(self.message)


class UsageError(RlcliError):
    """Error for an invalid command line or an invalid argument of a function. Exit code 2."""

    exit_code = 2
    kind = "usage"


@dataclass(frozen=True, slots=True)
class Problem:
    """Mistake in a configuration."""

    where: str
    """Place of the mistake: `file:line:column`, or the text of an override."""
    path: str
    """Dotted key of the wrong value; empty for a mistake in the file as a whole."""
    message: str
    """What is wrong, and what is allowed."""
    hint: str | None = None
    """What the user can do about the mistake."""

    def __post_init__(self) -> None:
        """Convert each field to one line of limited length."""
        for name in self.__slots__:
            value = getattr(self, name)
            object.__setattr__(self, name, value and message_line(value))

    def __str__(self) -> str:
        """Return the mistake on one line: place, key, what is wrong, what to do."""
        text = f"{self.where}: {self.path}: {self.message}" if self.path else f"{self.where}: {self.message}"
        return f"{text}; {self.hint}" if self.hint else text


class ConfigError(RlcliError):
    """Error for an invalid configuration; `problems` has every mistake that was found. Exit code 3."""

    exit_code = 3
    kind = "config"

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = sorted(dict.fromkeys(problems), key=_position)
        super().__init__([str(problem) for problem in self.problems])


class ShapeError(ConfigError):
    """Error for a term (a reward, an observation, ...) whose result has a wrong shape or type. Exit code 3."""


class TaskError(RlcliError):
    """Error for a missing or broken task or plugin. Exit code 4."""

    exit_code = 4
    kind = "task"


class MissingModelError(TaskError):
    """Error for a missing robot model that the user must provide. Exit code 4."""


class CheckpointError(RlcliError):
    """Error for a checkpoint or run that is missing, corrupt or does not fit the task. Exit code 5."""

    exit_code = 5
    kind = "checkpoint"


class DivergedError(RlcliError):
    """Error for NaN or infinite values in the simulation or in the policy update. Exit code 6."""

    exit_code = 6
    kind = "diverged"


class DependencyError(RlcliError):
    """Error for a missing optional dependency; the hint is the pip command that installs it. Exit code 7."""

    exit_code = 7
    kind = "dependency"


class DeviceError(RlcliError):
    """Error for a requested device that is not available. Exit code 8."""

    exit_code = 8
    kind = "device"


class VerdictError(RlcliError):
    """Negative result of a command that ran to its end: a check failed, or a limit was not met. Exit code 9."""

    exit_code = 9
    kind = "verdict"


class MachineError(RlcliError):
    """Error for an operation that the machine refused, such as writing to a full disk. Exit code 10."""

    exit_code = 10
    kind = "machine"


class Stopped(RlcliError):
    """Stop of a run by a signal; the run can be resumed. Exit code 130 for Ctrl-C, 75 for other signals."""

    kind = "stopped"

    def __init__(self, message: str, *, exit_code: int, hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.exit_code = exit_code


def did_you_mean(name: str, candidates: Iterable[str]) -> str | None:
    """Return `did you mean 'x'?` with the (at most three) candidates that are similar to a name; None if none is."""
    known = dict.fromkeys(itertools.islice(candidates, 1000))
    close = difflib.get_close_matches(name[:200], known, n=3, cutoff=0.6)
    return f"did you mean {' or '.join(repr(match) for match in close)}?" if close else None


def pip_install(package: str) -> str:
    """Return the `pip install` command that installs packages in the tested versions, for a hint.

    rlcli and the plugins of its repository are not on a package index. If rlcli runs from a checkout, the command
    installs them from the checkout's folders; else from a folder with their wheels, for which the command has the
    placeholder WHEELS.

    Args:
        package: names of packages, or of an extra such as `rlcli[plot]`, separated by spaces.
    """
    root = Path(__file__).parents[1]
    # the place of the file in a wheel, and in a checkout
    lists = (Path(__file__).with_name("constraints.txt"), root / "constraints.txt")
    pins = [str(file) for file in lists if file.is_file() and package not in _UNPINNED]
    words = ["-c", pins[0]] if pins else []
    for word in package.split():
        source = root if word == "rlcli" else root / "plugins" / word
        if (source / "pyproject.toml").is_file():
            words += ["-e", str(source)]
        else:
            words += [*(["--find-links", "WHEELS"] if re.fullmatch(r"rlcli(-[\w-]+)?", word) else []), word]
    return " ".join(["pip install", *(f'"{word}"' if set(word) & set(" []<>=*") else word for word in words)])


def install_hint(packages: str) -> str:
    """Return the hint that installs missing packages; for torch it also names the index of the build for the CPU.

    Args:
        packages: as in `pip_install`.
    """
    index = "; on Linux without a GPU, add --index-url https://download.pytorch.org/whl/cpu"
    return pip_install(packages) + (index if packages == "torch" else "")


_MAX_ERROR_TEXT = 20_000
"""Largest part of an error's message that is used [characters]; longer text would take too long to split and escape."""


def error_text(error: BaseException) -> str:
    """Return the message of an error, cut to `_MAX_ERROR_TEXT` characters.

    If the error's `__str__` itself raises an exception, return a text that states this.
    """
    try:
        return str(error)[:_MAX_ERROR_TEXT]
    except BaseException as failed:
        return f"the error's message cannot be read: __str__ raises {type(failed).__name__}"


def error_with_type(error: BaseException) -> str:
    """Return the message of an error; if the error is not a `RlcliError`, the name of its class is in front."""
    if isinstance(error, RlcliError):
        return error.message
    return ": ".join(filter(None, (type(error).__name__, error_text(error))))


def short_error(error: BaseException) -> str:
    """Return `error_with_type` of an error from the code of a task or plugin, on one line of at most 200 characters."""
    return shorten(" ".join(error_with_type(error).split()), 200)


def one_line(error: BaseException, limit: int | None = None) -> str:
    """Return the message of an error on one line, cut to `limit` characters; the name of its class if it has none."""
    text = " ".join(error_text(error).split())
    if "set_int_max_str_digits" in text:  # Python's advice does not help users of rlcli
        text = "a number has more than 4300 digits"
    return text[:limit] or type(error).__name__


def require_known(name: str, names: Sequence[str], what: str, plural: str) -> None:
    """Check that a name on the command line is valid.

    Args:
        name: the name that the user typed.
        names: the valid names.
        what: noun for the message, which describes the name, such as `policy`.
        plural: the plural of `what`, for the hint.

    Raises:
        UsageError: with the most similar valid name, or with all valid names if none is similar.
    """
    if name not in names:
        raise UsageError(f"no {what} '{name}'", hint=did_you_mean(name, names) or f"{plural}: {', '.join(names)}")


def listing(names: Iterable[str], limit: int = 20) -> str:
    """Return names as text for a message, separated by commas and cut after `limit` names; without names, `(none)`."""
    names = list(names)
    shown = ", ".join(names[:limit])
    return f"{shown}, ... ({len(names)} in all)" if len(names) > limit else shown or "(none)"


def _position(problem: Problem) -> tuple[str, tuple[int, ...], str]:
    """Return the sort key of a problem: its file (or override), its line and column as numbers, its dotted key."""
    file, *numbers = problem.where.rsplit(":", 2)
    place = tuple(int(number) for number in numbers if number.isdecimal() and len(number) < 10)
    return (file if len(place) == 2 else problem.where, place, problem.path)
