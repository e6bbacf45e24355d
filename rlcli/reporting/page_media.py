"""Evaluation and video of a run's page: those that the run holds, else new ones."""

from __future__ import annotations

import logging
from functools import cached_property
from pathlib import Path

from rlcli.errors import CheckpointError, RlcliError
from rlcli.evaluation.session import (
    PolicyRequest,
    Session,
    evaluation_record,
    open_session,
    run_episodes,
    save_evaluation,
)
from rlcli.reporting.run_page import Page, reason_of
from rlcli.runs.eval_store import read_evaluation
from rlcli.runs.run import Run, require_own
from rlcli.runs.safe_io import read_file, require_inside

_log = logging.getLogger(__name__)

_EPISODES = 200
_LONGEST_S = 20.0
"""Length of a video for the page, at most [s]."""
_LARGEST = 24 * 2**20
"""Size of a video in the page, at most [bytes]."""


class PageMedia:
    """Evaluation and video of one checkpoint; the environment is built when it is first needed.

    Args:
        page: the page that gets them.
        run: the run.
        checkpoint: the checkpoint's folder.
        schema: version of the documents that the command line writes.
    """

    def __init__(self, page: Page, run: Run, checkpoint: Path, schema: int) -> None:
        self._page, self._run, self._checkpoint, self._schema = page, run, checkpoint, schema
        self._name = checkpoint.resolve().name

    def add_evaluation(self, *, may_evaluate: bool) -> str:
        """Put the evaluation on the page; return where it is from: `stored`, `made` or nothing."""
        page = self._page
        try:
            page.evaluation = read_evaluation(self._run, self._name)
            if page.evaluation is not None:
                return "stored"
            if not may_evaluate:
                command = f"rlcli eval --checkpoint {self._run.folder}"
                page.missing["evaluation"] = f"There is no evaluation: `{command}` makes one."
                return ""
            _log.info(f"evaluating {_EPISODES} episodes")
            summary, _ = run_episodes(self._session, _EPISODES)
            page.evaluation = evaluation_record(self._session, summary)
            save_evaluation(self._session, {"schema": self._schema, "command": "eval", **page.evaluation})
        except RlcliError as error:
            page.missing["evaluation"] = f"There is no evaluation: {reason_of(error)}"
            return ""
        return "made"

    def add_video(self) -> str:
        """Put a video on the page; return where it is from: `stored`, `made`, `older` (checkpoint) or nothing."""
        page, file = self._page, self._run.folder / "videos" / f"{self._name}.mp4"
        try:
            page.video = self._read(file)
            if page.video is not None:
                page.video_of = f"Checkpoint {self._name}."
                return "stored"
            page.video = self._film(file)
            page.video_of = f"Checkpoint {self._name}, environment 0, deterministic policy."
        except RlcliError as error:
            return self._add_older_video(reason_of(error))
        return "made"

    @cached_property
    def _session(self) -> Session:
        return open_session(PolicyRequest(None, checkpoint=str(self._checkpoint)))

    def _film(self, file: Path) -> bytes | None:
        from rlcli.viewer.video_writer import check_video

        check_video(file)
        require_own(self._run, "videos")
        session = self._session

        from rlcli.viewer.record_video import record_episode

        frames, fps, backend = record_episode(session.env, session.act, file, longest_s=_LONGEST_S)
        _log.info(f"{file}: {frames} frames, {fps:g} a second, drawn with {backend}")
        return self._read(file)

    def _add_older_video(self, why: str) -> str:
        folder = self._run.folder / "videos"
        for file in sorted(folder.glob("*.mp4"), reverse=True) if folder.is_dir() else []:
            try:
                self._page.video = self._read(file)
            except RlcliError:
                continue
            self._page.video_of = f"{file.stem}; of the newest checkpoint there is none: {why}"
            return "older"
        self._page.missing["video"] = f"There is no video: {why}"
        return ""

    def _read(self, file: Path) -> bytes | None:
        """A video of the run; None if it is not there.

        Raises:
            CheckpointError: if it is no video, not the run's own, or too large for a page.
        """
        try:
            require_inside(self._run.folder, file)
            data = read_file(file, _LARGEST)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise CheckpointError(f"{file} cannot be read: {error.strerror or error}") from None
        if data[4:8] != b"ftyp":
            raise CheckpointError(f"{file} is no MP4")
        return data
