"""Schema of the settings of an agent that all trainers share: budget, checkpoints, evaluations.

Each trainer derives the model of its own settings from `AgentConfig`.
"""

import math
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator

from rlcli.config.schema.base import Count, Length, Positive, StrictModel, Threads, _FractionString
from rlcli.safe_text import float_or_nan


class AutopsyConfig(StrictModel):
    """Recording of failed and outlier episodes during training; `rlcli autopsy RUN` shows the recordings."""

    seconds: Annotated[float, Field(gt=0, le=60), _FractionString()] = 2.0
    """Length of the recorded end of an episode [s]."""
    keep: Annotated[int, Field(ge=1, le=1000)] = 32
    """Number of recordings to keep: the newest ones, with some of every kind of termination."""
    memory_mib: Annotated[int, Field(ge=1, le=1_000_000)] = 256
    """Memory for the last seconds of all environments [MiB]. With too little memory, fewer seconds are recorded."""


def parse_threshold(text: str) -> tuple[str, float]:
    """Return the metric and the value of a threshold such as `success=0.99`, `return=200` or `length=250`.

    Raises:
        ValueError: if the text is not such a threshold.
    """
    key, _, number = text.partition("=")
    value = float_or_nan(number)
    if key not in ("success", "return", "length") or not math.isfinite(value):
        raise ValueError(f"'{text}' is not a threshold; write success=0.97, return=200 or length=250")
    if key == "success" and not 0.0 < value <= 1.0:
        raise ValueError(f"'{text}' is not a threshold; give a success rate above 0 and at most 1")
    return key, value


def _check_threshold(text: str) -> str:
    if parse_threshold(text) == ("success", 1.0):
        raise ValueError("no number of episodes shows a success rate of 1 with 95 % confidence; write success=0.97")
    return text


class AgentConfig(StrictModel):
    """Settings of an agent that all trainers share. Each trainer has a subclass with its own settings."""

    trainer: str
    """Name of the trainer, for example ppo or sb3 (entry-point group rlcli.trainers)."""
    algorithm: str
    """Name of an algorithm of the trainer."""
    task: dict[str, Any] = {}
    """Changes of the task for this agent: keys of the task with other values."""
    max_iterations: Length | None = None
    """Number of training iterations; null: no limit, then `max_steps` is needed."""
    max_steps: Length | None = None
    """Number of environment steps of the training, summed over all environments; null: no limit."""
    max_minutes: Positive | None = None
    """Number of minutes after which a training stops with a checkpoint; each time the training is resumed, it may take
    this time again. null: no limit. Schedules follow `max_iterations` and `max_steps` only."""
    save_interval: Length | None = None
    """Iterations between two checkpoints; null: a checkpoint every 60 s and one at the end."""
    keep_last: Count | None = None
    """Number of newest checkpoints to keep, besides the first and the best; null: 10, or all if `save_interval` is
    set."""
    keep_every: Count | None = None
    """A checkpoint of every iteration divisible by this number is written and always kept; null: none."""
    eval_interval: Count | None = None
    """Iterations between two evaluations of the policy, as `rlcli eval` does them; null: no evaluations. RUN@best is
    the checkpoint with the best evaluation."""
    eval_episodes: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    """Number of episodes of each evaluation of `eval_interval`; the training waits for their end."""
    until: Annotated[str, AfterValidator(_check_threshold)] | None = None
    """Threshold at which training ends before its budget: success=X, return=X or length=X. The training ends when the
    lower end of the 95 % confidence interval of an evaluation is at least X. With a threshold, `eval_interval: null`
    means a twentieth of the budget, and `eval_episodes` is raised to the number of episodes that a success rate of X
    needs."""
    autopsy: AutopsyConfig | None = AutopsyConfig()
    """Recording of failed and outlier episodes during training on a CPU; null: no recording."""
    torch_threads: Threads | None = None
    """Number of CPU threads of the policy update; null: min(4, cores). Another number may give other
    rounding errors (not for MLPs of `ppo` on a CPU)."""
    action_bound: Positive | None = 1.0
    """Actions of the policy are clipped to +-`action_bound` in training, play and export; null: no clipping."""

    @model_validator(mode="after")
    def _budget(self) -> Self:
        if self.max_iterations is None and self.max_steps is None:
            raise ValueError("the training has no length: set max_iterations or max_steps")
        return self
