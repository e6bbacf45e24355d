"""`rlcli diff`: where two runs first part, read from their files."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.rl.compare import Difference, Section
    from rlcli.rl.run import Run

_SHOWN = 10
"""Differences of one section that the table shows."""
_WIDTH = 40


def command(
    left: Annotated[str, typer.Argument(metavar="RUN1", help="RUN, RUN@step:N, RUN@best, a checkpoint, or latest.")],
    right: Annotated[str, typer.Argument(metavar="RUN2", help="The other one.")],
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="configuration, environment, metrics, weights or policy; repeatable."),
    ] = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Tell where two runs first differ."""
    from rlcli.errors import CheckpointError, UsageError, did_you_mean
    from rlcli.rl.compare import SECTIONS, compare
    from rlcli.rl.run import default_runs_dir

    for name in only or []:
        if name not in SECTIONS:
            raise UsageError(f"no --only '{name}'", hint=did_you_mean(name, SECTIONS) or ", ".join(SECTIONS))
    runs = runs_dir or default_runs_dir()
    one, step = _find(left, runs)
    other, twin = _find(right, runs)
    if step is not None and twin is not None and step != twin:
        raise UsageError(f"{left} is at step {step}, {right} at step {twin}", hint="compare equal steps")
    until = step if step is not None else twin
    if until is not None:
        for run in (one, other):
            _require_step(run, until)
    try:
        sections = compare(one, other, sections=only or SECTIONS, until=until)
        equal = report("diff", sections, str(one.folder), str(other.folder), step=until)
    except RecursionError:
        raise CheckpointError(f"{one.folder} or {other.folder} is corrupt: values nested too deeply") from None
    if not equal:
        raise typer.Exit(9)


def report(name: str, sections: list[Section], left: str, right: str, **more: Any) -> bool:
    """Show what comparing two runs gave; whether they are equal."""
    from rlcli.rl.compare import first_difference, plain

    first = first_difference(sections)
    console.table(["", "WHERE", "RUN1", "RUN2"], [row for section in sections for row in _rows(section)])
    if first is None:
        console.data("no difference")
    else:
        section, found = first
        console.data(f"first difference: {section} {_safe(found.where)}: {_told(found, 0)} | {_told(found, 1)}")

    def document(difference: Difference) -> dict[str, Any]:
        return {key: plain(value) for key, value in asdict(difference).items()}

    console.document(
        name,
        equal=first is None,
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
    from rlcli.rl.run import find_checkpoint, find_run

    if (Path(reference) / "manifest.json").is_file() or ("@" in reference and not Path(reference).exists()):
        run, folder, _ = find_checkpoint(reference, runs)
        if not folder.resolve().name.isdecimal():
            from rlcli.errors import CheckpointError

            raise CheckpointError(f"{folder} is not named by its step, as a run's checkpoints are")
        return run, int(folder.resolve().name)
    run, why = find_run(reference, runs)
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
    rows = [[section.name, _safe(d.where), _told(d, 0), _told(d, 1)] for d in section.differences[:_SHOWN]]
    if (more := len(section.differences) - _SHOWN) > 0:
        rows.append([section.name, f"and {more} more", "", ""])
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
