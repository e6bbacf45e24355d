"""Add an evaluation and a video to the HTML report of a run.

Both are read from the run's folder; if they are missing there, the policy is evaluated and a video is recorded.
"""

import logging
from functools import cached_property
from pathlib import Path

from rlcli.errors import CheckpointError, RlcliError
from rlcli.evaluation import session as sessions
from rlcli.reporting.run_page_content import Page, reason_of
from rlcli.runs.eval_store import read_evaluation
from rlcli.runs.run import Run, require_own
from rlcli.runs.safe_io import read_errors, read_file, require_inside

_log = logging.getLogger(__name__)

_EPISODES = 200
"""Number of episodes of an evaluation that is made for a report."""
_MAX_VIDEO_S = 20.0
"""Largest length of a video that is made for a report [s]."""
_MAX_VIDEO_BYTES = 24 * 2**20
"""Size limit of the video in a report [bytes]."""


class PageMedia:
    """Reader, or maker, of the evaluation and the video of a checkpoint, which are added to a report.

    The environment is built only if one of them is missing in the run.

    Args:
        page: the report to which evaluation and video are added.
        run: the run.
        checkpoint: the checkpoint's folder.
        schema: version of the command line's JSON documents, for an evaluation that is saved in the run.
    """

    def __init__(self, page: Page, run: Run, checkpoint: Path, schema: int) -> None:
        self._page, self._run, self._checkpoint, self._schema = page, run, checkpoint, schema
        self._name = checkpoint.resolve().name

    def add_evaluation(self, *, may_evaluate: bool) -> str:
        """Add the run's saved evaluation to the page, or evaluate the policy and save the result in the run.

        An error becomes the reason on the page why there is no evaluation.

        Args:
            may_evaluate: whether the policy is evaluated if the run has no saved evaluation.

        Returns:
            `stored` (saved in the run); `made` (evaluated now); an empty text if there is no evaluation.
        """
        page = self._page
        try:
            page.evaluation = read_evaluation(self._run, self._name)
            if page.evaluation is not None:
                return "stored"
            if not may_evaluate:
                command = f"rlcli eval --checkpoint {self._run.folder}"
                page.missing["evaluation"] = f"There is no evaluation. Run `{command}` to make one."
                return ""
            _log.info(f"evaluating {_EPISODES} episodes")
            summary, _ = sessions.run_episodes(self._session, _EPISODES)
            page.evaluation = sessions.evaluation_record(self._session, summary)
            sessions.save_evaluation(self._session, {"schema": self._schema, "command": "eval", **page.evaluation})
        except RlcliError as error:
            page.missing["evaluation"] = f"There is no evaluation: {reason_of(error)}"
            return ""
        return "made"

    def add_video(self) -> str:
        """Add the run's saved video of the checkpoint to the page, or record one and save it in the run.

        If neither is possible, the newest saved video of another checkpoint is added.

        Returns:
            `stored` (saved in the run); `made` (recorded now); `older` (saved, of another checkpoint); an empty text
            if there is no video.
        """
        page, file = self._page, self._run.folder / "videos" / f"{self._name}.mp4"
        try:
            page.video = self._read_video(file)
            if page.video is not None:
                page.video_of = f"Checkpoint {self._name}."
                return "stored"
            page.video = self._record_video(file)
            page.video_of = f"Checkpoint {self._name}, environment 0, deterministic policy."
        except RlcliError as error:
            return self._add_older_video(reason_of(error))
        return "made"

    @cached_property
    def _session(self) -> sessions.Session:
        return sessions.open_session(sessions.PolicyRequest(None, checkpoint=str(self._checkpoint)))

    def _record_video(self, file: Path) -> bytes | None:
        from rlcli.viewer.video_writer import check_video

        check_video(file)
        require_own(self._run, "videos")
        session = self._session  # imports torch and MuJoCo: after the checks above

        from rlcli.viewer.record_video import record_episode

        frames, fps, backend = record_episode(session.env, session.act, file, longest_s=_MAX_VIDEO_S)
        _log.info(f"{file}: {frames} frames, {fps:g} a second, rendered with {backend}")
        return self._read_video(file)

    def _add_older_video(self, why: str) -> str:
        folder = self._run.folder / "videos"
        for file in sorted(folder.glob("*.mp4"), reverse=True) if folder.is_dir() else []:
            try:
                self._page.video = self._read_video(file)
            except RlcliError:
                continue
            self._page.video_of = f"Checkpoint {file.stem}. The newest checkpoint has no video: {why}"
            return "older"
        self._page.missing["video"] = f"There is no video: {why}"
        return ""

    def _read_video(self, file: Path) -> bytes | None:
        """Return the content of a video file of the run; None if the file does not exist.

        Raises:
            CheckpointError: if the file is not an MP4, is outside the run's folder, or is too large for a page.
        """
        try:
            with read_errors(file):
                require_inside(self._run.folder, file)
                data = read_file(file, _MAX_VIDEO_BYTES)
        except FileNotFoundError:
            return None
        if data[4:8] != b"ftyp":
            raise CheckpointError(f"{file} is not an MP4 video; move the file out of the run's folder")
        return data
