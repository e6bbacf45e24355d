"""`make_env`: the environment of a task."""

from __future__ import annotations

from pathlib import Path

from rlcli.config.load import Resolved, resolve
from rlcli.config.python_task import source_of
from rlcli.config.schema import TaskConfig
from rlcli.envs.vec_env import VecEnv
from rlcli.machine import restore_garbage_collection
from rlcli.registry import load_object

_MANAGED, _DIRECT = "rlcli.envs.managed:ManagedEnv", "rlcli.envs.direct:DirectEnv"
"""The class of each workflow's environments, imported when it is needed."""


def make_env(
    task: Resolved | TaskConfig,
    *,
    seed: int = 42,
    device: str = "cpu",
    root: Path | None = None,
    shared_streams: int = 0,
) -> VecEnv:
    """Return the environment of a task, in the task's own workflow.

    Args:
        task: a resolved task, or a `TaskConfig` built in Python.
        seed: of every random draw.
        device: where the engine and all tensors live.
        root: folder of the models of a `TaskConfig`; by default the working directory.
        shared_streams: see `VecEnv`.
    """
    restore_garbage_collection()  # what is large has been imported; from here on a command runs
    resolved = task if isinstance(task, Resolved) else resolve(source_of(task, root))
    if resolved.source.task is not None and resolved.format is not None and resolved.format.spec.environment:
        env_class = resolved.format.load(resolved.format.spec.environment)
    else:
        env_class = load_object(_MANAGED if resolved.source.task is None else _DIRECT)
    env: VecEnv = env_class(resolved, seed=seed, device=device, shared_streams=shared_streams)
    return env
