"""Several processes that train one policy: who they are, what they agree on, and how PyTorch's launcher starts them.

Every process has environments of its own and the same networks: gradients, divergences, statistics of observations and
metrics are means over all of them. The one of rank 0 leads: it alone writes the run and prints.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from rlcli.errors import MachineError

if TYPE_CHECKING:
    from torch import Tensor

_JOIN_WITHIN = timedelta(minutes=10)
"""A process that waits longer for the others gives up: kernels may be compiling, but not for ever."""


@dataclass(frozen=True, slots=True)
class Peers:
    """The processes of a run, as one of them sees them; of a single process, all of this does nothing."""

    rank: int = 0
    size: int = 1
    device: str = "cpu"

    @property
    def leads(self) -> bool:
        """Whether this process writes and prints."""
        return self.rank == 0

    def seed(self, seed: int, what: str) -> int:
        """The seed of a process's own draws: the leader's is the one given."""
        if self.leads:
            return seed
        from rlcli.random import derive

        return derive(seed, f"{what} of process {self.rank}")

    def average_(self, values: Tensor) -> Tensor:
        """Put the mean over all processes in place."""
        if self.size > 1:
            import torch.distributed as dist

            with _together():
                dist.all_reduce(values)
            values /= self.size
        return values

    def lead_(self, values: Tensor) -> None:
        """Put the leader's values in place."""
        if self.size > 1:
            import torch.distributed as dist

            with _together():
                dist.broadcast(values, 0)

    def total(self, *numbers: float) -> tuple[float, ...]:
        """Each number summed over all processes."""
        if self.size == 1:
            return numbers
        import torch

        values = torch.tensor(numbers, dtype=torch.float64, device=self.device)
        return tuple((self.average_(values) * self.size).tolist())

    def share(self, value: Any = None) -> Any:
        """What the leader gives, in every process."""
        if self.size == 1:
            return value
        import torch.distributed as dist

        values = [value]
        with _together():
            dist.broadcast_object_list(values, 0)
        return values[0]

    def gather(self, value: Any) -> list[Any]:
        """What each process gives, by rank; for the leader alone."""
        if self.size == 1:
            return [value]
        import torch.distributed as dist

        values: list[Any] | None = [None] * self.size if self.leads else None
        with _together():
            dist.gather_object(value, values, 0)
        return values or []


_peers = Peers()


def current() -> Peers:
    """The processes of this run."""
    return _peers


def launched() -> bool:
    """Whether a launcher started this process as one of several."""
    return "RANK" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


def leads() -> bool:
    """Whether this process is the only one, or leads the others."""
    return not launched() or os.environ["RANK"] == "0"


def local() -> tuple[int, int]:
    """Number of this process on its machine, and how many run there."""
    if not launched():
        return 0, 1
    return int(os.environ.get("LOCAL_RANK", "0")), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def join(device: str) -> Peers:
    """Meet the other processes; NCCL carries what is on a GPU, gloo the rest.

    Raises:
        MachineError: if they cannot be reached.
    """
    global _peers
    if not launched() or _peers.size > 1:
        return _peers
    import torch
    import torch.distributed as dist
    import torch.distributed.nn  # imported later, defaults of its functions would keep the group and its threads alive

    on_gpu = device.startswith("cuda")
    if on_gpu:
        torch.cuda.set_device(device)
    try:
        dist.init_process_group("cpu:gloo,cuda:nccl" if on_gpu else "gloo", timeout=_JOIN_WITHIN)
    except (RuntimeError, ValueError) as error:
        raise MachineError(f"the other processes cannot be reached: {' '.join(str(error).split())}") from error
    _peers = Peers(dist.get_rank(), dist.get_world_size(), device)
    return _peers


def leave() -> None:
    """Part from the other processes."""
    global _peers
    if _peers.size > 1:
        import gc

        import torch.distributed as dist

        _peers = Peers()
        gc.collect()  # NCCL waits for ever while a recorded graph uses it
        with contextlib.suppress(RuntimeError):
            dist.destroy_process_group()


def launch(processes: int, arguments: Sequence[str]) -> int:
    """Run `rlcli ARGUMENTS` in several processes of this machine.

    Returns:
        Their exit code: of several that failed, that of the one that did not fail because of another.
    """
    import logging
    import sys

    from torch.distributed import run
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

    os.environ.setdefault("OMP_NUM_THREADS", "1")  # torch_threads decides; the launcher would only warn
    logging.getLogger("torch.distributed").setLevel(logging.CRITICAL)  # each process has said what is wrong with it
    options = ["--standalone", f"--nproc-per-node={processes}"]
    try:
        run.run(run.parse_args([*options, "--no-python", sys.executable, "-m", "rlcli", *arguments]))
    except ChildFailedError as error:
        return _exit_code([failure.exitcode for failure in error.failures.values()])
    except SignalException as error:
        return 75 if error.sigval == signal.SIGTERM else 130
    return 0


def _exit_code(codes: Sequence[int]) -> int:
    """A process killed by the launcher, or left alone by another, has not failed itself."""
    own = [code for code in codes if code > 0 and code != MachineError.exit_code]
    return next(iter(own), MachineError.exit_code)


@contextlib.contextmanager
def _together() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        hint = "its own message says why; --resume goes on from the last checkpoint"
        raise MachineError("another process of this run is gone", hint=hint) from error
