"""What is installed, and whether it fits together."""

from __future__ import annotations

import platform
import re
import sys
import threading
from importlib import metadata
from pathlib import Path

import rlcli
from rlcli.doctor.check import Check
from rlcli.registry import Entry, catalog, unreadable_distributions
from rlcli.registry.probe import probe

TRIPLE = ("mujoco", "mujoco-core", "mujoco-studio")
"""Packages that MuJoCo comes as, of one version: the library, and what is around it."""
_NO_EXTRAS = ("all", "dev", "docs")
"""Extras that are lists of others, or of what builds rlcli."""
_REQUIREMENT = re.compile(r"\s*([\w.-]+)(?:\[[^]]*\])?\s*([^;]*)(?:;(.*))?")
_BOUND = re.compile(r"\s*(==|>=|<=|!=|<|>)\s*([\d.]+)(\.\*)?\s*")


def installation_checks() -> list[Check]:
    """Python, rlcli, what it requires, MuJoCo's packages, and the extras."""
    place = f"{platform.python_implementation()} {platform.python_version()} at {sys.executable}"
    return [
        Check("python", "ok", place, details={"platform": platform.platform(), "prefix": sys.prefix}),
        Check("rlcli", "ok", f"{rlcli.__version__} at {Path(rlcli.__file__).parent}"),
        _packages(),
        _mujoco_packages(),
        *_extras(),
    ]


def metadata_checks() -> list[Check]:
    """Distributions whose metadata nobody can read."""
    bad = unreadable_distributions()
    hint = "install that package again, or remove the folder; it stops others than rlcli too"
    return [Check(f"metadata of {each.distribution}", "broken", each.reason, hint) for each in bad]


def entry_checks(group: str, timeout_s: float, stop: threading.Event) -> list[Check]:
    """Load every task, trainer or format in another process."""
    kind = group.rpartition(".")[2].removesuffix("s")
    found, _ = catalog(group)
    without = {"MUJOCO_GL"}  # one that is wrong stops MuJoCo from starting: a finding of its own, not of every task
    rows = probe(found, timeout_s, group, stop, without)
    checks = []
    for entry in found:
        row = rows[entry.qualified]
        said = f"{entry.distribution} {entry.version}: {row.broken or row.summary or 'loads'}"
        hint = _remedy(entry, row.broken) if row.broken else None
        shared = kind == "task" and _shared(entry, found)
        state = "broken" if row.broken else "warning" if shared else "ok"
        if shared and not row.broken:
            hint = f"{shared} offers one of that name; write {entry.qualified}"
        checks.append(Check(f"{kind} {entry.name}", state, said, hint, {"distribution": entry.distribution}))
    return checks


def version(name: str) -> str | None:
    """Of an installed distribution; None if there is none, or its metadata is malformed."""
    try:
        return metadata.version(name)
    except Exception:
        return None


def unmet(wanted: str, found: str) -> bool:
    """Whether a version is outside of bounds like `>=4.0,<5`; what is not understood is taken as met."""
    have = _numbers(found)
    for part in wanted.split(","):
        match = _BOUND.fullmatch(part)
        if match is None:
            continue
        sign, bound, prefix = match[1], _numbers(match[2]), match[3] is not None
        mine = have[: len(bound)] if prefix else have + [0] * (len(bound) - len(have))
        bound = bound + [0] * (len(mine) - len(bound))
        met = {"==": mine == bound, "!=": mine != bound, ">=": mine >= bound, "<=": mine <= bound}
        if not (met | {"<": mine < bound, ">": mine > bound})[sign]:
            return True
    return False


def _packages() -> Check:
    bad, versions = [], {}
    for name, wanted, extra in _requirements("rlcli"):
        if extra in _NO_EXTRAS:
            continue
        versions[name] = found = version(name)
        if found is None and extra is None:
            bad.append(f"{name} is missing")
        elif found is not None and unmet(wanted, found):
            bad.append(f"{name} {found} does not fit, {wanted} is needed")
    there = ", ".join(f"{name} {found}" for name, found in versions.items() if found)
    mend = "pip install --upgrade rlcli" if bad else None
    return Check("packages", "broken" if bad else "ok", "; ".join(bad) or there, mend, {"versions": versions})


