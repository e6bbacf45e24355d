"""Functions that join the saved states of shards (parts of the environments) into one state, and split it again.

With them, a checkpoint does not depend on the number of processes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rlcli.envs.shard_range import Shard
from rlcli.errors import TaskError


def environment_dim(shapes: Sequence[torch.Size]) -> int | None:
    """Return the dimension of a tensor that counts environments, from the tensor's shapes in the shards.

    `rlcli.envs.shard_range.split` gives the first and the last shard different sizes. The environment dimension is
    therefore the only one in which the shapes differ. None: the tensor has no such dimension.
    """
    return next((dim for dim, sizes in enumerate(zip(*shapes, strict=True)) if len(set(sizes)) > 1), None)


def join(parts: Sequence[Tensor]) -> Tensor:
    """Concatenate the tensors of all shards along the environment dimension.

    If the tensors have no such dimension, return the first shard's tensor.
    """
    dim = environment_dim([part.shape for part in parts])
    return parts[0] if dim is None else torch.cat(list(parts), dim=dim)


def join_states(states: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Join the states (`VecEnv.state_dict`) of all shards into the state of one environment with all rows.

    Raises:
        TaskError: if a value that all environments share differs between the shards.
    """
    for name, value in states[0].items():
        parts = [state.get(name) for state in states]
        if any(part is None for part in parts) or (not _is_per_env(parts) and not _all_equal(value, parts)):
            raise TaskError(
                f"the state '{name}' of the task depends on all environments, and differs between the worker processes",
                hint="set scene.workers: 1",
            )
    return {name: join([state[name] for state in states]) for name in states[0]}


def _is_per_env(parts: Sequence[Tensor | None]) -> bool:
    return environment_dim([part.shape for part in parts if part is not None]) is not None


def _all_equal(value: Tensor, parts: Sequence[Tensor | None]) -> bool:
    return all(part is not None and torch.equal(value.nan_to_num(), part.nan_to_num()) for part in parts)


def split_state(
    state: Mapping[str, Tensor], present: Mapping[str, Sequence[torch.Size]], shards: Sequence[Shard]
) -> list[dict[str, Tensor]]:
    """Split the state of all environments, as `join_states` returns it, into one state for each shard.

    Args:
        state: the joined state.
        present: shapes of the current state's tensors in each shard, by name.
        shards: the shards.
    """
    parts: list[dict[str, Tensor]] = [{} for _ in shards]
    for name, value in state.items():
        dim = environment_dim(present[name]) if name in present else _first_dim(value, shards[0].total)
        for part, shard in zip(parts, shards, strict=True):
            part[name] = value if dim is None else value.narrow(dim, shard.first, shard.count)
    return parts


def _first_dim(value: Tensor, total: int) -> int | None:
    """Guess the environment dimension of a tensor that the current state does not have.

    Return 0 if the tensor has `total` rows, one for each environment; else None.
    """
    return 0 if value.shape[:1] == (total,) else None
