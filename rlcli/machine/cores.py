"""Number of cores that this process may use."""

import os
from pathlib import Path

from rlcli.machine.control_groups import GROUPS, OWN_GROUP, core_quota
from rlcli.machine.processes import launcher_number


def available_cores(groups: Path = GROUPS, own: Path = OWN_GROUP) -> int:
    """Return the number of cores that this process may use.

    These are the cores of its CPU affinity, limited by the quota of its control group (rounded down). If a launcher
    such as torchrun started several processes, they share the cores equally.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = core_quota(groups, own)
    if quota is not None:  # a thread above the quota is paused for the rest of each period, and the others wait for it
        cores = min(cores, int(quota))
    return max(1, cores // launcher_number("LOCAL_WORLD_SIZE", 1, least=1))
