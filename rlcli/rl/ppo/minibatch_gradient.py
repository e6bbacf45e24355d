"""Gradient of a minibatch's loss: by autograd, or in closed form, which is faster for MLPs on a CPU.

Both computations have the same arguments and write the same vector: the gradient of all parameters, followed by the KL
divergence.

The closed form differentiates the loss of `rlcli.rl.ppo.loss.minibatch_loss` (equations 7 and 9 of Schulman et al.
2017) with respect to the networks' outputs. With z = (a - mean) / std, n samples and the ratio r:

    log pi           = - sum over actions of (z^2 / 2 + log std + log(2 pi) / 2)
    dlog pi/dmean    = z / std
    dlog pi/dlog std = z^2 - 1
    dL_clip/dlog pi  = r A / n   where r A is the minimum in equation 7, else 0
    dL_value/dvalue  = 2 (value - target) / n

Where a minimum or a maximum has two equal arguments, each gets half of the gradient, as in autograd.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from rlcli.rl.mlp import is_plain
from rlcli.rl.mlp_gradients import MlpGradients
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.loss import KL, LossResult, entropy, log_prob, minibatch_loss, policy_divergence
from rlcli.rl.ppo.networks import ActorCritic
from rlcli.rl.ppo.rollout_buffer import Samples

_HALF = torch.tensor(0.5)


MinibatchGradient = Callable[[PpoConfig, Samples, Tensor, Tensor, Tensor, Tensor], LossResult]
"""Function that computes the loss of a minibatch and writes its gradient; for its arguments see `minibatch_loss`."""


class LayerGradients(Protocol):
    """Function that computes the gradients of the layers of actor and critic for a minibatch."""

    def __call__(self, obs: Tensor, critic_obs: Tensor, objective: Objective) -> tuple[Tensor, Tensor]:
        """Write the gradients of all layers.

        Args:
            obs: inputs of the actor. (n, d)
            critic_obs: inputs of the critic. (n, c)
            objective: the loss as a function of the networks' outputs.

        Returns:
            The statistics of `Objective.mean_gradient`, (3 + 2 a,), and `value_gradient`, (), summed over all samples.
        """


MakeLayerGradients = Callable[[Sequence[Tensor]], LayerGradients]
"""Function from the tensors for the gradients of all parameters to the function that writes these gradients."""


def threaded_gradients(networks: ActorCritic, rows: int, threads: int) -> MakeLayerGradients:
    """Return a factory of functions (`LayerGradients`) that compute gradients in threads of this process.

    Args:
        networks: actor and critic, MLPs.
        rows: number of samples of the largest minibatch.
        threads: number of threads.
    """

    def make(gradients: Sequence[Tensor]) -> LayerGradients:
        mlps = MlpGradients(networks.actor, networks.critic, gradients, rows, threads)
        return lambda obs, critic_obs, o: mlps(obs, critic_obs, o.mean_gradient, o.value_gradient)

    return make


class AutogradGradient:
    """Gradient by autograd, for any networks and any device.

    Args:
        networks: actor and critic.
        out: vector for the gradient and, after it, the KL divergence.
        loss: `minibatch_loss`, compiled or not.
    """

    def __init__(self, networks: ActorCritic, out: Tensor, loss: Callable[..., LossResult] = minibatch_loss) -> None:
        self._networks, self._out, self._loss = networks, out, loss

    def __call__(
        self, config: PpoConfig, batch: Samples, obs: Tensor, critic_obs: Tensor, advantage: Tensor, old_std: Tensor
    ) -> LossResult:
        """Return the loss of a minibatch and write its gradient into `out`."""
        if config.symmetry is not None and not config.symmetry.augment:  # images are for the mirror loss only
            batch, critic_obs, advantage = batch.first_half(), critic_obs.chunk(2)[0], advantage.chunk(2)[0]
        result = self._loss(self._networks, config, batch, obs, critic_obs, advantage, old_std)
        gradients = torch.autograd.grad(result.loss, list(self._networks.parameters()))
        torch.cat([*(part.flatten() for part in gradients), result.metrics[KL : KL + 1]], out=self._out)
        return result


def has_closed_form(networks: ActorCritic, config: PpoConfig) -> bool:
    """Return whether `ClosedFormGradient` supports the agent: MLPs on a CPU, no RNN, no CNN, no auxiliary loss."""
    others = (networks.memory, networks.vision, networks.critic_vision, networks.teller)
    if config.symmetry is not None and config.symmetry.mirror_coef:
        return False
    return all(other is None for other in others) and all(map(is_plain, (networks.actor, networks.critic)))


class ClosedFormGradient:
    """Gradient of a minibatch's loss in closed form, for MLPs on a CPU.

    Args:
        networks: actor and critic for which `has_closed_form` is true.
        out: vector for the gradient and, after it, the KL divergence.
        slices: parameter name -> slice of its gradient in `out`.
        compute: function that takes the tensors for the gradients and returns the function that writes the gradients
            there, such as the result of `threaded_gradients`.
    """

    def __init__(
        self, networks: ActorCritic, out: Tensor, slices: Mapping[str, slice], compute: MakeLayerGradients
    ) -> None:
        self._networks, self._out = networks, out
        parameters = dict(networks.named_parameters())
        gradients = {name: out[part].view_as(parameters[name]) for name, part in slices.items()}
        (name,) = (name for name in gradients if name.endswith("_std"))
        self._std_gradient = gradients.pop(name)
        self._compute = compute(list(gradients.values()))

    def __call__(
        self, config: PpoConfig, batch: Samples, obs: Tensor, critic_obs: Tensor, advantage: Tensor, old_std: Tensor
    ) -> LossResult:
        """Return the loss of a minibatch, without an autograd graph, and write its gradient into `out`."""
        networks = self._networks
        with torch.no_grad():
            std, policy_entropy = networks.std, entropy(networks.std)
            objective = Objective(config, batch, advantage, std, torch.empty_like(batch.mean))
            sums = self._compute(obs, critic_obs, objective)
            actor_means, value_loss = (values / len(advantage) for values in sums)
            losses, log_std_gradient, distance = actor_means.split_with_sizes([3, len(std), len(std)])
            surrogate, clip_fraction, bounds = losses
            # the entropy has the gradient 1 with respect to each log std
            self._std_gradient.copy_(networks.std_gradient(log_std_gradient - config.entropy_coef))
            kl = policy_divergence(config, distance, std, old_std)
            self._out[-1:].copy_(kl)
            loss = surrogate + config.value_coef * value_loss - config.entropy_coef * policy_entropy
            loss = loss + config.bounds_coef * bounds
            mirror = networks.mirror_error(objective.mean)
            metrics = torch.stack((surrogate, value_loss, policy_entropy, kl, clip_fraction, bounds, mirror))
        return LossResult(loss, metrics, objective.mean, std)


class Objective:
    """Loss of a minibatch as a function of the networks' outputs, with the gradient with respect to the outputs.

    Args:
        config: configuration of the agent.
        batch: the minibatch.
        advantage: advantages, normalised if the agent normalises advantages. (n,)
        std: standard deviation of the policy. (a,)
        mean: memory for the outputs of the actor. (n, a)
    """

    def __init__(self, config: PpoConfig, batch: Samples, advantage: Tensor, std: Tensor, mean: Tensor) -> None:
        self._config, self.batch, self.advantage, self.std, self.mean = config, batch, advantage, std, mean
        self._mean_scale = 1.0 / (std * len(advantage))

    def mean_gradient(self, rows: slice, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradient of the loss with respect to the actor's outputs, (n, a), and statistics, (3 + 2 a,).

        The statistics are sums over the samples: surrogate, number of clipped ratios and bounds loss, (3,); gradients
        of the log std, (a,); squared distances between old and new mean, (a,).

        Args:
            rows: which samples of the minibatch, a part of it.
            mean: outputs of the actor for these samples. (n, a)
        """
        config, batch = self._config, self.batch
        self.mean[rows] = mean
        distance = (batch.mean[rows] - mean).square_().sum(dim=0)
        noise = (batch.action[rows] - mean).div_(self.std)
        surrogate, clipped, log_prob_gradient, log_std_gradient = self._surrogate(rows, noise)
        gradient = noise.mul_(log_prob_gradient[:, None]).mul_(self._mean_scale)  # dlog pi/dmean = z / std
        bounds = torch.zeros(())
        if config.bounds_coef:
            excess = (mean.abs() - config.bounds_margin).clamp_(min=0.0)
            bounds = excess.square().sum()
            gradient += excess.mul_(mean.sign()).mul_(2.0 * config.bounds_coef / len(self.advantage))
        return gradient, torch.cat((torch.stack((surrogate, clipped, bounds)), log_std_gradient, distance))

    def value_gradient(self, rows: slice, value: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gradient of the loss with respect to the critic's outputs, (n, 1), and the sum of squared errors.

        Args:
            rows: which samples of the minibatch, a part of it.
            value: outputs of the critic for these samples. (n, 1)
        """
        config, value, old_value = self._config, value.squeeze(-1), self.batch.value[rows]
        error = value - self.batch.target[rows]
        if config.clip_value is None:
            gradient, square = error, error.square()
        else:
            limit = config.clip_value_range or config.clip_range
            change = value - old_value
            within = change.clamp(-limit, limit)
            clipped = old_value + within - self.batch.target[rows]
            # inside the range, `clipped` equals `error` up to rounding; outside, its gradient is 0
            gradient, square = torch.where(change == within, clipped, 0.0), clipped.square()
            if config.clip_value == "larger":
                plain = error.square()
                gradient = torch.lerp(gradient, error, _share_of_minimum(square, plain))
                square = torch.max(plain, square)
        # `gradient` is half the derivative of `square`
        return gradient.mul_(2.0 * config.value_coef / len(self.advantage))[:, None], square.sum()

    def _surrogate(self, rows: slice, noise: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the surrogate loss (equation 7), the number of clipped ratios, dL/dlog pi (n,) and dL/dlog std (a,).

        Args:
            rows: which samples of the minibatch, a part of it.
            noise: (action - mean) / std of these samples. (n, a)
        """
        limit, advantage, square = self._config.clip_range, self.advantage[rows], noise.square()
        ratio = (log_prob(noise, self.std) - self.batch.log_prob[rows]).exp_()
        within = ratio.clamp(1.0 - limit, 1.0 + limit)
        plain, bounded, clipped = advantage * ratio, advantage * within, ratio != within
        # dr/dlog pi = r, so dL_clip/dlog pi = r A = `plain` where the minimum is not the clipped product
        share = torch.where(clipped, _share_of_minimum(plain, bounded), 1.0)
        log_prob_gradient = share.mul_(plain).neg_()
        # dlog pi/dlog std = z^2 - 1, summed over the samples
        log_std_gradient = torch.mv(square.t(), log_prob_gradient) - log_prob_gradient.sum()
        return -torch.min(plain, bounded).sum(), clipped.sum(), log_prob_gradient, log_std_gradient


def _share_of_minimum(one: Tensor, other: Tensor) -> Tensor:
    """Return 1 where `one` is smaller than `other`, 0.5 where both are equal, 0 elsewhere."""
    return torch.heaviside(other - one, _HALF)
