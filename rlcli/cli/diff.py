"""`rlcli diff`: where two runs first part, read from their files; or in what two configurations differ."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import runs_and_tasks, words
from rlcli.cli.console import console
from rlcli.cli.options import Agent, Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.rl.configurations import Difference, Section
    from rlcli.rl.run import Run

_SHOWN = 10
"""Differences of one kind that the table shows."""
_WIDTH = 40

Side = tuple[str, list[str]]
"""What is compared, and the overrides that stand after it."""


def command(
    words: Annotated[
        list[str],
        typer.Argument(
            autocompletion=runs_and_tasks,
            metavar="A [KEY.PATH=VALUE]... [B [KEY.PATH=VALUE]...]",
            help="Each a run (RUN, RUN@step:N, RUN@best, a checkpoint, latest), or a task (a name, a folder, a YAML"
            " file) with the overrides after it. One task with overrides is compared with itself without them.",
        ),
    ],
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only",
            autocompletion=words("configuration", "environment", "metrics", "weights", "policy"),
            help="Of runs: configuration, environment, metrics, weights or policy; repeatable.",
        ),
    ] = None,
    agent: Agent = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Tell where two runs or configurations differ. Of each key: physics, MDP, agent or cosmetic."""
    from rlcli.errors import CheckpointError, UsageError, did_you_mean
    from rlcli.rl.compare import SECTIONS
    from rlcli.rl.run import default_runs_dir

    for name in only or []:
        if name not in SECTIONS:
            raise UsageError(f"no --only '{name}'", hint=did_you_mean(name, SECTIONS) or ", ".join(SECTIONS))
    runs = runs_dir or default_runs_dir()
    left, right = _sides(words)
    one, other = _task(left, agent), _task(right, agent)
    try:
        if one is None and other is None:
            if agent is not None:
                raise UsageError("--agent is of tasks; a run has the agent that it was trained with")
            equal = _compare_runs(left[0], right[0], runs, only)
        else:
            if only:
                raise UsageError("--only is of two runs; of a task there is the configuration alone")
            equal = _compare_configurations(one or _run(left[0], runs), other or _run(right[0], runs), left, right)
    except RecursionError:
        raise CheckpointError(f"{left[0]} or {right[0]} is corrupt: values nested too deeply") from None
    if not equal:
        raise typer.Exit(9)


def _sides(words: list[str]) -> tuple[Side, Side]:
    """What stands on the command line, with each one's overrides."""
    from rlcli.errors import UsageError

    sides: list[Side] = []
    for word in words:
        if "=" not in word or Path(word).exists():
            sides.append((word, []))
        elif sides:
            sides[-1][1].append(word)
        else:
            raise UsageError(f"what is '{word}' an override of?", hint="rlcli diff TASK key.path=value")
    if len(sides) == 1 and sides[0][1]:
        sides.insert(0, (sides[0][0], []))
    if len(sides) != 2:
        found = ", ".join(name for name, _ in sides)
        raise UsageError(
            f"two are compared, found {len(sides)}: {found}", hint="rlcli diff A B, or TASK key.path=value"
        )
    return sides[0], sides[1]


def _task(side: Side, agent: str | None) -> Resolved | None:
    """The task that is meant; None if it is a run."""
    from rlcli.cli.validate import task_source
    from rlcli.config.load import resolve
    from rlcli.errors import TaskError, UsageError
    from rlcli.registry import TASKS, catalog
    from rlcli.rl.run import RECORD

    name, overrides = side
    place = Path(name)
    offered = any(name in (entry.name, entry.qualified) for entry in catalog(TASKS)[0])
    is_run = not offered and ("@" in name or (place / RECORD).is_file() or (place / "manifest.json").is_file())
    if not is_run:
        try:
            return resolve(task_source(name), agent=agent, overrides=overrides)
        except TaskError:
            looks_like_task = offered or place.suffix in (".yaml", ".yml", ".py") or (place / "task.yaml").exists()
            if looks_like_task or (overrides and name != "latest"):
                raise
    if overrides:
        raise UsageError(f"{name} is a run, which has no overrides: {' '.join(overrides)}")
    return None


def _run(name: str, runs: Path) -> Run:
    return _find(name, runs)[0]


def _as_task_name(name: str) -> str | None:
    """What to say where a name may be that of a task, with a slip."""
    from rlcli.errors import did_you_mean
    from rlcli.registry import TASKS, catalog

    return did_you_mean(name, [entry.name for entry in catalog(TASKS)[0]])


def _compare_configurations(one: Resolved | Run, other: Resolved | Run, left: Side, right: Side) -> bool:
    """Compare what two tasks, or a task and a run, resolve to, and their models and code."""
    from rlcli.rl.configurations import Values, compare_files, compare_values
    from rlcli.rl.environment import sources
    from rlcli.rl.run import Run

    values, files = [], []
    for side, opposite in ((one, other), (other, one)):
        found = Values.of_run(side) if isinstance(side, Run) else Values.of_task(side)
        if not isinstance(opposite, Run):  # only a run has a seed
            found = found.without_seed()
        values.append(found)
        digests = side.record.get("sources") if isinstance(side, Run) else sources(side)
        files.append({name: sha for name, sha in (digests or {}).items() if name != "rlcli"})
    sections = [compare_values(*values), compare_files(*files)]
    return report("diff", sections, " ".join([left[0], *left[1]]), " ".join([right[0], *right[1]]))


