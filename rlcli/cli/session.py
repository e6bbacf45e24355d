"""What play and eval share: which run and checkpoint, which policy, and the environment they act in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.cli.console import console
from rlcli.cli.options import flags, tell_notes

POLICIES = ("trained", "zero", "random")


@dataclass(slots=True)
class Session:
    """An environment with a policy in it."""

    env: Any
    act: Any
    run: Any
    checkpoint: Path | None
    resolved: Any


def open_session(
    task: str | None,
    overrides: list[str],
    *,
    checkpoint: str | None,
    policy: str,
    stochastic: bool,
    num_envs: int | None,
    seed: int,
    config: Path | None,
    runs_dir: Path | None,
    check: Callable[[Any], None] = lambda resolved: None,
    at_least: int = 1,
) -> Session:
    """Find, check and build; heavy imports begin only when files and configuration are in order.

    `check` gets the configuration and may raise; of environments there are `at_least` so many.
    """
    from rlcli.config.load import resolve
    from rlcli.errors import UsageError, did_you_mean
    from rlcli.rl.load import resolve_run
    from rlcli.rl.run import default_runs_dir, find_checkpoint
    from rlcli.rl.trust import named_task

    if policy not in POLICIES:
        raise UsageError(
            f"no policy '{policy}'", hint=did_you_mean(policy, POLICIES) or f"policies: {', '.join(POLICIES)}"
        )
    if task is not None and "=" in task:
        overrides, task = [task, *overrides], None
    if task is None and checkpoint is None:
        raise UsageError("play what?", hint="a TASK, or --checkpoint RUN|latest")
    values = flags(scene__num_envs=num_envs)
    run = folder = None
    if policy == "trained" or checkpoint is not None:
        named = None if task is None else named_task(task)
        name = None if named is None else named.name
        runs = runs_dir or default_runs_dir()
        run, folder, why = find_checkpoint(checkpoint or "latest", runs, name, tell=console.warn)
        console.info(f"checkpoint {folder} ({why})")
        the_run = run

        def configure(values: Any) -> Any:
            return resolve_run(the_run, play=True, config_file=config, overrides=overrides, flags=values, named=named)
    else:
        assert task is not None
        source = named_task(task)

        def configure(values: Any) -> Any:
            return resolve(source, play=True, config_file=config, overrides=overrides, flags=values)

    resolved = configure(values)
    if resolved.task.scene.num_envs < at_least:
        resolved = configure({**values, "scene.num_envs": at_least})
    check(resolved)
    tell_notes(resolved)
    session = _build(resolved, run, folder, policy, stochastic, seed)
    from rlcli.rl.dump import Watch

    home = runs_dir or default_runs_dir() if run is None else run.folder
    Watch(session.env, home / "dumps", console.warn)
    return session


def _build(resolved: Any, run: Any, folder: Path | None, policy: str, stochastic: bool, seed: int) -> Session:
    import torch

    from rlcli.envs.vec_env import make_env
    from rlcli.random import derive
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.load import policy_of, require_fit
    from rlcli.rl.rng import seed_generators
    from rlcli.rl.rollout import acting, random_policy, zero_policy

    torch.set_num_threads(1)
    trained, checkpoint = None, None
    if policy == "trained":
        assert folder is not None
        checkpoint = open_checkpoint(folder)
        trained = policy_of(checkpoint)
    # evaluation sees other episodes than training did
    seed_generators(derive(seed, "task"))  # some tasks draw from them
    env = make_env(resolved, seed=derive(seed, "evaluation"))
    if checkpoint is not None and trained is not None:
        require_fit(checkpoint, env.layout)
        generator = torch.Generator().manual_seed(derive(seed, "play"))
        act = acting(env, trained, stochastic=stochastic, generator=generator)
    elif policy == "zero":
        act = zero_policy(env)
    else:
        act = random_policy(env, resolved.agent.action_bound if resolved.agent else 1.0, derive(seed, "play"))
    return Session(env, act, run, folder, resolved)


def check_record(record: Path | None, mode: str) -> None:
    """Refuse, before anything is built, what cannot be recorded.

    Raises:
        UsageError: for a mode that there is not.
        MachineError: if the folder is not there.
    """
    from rlcli.errors import MachineError, UsageError, did_you_mean

    modes = ("all", "succeeded", "failed", "separate")
    if mode not in modes:
        raise UsageError(f"no --record-mode '{mode}'", hint=did_you_mean(mode, modes) or f"modes: {', '.join(modes)}")
    if record is None:
        return
    if record.is_dir():
        raise UsageError(f"--record {record} is a folder", hint=f"give a file: {record / 'episodes.safetensors'}")
    if not record.absolute().parent.is_dir():
        raise MachineError(f"--record: there is no folder {record.absolute().parent}")


def run_episodes(session: Session, episodes: int, record: Path | None, mode: str) -> tuple[dict[str, Any], list[str]]:
    """Evaluate, and record if asked to: the summary, and the files that were written."""
    from rlcli.rl.rollout import evaluate

    if record is None:
        return evaluate(session.env, session.act, episodes).summary(), []
    from rlcli.rl.recording import Recorder

    with Recorder(session.env, session.act, episodes) as recorder:
        summary = evaluate(session.env, recorder.act, episodes, recorder.on_step).summary()
    files = [str(file) for file in recorder.save(record, mode)]
    console.info(f"recorded {len(recorder.episodes)} episodes to {' and '.join(files)}")
    return summary, files
