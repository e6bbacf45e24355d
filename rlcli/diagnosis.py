"""What `rlcli doctor` finds out: whether this machine, this installation and every plugin in it can work.

Whatever may hang or crash (drivers, graphics, plugins) is asked in processes of its own, several at a time.
`python -m rlcli.diagnosis QUESTION` is such a process.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from rlcli import __version__
from rlcli.errors import MachineError, RlcliError
from rlcli.machine import available_cores, core_quota
from rlcli.probe import TIMEOUT_S, probe
from rlcli.registry import (
    TASKS,
    TRAINERS,
    Entry,
    catalog,
    malformed_metadata_ignored,
    unknown_wanted,
    unreadable_distributions,
)
from rlcli.sim.gl import has_display

BACKENDS = {"egl": "EGL", "osmesa": "OSMesa", "glfw": "window"}
SETTINGS = (
    *("RLCLI_MODELS", "RLCLI_PLUGINS", "RLCLI_RUNS_DIR", "MUJOCO_GL", "DISPLAY", "CUDA_VISIBLE_DEVICES"),
    *("OMP_NUM_THREADS", "MKL_NUM_THREADS", "LOCAL_WORLD_SIZE", "PYTHONPATH"),
)
LOW_DISK_BYTES = 1e9


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at. `state` is ok, warning (something will not work) or broken."""

    name: str
    state: str
    found: str
    hint: str | None = None
    details: dict[str, Any] = field(default_factory=dict)


def examine(runs_dir: Path, timeout_s: float = TIMEOUT_S) -> list[Check]:
    """Look at everything."""
    stop = threading.Event()
    with ThreadPoolExecutor(2) as pool:
        try:
            tasks = pool.submit(_entries, TASKS, timeout_s, stop)
            asked = pool.submit(_outside, timeout_s)
            checks = [*_installation(), _cores(), _runs_folder(runs_dir), *_settings()]
            return [*checks, *asked.result(), *_metadata(), *tasks.result(), *_entries(TRAINERS, timeout_s, stop)]
        except BaseException:  # Ctrl-C
            stop.set()
            raise


def _installation() -> list[Check]:
    place = f"{platform.python_implementation()} {platform.python_version()} at {sys.executable}"
    checks = [
        Check("python", "ok", place, details={"platform": platform.platform(), "prefix": sys.prefix}),
        Check("rlcli", "ok", f"{__version__} at {Path(__file__).parent}"),
    ]
    bad, versions = [], {}
    for line in metadata.requires("rlcli") or ():
        requirement, _, condition = line.partition(";")
        match = re.match(r"\s*([\w.-]+)(?:\[[^]]*\])?\s*(?:>=\s*([\d.]+))?", requirement)
        if match is None or match[1] == "rlcli" or re.search(r"extra == .(dev|docs|all)\b", condition):
            continue
        name, wanted = match[1], match[2] or "0"
        versions[name] = found = _version(name)
        if found is None and "extra" not in condition:
            bad.append(f"{name} is missing")
        elif found is not None and _numbers(found) < _numbers(wanted):
            bad.append(f"{name} {found} is older than {wanted}")
    hint = "pip install --upgrade rlcli" if bad else None
    there = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
    absent = ", ".join(name for name, version in versions.items() if version is None)
    checks.append(
        Check("packages", "broken" if bad else "ok", "; ".join(bad) or there, hint, {"versions": versions})
        if not absent or bad
        else Check("packages", "ok", f"{there}; not installed: {absent}", details={"versions": versions})
    )
    return checks


def _cores() -> Check:
    cores, quota = available_cores(), core_quota()
    found = f"{cores} of {os.cpu_count()} for this process, the default of engine_threads"
    details = {"cores": os.cpu_count(), "available": cores, "quota": quota}
    if quota is not None:
        found += f"; its control group grants {quota:g}"
    return Check("cores", "ok", found, details=details)


