"""Declarations of options that several commands share, so that a flag means the same everywhere.

`add_command` adds a command with the common options, such as --json, and with the help of its docstring.
"""

import functools
import inspect
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer._click.globals import get_current_context
from typer.models import OptionInfo

from rlcli import progress
from rlcli.cli.ui.completion import agents, checkpoints, runs, tasks, words
from rlcli.cli.ui.console import console
from rlcli.cli.ui.help_text import METAVARS, HelpCommand, read_docstring
from rlcli.errors import MachineError, UsageError
from rlcli.registry.task_code_monitor import raised_by_task
from rlcli.safe_text import MAX_SEED, read_number

CHOOSE = "auto"
"""Text that the parser stores for an option such as `--video` if the user gives no value for it."""


def choice(metavar: str, *names: str, help: str | None = None) -> Any:
    """Return typer's declaration of an option with a fixed list of values, which the shell completes."""
    return typer.Option(autocompletion=words(*names), metavar=metavar, help=help)


def random_if_minus_one(seed: int) -> int:
    """Return the value of --seed; for -1 return a random seed below 2**31."""
    if seed != -1:
        return seed
    import secrets

    return secrets.randbelow(2**31)


_TASK = typer.Argument(
    autocompletion=tasks,
    metavar="TASK",
    help="Name of a task, distribution:name, or a folder with a task.yaml; with a plugin, PACKAGE:ID or FILE.py:Class.",
)
_POLICY_TASK = "Task: its newest run is used, else the policy shipped with the task. Not needed with --checkpoint."
_OVERRIDES = "Overrides of settings; agent.KEY=VALUE changes the chosen agent."
_AGENT = "Agent of the task: a trainer and its settings. [default: the task's]"
_CONFIG = "YAML file merged over the task; its key `agent` changes the chosen agent."
_FEW_ENVS = "Number of environments, whatever scene.num_envs is; at least 8."
_SEED = "Seed of all random numbers; -1 picks a random one and records it."
_MAX_MINUTES = "Minutes after which each training stops with a checkpoint, for --resume. [default: no limit]"
_TASK_FOLDER = "Folder of the task's code, if the task is not installed and its folder has moved."
_RUNS_DIR = "Folder of runs. [default: RLCLI_RUNS_DIR, the settings' runs_dir, or runs]"
_RECORD_MODE = "Episodes to record: all, succeeded, failed, or separate (one file each for the last two)."
_CHECKPOINT = "RUN, RUN@best, RUN@step:N, latest, a checkpoint folder, a bundle, or shipped (the task's own policy)."
_DEVICE = "Device of simulation and training: auto (a GPU, if one can be used), cpu, cuda or cuda:N."
_POLICY = "trained, zero or random actions, or lqr (a linear-quadratic regulator)."
_PROBE_TIMEOUT = "Time limit for loading each task; in doctor also for each trainer and graphics driver [s]."
TaskName = Annotated[str, _TASK]
OptionalTask = Annotated[str | None, _TASK]
TaskOfPolicy = Annotated[str | None, typer.Argument(autocompletion=tasks, metavar="TASK", help=_POLICY_TASK)]
Overrides = Annotated[list[str] | None, typer.Argument(metavar="KEY.PATH=VALUE", help=_OVERRIDES)]
RunRef = Annotated[str, typer.Argument(autocompletion=runs, metavar="RUN", help="Folder or name of a run, or latest.")]
ConfigFile = Annotated[Path | None, typer.Option(metavar="FILE", help=_CONFIG)]
Agent = Annotated[str | None, typer.Option(autocompletion=agents, metavar="NAME", help=_AGENT)]
NumEnvs = Annotated[int | None, typer.Option(help="Number of environments (scene.num_envs). [default: the task's]")]
FewEnvs = Annotated[int, typer.Option("--num-envs", help=_FEW_ENVS)]
Seed = Annotated[int, typer.Option(min=-1, max=MAX_SEED, callback=random_if_minus_one, help=_SEED)]
Device = Annotated[str, choice("DEVICE", "auto", "cpu", "cuda", help=_DEVICE)]
RunName = Annotated[str | None, typer.Option(help="Text at the end of the run folder's name.")]
MaxIterations = Annotated[int | None, typer.Option(help="Iterations of each training. [default: the agent's]")]
MaxSteps = Annotated[int | None, typer.Option(help="Environment steps of each training. [default: the agent's]")]
MaxMinutes = Annotated[float | None, typer.Option(help=_MAX_MINUTES)]
TaskFolder = Annotated[str | None, typer.Option(metavar="FOLDER", help=_TASK_FOLDER)]
RunsDir = Annotated[Path | None, typer.Option(help=_RUNS_DIR)]
Record = Annotated[Path | None, typer.Option(metavar="FILE", help="Record the episodes to FILE, for rlcli replay.")]
RecordMode = Annotated[str, choice("MODE", "all", "succeeded", "failed", "separate", help=_RECORD_MODE)]
CheckpointRef = Annotated[str | None, typer.Option(autocompletion=checkpoints, metavar="CHECKPOINT", help=_CHECKPOINT)]
Policy = Annotated[str, choice("POLICY", "trained", "zero", "random", "lqr", help=_POLICY)]
Stochastic = Annotated[bool, typer.Option("--stochastic", help="Sample actions as in training.")]
ProbeTimeout = Annotated[
    float,
    typer.Option("--probe-timeout", help=_PROBE_TIMEOUT),
]
Headless = Annotated[bool, typer.Option("--headless", hidden=True, help="Open no viewer unless --viewer is given.")]


