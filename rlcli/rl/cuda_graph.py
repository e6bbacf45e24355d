"""Record a repeated function, such as a rollout, as a CUDA graph, and replay the graph instead of the function.

A graph records the function's kernel launches on fixed memory addresses. The function has no arguments, must not read a
value back from the device, and must keep the addresses of tensors that it uses from one call to the next. Tensors that
a task rebinds in every step are copied back to their first address at the end of the recording. A function that cannot
be recorded runs eagerly, after a warning.

All kernels are recorded in one stream: once a process holds one recording with parallel branches, each launch of every
recording takes about a third of a microsecond longer (docs/tutorials/train-on-a-gpu.md).
"""

from __future__ import annotations

import logging
import traceback
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

Work = Callable[[], None]

_log = logging.getLogger(__name__)


def capture_on_gpu(work: Work, device: torch.device, holders: Iterable[Any] = ()) -> Work:
    """Return a `Recording` of the function `work` on a GPU, and `work` itself on a CPU.

    Args:
        work: the function.
        device: device on which the function computes.
        holders: objects whose attributes the function keeps from one call to the next, such as a direct task or terms
            with a state.
    """
    return Recording(work, device, list(holders)) if device.type == "cuda" else work


class Recording:
    """Function that runs eagerly in the first calls, is then recorded as a CUDA graph, and is replayed after that.

    Only the first call may synchronise with the device. After a call that neither synchronises nor changes a Python
    number in the attributes of `holders`, the next call is recorded. A function that cannot be recorded always runs
    eagerly, after a warning.

    Args:
        work: the function.
        device: the GPU on which the function computes.
        holders: objects whose attributes the function keeps from one call to the next.
    """

    def __init__(self, work: Work, device: torch.device, holders: list[Any]) -> None:
        self._work, self._holders = work, holders
        self._device = torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warp_capture: Any = None  # keeps the memory alive that Warp has allocated during the recording
        self._eager_runs, self._ready = 0, False
        self.refusal: str | None = None
        """Reason why the function cannot be recorded; None: none was found so far."""

    def __call__(self) -> None:
        """Call the function: eagerly at first, later by replaying its recording."""
        if self._graph is not None:
            self._graph.replay()
        elif self.refusal is not None:
            self._work()
        elif self._ready:
            self._record()
        else:
            self._run_eagerly()

    def _run_eagerly(self) -> None:
        """Call the function without recording: kernels compile, buffers are allocated, host syncs are detected."""
        self._eager_runs += 1
        before = torch.cuda.get_sync_debug_mode()
        numbers = self._numbers()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                self._work()
            finally:
                torch.cuda.set_sync_debug_mode(before)
        waits = [w for w in caught if "synchronizing CUDA operation" in str(w.message)]
        if waits and self._eager_runs > 1:
            first, *others = sorted({f"{w.filename}:{w.lineno}" for w in waits})
            more = f" (so do {', '.join(others[:3])}{', ...' if len(others) > 3 else ''})" if others else ""
            self._refuse(f"{first} waits for the GPU{more}")
        changed = [name for name, value in self._numbers().items() if numbers.get(name, value) != value]
        if changed and not waits:
            self._refuse(f"{changed[0]} is a Python number that changes between steps; keep it in a tensor")
        self._ready = not waits and not changed

    def _record(self) -> None:
        import warp as wp

        tensors = [(h, n, v) for h in self._holders for n, v in vars(h).items() if isinstance(v, Tensor)]
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]  # torch has no type here
        try:
            torch.cuda.synchronize(self._device)
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                on = wp.stream_from_torch(stream)
                wp.set_stream(on, wp.device_from_torch(self._device))
                wp.capture_begin(stream=on, external=True)
                try:
                    self._work()
                    _copy_back(tensors)
                finally:
                    self._warp_capture = wp.capture_end(stream=on), on
        except RuntimeError as error:
            for holder, name, value in tensors:  # the failed recording may have replaced these tensors by new ones
                setattr(holder, name, value)
            frames = reversed(traceback.extract_tb(error.__traceback__))
            culprit = next(frame for frame in frames if "torch" not in frame.filename)
            self._refuse(f"{culprit.filename}:{culprit.lineno} ({' '.join(str(error).split())[:120]})")
            self._work()
            return
        self._graph = graph
        graph.replay()

    def _refuse(self, reason: str) -> None:
        self.refusal = reason
        _log.warning(f"the step cannot run as a CUDA graph and is several times slower; change this: {reason}")

    def _numbers(self) -> dict[str, Any]:
        """Return the attributes of the holders that are Python numbers; a graph would replay their recorded values."""
        return {
            f"{type(holder).__name__}.{name}": value
            for holder in self._holders
            for name, value in vars(holder).items()
            if isinstance(value, bool | int | float)
        }


def _copy_back(tensors: list[tuple[Any, str, Tensor]]) -> None:
    """Copy tensors that the recorded function has replaced by new ones into the old memory, which a replay reads.

    `tensors` has entries (object, name of the attribute, tensor of this attribute before the call).
    """
    for holder, name, old in tensors:
        new = getattr(holder, name)
        if new is not old and isinstance(new, Tensor) and new.shape == old.shape and new.dtype == old.dtype:
            old.copy_(new)
            setattr(holder, name, old)
