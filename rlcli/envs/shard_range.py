"""Division of a task's environments into shards: consecutive environments that one process steps.

With one shard, all environments are in the main process.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, slots=True)
class Shard:
    """Part of the environments of a task, which one process steps: consecutive indices."""

    first: int
    """Index of the first environment."""
    count: int
    """Number of environments."""
    total: int
    """Number of environments of all shards."""
    number: int = 0
    """Index of the shard."""
    number_of_shards: int = 1
    counters: Tensor | None = field(default=None, compare=False)
    """Lengths and indices of this shard's running episodes, written in place; None: new tensors. (2, count) int64"""
    shared: dict[str, Tensor] = field(default_factory=dict, compare=False)
    """Tensors in memory that all processes share, by name; `ShardedEnv.share` makes them."""

    @property
    def rows(self) -> slice:
        """Rows of this shard's environments in a tensor of all environments."""
        return slice(self.first, self.first + self.count)


def split(total: int, shards: int) -> list[Shard]:
    """Split environments into shards of nearly equal size, the smallest first.

    With several shards the first and the last differ in size: a tensor with one row per environment is then recognised
    by its shape (`rlcli.envs.sharding.state`).

    Raises:
        ValueError: for fewer than two environments per shard.
    """
    if shards > 1 and total < 2 * shards:
        raise ValueError(f"{total} environments are too few for {shards} workers: each needs two; lower scene.workers")
    sizes = [total // shards + (number >= shards - total % shards) for number in range(shards)]
    if shards > 1 and sizes[0] == sizes[-1]:
        sizes[0], sizes[-1] = sizes[0] - 1, sizes[-1] + 1
    return [Shard(sum(sizes[:number]), size, sum(sizes), number, shards) for number, size in enumerate(sizes)]
