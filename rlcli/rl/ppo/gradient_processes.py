"""Compute the gradients of MLPs in the worker processes that step the environments and are idle between rollouts.

Python runs one thread at a time, so more than about eight threads of one process slow each other down. A minibatch
is split and summed as in `rlcli.rl.mlp_gradients.MlpGradients`, so the gradients have the same bits as with threads.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from rlcli.envs.sharding.arrays import ArraySpec
from rlcli.envs.sharding.env import ShardedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.rl.mlp import Mlp
from rlcli.rl.mlp_gradients import PartGradients, PartMemory
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.minibatch_gradient import LayerGradients, Objective
from rlcli.rl.ppo.networks import ActorCritic
from rlcli.rl.ppo.rollout_buffer import RolloutBuffer, Samples


def distributed_gradients(
    env: ShardedEnv, networks: ActorCritic, weights: Tensor, config: PpoConfig, rollout: RolloutBuffer
) -> Callable[[Sequence[Tensor]], LayerGradients]:
    """Return a factory of functions (`LayerGradients`) that compute gradients in the environment's worker processes.

    Args:
        env: the environment.
        networks: actor and critic, MLPs.
        weights: vector of all parameters of both networks. (p,)
        config: configuration of the agent.
        rollout: buffer whose minibatches are moved to shared memory, so that the processes can read them.
    """
    rows = max(rollout.sizes)
    actions = rollout.old_std.shape[1]
    memory = PartMemory(networks.actor, networks.critic, rows)
    shapes = memory.shapes | {
        "weights": tuple(weights.shape),
        "samples": tuple(rollout.ordered.shape),
        "advantage": (rows,),
        "std": (actions,),
        "mean": (rows, actions),
    }
    shared = env.share({f"gradient.{name}": ArraySpec(shape, torch.float32) for name, shape in shapes.items()})
    tensors = {name: shared[f"gradient.{name}"] for name in shapes}
    rollout.move(tensors["samples"])
    memory = PartMemory(networks.actor, networks.critic, rows, tensors)
    slices = {name: (int(p.storage_offset()), p.shape) for name, p in _parameters(networks.actor, networks.critic)}
    env.call_all(_prepare, _Job(networks.actor, networks.critic, slices, config, rollout.columns, rollout.sizes, rows))

    def make(gradients: Sequence[Tensor]) -> LayerGradients:
        def compute(obs: Tensor, critic_obs: Tensor, objective: Objective) -> tuple[Tensor, Tensor]:
            number = next(n for n, batch in enumerate(rollout.minibatches) if batch is objective.batch)
            tensors["weights"].copy_(weights.detach())
            tensors["std"].copy_(objective.std)
            tensors["advantage"][: len(obs)] = objective.advantage
            env.call_all(_compute, number)
            objective.mean.copy_(tensors["mean"][: len(obs)])
            return memory.sum_parts(len(obs), gradients)

        return compute

    return make


@dataclass(frozen=True, slots=True)
class _Job:
    """Networks, settings and sizes that each process receives once, before the first update."""

    actor: Mlp
    critic: Mlp
    slices: dict[str, tuple[int, torch.Size]]
    """Name of a parameter -> (its first index in the vector of all parameters, its shape)."""
    config: PpoConfig
    columns: tuple[int, int, int]
    """Columns of actor observation, critic observation and action (`RolloutBuffer.columns`)."""
    sizes: list[int]
    """Number of samples of each minibatch."""
    rows: int
    """Number of samples of the largest minibatch."""


class _ProcessGradients:
    """Gradient computation in one of n processes, which computes every n-th part of a minibatch.

    Samples and gradients are in memory that all processes share.
    """

    def __init__(self, env: VecEnv, job: _Job) -> None:
        tensors = {name.removeprefix("gradient."): tensor for name, tensor in env.shard.shared.items()}
        # copies: in the main process the job holds the trainer's own networks, whose parameters must not move
        actor, critic = copy.deepcopy((job.actor, job.critic))
        for name, parameter in _parameters(actor, critic):
            start, shape = job.slices[name]
            parameter.data = tensors["weights"][start : start + shape.numel()].view(shape)
        self._memory = PartMemory(actor, critic, job.rows, tensors)
        self._parts = PartGradients(actor, critic, self._memory)
        self._tensors, self._config = tensors, job.config
        self._batches = [Samples.views(p, *job.columns) for p in tensors["samples"].split_with_sizes(job.sizes)]
        self._first, self._step = env.shard.number, env.shard.number_of_shards

    def compute(self, number: int) -> None:
        """Write the gradients of this process's parts of the minibatch with index `number` to the shared memory."""
        batch, tensors = self._batches[number], self._tensors
        rows = len(batch.target)
        objective = Objective(self._config, batch, tensors["advantage"][:rows], tensors["std"], tensors["mean"][:rows])
        for task in self._memory.tasks(rows)[self._first :: self._step]:
            inputs, gradients = (batch.obs, batch.critic_obs), (objective.mean_gradient, objective.value_gradient)
            self._parts.compute(task, inputs, gradients)


_shares: WeakKeyDictionary[VecEnv, _ProcessGradients] = WeakKeyDictionary()


def _prepare(env: VecEnv, job: _Job) -> None:
    _shares[env] = _ProcessGradients(env, job)


def _compute(env: VecEnv, number: int) -> None:
    with torch.no_grad():
        _shares[env].compute(number)


def _parameters(actor: Mlp, critic: Mlp) -> list[tuple[str, torch.nn.Parameter]]:
    networks = (("actor", actor), ("critic", critic))
    return [(f"{prefix}.{name}", p) for prefix, network in networks for name, p in network.named_parameters()]
