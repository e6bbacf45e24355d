"""Reading untrusted MJCF: which files it may open, and how much memory and time it may take.

The text is read here before MuJoCo sees it. Files that it includes or loads must lie in the folders that its task may
read, links followed; what could keep the compiler busy for ever is counted. A model that asks for much, though not for
too much, is compiled first in a process of its own, under limits of memory and time; one that asks for little, which is
every ordinary robot, is compiled at once: the reading costs milliseconds, a process half a second.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mujoco
import numpy as np

from rlcli.machine import read_plain
from rlcli.registry import chosen_model, model_file
from rlcli.sim.mujoco_log import quiet_mujoco

MOST_TEXT = 16 * 1024 * 1024
MOST_ASSET = 256 * 1024 * 1024
MOST_FILES = 1000
MOST_DEPTH = 200
MOST_MEMORY = 4 * 1024**3
MUCH, TOO_MUCH = 5_000, 1_000_000
"""Elements (after replication), and what else costs as much as one: see `_WEIGHTS`."""
TIME_S = 30
_ITERATIONS = 100_000
_TEXT = (".xml", ".mjcf", ".urdf")


class BadModel(ValueError):
    """A model that is not opened; the message names the file and the reason."""


def read_mjcf(file: Path, roots: Sequence[Path], *, installed: bool = False) -> mujoco.MjSpec:
    """A model, once it has been looked at.

    Args:
        file: its MJCF.
        roots: folders that it and what it loads must lie in.
        installed: whether it belongs to an installed package, which is trusted not to ask for too much.

    Raises:
        BadModel: if it is refused, or MuJoCo does not take it.
    """
    scan = _MjcfScan(file, [root.resolve() for root in roots])
    if not any(file.resolve().is_relative_to(root) for root in scan.roots):
        raise BadModel(f"{file}: lies outside of {scan.roots[0]}")
    scan.read(file)
    if not installed and scan.cost > TOO_MUCH:
        raise BadModel(f"{file}: asks for too much: {scan.costliest} ({scan.cost:,.0f} elements in all)")
    if not installed and scan.cost > MUCH:
        _compile_in_subprocess(file)
    try:
        quiet_mujoco()
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        raise BadModel(_one_line(error)) from None
    _check_options(spec, file)
    return spec


def model_roots(root: Path, model: str) -> list[Path]:
    """Folders that a model of a task in `root` may read: its task's or package's; `model` as `model_file` takes it."""
    task, _, inner = chosen_model(root, model).rpartition(":")
    if not task:
        return package_roots(root)
    home = model_file(root, model)
    for _ in Path(inner.partition("/")[2] if task == "package" else inner).parts:
        home = home.parent
    return package_roots(home)


def package_roots(root: Path) -> list[Path]:
    """A task's folder, and the Python package that it is part of."""
    top = root.resolve()
    while (top / "__init__.py").is_file() and (top.parent / "__init__.py").is_file():
        top = top.parent
    return [root, top]


