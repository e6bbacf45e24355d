"""What C code writes to stderr."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def native_stderr_discarded() -> Iterator[None]:
    """Discard what C code writes to stderr (file descriptor 2) in the `with` block, such as messages at its start."""
    with contextlib.ExitStack() as stack:
        try:
            kept = os.dup(2)
        except OSError:  # file descriptor 2 is closed
            kept = -1
        if kept >= 0:
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, 2)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 2)
            os.close(nowhere)
        yield
