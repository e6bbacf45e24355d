"""Redirection of the output that C code writes directly to stdout and stderr, without Python's `sys.stdout`."""

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def descriptor_redirected(descriptor: int, target: int | None = None) -> Iterator[None]:
    """Redirect what C code writes to a file descriptor in the `with` block; a closed descriptor stays closed.

    Args:
        descriptor: the file descriptor: 1 is stdout, 2 is stderr.
        target: the file descriptor that receives the output; None: the output is discarded.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # one of the two is closed
            to = os.open(os.devnull, os.O_WRONLY) if target is None else os.dup(target)
            stack.callback(os.close, to)
            kept = os.dup(descriptor)
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, descriptor)
            os.dup2(to, descriptor)
        yield
