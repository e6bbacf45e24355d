"""From a run to an environment and a policy that fit each other: what play, eval and resume have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rlcli.config.load import Resolved, resolve
from rlcli.envs.vec_env import Layout
from rlcli.errors import CheckpointError, TaskError
from rlcli.registry import TaskSource, find_task, folder_task
from rlcli.rl.checkpoint import Checkpoint
from rlcli.rl.policy import Policy, load_policy
from rlcli.rl.run import Run


def source_of(run: Run) -> TaskSource:
    """The task of a run: its code and models as installed, its configuration as the run recorded it.

    Raises:
        TaskError: if the task is not installed any more.
    """
    record = run.record["task"]
    try:
        if record.get("folder"):
            file = Path(str(record.get("file") or "task.yaml")).name
            source = folder_task(Path(str(record["folder"])), file)
        else:
            source = find_task(f"{record['distribution']}:{record['name']}")
    except TaskError as error:
        raise TaskError(
            f"the task of {run.folder} is not there: {error.message}",
            hint=f"install {record.get('distribution')} {record.get('version')}"
            if record.get("distribution")
            else error.hint,
        ) from None
    return replace(source, config=run.config)


def resolve_run(
    run: Run,
    *,
    play: bool,
    config_file: Path | None = None,
    overrides: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
) -> Resolved:
    """The configuration of a run, with what the command line changes for playing."""
    return resolve(source_of(run), play=play, config_file=config_file, overrides=overrides, flags=flags)


def policy_of(checkpoint: Checkpoint) -> Policy:
    """The policy of a checkpoint; nothing of the task or the simulator is needed."""
    return load_policy(checkpoint.json("policy.json"), checkpoint.tensors("policy"))


def require_fit(checkpoint: Checkpoint, layout: Layout) -> None:
    """The environment must be what the policy was trained in.

    Raises:
        CheckpointError: with a table of what differs, then and now.
    """
    try:
        was, now = _fields(checkpoint.manifest["layout"]), _fields(layout.record())
    except (AttributeError, KeyError, TypeError, ValueError):
        raise CheckpointError(f"{checkpoint.folder}/manifest.json is corrupt: its layout is malformed") from None
    differs = [name for name in {**was, **now} if was.get(name) != now.get(name)]
    if not differs:
        return
    rows = [("field", "in the checkpoint", "now"), *((n, was.get(n, "-"), now.get(n, "-")) for n in differs)]
    widths = [max(len(row[column]) for row in rows) for column in range(2)]
    table = "\n".join(f"  {a.ljust(widths[0])}  {b.ljust(widths[1])}  {c}" for a, b, c in rows)
    raise CheckpointError(
        f"{checkpoint.folder} does not fit the installed task:\n{table}",
        hint="install the task's version that run.json names, or train again",
    )


def _fields(record: Mapping[str, Any]) -> dict[str, str]:
    fields: dict[str, str] = {}
    for group, terms in record.get("observations", {}).items():
        for position, term in enumerate(terms):
            fields[f"observations.{group}[{position}]"] = _term(term)
    for position, term in enumerate(record.get("actions", [])):
        fields[f"actions[{position}]"] = _term(term)
    if "step_dt" in record:
        fields["step_dt"] = f"{record['step_dt']:.9g} s"
    return fields


def _term(term: Mapping[str, Any]) -> str:
    elements = ", ".join(term.get("elements", []))
    return f"{term['name']} ({term['size']}{': ' + elements if elements else ''})"
