"""Delay of Python's garbage collection while large libraries are imported."""

import gc

_SELDOM = (100_000, 10, 10)
"""Arguments of `gc.set_threshold` with which collections are rare."""
_saved_thresholds: list[tuple[int, int, int]] = []


def delay_garbage_collection() -> None:
    """Make Python's cyclic garbage collection rare until `restore_garbage_collection` is called.

    The command line calls this function at its start. Imports create hundreds of thousands of objects that stay in
    memory; to scan these objects again and again takes a fifth of the time of importing torch.
    """
    _saved_thresholds.append(gc.get_threshold())
    gc.set_threshold(*_SELDOM)


def restore_garbage_collection() -> None:
    """Undo `delay_garbage_collection`, if it was called, after the large libraries have been imported.

    The objects that exist now are excluded from all later collections, also from the one at the end of the process.
    """
    if _saved_thresholds:
        gc.freeze()
        gc.set_threshold(*_saved_thresholds.pop())
