"""Reader of untrusted MJCF, with limits on the files that a model may open and on its memory and compile time.

The text is parsed here before MuJoCo reads it. Files that a model includes or loads must lie in the folders that its
task may read, after links are resolved. The elements that take compile time are counted. An expensive model is first
compiled in a subprocess with limits on memory and time; a model above a second threshold is refused. All ordinary
robots are below the first threshold and are compiled at once: parsing takes milliseconds, a subprocess half a second.
"""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mujoco
import numpy as np

from rlcli.errors import one_line
from rlcli.machine import python_command, read_plain
from rlcli.registry import chosen_model, model_file
from rlcli.sim.quiet_mujoco import quiet_mujoco

_MAX_TEXT = 16 * 1024 * 1024
_MAX_ASSET = 256 * 1024 * 1024
_MAX_FILES = 1000
_MAX_DEPTH = 200
_MAX_MEMORY = 4 * 1024**3
SUBPROCESS_COST, _MAX_COST = 5_000, 1_000_000
"""Elements after replication; `_element_cost` counts an expensive element as several."""
TIME_S = 30
_MAX_ITERATIONS = 100_000
_TEXT = (".xml", ".mjcf", ".urdf")


class BadModel(ValueError):
    """Error for a model that is refused; the message has the file and the reason."""


def read_mjcf(file: Path, roots: Sequence[Path], *, installed: bool = False) -> mujoco.MjSpec:
    """Check a model and read it.

    Args:
        file: MJCF of the model.
        roots: folders that must contain the model and all files that it loads.
        installed: whether the model belongs to an installed package, whose size is trusted.

    Raises:
        BadModel: if the model is refused, or MuJoCo cannot read it.
    """
    scan = _MjcfScan(file, [root.resolve() for root in roots])
    if not any(file.resolve().is_relative_to(root) for root in scan.roots):
        raise BadModel(f"{file}: lies outside of {scan.roots[0]}; move it inside")
    scan.read(file)
    if not installed and scan.cost > _MAX_COST:
        raise BadModel(
            f"{file}: too large: as expensive as {scan.cost:,.0f} elements, {_MAX_COST:,} are allowed;"
            f" make its most expensive part smaller: {scan.costliest}"
        )
    if not installed and scan.cost > SUBPROCESS_COST:
        _compile_in_subprocess(file)
    try:
        quiet_mujoco()
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        raise BadModel(one_line(error)) from None
    _check_options(spec, file)
    return spec


def model_roots(root: Path, model: str) -> list[Path]:
    """Return the folders that a model may read: those of its task or of its package.

    Args:
        root: the task's folder.
        model: the model as in the YAML: a file of the task, or `package:...` and the like, as for `model_file`.
    """
    task, _, inner = chosen_model(root, model).rpartition(":")
    if not task:
        return package_roots(root)
    home = model_file(root, model)
    for _ in Path(inner.partition("/")[2] if task == "package" else inner).parts:
        home = home.parent
    return package_roots(home)


def package_roots(root: Path) -> list[Path]:
    """Return a task's folder, and the topmost Python package that contains it."""
    top = root.resolve()
    while (top / "__init__.py").is_file() and (top.parent / "__init__.py").is_file():
        top = top.parent
    return [root, top]


