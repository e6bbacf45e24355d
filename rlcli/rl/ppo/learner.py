"""Update actor and critic of the PPO trainer: several epochs of minibatches over one rollout.

The method `update` of `Learner` has no arguments and no result, and never reads a value back from the device, so that a
GPU can capture it as a CUDA graph and replay it. The method `metrics` reads one small tensor.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rlcli.rl.nan_check import require_finite, require_finite_learner
from rlcli.rl.ppo.collector import Collector
from rlcli.rl.ppo.compile import compile_update, tf32_matmul
from rlcli.rl.ppo.loss import KL, METRICS, LossResult, UpdateFunctions, standardize
from rlcli.rl.ppo.minibatch_gradient import (
    AutogradGradient,
    ClosedFormGradient,
    MakeLayerGradients,
    MinibatchGradient,
    has_closed_form,
    threaded_gradients,
)
from rlcli.rl.ppo.networks import adam, flatten, unroll
from rlcli.rl.ppo.rollout_buffer import Samples
from rlcli.rl.ppo.setup import compile_mode
from rlcli.rl.trainer_base import finite_values
from rlcli.sim.state_cache import is_finite


class Learner:
    """Learner that updates actor and critic with the rollout of a collector.

    Args:
        collector: the collector of the rollouts.
        torch_threads: number of threads of the update.
    """

    def __init__(self, collector: Collector, torch_threads: int) -> None:
        config, process_group = collector.config, collector.process_group
        self.collector, self.config, self._process_group = collector, config, process_group
        self._networks, device = collector.networks, collector.env.device
        self._samples_per_rollout = config.num_steps * collector.env.num_envs
        self.weights, self.gradient_and_kl, slices = flatten(self._networks)
        self.gradient, self._minibatch_kl = self.gradient_and_kl[:-1], self.gradient_and_kl[-1]
        process_group.broadcast_(self.weights.data)
        actor_end = min(part.start for name, part in slices.items() if name.startswith("critic"))
        joint = config.clip_grad == "joint"
        self._clipped_parts = (self.gradient,) if joint else (self.gradient[:actor_end], self.gradient[actor_end:])
        self.learning_rate = torch.tensor(config.learning_rate, device=device)
        self._rate_ceiling = torch.tensor(config.learning_rate_range[1], device=device)
        self.optimizer = adam(self.weights, self.learning_rate, config.adam_eps)

        self._kl_sum = torch.zeros((), device=device)
        """KL divergences between old and new policy, summed over the minibatches of the current epoch. (scalar)"""
        self._metric_sums = torch.zeros(len(METRICS), device=device)
        self.metric_values = torch.zeros(len(METRICS) + 4, device=device)
        """`METRICS`, then mean action std, learning rate, 1 if all weights are finite, explained variance. (11,)"""

        self._tf32 = config.tf32 and device.type == "cuda"
        self.functions = UpdateFunctions()
        self.torch_threads = torch_threads
        """Number of torch's threads in `update`; 1 with the closed-form gradient, which starts its own threads."""
        self.minibatch_gradient: MinibatchGradient
        mode = compile_mode(config, device, self._samples_per_rollout * process_group.world_size)
        if mode:
            self.functions = compile_update(self.functions, self._call_all, tuned=mode == "tuned")
        if not mode and has_closed_form(self._networks, config):
            compute = self._gradient_computation(torch_threads)
            self.minibatch_gradient = ClosedFormGradient(self._networks, self.gradient_and_kl, slices, compute)
            self.torch_threads = 1
        else:
            self.minibatch_gradient = AutogradGradient(self._networks, self.gradient_and_kl, self.functions.loss)

    def _gradient_computation(self, threads: int) -> MakeLayerGradients:
        """Return a factory of functions that compute the gradients of the layers of actor and critic.

        If the environment has worker processes, they compute the gradients; else threads of this process do.
        """
        env, rollout = self.collector.env, self.collector.rollout
        if env.workers > 1:
            from rlcli.envs.sharding.env import ShardedEnv
            from rlcli.rl.ppo.gradient_processes import distributed_gradients

            assert isinstance(env, ShardedEnv)
            return distributed_gradients(env, self._networks, self.weights, self.config, rollout)
        return threaded_gradients(self._networks, max(rollout.sizes), threads)

    def update(self) -> None:
        """Estimate the advantages of the rollout, optimise actor and critic, and store the metrics of the update."""
        collector = self.collector
        with tf32_matmul(self._tf32):
            collector.estimate_advantages()
            collector.complete_images()
            if collector.normalizer is not None and self.config.normalizer_update == "rollout":
                # after the advantages: they are computed with the normalisation that was used in the rollout
                collector.update_normalizers(collector.raw_obs)
            self.optimize()
            self._write_metrics()

    def optimize(self) -> None:
        """Take one optimiser step per minibatch, for several epochs."""
        config, rollout = self.config, self.collector.rollout
        self._metric_sums.zero_()
        for epoch in range(config.num_epochs):
            if epoch == 0 or config.shuffle == "epoch":
                rollout.fill_minibatches(self.sample_order())
            self._kl_sum.zero_()
            for number, minibatch in enumerate(rollout.minibatches):
                self.step(minibatch, number)
            self._adapt_learning_rate(self._kl_sum / len(rollout.minibatches), "epoch")
        self._adapt_learning_rate(self._kl_sum / len(rollout.minibatches), "iteration")

    def sample_order(self) -> Tensor:
        """Return the order in which the samples fill the minibatches, as indices t * num_envs + env. (samples,)"""
        shuffled, rollout = self.config.shuffle != "none", self.collector.rollout
        device = self.weights.device
        if self._networks.memory is not None:
            arrange = torch.randperm if shuffled else torch.arange
            return rollout.order_by_environment(arrange(self.collector.env.num_envs, device=device))
        return torch.randperm(self._samples_per_rollout, device=device) if shuffled else rollout.by_environment

    def step(self, batch: Samples, number: int) -> None:
        """Take one optimiser step on the minibatch `batch`, which has the index `number`.

        On a CPU raise `DivergedError` if a loss, gradient or weight is not finite.
        """
        iteration, checks = self.collector.iteration, self.collector.checks_every_stage
        result = self.compute_gradient(self.minibatch_gradient, batch, number)
        self._metric_sums += result.metrics
        self._process_group.average_(self.gradient_and_kl)
        if checks and not (is_finite(self.gradient_and_kl) and is_finite(result.metrics)):
            require_finite(self._gradient_in_causal_order(result), iteration)
        if self.config.kl_from == "rollout":
            self._adapt_learning_rate(self._minibatch_kl, "minibatch")
        self.clip_gradient()
        self.optimizer.step()
        if checks and not is_finite(self.weights):
            weights = self.collector.named_weights()
            require_finite([("the learning rate", self.learning_rate), *weights], iteration)
        if self.config.kl_from == "last_pass":
            self._adapt_learning_rate(self._minibatch_kl, "minibatch")
            batch.mean.copy_(result.mean)
            self.collector.rollout.old_std[number].copy_(result.std)
        if self.config.kl_grain != "minibatch":
            self._kl_sum += self._minibatch_kl

    def compute_gradient(self, minibatch_gradient: MinibatchGradient, batch: Samples, number: int) -> LossResult:
        """Return the loss of a minibatch, and write its gradient and its KL divergence to `gradient_and_kl`.

        `minibatch_gradient` computes both; `number` is the index of the minibatch `batch`.
        """
        config, old_std = self.config, self.collector.rollout.old_std[number]
        obs, critic_obs = self.network_inputs(batch, number)
        advantage = batch.advantage
        if config.normalize_advantage == "minibatch":
            advantage = standardize(advantage, self._process_group)
        return minibatch_gradient(config, batch, obs, critic_obs, advantage, old_std)

    def network_inputs(self, batch: Samples, number: int) -> tuple[Tensor, Tensor]:
        """Return the inputs of the MLPs of actor and critic for the minibatch `batch`, which has the index `number`.

        The inputs are the observations, or the outputs of the LSTMs unrolled over the rollout. (n, d), (n, c)
        """
        if self._networks.memory is None:
            return batch.obs, batch.critic_obs
        environments = self.collector.rollout.environments[number]
        obs = {"actor": batch.obs, "critic": batch.critic_obs}
        shape = (self.config.num_steps, len(environments))
        features = []
        for name, lstm in self._networks.recurrent_modules().items():
            initial_state = self.collector.initial_hidden_state[name].index_select(0, environments)
            sequences, starts = (torch.unflatten(rows, 0, shape) for rows in (obs[name], batch.episode_start))
            outputs, _ = unroll(lstm, sequences, starts, initial_state)
            features.append(outputs.flatten(0, 1))
        return features[0], features[1]

    def clip_gradient(self) -> None:
        """Clip the norm of the joint gradient, or of the gradients of actor and critic separately."""
        if self.config.max_grad_norm is not None:
            self.functions.clip_gradient_(self._clipped_parts, self.config.max_grad_norm)

    def decay_learning_rate(self, remaining: float) -> None:
        """Decrease the learning rate linearly, or the upper limit of an adaptive learning rate.

        Args:
            remaining: share of the budget that is left, 0 to 1.
        """
        if self.config.schedule == "linear":
            self.learning_rate.fill_(self.config.learning_rate * remaining)
        elif self.config.schedule == "adaptive_linear":
            self._rate_ceiling.fill_(self.config.learning_rate_range[1] * remaining)
            self.learning_rate.clamp_(max=self._rate_ceiling)

    def _adapt_learning_rate(self, kl: Tensor, grain: str) -> None:
        """Adapt the learning rate to the KL divergence, if the schedule is adaptive and `kl_grain` is `grain`."""
        if self.config.desired_kl is not None and grain == self.config.kl_grain:
            self.functions.adapt_learning_rate_(self.learning_rate, self._rate_ceiling, kl, self.config)

    def _call_all(self, functions: UpdateFunctions) -> None:
        """Call each function once with every minibatch size, so that torch compiles it for these sizes."""
        gradient = AutogradGradient(self._networks, self.gradient_and_kl, functions.loss)
        minibatches = self.collector.rollout.minibatches
        with tf32_matmul(self._tf32):
            number_by_size = {len(minibatch.target): number for number, minibatch in enumerate(minibatches)}
            for number in number_by_size.values():
                self.compute_gradient(gradient, minibatches[number], number)
            if self.config.max_grad_norm is not None:
                functions.clip_gradient_(self._clipped_parts, self.config.max_grad_norm)
            if self.config.desired_kl is not None:
                rate = self.learning_rate.clone()
                functions.adapt_learning_rate_(rate, self._rate_ceiling, self._minibatch_kl, self.config)

    # --- metrics ---

    @torch.no_grad()
    def _write_metrics(self) -> None:
        """Write the metrics of the update into `metric_values`."""
        updates = self.config.num_epochs * len(self.collector.rollout.minibatches)
        moments = [values for _, values in self.collector.normalizer_moments()]
        # a sum is finite only if all its terms are: one number per tensor instead of one per weight
        sums = torch.stack([values.sum().double() for values in (self.weights, *moments)])
        all_finite = sums.isfinite().all().float()
        last = (self._networks.std.mean(), self.learning_rate, all_finite, self.collector.explained_variance)
        self.metric_values[: len(METRICS)].copy_(self._metric_sums / updates)
        self.metric_values[len(METRICS) :].copy_(torch.stack(last))
        self._process_group.average_(self.metric_values)

    def metrics(self) -> dict[str, float]:
        """Return the metrics of the last update, by name; metrics that are not finite are left out.

        Raises:
            DivergedError: if a weight, normaliser or loss is not finite, with the first such tensor.
        """
        *losses, std, learning_rate, all_finite, explained = self.metric_values.tolist()
        metrics = {f"Loss/{name}": value for name, value in zip(METRICS, losses, strict=True)}
        metrics |= {"Policy/mean_std": std, "Loss/learning_rate": learning_rate, "Loss/explained_variance": explained}
        required = {name: metrics[name] for name in ("Loss/surrogate", "Loss/value", "Policy/mean_std")}
        if all_finite < 1.0 or not all(map(math.isfinite, required.values())):
            iteration = self.collector.iteration
            if not self.collector.rollout.is_finite():
                self.collector.require_finite_rollout()
            require_finite(self.collector.normalizer_moments(), iteration)
            require_finite_learner(required, {}, iteration)
            require_finite(self.collector.named_weights(), iteration)
        if not self.config.bounds_coef:
            del metrics["Loss/bounds"]
        if self.config.symmetry is None:
            del metrics["Loss/mirror"]
        return finite_values(metrics)

    def _gradient_in_causal_order(self, result: LossResult) -> list[tuple[str, Tensor]]:
        """Return (name, tensor) of losses, then of gradients in the order of the backward pass.

        If the learner diverges, the first tensor that is not finite is the cause.
        """
        losses = [(f"the loss ({name})", result.metrics[i]) for i, name in enumerate(METRICS) if i != KL]
        names, parameters = zip(*self._networks.named_parameters(), strict=True)
        parts = self.gradient.split_with_sizes([parameter.numel() for parameter in parameters])
        gradients = [(f"the gradient of '{name}'", part) for name, part in zip(names, parts, strict=True)]
        loss, kl = ("the loss", result.loss.detach()), ("the KL divergence", self._minibatch_kl)
        return [*losses, loss, *reversed(gradients), kl]
