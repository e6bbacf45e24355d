"""Choice and check of the number of processes that step the environments (`scene.workers`), the main one included.

The module imports neither torch nor MuJoCo, so that workers can be started before these slow imports.
"""

from __future__ import annotations

import os

from rlcli.config.load import Resolved
from rlcli.config.schema import CameraSensorConfig
from rlcli.errors import ConfigError
from rlcli.machine.cores import available_cores
from rlcli.machine.memory import available_memory

ENVS_PER_WORKER = 512
"""Smallest number of environments for each process with `scene.workers: auto`: smaller parts are not faster."""
FEWEST_WORKERS = 4
"""`scene.workers: auto` uses one process, or at least this number: two or three processes are not faster than one."""

FREE_MEMORY_PER_WORKER = 1 << 30
"""Free memory for each process that `auto` starts [bytes]; a process takes about a quarter of it."""
ONE_WORKER = "RLCLI_ONE_WORKER"
"""Environment variable that is set for trainings that run at the same time: `scene.workers: auto` is then 1."""
FEWEST_CORES = 4
"""Number of cores from which `auto` uses several processes: on fewer cores physics takes most of a step anyway."""
_TESTED = ("rlcli", "rlcli-gymnasium", "rlcli-menagerie")
"""Distributions whose tasks are tested with several workers."""


def number_of_workers(resolved: Resolved, device: str) -> int:
    """Return the number of processes that step the environments of a task.

    Raises:
        ConfigError: for a number that the task or the machine does not allow.
    """
    scene = resolved.task.scene
    if scene.workers == 1:
        return 1
    reason = _reason_for_one(resolved, device)
    if scene.workers == "auto":
        cores = resolved.task.sim.engine_threads or available_cores()
        # a renderer for each process would need several times the memory
        has_camera = any(isinstance(sensor, CameraSensorConfig) for sensor in scene.sensors.values())
        if reason is not None or has_camera or cores < FEWEST_CORES or has_untested_code(resolved):
            return 1
        if ONE_WORKER in os.environ:
            return 1
        most = max(cores // 2, FEWEST_WORKERS)  # two hardware threads share a core; a process for each is slower
        count = min(most, scene.num_envs // ENVS_PER_WORKER, available_memory() // FREE_MEMORY_PER_WORKER)
        return count if count >= FEWEST_WORKERS else 1
    if reason is None and scene.num_envs < 2 * scene.workers:
        reason = f"{scene.num_envs} environments are too few; each worker needs two"
    if reason is not None:
        message = f"{scene.workers} workers cannot step this task: {reason}"
        raise ConfigError([resolved.problem(("scene", "workers"), message, "set scene.workers: 1, for one process")])
    return scene.workers


def _reason_for_one(resolved: Resolved, device: str) -> str | None:
    """Return the reason why several processes cannot step a task; None: there is no such reason."""
    task = resolved.task
    if device.partition(":")[0] != "cpu" or task.sim.engine == "warp":
        return "a GPU steps all environments at once"
    if os.name == "nt":
        return "worker processes need Linux or macOS"
    for name, term in task.curriculum.items():
        if term is not None and term.func in resolved.vocabulary.own:
            return f"the task's own code for curriculum '{name}' may use all environments"
    return None


def has_untested_code(resolved: Resolved) -> bool:
    """Return whether a task has code of its own that is not tested with several workers."""
    has_own_code = resolved.source.task is not None or bool(resolved.vocabulary.own)
    return has_own_code and resolved.source.distribution not in _TESTED
