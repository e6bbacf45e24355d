"""What PPO minimises, and what it does to the gradient and the learning rate: functions of tensors alone.

So they run as they stand on a CPU, and a GPU may run them as a compiler fuses them (`rlcli.rl.fusion`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rlcli.rl.networks import ActorCritic
from rlcli.rl.ppo_config import PpoConfig
from rlcli.rl.ppo_rollout import Samples

METRICS = ("surrogate", "value", "entropy", "kl", "clip_fraction", "bounds")
"""What is reported of a minibatch."""
KL = METRICS.index("kl")


class Judged(NamedTuple):
    """What a minibatch says of the networks as they are."""

    loss: Tensor
    """What to descend. ()"""
    metrics: Tensor
    """`METRICS`, without a gradient. (6,)"""
    mean: Tensor
    """Mean actions, without a gradient. (n, a)"""
    std: Tensor
    """Their deviation, without a gradient. (a,)"""


def judge(
    networks: ActorCritic,
    config: PpoConfig,
    batch: Samples,
    obs: Tensor,
    critic_obs: Tensor,
    advantage: Tensor,
    old_std: Tensor,
) -> Judged:
    """The clipped surrogate objective of a minibatch.

    Args:
        networks: actor and critic.
        config: weights and clipping.
        batch: the samples. (n, ...)
        obs: what the actor's network sees of them. (n, d)
        critic_obs: what the critic's does. (n, c)
        advantage: as it is to be weighed. (n,)
        old_std: deviation of the policy that `batch.mean` is of. (a,)
    """
    value_loss = _value_loss(networks.value(critic_obs), batch, config)
    hidden = networks.hidden(obs)
    std, mean = networks.std, networks.actor[-1](hidden)

    log_ratio = log_prob((batch.action - mean) / std, std) - batch.log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - config.clip_range, 1.0 + config.clip_range)
    surrogate = -torch.min(advantage * ratio, advantage * clipped).mean()
    spread = entropy(std)
    loss = surrogate + config.value_coef * value_loss - config.entropy_coef * spread
    if networks.teller is not None:
        loss = loss + config.tell_coef * (networks.teller(hidden) - _standard(critic_obs)).square().mean()
    if config.bounds_coef:
        bounds = (mean.abs() - config.bounds_margin).clamp(min=0.0).square().sum(dim=-1).mean()
        loss = loss + config.bounds_coef * bounds
    else:
        bounds = torch.zeros_like(loss)

    with torch.no_grad():
        kl = policy_divergence(config, (batch.mean - mean).square().mean(dim=0), std, old_std)
        clip_fraction = (ratio != clipped).float().mean()
        metrics = torch.stack((surrogate, value_loss, spread, kl, clip_fraction, bounds))
    return Judged(loss, metrics, mean.detach(), std.detach())


def clip_gradient_(parts: Sequence[Tensor], most: float) -> None:
    """Shrink each part of a gradient, in place, to a norm of `most`."""
    for part in parts:
        part.mul_((most / (part.norm() + 1e-6)).clamp(max=1.0))


def adapt_(rate: Tensor, ceiling: Tensor, kl: Tensor, config: PpoConfig) -> None:
    """Move the learning rate, in place, to where the divergence is as desired."""
    desired, low = config.desired_kl, config.learning_rate_range[0]
    assert desired is not None
    slower, faster = (rate / 1.5).clamp(min=low), (rate * 1.5).minimum(ceiling)
    # a divergence from the rollout is 0 before the first step; one from the last pass is 0 all through the first
    too_small = (kl < 0.5 * desired) & (kl > (0.0 if config.kl_from == "rollout" else -1.0))
    rate.copy_(torch.where(kl > 2.0 * desired, slower, torch.where(too_small, faster, rate)))


class Parts(NamedTuple):
    """What an update is made of, as it stands or compiled."""

    judge: Callable[..., Judged] = judge
    clip_: Callable[..., None] = clip_gradient_
    adapt_: Callable[..., None] = adapt_


def log_prob(noise: Tensor, std: Tensor) -> Tensor:
    """Log-density of `mean + std * noise`. (n, a), (a,) -> (n,)"""
    return -(0.5 * noise.square() + std.log() + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)


def entropy(std: Tensor) -> Tensor:
    """Of a Gaussian with these deviations. (a,) -> ()"""
    return (std.log() + 0.5 * math.log(2.0 * math.pi * math.e)).sum()


def policy_divergence(config: PpoConfig, distance: Tensor, std: Tensor, old_std: Tensor) -> Tensor:
    """Between old and new policy, the way round that is asked for.

    Args:
        config: of which `kl_from` counts.
        distance: mean square of what their mean actions differ by. (a,)
        std: the new deviation. (a,)
        old_std: the old one. (a,)
    """
    if config.kl_from == "rollout":
        return _divergence(distance, old_std, std)
    return _divergence(distance, std, old_std, eps=1e-5)


def _standard(values: Tensor) -> Tensor:
    """Each column less its mean, by its deviation, within +-3. (n, d)"""
    deviation, mean = torch.std_mean(values, dim=0)
    return ((values - mean) / (deviation + 1e-6)).clamp(-3.0, 3.0)


def _value_loss(value: Tensor, batch: Samples, config: PpoConfig) -> Tensor:
    error = (value - batch.target).square()
    if config.clip_value is not None:
        most = config.clip_value_range or config.clip_range
        clipped = batch.value + (value - batch.value).clamp(-most, most)
        clipped_error = (clipped - batch.target).square()
        error = torch.max(error, clipped_error) if config.clip_value == "larger" else clipped_error
    return error.mean()


def _divergence(distance: Tensor, std: Tensor, other_std: Tensor, eps: float = 0.0) -> Tensor:
    """Mean of KL(N(mean, std) || N(other_mean, other_std)), from the mean square of what the means differ by. (a,)"""
    variances = (std.square() + distance) / (2.0 * (other_std.square() + eps))
    return ((other_std / std + eps).log() + variances - 0.5).sum()