def _mujoco_packages() -> Check:
    """Whether the packages of MuJoCo are of one version, and each there once."""
    copies = {name: _copies(name) for name in TRIPLE}
    first = {name: next(iter(found.values()), None) for name, found in copies.items()}
    bad = [f"{name} is missing" for name in TRIPLE if first[name] is None]
    for name in TRIPLE:
        own = first[name]
        for other, wanted, extra in _requirements(name):
            have = first.get(other)
            if own is not None and have is not None and extra is None and unmet(wanted, have):
                bad.append(f"{name} {own} needs {other} {wanted.lstrip('=')}, but {other} {have} is installed")
        if len(copies[name]) > 1:
            places = ", ".join(f"{found} in {place}" for place, found in copies[name].items())
            bad.append(f"{name} is there {len(copies[name])} times: {places}")
    said = ", ".join(f"{name} {found}" for name, found in first.items() if found)
    if not bad:
        return Check("mujoco packages", "ok", said, details=first)
    newest = max((found for found in first.values() if found), key=_numbers, default=None)
    wanted = f"mujoco=={first['mujoco'] or newest}" if newest else "mujoco"
    mend = f'pip uninstall -y {" ".join(TRIPLE)} && pip install "{wanted}"'  # why both: isolated_checks.REINSTALL
    return Check("mujoco packages", "broken", "; ".join(dict.fromkeys(bad)), mend, first)


def _copies(name: str) -> dict[str, str]:
    """Folder -> version of every installation of a distribution, the one that Python imports first."""
    found: dict[str, str] = {}
    for distribution in metadata.distributions(name=name):
        place = Path(str(getattr(distribution, "_path", "?"))).parent
        try:
            found.setdefault(str(place.resolve()), str(distribution.version))
        except Exception:  # malformed: `metadata_checks` says it
            continue
    return found


def _extras() -> list[Check]:
    """What each extra brings, whether it is installed, and how to install it."""
    wanted: dict[str, list[tuple[str, str]]] = {}
    for name, bounds, extra in _requirements("rlcli"):
        if extra is not None and extra not in _NO_EXTRAS and name != "rlcli":
            wanted.setdefault(extra, []).append((name, bounds))
    checks = []
    for extra, packages in sorted(wanted.items()):
        line = f'pip install "rlcli[{extra}]"'
        versions = {name: version(name) for name, _ in packages}
        there = ", ".join(f"{name} {found}" for name, found in versions.items() if found)
        missing = [name for name, found in versions.items() if found is None]
        state, said = ("warning", f"{there}; missing: {', '.join(missing)}") if missing else ("ok", there)
        if len(missing) == len(packages):
            state, said = "absent", "not installed"
        checks.append(Check(f"extra {extra}", state, said, line if missing else None, versions))
    return checks


def _requirements(distribution: str) -> list[tuple[str, str, str | None]]:
    """Name, bounds and extra of all that a distribution requires; those of another platform are left out."""
    try:
        lines = metadata.requires(distribution) or []
    except Exception:
        return []
    found = []
    for line in lines:
        match = _REQUIREMENT.match(line)
        if match is None:
            continue
        condition = match[3] or ""
        extra = re.search(r"""extra\s*==\s*["']([\w.-]+)["']""", condition)
        if extra is None and condition.strip():
            continue
        found.append((match[1], match[2].strip().strip("()"), extra[1] if extra else None))
    return found


def _remedy(entry: Entry, reason: str) -> str:
    if entry.distribution == "rlcli":
        return "pip install --upgrade --force-reinstall rlcli"
    late = "; if the machine is busy: rlcli doctor --probe-timeout 120" if " within " in reason else ""
    return f"pip uninstall {entry.distribution}, or leave it out with RLCLI_PLUGINS; tell its authors{late}"


def _shared(entry: Entry, others: list[Entry]) -> str | None:
    """The other distributions that have a task of this name."""
    owners = [e.distribution for e in others if e.name == entry.name and e.distribution != entry.distribution]
    return " and ".join(owners) if owners and entry.distribution != "rlcli" else None


def _numbers(text: str) -> list[int]:
    """The numbers of a release: `2.13.0+cpu` -> [2, 13, 0]."""
    return [int(number) for number in re.findall(r"\d+", text.partition("+")[0])]
