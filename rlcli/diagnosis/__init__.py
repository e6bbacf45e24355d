"""What `rlcli doctor` finds out: whether this machine, this installation and every plugin in it can work."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rlcli.diagnosis.check import Check
from rlcli.diagnosis.installation import entry_checks, installation_checks, metadata_checks
from rlcli.diagnosis.machine import machine_checks
from rlcli.diagnosis.outside import outside_checks
from rlcli.diagnosis.settings import settings_checks
from rlcli.probe import TIMEOUT_S
from rlcli.registry import TASKS, TRAINERS

__all__ = ["Check", "examine"]


def examine(runs_dir: Path, timeout_s: float = TIMEOUT_S) -> list[Check]:
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
            asked = pool.submit(outside_checks, timeout_s)
            checks = [*installation_checks(), *machine_checks(runs_dir), *settings_checks()]
            return [
                *checks,
                *asked.result(),
                *metadata_checks(),
                *tasks.result(),
                *entry_checks(TRAINERS, timeout_s, stop),
            ]
        except BaseException:  # Ctrl-C
            stop.set()
            raise
