"""What the machine offers this process."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Cores this process may use; processes that a launcher started together share them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
