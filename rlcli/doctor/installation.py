"""Checks of the installed packages and plugins: whether they are present, can be loaded, and fit together."""

import platform
import re
import sys
import threading
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import rlcli
from rlcli.doctor.check import Check
from rlcli.errors import install_hint, pip_install
from rlcli.registry import Entry, catalog, unreadable_distributions
from rlcli.registry.plugin_imports import release_numbers
from rlcli.registry.probe import probe

MUJOCO_PACKAGES = ("mujoco", "mujoco-core", "mujoco-studio")
"""The three PyPI packages of MuJoCo, which must have the same version."""
_NO_EXTRAS = ("all", "dev", "docs")
"""Extras (optional dependencies) that are not checked: those that list other extras, and tools for developers."""
_REQUIREMENT = re.compile(r"\s*([\w.-]+)(?:\[[^]]*\])?\s*([^;]*)(?:;(.*))?")
_NO_MODULE = re.compile(r"ModuleNotFoundError: No module named '(\w+)")
_BOUND = re.compile(r"\s*(==|>=|<=|!=|<|>)\s*([\d.]+)(\.\*)?\s*")


def installation_checks() -> list[Check]:
    """Return the checks of Python, rlcli, its dependencies, MuJoCo's packages and the extras."""
    python = f"{platform.python_implementation()} {platform.python_version()} at {sys.executable}"
    return [
        Check("python", "ok", python, details={"platform": platform.platform(), "prefix": sys.prefix}),
        Check("rlcli", "ok", f"{rlcli.__version__} at {Path(rlcli.__file__).parent}"),
        _dependencies_check(),
        _mujoco_packages_check(),
        *_extras_checks(),
    ]


def metadata_checks() -> list[Check]:
    """Return one broken check for each distribution whose metadata cannot be read."""
    bad = unreadable_distributions()
    hint = "reinstall this package, or delete the folder of its metadata; pip and other programs may fail on it, too"
    return [Check(f"metadata of {each.distribution}", "broken", each.reason, hint) for each in bad]


def entry_checks(group: str, timeout_s: float, stop: threading.Event) -> list[Check]:
    """Load every plugin of an entry-point group in another process and return one check for each.

    Args:
        group: `rlcli.tasks`, `rlcli.trainers` or `rlcli.formats`.
        timeout_s: time limit for each plugin [s].
        stop: event that ends the checks before all plugins are loaded.
    """
    kind = group.rpartition(".")[2].removesuffix("s")
    entries, _ = catalog(group)
    without = {"MUJOCO_GL"}  # a wrong value of MUJOCO_GL stops MuJoCo from starting; `graphics_check` reports this once
    rows = probe(entries, timeout_s, group, stop, without)
    checks = []
    for entry in entries:
        row = rows[entry.qualified]
        owners = _other_owners(entry, entries) if kind == "task" else ""
        state, hint = "ok", None
        if row.broken:
            state, hint = "broken", row.remedy or _remedy(entry, row.broken)
            if _is_late(row.broken):
                state, row = "warning", replace(row, broken=f"slow: {row.broken}")
        elif owners:
            state, hint = "warning", f"{owners} has a task of the same name; write {entry.qualified}"
        text = f"{entry.distribution} {entry.version}: {row.broken or row.summary or 'loads'}"
        checks.append(Check(f"{kind} {entry.name}", state, text, hint, {"distribution": entry.distribution}))
    return checks


def version(name: str) -> str | None:
    """Return the version of an installed distribution; None if it is missing or its metadata is malformed."""
    try:
        return metadata.version(name)
    except Exception:
        return None


def violates_bounds(wanted: str, found: str) -> bool:
    """Return whether the version `found` is outside of the bounds `wanted`, such as `>=4.0,<5`.

    Bounds of an unknown form are ignored.
    """
    have = release_numbers(found)
    for part in wanted.split(","):
        match = _BOUND.fullmatch(part)
        if match is None:
            continue
        sign, bound, prefix = match[1], release_numbers(match[2]), match[3] is not None
        # compare lists of equal length: 4.0 equals 4.0.0, and `==4.0.*` compares only the first two numbers
        mine = have[: len(bound)] if prefix else have + [0] * (len(bound) - len(have))
        bound = bound + [0] * (len(mine) - len(bound))
        met = {"==": mine == bound, "!=": mine != bound, ">=": mine >= bound, "<=": mine <= bound}
        if not (met | {"<": mine < bound, ">": mine > bound})[sign]:
            return True
    return False


def _dependencies_check() -> Check:
    """Check that the dependencies of rlcli are installed in versions that fit."""
    bad, versions = {}, {}
    for name, wanted, extra in _requirements("rlcli"):
        if extra in _NO_EXTRAS:
            continue
        versions[name] = found = version(name)
        if found is None and extra is None:
            bad[name] = f"{name} is missing"
        elif found is not None and violates_bounds(wanted, found):
            bad[name] = f"{name} {found} does not fit, {wanted} is needed"
    details = {"versions": versions}
    if bad:
        return Check("packages", "broken", "; ".join(bad.values()), install_hint(" ".join(bad)), details)
    return Check("packages", "ok", _versions_text(versions), details=details)


