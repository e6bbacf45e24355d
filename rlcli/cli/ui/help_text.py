"""Formatter of `--help`: commands and options in titled panels, and examples.

The help is plain text, because rich, which typer would use, is slow to import.
"""

import inspect
import re
import textwrap
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from typer.core import TyperCommand, TyperGroup

OPTION_PANELS = {
    "Run": ("resume", "init-from", "name", "runs-dir", "seed", "seeds", "jobs"),
    "Policy": ("checkpoint", "policy", "stochastic", "against", "compare"),
    "Environment": ("num-envs", "config", "command", "model"),
    "Trainer": ("agent", "max-iterations", "max-steps", "max-minutes", "until"),
    "Search": ("param", "trials", "objective", "minimize", "pruner", "storage"),
    "Variants": ("sweep", "points", "worst"),
    "Episodes": ("episodes", "env", "episode", "fail-under", "fail-over"),
    "Viewer": ("viewer", "port", "show", "seconds"),
    "Logs and files": ("logger", "video-every", "video", "record", "record-mode", "plot", "output"),
    "Machine": ("device", "gpus"),
    "Output": ("json", "quiet", "verbose", "debug", "help"),
}
"""Panel -> names of its options, in the order of the help; all other options are in the panel "Options"."""
_MAX_UNGROUPED = 8
"""A command with at most this many options, not counting the panel "Output", has them all in the panel "Options"."""
_UNBOUNDED = 10**9
"""Largest upper limit of an option that `--help` shows; a higher limit means any number."""
METAVARS = {int: "INTEGER", float: "FLOAT", Path: "PATH"}


def read_docstring(function: Callable[..., Any]) -> tuple[str, dict[str, str], str]:
    """Split the docstring of a command's function into the parts that `--help` prints.

    Returns:
        The text before the sections, parameter -> help (of `Options:`), and the text of `Examples:`.
    """
    head, _, examples = inspect.cleandoc(function.__doc__ or "").partition("\n\nExamples:\n")
    text, _, options = head.partition("\n\nOptions:\n")
    entries = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", options, re.MULTILINE)
    return text, {name: " ".join(words.split()) for name, words in entries}, textwrap.dedent(examples)


class _PanelHelp:
    """Mix-in for typer's commands and groups that prints the help in panels (titled groups of options)."""

    def collect_usage_pieces(self: Any, ctx: Any) -> list[str]:
        """Return the usage line after the name of the command."""
        arguments = [each for each in self.params if each.param_type_name == "argument"]
        names = [_name(each) if each.required else f"[{_name(each)}]" for each in arguments]
        repeated = [
            f"{name}..." if each.nargs < 0 and " " not in name else name
            for name, each in zip(names, arguments, strict=True)
        ]
        return ["[OPTIONS]", *repeated, *([self.subcommand_metavar] if hasattr(self, "commands") else [])]

    def format_options(self: Any, ctx: Any, formatter: Any) -> None:
        """Write the tables of commands, arguments and options of `--help`; Typer calls this method."""
        panels: dict[str, list[tuple[str, str]]] = defaultdict(list)
        for name, command in getattr(self, "commands", {}).items():
            if not command.hidden:
                panels[command.rich_help_panel or "Commands"].append((name, command.get_short_help_str(200)))
        shown = [(_panel(each), each) for each in self.get_params(ctx) if not each.hidden]
        grouped = sum(panel not in ("Arguments", "Output") for panel, _ in shown) > _MAX_UNGROUPED
        rows: dict[str, list[tuple[str, str]]] = {name: [] for name in ("Arguments", "Options", *OPTION_PANELS)}
        for panel, each in shown:
            kept = grouped or panel in ("Arguments", "Output")
            rows[panel if kept else "Options"].append((_name(each), _description(each)))
        for panel, entries in [*panels.items(), *rows.items()]:
            if entries:
                with formatter.section(panel):
                    formatter.write_dl(entries)

    def format_epilog(self: Any, ctx: Any, formatter: Any) -> None:
        """Write the examples without changing their lines."""
        if self.epilog:
            formatter.write(f"\nExamples:\n{textwrap.indent(self.epilog, '  ')}\n")


class HelpCommand(_PanelHelp, TyperCommand):
    """Typer's command, whose `--help` groups the options in tables by subject."""


class HelpGroup(_PanelHelp, TyperGroup):
    """Typer's group of commands, whose `--help` groups commands and options in tables by subject."""


def _panel(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return "Arguments"
    name = max(parameter.opts, key=len).lstrip("-")
    return next((panel for panel, names in OPTION_PANELS.items() if name in names), "Options")


def _name(parameter: Any) -> str:
    """Return the first column of the help: the metavar of an argument, or the flags of an option and its metavar."""
    if parameter.param_type_name == "argument":
        return str(parameter.metavar or parameter.name.upper())
    metavar = parameter.metavar or METAVARS.get(parameter.type_descriptor.annotation, "TEXT")
    options = ", ".join(sorted(parameter.opts, key=len))
    return options if parameter.is_flag else f"{options} {metavar}"


def _description(parameter: Any) -> str:
    """Return the second column of the help: the help text, the allowed range and the default value."""
    found = re.fullmatch(r"(.*?)(?: \[default: (.+)\])?", parameter.help or "", re.DOTALL)
    assert found is not None
    default = found[2] or (None if isinstance(parameter.default, bool) else parameter.default)
    low, high = parameter.min, parameter.max
    parts = [found[1]]
    if low is not None and high is None:
        parts.append(f"[at least {low}]")
    elif low is not None and high < _UNBOUNDED:
        parts.append(f"[{low} to {high}]")
    if default is not None:
        parts.append(f"[default: {default}]")
    if parameter.required and parameter.param_type_name == "option":
        parts.append("[required]")
    return "  ".join(parts)
