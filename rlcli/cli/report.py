"""`rlcli report`: a run as one page of HTML that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import checkpoints
from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json, Quiet, RunsDir, Verbose
from rlcli.cli.plot import require_folder

if TYPE_CHECKING:
    from rlcli.cli.session import Session
    from rlcli.rl.report import Page
    from rlcli.rl.run import Run

_FILE = "report.html"
_EPISODES = 200
_SEED = 42
_LONGEST_S = 20.0
"""Of an episode that is filmed for the page."""
_LARGEST = 24 * 2**20
"""Of a video in the page [bytes]."""


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
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Write a run's page. On it: task, curves, evaluation, video, configuration, machine."""
    from rlcli.errors import UsageError
    from rlcli.rl.run import default_runs_dir, require_own

    if output is not None and output.suffix not in (".html", ".htm"):
        raise UsageError(f"'{output}' is not a page", hint="name it *.html")
    require_folder(output)
    found, checkpoint = _find(run, runs_dir or default_runs_dir())
    if output is None:
        require_own(found, _FILE)

    from rlcli.rl.files import write_atomic
    from rlcli.rl.page import render
    from rlcli.rl.report import gather_page

    page = gather_page(found, checkpoint)
    made: dict[str, str] = {}
    if checkpoint is None:
        page.missing["evaluation"] = "There is no evaluation: the run has no complete checkpoint."
        if not no_video:
            page.missing["video"] = "There is no video: the run has no complete checkpoint."
    else:
        stage = _Stage(checkpoint)
        made["evaluation"] = _evaluate(page, found, checkpoint, stage, allowed=not no_eval)
        made["video"] = "" if no_video else _film(page, found, checkpoint, stage)
    for reason in page.missing.values():
        console.warn(reason)
    file = output or found.folder / _FILE
    write_atomic(file, render(page))
    console.data(str(file))
    console.document(
        "report",
        file=str(file),
        run=str(found.folder),
        checkpoint=str(checkpoint) if checkpoint else None,
        charts=[chart.title for chart in page.charts],
        evaluation=made.get("evaluation") or None,
        video=made.get("video") or None,
        missing=page.missing,
    )


def _find(reference: str, runs: Path) -> tuple[Run, Path | None]:
    """The run, and the checkpoint to speak of; a run may have none yet."""
    from rlcli.errors import CheckpointError
    from rlcli.rl.run import find_checkpoint, find_run

    named = (Path(reference) / "manifest.json").is_file() or ("@" in reference and not Path(reference).exists())
    if not named:
        run, why = find_run(reference, runs)
        console.info(f"{run.folder} ({why})")
        reference = str(run.folder)
    try:
        found, checkpoint, why = find_checkpoint(reference, runs, tell=console.warn)
    except CheckpointError as error:
        if named:
            raise
        console.warn(error.message)
        return run, None
    console.info(f"checkpoint {checkpoint} ({why})")
    return found, checkpoint


class _Stage:
    """The environment with the policy in it, built when it is first needed."""

    def __init__(self, checkpoint: Path) -> None:
        self._checkpoint = checkpoint
        self._session: Session | None = None

    def session(self) -> Session:
        from rlcli.cli.session import open_session

        if self._session is None:
            self._session = open_session(
                None,
                [],
                checkpoint=str(self._checkpoint),
                policy="trained",
                stochastic=False,
                num_envs=None,
                seed=_SEED,
                config=None,
                runs_dir=None,
            )
        return self._session


def _evaluate(page: Page, run: Run, checkpoint: Path, stage: _Stage, *, allowed: bool) -> str:
    """Put the evaluation on the page: what the run holds, else a new one. Says which it was."""
    from rlcli.errors import RlcliError
    from rlcli.rl.evaluations import read_evaluation

    name = checkpoint.resolve().name
    try:
        page.evaluation = read_evaluation(run, name)
        if page.evaluation is not None:
            return "stored"
        if not allowed:
            page.missing["evaluation"] = f"There is no evaluation: `rlcli eval --checkpoint {run.folder}` makes one."
            return ""
        console.info(f"evaluating {_EPISODES} episodes")
        page.evaluation = _evaluated(stage.session())
    except RlcliError as error:
        page.missing["evaluation"] = f"There is no evaluation: {_said(error)}"
        return ""
    return "made"


def _evaluated(session: Session) -> dict[str, Any]:
    """What `rlcli eval` says of it, kept in the run likewise."""
    from rlcli.cli.eval import keep
    from rlcli.cli.session import run_episodes

    summary, _ = run_episodes(session, _EPISODES, None, "all")
    said = {
        "checkpoint": str(session.checkpoint),
        "policy": "trained",
        "stochastic": False,
        "seed": session.seed,
        "num_envs": session.env.num_envs,
        **summary,
    }
    if session.as_trained:
        keep(session, said)
    return said


def _film(page: Page, run: Run, checkpoint: Path, stage: _Stage) -> str:
    """Put a video on the page: the checkpoint's in the run, else a new one, else an older one of the run."""
    from rlcli.errors import RlcliError

    name = checkpoint.resolve().name
    file = run.folder / "videos" / f"{name}.mp4"
    try:
        if (video := _read(run, file)) is not None:
            page.video, page.video_of = video, f"Checkpoint {name}."
            return "stored"
        page.video = _filmed(run, file, stage)
        page.video_of = f"Checkpoint {name}, environment 0, deterministic policy."
    except RlcliError as error:
        return _older(page, run, _said(error))
    return "made"


def _filmed(run: Run, file: Path, stage: _Stage) -> bytes | None:
    from rlcli.rl.run import require_own
    from rlcli.viewer.writer import check_video

    check_video(file)
    require_own(run, "videos")
    session = stage.session()

    from rlcli.viewer.clip import film

    frames, fps, backend = film(session.env, session.act, file, longest_s=_LONGEST_S)
    console.info(f"{file}: {frames} frames, {fps:g} a second, drawn with {backend}")
    return _read(run, file)


def _older(page: Page, run: Run, why: str) -> str:
    from rlcli.errors import RlcliError

    folder = run.folder / "videos"
    names = sorted(file.name for file in folder.glob("*.mp4")) if folder.is_dir() else []
    for name in reversed(names):
        try:
            page.video = _read(run, folder / name)
        except RlcliError:
            continue
        page.video_of = f"{name.removesuffix('.mp4')}; of the newest checkpoint there is none: {why}"
        return "older"
    page.missing["video"] = f"There is no video: {why}"
    return ""


def _read(run: Run, file: Path) -> bytes | None:
    """A video of the run; None if it is not there.

    Raises:
        CheckpointError: if it is no video, not the run's own, or too large for a page.
    """
    from rlcli.errors import CheckpointError
    from rlcli.rl.reading import read_file
    from rlcli.rl.run import require_inside

    try:
        require_inside(run.folder, file)
        data = read_file(file, _LARGEST)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror or error}") from None
    if data[4:8] != b"ftyp":
        raise CheckpointError(f"{file} is no MP4")
    return data


def _said(error: Any) -> str:
    text = " ".join(error.message.split()) + (f" ({error.hint})" if error.hint else "")
    return text if text.endswith((".", ")")) else f"{text}."
