"""How long to train: a limit of iterations, of environment steps, or both."""

from __future__ import annotations

from dataclasses import dataclass

from rlcli.rl.trainer import Trainer


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of a training in total: a resumed run trains what is left of them."""

    max_iterations: int | None
    max_steps: int | None

    def spent(self, trainer: Trainer) -> bool:
        """Return whether the trainer has reached a limit."""
        return (self.max_iterations is not None and trainer.iteration >= self.max_iterations) or (
            self.max_steps is not None and trainer.env_steps >= self.max_steps
        )

    def share(self, trainer: Trainer) -> float:
        """Return the share of the budget that is spent, 0 to 1; within an iteration, that at its beginning."""
        shares = [0.0]
        if self.max_iterations is not None:
            shares.append(trainer.iteration / self.max_iterations)
        if self.max_steps is not None:
            shares.append(trainer.iteration * trainer.steps_per_iteration / self.max_steps)
        return min(1.0, max(shares))

    def iterations(self, trainer: Trainer) -> int:
        """Return the iterations in all."""
        limits = []
        if self.max_iterations is not None:
            limits.append(self.max_iterations)
        if self.max_steps is not None:
            left = max(0, self.max_steps - trainer.env_steps)
            limits.append(trainer.iteration + -(-left // trainer.steps_per_iteration))
        return min(limits)
