"""Python interface: make environments, train a policy, evaluate it, act with it, and export it.

`train`, `evaluate` and `export` do the work of the commands `rlcli train`, `rlcli eval` and `rlcli export`, and return
the result instead of printing it. Errors are the exceptions of `rlcli.errors`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex

from torch import Tensor

from rlcli.config.layers import flags
from rlcli.config.load import resolve
from rlcli.deploy.export import Exported, check_target
from rlcli.deploy.export import export as write_export
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import UsageError
from rlcli.evaluation.session import PolicyRequest, open_session, run_episodes
from rlcli.registry.find import find_task
from rlcli.rl.action_functions import trained_policy
from rlcli.runs.checkpoint_fit import require_fit
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.policy_ref import choose
from rlcli.runs.run_ref import default_runs_dir
from rlcli.safe_text import MAX_SEED, shorten
from rlcli.training.job import Job, TrainingResult
from rlcli.training.runner import run_training
from rlcli.training.signals import StopRequest
from rlcli.training.start_run import TrainingRequest, broadcast_job, process_device, setup_job

if TYPE_CHECKING:
    from rlcli.registry.task_location import TaskSource
    from rlcli.training.progress import Progress


def make(
    task: str, *, num_envs: int | None = None, seed: int = 42, device: str = "cpu", overrides: Sequence[str] = ()
) -> VecEnv:
    """Return the environments of a task, which are stepped together, as one `VecEnv`.

    Args:
        task: name of an installed task, or the path of a task folder.
        num_envs: number of environments; None: the number in the task's configuration.
        seed: seed of all random numbers.
        device: `cpu`, or `cuda` for the physics engine MuJoCo Warp on the GPU.
        overrides: changes of the task's configuration: list of `key.path=value`, as on the command line.

    Raises:
        TaskError: if the task is not found.
        ConfigError: if an override or the configuration of the task is not valid.
        DeviceError: if the device is not available.
        UsageError: if `seed` is not an integer from 0 to 2^62, or `overrides` is a string instead of a list.
    """
    _check(seed, overrides)
    resolved = resolve(find_task(task), overrides=list(overrides), flags=flags(scene__num_envs=num_envs))
    return make_env(resolved, seed=seed, device=device)


def train(
    task: str | None = None,
    *,
    agent: str | None = None,
    num_envs: int | None = None,
    max_iterations: int | None = None,
    seed: int = 42,
    device: str = "auto",
    overrides: Sequence[str] = (),
    runs_dir: Path | str | None = None,
    name: str | None = None,
    resume: Path | str | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> TrainingResult:
    """Train a policy, or resume a training, and return the result at the end.

    Call this function in the main thread. During the call, SIGINT and SIGTERM save a checkpoint and stop the training.

    Args:
        task: name of an installed task, or the path of a task folder; not needed with `resume`.
        agent: name of an agent of the task; None: the default agent.
        num_envs: number of environments; None: the number in the task's configuration.
        max_iterations: number of iterations, counted from the start of the training; None: the agent's budget.
        seed: seed of the training.
        device: `auto`, `cpu` or `cuda`.
        overrides: changes of the configuration: list of `key.path=value`; `agent.key=value` changes the agent.
        runs_dir: folder of the runs; None: the environment variable RLCLI_RUNS_DIR, else `runs`.
        name: text to add to the name of the run's folder, to recognise the run.
        resume: folder of a run to resume; None: a new run.
        on_progress: called with a `Progress` (iteration, steps, metrics) after each iteration.

    Raises:
        Stopped: if a signal has stopped the training; the run can be resumed.
        RlcliError: in every other case in which `rlcli train` would end with an error.
    """
    _check(seed, overrides)
    if task is None and resume is None:
        raise UsageError(
            "train(): neither a task nor a run to resume is given", hint='write train("cartpole") or train(resume=RUN)'
        )
    request = TrainingRequest(
        Path(runs_dir or default_runs_dir()),
        source=None if task is None else find_task(task),
        resume=None if resume is None else str(resume),
        agent=agent,
        device=device,
        overrides=list(overrides),
        flags=flags(scene__num_envs=num_envs),
        budget={} if max_iterations is None else {"agent.max_iterations": max_iterations, "agent.max_steps": None},
        seed=seed,
        name=name,
    )
    stop = StopRequest()
    with stop:
        resolved, place = request.resolve() if resume is None else (None, process_device(device, None))
        result = broadcast_job(request, resolved, place)
        if isinstance(result, Job):
            trainer, env = setup_job(result, place, stop)
            result = run_training(result, trainer, env, stop, _ProgressCallback(on_progress))
    assert result is not None  # None is returned on ranks other than 0, and there is one rank
    return result


def evaluate(
    checkpoint: Path | str | None = None,
    *,
    task: str | None = None,
    episodes: int = 1000,
    num_envs: int | None = None,
    seed: int = 42,
    stochastic: bool = False,
    overrides: Sequence[str] = (),
    runs_dir: Path | str | None = None,
) -> dict[str, Any]:
    """Evaluate a policy; return the results (returns, success, lengths) as the dict that `rlcli eval --json` prints.

    Args:
        checkpoint: folder of a run or checkpoint; None: the newest run of the task, else the policy that is installed
            with the task.
        task: name or folder of the task to evaluate in; None: the task of the run.
        episodes: number of episodes.
        num_envs: number of environments; None: the number in the task's configuration.
        seed: seed of the episodes.
        stochastic: whether to sample actions; otherwise the mean of the policy's distribution is the action.
        overrides: changes of the task's configuration: list of `key.path=value`.
        runs_dir: folder of the runs; None: the environment variable RLCLI_RUNS_DIR, else `runs`.

    Raises:
        CheckpointError: if there is no such checkpoint, or the checkpoint does not fit the task.
        UsageError: if neither `checkpoint` nor `task` is given, `episodes` is below 1, `seed` is not an integer from 0
            to 2^62, or `overrides` is a string.
    """
    _check(seed, overrides)
    if not isinstance(episodes, SupportsIndex) or operator.index(episodes) < 1:
        raise UsageError(f"evaluate(): episodes is {episodes!r}; give an integer above 0")
    reference = None if checkpoint is None else str(checkpoint)
    folder = None if runs_dir is None else Path(runs_dir)
    request = PolicyRequest(
        task, overrides, reference, stochastic=stochastic, num_envs=num_envs, seed=seed, runs_dir=folder
    )
    session = open_session(request)
    try:
        summary, _ = run_episodes(session, episodes)
    finally:
        session.env.close()
    return summary


def load_policy(
    env: VecEnv, checkpoint: Path | str | None = None, *, stochastic: bool = False, runs_dir: Path | str | None = None
) -> Callable[[Tensor], Tensor]:
    """Return a trained policy as a function: observations (num_envs, obs_size) -> actions (num_envs, action_size).

    The observations are those of the group `policy`. The function keeps the hidden state of a recurrent policy, and
    resets the state of each environment whose episode ends.

    Args:
        env: environments in which the policy acts.
        checkpoint: folder of a run or checkpoint; None: the newest run of the task, else the policy that is installed
            with the task.
        stochastic: whether to sample actions; otherwise the mean of the policy's distribution is the action.
        runs_dir: folder of the runs; None: the environment variable RLCLI_RUNS_DIR, else `runs`.

    Raises:
        CheckpointError: if there is no such checkpoint, or the checkpoint does not fit the environment.
    """
    saved = open_checkpoint(_find(checkpoint, env.resolved.source, runs_dir))
    require_fit(saved, env.layout)
    return trained_policy(env, saved.policy(), stochastic=stochastic)


def export(
    checkpoint: Path | str, file: Path | str, *, format: str = "onnx", runs_dir: Path | str | None = None
) -> Exported:
    """Write a policy to one file and check that the file computes the same actions.

    Args:
        checkpoint: folder of a run or checkpoint.
        file: path of the file to write; missing folders are created.
        format: `onnx`, `torch` or `numpy`.
        runs_dir: folder of the runs; None: the environment variable RLCLI_RUNS_DIR, else `runs`.

    Returns:
        The file, and the largest difference between its actions and those of the policy.

    Raises:
        UsageError: for an unknown format or a wrong suffix.
        DependencyError: if the library that writes the format is not installed.
        CheckpointError: if there is no such checkpoint.
        VerdictError: if the file computes other actions than the policy; the file is deleted.
    """
    check_target(format, Path(file))
    return write_export(open_checkpoint(_find(checkpoint, None, runs_dir)), Path(file), format)


def _check(seed: object, overrides: object) -> None:
    """Check the arguments `seed` and `overrides`, which several functions of this module have.

    Raises:
        UsageError: if `seed` is not an integer from 0 to 2^62, or `overrides` is a string.
    """
    if not isinstance(seed, SupportsIndex) or not 0 <= operator.index(seed) <= MAX_SEED:
        raise UsageError(f"seed is {shorten(repr(seed), 40)}; give an integer from 0 to 2^62")
    if isinstance(overrides, str):
        raise UsageError(
            f"overrides must be a list, found the string '{shorten(overrides, 40)}'",
            hint='write a list, such as overrides=["sim.dt=0.005"]',
        )


def _find(checkpoint: Path | str | None, task: TaskSource | None, runs_dir: Path | str | None) -> Path:
    """Return the folder of a checkpoint or installed policy; without `checkpoint`, of the task's newest run.

    Raises:
        CheckpointError: if there is no such checkpoint.
    """
    return choose(None if checkpoint is None else str(checkpoint), Path(runs_dir or default_runs_dir()), task).folder


class _ProgressCallback:
    """Display of progress for `run_training` that calls a function of the user after each iteration."""

    def __init__(self, function: Callable[[Progress], None] | None) -> None:
        self._function = function

    def show(self, progress: Progress) -> None:
        """Call the function with the progress after one iteration."""
        if self._function is not None:
            self._function(progress)

    def __enter__(self) -> _ProgressCallback:
        return self

    def __exit__(self, *_: object) -> None: ...
