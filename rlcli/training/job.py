"""Data classes `Job`, a training to start, and `TrainingResult`, the result of a finished training.

The module imports neither torch nor MuJoCo.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.machine.cores import available_cores
from rlcli.runs.run import Run

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.runs.checkpoint_reader import Checkpoint


@dataclass(slots=True)
class Job:
    """A training to start: its run, which this process has locked, and its settings."""

    run: Run
    resolved: Resolved
    loggers: list[str]
    """Names of the loggers besides `metrics.jsonl`."""
    resume_from: Checkpoint | None = None
    """Checkpoint to resume from; None: training starts at iteration 0."""
    created: bool = True
    """Whether the run's folder was created for this job; False for a run that is resumed or was prepared before."""
    init_from: Path | None = None
    """Folder of the checkpoint whose weights the policy starts with; None: random weights."""
    stages: list[int] = field(default_factory=list)
    """Iterations after which a checkpoint is saved; training ends after the last of these iterations. If the list is
    not empty, the agent's `max_iterations`, `max_steps`, `save_interval` and `keep_*` have no effect."""
    config: str | None = None
    """New content of a resumed run's `config.yaml`; None: the file stays, because the budget does not change."""
    video_every: int = 0
    """Number of iterations between videos; 0: no videos."""
    writes: bool = True
    """Whether this process writes the run: True on rank 0."""
    begin: float = field(default_factory=time.monotonic)
    """Time at which the job was made, by the monotonic clock [s]."""

    def message(self) -> dict[str, Any]:
        """Return the entries that rank 0 broadcasts, from which the other ranks make the same job."""
        return {
            "run": str(self.run.folder),
            "record": self.run.record,
            "resume_from": None if self.resume_from is None else str(self.resume_from.folder),
            "created": self.created,
            "init_from": self.init_from,
        }


@dataclass(frozen=True, slots=True)
class TrainingResult:
    """Result of a finished training, which the command prints."""

    run: Path
    """Folder of the run."""
    checkpoint: Path
    """Newest checkpoint."""
    step: int
    """Environment steps of the whole run."""
    iteration: int | None = None
    """Iterations of the whole run. If the run was already finished, so that nothing was trained, this field is None,
    and the following ones have their defaults."""
    elapsed_s: float | None = None
    """Duration of this training [s]."""
    seed: int | None = None
    new_steps: int | None = None
    """Environment steps of this training; for a resumed run, without the steps before the resumption."""
    metrics: dict[str, float] = field(default_factory=dict)
    """Metrics of the last iteration."""
    state: str = "finished"
    """finished, or stopped if the agent's `max_minutes` ended the training."""


def threads(resolved: Resolved) -> tuple[int, int]:
    """Return the number of threads of the physics engine, and of torch in the update of the policy."""
    agent, _ = resolved.require_agent()
    cores = available_cores()
    return resolved.task.sim.engine_threads or cores, agent.torch_threads or min(4, cores)
