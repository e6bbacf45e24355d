"""Budget of a training: a limit of iterations, of environment steps, or both.

The training loop ends when the budget is spent. Schedules, such as that of the learning rate, depend on the remaining
budget.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rlcli.config.schema import AgentConfig
from rlcli.rl.trainer import Trainer


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of a whole training; at least one is set.

    The limits include iterations and steps before the run was resumed, so a resumed run trains only the rest.
    """

    max_iterations: int | None
    """Iterations of the trainer; None: no limit."""
    max_steps: int | None
    """Environment steps, counted over all environments; None: no limit."""

    def spent(self, trainer: Trainer) -> bool:
        """Return whether the trainer has reached a limit."""
        return trainer.iteration >= self.iterations(trainer)

    def iterations(self, trainer: Trainer) -> int:
        """Return the number of iterations of the whole training after which the first limit is reached."""
        limits = []
        if self.max_iterations is not None:
            limits.append(self.max_iterations)
        if self.max_steps is not None:
            left = max(0, self.max_steps - trainer.env_steps)
            limits.append(trainer.iteration + -(-left // trainer.steps_per_iteration))
        return min(limits)


def remaining_budget(config: AgentConfig, trainer: Trainer) -> float:
    """Return the fraction of an agent's budget that is left, from 1 (start of the training) to 0 (end).

    Schedules, such as that of the learning rate, use the fraction. It changes only between iterations.
    """
    by_iterations = trainer.iteration / (config.max_iterations or math.inf)
    by_steps = trainer.iteration * trainer.steps_per_iteration / (config.max_steps or math.inf)
    return 1.0 - min(1.0, max(by_iterations, by_steps))
