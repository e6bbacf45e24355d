"""The command table, and the one place where an error becomes an exit code."""

from __future__ import annotations

import functools
import importlib
import os
import re
import sys
import traceback
from typing import TYPE_CHECKING, Any

import typer
from typer._click.exceptions import ClickException, NoArgsIsHelpError, UsageError

from rlcli.cli.ui.console import console, discard, print_log_records
from rlcli.cli.ui.options import CHOOSE, with_common_options
from rlcli.config.settings_file import read_settings
from rlcli.errors import ConfigError, RlcliError
from rlcli.machine import delay_garbage_collection
from rlcli.registry import OWN, TRAINERS, catalog, load_entry, load_object, malformed_metadata_ignored
from rlcli.settings import settings_file, use_settings
from rlcli.trainers import TrainerSpec

if TYPE_CHECKING:
    from pydantic import BaseModel

COMMANDS = (
    "list-tasks", "terms", "show", "validate", "train", "sweep", "bench", "play", "eval", "stress", "export", "replay",
    "autopsy", "runs", "watch", "plot", "report", "diff", "reproduce", "check", "lint", "new", "doctor",
)  # fmt: skip
"""Commands, in the order of `--help`; each has a module of `rlcli.cli.commands` of its name with `command`."""

GROUPS = {"import": "import_"}
"""Command that has commands of its own -> module of `rlcli.cli.commands` with their `app`."""

_INTERRUPTED = 130
_HELP_FLAGS = frozenset(("-h", "--help", "--version", "--install-completion", "--show-completion"))
_COMPLETION_VARIABLE = "_RLCLI_COMPLETE"
"""Environment variable that a shell sets to complete a line."""

_SETTINGS = {
    "help_option_names": ["-h", "--help"],
    "token_normalize_func": lambda name: name.replace("_", "-"),
}


def _root(
    version: bool = typer.Option(False, "--version", help="Print the version and exit.", is_eager=True),
) -> None:
    if version:
        import rlcli

        console.data(f"rlcli {rlcli.__version__}")
        raise typer.Exit


@functools.cache
def build(only: str | None = None) -> typer.Typer:
    """The app with every command registered, or with one; command modules import nothing heavy."""
    app = typer.Typer(
        context_settings=_SETTINGS,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help="Train, play, evaluate and export robot-control policies in MuJoCo.",
    )
    app.callback(invoke_without_command=True)(_root)
    for name in COMMANDS:
        if only in (None, name):
            command = importlib.import_module(f"rlcli.cli.commands.{name.replace('-', '_')}").command
            app.command(name, context_settings=_SETTINGS)(with_common_options(command))
    for name, module in GROUPS.items():
        if only in (None, name):
            group = importlib.import_module(f"rlcli.cli.commands.{module}").app
            app.add_typer(group, name=name, context_settings=_SETTINGS)
    return app


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    print_log_records()
    console.owns_process = arguments is None
    if console.owns_process:
        delay_garbage_collection()
    arguments = sys.argv[1:] if arguments is None else arguments
    console.json, console.debug = "--json" in arguments, "--debug" in arguments
    console.has_document = False  # an earlier command of this process may have printed one
    with console.stdout_kept(), malformed_metadata_ignored():
        code = _run(_with_values(arguments))
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        discard(sys.stdout)
    return code


def _with_values(arguments: list[str]) -> list[str]:
    """`--video` may stand without its FILE: the parser knows no optional values, so the word for "choose" is put in."""
    filled = []
    for position, word in enumerate(arguments):
        filled.append(word)
        following = arguments[position + 1] if position + 1 < len(arguments) else ""
        if word == "--video" and (not following or following.startswith("-") or "=" in following):
            filled.append(CHOOSE)
    return filled


def _command_name(arguments: list[str]) -> str | None:
    """The command on the command line, if it exists."""
    word = next((word for word in arguments if not word.startswith("-")), "").replace("_", "-")
    return word if word in COMMANDS or word in GROUPS else None


def _run(arguments: list[str]) -> int:
    try:
        with use_settings(_preferences(arguments)):
            result = build(_command_name(arguments))(arguments, prog_name="rlcli", standalone_mode=False)
        if result == _INTERRUPTED:  # how typer hands on Ctrl-C
            raise KeyboardInterrupt
        return result if isinstance(result, int) else 0
    except RlcliError as error:
        return _report(error)
    except UsageError as error:
        return _usage(error, arguments)
    except ClickException as error:
        console.error("usage", error.exit_code, error.format_message(), None, [])
        return error.exit_code
    except (KeyboardInterrupt, typer.Abort):
        console.error("stopped", _INTERRUPTED, "interrupted", None, [])
        return _INTERRUPTED
    except OSError as error:
        return _machine(error)
    except Exception as error:
        from rlcli.cli.ui.error_origin import own_failure
        from rlcli.sim.gl import opengl_import_error

        if (unusable := opengl_import_error(error)) is not None:
            return _report(unusable)
        if (failure := own_failure(error)) is not None:
            return _report(failure)
        traceback.print_exc()
        message = f"this is a bug in rlcli: {type(error).__name__}: {error}"
        console.error("bug", 1, message, "please report it with the lines above", [])
        return 1


