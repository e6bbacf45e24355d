"""Functions that find a policy and its task and build the environment, for `play`, `eval`, `stress` and `report`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.config.layers import flags
from rlcli.errors import CheckpointError, MachineError, TaskError, UsageError, require_known
from rlcli.registry.find import path_of
from rlcli.runs.atomic_io import require_regular, require_writable
from rlcli.runs.run import RECORD, Run
from rlcli.runs.run_ref import default_runs_dir, find_run, list_runs

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.config.load import Resolved
    from rlcli.envs.vec_env import VecEnv
    from rlcli.registry import TaskSource
    from rlcli.replay.episode_recorder import EpisodeRecorder
    from rlcli.rl.action_functions import Act

_log = logging.getLogger(__name__)

POLICIES = ("trained", "zero", "random", "lqr")
MAX_ENVS = 8192
"""Largest number of environments; for more episodes than this, each environment runs several, one after the other."""


@dataclass(frozen=True, slots=True)
class PolicyRequest:
    """Policy and task as the user has named them on a command line; `find_policy` looks them up."""

    task: str | None
    overrides: Sequence[str] = ()
    checkpoint: str | None = None
    policy: str = "trained"
    """One of POLICIES."""
    stochastic: bool = False
    num_envs: int | None = None
    seed: int = 42
    config: Path | None = None
    runs_dir: Path | None = None
    episodes: int | None = None
    """Number of episodes, for one environment each; None: the task's own number of environments."""
    min_envs: int = 1
    """Smallest number of environments."""
    usual_envs: int | None = None
    """Largest number of environments if neither the user nor the task's `play:` sets a number; None: no limit."""


@dataclass(frozen=True, slots=True)
class PolicyInTask:
    """Policy and task that `find_policy` has found; no environment is built yet."""

    resolved: Resolved
    run: Run | None
    """The run of the checkpoint; None for a policy that belongs to no run."""
    checkpoint: Path | None
    reason: str | None
    """Why this checkpoint was chosen."""
    kind: str
    """One of POLICIES."""
    stochastic: bool
    seed: int
    as_trained: bool
    """Whether the policy is a checkpoint of a run and the task is configured as in that run."""

    def record(self) -> dict[str, Any]:
        """Return data for JSON: `checkpoint`, `chosen` (why this checkpoint) and `policy` (one of POLICIES)."""
        checkpoint = str(self.checkpoint) if self.checkpoint else None
        return {"checkpoint": checkpoint, "chosen": self.reason, "policy": self.kind}


@dataclass(slots=True)
class Session:
    """An environment and a policy that acts in it, ready to run."""

    env: VecEnv
    act: Act
    policy: PolicyInTask
    start: tuple[int, Tensor] | None = None
    """Index of the environment to show, and observations of all environments; None: start with a reset."""


def find_policy(request: PolicyRequest, check: Callable[[Resolved], None] = lambda resolved: None) -> PolicyInTask:
    """Find the policy and its task, and check the task.

    torch and MuJoCo are not imported for a policy without a checkpoint, such as `random`.

    Args:
        request: the policy and the task.
        check: a further check, called with the task's configuration; it may raise an error.

    Raises:
        UsageError: if neither a task nor a checkpoint is named, or there is no such policy.
        CheckpointError: if there is no such checkpoint.
    """
    from rlcli.config.load import resolve
    from rlcli.formats import log_notes

    require_known(request.policy, POLICIES, "policy", "policies")
    task, overrides = split_overrides(request.task, request.overrides)
    if task is None and request.checkpoint is None:
        raise UsageError("no task or checkpoint given", hint="name a TASK, or --checkpoint RUN|latest")
    source = None if task is None else named_task_or_run(task, request.runs_dir)
    run = folder = reason = agent = None
    as_trained = False
    if request.policy == "trained" or request.checkpoint is not None:
        from rlcli.runs.policy_ref import choose

        choice = choose(request.checkpoint, request.runs_dir or default_runs_dir(), source)
        run, folder, reason = choice.run, choice.folder, choice.why
        _log.info(f"checkpoint {folder} ({reason})")
        source, agent = choice.source(source), choice.agent
        own = run is not None and folder.resolve().parent == run.checkpoints.resolve()
        as_trained = own and request.policy == "trained" and not overrides and request.config is None
    assert source is not None
    configure = partial(resolve, source, agent=agent, play=True, config_file=request.config, overrides=overrides)
    values = flags(scene__num_envs=request.num_envs)
    resolved = configure(flags=values)
    origin = resolved.layers.origin(("scene", "num_envs"))
    if request.usual_envs is not None and (origin is None or origin.layer in ("task", "agent")):
        resolved = resolved.with_num_envs(min(request.usual_envs, resolved.task.scene.num_envs))
    if resolved.task.scene.num_envs < request.min_envs:
        resolved = configure(flags={**values, "scene.num_envs": request.min_envs})
    check(resolved)
    log_notes(resolved.notes)
    return PolicyInTask(resolved, run, folder, reason, request.policy, request.stochastic, request.seed, as_trained)


