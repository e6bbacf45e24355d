"""The checkpoints of a run, as a viewer switches between them, also while the run goes on."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError
from rlcli.rl.acting import Act, trained_policy
from rlcli.runs.checkpoint import open_checkpoint, steps
from rlcli.runs.restore import require_fit
from rlcli.runs.run import Run


@dataclass(slots=True)
class RunCheckpoints:
    """Checkpoints of a run.

    Args:
        run: the run.
        env: where the policies act.
        stochastic: whether they sample.
        seed: of what they sample.
    """

    run: Run
    env: VecEnv
    stochastic: bool = False
    seed: int = 0

    def steps(self) -> list[int]:
        """Steps of those that are there now, ascending; none where the folder is gone."""
        try:
            return steps(self.run.checkpoints)
        except OSError:
            return []

    def load(self, step: int) -> Act:
        """The policy of one; what it remembers of an episode begins now.

        Raises:
            CheckpointError: if it is not there any more, damaged, or of another task.
        """
        folder = self.run.checkpoints / f"{step:012d}"
        if step not in self.steps():
            raise CheckpointError(f"{folder} is not there any more")
        try:
            checkpoint = open_checkpoint(folder)
            policy = checkpoint.policy()
            require_fit(checkpoint, self.env.layout)
        except OSError as error:  # removed while it is read
            raise CheckpointError(f"{folder} cannot be read: {error.strerror or error}") from None
        generator = torch.Generator().manual_seed(self.seed)
        return trained_policy(self.env, policy, stochastic=self.stochastic, generator=generator)