def _preferences(arguments: list[str]) -> dict[str, Any]:
    """The user's settings; what is asked for help, or to find out what is wrong, works without them too."""
    try:
        settings = read_settings()
    except ConfigError:
        needs_no_settings = arguments[:1] in ([], ["doctor"]) or _HELP_FLAGS.intersection(arguments)
        if not needs_no_settings and _COMPLETION_VARIABLE not in os.environ:
            raise
        settings = {}
    verbosity = settings.get("verbosity")
    console.quiet = verbosity == "quiet"  # a flag may change it
    console.verbose = verbosity == "verbose" or not {"-v", "--verbose"}.isdisjoint(arguments)
    if settings:
        console.detail(f"settings: {settings_file()}")
    return settings


def _report(error: RlcliError) -> int:
    problems: list[dict[str, Any]] = []
    if isinstance(error, ConfigError):
        problems = [{"where": p.where, "path": p.path, "message": p.message, "hint": p.hint} for p in error.problems]
    if console.debug:
        traceback.print_exc()  # of what is being handled, which may be another one
    console.error(error.kind, error.exit_code, error.message, error.hint, problems)
    return error.exit_code


def _usage(error: UsageError, arguments: list[str]) -> int:
    if isinstance(error, NoArgsIsHelpError):
        console.error("usage", 2, "no command", "rlcli --help", []) if console.json else console.info(error.message)
        return 2
    hint = "rlcli --help" if error.ctx is None else f"{error.ctx.command_path} --help"
    match = re.match(r"No such option: --([A-Za-z_][\w.-]*)", error.format_message())
    if match:
        hint = _hint_for_option(match[1], arguments) or hint
    console.error("usage", 2, error.format_message(), hint, [])
    return 2


def _hint_for_option(name: str, arguments: list[str]) -> str | None:
    """What to write where an option does not exist: the override of a setting, or an option of rlcli."""
    keys = _settings_called(name)
    if not keys:
        return _WRITTEN_OTHERWISE.get(name)
    spellings = (f"--{name}", f"--{name.replace('-', '_')}")
    given = next((word for word in arguments if word.startswith(spellings)), "")
    value = given.partition("=")[2]
    if not value and given in arguments[:-1]:
        value = arguments[arguments.index(given) + 1]
    value = value or "VALUE"
    return f"overrides have no dashes: {' or '.join(f'{key}={value}' for key in keys)}"


def _settings_called(option: str) -> list[str]:
    """The settings that an option's name without its dashes may mean: an address, or the last part of one to three."""
    name = option.replace("-", "_")
    if "." in name.strip("."):
        return [name]
    from rlcli.config.messages import key_locations
    from rlcli.config.schema import TaskConfig

    key = _SHORT_FOR.get(name, name)
    models: list[dict[str, Any]] = [{"": TaskConfig}, *({"agent": model} for model in _agent_models())]
    places = list(dict.fromkeys(place for model in models for place in key_locations(model).get(key, [])))
    return places if len(places) <= 3 and name != "task" else []  # the task is an argument


def _agent_models() -> set[type[BaseModel]]:
    """Return the models of the settings of rlcli's own trainers."""
    specs = [load_entry(entry, TrainerSpec) for entry in catalog(TRAINERS)[0] if entry.distribution == OWN]
    return {load_object(model) for spec in specs for model in spec.algorithms.values()}


_WRITTEN_OTHERWISE = {
    "task": "the task is named without an option, as in: rlcli train cartpole",
    "load-run": "a run or one of its checkpoints is named by --checkpoint RUN; rlcli train --resume RUN goes on",
    "enable-cameras": "cameras of a task need no option",
}
"""Options of other programs -> what is written here."""
_SHORT_FOR = {"lr": "learning_rate"}


def _machine(error: OSError) -> int:
    if console.debug:
        traceback.print_exc()
    place = f"{error.filename}: " if error.filename else ""
    console.error("machine", 10, f"{place}{error.strerror or error}", None, [])
    return 10
