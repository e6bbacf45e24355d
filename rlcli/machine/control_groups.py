"""Limits that the control groups of this process (Linux) set."""

from collections.abc import Iterator
from pathlib import Path

GROUPS, OWN_GROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def core_quota(groups: Path = GROUPS, own: Path = OWN_GROUP) -> float | None:
    """Return the CPU quota of this process's control group in cores, for example 1.5; None if there is no limit."""
    quotas = [_quota(folder) for folder in control_groups("cpu", groups, own)]
    return min((quota for quota in quotas if quota is not None), default=None)


def _quota(group: Path) -> float | None:
    """Return the CPU quota of the control group with this folder, in cores; None if the group sets no quota."""
    try:
        if (group / "cpu.max").is_file():
            limit, period = (group / "cpu.max").read_text(encoding="utf-8").split()
        else:
            limit, period = ((group / f"cpu.cfs_{name}_us").read_text(encoding="utf-8") for name in ("quota", "period"))
        return int(limit) / int(period) if limit != "max" and int(limit) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):
        return None


def control_groups(controller: str, groups: Path, own: Path) -> Iterator[Path]:
    """Yield the folders of this process's control groups (Linux), from its own group up to the root group.

    Args:
        controller: cpu or memory.
        groups: folder of all groups.
        own: file that names the process's own group.
    """
    try:
        lines = [line.split(":", 2) for line in own.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError):
        return
    for _, controllers, path in (parts for parts in lines if len(parts) == 3):
        if controllers and controller not in controllers.split(","):
            continue
        # version 1 has one folder for each controller, mounted under either name; version 2 has one tree for all
        for root in (groups / controllers, groups / controller) if controllers else (groups,):
            folder = root / path.strip("/")
            yield from (each for each in (folder, *folder.parents) if each.is_relative_to(root))
