"""Loader of a run's checkpoints for a viewer.

The viewer can switch between checkpoints while the run is still training.
"""

from dataclasses import dataclass

import torch

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError
from rlcli.rl.action_functions import Act, trained_policy
from rlcli.runs.checkpoint_fit import require_fit
from rlcli.runs.checkpoint_reader import open_checkpoint, steps
from rlcli.runs.run import Run


@dataclass(slots=True)
class RunCheckpoints:
    """Loader of the policies of a run's checkpoints, for a viewer that can switch between them.

    Args:
        run: the run.
        env: the environment.
        stochastic: whether the policies sample their actions.
        seed: seed of the sampled actions.
    """

    run: Run
    env: VecEnv
    stochastic: bool = False
    seed: int = 0

    def steps(self) -> list[int]:
        """Return the steps of the existing checkpoints, ascending; an empty list if the folder was removed."""
        try:
            return steps(self.run.checkpoints)
        except OSError:
            return []

    def load(self, step: int) -> Act:
        """Return the policy of the checkpoint at a step, as a function from observations to actions.

        The hidden state of a recurrent policy is reset.

        Raises:
            CheckpointError: if the checkpoint was removed, is corrupt, or belongs to another task.
        """
        folder = self.run.checkpoints / f"{step:012d}"
        if step not in self.steps():
            raise CheckpointError(f"{folder} was deleted; choose a newer checkpoint")
        try:
            checkpoint = open_checkpoint(folder)
            policy = checkpoint.policy()
            require_fit(checkpoint, self.env.layout)
        except OSError as error:  # the training has removed the checkpoint while it was read
            raise CheckpointError(f"{folder} cannot be read: {error.strerror or error}; choose another") from None
        generator = torch.Generator().manual_seed(self.seed)
        return trained_policy(self.env, policy, stochastic=self.stochastic, generator=generator)