def split_overrides(task: str | None, overrides: Sequence[str]) -> tuple[str | None, list[str]]:
    """Return the task and the overrides of a command line, where TASK is optional and comes before the overrides.

    If the first word has a `=`, it is an override, and the task is None.
    """
    if task is not None and "=" in task:
        return None, [task, *overrides]
    return task, list(overrides)


def named_task_or_run(task: str, runs_dir: Path | None) -> TaskSource:
    """Return the task that the user has named. If a run has this name (a common mistake), the error names the run.

    Args:
        task: name, file or folder of a task.
        runs_dir: folder in which to look for a run with this name; None: the default folder of runs.

    Raises:
        TaskError: if there is no such task.
    """
    from rlcli.runs.trusted_tasks import named_task

    try:
        return named_task(task)
    except TaskError as error:
        try:
            find_run(task.partition("@")[0], runs_dir or default_runs_dir())
        except CheckpointError as no_run:
            if error.message == f"no task '{task}'":
                raise TaskError(f"no task or run '{task}'", hint=f"{no_run.hint}; {error.hint}") from None
            raise error from None
        raise TaskError(f"'{task}' is a run, not a task", hint=f"--checkpoint {task}") from None


def open_session(request: PolicyRequest, check: Callable[[Resolved], None] = lambda resolved: None) -> Session:
    """Find and check a policy and its task, then build the environment.

    If the simulation diverges later, a crash dump is written.

    Args:
        request: the policy and the task.
        check: a further check, called with the task's configuration; it may raise an error.
    """
    policy = find_policy(request, check)
    if request.episodes is not None:
        policy = replace(policy, resolved=one_each(policy.resolved, request.episodes))
    from rlcli.envs.make import make_env
    from rlcli.random import derive
    from rlcli.replay.crash_dump import CrashDumper
    from rlcli.rl.rng import seed_generators

    make = make_actor(policy)
    seed_generators(derive(policy.seed, "task"))  # some tasks draw from torch's, numpy's or Python's generator
    # a derived seed: evaluation uses other episodes than training
    env = make_env(policy.resolved, seed=derive(policy.seed, "evaluation"))
    session = Session(env, make(env), policy)
    home = request.runs_dir or default_runs_dir() if policy.run is None else policy.run.folder
    CrashDumper(env, home / "dumps", parents=policy.run is None)
    return session


def one_each(resolved: Resolved, episodes: int) -> Resolved:
    """Return the task with as many environments as episodes, at most `MAX_ENVS`, unless the user set `num_envs`."""
    from rlcli.config.dump import explicit_values

    return (
        resolved if "scene.num_envs" in explicit_values(resolved) else resolved.with_num_envs(min(episodes, MAX_ENVS))
    )


def baseline(policy: PolicyInTask, kind: str) -> PolicyInTask:
    """Return a reference policy of this kind (zero, random or lqr) in the task of another policy.

    Raises:
        UsageError: if there is no such policy.
    """
    require_known(kind, POLICIES, "policy", "policies")
    if kind == "trained":
        raise UsageError(
            "--against trained: only a policy without training can be the reference",
            hint="use --against lqr, zero or random",
        )
    return replace(policy, kind=kind, stochastic=False, as_trained=False)


def is_run_name(word: str, runs_dir: Path | None) -> bool:
    """Return whether a word is `latest` or names a run or a checkpoint that exists; a task may have the same name."""
    runs = runs_dir or default_runs_dir()
    path = path_of(word)
    name = word if path.exists() else word.partition("@")[0]
    if name == "latest" or (path / "manifest.json").is_file():
        return True
    if any((folder / RECORD).is_file() for folder in (path_of(name), runs / name)):
        return True
    return any(run.folder.name == name for run in list_runs(runs, None))


