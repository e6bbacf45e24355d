"""Functions that find the task and configuration of a saved run, and check that a checkpoint fits an environment.

Commands that use a trained policy call them, such as `play`, `eval` and `train --resume`.
"""

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import Field

from rlcli.config.load import Resolved, resolve
from rlcli.envs.layout import Layout
from rlcli.errors import CheckpointError, TaskError
from rlcli.registry import TASKS, TaskSource, find_entry, folder_task, installed_task, python_task
from rlcli.rl.policy import Policy
from rlcli.runs import trusted_tasks
from rlcli.runs.checkpoint_reader import Checkpoint
from rlcli.runs.run import Run
from rlcli.runs.safe_io import FileModel, check_json, read_errors, require_inside
from rlcli.safe_text import shorten


def source_of(run: Run, named: TaskSource | None = None) -> TaskSource:
    """Return the task of a run: code and models as installed now, configuration as recorded in the run.

    Args:
        run: the run.
        named: the task on the command line. It replaces the recorded task if both are folders or files, for example
            after the task's folder was moved, or if the recorded task is not on this machine. None: no task was named.

    Raises:
        TaskError: if the task is not installed any more.
        CheckpointError: if the run names code that the user has never named on this machine.
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
        run: the run that holds the record, if there is one.
        named: the task on the command line, which replaces a task in a folder; see `source_of`.

    Raises:
        TaskError: if the task is not installed any more.
        CheckpointError: if the record names code that the user has never named on this machine.
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
            return named
        if not trusted_tasks.is_known(record):
            raise _untrusted_code_error(record, what, run)
        if record.get("python"):
            return python_task(str(record["python"]), str(record["name"]))
        file = Path(str(record.get("file") or "task.yaml")).name
        return folder_task(Path(str(record["folder"])), file)
    except TaskError as error:
        version = f" {record['version']}" if record.get("version") else ""
        run_word = shlex.quote(run or "")
        folder = "" if run is None else f"; or name its folder: rlcli play FOLDER --checkpoint {run_word}"
        place = shlex.quote(f"PATH/{Path(str(record.get('python') or record.get('folder'))).name}")
        moved = (
            "" if run is None else f"if it was moved, name its new place: rlcli eval {place} --checkpoint {run_word}"
        )
        known = "; ".join(filter(None, (error.hint, moved))) or None
        hint = f"if you trust its authors, install {owner}{version}{folder}" if owner else known
        raise TaskError(f"{what} is not installed: {error.message}", hint=hint) from None


def _untrusted_code_error(record: Mapping[str, Any], what: str, run: str | None) -> CheckpointError:
    code = trusted_tasks.named_code(record)
    name = shlex.quote(code if os.sep in code or "/" in code else f"./{code}")
    allow = f"--task {name}" if run is None else f"rlcli play {name} --checkpoint {shlex.quote(run)}"
    message = f"{what} is not loaded: it names code that you have not used on this machine, {code}"
    return CheckpointError(message, hint=f"if you trust that code, or have it elsewhere, name it once: {allow}")


def resolve_run(
    run: Run, *, play: bool, flags: Mapping[str, Any] | None = None, named: TaskSource | None = None
) -> Resolved:
    """Return the configuration of a run, changed by flags of the command line.

    Args:
        run: the run.
        play: whether to apply the task's `play:` changes.
        flags: dotted key -> value.
        named: the task on the command line, which replaces a task in a folder; see `source_of`.
    """
    return resolve(source_of(run, named), play=play, flags=flags)


def require_fit(checkpoint: Checkpoint, layout: Layout) -> None:
    """Check that an environment has the observations, actions and control period that a policy was trained with.

    Raises:
        CheckpointError: with a table of the differences.
    """
    saved, file = checkpoint.manifest.get("layout"), checkpoint.folder / "manifest.json"
    check_json(_SavedLayout, saved, file, "layout", hint="use another checkpoint: RUN@step:N")
    differing = _differing_rows(checkpoint.manifest["layout"], layout.record())
    if not differing:
        return
    table = _table([("field", "in the checkpoint", "now"), *differing])
    names = "manifest.json" if "bundle" in checkpoint.manifest else "run.json"
    lines = [f"{checkpoint.folder} does not fit the installed task:", *table]
    raise CheckpointError(lines, hint=f"install the task's version that {names} names, or train again")


class _SavedTerm(FileModel):
    """Columns of a term in a layout, which may be of an older version of rlcli that lacks some keys."""

    name: str
    size: int
    elements: list[str] = Field(default_factory=list)
    scale: list[float] | None = None
    offset: list[float] | None = None
    clip: list[float | list[float | None] | None] | None = None
    history: int = 1
    modifiers: list[dict[str, Any]] = Field(default_factory=list)


class _SavedLayout(FileModel):
    observations: dict[str, list[_SavedTerm]]
    actions: list[_SavedTerm]
    step_dt: float | None = None


def require_trainer(checkpoint: Checkpoint, trainer: str) -> None:
    """Check that a run is resumed by the trainer that saved it; checkpoints of older versions do not record it.

    Raises:
        CheckpointError: with both trainers.
    """
    saved = checkpoint.manifest.get("trainer")
    if saved is not None and saved != trainer:
        message = f"{checkpoint.folder} is a checkpoint of trainer '{saved}', but the run's agent uses '{trainer}'"
        raise CheckpointError(message, hint="use --init-from to start a new run with the weights of its policy")


def require_same_policy(checkpoint: Checkpoint, policy: Policy, trainer: str) -> None:
    """Check that the weights of a checkpoint fit a policy. The two may differ in the bounds of actions.

    Raises:
        CheckpointError: with a table of the differences.
    """
    saved, wanted = checkpoint.policy().spec.model_dump(), policy.spec.model_dump()
    rows = [(key, str(saved[key]), str(wanted[key])) for key in wanted if saved[key] != wanted[key]]
    # without normalisation the clip of normalised observations has no effect
    free = {"action_bound"} if saved["normalize"] and wanted["normalize"] else {"action_bound", "normalize_clip"}
    rows = [row for row in rows if row[0] not in free]
    if rows:
        table = _table([("policy", "in the checkpoint", "the agent's"), *rows])
        owner = checkpoint.manifest.get("trainer") or "?"
        title = (
            f"{checkpoint.folder}: the weights do not fit the agent; the checkpoint is from trainer '{owner}', and the"
            f" agent uses '{trainer}':"
        )
        hint = "give the agent the network of the checkpoint, or start without --init-from"
        raise CheckpointError([title, *table], hint=hint)


_MAX_CELL = 200
"""Largest width of a column in a table of differences [characters]; longer texts are cut."""


def _table(rows: Sequence[tuple[str, str, str]]) -> list[str]:
    rows = [(shorten(a, _MAX_CELL), shorten(b, _MAX_CELL), shorten(c, _MAX_CELL)) for a, b, c in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(2)]
    return [f"  {a.ljust(widths[0])}  {b.ljust(widths[1])}  {c}" for a, b, c in rows]


def _differing_rows(record: Mapping[str, Any], current: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return a row (name, value in the checkpoint, value now) for each term that differs between two layouts.

    Args:
        record: the layout in a checkpoint.
        current: the layout of an environment.
    """
    was, now = _fields(record), _fields(current)
    names = [name for name in {**was, **now} if _differ(was.get(name), now.get(name))]
    return [(name, _text(was.get(name)), _text(now.get(name))) for name in names]


