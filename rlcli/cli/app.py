"""Main function of the command `rlcli`: build the typer app, run a command and return the exit code.

Exceptions of a command, of a task's code or of a library become error messages with a hint and an exit code.
"""

from __future__ import annotations

import errno
import functools
import importlib
import os
import re
import signal
import sys
import traceback
from types import FrameType
from typing import TYPE_CHECKING, Any

import typer
from typer._click.exceptions import ClickException, NoArgsIsHelpError
from typer._click.exceptions import UsageError as ClickUsageError

from rlcli.cli.import_hooks import AddressSpaceCheck, MatplotlibFinder
from rlcli.cli.ui.console import console, print_log_records, redirect_to_null
from rlcli.cli.ui.help_text import HelpGroup
from rlcli.cli.ui.options import CHOOSE, TYPER_ERRORS, BodyError, add_command
from rlcli.config.user_settings import read_settings
from rlcli.errors import (
    INTERRUPTED,
    CheckpointError,
    ConfigError,
    MachineError,
    RlcliError,
    Stopped,
    TaskError,
    UsageError,
)
from rlcli.machine.garbage_collection import delay_garbage_collection
from rlcli.machine.memory import memory_error
from rlcli.machine.stop_signals import end_on_signals, raise_on_signals, stopped_by_signal
from rlcli.registry import OWN, TRAINERS, catalog, load_entry, load_object, malformed_metadata_ignored
from rlcli.registry.changed_modules import ModuleCopies, change_of_module
from rlcli.registry.task_code_monitor import (
    error_of_task,
    exit_refused,
    observe_task_code,
    place_in_task,
    raised_by_task,
    report_lasting_threads,
)
from rlcli.safe_text import remember_given
from rlcli.settings import settings_file, use_settings
from rlcli.trainers import TrainerSpec

if TYPE_CHECKING:
    from pydantic import BaseModel

PANELS = {
    "Tasks": ("list-tasks", "terms", "show", "new", "validate", "check", "lint"),
    "Train": ("bench", "train", "watch", "sweep", "import"),
    "Play": ("play", "replay", "autopsy"),
    "Evaluate": ("eval", "stress", "plot", "report"),
    "Deploy": ("export",),
    "Project": ("runs", "diff", "reproduce", "doctor"),
}
"""Panel of `--help` -> its commands, in the order in which they are usually used."""
GROUPS = {"import": "import_"}
"""Name of a command with subcommands -> the module of `rlcli.cli.commands` that defines them in its `app`."""
COMMANDS = tuple(name for names in PANELS.values() for name in names if name not in GROUPS)
"""Commands without subcommands. Each has its own module in `rlcli.cli.commands`, with a function `command`."""

_HELP_FLAGS = frozenset(("-h", "--help", "--version", "--install-completion", "--show-completion"))
_COMPLETION_VARIABLE = "_RLCLI_COMPLETE"
"""Environment variable that a shell sets to complete a command line."""
_SETTINGS = {
    "help_option_names": ["-h", "--help"],
    "token_normalize_func": lambda name: name.replace("_", "-"),
}
_EXAMPLES = """\
rlcli train cartpole
    Train the built-in task cartpole; the run goes to runs/cartpole/.
rlcli play cartpole
    Show the policy of its newest run in a window or the browser."""


def _root(
    version: bool = typer.Option(False, "--version", help="Print the version and exit.", is_eager=True),
) -> None:
    if version:
        import rlcli

        console.data(f"rlcli {rlcli.__version__}")
        raise typer.Exit


@functools.cache
def build(only: str | None = None) -> typer.Typer:
    """Return the typer app with all commands. With `only`, import just the module of this command: this is faster."""
    app = typer.Typer(
        cls=HelpGroup,
        context_settings=_SETTINGS,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help="Train, play, evaluate and export robot-control policies in MuJoCo.",
        epilog=_EXAMPLES,
    )
    app.callback(invoke_without_command=True)(_root)
    for panel, names in PANELS.items():
        for name in names:
            if only not in (None, name):
                continue
            module = importlib.import_module(f"rlcli.cli.commands.{GROUPS.get(name) or name.replace('-', '_')}")
            if name in GROUPS:
                app.add_typer(module.app, name=name, rich_help_panel=panel)
            else:
                add_command(app, name, module.command, rich_help_panel=panel)
    return app


