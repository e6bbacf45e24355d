"""`rlcli report`: a run as one page of HTML that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.completion import checkpoints
from rlcli.cli.ui.console import SCHEMA_VERSION, console
from rlcli.cli.ui.options import RunsDir, check_output
from rlcli.errors import CheckpointError

if TYPE_CHECKING:
    from rlcli.reporting.run_page import Page
    from rlcli.runs.run import Run

_FILE = "report.html"


def command(
    run: Annotated[
        str,
        typer.Argument(
            autocompletion=checkpoints, metavar="RUN", help="RUN, RUN@best, RUN@step:N, a checkpoint, or latest."
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="FILE.html; by default report.html in the run.")
    ] = None,
    no_eval: Annotated[
        bool, typer.Option("--no-eval", help="Evaluate nothing; an evaluation that the run holds is shown.")
    ] = False,
    no_video: Annotated[bool, typer.Option("--no-video", help="No video in the page.")] = False,
    runs_dir: RunsDir = None,
) -> None:
    """Write a run's page. On it: task, curves, evaluation, video, configuration, machine."""
    from rlcli.runs.run import require_own
    from rlcli.runs.run_ref import default_runs_dir

    check_output(output, "page", (".html", ".htm"))
    found, checkpoint = _find(run, runs_dir or default_runs_dir())
    if output is None:
        require_own(found, _FILE)

    from rlcli.reporting.html import render
    from rlcli.reporting.run_page import gather_page
    from rlcli.runs.atomic_io import write_atomic

    page = gather_page(found, checkpoint)
    evaluation, video = _add_media(page, found, checkpoint, no_eval=no_eval, no_video=no_video)
    for reason in page.missing.values():
        console.warn(reason)
    file = output or found.folder / _FILE
    write_atomic(file, render(page))
    console.data(str(file))
    console.document(
        "report",
        file=file,
        run=found.folder,
        checkpoint=checkpoint,
        charts=[chart.title for chart in page.charts],
        evaluation=evaluation or None,
        video=video or None,
        missing=page.missing,
    )


def _add_media(page: Page, run: Run, checkpoint: Path | None, *, no_eval: bool, no_video: bool) -> tuple[str, str]:
    """Put evaluation and video on the page; return where each is from."""
    from rlcli.reporting.page_media import PageMedia

    if checkpoint is None:
        page.missing["evaluation"] = "There is no evaluation: the run has no complete checkpoint."
        if not no_video:
            page.missing["video"] = "There is no video: the run has no complete checkpoint."
        return "", ""
    media = PageMedia(page, run, checkpoint, SCHEMA_VERSION)
    return media.add_evaluation(may_evaluate=not no_eval), "" if no_video else media.add_video()


def _find(reference: str, runs_dir: Path) -> tuple[Run, Path | None]:
    """The run, and the checkpoint that the page is about; a run may have none yet."""
    from rlcli.runs.run_ref import find_checkpoint, find_run, is_checkpoint_ref

    one_checkpoint = is_checkpoint_ref(reference)
    if not one_checkpoint:
        run, why = find_run(reference, runs_dir)
        console.info(f"{run.folder} ({why})")
        reference = str(run.folder)
    try:
        found, checkpoint, why = find_checkpoint(reference, runs_dir)
    except CheckpointError as error:
        if one_checkpoint:
            raise
        console.warn(error.message)
        return run, None
    console.info(f"checkpoint {checkpoint} ({why})")
    return found, checkpoint
