"""Job of a training: an open run, its configuration and where to begin; imports nothing heavy."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.machine import available_cores
from rlcli.runs.run import Run

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.runs.checkpoint import Checkpoint


@dataclass(slots=True)
class Job:
    """A locked run and what to train in it."""

    run: Run
    resolved: Resolved
    loggers: list[str]
    resume_from: Checkpoint | None = None
    """The checkpoint to resume from."""
    created: bool = True
    """Whether the run's folder was made for this job; without a checkpoint a run that is resumed begins again."""
    init_from: Path | None = None
    """The checkpoint folder to take weights from."""
    stages: list[int] = field(default_factory=list)
    """Iterations to save at, the last one to end at; they replace the agent's budget and which checkpoints it keeps."""
    config: str | None = None
    """The configuration of a resumed run, if its budget changes."""
    video_every: int = 0
    """Iterations between videos; 0: none."""
    writes: bool = True
    """Whether this process writes the run."""
    begin: float = field(default_factory=time.monotonic)

    def message(self) -> dict[str, Any]:
        """Return what rank 0 broadcasts to the other ranks."""
        return {
            "run": str(self.run.folder),
            "record": self.run.record,
            "resume_from": None if self.resume_from is None else str(self.resume_from.folder),
            "created": self.created,
            "init_from": self.init_from,
        }


@dataclass(frozen=True, slots=True)
class TrainingResult:
    """A finished run, as the command prints it."""

    run: Path
    checkpoint: Path
    """The newest checkpoint."""
    step: int
    iteration: int | None = None
    """This and the rest are None if nothing was left to train."""
    elapsed_s: float | None = None
    seed: int | None = None


def threads(resolved: Resolved) -> tuple[int, int]:
    """Return the threads of the engine and of torch's update."""
    assert resolved.agent is not None
    cores = available_cores()
    return resolved.task.sim.engine_threads or cores, resolved.agent.torch_threads or min(4, cores)
