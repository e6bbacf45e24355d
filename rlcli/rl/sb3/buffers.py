"""Rollout and replay buffers for Stable-Baselines3's algorithms, stored as torch tensors.

SB3's own buffers store numpy arrays; with them each sample would be copied twice.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples
from torch import Tensor

from rlcli.machine.memory import require_memory
from rlcli.rl.policy import Normalizer
from rlcli.rl.trainer import Rows
from rlcli.sim.saved_tensors import require_matching_tensors


class TorchRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with torch storage. All tensors are (n_steps, n_envs, ...)."""

    num_minibatches: int | None = None
    """Number of minibatches that `get` yields, of nearly equal size; None: minibatches of `batch_size` samples."""

    def reset(self) -> None:
        """Discard the rollout. The first call allocates the storage."""
        if not hasattr(self, "obs"):
            steps, envs = self.buffer_size, self.n_envs
            size = 4 * steps * envs * (math.prod(self.obs_shape) + self.action_dim + 6)
            require_memory(size, f"the {steps * envs} samples of a rollout")
            self.obs = torch.zeros(steps, envs, *self.obs_shape)
            self.action = torch.zeros(steps, envs, self.action_dim)
            self.reward, self.start, self.value, self.log_prob, self.advantage, self.target = (
                torch.zeros(steps, envs) for _ in range(6)
            )
            # SB3's update reads these two numpy arrays for its explained variance
            self.values, self.returns = self.value.numpy(), self.target.numpy()
        self.pos, self.full = 0, False

    def put(self, obs: Tensor, action: Tensor, reward: Tensor, start: Tensor, value: Tensor, log_prob: Tensor) -> None:
        """Store one step of every environment. (n_envs, ...) each"""
        columns = (self.obs, self.action, self.reward, self.start, self.value, self.log_prob)
        for column, values in zip(columns, (obs, action, reward, start, value, log_prob), strict=True):
            column[self.pos].copy_(values)
        self.pos += 1
        self.full = self.pos == self.buffer_size

    def finish(self, last_value: Tensor, last_done: Tensor) -> None:
        """Estimate advantages and targets by GAE, equations 11 and 12 of Schulman et al. 2017 (PPO).

        Args:
            last_value: values of the observations after the rollout. (n_envs,)
            last_done: whether the last step ended an episode. (n_envs,)
        """
        advantage = torch.zeros_like(last_value)
        next_value, not_done = last_value, 1.0 - last_done.float()
        for step in reversed(range(self.buffer_size)):
            delta = self.reward[step] + self.gamma * next_value * not_done - self.value[step]  # equation 12
            advantage = delta + self.gamma * self.gae_lambda * not_done * advantage  # equation 11, as a recursion
            self.advantage[step].copy_(advantage)
            next_value, not_done = self.value[step], 1.0 - self.start[step]
        torch.add(self.advantage, self.value, out=self.target)

    def get(self, batch_size: int | None = None) -> Iterator[RolloutBufferSamples]:  # type: ignore[override]
        """Shuffle the samples of the rollout and yield the minibatches.

        `batch_size` is the number of samples of a minibatch, None: all samples; not used if `num_minibatches` is set.
        """
        total = self.buffer_size * self.n_envs
        storage = (self.obs, self.action, self.value, self.log_prob, self.advantage, self.target)
        columns = [tensor.view(total, *tensor.shape[2:]) for tensor in storage]
        order, parts = torch.randperm(total), self.num_minibatches
        for rows in torch.split(order, batch_size or total) if parts is None else order.tensor_split(parts):
            yield RolloutBufferSamples(*(column.index_select(0, rows) for column in columns))


