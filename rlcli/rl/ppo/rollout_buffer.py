"""Buffer of a rollout's samples, allocated once on the device and written in place; it also makes the minibatches."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rlcli.machine.memory import require_memory
from rlcli.sim.state_cache import is_finite


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of a rollout or a minibatch. All fields are columns of one packed tensor. (..., d) or (...)

    One gather operation on the packed tensor therefore fills a minibatch.
    """

    obs: Tensor
    """Normalised observation of the actor."""
    critic_obs: Tensor
    """Normalised observation of the critic."""
    action: Tensor
    """Sampled action, before it is clipped to a bound."""
    mean: Tensor
    """Mean of the distribution that the action was sampled from."""
    log_prob: Tensor
    """Log-probability density of the action."""
    value: Tensor
    """The critic's value of the observation, normalised if the agent normalises values."""
    advantage: Tensor
    target: Tensor
    """Regression target of the critic: advantage + value."""
    episode_start: Tensor
    """1 at the first step of an episode, 0 elsewhere."""

    @classmethod
    def views(cls, packed: Tensor, obs: int, critic_obs: int, action: int) -> Samples:
        """Return samples whose tensors are views of the columns of `packed`.

        Args:
            packed: memory of the samples. (..., columns)
            obs: number of columns of the actor's observation.
            critic_obs: number of columns of the critic's observation; 0: the critic reads the actor's observation.
            action: number of columns of the action.
        """
        parts = packed.split_with_sizes([obs, critic_obs, action, action, 1, 1, 1, 1, 1], dim=-1)
        scalars = [part.squeeze(-1) for part in parts[4:]]
        return cls(parts[0], parts[1] if critic_obs else parts[0], parts[2], parts[3], *scalars)

    def first_half(self) -> Samples:
        """Return the first half of a minibatch, without the second half, which has the mirror images of the samples."""
        return Samples(*(getattr(self, each.name).chunk(2)[0] for each in fields(self)))


class RolloutBuffer:
    """Samples of a rollout, and a copy of them in the order of the minibatches.

    Args:
        steps: number of steps of every environment.
        envs: number of environments.
        sizes: columns of the actor's observation, of the critic's observation (0: the actor's) and of the action.
        minibatches: number of samples of each minibatch.
        whole_envs: whether a minibatch holds all steps of its environments.
        device: device of all tensors.
        mirrored: whether each minibatch also holds the mirror images of its samples, after all samples.

    Raises:
        MachineError: if the CPU's memory is too small for the buffer.
    """

    def __init__(
        self,
        steps: int,
        envs: int,
        sizes: tuple[int, int, int],
        minibatches: list[int],
        whole_envs: bool,
        device: torch.device,
        mirrored: bool = False,
    ) -> None:
        obs, critic_obs, action = sizes
        copies = 1 + mirrored
        if device.type == "cpu":
            columns = 2 * (obs + critic_obs + 2 * action + 5) + (critic_obs or obs) + 2
            size = copies * steps * envs
            require_memory(size * (4 * columns + 17), f"the {size} samples of a rollout")
        self._packed = torch.zeros(copies * steps, envs, obs + critic_obs + 2 * action + 5, device=device)
        self.columns, self.sizes = sizes, [copies * size for size in minibatches]
        self._samples_of_minibatches = minibatches
        self.samples = Samples.views(self._packed[:steps], *sizes)
        """Samples in the order in which they were collected. (num_steps, num_envs, ...)"""
        self.images = Samples.views(self._packed[steps:], *sizes) if mirrored else None
        """Mirror images of the samples. (num_steps, num_envs, ...)"""
        self.move(torch.zeros(self._packed.shape[0] * envs, self._packed.shape[2], device=device))
        self.old_std = torch.ones(len(minibatches), action, device=device)
        """Standard deviation of the old policy, for each minibatch; its mean is `Samples.mean`. (minibatches, a)"""
        self.reward = torch.zeros(steps, envs, device=device)
        self.done = torch.zeros(steps, envs, device=device)
        """1 where the step ended the episode by termination or truncation, 0 elsewhere. (num_steps, num_envs)"""
        self.time_out = torch.zeros(steps, envs, dtype=torch.bool, device=device)
        """True where the episode was truncated and not terminated. (num_steps, num_envs)"""
        self.final_obs = torch.zeros(steps, envs, critic_obs or obs, device=device)
        """Normalised last observation of the episode for the critic. (num_steps, num_envs, c)

        Valid only where `time_out` is true.
        """
        self._indices = torch.arange(steps * envs, device=device).view(steps, envs)
        self.by_environment = self._indices.T.flatten()
        """Indices of the samples, all steps of the first environment first, then all of the second, ... (samples,)"""
        parts = self._indices[0].split_with_sizes([size // steps for size in minibatches]) if whole_envs else ()
        self.environments = [part.clone() for part in parts]
        """Environments of each minibatch; empty without `whole_envs`. (n,) each"""

    def move(self, memory: Tensor) -> None:
        """Use `memory` for the minibatches, one after the other. (samples of all minibatches, columns)"""
        self.ordered = memory
        self.minibatches = [Samples.views(part, *self.columns) for part in memory.split_with_sizes(self.sizes)]
        """Samples of each minibatch, views of `ordered`. (n, ...) each"""

    def is_finite(self) -> bool:
        """Return whether all samples are finite."""
        return is_finite(self._packed)

    def in_causal_order(self) -> list[tuple[str, Tensor]]:
        """Return (name, tensor) of all samples for `require_finite`, in the order in which they are computed.

        Each tensor comes after those that it is computed from. (num_steps, num_envs, ...) each
        """
        samples = self.samples
        final_obs = torch.where(self.time_out[..., None], self.final_obs, 0.0)
        return [
            ("the observation of the actor", samples.obs),
            ("the mean action", samples.mean),
            ("the action", samples.action),
            ("the action's log-probability", samples.log_prob),
            ("the reward", self.reward),
            ("the observation of the critic", samples.critic_obs),
            ("the last observation of the critic", final_obs),
            ("the value", samples.value),
            ("the advantage", samples.advantage),
            ("the value's target", samples.target),
        ]

    def order_by_environment(self, environments: Tensor) -> Tensor:
        """Assign environments to minibatches in the order of `environments`; return the indices of the samples.

        Within a minibatch the samples are ordered by step. The indices are as in `fill_minibatches`.
        """
        parts = environments.split_with_sizes([len(own) for own in self.environments])
        for own, part in zip(self.environments, parts, strict=True):
            own.copy_(part)
        return torch.cat([self._indices.index_select(1, part).flatten() for part in parts])

    def fill_minibatches(self, order: Tensor) -> None:
        """Copy the samples into the minibatches in the given order, with their mirror images if there are any.

        `order` has the indices of the samples; the sample of environment env in step t has index t * num_envs + env.
        """
        if self.images is not None:
            parts = order.split_with_sizes(self._samples_of_minibatches)
            order = torch.cat([torch.cat((part, part + len(order))) for part in parts])
        torch.index_select(self._packed.view(self.ordered.shape), 0, order, out=self.ordered)
