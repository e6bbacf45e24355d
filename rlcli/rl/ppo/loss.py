"""Loss of PPO, gradient clipping and adaptive learning rate, as functions of tensors.

On a GPU torch's compiler may fuse these functions (`rlcli.rl.ppo.compile`); on a CPU they run uncompiled by default.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rlcli.rl.distributed import ProcessGroup
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.networks import ActorCritic
from rlcli.rl.ppo.rollout_buffer import Samples

METRICS = ("surrogate", "value", "entropy", "kl", "clip_fraction", "bounds", "mirror")
"""Metrics of a minibatch, in the order of `LossResult.metrics`."""
KL = METRICS.index("kl")
"""Index of the KL divergence in `METRICS`."""


class LossResult(NamedTuple):
    """Loss of a minibatch, its metrics and the new policy's distribution."""

    loss: Tensor
    """Loss that the optimiser minimises. (scalar)"""
    metrics: Tensor
    """Values of `METRICS`, detached. (7,)"""
    mean: Tensor
    """Mean actions, detached. (n, a)"""
    std: Tensor
    """Standard deviation of the actions, detached. (a,)"""


def minibatch_loss(
    networks: ActorCritic,
    config: PpoConfig,
    batch: Samples,
    obs: Tensor,
    critic_obs: Tensor,
    advantage: Tensor,
    old_std: Tensor,
) -> LossResult:
    """Return the loss of a minibatch: the negative of equations 7 and 9 of Schulman et al. 2017 (PPO):

        r_t      = pi(a_t | s_t) / pi_old(a_t | s_t)
        L_clip   = mean( min( r_t A_t, clip(r_t, 1 - clip_range, 1 + clip_range) A_t ) )            (7)
        loss     = - ( L_clip - value_coef * L_value + entropy_coef * entropy )                     (9)

    Further terms are added to the loss if the agent uses them:

        tell_coef x mean squared error of the auxiliary layer `teller`, which predicts the critic's observation
            (standardised, clipped to +-3) from the actor's last hidden layer
        bounds_coef x mean over samples of the squared part of |mean action| above bounds_margin
        mirror_coef x `ActorCritic.mirror_error`

    Args:
        networks: actor, critic and auxiliary layer.
        config: coefficients and clipping.
        batch: the samples; with `symmetry.augment` the second half are the mirror images of the first. (n, ...)
        obs: inputs of the actor's network; with `symmetry` the second half are mirror images. (n or 2 n, d)
        critic_obs: inputs of the critic's network. (n, c)
        advantage: A_t, normalised if the agent normalises advantages. (n,)
        old_std: standard deviation of the policy whose mean is `batch.mean`. (a,)
    """
    hidden = networks.hidden(obs)
    std, mean = networks.std, networks.actor[-1](hidden)
    mirror, all_means = networks.mirror_error(mean), mean.detach()
    if len(mean) > len(advantage):
        hidden, mean = hidden[: len(advantage)], mean[: len(advantage)]
    value_loss = _value_loss(networks.value(critic_obs), batch, config)
    log_ratio = log_prob((batch.action - mean) / std, std) - batch.log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - config.clip_range, 1.0 + config.clip_range)
    surrogate = -torch.min(advantage * ratio, advantage * clipped).mean()  # equation 7, negative
    policy_entropy = entropy(std)
    loss = surrogate + config.value_coef * value_loss - config.entropy_coef * policy_entropy  # equation 9, negative
    if networks.teller is not None:
        target = _clipped_standard_score(critic_obs)
        loss = loss + config.tell_coef * (networks.teller(hidden) - target).square().mean()
    if config.bounds_coef:
        bounds = (mean.abs() - config.bounds_margin).clamp(min=0.0).square().sum(dim=-1).mean()
        loss = loss + config.bounds_coef * bounds
    else:
        bounds = torch.zeros_like(loss)

    if config.symmetry is not None and config.symmetry.mirror_coef:
        loss = loss + config.symmetry.mirror_coef * mirror

    with torch.no_grad():
        kl = policy_divergence(config, (batch.mean - mean).square().mean(dim=0), std, old_std)
        clip_fraction = (ratio != clipped).float().mean()
        metrics = torch.stack((surrogate, value_loss, policy_entropy, kl, clip_fraction, bounds, mirror))
    return LossResult(loss, metrics, all_means, std.detach())


def clip_gradient_(parts: Sequence[Tensor], max_norm: float) -> None:
    """Scale each part of a gradient to a norm of at most `max_norm`, in place."""
    for part in parts:
        part.mul_((max_norm / (part.norm() + 1e-6)).clamp(max=1.0))