def _set_verbosity(option: typer.CallbackParam, is_set: bool) -> bool:
    """Set the verbosity of the console for -q or -v; the last of these options on the command line counts."""
    if is_set:
        console.quiet, console.verbose = option.name == "quiet", option.name == "verbose"
    return is_set


_MODEL = (
    "MJCF file of a robot or object of a task in another framework's format, or a YAML file {NAME: FILE}; repeatable."
)
_Models = Annotated[list[str] | None, typer.Option("--model", metavar="NAME=FILE", help=_MODEL)]
_COMMON: dict[str, Any] = {
    "json": typer.Option("--json", help="Print one JSON document on stdout."),
    "quiet": typer.Option("--quiet", "-q", callback=_set_verbosity, help="Print only results and errors."),
    "verbose": typer.Option(
        "--verbose", "-v", callback=_set_verbosity, help="Print details; the last of -q, -v counts."
    ),
    "debug": typer.Option("--debug", help="Print the traceback of an error."),
}
"""Options that every command has; the console holds their values."""


_NEEDED = {
    "record_mode": ("record", "--record FILE"),
    "overwrite": ("save_preset", "--save-preset FILE"),
    "episodes": ("verify", "--verify"),
    "steps": ("case", "the number of a recorded episode"),
}
"""Option -> another parameter without which the option has no effect, and how the user writes that parameter."""


TYPER_ERRORS = (OSError, EOFError, typer.Exit, typer.Abort, typer.BadParameter)
"""Exceptions that typer handles itself, without a message of rlcli. The code of a task may raise them, too."""


class BodyError(Exception):
    """Wrapper around an error of a command's function, so that typer does not handle it as an error of its own.

    Without the wrapper, typer ends the command without a message, for example at the OSError of a closed pipe.
    """

    def __init__(self, error: Exception) -> None:
        self.error = error
        super().__init__()


def add_command(app: typer.Typer, name: str, function: Callable[..., None], **settings: Any) -> None:
    """Add a command to an app, with the common options and the help of the function's docstring.

    The docstring may have the sections `Options:`, with the help of the parameters, and `Examples:`.
    The function does not receive the common options.

    Args:
        app: the app or the group of commands.
        name: the command.
        function: the body of the command; its parameters are declared with typer.
        settings: further settings of the command.
    """
    text, parameter_help, examples = read_docstring(function)
    signature = inspect.signature(function, eval_str=True)
    own = [_with_strict_number(parameter) for parameter in signature.parameters.values()]
    for parameter in own:
        if parameter.name in parameter_help:
            parameter.annotation.__metadata__[0].help = parameter_help[parameter.name]
    common = [
        inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, info])
        for option, info in _COMMON.items()
    ]

    parameters = [*own, *common]
    if "overrides" in signature.parameters:
        model = inspect.Parameter("model", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=_Models)
        parameters.insert(len(signature.parameters), model)

    @functools.wraps(function)
    def run(**values: Any) -> None:
        from rlcli.cli.ui.progress_view import WorkView

        for option, (other, what) in _NEEDED.items():
            is_alone = {option, other} <= values.keys() and values[other] in (None, False)
            if is_alone and values[option] != signature.parameters[option].default:
                flag = f"--{option.replace('_', '-')}"
                raise UsageError(f"{flag} needs {what}", hint=f"add {what}, or leave out {flag}")
        if "overrides" in values and (model := values.pop("model")):
            from rlcli.config.model_option import MODELS, read_models

            words = [f'{MODELS}."{name}"={json.dumps(value)}' for name, value in read_models(model).items()]
            values["overrides"] = [*(values["overrides"] or []), *words]
        progress.view = WorkView
        given = {option: value for option, value in values.items() if option not in _COMMON}
        try:
            with progress.track(get_current_context().command_path):
                function(**given)
        except TYPER_ERRORS as error:
            if isinstance(error, OSError | EOFError) or raised_by_task(error):
                raise BodyError(error) from error
            raise

    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    app.command(name, cls=HelpCommand, help=text, epilog=examples, **settings)(run)