def make_actor(policy: PolicyInTask) -> Callable[[VecEnv], Act]:
    """Read a policy once; return a function that makes the policy's action function for any environment of the task.

    An action function maps observations (num_envs, d) to actions (num_envs, a).
    """
    import torch

    from rlcli.random import derive
    from rlcli.rl.action_functions import random_policy, trained_policy, zero_policy
    from rlcli.runs.checkpoint_fit import require_fit
    from rlcli.runs.checkpoint_reader import open_checkpoint

    torch.set_num_threads(1)
    agent, seed = policy.resolved.agent, derive(policy.seed, "play")
    bound = agent.action_bound if agent else 1.0
    if policy.kind == "zero":
        return zero_policy
    if policy.kind == "random":
        return lambda env: random_policy(env, bound, seed)
    if policy.kind == "lqr":
        from rlcli.evaluation.lqr import regulator

        return regulator(policy.resolved, bound).acting
    assert policy.checkpoint is not None
    checkpoint = open_checkpoint(policy.checkpoint)
    trained = checkpoint.policy()

    def make(env: VecEnv) -> Act:
        require_fit(checkpoint, env.layout)
        generator = torch.Generator().manual_seed(seed)
        return trained_policy(env, trained, stochastic=policy.stochastic, generator=generator)

    return make


def check_record(record: Path | None, mode: str) -> None:
    """Check the options `--record FILE` and `--record-mode MODE`, before anything is built.

    Raises:
        UsageError: for an unknown mode, or if the path is a folder, pipe or device.
        MachineError: if the folder of the file does not exist or cannot be written.
    """
    modes = ("all", "succeeded", "failed", "separate")
    require_known(mode, modes, "--record-mode", "modes")
    if record is None:
        return
    files = recording_files(record, mode).values()
    for file in files:
        require_regular(file)
    if not record.absolute().parent.is_dir():
        raise MachineError(f"--record: there is no folder {record.absolute().parent}; create this folder")
    for file in files:
        require_writable(file)


def recording_files(file: Path, mode: str) -> dict[str, Path]:
    """Return the recordings to write: which episodes (`all`, `succeeded` or `failed`) -> file.

    Args:
        file: the FILE of `--record`.
        mode: the mode of `--record-mode`; `separate` writes succeeded and failed episodes to two files.
    """
    if mode != "separate":
        return {mode: file}
    return {word: file.with_name(f"{file.stem}-{word}{file.suffix}") for word in ("succeeded", "failed")}


def run_episodes(
    session: Session, episodes: int, *, records: bool = False
) -> tuple[dict[str, Any], EpisodeRecorder | None]:
    """Evaluate the policy of a session; return the summary, and the recorder of the episodes if `records` is true."""
    from rlcli.evaluation.evaluate import evaluate

    if not records:
        return evaluate(session.env, session.act, episodes).summary(), None
    from rlcli.replay.episode_recorder import EpisodeRecorder

    with session.env.observers.added(EpisodeRecorder(session.env, episodes)) as recorder:
        return evaluate(session.env, session.act, episodes).summary(), recorder


def save_episodes(
    recorder: EpisodeRecorder | None, record: Path | None, mode: str
) -> tuple[list[str], MachineError | None]:
    """Write the recorded episodes; return (paths of the files, error).

    An error is returned, not raised, so that the command prints its results before it ends.
    """
    if recorder is None or record is None:
        return [], None
    try:
        files = [str(file) for file in recorder.save(recording_files(record, mode))]
    except MachineError as error:
        return [], error
    _log.info(f"recorded {len(recorder.episodes)} episodes to {' and '.join(files)}")
    return files, None


def evaluation_record(session: Session, summary: dict[str, Any]) -> dict[str, Any]:
    """Return the data that `rlcli eval --json` prints: the policy, the settings of the evaluation, and the summary."""
    policy = session.policy
    settings = {"stochastic": policy.stochastic, "seed": policy.seed, "num_envs": session.env.num_envs}
    return {**policy.record(), **settings, **summary}


def save_evaluation(session: Session, record: dict[str, Any]) -> None:
    """Write an evaluation (`record`, from `evaluation_record`) into the checkpoint's run, for `report` and `runs`.

    Only evaluations of a deterministic policy in the task as it was trained are written. If the run cannot be written,
    a warning is logged.
    """
    from rlcli.runs.eval_store import write_evaluation

    policy = session.policy
    if policy.stochastic or not policy.as_trained:
        return
    assert policy.run is not None
    assert policy.checkpoint is not None
    try:
        file = write_evaluation(policy.run, policy.checkpoint.name, record)
    except (CheckpointError, MachineError) as error:
        _log.warning(f"the evaluation is not saved in the run: {error.message}")
        return
    _log.debug(f"evaluation saved in {file}")
