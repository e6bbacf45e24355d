"""What `rlcli doctor` finds out: whether this machine, this installation and every plugin in it can work."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rlcli.doctor.check import Check
from rlcli.doctor.installation import entry_checks, installation_checks, metadata_checks
from rlcli.doctor.isolated_checks import check_isolated
from rlcli.doctor.machine import machine_checks
from rlcli.doctor.settings import settings_checks
from rlcli.registry import FORMATS, TASKS, TRAINERS
from rlcli.registry.probe import TIMEOUT_S

__all__ = ["Check", "run_checks"]


def run_checks(runs_dir: Path, timeout_s: float = TIMEOUT_S) -> list[Check]:
    """Look at everything.

    Whatever may hang or crash (drivers, graphics, plugins) is asked in processes of its own, several at a time.

    Args:
        runs_dir: the folder that runs would be written to.
        timeout_s: how long each task, trainer and driver is given.
    """
    stop = threading.Event()
    with ThreadPoolExecutor(2) as pool:
        try:
            tasks = pool.submit(entry_checks, TASKS, timeout_s, stop)
            isolated = pool.submit(check_isolated, timeout_s)
            checks = [*installation_checks(), *machine_checks(runs_dir), *settings_checks()]
            checks += [*isolated.result(), *metadata_checks(), *tasks.result()]
            return checks + [check for group in (TRAINERS, FORMATS) for check in entry_checks(group, timeout_s, stop)]
        except BaseException:  # Ctrl-C
            stop.set()
            raise