def _compare_runs(left: str, right: str, runs: Path, only: list[str] | None) -> bool:
    from rlcli.errors import UsageError
    from rlcli.rl.compare import SECTIONS, compare

    one, step = _find(left, runs)
    other, twin = _find(right, runs)
    if step is not None and twin is not None and step != twin:
        raise UsageError(f"{left} is at step {step}, {right} at step {twin}", hint="compare equal steps")
    until = step if step is not None else twin
    if until is not None:
        for run in (one, other):
            _require_step(run, until)
    sections = compare(one, other, sections=only or SECTIONS, until=until)
    return report("diff", sections, str(one.folder), str(other.folder), step=until)


def report(name: str, sections: list[Section], left: str, right: str, **more: Any) -> bool:
    """Show what comparing two sides gave; whether they are equal but for what is cosmetic."""
    from rlcli.rl.compare import first_difference, plain
    from rlcli.rl.configurations import CATEGORIES

    first = first_difference(sections)
    counts = Counter(each.category for section in sections for each in section.differences)
    console.table(["", "WHERE", "A", "B"], [row for section in sections for row in _rows(section)])
    if told := [f"{name} {counts[name]}" for name in CATEGORIES if counts[name]]:
        console.data(f"differences: {', '.join(told)}")
    if first is None:
        console.data("no difference that is not cosmetic" if counts else "no difference")
    else:
        section, found = first
        console.data(f"first difference: {section} {_safe(found.where)}: {_told(found, 0)} | {_told(found, 1)}")

    def document(difference: Difference) -> dict[str, Any]:
        return {key: plain(value) for key, value in asdict(difference).items()}

    console.document(
        name,
        equal=first is None,
        categories={name: counts[name] for name in CATEGORIES},
        first=None if first is None else {"section": first[0], **document(first[1])},
        left=left,
        right=right,
        **more,
        sections=[
            {"name": s.name, "compared": s.compared, "differences": [document(d) for d in s.differences]}
            for s in sections
        ],
    )
    return first is None


def _find(reference: str, runs: Path) -> tuple[Run, int | None]:
    """A run, and the step of the checkpoint if one is named."""
    from rlcli.errors import CheckpointError
    from rlcli.rl.run import find_checkpoint, find_run

    if (Path(reference) / "manifest.json").is_file() or ("@" in reference and not Path(reference).exists()):
        run, folder, _ = find_checkpoint(reference, runs)
        if not folder.resolve().name.isdecimal():
            raise CheckpointError(f"{folder} is not named by its step, as a run's checkpoints are")
        return run, int(folder.resolve().name)
    try:
        run, why = find_run(reference, runs)
    except CheckpointError as error:
        if near := _as_task_name(reference):
            raise CheckpointError(f"no run and no task '{reference}'", hint=near) from error
        raise
    if reference == "latest":
        console.info(f"{run.folder} ({why})")
    return run, None


def _require_step(run: Run, step: int) -> None:
    from rlcli.errors import CheckpointError, listing
    from rlcli.rl.checkpoint import steps

    have = steps(run.checkpoints)
    if step not in have:
        raise CheckpointError(
            f"{run.folder} has no checkpoint at step {step}", hint=f"steps: {listing(map(str, have))}"
        )


def _rows(section: Section) -> list[list[str]]:
    if not section.differences:
        return [[section.name, f"equal: {section.compared}", "", ""]]
    rows = []
    seen: Counter[str] = Counter()
    for each in section.differences:
        kind = each.category or section.name
        seen[kind] += 1
        if seen[kind] <= _SHOWN or console.verbose:
            rows.append([kind, _safe(each.where), _told(each, 0), _told(each, 1)])
    for kind, count in seen.items():
        if count > _SHOWN and not console.verbose:
            rows.append([kind, f"and {count - _SHOWN} more (-v shows them)", "", ""])
    return rows


def _told(difference: Difference, side: int) -> str:
    value, place = (difference.left, difference.left_from) if side == 0 else (difference.right, difference.right_from)
    return f"{shown(value)} ({_safe(place)})" if place else shown(value)


def shown(value: Any) -> str:
    """A value in a cell; `-` for none."""
    text = "-" if value is None else _safe(value if isinstance(value, str) else repr(value))
    return text if len(text) <= _WIDTH else f"{text[: _WIDTH - 3]}..."


def _safe(text: str) -> str:
    """A stranger's text, with nothing in it that a terminal obeys."""
    return text.encode("unicode_escape").decode("ascii") if not text.isprintable() else text
