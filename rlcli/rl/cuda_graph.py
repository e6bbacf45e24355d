"""Repeated work as a CUDA graph: recorded once on a GPU, and then replayed.

A graph records kernel launches on fixed addresses. The work may not read a value back from the device, and tensors that
it carries from one run to the next must keep their addresses. Tensors that a task rebinds in every step are copied back
to their first address at the end of the recording. Work that cannot be recorded is named in a warning and runs eagerly.

All work is recorded in one stream: once a process holds a single recording with parallel branches, each launch of
every recording takes about a third of a microsecond longer (docs/tutorials/train-on-a-gpu.md).
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

_NUMBERS = (bool, int, float)
_log = logging.getLogger(__name__)


def captured(work: Work, device: torch.device, holders: Iterable[Any] = ()) -> Work:
    """Return `work` itself on a CPU, and a recording of it on a GPU.

    Args:
        work: the function.
        device: where it runs.
        holders: objects whose attributes the work carries from one run to the next: a task, terms with a state.
    """
    return Recording(work, device, list(holders)) if device.type == "cuda" else work


class Recording:
    """Work that runs eagerly until a run shows no obstacle, is recorded in the next run, and replayed from then on.

    The first run may allocate what later runs use, and synchronise with the device for it; a second run may not.
    """

    def __init__(self, work: Work, device: torch.device, holders: list[Any]) -> None:
        self._work, self._holders = work, holders
        self._device = torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._warp_capture: Any = None  # holds the memory that Warp allocated while recording
        self._eager_runs, self._ready = 0, False
        self.refusal: str | None = None
        """Why the work is not recorded."""

    def __call__(self) -> None:
        """Run the work."""
        if self._graph is not None:
            self._graph.replay()
        elif self.refusal is not None:
            self._work()
        elif self._ready:
            self._record()
        else:
            self._run_eagerly()

    def _run_eagerly(self) -> None:
        """Run without recording: kernels compile, buffers are allocated, synchronising calls are detected."""
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
            where = sorted({f"{w.filename}:{w.lineno}" for w in waits})
            self._refuse(f"{where[0]} waits for the GPU{f' (and {len(where) - 1} more places)' if where[1:] else ''}")
        changed = [name for name, value in self._numbers().items() if numbers.get(name, value) != value]
        if changed and not waits:
            self._refuse(f"{changed[0]} is a number that changes from step to step; keep it in a tensor")
        self._ready = not waits and not changed

    def _record(self) -> None:
        import warp as wp

        places = [(holder, name, value) for holder, name, value in self._tensors()]
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]  # torch has no type here
        try:
            torch.cuda.synchronize(self._device)
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                on = wp.stream_from_torch(stream)
                wp.set_stream(on, wp.device_from_torch(self._device))
                wp.capture_begin(stream=on, external=True)
                try:
                    self._work()
                    _copy_back(places)
                finally:
                    self._warp_capture = wp.capture_end(stream=on), on
        except RuntimeError as error:
            for holder, name, value in places:
                setattr(holder, name, value)
            place = next(f for f in reversed(traceback.extract_tb(error.__traceback__)) if "torch" not in f.filename)
            self._refuse(f"{place.filename}:{place.lineno} ({' '.join(str(error).split())[:120]})")
            self._work()
            return
        self._graph = graph
        graph.replay()

    def _refuse(self, reason: str) -> None:
        self.refusal = reason
        _log.warning(f"the step cannot be recorded as a CUDA graph and runs several times slower: {reason}")

    def _tensors(self) -> list[tuple[Any, str, Tensor]]:
        return [(h, n, v) for h in self._holders for n, v in vars(h).items() if isinstance(v, Tensor)]

    def _numbers(self) -> dict[str, Any]:
        return {
            f"{type(holder).__name__}.{name}": value
            for holder in self._holders
            for name, value in vars(holder).items()
            if isinstance(value, _NUMBERS)
        }


def _copy_back(places: list[tuple[Any, str, Tensor]]) -> None:
    """Copy tensors that were rebound to the addresses that the next replay reads."""
    for holder, name, old in places:
        new = getattr(holder, name)
        if new is not old and isinstance(new, Tensor) and new.shape == old.shape and new.dtype == old.dtype:
            old.copy_(new)
            setattr(holder, name, old)
