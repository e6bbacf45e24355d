"""Checks that a checkpoint fits an environment, a trainer and a policy; errors have a table of the differences."""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import Field

from rlcli.envs.layout import Layout
from rlcli.errors import CheckpointError
from rlcli.rl.policy import Policy
from rlcli.runs.checkpoint_reader import Checkpoint
from rlcli.runs.safe_io import FileModel, check_json
from rlcli.safe_text import shorten


def require_fit(checkpoint: Checkpoint, layout: Layout) -> None:
    """Check that an environment has the observations, actions and control period that a policy was trained with.

    Raises:
        CheckpointError: if they differ, with a table of the differences.
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
    """Check that the trainer that resumes a run is the trainer that saved the checkpoint.

    Checkpoints of older versions of rlcli do not record their trainer and are accepted.

    Raises:
        CheckpointError: if the trainers differ; the message names both.
    """
    saved = checkpoint.manifest.get("trainer")
    if saved is not None and saved != trainer:
        message = f"{checkpoint.folder} is a checkpoint of trainer '{saved}', but the run's agent uses '{trainer}'"
        raise CheckpointError(message, hint="use --init-from to start a new run with the weights of its policy")


def require_same_policy(checkpoint: Checkpoint, policy: Policy, trainer: str) -> None:
    """Check that the weights of a checkpoint fit an agent's policy; the bounds of actions may differ.

    Args:
        checkpoint: the checkpoint.
        policy: the policy of the agent that gets the weights.
        trainer: name of the agent's trainer, for the message.

    Raises:
        CheckpointError: if the structures of the policies differ, with a table of the differences.
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

    Only keys that both layouts have are compared: checkpoints of older versions of rlcli lack some keys.
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
    """Return a float, or a list, as text with six significant digits: further digits depend on the machine.

    Other values are returned unchanged.
    """
    if isinstance(value, list):
        return "[" + ", ".join(str(_rounded(item)) for item in value) + "]"
    return f"{value:.6g}" if isinstance(value, float) else value
