"""Settings that all trainers have."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from rlcli.config.schema.base import Count, Positive, StrictModel, Threads, _FractionString


class AutopsyConfig(StrictModel):
    """What is kept, while training, of episodes that ended badly or unlike the others; `rlcli autopsy RUN` shows it."""

    seconds: Annotated[float, Field(gt=0, le=60), _FractionString()] = 2.0
    """How much of an episode's end [s]."""
    keep: Annotated[int, Field(ge=1, le=1000)] = 32
    """Episodes that stay: the newest, of every kind of end some."""
    memory_mib: Annotated[int, Field(ge=1, le=1_000_000)] = 256
    """What the last seconds of all environments may take [MiB]; where they do not fit, fewer seconds are kept."""


class AgentConfig(StrictModel):
    """What every trainer's settings have in common; a trainer's own model extends it."""

    trainer: str
    """Name of a trainer (entry-point group rlcli.trainers)."""
    algorithm: str
    """Algorithm of that trainer."""
    task: dict[str, Any] = {}
    """Patch of the task for what this agent was tuned for."""
    max_iterations: Count | None = None
    """Iterations to train for."""
    max_steps: Count | None = None
    """Environment steps to train for."""
    save_interval: Count | None = None
    """Iterations between checkpoints; null: every 60 s and at the end."""
    keep_last: Count | None = None
    """Newest checkpoints that stay, beside the first and the best; null: 10, or all where `save_interval` is set."""
    keep_every: Count | None = None
    """Checkpoints of every such iteration are written, and stay."""
    eval_interval: Count | None = None
    """Iterations between evaluations of the policy, as `rlcli eval` does it; the best one's checkpoint is RUN@best.
    null: none."""
    eval_episodes: Count = 100
    """Episodes of such an evaluation."""
    autopsy: AutopsyConfig | None = AutopsyConfig()
    """Ends of episodes that are kept while training on a CPU; null: none."""
    torch_threads: Threads | None = None
    """Threads of the update; null: min(4, cores). Results are equal only for an equal number."""
    action_bound: Positive | None = 1.0
    """The policy's actions are clipped to +-this in training, play and export alike; null: unbounded."""

    @model_validator(mode="after")
    def _budget(self) -> AgentConfig:
        if self.max_iterations is None and self.max_steps is None:
            raise ValueError("one of max_iterations and max_steps is needed")
        return self
