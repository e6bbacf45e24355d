"""The command table, and the one place where an error becomes an exit code."""

from __future__ import annotations

import functools
import importlib
import os
import re
import sys
import traceback
from typing import Any

import typer
from typer._click.exceptions import ClickException, NoArgsIsHelpError, UsageError

from rlcli.cli.console import console, discard, print_log_records
from rlcli.cli.options import CHOOSE
from rlcli.config.settings import applied, read_settings, settings_file
from rlcli.errors import ConfigError, RlcliError
from rlcli.machine import collect_seldom
from rlcli.registry import malformed_metadata_ignored

COMMANDS = {
    "list-tasks": "list_tasks",
    "show": "show",
    "validate": "validate",
    "train": "train",
    "sweep": "sweep",
    "bench": "bench",
    "play": "play",
    "eval": "eval",
    "stress": "stress",
    "export": "export",
    "replay": "replay",
    "autopsy": "autopsy",
    "runs": "runs",
    "watch": "watch",
    "plot": "plot",
    "report": "report",
    "diff": "diff",
    "reproduce": "reproduce",
    "check": "check",
    "lint": "lint",
    "new": "new",
    "doctor": "doctor",
}
"""Command -> module of `rlcli.cli` that registers it."""

GROUPS = {"import": "import_"}
"""Command that has commands of its own -> module of `rlcli.cli` with their `app`."""

_INTERRUPTED = 130
_ASKING = frozenset(("-h", "--help", "--version", "--install-completion", "--show-completion"))
_COMPLETING = "_RLCLI_COMPLETE"
"""Set by a shell that asks how a line may go on."""

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
    for name, module in COMMANDS.items():
        if only in (None, name):
            command = importlib.import_module(f"rlcli.cli.{module}").command
            app.command(name, context_settings=_SETTINGS)(command)
    for name, module in GROUPS.items():
        if only in (None, name):
            group = importlib.import_module(f"rlcli.cli.{module}").app
            app.add_typer(group, name=name, context_settings=_SETTINGS)
    return app


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    print_log_records()
    console.owns_process = arguments is None
    if console.owns_process:
        collect_seldom()
    arguments = sys.argv[1:] if arguments is None else arguments
    console.json, console.debug = "--json" in arguments, "--debug" in arguments
    console.told = False  # what an earlier command of this process was told
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


def _named(arguments: list[str]) -> str | None:
    """The command that is asked for, if there is such a one."""
    word = next((word for word in arguments if not word.startswith("-")), "").replace("_", "-")
    return word if word in COMMANDS or word in GROUPS else None


def _run(arguments: list[str]) -> int:
    try:
        with applied(_preferences(arguments)):
            result = build(_named(arguments))(arguments, prog_name="rlcli", standalone_mode=False)
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
        from rlcli.cli.culprit import own_failure
        from rlcli.sim.gl import unusable_choice

        if (unusable := unusable_choice(error)) is not None:
            return _report(unusable)
        if (failure := own_failure(error)) is not None:
            return _report(failure)
        traceback.print_exc()
        said = f"this is a bug in rlcli: {type(error).__name__}: {error}"
        console.error("bug", 1, said, "please report it with the lines above", [])
        return 1


def _preferences(arguments: list[str]) -> dict[str, Any]:
    """The user's settings; what is asked for help, or to find out what is wrong, works without them too."""
    try:
        settings = read_settings()
    except ConfigError:
        looking = arguments[:1] in ([], ["doctor"]) or _ASKING.intersection(arguments)
        if not looking and _COMPLETING not in os.environ:
            raise
        settings = {}
    told = settings.get("verbosity")
    console.quiet = told == "quiet"  # unless a flag says otherwise
    console.verbose = told == "verbose" or not {"-v", "--verbose"}.isdisjoint(arguments)
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
    keys = _settings_called(match[1]) if match else []
    if match and keys:
        key = match[1]
        given = next(
            (a for a in arguments if a.startswith(f"--{key}") or a.startswith(f"--{key.replace('-', '_')}")),
            "",
        )
        value = given.partition("=")[2]
        if not value and given in arguments[:-1]:
            value = arguments[arguments.index(given) + 1]
        value = value or "VALUE"
        hint = f"overrides have no dashes: {' or '.join(f'{key}={value}' for key in keys)}"
    elif match and match[1] in _WRITTEN_OTHERWISE:
        hint = _WRITTEN_OTHERWISE[match[1]]
    console.error("usage", 2, error.format_message(), hint, [])
    return 2


def _settings_called(option: str) -> list[str]:
    """The settings that an option's name without its dashes may mean: an address, or the last part of one to three."""
    name = option.replace("-", "_")
    if "." in name.strip("."):
        return [name]
    from rlcli.config.messages import homes
    from rlcli.config.schema import TaskConfig
    from rlcli.rl.ppo_config import PpoConfig
    from rlcli.rl.sb3_config import Sb3Config

    key = _SHORT_FOR.get(name, name)
    both: tuple[dict[str, Any], ...] = ({"": TaskConfig, "agent": PpoConfig}, {"agent": Sb3Config})
    places = list(dict.fromkeys(place for models in both for place in homes(models).get(key, [])))
    return places if len(places) <= 3 and name != "task" else []  # the task is an argument


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
