"""Find the task and configuration of a saved run, for `play`, `eval`, `train --resume` and other commands."""

import logging
import os
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rlcli.config.load import Resolved, resolve
from rlcli.errors import CheckpointError, TaskError
from rlcli.registry import TASKS, TaskSource, find_entry, folder_task, installed_task, python_task
from rlcli.runs import trusted_tasks
from rlcli.runs.run import Run
from rlcli.runs.safe_io import read_errors, require_inside
from rlcli.safe_text import shorten

_log = logging.getLogger(__name__)


def source_of(run: Run, named: TaskSource | None = None) -> TaskSource:
    """Return the task of a run: code and models as installed now, configuration as recorded in the run.

    Args:
        run: the run.
        named: the task on the command line. It replaces the recorded task if both are folders or files, for example
            after the task's folder was moved, or if the recorded task is not on this machine. None: no task was named.

    Raises:
        TaskError: if the task is not installed any more.
        CheckpointError: if the task's code is not trusted, because the user has never used it on this machine.
    """
    source = recorded_task(run.record["task"], f"the task of {run.folder}", str(run.folder), named)
    with read_errors(run.config):
        require_inside(run.folder, run.config)
    return replace(source, config=run.config)


def recorded_task(
    record: Mapping[str, Any], what: str, run: str | None = None, named: TaskSource | None = None
) -> TaskSource:
    """Find the task that a run or another file has stored as a record (`TaskSource.record`), as it is installed now.

    Args:
        record: the record.
        what: name of the task in messages, such as `the task of RUN`.
        run: folder of the run that holds the record, for the message; None: another file holds the record.
        named: the task on the command line, which replaces a task in a folder; see `source_of`.

    Raises:
        TaskError: if the task is not installed any more.
        CheckpointError: if the task's code is not trusted, because the user has never used it on this machine.
    """
    owner = record.get("distribution")
    try:
        if owner:
            try:
                return installed_task(find_entry(TASKS, f"{owner}:{record['name']}", what="task"))
            except TaskError:
                if named is None or named.distribution is not None:
                    raise
                return named
        is_gone = not record.get("python") and not Path(str(record["folder"])).exists()
        if named is not None and (named.distribution is None or is_gone):
            if named.distribution is not None:
                _log.warning(
                    "%s is not on this machine (%s); the task '%s' of %s is used instead",
                    what, shorten(record["folder"], 100), named.name, named.distribution,
                )  # fmt: skip
            return named
        if not trusted_tasks.is_known(record):
            raise _untrusted_code_error(record, what, run)
        if record.get("python"):
            return python_task(str(record["python"]), str(record["name"]))
        file = Path(str(record.get("file") or "task.yaml")).name
        return folder_task(Path(str(record["folder"])), file)
    except TaskError as error:
        version = f" {record['version']}" if record.get("version") else ""
        known = error.hint
        if run is not None:
            word, path = shlex.quote(run), Path(str(record.get("python") or record.get("folder")))
            version += f"; or name the task's folder: rlcli play FOLDER --checkpoint {word}"
            moved = shlex.quote(f"PATH/{path.name}")
            known = f"{error.hint}; " if error.hint else ""
            known += f"if the task was moved, name its new place: rlcli eval {moved} --checkpoint {word}"
        hint = f"if you trust its authors, install {owner}{version}" if owner else known
        state = "is not installed" if owner else "was not found"
        raise TaskError(f"{what} {state}: {error.message}", hint=hint) from None


def _untrusted_code_error(record: Mapping[str, Any], what: str, run: str | None) -> CheckpointError:
    code = trusted_tasks.named_code(record)
    name = shlex.quote(code if os.sep in code or "/" in code else f"./{code}")
    allow = f"--task {name}" if run is None else f"rlcli play {name} --checkpoint {shlex.quote(run)}"
    message = f"{what} is not loaded: its code, {code}, has not been used on this machine before"
    return CheckpointError(
        message, hint=f"if you trust this code, or have a copy of it at another path, give its path once: {allow}"
    )


def resolve_run(
    run: Run, *, play: bool, flags: Mapping[str, Any] | None = None, named: TaskSource | None = None
) -> Resolved:
    """Return the configuration of a run, changed by flags of the command line.

    Args:
        run: the run.
        play: whether to apply the task's `play:` changes.
        flags: dotted key -> value that replaces the recorded value; None: no changes.
        named: the task on the command line, which replaces a task in a folder; see `source_of`.

    Raises:
        TaskError, CheckpointError: see `source_of`.
        ConfigError: if the installed task does not accept the configuration.
    """
    return resolve(source_of(run, named), play=play, flags=flags)
