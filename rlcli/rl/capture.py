"""Running the same work again and again: on a GPU it is recorded once in a CUDA graph and then replayed.

What is recorded are launches on fixed addresses. So the work may not ask the device for a value, and what it carries
from one run to the next must stay where it is. Tensors that a task binds anew in every step are copied back to where
they were at the end of the recording; everything else that cannot be recorded is found, named, and run as it is.

All of it is recorded in one stream: once a process holds a single recording with parallel branches, each launch of
every recording takes about a third of a microsecond longer (docs/gpu.md).
"""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

Work = Callable[[], None]
Tell = Callable[[str], None]

_NUMBERS = (bool, int, float)


def captured(work: Work, device: torch.device, holders: Iterable[Any] = (), tell: Tell = lambda _: None) -> Work:
    """What does the work: `work` itself on a CPU, a recording of it on a GPU.

    Args:
        work: takes and returns nothing.
        device: where it runs.
        holders: objects whose attributes the work carries from one run to the next: a task, terms with memory.
        tell: told once, in a sentence, if it cannot be recorded.
    """
    return Recording(work, device, list(holders), tell) if device.type == "cuda" else work


class Recording:
    """Runs the work as it is until a run shows nothing against it, records it at the next, and replays it from then on.

    The first run may make what the later ones use, and wait for the device to do so; a second one may not.
    """

    def __init__(self, work: Work, device: torch.device, holders: list[Any], tell: Tell) -> None:
        self._work, self._holders, self._tell = work, holders, tell
        self._device = torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._kept: Any = None  # what Warp allocated while recording lives as long as this
        self._rehearsals, self._ready = 0, False
        self.refusal: str | None = None
        """Why it is not recorded."""

    def __call__(self) -> None:
        """Do the work."""
        if self._graph is not None:
            self._graph.replay()
        elif self.refusal is not None:
            self._work()
        elif self._ready:
            self._record()
        else:
            self._rehearse()

    def _rehearse(self) -> None:
        """A run that compiles, makes buffers, and shows what waits for the device."""
        self._rehearsals += 1
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
        if waits and self._rehearsals > 1:
            where = sorted({f"{w.filename}:{w.lineno}" for w in waits})
            self._refuse(f"{where[0]} waits for the GPU{f' (and {len(where) - 1} more places)' if where[1:] else ''}")
        changed = [name for name, value in self._numbers().items() if numbers.get(name, value) != value]
        if changed and not waits:
            self._refuse(f"{changed[0]} is a number that changes from step to step; keep it in a tensor")
        self._ready = not waits and not changed

    def _record(self) -> None:
        import warp as wp

        places = [(holder, name, value) for holder, name, value in self._tensors()]
        graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream(self._device)
        try:
            torch.cuda.synchronize(self._device)
            with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                on = wp.stream_from_torch(stream)
                wp.set_stream(on, wp.device_from_torch(self._device))
                wp.capture_begin(stream=on, external=True)
                try:
                    self._work()
                    _put_back(places)
                finally:
                    self._kept = wp.capture_end(stream=on), on
        except RuntimeError as error:
            for holder, name, value in places:
                setattr(holder, name, value)
            place = next(f for f in reversed(traceback.extract_tb(error.__traceback__)) if "torch" not in f.filename)
            self._refuse(f"{place.filename}:{place.lineno} ({' '.join(str(error).split())[:120]})")
            self._work()
            return
        self._graph = graph
        graph.replay()

    def _refuse(self, why: str) -> None:
        self.refusal = why
        self._tell(f"the step cannot be recorded as a CUDA graph and runs several times slower: {why}")

    def _tensors(self) -> list[tuple[Any, str, Tensor]]:
        return [(h, n, v) for h in self._holders for n, v in vars(h).items() if isinstance(v, Tensor)]

    def _numbers(self) -> dict[str, Any]:
        return {
            f"{type(holder).__name__}.{name}": value
            for holder in self._holders
            for name, value in vars(holder).items()
            if isinstance(value, _NUMBERS)
        }


def _put_back(places: list[tuple[Any, str, Tensor]]) -> None:
    """Carry what was bound anew to where the next replay looks for it."""
    for holder, name, old in places:
        new = getattr(holder, name)
        if new is not old and isinstance(new, Tensor) and new.shape == old.shape and new.dtype == old.dtype:
            old.copy_(new)
            setattr(holder, name, old)