@dataclass(slots=True)
class _MjcfScan:
    """What a model and the files that it includes ask for."""

    main: Path
    roots: list[Path]
    cost: float = 0.0
    costliest: str = ""
    _most: float = 0.0
    _seen: list[Path] = field(default_factory=list)
    _assets: set[str] = field(default_factory=lambda: {""})
    _loads: list[tuple[Path, int, str, str]] = field(default_factory=list)

    def read(self, file: Path) -> None:
        """Read the model, then what it includes, then see to what it loads.

        Raises:
            BadModel: if anything is refused.
        """
        self._read_text(file)
        for number, (where, line, element, name) in enumerate(self._loads):
            if number >= MOST_FILES:
                raise BadModel(f"{self.main}: loads more than {MOST_FILES} files")
            folders = [base / folder for base in (self.main.parent, where.parent) for folder in self._assets]
            for found in self._allowed_files(where, line, element, name, folders):
                self._check_asset(found, where, line)

    def _read_text(self, file: Path) -> None:
        if file.suffix.lower() not in _TEXT:
            raise BadModel(
                f"{file}: not MJCF: models are text, {', '.join(_TEXT)}; compiled ones (.mjb) are not opened"
            )
        if len(self._seen) >= MOST_FILES:
            raise BadModel(f"{self.main}: includes more than {MOST_FILES} files")
        self._seen.append(file)
        try:
            data = read_plain(file, MOST_TEXT)
        except OSError as error:
            raise BadModel(f"{file}: {error.strerror or error}") from None
        includes: list[tuple[int, str, str]] = []
        stack: list[float] = [1.0]
        parser = expat.ParserCreate("utf-8")

        def start(name: str, attributes: dict[str, str]) -> None:
            line = parser.CurrentLineNumber
            if len(stack) > MOST_DEPTH:
                raise BadModel(f"{file}:{line}: nested deeper than {MOST_DEPTH} elements")
            times = stack[-1]
            self._count(file, line, name, attributes, times)
            stack.append(times * (max(1.0, _number(attributes.get("count"))) if name == "replicate" else 1.0))
            for key in ("meshdir", "texturedir", "assetdir"):
                if key in attributes:
                    self._assets.add(attributes[key])
            for key, value in attributes.items():
                if not key.startswith("file") or not value:
                    continue
                if value.lower().endswith((".mjb", ".mjz", ".zip")):
                    raise BadModel(f"{file}:{line}: {name}: '{value}' is not text; compiled models are not opened")
                if name in ("include", "model") or "xml" in attributes.get("content_type", ""):
                    includes.append((line, name, value))
                elif key != "filename" or name in ("mesh", "texture"):
                    self._loads.append((file, line, name, value))

        def end(name: str) -> None:
            stack.pop()

        def refuse(*_: Any) -> None:
            raise BadModel(f"{file}:{parser.CurrentLineNumber}: a DOCTYPE is not allowed in a model")

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.StartDoctypeDeclHandler = refuse
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            why = expat.ErrorString(error.code)
            raise BadModel(f"{file}:{error.lineno}:{error.offset + 1}: not well-formed XML: {why}") from None
        except ValueError as error:
            raise BadModel(str(error) if isinstance(error, BadModel) else f"{file}: not XML: {error}") from None
        for line, element, name in includes:
            folders = [base / folder for base in (self.main.parent, file.parent) for folder in self._assets]
            for found in self._allowed_files(file, line, element, name, folders):
                if found not in self._seen:
                    self._read_text(found)

    def _count(self, file: Path, line: int, name: str, attributes: dict[str, str], times: float) -> None:
        cost = times * _element_cost(name, attributes)
        self.cost += cost
        if cost > self._most:
            self._most, self.costliest = cost, f"{name} at {file}:{line}"
        if name == "size":
            for key, value in attributes.items():
                most = MOST_MEMORY if key == "memory" else 1_000_000
                if _number(value) > most:
                    raise BadModel(f'{file}:{line}: size {key}="{value[:40]}" is more than {most:,}')
        if name == "compiler" or name == "option":
            for key, value in attributes.items():
                if any(word.lower().lstrip("+-")[:3] in ("nan", "inf") for word in value.split()):
                    raise BadModel(f'{file}:{line}: {name} {key}="{value[:40]}" is not a finite number')

    def _allowed_files(self, file: Path, line: int, element: str, name: str, folders: list[Path]) -> Iterator[Path]:
        """The files that a name may stand for; none if there is none, which MuJoCo says."""
        if "\0" in name or "://" in name:
            raise BadModel(f"{file}:{line}: {element}: '{name}' is not the name of a file")
        seen: set[Path] = set()
        for folder in folders:
            try:
                path = (folder / name).resolve()
                inside = any(path.is_relative_to(root) for root in self.roots)
                if path in seen or (inside and not path.exists()):
                    continue
                if not inside and (Path(name).is_absolute() or path.exists()):
                    where = " and ".join(str(root) for root in dict.fromkeys(self.roots))
                    raise BadModel(f"{file}:{line}: {element}: '{name}' lies outside of {where}")
            except (OSError, RuntimeError) as error:
                raise BadModel(f"{file}:{line}: {element}: '{name}': {error}") from None
            if inside:
                seen.add(path)
                yield path

    def _check_asset(self, path: Path, file: Path, line: int) -> None:
        if not path.is_file():
            raise BadModel(f"{file}:{line}: '{path}' is not a plain file")
        size = path.stat().st_size
        if size > MOST_ASSET:
            raise BadModel(f"{file}:{line}: '{path}' is larger than {MOST_ASSET:,} bytes")
        cost = size / 20_000
        with path.open("rb") as opened:
            head = opened.read(24)
        if head[:8] == b"\x89PNG\r\n\x1a\n":
            cost = max(cost, int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big") / 10_000)
        self.cost += cost
        if cost > self._most:
            self._most, self.costliest = cost, f"'{path}'"


def _element_cost(name: str, attributes: dict[str, str]) -> float:
    """How many ordinary elements an element costs."""
    counts = [max(1.0, _number(word)) for word in attributes.get("count", "").split()]
    if name in ("flexcomp", "composite"):
        return 1.0 + 10.0 * math.prod(counts)
    if name == "hfield":
        return 1.0 + _number(attributes.get("nrow")) * _number(attributes.get("ncol")) / 1_000
    if name == "texture":
        width = _number(attributes.get("width"))
        return 1.0 + width * max(width, _number(attributes.get("height"))) / 10_000
    if name == "mesh":  # a built-in shape
        return 1.0 + math.prod(max(1.0, _number(word)) for word in attributes.get("params", "").split()) / 10
    if name == "size":
        return 1.0 + sum(_number(attributes.get(key)) for key in attributes if key != "memory") / 100
    return 1.0 + sum(len(value) for value in attributes.values()) / 10_000


def _number(text: str | None) -> float:
    """A number, with MuJoCo's K, M, G and T; what is none counts as 0, and MuJoCo says what it is."""
    text = (text or "").strip()
    factor = {"k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40, "p": 2**50, "e": 2**60}.get(text[-1:].lower(), 1)
    try:
        value = float(text[:-1] if factor != 1 else text)
    except ValueError:
        return 0.0
    return value * factor if math.isfinite(value) else math.inf


def _check_options(spec: mujoco.MjSpec, file: Path) -> None:
    """Options that MuJoCo takes and no simulation survives."""
    option = spec.option
    if not (math.isfinite(option.timestep) and option.timestep > 0):
        raise BadModel(f"{file}: option timestep is {option.timestep:g}; it must be above 0")
    for name in ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations"):
        value = int(getattr(option, name, 0))
        if not 0 <= value <= _ITERATIONS:
            raise BadModel(f"{file}: option {name} is {value}; it must be between 0 and {_ITERATIONS:,}")
    for name in ("gravity", "wind", "magnetic", "tolerance", "impratio", "density", "viscosity"):
        if not np.isfinite(getattr(option, name)).all():
            raise BadModel(f"{file}: option {name} is not finite")
    widths = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
    positions = sum(widths.get(joint.type, 1) for joint in spec.joints)
    for key in spec.keys:
        if len(key.qpos) not in (0, positions):
            raise BadModel(f"{file}: keyframe '{key.name}' has {len(key.qpos)} positions, and the model {positions}")


def _compile_in_subprocess(file: Path) -> None:
    """Compile in a process of its own that the system ends when it takes too much.

    Raises:
        BadModel: if it does not end well.
    """
    command = [sys.executable, "-P", "-c", _SUBPROCESS_CODE, str(file), str(MOST_MEMORY), str(TIME_S)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=2 * TIME_S)
    except subprocess.TimeoutExpired:
        raise BadModel(f"{file}: compiling it takes more than {TIME_S} s") from None
    if done.returncode == 0:
        return
    limits = f"{TIME_S} s of time or {MOST_MEMORY >> 30} GiB of memory"
    why = done.stdout.strip() or f"compiling it takes more than {limits}, or crashes (exit {done.returncode})"
    raise BadModel(f"{file}: {' '.join(why.split())[:500]}")


_SUBPROCESS_CODE = """
import sys
file, memory, time = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
import mujoco
log = mujoco.MjLogConfig()
log.logto_file = log.logto_console = False
log.set()
try:
    import resource
    for what, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, time), (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(what)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (most, most))
except (ImportError, ValueError, OSError):
    pass  # the parent's patience is the limit
try:
    mujoco.MjSpec.from_file(file).compile()
except (ValueError, MemoryError, RuntimeError) as error:
    print(error or type(error).__name__)
    sys.exit(1)
"""


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