def main(arguments: list[str] | None = None) -> int:
    """Run one command of rlcli and return its exit code.

    Args:
        arguments: the words after `rlcli`; None: those of this process (`sys.argv`). With None, the function also sets
            signal handlers and import hooks, because the process then runs only this command.
    """
    print_log_records()
    console.owns_process = arguments is None
    try:
        if console.owns_process:
            _set_up_process()
        code = _main(sys.argv[1:] if arguments is None else arguments)
        end_on_signals()
    except KeyboardInterrupt:  # before or after the command
        failure = stopped_by_signal()
        if failure is None:
            raise
        console.error(failure)
        code = failure.exit_code
        end_on_signals()
    return code


def _set_up_process() -> None:
    """Set signal handlers and import hooks of a process that runs only this command."""
    # the library GLFW in MuJoCo starts a Python process, which otherwise imports from this folder
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    raise_on_signals()
    delay_garbage_collection()
    if hasattr(signal, "SIGALRM"):
        signal.signal(signal.SIGALRM, _on_alarm)
    sys.meta_path[:0] = [AddressSpaceCheck, MatplotlibFinder]


def _main(arguments: list[str]) -> int:
    if not {"COMP_WORDS", "_TYPER_COMPLETE_ARGS"}.intersection(os.environ) and "complete_" in os.environ.get(
        _COMPLETION_VARIABLE, ""
    ):
        del os.environ[_COMPLETION_VARIABLE]  # a shell completion set it earlier; nothing is completed now
    remember_given([*arguments, *(value for name, value in os.environ.items() if name.startswith("RLCLI_"))])
    console.json, console.debug = "--json" in arguments, "--debug" in arguments
    console.has_document = False  # an earlier command of this process may have printed one
    with console.stdout_kept(), malformed_metadata_ignored(), exit_refused(), observe_task_code():
        code = _run(_with_values(arguments))
    _flush_output()
    if console.owns_process:
        report_lasting_threads()
    return code


def _flush_output() -> None:
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        redirect_to_null(sys.stdout)


def _on_alarm(_: int, frame: FrameType | None) -> None:
    """Raise an error when a timer that a task's code has set expires.

    Without this handler the timer's signal, SIGALRM, would end the process without a message.
    """
    place = place_in_task(frame)
    message = "a timer has expired, and the task's code has set no handler for its signal SIGALRM"
    raise TaskError(f"{place}: {message}" if place else message, hint="remove signal.alarm or signal.setitimer")


def _with_values(arguments: list[str]) -> list[str]:
    """Insert the value `auto` (CHOOSE) after a `--video` without FILE: the parser needs a value for this option."""
    filled = []
    for position, word in enumerate(arguments):
        filled.append(word)
        following = arguments[position + 1] if position + 1 < len(arguments) else ""
        if word == "--video" and (not following or following.startswith("-") or "=" in following):
            filled.append(CHOOSE)
    return filled


def _command_name(arguments: list[str]) -> str | None:
    """Return the name of the command on the command line; None if there is no such command."""
    word = next((word for word in arguments if not word.startswith("-")), "").replace("_", "-")
    return word if word in COMMANDS or word in GROUPS else None


def _require_words(arguments: list[str]) -> None:
    """Check that all arguments of the command line are UTF-8, and that none is empty (`--record ""`, `--record=`).

    The values of environment variables `RLCLI_*` are checked too, because some of them are values of options.

    Raises:
        UsageError: with the wrong argument, and the option or variable that it belongs to.
    """
    for position, word in enumerate(arguments):
        if not word or (word.startswith("--") and word.endswith("=")):
            name = word or (arguments[position - 1] if position else "rlcli")
            message = f"there is an empty word after {name.rstrip('=')}"
            raise UsageError(message, hint="write a value there, or leave out the empty word")
    words = dict.fromkeys(arguments, "a word of the command line") | {
        value: name for name, value in os.environ.items() if name.startswith("RLCLI_")
    }
    for word, place in words.items():
        # surrogates stand for bytes that are not UTF-8
        if any("\ud800" <= character <= "\udfff" for character in word):
            raise UsageError(
                f"{place} is not UTF-8: '{word}'", hint="write the word in UTF-8, or rename the file or folder"
            )