def _runs_folder(folder: Path) -> Check:
    at = folder.absolute()
    while not at.exists() and at != at.parent:
        at = at.parent
    try:
        with tempfile.NamedTemporaryFile(dir=at):
            pass
        free = shutil.disk_usage(at).free
    except OSError as error:
        said = f"{folder} cannot be written: {at}: {error.strerror or error}"
        return Check("runs folder", "broken", said, "--runs-dir, or RLCLI_RUNS_DIR")
    found = f"{folder} can be written, {free / 1e9:.1f} GB free"
    state = "warning" if free < LOW_DISK_BYTES else "ok"
    return Check("runs folder", state, found, "make room" if state != "ok" else None, {"free_bytes": free})


def _settings() -> list[Check]:
    given = {name: os.environ[name] for name in SETTINGS if name in os.environ}
    found = ", ".join(f"{name}={value}" for name, value in given.items()) or "none"
    unknown = unknown_wanted()
    if unknown:
        said = f"{found}; RLCLI_PLUGINS names what is not installed: {', '.join(unknown)}"
        return [Check("settings", "warning", said, "name distributions, as list-tasks does", given)]
    return [Check("settings", "ok", found, details=given)]


def _metadata() -> list[Check]:
    bad = unreadable_distributions()
    hint = "install that package again, or remove the folder; it stops others than rlcli too"
    return [Check(f"metadata of {each.distribution}", "broken", each.reason, hint) for each in bad]


def _outside(timeout_s: float) -> list[Check]:
    """What drivers and graphics say."""
    with ThreadPoolExecutor(available_cores()) as pool:
        compute = pool.submit(_ask, "compute", timeout_s)
        drawn = {name: pool.submit(_ask, name, timeout_s) for name in BACKENDS}
        return [*_compute(*compute.result()), _graphics({name: answer.result() for name, answer in drawn.items()})]


def _compute(answer: dict[str, Any] | None, reason: str) -> list[Check]:
    if answer is None:
        return [
            Check("torch", "broken", f"torch and mujoco cannot be imported: {reason}", "pip install --upgrade rlcli")
        ]
    build = f"{answer['torch']}, built for {'CUDA ' + answer['cuda'] if answer['cuda'] else 'the CPU'}"
    checks = [
        Check("torch", "ok", f"{build}, {answer['threads']} threads", details=answer),
        Check("mujoco", "ok", f"{answer['mujoco']}, the CPU engine steps"),
    ]
    driver = shutil.which("nvidia-smi") is not None or Path("/proc/driver/nvidia").exists()
    if answer["gpus"]:
        warp = _version("mujoco-warp")
        said = ", ".join(answer["gpus"])
        if warp is None:
            return [*checks, Check("gpu", "warning", f"{said}; without mujoco-warp", 'pip install "rlcli[gpu]"')]
        return [*checks, Check("gpu", "ok", f"{said}; mujoco-warp {warp}")]
    if driver:
        hint = "install a CUDA build of torch (https://pytorch.org), and see whether nvidia-smi works"
        return [*checks, Check("gpu", "warning", "there is a driver, but torch sees no device", hint)]
    return [*checks, Check("gpu", "ok", "none; the CPU engine needs none")]


_OTHER_CHOICES = {
    "disable",
    "disabled",
    "off",
    "false",
    "0",
    "enable",
    "enabled",
    "on",
    "true",
    "1",
    "glx",
    "wgl",
    "cgl",
}
"""Of MUJOCO_GL, beside the names of libraries: MuJoCo's own."""


