"""`rlcli play --env E --episode K`: one episode of an evaluation again, as numbers, video, recording or in a window."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.ui.console import console
from rlcli.errors import UsageError

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.envs.step import StepResult
    from rlcli.evaluation.session import Session
    from rlcli.replay.rerun_episode import EpisodeStart
    from rlcli.viewer.offscreen import Renderer
    from rlcli.viewer.video_writer import VideoWriter

_MOST_NAMES = 6


def check_choice(
    env: int | None, episode: int | None, num_envs: int | None, record_mode: str, commands: Mapping[str, float]
) -> None:
    """Refuse, before anything is built, what does not name one episode.

    Raises:
        UsageError: if that is so.
    """
    if env is None or episode is None:
        given, missing = ("--episode", "--env") if env is None else ("--env", "--episode")
        raise UsageError(f"{given} needs {missing}", hint="--env 317 --episode 12 is one episode, both counted from 0")
    if num_envs is not None and num_envs <= env:
        raise UsageError(f"there is no environment {env} of {num_envs}", hint=f"--num-envs {env + 1}, or leave it out")
    if record_mode != "all":
        raise UsageError("--record-mode chooses among episodes, and this is one")
    if commands:
        raise UsageError("--command makes another episode of it", hint="leave out --env and --episode, or --command")


def play_episode(
    session: Session,
    env_id: int,
    episode: int,
    *,
    video: Path | None,
    record: Path | None,
    watch: Callable[[], bool],
) -> None:
    """Run one episode of an evaluation again and show it.

    Args:
        session: environments and policy.
        env_id: the environment whose episode it is.
        episode: its number, from 0.
        video: file to draw it to.
        record: file to record it to.
        watch: opens a viewer where the session stands; whether there was one.
    """
    from rlcli.replay.rerun_episode import run_episode, start_episode

    policy = session.policy
    random_actions = policy.stochastic or policy.kind == "random"
    start = start_episode(session.env, session.act, env_id, episode, drawn_actions=random_actions)
    _show_origin(session, start, env_id, episode)
    if video is None and record is None:
        session.start = (env_id, start.obs)
        if watch():
            return
    frames = 0
    recorded: list[str] = []
    if video is not None:
        last, frames = _film(session, start, env_id, video)
    elif record is not None:
        last, recorded = _record(session, start, env_id, record)
    else:
        last = run_episode(session.env, session.act, start.obs, env_id)
    outcome, origin = _outcome(last, env_id), _origin(session, start, env_id, episode)
    _show_outcome(outcome)
    if video is not None:
        console.data(str(video))
    files = {"video": None if video is None else str(video), "frames": frames, "recorded": recorded}
    console.document("play", **origin, **outcome, **files)


def _show_origin(session: Session, start: EpisodeStart, env_id: int, episode: int) -> None:
    policy = session.policy
    checkpoint = f" --checkpoint {shlex.quote(str(policy.checkpoint))}" if policy.checkpoint else ""
    evaluation = f"rlcli eval{checkpoint} --num-envs {session.env.num_envs} --seed {policy.seed}"
    console.info(f"episode {episode} of environment {env_id} of {evaluation}")
    if start.episodes_before:
        names, more = ", ".join(start.reasons[:_MOST_NAMES]), len(start.reasons) - _MOST_NAMES
        causes = f"{names} and {more} more" if more > 0 else names
        console.info(f"lived after the {start.episodes_before} before it, which reach into it by {causes}")


def _origin(session: Session, start: EpisodeStart, env_id: int, episode: int) -> dict[str, Any]:
    """Which episode it is, as JSON; call it after the episode has run."""
    shared = start.shared_draws()
    if shared:
        console.warn(
            "the task draws from torch's, numpy's or Python's own generator, which all environments share: with another"
            f" --num-envs than {session.env.num_envs} the episode is another"
        )
    policy = session.policy.record()
    return {
        "checkpoint": policy["checkpoint"],
        "chosen": policy["chosen"],
        "env": env_id,
        "episode": episode,
        "seed": session.policy.seed,
        "num_envs": session.env.num_envs,
        "lived_before": start.episodes_before,
        "because_of": start.reasons,
        "shared_draws": shared,
    }


def _record(session: Session, start: EpisodeStart, env_id: int, file: Path) -> tuple[StepResult, list[str]]:
    from rlcli.replay.episode_recorder import EpisodeRecorder
    from rlcli.replay.rerun_episode import run_episode

    with EpisodeRecorder(session.env, 1, env_id=env_id) as recorder:
        last = run_episode(session.env, session.act, start.obs, env_id)
    recorded = [str(written) for written in recorder.save(file)]
    console.info(f"recorded to {recorded[0]}")
    return last, recorded


def _film(session: Session, start: EpisodeStart, env_id: int, file: Path) -> tuple[StepResult, int]:
    from rlcli.replay.rerun_episode import run_episode

    with film(session, file, env_id) as filming:
        last = run_episode(session.env, filming.act, start.obs, env_id)
    writer = filming.writer
    console.info(f"{writer.frames} frames at {writer.fps:g} a second, drawn with {filming.renderer.backend}")
    return last, writer.frames


@dataclass(slots=True)
class Filming:
    """A policy that draws the states in which it acts."""

    session: Session
    env_id: int
    stride: int
    """Steps from one frame to the next."""
    renderer: Renderer
    writer: VideoWriter
    ended: bool = False
    """Nothing more is drawn."""

    @property
    def length_s(self) -> float:
        """Simulated time of the frames so far [s]."""
        return self.writer.frames * self.stride * self.session.env.step_dt

    def act(self, obs: Tensor) -> Tensor:
        """Draw the state if a frame is due, and act in it."""
        env = self.session.env
        if not self.ended and int(env.episode_length_buf[self.env_id]) % self.stride == 0:
            self.writer.add(self.renderer.picture(env, self.env_id))
        return self.session.act(obs)


@contextlib.contextmanager
def film(session: Session, file: Path, env_id: int = 0, drawn: int = 1) -> Iterator[Filming]:
    """Open a video file for the states in which a policy acts.

    Args:
        session: environments and policy.
        file: an .mp4 or .gif; it appears when it is whole.
        env_id: the environment in the foreground.
        drawn: how many environments are in the picture.
    """
    from rlcli.viewer.env_grid import EnvGrid
    from rlcli.viewer.offscreen import Renderer
    from rlcli.viewer.video_writer import VideoWriter

    env = session.env
    stride = max(1, env.config.sim.render_interval // env.config.decimation)
    with (
        Renderer(env.engine.model, env.config.viewer, EnvGrid(env, drawn)) as renderer,
        VideoWriter(file, stride * env.step_dt) as writer,
    ):
        yield Filming(session, env_id, stride, renderer, writer)


def _outcome(last: StepResult, env_id: int) -> dict[str, Any]:
    """How the episode ended, as JSON."""
    assert last.episodes is not None
    ended = last.episodes.ended()
    row = ended.ids.tolist().index(env_id)
    return {
        "length": int(ended.lengths[row]),
        "return": float(ended.returns[row]),
        "reward_terms": {name: float(values[row]) for name, values in ended.reward_terms.items()},
        "ended_by": [name for name, fired in ended.causes.items() if bool(fired[row])],
        "truncated": bool(ended.truncated[row]),
        "success": None if ended.success is None else bool(ended.success[row]),
    }


def _show_outcome(outcome: dict[str, Any]) -> None:
    rows = [["length [steps]", str(outcome["length"])], ["return", f"{outcome['return']:.6g}"]]
    rows += [[f"reward {name}", f"{value:.6g}"] for name, value in outcome["reward_terms"].items()]
    rows.append(["ended by", ", ".join(outcome["ended_by"])])
    if outcome["success"] is not None:
        rows.append(["success", "yes" if outcome["success"] else "no"])
    console.table(["", "EPISODE"], rows)
