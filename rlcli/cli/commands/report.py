"""Command `rlcli report`: one self-contained HTML page about a run.

The page has task, learning curves, evaluation, video, configuration and machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.completion import checkpoints
from rlcli.cli.ui.console import SCHEMA_VERSION, console
from rlcli.cli.ui.options import RunsDir, check_output
from rlcli.errors import CheckpointError

if TYPE_CHECKING:
    from rlcli.reporting.run_page_content import Page
    from rlcli.runs.run import Run

_FILE = "report.html"


def command(
    run: Annotated[str, typer.Argument(autocompletion=checkpoints, metavar="RUN")],
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE")] = None,
    no_eval: Annotated[bool, typer.Option("--no-eval")] = False,
    no_video: Annotated[bool, typer.Option("--no-video")] = False,
    runs_dir: RunsDir = None,
) -> None:
    """Write a page about a run, with task, curves, evaluation, video, configuration and machine.

    Options:
        run: RUN, RUN@best, RUN@step:N, a checkpoint folder, or latest.
        output: File to write, FILE.html. [default: report.html in the run]
        no_eval: Do not evaluate the policy; show a saved evaluation of the run if there is one.
        no_video: Do not put a video on the page.

    Examples:
        rlcli report latest
            Evaluate and film the newest run; write report.html into it.
        rlcli report latest@best -o page.html --no-video
            Write a page about the best checkpoint of the newest run, without a video.
    """
    from rlcli.runs.run import require_own
    from rlcli.runs.run_ref import default_runs_dir

    check_output(output, "page", (".html", ".htm"))
    found, checkpoint = _find(run, runs_dir or default_runs_dir())
    if output is None:
        require_own(found, _FILE)

    from rlcli.reporting.html import render
    from rlcli.reporting.run_page_content import gather_page
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
    """Add evaluation and video to the page.

    Returns:
        The origin of the evaluation and the origin of the video. Each is `stored` (a file of the run), `made` (by
        this call), `older` (a file of an earlier checkpoint) or an empty text (the page has none).
    """
    from rlcli.reporting.page_media import PageMedia

    if checkpoint is None:
        page.missing["evaluation"] = "There is no evaluation: the run has no complete checkpoint."
        if not no_video:
            page.missing["video"] = "There is no video: the run has no complete checkpoint."
        return "", ""
    media = PageMedia(page, run, checkpoint, SCHEMA_VERSION)
    return media.add_evaluation(may_evaluate=not no_eval), "" if no_video else media.add_video()


def _find(reference: str, runs_dir: Path) -> tuple[Run, Path | None]:
    """Return the run that a reference names, and its checkpoint; None if the run has no checkpoint yet."""
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
