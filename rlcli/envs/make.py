"""Function `make_env`, which builds the environment of a task in this process.

The environment class depends on how the task is written: manager-based, direct, or in another framework's format.
"""

from __future__ import annotations

from pathlib import Path

from rlcli.config.load import Resolved, resolve
from rlcli.config.python_task import source_of
from rlcli.config.schema import TaskConfig
from rlcli.envs.shard_range import Shard
from rlcli.envs.vec_env import VecEnv
from rlcli.machine.garbage_collection import restore_garbage_collection
from rlcli.progress import track
from rlcli.registry import load_object

_MANAGED, _DIRECT = "rlcli.envs.managed:ManagedEnv", "rlcli.envs.direct:DirectEnv"
"""Environment class of each workflow, imported on demand."""


def make_env(
    task: Resolved | TaskConfig,
    *,
    seed: int = 42,
    device: str = "cpu",
    root: Path | None = None,
    shared_streams: int = 0,
    shard: Shard | None = None,
) -> VecEnv:
    """Build and return the environment of a task: a `ManagedEnv`, a `DirectEnv`, or the class of the task's format.

    Args:
        task: a resolved task, or a `TaskConfig` built in Python.
        seed: seed of all random numbers.
        device: device of the engine and of all tensors.
        root: folder of the models of a `TaskConfig`; None: the current folder.
        shared_streams: see `VecEnv`.
        shard: see `VecEnv`.
    """
    restore_garbage_collection()  # garbage collection was delayed while large libraries were imported
    resolved = task if isinstance(task, Resolved) else resolve(source_of(task, root))
    if resolved.source.task is not None and resolved.format is not None and resolved.format.spec.environment:
        env_class = resolved.format.load(resolved.format.spec.environment)
    else:
        env_class = load_object(_MANAGED if resolved.source.task is None else _DIRECT)
    with track(f"building {resolved.task.scene.num_envs} environments"):
        env: VecEnv = env_class(resolved, seed=seed, device=device, shared_streams=shared_streams, shard=shard)
    return env