def _run(arguments: list[str]) -> int:
    copies = ModuleCopies()
    broken: TaskError | None = None
    try:
        _require_words(arguments)
        _require_folder_and_output()
        with use_settings(_user_settings(arguments)):
            try:
                result = build(_command_name(arguments))(arguments, prog_name="rlcli", standalone_mode=False)
            finally:
                broken = copies.restore()
        if result == INTERRUPTED:  # typer turns Ctrl-C into this exit code
            raise KeyboardInterrupt
        return result if isinstance(result, int) else 0
    except NoArgsIsHelpError as error:
        if not console.json:
            for line in error.message.split("\n"):
                console.info(line)
            return 2
        failure: RlcliError = UsageError("no command given", hint="rlcli --help lists the commands")
    except BaseException as raised:  # the code of a task may raise any exception
        cause = raised.error if isinstance(raised, BodyError) else raised
        # a library that is being imported may replace KeyboardInterrupt by an error of its own
        signal_error = None if isinstance(cause, Stopped) else stopped_by_signal()
        failure = signal_error or _as_rlcli_error(cause, arguments)
        if failure.kind == "bug" or (isinstance(cause, ImportError) and copies.lost_modules):
            is_exit = isinstance(cause, SystemExit)
            by_module = None if is_exit else change_of_module(cause) or copies.error_of_lost_modules(cause)
            failure = broken or by_module or failure
        if failure.kind == "bug" and isinstance(cause, SystemExit):
            # the exception is not from a task or plugin: typer itself ends completions and closed pipes in this way
            raise
        is_expected = isinstance(cause, ClickException | KeyboardInterrupt | typer.Abort) or failure.kind == "stopped"
        if failure.kind == "bug" or (console.debug and not is_expected):
            traceback.print_exc()
    console.error(failure)
    return failure.exit_code


def _require_folder_and_output() -> None:
    """Check that the current folder exists and that stdout is open. Otherwise libraries fail with obscure errors.

    Raises:
        MachineError: if the folder was deleted, or the parent process closed stdout.
    """
    try:
        os.getcwd()
    except OSError as error:
        message = f"the current folder cannot be used: {error.strerror}"
        hint = "the folder may have been deleted; change to another folder with `cd`"
        raise MachineError(message, hint=hint) from None
    if sys.stdout is None:
        raise MachineError("the standard output is closed", hint="redirect stdout to a file or to /dev/null")


def _as_rlcli_error(error: BaseException, arguments: list[str]) -> RlcliError:
    """Convert an exception to the error that is printed; an exception that is not expected is a bug in rlcli.

    Args:
        error: any exception of a command, a task's code or a library.
        arguments: the words of the command line; the hint about an unknown option repeats its value.
    """
    # a corrupt checkpoint may claim any size: its error names the file, which helps more than "too little memory"
    if not isinstance(error, CheckpointError) and (too_little := memory_error(error)):
        return too_little
    if isinstance(error, RlcliError):
        return error
    if isinstance(error, TYPER_ERRORS) and raised_by_task(error) and (of_task := error_of_task(error)):
        return of_task
    if isinstance(error, ClickException):
        failure = UsageError(_usage_message(error), hint=_usage_hint(error, arguments))
        failure.exit_code = error.exit_code
        return failure
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        return Stopped("interrupted", exit_code=INTERRUPTED)
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        return UsageError(f"'{error.filename}' is too long: a name in a path has at most 255 bytes", hint="shorten it")
    if isinstance(error, OSError):
        file = f"{error.filename}: " if error.filename else ""
        return MachineError(f"{file}{error.strerror or str(error) or type(error).__name__}")

    from rlcli.cli.ui.missing_dependency import missing_dependency
    from rlcli.sim.gl import opengl_import_error

    known = opengl_import_error(error) or missing_dependency(error) or error_of_task(error)
    if known is not None:
        return known
    bug = RlcliError(
        f"this is a bug in rlcli: {type(error).__name__}: {error}", hint="please report the bug with the lines above"
    )
    bug.kind = "bug"
    return bug


