"""`rlcli play --env E --episode K`: one episode of an evaluation again, as numbers, video, recording or in a window."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.console import console

if TYPE_CHECKING:
    from rlcli.rl.regenerate import Begun


def check_choice(
    env: int | None, episode: int | None, num_envs: int | None, record_mode: str, commands: Mapping[str, float]
) -> None:
    """Refuse, before anything is built, what does not name one episode.

    Raises:
        UsageError: if that is so.
    """
    from rlcli.errors import UsageError

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
    session: Any,
    who: int,
    episode: int,
    *,
    stochastic: bool,
    video: Path | None,
    record: Path | None,
    watch: Callable[[], bool],
) -> None:
    """Bring it about, and show it: `watch` opens a viewer where the session stands, and says whether there was one."""
    from rlcli.rl.recording import Recorder
    from rlcli.rl.regenerate import begin_episode, live_episode

    env = session.env
    drawn = stochastic or session.policy == "random"
    begun = begin_episode(env, session.act, who, episode, drawn_actions=drawn)
    _tell_origin(session, begun, who, episode)
    if video is None and record is None:
        session.begun = (who, begun.obs)
        if watch():
            return
    frames, recorded = 0, []
    if video is not None:
        last, frames = _filmed(session, begun, who, video)
    elif record is not None:
        with Recorder(env, session.act, 1, only=who) as recorder:
            last = live_episode(env, recorder.act, begun.obs, who, recorder.on_step)
        recorded = [str(file) for file in recorder.save(record)]
        console.info(f"recorded to {recorded[0]}")
    else:
        last = live_episode(env, session.act, begun.obs, who)
    facts = _facts(last, who)
    shared = begun.shared_draws()
    if shared:
        console.warn(
            "the task draws from torch's, numpy's or Python's own generator, which all environments share: with another"
            f" --num-envs than {env.num_envs} the episode is another"
        )
    _show(facts)
    if video is not None:
        console.data(str(video))
    console.document(
        "play",
        checkpoint=str(session.checkpoint) if session.checkpoint else None,
        chosen=session.chosen,
        env=who,
        episode=episode,
        seed=session.seed,
        num_envs=env.num_envs,
        lived_before=begun.lived,
        because_of=begun.carried,
        shared_draws=shared,
        **facts,
        video=None if video is None else str(video),
        frames=frames,
        recorded=recorded,
    )


def _tell_origin(session: Any, begun: Begun, who: int, episode: int) -> None:
    of = f" --checkpoint {shlex.quote(str(session.checkpoint))}" if session.checkpoint else ""
    evaluation = f"rlcli eval{of} --num-envs {session.env.num_envs} --seed {session.seed}"
    console.info(f"episode {episode} of environment {who} of {evaluation}")
    if begun.lived:
        console.info(f"lived after the {begun.lived} before it, which reach into it by {_listed(begun.carried)}")


def _listed(names: list[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _filmed(session: Any, begun: Begun, who: int, file: Path) -> tuple[Any, int]:
    from rlcli.rl.regenerate import live_episode
    from rlcli.viewer.video import Renderer
    from rlcli.viewer.writer import VideoWriter

    env = session.env
    stride = max(1, env.config.sim.render_interval // env.config.decimation)
    with Renderer(env.engine.model, env.config.viewer) as renderer, VideoWriter(file, stride * env.step_dt) as writer:

        def act(obs: Any) -> Any:
            if int(env.episode_length_buf[who]) % stride == 0:
                writer.add(renderer.picture(env, who))
            return session.act(obs)

        last = live_episode(env, act, begun.obs, who)
    console.info(f"{writer.frames} frames at {writer.fps:g} a second, drawn with {renderer.backend}")
    return last, writer.frames


def _facts(last: Any, who: int) -> dict[str, Any]:
    """How the episode ended."""
    ended = last.episodes.ended()
    row = ended.ids.tolist().index(who)
    return {
        "length": int(ended.lengths[row]),
        "return": float(ended.returns[row]),
        "reward_terms": {name: float(values[row]) for name, values in ended.reward_terms.items()},
        "ended_by": [name for name, fired in ended.causes.items() if bool(fired[row])],
        "truncated": bool(ended.truncated[row]),
        "success": None if ended.success is None else bool(ended.success[row]),
    }


def _show(facts: dict[str, Any]) -> None:
    rows = [["length [steps]", str(facts["length"])], ["return", f"{facts['return']:.6g}"]]
    rows += [[f"reward {name}", f"{value:.6g}"] for name, value in facts["reward_terms"].items()]
    rows.append(["ended by", ", ".join(facts["ended_by"])])
    if facts["success"] is not None:
        rows.append(["success", "yes" if facts["success"] else "no"])
    console.table(["", "EPISODE"], rows)
