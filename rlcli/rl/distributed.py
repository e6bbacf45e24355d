"""Processes of a data-parallel training: start them, join their group, and average or gather values.

PyTorch's launcher starts the processes. Every process has its own environments and a copy of the networks. Gradients,
KL divergences, observation statistics and metrics are averaged over all processes. Only rank 0 writes the run and
prints.
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any

from rlcli.errors import INTERRUPTED, STOPPED, MachineError
from rlcli.machine.processes import launcher_number, python_command
from rlcli.progress import track

if TYPE_CHECKING:
    from torch import Tensor

_TIMEOUT = timedelta(minutes=10)
"""Time after which waiting for other processes is an error; it is long because they may compile GPU kernels."""


@dataclass(frozen=True, slots=True)
class ProcessGroup:
    """Group of the processes that train one policy together, with the rank of this process.

    With a world size of 1 (a single process) the methods return at once, without communication. With more processes,
    all of them must call the methods in the same order; a method raises `MachineError` if another process has ended.
    """

    rank: int = 0
    world_size: int = 1
    device: str = "cpu"

    @property
    def is_rank_zero(self) -> bool:
        """Whether this process has rank 0, and so writes the run and prints."""
        return self.rank == 0

    def seed(self, seed: int, purpose: str) -> int:
        """Return this process's own seed for a purpose, such as exploration.

        On rank 0 the result is `seed` itself; on other ranks it is derived from `seed`, the purpose and the rank.
        """
        if self.is_rank_zero:
            return seed
        from rlcli.random import derive

        return derive(seed, f"{purpose} of process {self.rank}")

    def average_(self, values: Tensor) -> Tensor:
        """Replace the elements of a tensor by their means over all processes, in place; return the tensor."""
        if self.world_size > 1:
            _communicate("all_reduce", values)
            values /= self.world_size
        return values

    def broadcast_(self, values: Tensor) -> None:
        """Replace the elements of a tensor by those of rank 0, in place."""
        if self.world_size > 1:
            _communicate("broadcast", values, 0)

    def sum(self, *numbers: float) -> tuple[float, ...]:
        """Return each number summed over all processes."""
        if self.world_size == 1:
            return numbers
        import torch

        values = torch.tensor(numbers, dtype=torch.float64, device=self.device)
        return tuple((self.average_(values) * self.world_size).tolist())

    def broadcast_object(self, value: object = None) -> Any:
        """Return the `value` that rank 0 passes, in every process."""
        values = [value]
        if self.world_size > 1:
            _communicate("broadcast_object_list", values, 0)
        return values[0]

    def gather_object(self, value: object) -> list[Any]:
        """Return the values of all processes in the order of their ranks, on rank 0; an empty list on other ranks."""
        if self.world_size == 1:
            return [value]
        values: list[Any] | None = [None] * self.world_size if self.is_rank_zero else None
        _communicate("gather_object", value, values, 0)
        return values or []


_current = ProcessGroup()


def current() -> ProcessGroup:
    """Return the group that this process has joined by `join`; before that, a group with a world size of 1."""
    return _current


def launched() -> bool:
    """Return whether a launcher (torchrun) started this process as one of several; it sets RANK and WORLD_SIZE."""
    return "RANK" in os.environ and launcher_number("WORLD_SIZE", 1, least=1) > 1


def is_rank_zero() -> bool:
    """Return whether this process is the only one or has rank 0."""
    return not launched() or launcher_number("RANK", 0) == 0


def local_rank_and_size() -> tuple[int, int]:
    """Return the rank of this process on its machine, and the number of processes there."""
    if not launched():
        return 0, 1
    return launcher_number("LOCAL_RANK", 0), launcher_number("LOCAL_WORLD_SIZE", 1, least=1)


def join(device: str) -> ProcessGroup:
    """Join the group of all processes that the launcher started, and return the group.

    NCCL transfers tensors on GPUs, gloo all others. A single process gets a group with a world size of 1.

    Args:
        device: device of this process's networks: cpu or cuda:N.

    Raises:
        MachineError: if the other processes cannot be reached.
    """
    global _current
    if not launched() or _current.world_size > 1:
        return _current
    import torch
    import torch.distributed as dist

    # imported before the group exists: default arguments of its functions would keep the group alive
    import torch.distributed.nn

    on_gpu = device.startswith("cuda")
    if on_gpu:
        torch.cuda.set_device(device)
    try:
        dist.init_process_group("cpu:gloo,cuda:nccl" if on_gpu else "gloo", timeout=_TIMEOUT)
    except (RuntimeError, ValueError) as error:
        message = f"cannot connect to the other training processes: {' '.join(str(error).split())}"
        hint = f"start all {os.environ.get('WORLD_SIZE', '')} processes of the training (WORLD_SIZE)"
        raise MachineError(message, hint=hint) from error
    _current = ProcessGroup(dist.get_rank(), dist.get_world_size(), device)
    return _current


def leave() -> None:
    """Leave the process group; `current` then returns a group with a world size of 1."""
    global _current
    if _current.world_size > 1:
        import gc

        import torch.distributed as dist

        _current = ProcessGroup()
        gc.collect()  # destroys captured CUDA graphs: NCCL blocks for ever while a graph uses the group
        with contextlib.suppress(RuntimeError):
            dist.destroy_process_group()


def launch(processes: int, arguments: Sequence[str]) -> int:
    """Run `rlcli ARGUMENTS` in several processes of this machine, and wait until all have ended.

    Returns:
        The exit code: 0 if all processes succeed; if a signal stopped the launcher, the exit code for that signal; else
        that of the process whose failure was the cause. Processes that failed because another had ended do not count.
    """
    import logging

    from torch.distributed import run
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

    # otherwise the launcher prints a warning; torch_threads sets the number of threads later
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    logging.getLogger("torch.distributed").setLevel(logging.CRITICAL)  # each process prints its own error
    options = ["--standalone", f"--nproc-per-node={processes}"]
    command = run.parse_args([*options, "--no-python", *python_command("-m", "rlcli", *arguments)])  # type: ignore[no-untyped-call]  # torch has no type here
    try:
        with track("processes", has_own_view=True):
            run.run(command)  # type: ignore[no-untyped-call]
    except ChildFailedError as error:
        return _exit_code([failure.exitcode for failure in error.failures.values()])
    except SignalException as error:
        return STOPPED if error.sigval == signal.SIGTERM else INTERRUPTED
    return 0


def _exit_code(codes: Sequence[int]) -> int:
    """Return the exit code of the run, from the exit codes of its processes.

    Ignore processes that the launcher killed (negative codes), and processes that ended because another had ended
    (exit code of `MachineError`).
    """
    own = [code for code in codes if code > 0 and code != MachineError.exit_code]
    return next(iter(own), MachineError.exit_code)


def _communicate(operation: str, *arguments: Any) -> None:
    """Call a collective operation (such as `all_reduce`) of `torch.distributed`.

    Raises:
        MachineError: if another process has ended.
    """
    import torch.distributed as dist

    try:
        getattr(dist, operation)(*arguments)
    except RuntimeError as error:
        hint = "read the message of that process; `rlcli train --resume RUN` continues from the last checkpoint"
        raise MachineError("another process of this training has ended, so this process stops", hint=hint) from error