@dataclass(slots=True)
class _MjcfScan:
    """Parser that checks a model and all files that it includes or loads."""

    main: Path
    roots: list[Path]
    cost: float = 0.0
    costliest: str = ""
    _max_cost: float = 0.0
    _texts: list[Path] = field(default_factory=list)
    _asset_folders: set[str] = field(default_factory=lambda: {""})
    _assets: list[tuple[Path, int, str, str]] = field(default_factory=list)
    """File, line, element and file name of each asset to load."""

    def read(self, file: Path) -> None:
        """Parse the model and the files that it includes; then check the assets that it loads.

        Raises:
            BadModel: if anything is refused.
        """
        self._read_text(file)
        if len(self._assets) > _MAX_FILES:
            raise BadModel(f"{self.main}: loads more than {_MAX_FILES} files; use fewer meshes and textures")
        for source, line, element, name in self._assets:
            for found in self._allowed_files(source, line, element, name):
                self._check_asset(found, source, line)

    def _read_text(self, file: Path) -> None:
        if file.suffix.lower() not in _TEXT:
            allowed = ", ".join(_TEXT)
            raise BadModel(f"{file}: not MJCF; give a text file ({allowed}): compiled models (.mjb) are not opened")
        if len(self._texts) >= _MAX_FILES:
            raise BadModel(f"{self.main}: includes more than {_MAX_FILES} files; use fewer")
        self._texts.append(file)
        try:
            data = read_plain(file, _MAX_TEXT)
        except OSError as error:
            raise BadModel(f"{file}: {error.strerror or error}") from None
        includes: list[tuple[int, str, str]] = []
        copies: list[float] = [1.0]
        """How often each open element is replicated."""
        parser = expat.ParserCreate("utf-8")

        def start(name: str, attributes: dict[str, str]) -> None:
            line = parser.CurrentLineNumber
            if len(copies) > _MAX_DEPTH:
                raise BadModel(f"{file}:{line}: nested deeper than {_MAX_DEPTH} elements; use fewer levels")
            self._add_cost(copies[-1] * _element_cost(name, attributes), f"{name} at {file}:{line}")
            _check_numbers(file, line, name, attributes)
            copies.append(copies[-1] * (max(1.0, _number(attributes.get("count"))) if name == "replicate" else 1.0))
            for key in ("meshdir", "texturedir", "assetdir"):
                if key in attributes:
                    self._asset_folders.add(attributes[key])
            for key, value in attributes.items():
                if not key.startswith("file") or not value:
                    continue
                if value.lower().endswith((".mjb", ".mjz", ".zip")):
                    raise BadModel(f"{file}:{line}: {name}: '{value}' is a compiled model; give its MJCF text")
                if name in ("include", "model") or "xml" in attributes.get("content_type", ""):
                    includes.append((line, name, value))
                elif key != "filename" or name in ("mesh", "texture"):
                    self._assets.append((file, line, name, value))

        def refuse(*_: Any) -> None:
            raise BadModel(f"{file}:{parser.CurrentLineNumber}: a DOCTYPE is not allowed; remove it")

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda name: copies.pop()
        parser.StartDoctypeDeclHandler = refuse
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            why = expat.ErrorString(error.code)
            raise BadModel(f"{file}:{error.lineno}:{error.offset + 1}: not well-formed XML: {why}") from None
        except ValueError as error:
            raise BadModel(str(error) if isinstance(error, BadModel) else f"{file}: not XML: {error}") from None
        for line, element, name in includes:
            for found in self._allowed_files(file, line, element, name):
                if found not in self._texts:
                    self._read_text(found)

    def _add_cost(self, cost: float, source: str) -> None:
        self.cost += cost
        if cost > self._max_cost:
            self._max_cost, self.costliest = cost, source

    def _allowed_files(self, file: Path, line: int, element: str, name: str) -> Iterator[Path]:
        """Yield the existing files that MuJoCo may open for a file name; MuJoCo reports a file that does not exist."""
        if "\0" in name or "://" in name:
            raise BadModel(f"{file}:{line}: {element}: '{name}' is not a file name; correct it")
        seen: set[Path] = set()
        # MuJoCo looks in the folder of the main file and of the including one, with and without an asset folder
        for folder in [base / inner for base in (self.main.parent, file.parent) for inner in self._asset_folders]:
            try:
                path = (folder / name).resolve()
                inside = any(path.is_relative_to(root) for root in self.roots)
                if path in seen or (inside and not path.exists()):
                    continue
                if not inside and (Path(name).is_absolute() or path.exists()):
                    where = " and ".join(str(root) for root in dict.fromkeys(self.roots))
                    raise BadModel(f"{file}:{line}: {element}: '{name}' lies outside of {where}; move it inside")
            except (OSError, RuntimeError) as error:
                raise BadModel(f"{file}:{line}: {element}: '{name}': {error}") from None
            if inside:
                seen.add(path)
                yield path

    def _check_asset(self, path: Path, file: Path, line: int) -> None:
        if not path.is_file():
            raise BadModel(f"{file}:{line}: '{path}' is not a regular file; name a mesh or image file")
        size = path.stat().st_size
        if size > _MAX_ASSET:
            raise BadModel(f"{file}:{line}: '{path}' is too large; allowed are {_MAX_ASSET:,} bytes")
        cost = size / 20_000
        with path.open("rb") as opened:
            head = opened.read(24)
        if head[:8] == b"\x89PNG\r\n\x1a\n":  # a small file may decompress to a huge image: width x height
            cost = max(cost, int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big") / 10_000)
        self._add_cost(cost, f"'{path}'")


def _check_numbers(file: Path, line: int, name: str, attributes: dict[str, str]) -> None:
    """Refuse sizes that are too large, and options that are not finite."""
    for key, value in attributes.items():
        limit = _MAX_MEMORY if key == "memory" else 1_000_000
        if name == "size" and _number(value) > limit:
            raise BadModel(f'{file}:{line}: size {key}="{value[:40]}" is too large; {limit:,} is allowed')
        is_option = name in ("compiler", "option")
        if is_option and any(word.lower().lstrip("+-")[:3] in ("nan", "inf") for word in value.split()):
            raise BadModel(f'{file}:{line}: {name} {key}="{value[:40]}" is not finite; give a number')


def _element_cost(name: str, attributes: dict[str, str]) -> float:
    """Return the cost of an element, in ordinary elements."""
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
    """Return a number, which may end in MuJoCo's K, M, G, T, P or E; 0 for text that MuJoCo will refuse."""
    text = (text or "").strip()
    factor = {"k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40, "p": 2**50, "e": 2**60}.get(text[-1:].lower(), 1)
    try:
        value = float(text[:-1] if factor != 1 else text)
    except ValueError:
        return 0.0
    return value * factor if math.isfinite(value) else math.inf


def _check_options(spec: mujoco.MjSpec, file: Path) -> None:
    """Refuse options that MuJoCo accepts but that break every simulation."""
    option = spec.option
    if not (math.isfinite(option.timestep) and option.timestep > 0):
        raise BadModel(f"{file}: option timestep is {option.timestep:g}; it must be above 0")
    for name in ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations"):
        value = int(getattr(option, name, 0))
        if not 0 <= value <= _MAX_ITERATIONS:
            raise BadModel(f"{file}: option {name} is {value}; it must be between 0 and {_MAX_ITERATIONS:,}")
    for name in ("gravity", "wind", "magnetic", "tolerance", "impratio", "density", "viscosity"):
        if not np.isfinite(getattr(option, name)).all():
            raise BadModel(f"{file}: option {name} is not finite; give finite numbers")
    widths = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
    positions = sum(widths.get(joint.type, 1) for joint in spec.joints)
    for key in spec.keys:
        if len(key.qpos) not in (0, positions):
            raise BadModel(f"{file}: keyframe '{key.name}' has {len(key.qpos)} positions; give {positions}")


def _compile_in_subprocess(file: Path) -> None:
    """Compile a model in a subprocess, which the system ends if it exceeds its memory or time.

    Raises:
        BadModel: if compiling fails.
    """
    command = python_command("-c", _SUBPROCESS_CODE, str(file), str(_MAX_MEMORY), str(TIME_S))
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=2 * TIME_S)
    except subprocess.TimeoutExpired:
        raise BadModel(f"{file}: compiling takes more than {TIME_S} s; simplify the model") from None
    if done.returncode == 0:
        return
    limits = f"{TIME_S} s of time or {_MAX_MEMORY >> 30} GiB of memory"
    why = done.stdout.strip() or f"compiling takes more than {limits}, or crashes (exit {done.returncode}); simplify it"
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
    for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, time), (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(kind)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (limit, limit))
except (ImportError, ValueError, OSError):
    pass  # no limits on this system; the timeout of the parent process remains
try:
    mujoco.MjSpec.from_file(file).compile()
except (ValueError, MemoryError, RuntimeError) as error:
    print(error or type(error).__name__)
    sys.exit(1)
"""