def _mujoco_packages_check() -> Check:
    """Check that the packages of MuJoCo have the same version and that each is installed once."""
    copies = {name: _copies(name) for name in MUJOCO_PACKAGES}
    first = {name: next(iter(found.values()), None) for name, found in copies.items()}
    bad = [f"{name} is missing" for name in MUJOCO_PACKAGES if first[name] is None]
    for name in MUJOCO_PACKAGES:
        own = first[name]
        for other, wanted, extra in _requirements(name):
            have = first.get(other)
            if own is not None and have is not None and extra is None and violates_bounds(wanted, have):
                bad.append(f"{name} {own} needs {other} {wanted.lstrip('=')}, but {other} {have} is installed")
        if len(copies[name]) > 1:
            places = ", ".join(f"{found} in {place}" for place, found in copies[name].items())
            bad.append(f"{name} is installed {len(copies[name])} times: {places}")
    if not bad:
        return Check("mujoco packages", "ok", _versions_text(first), details=first)
    newest = max((found for found in first.values() if found), key=release_numbers, default=None)
    wanted = f"mujoco=={first['mujoco'] or newest}" if newest else "mujoco"
    # uninstall first: see compute_and_graphics.REINSTALL
    hint = f"pip uninstall -y {' '.join(MUJOCO_PACKAGES)} && {pip_install(wanted)}"
    return Check("mujoco packages", "broken", "; ".join(dict.fromkeys(bad)), hint, first)


def _copies(name: str) -> dict[str, str]:
    """Return the version of every installation of a package, by folder; Python imports the first one."""
    found: dict[str, str] = {}
    for distribution in metadata.distributions(name=name):
        folder = Path(str(getattr(distribution, "_path", "?"))).parent
        try:
            found.setdefault(str(folder.resolve()), str(distribution.version))
        except Exception:  # malformed metadata: `metadata_checks` reports it
            continue
    return found


def _extras_checks() -> list[Check]:
    """Return one check for each extra of rlcli, such as `rlcli[export]`: whether its packages are installed."""
    wanted: dict[str, list[tuple[str, str]]] = {}
    for name, bounds, extra in _requirements("rlcli"):
        if extra is not None and extra not in _NO_EXTRAS and name != "rlcli":
            wanted.setdefault(extra, []).append((name, bounds))
    checks = []
    for extra, packages in sorted(wanted.items()):
        hint = pip_install(f"rlcli[{extra}]")
        versions = {name: version(name) for name, _ in packages}
        missing = [name for name, found in versions.items() if found is None]
        if not missing:
            state, text = "ok", _versions_text(versions)
        elif len(missing) < len(packages):
            state, text = "warning", f"{_versions_text(versions)}; missing: {', '.join(missing)}"
        else:
            state, text = "absent", "not installed"
        checks.append(Check(f"extra {extra}", state, text, hint if missing else None, versions))
    return checks


def _versions_text(versions: dict[str, str | None]) -> str:
    """Return the installed packages with their versions, as text."""
    return ", ".join(f"{name} {found}" for name, found in versions.items() if found)


def _requirements(distribution: str) -> list[tuple[str, str, str | None]]:
    """Return (name, bounds such as `>=4`, extra or None) of every requirement of a package.

    Requirements with a condition other than an extra (platform, Python version) are left out.
    """
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
    """Return the hint for a plugin that cannot be loaded: what to install, reinstall or uninstall.

    Args:
        entry: the plugin's entry point.
        reason: the error of its import; after a time-out, the hint also names a longer time limit.
    """
    missing = missing_requirement(reason)
    if missing is not None:
        return install_hint(missing)
    if entry.distribution == "rlcli":
        return pip_install("--force-reinstall --no-deps rlcli")
    late = "if the machine is busy: `rlcli doctor --probe-timeout 120`; else " if _is_late(reason) else ""
    remove = f"pip uninstall {entry.distribution}, or exclude this plugin with RLCLI_PLUGINS"
    return f"{late}{remove}; report the error to the plugin's authors"


def missing_requirement(reason: str) -> str | None:
    """Return the package that rlcli requires and that a failed import did not find; None for other failures.

    Args:
        reason: text of the import's error.
    """
    match = _NO_MODULE.search(reason)
    module = match[1].lower() if match else None
    for name, _, extra in _requirements("rlcli"):
        if extra is None and name.lower().replace("-", "_") == module and version(name) is None:
            return name
    return None


def _is_late(reason: str) -> bool:
    """Return whether a plugin counts as broken only because it exceeded the time limit of its load."""
    return reason.startswith(("did not load within ", "not loaded, because "))


def _other_owners(entry: Entry, entries: list[Entry]) -> str:
    """Return the other packages with a task of the same name; empty for a task of rlcli, which has priority."""
    owners = [e.distribution for e in entries if e.name == entry.name and e.distribution != entry.distribution]
    return " and ".join(owners) if entry.distribution != "rlcli" else ""