class TorchReplayBuffer(ReplayBuffer):
    """SB3's replay buffer with torch storage: a ring buffer that normalises observations when they are sampled.

    A time-out is stored as not done, with the last observation of the episode as the next observation. All tensors are
    (rows, n_envs, ...).
    """

    normalizer: Normalizer | None = None
    """Normaliser of the observations; None: observations are not normalised. The trainer sets it."""

    def __init__(self, buffer_size: int, *args: Any, **kwargs: Any) -> None:
        super().__init__(1, *args, **kwargs)  # SB3's own storage has one row: it is not used
        self.buffer_size = max(1, buffer_size // self.n_envs)
        rows, envs = self.buffer_size, self.n_envs
        size = 4 * rows * envs * (2 * math.prod(self.obs_shape) + self.action_dim + 2)
        require_memory(size, f"the {rows * envs} samples of agent.buffer_size")
        self.obs = torch.zeros(rows, envs, *self.obs_shape)
        self.next_obs = torch.zeros(rows, envs, *self.obs_shape)
        self.action = torch.zeros(rows, envs, self.action_dim)
        self.reward = torch.zeros(rows, envs, 1)
        self.done = torch.zeros(rows, envs, 1)
        self.added = 0
        """Number of steps stored since the start of the training, including overwritten ones."""

    def put(self, obs: Tensor, next_obs: Tensor, action: Tensor, reward: Tensor, done: Tensor) -> None:
        """Store one step of every environment. (n_envs, ...) each"""
        for name, values in zip(_COLUMNS, (obs, next_obs, action, reward[:, None], done[:, None]), strict=True):
            getattr(self, name)[self.pos].copy_(values)
        self._count(1)

    def sample(self, batch_size: int, env: object = None) -> ReplayBufferSamples:
        """Return uniformly sampled transitions; observations are normalised."""
        rows = torch.randint((self.buffer_size if self.full else self.pos) * self.n_envs, (batch_size,))
        obs, action, next_obs, done, reward = (
            storage.view(-1, storage.shape[2]).index_select(0, rows)
            for storage in (self.obs, self.action, self.next_obs, self.done, self.reward)
        )
        if self.normalizer is not None:
            obs, next_obs = self.normalizer(obs), self.normalizer(next_obs)
        return ReplayBufferSamples(obs, action, next_obs, done, reward)

    def rows(self, at_risk: int) -> Rows:
        """Return the stored rows for a checkpoint, which may read them while the training goes on.

        Args:
            at_risk: number of steps that the training may store before the checkpoint reads the rows. The rows that
                these steps would overwrite are copied now.
        """
        first, stop = max(0, self.added - self.buffer_size), self.added
        overwritten = max(0, stop + at_risk - self.buffer_size - first)
        kept = self._read(first, first + overwritten)

        def read(start: int, end: int) -> dict[str, Tensor]:
            own = min(max(start, first + overwritten), end)
            early, late = slice(start - first, own - first), self._read(own, end)
            return {name: torch.cat([kept[name][early], late[name]]) for name in _COLUMNS}

        return Rows(first, stop, read)

    def load_rows(self, rows: Rows) -> None:
        """Restore the rows returned by `rows()`.

        Raises:
            ValueError: if the rows do not fit this buffer.
        """
        count = rows.stop - rows.first
        if not 0 <= count <= self.buffer_size:
            raise ValueError(
                f"replay: the checkpoint has {count} rows, but buffer_size is {self.buffer_size}; raise"
                " agent.buffer_size"
            )
        saved = rows.read(rows.first, rows.stop)
        if count:
            own = {name: getattr(self, name)[:count] for name in _COLUMNS}
            require_matching_tensors({name: saved[name] for name in own}, own, "replay")
        positions = torch.arange(rows.first, rows.stop) % self.buffer_size
        for name, values in saved.items():
            getattr(self, name)[positions] = values
        self.added = rows.first
        self._count(count)

    def _read(self, start: int, stop: int) -> dict[str, Tensor]:
        positions = torch.arange(start, stop) % self.buffer_size
        return {name: getattr(self, name)[positions] for name in _COLUMNS}

    def _count(self, steps: int) -> None:
        self.added += steps
        self.pos, self.full = self.added % self.buffer_size, self.added >= self.buffer_size


_COLUMNS = ("obs", "next_obs", "action", "reward", "done")
