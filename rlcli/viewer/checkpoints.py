"""Loader of the policies of a run's checkpoints, for viewers that switch between checkpoints, also during training."""

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
    """Loader of the policies of a run's checkpoints, for a viewer that can switch between checkpoints.

    Args:
        run: the run.
        env: the environments in which the policies act.
        stochastic: whether the policies sample their actions; otherwise the mean of the distribution is the action.
        seed: seed of the sampled actions.
    """

    run: Run
    env: VecEnv
    stochastic: bool = False
    seed: int = 0

    def steps(self) -> list[int]:
        """Return the environment steps of the existing checkpoints, ascending; an empty list without a folder."""
        try:
            return steps(self.run.checkpoints)
        except OSError:
            return []

    def load(self, step: int) -> Act:
        """Return the policy of a checkpoint, as a function: observations (num_envs, d) -> actions (num_envs, a).

        A recurrent policy starts with hidden state 0.

        Args:
            step: number of environment steps of the checkpoint, from `steps`.

        Raises:
            CheckpointError: if the checkpoint was removed, is corrupt, or belongs to another task.
        """
        folder = self.run.checkpoints / f"{step:012d}"
        if step not in self.steps():
            raise CheckpointError(f"{folder} does not exist (training deletes old checkpoints); choose a newer one")
        try:
            checkpoint = open_checkpoint(folder)
            policy = checkpoint.policy()
            require_fit(checkpoint, self.env.layout)
        except OSError as error:  # the training has removed the checkpoint while it was read
            message = f"{folder} cannot be read: {error.strerror or error}; choose another checkpoint"
            raise CheckpointError(message) from None
        generator = torch.Generator().manual_seed(self.seed)
        return trained_policy(self.env, policy, stochastic=self.stochastic, generator=generator)