def adapt_learning_rate_(rate: Tensor, ceiling: Tensor, kl: Tensor, config: PpoConfig) -> None:
    """Adapt the learning rate to the KL divergence, in place, as RSL-RL (Rudin et al. 2022) does:

        kl > 2 desired_kl       ->  rate = max(rate / 1.5, lower end of learning_rate_range)
        kl < desired_kl / 2     ->  rate = min(rate * 1.5, ceiling)

    Section 4 of Schulman et al. 2017 (PPO) adapts beta, the weight of the KL penalty in equation 8, in a similar way.
    """
    desired, low = config.desired_kl, config.learning_rate_range[0]
    assert desired is not None
    slower, faster = (rate / 1.5).clamp(min=low), (rate * 1.5).minimum(ceiling)
    # kl_from "rollout": a KL of 0 means the first optimiser step, before any change; the rate stays.
    # kl_from "last_pass": the KL is 0 in the whole first epoch; the rate grows, as in rl_games.
    too_small = (kl < 0.5 * desired) & (kl > (0.0 if config.kl_from == "rollout" else -1.0))
    rate.copy_(torch.where(kl > 2.0 * desired, slower, torch.where(too_small, faster, rate)))


class UpdateFunctions(NamedTuple):
    """Functions of an update that torch can compile: loss, gradient clipping, adaptive learning rate."""

    loss: Callable[..., LossResult] = minibatch_loss
    clip_gradient_: Callable[..., None] = clip_gradient_
    adapt_learning_rate_: Callable[..., None] = adapt_learning_rate_


def standardize(values: Tensor, process_group: ProcessGroup) -> Tensor:
    """Return (values - mean) / std, with mean and unbiased std over the elements of all processes. (...) -> (...)"""
    deviation = values - process_group.average_(values.mean())
    count = values.numel() * process_group.world_size
    variance = process_group.average_(deviation.square().mean()) * (count / (count - 1))
    return deviation / (variance.sqrt() + 1e-8)


def log_prob(noise: Tensor, std: Tensor) -> Tensor:
    """Return the Gaussian log density of the action `mean + std * noise`. (n, a), (a,) -> (n,)"""
    return -(0.5 * noise.square() + std.log() + 0.5 * math.log(2.0 * math.pi)).sum(dim=-1)


def entropy(std: Tensor) -> Tensor:
    """Return the entropy of a diagonal Gaussian: sum of log std + log(2 pi e) / 2. (a,) -> scalar"""
    return (std.log() + 0.5 * math.log(2.0 * math.pi * math.e)).sum()


def policy_divergence(config: PpoConfig, distance: Tensor, std: Tensor, old_std: Tensor) -> Tensor:
    """Return the KL divergence between old and new policy: KL(old || new) for kl_from "rollout", else KL(new || old).

    Args:
        config: configuration of the agent.
        distance: mean over the samples of (old mean action - new mean action)^2. (a,)
        std: standard deviation of the new policy. (a,)
        old_std: standard deviation of the old policy. (a,)
    """
    if config.kl_from == "rollout":
        return _divergence(distance, old_std, std)
    return _divergence(distance, std, old_std, eps=1e-5)  # rl_games adds this epsilon


def _clipped_standard_score(values: Tensor) -> Tensor:
    """Return (column - mean) / std for each column, clipped to +-3. (n, d)"""
    deviation, mean = torch.std_mean(values, dim=0)
    return ((values - mean) / (deviation + 1e-6)).clamp(-3.0, 3.0)


def _value_loss(value: Tensor, batch: Samples, config: PpoConfig) -> Tensor:
    """Return the value loss: the mean squared error of the critic's values (n,) for a minibatch. (scalar)

    With `clip_value` the change of the value is clipped, as in OpenAI Baselines:

        V_clip = V_old + clip(V - V_old, -limit, limit)
    """
    error = (value - batch.target).square()
    if config.clip_value is not None:
        limit = config.clip_value_range or config.clip_range
        clipped = batch.value + (value - batch.value).clamp(-limit, limit)
        clipped_error = (clipped - batch.target).square()
        error = torch.max(error, clipped_error) if config.clip_value == "larger" else clipped_error
    return error.mean()


def _divergence(distance: Tensor, std: Tensor, other_std: Tensor, eps: float = 0.0) -> Tensor:
    """Return the mean over samples of KL(N(mean, std) || N(other_mean, other_std)). (a,) -> ()

        KL = sum over actions of  log(other_std / std) + (std^2 + (mean - other_mean)^2) / (2 other_std^2) - 1/2

    `distance` is the mean over the samples of (mean - other_mean)^2.
    """
    variances = (std.square() + distance) / (2.0 * (other_std.square() + eps))
    return ((other_std / std + eps).log() + variances - 0.5).sum()
