"""What a rollout gathers, on the device and in place."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.sim.state import is_finite


@dataclass(frozen=True, slots=True)
class Samples:
    """Columns of one array, so that a minibatch is one gather. (..., d) each, numbers (...)"""

    obs: Tensor
    """As the actor saw it."""
    critic_obs: Tensor
    """As the critic saw it."""
    action: Tensor
    """As drawn, before it is clipped to a bound."""
    mean: Tensor
    """Of the distribution that it was drawn from."""
    log_prob: Tensor
    value: Tensor
    advantage: Tensor
    target: Tensor
    """What the critic should have said."""
    begins: Tensor
    """1 where an episode begins, 0 elsewhere."""

    @classmethod
    def views(cls, packed: Tensor, obs: int, critic_obs: int, action: int) -> Samples:
        """The columns of `packed`; with a `critic_obs` of 0 the critic sees what the actor does."""
        parts = packed.split([obs, critic_obs, action, action, 1, 1, 1, 1, 1], dim=-1)
        numbers = [part.squeeze(-1) for part in parts[4:]]
        return cls(parts[0], parts[1] if critic_obs else parts[0], parts[2], parts[3], *numbers)


class Rollout:
    """`num_steps` of every environment, and the same samples in the order of the minibatches.

    Args:
        steps: of every environment.
        envs: how many environments.
        sizes: columns of what the actor sees, of what the critic sees (0: the same) and of the action.
        minibatches: samples of each.
        whole: whether minibatches hold whole environments.
        device: where all of it lives.
    """

    def __init__(
        self,
        steps: int,
        envs: int,
        sizes: tuple[int, int, int],
        minibatches: list[int],
        whole: bool,
        device: torch.device,
    ) -> None:
        obs, critic_obs, action = sizes
        self._packed = torch.zeros(steps, envs, obs + critic_obs + 2 * action + 5, device=device)
        self._ordered = torch.zeros(self._packed.shape[0] * envs, self._packed.shape[2], device=device)
        self.samples = Samples.views(self._packed, *sizes)
        """(num_steps, num_envs, ...)"""
        self.minibatches = [Samples.views(part, *sizes) for part in self._ordered.split(minibatches)]
        """(n, ...) each"""
        self.reward = torch.zeros(steps, envs, device=device)
        self.ended = torch.zeros(steps, envs, device=device)
        """1 where the episode ended with the step, for whatever reason."""
        self.cut = torch.zeros(steps, envs, dtype=torch.bool, device=device)
        """Where it ended by time alone."""
        self.final_obs = torch.zeros(steps, envs, critic_obs or obs, device=device)
        """What the critic would have seen last; valid where cut."""
        numbers = torch.arange(steps * envs, device=device).view(steps, envs)
        self.by_environment = numbers.T.flatten()
        """An order in which the samples of an environment follow each other."""
        self._numbers = numbers
        parts = numbers[0].split([size // steps for size in minibatches]) if whole else ()
        self.environments = [part.clone() for part in parts]
        """The environments of each minibatch, where it holds them whole. (n,) each"""

    def is_finite(self) -> bool:
        """Whether all samples are."""
        return is_finite(self._packed)

    def in_order(self) -> list[tuple[str, Tensor]]:
        """What was gathered, in the order in which one thing is computed from the other. (num_steps, num_envs, ...)"""
        samples = self.samples
        return [
            ("the observation, as the actor sees it,", samples.obs),
            ("the mean action", samples.mean),
            ("the action", samples.action),
            ("the action's log-probability", samples.log_prob),
            ("the reward", self.reward),
            ("the observation, as the critic sees it,", samples.critic_obs),
            ("the last observation, as the critic sees it,", torch.where(self.cut[..., None], self.final_obs, 0.0)),
            ("the value", samples.value),
            ("the advantage", samples.advantage),
            ("the value's target", samples.target),
        ]

    def group(self, environments: Tensor) -> Tensor:
        """The order that deals `environments` out to the minibatches; within one, all of step 0 come first."""
        order, start = [], 0
        for own in self.environments:
            own.copy_(environments[start : start + len(own)])
            order.append(self._numbers.index_select(1, own).flatten())
            start += len(own)
        return torch.cat(order)

    def arrange(self, order: Tensor) -> None:
        """Fill the minibatches; sample (t, env) has number t * num_envs + env."""
        torch.index_select(self._packed.view(self._ordered.shape), 0, order, out=self._ordered)
