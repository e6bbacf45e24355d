"""What play and eval share: which run and checkpoint, which policy, and the environment they act in."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rlcli.cli.console import console
from rlcli.cli.options import flags, tell_notes

POLICIES = ("trained", "zero", "random", "lqr")


@dataclass(frozen=True, slots=True)
class Subject:
    """A policy in a task, found and checked, and not yet built."""

    resolved: Any
    run: Any
    checkpoint: Path | None
    chosen: str | None
    """Why this checkpoint."""
    policy: str
    stochastic: bool
    seed: int
    as_trained: bool
    """Whether it is a checkpoint in its own run, in the task as the run has it."""


@dataclass(slots=True)
class Session:
    """An environment with a policy in it."""

    env: Any
    act: Any
    run: Any
    """The run of the checkpoint; None for a policy without one."""
    checkpoint: Path | None
    chosen: str | None
    """Why this checkpoint."""
    resolved: Any
    policy: str
    """One of POLICIES."""
    seed: int
    as_trained: bool
    begun: tuple[int, Any] | None = None
    """An environment to watch, and the observations of all where they stand; None: from the beginning."""


def find_subject(
    task: str | None,
    overrides: list[str],
    *,
    checkpoint: str | None,
    policy: str,
    stochastic: bool = False,
    num_envs: int | None,
    seed: int,
    config: Path | None,
    runs_dir: Path | None,
    check: Callable[[Any], None] = lambda resolved: None,
    at_least: int = 1,
) -> Subject:
    """Find and check; nothing heavy is imported.

    `check` gets the configuration and may raise; environments there are `at_least` so many.
    """
    from rlcli.config.load import resolve
    from rlcli.errors import UsageError
    from rlcli.rl.run import default_runs_dir

    require_policy(policy)
    if task is not None and "=" in task:
        overrides, task = [task, *overrides], None
    if task is None and checkpoint is None:
        raise UsageError("play what?", hint="a TASK, or --checkpoint RUN|latest")
    values = flags(scene__num_envs=num_envs)
    run = folder = why = None
    as_trained = False
    configure: Callable[..., Any]
    if policy == "trained" or checkpoint is not None:
        from rlcli.rl.choice import choose

        named = None if task is None else task_named(task, runs_dir)
        choice = choose(checkpoint, runs_dir or default_runs_dir(), named, tell=console.warn)
        run, folder, why = choice.run, choice.folder, choice.why
        console.info(f"checkpoint {folder} ({why})")
        configure = partial(choice.configure, named, config_file=config, overrides=overrides)
        own = run is not None and folder.resolve().parent == run.checkpoints.resolve()
        as_trained = own and policy == "trained" and not overrides and config is None
    else:
        assert task is not None
        configure = partial(resolve, task_named(task, runs_dir), play=True, config_file=config, overrides=overrides)
    resolved = configure(flags=values)
    if resolved.task.scene.num_envs < at_least:
        resolved = configure(flags={**values, "scene.num_envs": at_least})
    check(resolved)
    tell_notes(resolved)
    return Subject(resolved, run, folder, why, policy, stochastic, seed, as_trained)


def task_named(task: str, runs_dir: Path | None) -> Any:
    """The task that the user names; where a run is named instead, that is said."""
    from rlcli.errors import TaskError
    from rlcli.rl.run import default_runs_dir
    from rlcli.rl.trust import named_task

    try:
        return named_task(task)
    except TaskError:
        require_no_run(task, runs_dir or default_runs_dir())
        raise


def require_no_run(task: str, runs_dir: Path) -> None:
    """Refuse a run where a task should be named."""
    from rlcli.errors import CheckpointError, TaskError
    from rlcli.rl.run import find_run

    with contextlib.suppress(CheckpointError):
        find_run(task.partition("@")[0], runs_dir)
        raise TaskError(f"'{task}' is a run, not a task", hint=f"--checkpoint {task}")


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

    `check` gets the configuration and may raise; environments there are `at_least` so many.
    """
    subject = find_subject(
        task,
        overrides,
        checkpoint=checkpoint,
        policy=policy,
        stochastic=stochastic,
        num_envs=num_envs,
        seed=seed,
        config=config,
        runs_dir=runs_dir,
        check=check,
        at_least=at_least,
    )
    session = _build(subject)
    from rlcli.rl.dump import Watch
    from rlcli.rl.run import default_runs_dir

    home = runs_dir or default_runs_dir() if subject.run is None else subject.run.folder
    Watch(session.env, home / "dumps", console.warn)
    return session


def require_policy(policy: str) -> None:
    """There must be such a policy.

    Raises:
        UsageError: naming those that there are.
    """
    from rlcli.errors import UsageError, did_you_mean

    if policy not in POLICIES:
        raise UsageError(
            f"no policy '{policy}'", hint=did_you_mean(policy, POLICIES) or f"policies: {', '.join(POLICIES)}"
        )


def baseline(subject: Subject, policy: str) -> Subject:
    """Another policy in the same task, one that needs no checkpoint.

    Raises:
        UsageError: if there is no such policy.
    """
    from rlcli.errors import UsageError

    require_policy(policy)
    if policy == "trained":
        raise UsageError("--against trained: it is compared with what needs no training", hint="lqr, zero or random")
    return replace(subject, policy=policy, stochastic=False, as_trained=False)


def names_run(word: str, runs_dir: Path | None) -> bool:
    """Whether a word stands for a run or a checkpoint, and not for a task."""
    from rlcli.rl.run import RECORD, default_runs_dir, list_runs

    runs = runs_dir or default_runs_dir()
    name = word if Path(word).exists() else word.partition("@")[0]
    if name == "latest" or (Path(word) / "manifest.json").is_file():
        return True
    if any((folder / RECORD).is_file() for folder in (Path(name), runs / name)):
        return True
    return any(run.folder.name == name for run in list_runs(runs, None))


def actor(subject: Subject) -> Callable[[Any], Any]:
    """What puts the policy into an environment; its files are read once, whatever the number of environments."""
    import torch

    from rlcli.random import derive
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.load import policy_of, require_fit
    from rlcli.rl.rollout import acting, random_policy, zero_policy

    torch.set_num_threads(1)
    agent, seed = subject.resolved.agent, derive(subject.seed, "play")
    bound = agent.action_bound if agent else 1.0
    if subject.policy == "zero":
        return zero_policy
    if subject.policy == "random":
        return lambda env: random_policy(env, bound, seed)
    if subject.policy == "lqr":
        from rlcli.rl.lqr import regulator

        return regulator(subject.resolved, bound).acting
    assert subject.checkpoint is not None
    checkpoint = open_checkpoint(subject.checkpoint)
    trained = policy_of(checkpoint)

    def act(env: Any) -> Any:
        require_fit(checkpoint, env.layout)
        generator = torch.Generator().manual_seed(seed)
        return acting(env, trained, stochastic=subject.stochastic, generator=generator)

    return act


def _build(subject: Subject) -> Session:
    from rlcli.envs.vec_env import make_env
    from rlcli.random import derive
    from rlcli.rl.rng import seed_generators

    put = actor(subject)
    # evaluation sees other episodes than training did
    seed_generators(derive(subject.seed, "task"))  # some tasks draw from them
    env = make_env(subject.resolved, seed=derive(subject.seed, "evaluation"))
    return Session(
        env=env,
        act=put(env),
        run=subject.run,
        checkpoint=subject.checkpoint,
        chosen=subject.chosen,
        resolved=subject.resolved,
        policy=subject.policy,
        seed=subject.seed,
        as_trained=subject.as_trained,
    )


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
