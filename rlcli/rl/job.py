"""What is to be trained, and where to begin; light, so that a run's folder is written before anything heavy is read."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rlcli.machine import available_cores
from rlcli.rl.run import Run

if TYPE_CHECKING:
    from rlcli.config.load import Resolved


@dataclass(slots=True)
class Job:
    """A locked run with what it trains."""

    run: Run
    resolved: Resolved
    loggers: list[str]
    resume_from: Any = None
    """The checkpoint to go on from exactly."""
    created: bool = True
    """Whether the run's folder was made for this job; one that was killed before its first checkpoint begins again."""
    init_from: Any = None
    """The checkpoint folder to take weights from."""
    stages: list[int] = field(default_factory=list)
    """Iterations to save at, the last one to end at, instead of the agent's budget and what it keeps."""
    config: str | None = None
    """The configuration of a run that goes on, where its budget changes."""
    video_every: int = 0
    """Iterations between clips; 0: none."""
    writes: bool = True
    """Whether this process writes the run."""
    begin: float = field(default_factory=time.monotonic)

    def word(self) -> dict[str, Any]:
        """What other processes need to know of it."""
        return {
            "run": str(self.run.folder),
            "record": self.run.record,
            "resume_from": None if self.resume_from is None else str(self.resume_from.folder),
            "created": self.created,
            "init_from": self.init_from,
        }


def threads(resolved: Resolved) -> tuple[int, int]:
    """Threads of the engine and of torch's update."""
    assert resolved.agent is not None
    cores = available_cores()
    return resolved.task.sim.engine_threads or cores, resolved.agent.torch_threads or min(4, cores)