def _user_settings(arguments: list[str]) -> dict[str, Any]:
    """Return the values of the user's settings file, and set the verbosity of the console.

    If the file is broken, help, shell completion and `rlcli doctor` go on without settings; other commands fail.
    """
    try:
        settings = read_settings()
    except ConfigError:
        needs_no_settings = arguments[:1] in ([], ["doctor"]) or _HELP_FLAGS.intersection(arguments)
        if not needs_no_settings and _COMPLETION_VARIABLE not in os.environ:
            raise
        settings = {}
    verbosity = settings.get("verbosity")
    console.quiet = verbosity == "quiet"  # -q or -v on the command line may change it later
    console.verbose = verbosity == "verbose" or not {"-v", "--verbose"}.isdisjoint(arguments)
    if settings:
        console.detail(f"settings: {settings_file()}")
    return settings


def _usage_message(error: ClickException) -> str:
    """Return the message of a wrong command line.

    A wrong value, which pydantic rejects, gets the wording that a wrong value in a task file gets.
    """
    cause, message = error.__cause__, error.format_message()
    if cause is None or not hasattr(cause, "errors"):  # only pydantic's ValidationError has the attribute `errors`
        return message
    from rlcli.config.messages import expected_and_found

    return f"{message.partition(': ')[0]}: {expected_and_found(cause.errors(include_url=False))}"


def _usage_hint(error: ClickException, arguments: list[str]) -> str | None:
    """Return the hint for a wrong command line: how to write the option, or where the help is."""
    if not isinstance(error, ClickUsageError):
        return None
    match = re.match(r"No such option: --([A-Za-z_][\w.-]*)", error.format_message())
    if match and (hint := _hint_for_option(match[1], arguments)):
        return hint
    return "rlcli --help" if error.ctx is None else f"{error.ctx.command_path} --help"


def _hint_for_option(name: str, arguments: list[str]) -> str | None:
    """Return what to write instead of the unknown option `--NAME`: `KEY=VALUE` or an option of rlcli; else None."""
    keys = _matching_settings(name)
    if not keys:
        return _FOREIGN_OPTIONS.get(name)
    spellings = (f"--{name}", f"--{name.replace('-', '_')}")
    word = next((word for word in arguments if word.startswith(spellings)), "")
    value = word.partition("=")[2]
    if not value and word in arguments[:-1]:
        value = arguments[arguments.index(word) + 1]
    value = value or "VALUE"
    return f"overrides have no dashes: {' or '.join(f'{key}={value}' for key in keys)}"


def _matching_settings(option: str) -> list[str]:
    """Return the configuration keys that an unknown option may mean: keys that equal the option's name or end with it.

    The list is empty if more than three keys end with the name.
    """
    name = option.replace("-", "_")
    if "." in name.strip("."):
        return [name]
    from rlcli.config.messages import key_locations
    from rlcli.config.schema import TaskConfig

    key = _SHORT_FOR.get(name, name)
    models: list[dict[str, Any]] = [{"": TaskConfig}, *({"agent": model} for model in _agent_models())]
    keys = list(dict.fromkeys(found for model in models for found in key_locations(model).get(key, [])))
    return keys if len(keys) <= 3 and name != "task" else []  # `task` is an argument of the commands


def _agent_models() -> set[type[BaseModel]]:
    """Return the pydantic models of the agent settings of rlcli's own trainers."""
    specs = [load_entry(entry, TrainerSpec) for entry in catalog(TRAINERS)[0] if entry.distribution == OWN]
    return {load_object(model) for spec in specs for model in spec.algorithms.values()}


_FOREIGN_OPTIONS = {
    "task": "the task is named without an option, as in `rlcli train cartpole`",
    "load-run": "--checkpoint RUN names a run or one of its checkpoints; `rlcli train --resume RUN` continues a run",
    "enable-cameras": "leave out this option: rlcli always renders the cameras that a task uses",
}
"""Option that users know from other training programs -> hint that says what to write in rlcli instead."""
_SHORT_FOR = {"lr": "learning_rate"}
"""Abbreviation of an option that users type -> full name of the key in the agent's settings."""
