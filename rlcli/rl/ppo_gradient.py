"""The slope of PPO's objective in closed form, as autograd would find it: what `ppo_loss.judge` gives, on a CPU faster.

Where a minimum or a maximum is taken of two equal numbers, each of them counts half, which is autograd's convention.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from rlcli.rl.mlp import is_plain
from rlcli.rl.mlp_gradients import MlpGradients
from rlcli.rl.networks import ActorCritic
from rlcli.rl.ppo_config import PpoConfig
from rlcli.rl.ppo_loss import Judged, entropy, log_prob, policy_divergence
from rlcli.rl.ppo_rollout import Samples

_HALF = torch.tensor(0.5)


def has_closed_form(networks: ActorCritic) -> bool:
    """Whether the gradient is written out: of plain networks on a CPU, without memory, pictures or telling."""
    others = (networks.memory, networks.vision, networks.critic_vision, networks.teller)
    return all(other is None for other in others) and all(map(is_plain, (networks.actor, networks.critic)))


class PpoGradient:
    """Judges minibatches, and writes the gradient, followed by the divergence, into one vector.

    Args:
        networks: actor and critic, of which `has_closed_form` holds.
        shared: the vector.
        places: where in it each parameter's gradient lies.
        rows: samples of the largest minibatch.
        threads: that share the work.
    """

    def __init__(
        self,
        networks: ActorCritic,
        shared: Tensor,
        places: Mapping[str, slice],
        rows: int,
        threads: int,
    ) -> None:
        self._networks, self._shared = networks, shared
        parameters = dict(networks.named_parameters())
        gradients = {name: shared[place].view_as(parameters[name]) for name, place in places.items()}
        (name,) = (name for name in gradients if name.endswith("_std"))
        self._of_std = gradients.pop(name)
        self._mlps = MlpGradients(networks.actor, networks.critic, list(gradients.values()), rows, threads)

    def __call__(self, config: PpoConfig, batch: Samples, advantage: Tensor, old_std: Tensor) -> Judged:
        """The same as `ppo_loss.judge`, but for what the loss carries: its gradient is written already."""
        networks = self._networks
        with torch.no_grad():
            std, spread = networks.std, entropy(networks.std)
            objective = _Objective(config, batch, advantage, std)
            sums = self._mlps(batch.obs, batch.critic_obs, objective.of_mean, objective.of_value)
            of_actor, value_loss = (values / len(advantage) for values in sums)
            losses, of_std, distance = of_actor.split([3, len(std), len(std)])
            surrogate, clip_fraction, bounds = losses
            self._of_std.copy_(networks.std_gradient(of_std - config.entropy_coef))
            kl = policy_divergence(config, distance, std, old_std)
            self._shared[-1:].copy_(kl)
            loss = surrogate + config.value_coef * value_loss - config.entropy_coef * spread
            loss = loss + config.bounds_coef * bounds
            metrics = torch.stack((surrogate, value_loss, spread, kl, clip_fraction, bounds))
        return Judged(loss, metrics, objective.mean, std)


class _Objective:
    """What a minibatch's samples say of the networks' outputs, and how that changes with each of them."""

    def __init__(self, config: PpoConfig, batch: Samples, advantage: Tensor, std: Tensor) -> None:
        self._config, self._batch, self._advantage, self._std = config, batch, advantage, std
        self._of_mean = 1.0 / (std * len(advantage))
        self.mean = torch.empty_like(batch.mean)
        """The actor's outputs. (n, a)"""

    def of_mean(self, rows: slice, mean: Tensor) -> tuple[Tensor, Tensor]:
        """`rlcli.rl.mlp_gradients.Slopes`. Sums of losses, of clipped ratios, of slopes to the log-deviation."""
        config, batch = self._config, self._batch
        self.mean[rows] = mean
        distance = (batch.mean[rows] - mean).square_().sum(dim=0)
        noise = (batch.action[rows] - mean).div_(self._std)
        surrogate, clipped, of_log_prob, of_std = self._surrogate(rows, noise)
        of_mean = noise.mul_(of_log_prob[:, None]).mul_(self._of_mean)
        bounds = torch.zeros(())
        if config.bounds_coef:
            beyond = (mean.abs() - config.bounds_margin).clamp_(min=0.0)
            bounds = beyond.square().sum()
            of_mean += beyond.mul_(mean.sign()).mul_(2.0 * config.bounds_coef / len(self._advantage))
        return of_mean, torch.cat((torch.stack((surrogate, clipped, bounds)), of_std, distance))

    def of_value(self, rows: slice, value: Tensor) -> tuple[Tensor, Tensor]:
        """`rlcli.rl.mlp_gradients.Slopes`. The sum of the errors."""
        config, batch = self._config, self._batch
        error, slope = _value_error(value.squeeze(-1), batch.value[rows], batch.target[rows], config)
        return slope.mul_(2.0 * config.value_coef / len(self._advantage))[:, None], error

    def _surrogate(self, rows: slice, noise: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The clipped surrogate, how many ratios are clipped, its slopes to log-probabilities and log-deviations."""
        most, advantage, square = self._config.clip_range, self._advantage[rows], noise.square()
        ratio = (log_prob(noise, self._std) - self._batch.log_prob[rows]).exp_()
        within = ratio.clamp(1.0 - most, 1.0 + most)
        plain, bounded, clipped = advantage * ratio, advantage * within, ratio != within
        share = torch.where(clipped, _share(plain, bounded), 1.0)
        of_log_prob = share.mul_(plain).neg_()
        of_std = torch.mv(square.t(), of_log_prob) - of_log_prob.sum()
        return -torch.min(plain, bounded).sum(), clipped.sum(), of_log_prob, of_std


def _value_error(value: Tensor, old: Tensor, target: Tensor, config: PpoConfig) -> tuple[Tensor, Tensor]:
    """The sum of squares that `ppo_loss.judge` means, and half its slope to each value. (n,) each -> (), (n,)"""
    error = value - target
    if config.clip_value is None:
        return error.square().sum(), error
    most = config.clip_value_range or config.clip_range
    change = value - old
    within = change.clamp(-most, most)
    clipped = old + within - target
    # within the range this is the error but for rounding, and has its slope
    slope, square = torch.where(change == within, clipped, 0.0), clipped.square()
    if config.clip_value == "larger":
        plain = error.square()
        slope, square = torch.lerp(slope, error, _share(square, plain)), torch.max(plain, square)
    return square.sum(), slope


def _share(one: Tensor, other: Tensor) -> Tensor:
    """1 where `one` is the smaller, 0.5 where they are equal, 0 elsewhere."""
    return torch.heaviside(other - one, _HALF)