def _fields(record: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return the terms and the control period of a layout, for the comparison.

    The key is the name of the row in the table of differences, such as `observations.policy[0]`.
    """
    fields: dict[str, Mapping[str, Any]] = {}
    for group, terms in record.get("observations", {}).items():
        for position, term in enumerate(terms):
            fields[f"observations.{group}[{position}]"] = term
    for position, term in enumerate(record.get("actions", [])):
        fields[f"actions[{position}]"] = term
    if "step_dt" in record:
        fields["step_dt"] = {"name": f"{record['step_dt']:.9g} s"}
    return fields


_CONTRACT = ("name", "size", "elements", "scale", "offset", "clip", "history", "modifiers")
"""Keys of a term's layout that must be equal for the policy. Units are only text, and limits belong to the robot."""


def _differ(was: Mapping[str, Any] | None, now: Mapping[str, Any] | None) -> bool:
    """Return whether the layout of a term in a checkpoint, `was`, differs from that in the environment, `now`.

    Only keys that both layouts have are compared.

    Checkpoints of older versions lack some keys.
    """
    if was is None or now is None:
        return True
    common = [key for key in _CONTRACT if key in was and key in now]
    return any(_rounded(was[key]) != _rounded(now[key]) for key in common if key != "elements" or was[key])


def _text(term: Mapping[str, Any] | None) -> str:
    if term is None:
        return "-"
    if "size" not in term:
        return str(term["name"])
    elements = ", ".join(term.get("elements", []))
    factors = [f"{key} {_rounded(term[key])}" for key in ("scale", "offset", "clip", "modifiers") if term.get(key)]
    if term.get("history", 1) > 1:
        factors.append(f"history {term['history']}")
    return ", ".join([f"{term['name']} ({term['size']}{': ' + elements if elements else ''})", *factors])


def _rounded(value: object) -> Any:
    """Return a number, or a list of numbers, as text with six digits: further digits depend on the machine."""
    if isinstance(value, list):
        return "[" + ", ".join(str(_rounded(item)) for item in value) + "]"
    return f"{value:.6g}" if isinstance(value, float) else value
