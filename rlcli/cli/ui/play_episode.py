"""Repetition of one episode of an evaluation, for `rlcli play --env E --episode K`.

The episode is shown in a viewer, filmed, recorded, or printed as a table.
"""

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

    from rlcli.envs.step_result import StepResult
    from rlcli.evaluation.session import Session
    from rlcli.replay.episode_from_seed import EpisodeStart
    from rlcli.viewer.offscreen import Renderer
    from rlcli.viewer.video_writer import VideoWriter

_MAX_REASONS = 6
"""Largest number of reasons in one message, which lists why earlier episodes of the environment had to run first."""


def check_choice(
    env: int | None, episode: int | None, num_envs: int | None, record_mode: str, commands: Mapping[str, float]
) -> None:
    """Check, before anything is built, that --env and --episode name one episode and fit the other options.

    Raises:
        UsageError: if one of the two is missing, --num-envs is too small, or --record-mode or --command is given.
    """
    if env is None or episode is None:
        given, missing = ("--episode", "--env") if env is None else ("--env", "--episode")
        raise UsageError(f"{given} needs {missing} too", hint="for example: --env 317 --episode 12, counted from 0")
    if num_envs is not None and num_envs <= env:
        raise UsageError(
            f"--env {env} does not exist: --num-envs is {num_envs}, and environments are counted from 0",
            hint=f"give --num-envs {env + 1}, or leave out --num-envs",
        )
    if record_mode != "all":
        raise UsageError("--env and --episode choose one episode; leave out --record-mode, which chooses several")
    if commands:
        raise UsageError(
            "--command would change the episode that --env and --episode choose",
            hint="leave out --command, or --env and --episode",
        )


def play_episode(
    session: Session,
    env_id: int,
    episode: int,
    *,
    video: Path | None,
    record: Path | None,
    watch: Callable[[], bool],
) -> None:
    """Repeat one episode of an evaluation and show it.

    Args:
        session: environments and policy.
        env_id: the environment of the episode.
        episode: index of the episode in this environment, from 0.
        video: file for the video of the episode.
        record: file to record the episode to.
        watch: opens a viewer at the start of the episode; returns whether one could be opened.
    """
    from rlcli.evaluation.session import save_episodes
    from rlcli.replay.episode_from_seed import run_episode, start_episode
    from rlcli.replay.episode_recorder import EpisodeRecorder

    policy = session.policy
    random_actions = policy.stochastic or policy.kind == "random"
    start = start_episode(session.env, session.act, env_id, episode, drawn_actions=random_actions)
    _print_origin(session, start, env_id, episode)
    if video is None and record is None:
        session.start = (env_id, start.obs)
        if watch():
            return
    frames, recorder = 0, None
    if video is not None:
        with film(session, video, env_id) as filming:
            last = run_episode(session.env, filming.act, start.obs, env_id)
        frames, fps, backend = filming.writer.frames, filming.writer.fps, filming.renderer.backend
        console.info(f"{frames} frames at {fps:g} per second, rendered with {backend}")
    elif record is not None:
        with session.env.observers.added(EpisodeRecorder(session.env, 1, env_id=env_id)) as recorder:
            last = run_episode(session.env, session.act, start.obs, env_id)
    else:
        last = run_episode(session.env, session.act, start.obs, env_id)
    outcome, origin = _outcome(last, env_id), _origin(session, start, env_id, episode)
    _print_outcome(outcome)
    if video is not None:
        console.data(str(video))
    recorded, unsaved = save_episodes(recorder, record, "all")
    files = {"video": None if video is None else str(video), "frames": frames, "recorded": recorded}
    console.document("play", **origin, **outcome, **files)
    if unsaved is not None:
        raise unsaved


