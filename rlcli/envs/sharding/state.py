"""States of shards joined to the state of one environment object, and split again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rlcli.envs.shard import Shard


def environment_dim(shapes: Sequence[torch.Size]) -> int | None:
    """Return the dimension of environments, in which the shapes of the shards differ; None: there is none."""
    return next((dim for dim, sizes in enumerate(zip(*shapes, strict=True)) if len(set(sizes)) > 1), None)


def join(parts: Sequence[Tensor]) -> Tensor:
    """Join the tensors of all shards, in order; a tensor without a dimension of environments is the first shard's."""
    dim = environment_dim([part.shape for part in parts])
    return parts[0] if dim is None else torch.cat(list(parts), dim=dim)


def join_states(states: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Join the states of all shards, in order."""
    return {name: join([state[name] for state in states]) for name in states[0]}


def split_state(
    state: Mapping[str, Tensor], present: Mapping[str, Sequence[torch.Size]], shards: Sequence[Shard]
) -> list[dict[str, Tensor]]:
    """Split a joined state into one state for each shard.

    Args:
        state: the joined state.
        present: shapes of the present state's tensors in each shard, by name.
        shards: the shards.
    """
    parts: list[dict[str, Tensor]] = [{} for _ in shards]
    for name, value in state.items():
        dim = environment_dim(present[name]) if name in present else _first_dim(value, shards[0].total)
        for part, shard in zip(parts, shards, strict=True):
            part[name] = value if dim is None else value.narrow(dim, shard.first, shard.count)
    return parts


def _first_dim(value: Tensor, total: int) -> int | None:
    """Return the dimension of environments of a tensor that the present state does not have."""
    return 0 if value.shape[:1] == (total,) else None