@dataclass(frozen=True)
class _StrictNumber:
    """Annotation for pydantic: read the text of an option as a number, by the same rules as a number in a task file.

    The class has pydantic's hook, but this module imports pydantic's core only when an option is read.
    """

    least: float | None
    most: float | None

    def __get_pydantic_core_schema__(self, source: Any, handler: Callable[[Any], Any]) -> Any:
        from pydantic_core import core_schema

        bounds = {key: value for key, value in (("ge", self.least), ("le", self.most)) if value is not None}
        schema = {**handler(source), "strict": True, **bounds}
        return core_schema.no_info_before_validator_function(_read, schema)


def _read(value: object) -> object:
    number = read_number(value) if isinstance(value, str) else None
    return value if number is None or abs(number) == math.inf else number


def _with_strict_number(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return a command's parameter; a number gets the type `_StrictNumber`, other parameters are unchanged."""
    kind, *infos = get_args(parameter.annotation) or (None,)
    kind = next((number for number in (int, float) if kind in (number, number | None)), None)
    if kind is None or not infos:
        return parameter
    info = infos[0]
    strict: Any = Annotated[kind, _StrictNumber(info.min, info.max)]
    if isinstance(info, OptionInfo):  # an argument is shown with its name
        info.metavar = info.metavar or METAVARS[kind]
    return parameter.replace(annotation=Annotated[strict | None, info])


def budget_keys(
    max_iterations: int | None, max_steps: int | None, until: str | None = None, max_minutes: float | None = None
) -> dict[str, Any]:
    """Return the options that end a training, such as --max-steps, as values of the agent's settings, by key.

    Options that the user has not given are left out. Exception: if only one of --max-iterations and --max-steps is
    given, the other is None in the result, so that the agent's own budget does not end the training first.
    """
    ends = {"agent.until": until, "agent.max_minutes": max_minutes}
    keys: dict[str, Any] = {key: value for key, value in ends.items() if value is not None}
    if max_iterations is not None or max_steps is not None:
        keys |= {"agent.max_iterations": max_iterations, "agent.max_steps": max_steps}
    return keys


def video_file(video: Path | None, default: str) -> Path | None:
    """Return the file that --video names, or `default` if it names none; check that the file can be written."""
    if video is None:
        return None
    from rlcli.runs.atomic_io import require_writable
    from rlcli.viewer.video_writer import check_video

    file = Path(default) if str(video) == CHOOSE else video
    check_video(file)
    require_writable(file)
    return file


def check_output(output: Path | None, what: str, suffixes: Sequence[str]) -> None:
    """Check, before any work is done, that an output file can be written.

    Args:
        output: the file; None: nothing is checked.
        what: what the file holds, for messages: picture or page.
        suffixes: the allowed suffixes, such as `.png`.

    Raises:
        UsageError: if the suffix is not one of `suffixes`, or the path exists and is not a regular file.
        MachineError: if the folder of the file does not exist or cannot be written.
    """
    from rlcli.runs.atomic_io import require_regular, require_writable

    if output is None:
        return
    if output.suffix.lower() not in suffixes:
        raise UsageError(f"'{output}' is not a {what}", hint=f"the name must end in {' or '.join(suffixes)}")
    require_regular(output)
    if not output.absolute().parent.is_dir():
        folder = output.absolute().parent
        raise MachineError(f"cannot write {output}: there is no folder {folder}; create this folder")
    require_writable(output)


def exit_on_failures(failures: list[str]) -> None:
    """Print the limits (--fail-under, --fail-over) that a result violates; exit with code 9 if there are any."""
    for failure in failures:
        console.info(f"failed: {failure}")
    if failures:
        raise typer.Exit(9)