def _print_origin(session: Session, start: EpisodeStart, env_id: int, episode: int) -> None:
    policy = session.policy
    checkpoint = f" --checkpoint {shlex.quote(str(policy.checkpoint))}" if policy.checkpoint else ""
    evaluation = f"rlcli eval{checkpoint} --num-envs {session.env.num_envs} --seed {policy.seed}"
    console.info(f"episode {episode} of environment {env_id} of {evaluation}")
    if start.episodes_before:
        names, more = ", ".join(start.reasons[:_MAX_REASONS]), len(start.reasons) - _MAX_REASONS
        causes = f"{names} and {more} more" if more > 0 else names
        count = start.episodes_before
        earlier, affect = (
            (f"{count} earlier episodes", "they affect") if count > 1 else ("1 earlier episode", "it affects")
        )
        console.info(f"first ran {earlier} of this environment, because {affect} this episode through {causes}")


def _origin(session: Session, start: EpisodeStart, env_id: int, episode: int) -> dict[str, Any]:
    """Return JSON data that identify the repeated episode; warn if it depends on the number of environments.

    An episode depends on --num-envs if the task draws from a random generator that all environments share. This is
    known only after the episode, so call this function then.
    """
    shared = start.shared_draws()
    if shared:
        console.warn(
            "the task uses the global random generator of torch, numpy or Python, which all environments share:"
            f" the episode is only the same with --num-envs {session.env.num_envs}"
        )
    policy = session.policy.record()
    return {
        **{name: policy[name] for name in ("checkpoint", "chosen")},
        **{"env": env_id, "episode": episode, "seed": session.policy.seed, "num_envs": session.env.num_envs},
        **{"lived_before": start.episodes_before, "because_of": start.reasons, "shared_draws": shared},
    }


@dataclass(slots=True)
class FilmedPolicy:
    """Wrapper around a policy that renders a video frame every `stride` steps, before the policy acts."""

    session: Session
    env_id: int
    stride: int
    """Environment steps between two frames."""
    renderer: Renderer
    writer: VideoWriter
    ended: bool = False
    """Whether the video is complete, so that no more frames are rendered."""

    @property
    def length_s(self) -> float:
        """Simulated time of the frames so far [s]."""
        return self.writer.frames / self.writer.fps

    def act(self, obs: Tensor) -> Tensor:
        """Render the state if a frame is due; return the action (num_envs, action_size). obs: (num_envs, obs_size)"""
        env = self.session.env
        if not self.ended and int(env.episode_length_buf[self.env_id]) % self.stride == 0:
            self.writer.add(self.renderer.image(env, self.env_id))
        return self.session.act(obs)


@contextlib.contextmanager
def film(session: Session, file: Path, env_id: int = 0, drawn: int = 1) -> Iterator[FilmedPolicy]:
    """Open a video of the environments in which a policy acts.

    Args:
        session: environments and policy.
        file: an .mp4 or .gif; it is created when the video is complete.
        env_id: the environment in the foreground.
        drawn: number of environments in the image.

    Yields:
        The policy; each call of its `act` adds a frame to the video, if one is due.
    """
    from rlcli.viewer.env_grid import EnvGrid
    from rlcli.viewer.record_video import open_video

    env = session.env
    with open_video(env.engine.model, env.config, file, EnvGrid(env, drawn)) as (renderer, writer, stride):
        yield FilmedPolicy(session, env_id, stride, renderer, writer)


def _outcome(last: StepResult, env_id: int) -> dict[str, Any]:
    """Return the result of the repeated episode (length, return, end) as JSON data."""
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
        "conditions": {name: bool(held[row]) for name, held in ended.conditions.items()},
        "condition_values": {name: float(values[row]) for name, values in ended.condition_values.items()},
    }


def _print_outcome(outcome: dict[str, Any]) -> None:
    rows = [["length [steps]", str(outcome["length"])], ["return", f"{outcome['return']:.6g}"]]
    rows += [[f"reward {name}", f"{value:.6g}"] for name, value in outcome["reward_terms"].items()]
    rows.append(["ended by", ", ".join(outcome["ended_by"])])
    if outcome["success"] is not None:
        rows.append(["success", "yes" if outcome["success"] else "no"])
    for name, held in outcome["conditions"].items():
        value = outcome["condition_values"].get(name)
        rows.append([f"success: {name}", ("held" if held else "failed") + ("" if value is None else f", {value:.4g}")])
    console.table(["", "EPISODE"], rows)