def _graphics(answers: dict[str, tuple[dict[str, Any] | None, str]]) -> Check:
    works = [BACKENDS[name] for name, (answer, _) in answers.items() if answer is not None]
    fails = {BACKENDS[name]: reason for name, (answer, reason) in answers.items() if answer is None}
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    said = f"{', '.join(works) or 'nothing'} can draw"
    said += "".join(f"; {name} cannot ({reason})" for name, reason in fails.items())
    details = {name: answer is not None for name, (answer, _) in answers.items()}
    if wanted in BACKENDS and answers[wanted][0] is None:
        return Check("graphics", "broken", f"MUJOCO_GL={wanted} cannot draw; {said}", "unset MUJOCO_GL", details)
    if wanted and wanted not in BACKENDS and wanted not in _OTHER_CHOICES:
        return Check(
            "graphics",
            "broken",
            f"MUJOCO_GL={wanted}, with which MuJoCo does not start; {said}",
            "unset MUJOCO_GL",
            details,
        )
    if not works:
        hint = "for videos: install libegl1 or libosmesa6 (Debian, Ubuntu: apt install libegl1 libosmesa6)"
        return Check("graphics", "warning", said, hint, details)
    return Check("graphics", "ok", said, details=details)


def _entries(group: str, timeout_s: float, stop: threading.Event) -> list[Check]:
    """Every task, or every trainer, loaded in another process."""
    kind = "task" if group == TASKS else "trainer"
    entries, _ = catalog(group)
    rows = probe(entries, timeout_s, group, stop)
    checks = []
    for entry in entries:
        row = rows[entry.qualified]
        found = f"{entry.distribution} {entry.version}: {row.broken or row.summary or 'loads'}"
        hint = f"RLCLI_PLUGINS leaves plugins out; tell the authors of {entry.distribution}" if row.broken else None
        shared = kind == "task" and _shared(entry, entries)
        state = "broken" if row.broken else "warning" if shared else "ok"
        if shared and not row.broken:
            hint = f"{shared} offers one of that name; write {entry.qualified}"
        checks.append(Check(f"{kind} {entry.name}", state, found, hint, {"distribution": entry.distribution}))
    return checks


def _shared(entry: Entry, entries: list[Entry]) -> str | None:
    """The other distributions that have a task of this name."""
    others = [e.distribution for e in entries if e.name == entry.name and e.distribution != entry.distribution]
    return " and ".join(others) if others and entry.distribution != "rlcli" else None


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except Exception:  # not installed, or malformed
        return None


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", version)]


def _ask(question: str, timeout_s: float) -> tuple[dict[str, Any] | None, str]:
    """The answer of another process, or None and why there is none."""
    command = [sys.executable, "-m", "rlcli.diagnosis", question]
    try:
        done = subprocess.run(command, capture_output=True, timeout=timeout_s, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        return None, f"no answer within {timeout_s:g} s"
    with contextlib.suppress(ValueError, IndexError):
        answer = json.loads(done.stdout.splitlines()[-1])
        return (None, str(answer["failed"])) if "failed" in answer else (answer, "")
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return None, f"exit {done.returncode}" + (f": {lines[-1][:200]}" if lines else "")


def _answer_compute() -> dict[str, Any]:
    import mujoco
    import torch

    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    mujoco.mj_step(model, mujoco.MjData(model))
    there = torch.cuda.is_available()
    return {
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "threads": torch.get_num_threads(),
        "gpus": [torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())] if there else [],
        "mujoco": mujoco.__version__,
    }


def _answer_graphics(backend: str) -> dict[str, Any]:
    if backend == "glfw" and not has_display():
        raise MachineError("there is no display")
    os.environ["MUJOCO_GL"] = backend
    context: Any = importlib.import_module(f"mujoco.{backend}").GLContext(64, 64)
    context.make_current()
    context.free()
    return {"backend": backend}


def _main(question: str) -> None:
    try:
        with malformed_metadata_ignored():
            answer = _answer_compute() if question == "compute" else _answer_graphics(question)
    except Exception as error:
        said = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
        answer = {"failed": " ".join(said.split())[:300]}
    sys.stdout.write("\n" + json.dumps(answer) + "\n")
    sys.stdout.flush()
    os._exit(0)  # some graphics drivers crash when they are unloaded


if __name__ == "__main__":
    _main(sys.argv[1])
