"""Checks of `rlcli doctor`: whether this machine, this installation and every installed plugin work.

`run_checks` runs all checks; the other modules contain the checks, grouped by subject.
"""

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rlcli.doctor.check import Check
from rlcli.doctor.compute_and_graphics import check_isolated
from rlcli.doctor.host_and_settings import machine_checks, settings_checks
from rlcli.doctor.installation import entry_checks, installation_checks, metadata_checks
from rlcli.machine.memory import require_address_space
from rlcli.registry.entries import GROUPS
from rlcli.registry.probe import TIMEOUT_S

__all__ = ["Check", "run_checks"]


def run_checks(runs_dir: Path, timeout_s: float = TIMEOUT_S) -> list[Check]:
    """Run all checks of `rlcli doctor` and return their results, in the order of its table.

    Checks that may hang or crash (drivers, graphics, plugins) run in separate processes, several at a time.

    Args:
        runs_dir: the folder that runs would be written to.
        timeout_s: time limit for each task, trainer and driver [s].

    Raises:
        MachineError: if a limit such as `ulimit -v` leaves too little memory to import torch.
    """
    require_address_space()
    stop = threading.Event()
    with ThreadPoolExecutor() as pool:
        try:
            plugins = [pool.submit(entry_checks, group, timeout_s, stop) for group in GROUPS]
            isolated = pool.submit(check_isolated, timeout_s)
            checks = [*installation_checks(), *machine_checks(runs_dir), *settings_checks()]
            checks += [*isolated.result(), *metadata_checks()]
            return checks + [check for future in plugins for check in future.result()]
        except BaseException:  # Ctrl-C
            stop.set()
            raise
