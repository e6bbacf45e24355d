"""Reader of untrusted MJCF, with limits on the files that a model may open and on its memory and compile time.

The text is parsed here before MuJoCo reads it. Files that a model includes or loads must lie in the folders that its
task may read, after links are resolved. The elements that take compile time are counted. An expensive model is first
compiled in a subprocess with limits on memory and time; a model above a second threshold is refused. All ordinary
robots are below the first threshold and are compiled at once: parsing takes milliseconds, a subprocess half a second.
"""

from __future__ import annotations

import itertools
import math
import re
import subprocess
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mujoco
import numpy as np

from rlcli.errors import one_line
from rlcli.machine import memory_error, python_command, read_plain
from rlcli.registry import chosen_model, model_file
from rlcli.safe_text import shorten
from rlcli.scene.mjcf_cost import ENDLESS, element_cost, mjcf_number, number_of
from rlcli.sim.quiet_mujoco import quiet_mujoco

_MAX_TEXT = 16 * 1024 * 1024
"""Largest MJCF file [bytes]."""
_MAX_ASSET = 256 * 1024 * 1024
"""Largest mesh or image file [bytes]."""
_MAX_FILES = 1000
_MAX_DEPTH = 200
"""Largest depth of nested elements."""
_MAX_LEVELS = 50  # of nested includes
_MAX_MEMORY = 2 * 1024**3
"""Limit of the memory that a model may ask for, and of the compiling subprocess [bytes]."""
SUBPROCESS_COST, _MAX_COST = 5_000, 1_000_000
"""Costs above which a model is first compiled in a subprocess, and above which it is refused; unit: one element."""
TIME_S = 10
"""Limit of the CPU time of the compiling subprocess [s]; it is killed after twice this time at the latest."""
_MAX_ITERATIONS = 100_000
_compiled: set[tuple[tuple[Path, tuple[int, int]], ...]] = set()
"""Files of each model that a subprocess has compiled, with their versions; the same files are not compiled again."""
_TEXT = (".xml", ".mjcf", ".urdf")
_NOT_FINITE = re.compile(r"[-+]?(nan|inf)|[eE]\+?\d{3}", re.IGNORECASE)
"""Parts of numbers that may not be finite: nan, inf, an exponent of three digits."""
_NAMES = {
    *("name", "class", "childclass", "prefix", "model", "frame", "target", "instance", "plugin", "key", "material"),
    *("mesh", "hfield", "texture", "camera", "actuator", "tendon", "tendon1", "tendon2", "flex", "node", "objname"),
    *("refname", "body", "body1", "body2", "subtree1", "subtree2", "joint", "joint1", "joint2", "jointinparent"),
    *("geom", "geom1", "geom2", "site", "site1", "site2", "sidesite", "cranksite", "slidersite", "refsite"),
}
"""Attributes that contain names, which may look like numbers, as `inf` does."""
_FREE_SENSORS = ("clock", "e_potential", "e_kinetic", "user", "plugin")
"""Sensors that may have no object."""
MUJOCO_ERRORS = (ValueError, RuntimeError, MemoryError, mujoco.FatalError, mujoco.UnexpectedError)
"""Exceptions that MuJoCo raises for a model that it cannot read or compile."""


class BadModel(ValueError):
    """Error for a model that is refused; the message has the file and the reason."""


def read_mjcf(file: Path, roots: Sequence[Path], *, installed: bool = False, compiled: bool = False) -> mujoco.MjSpec:
    """Check an untrusted MJCF, and return it as an MjSpec.

    Args:
        file: MJCF of the model.
        roots: folders that must contain the model and all files that it loads.
        installed: whether the model belongs to an installed package, whose size is trusted.
        compiled: whether to check by compiling that MuJoCo accepts the model.

    Raises:
        BadModel: if the model is refused, or MuJoCo cannot read it.
    """
    scan = _MjcfScan(file, [root.resolve() for root in roots])
    if not any(file.resolve().is_relative_to(root) for root in scan.roots):
        raise BadModel(f"{file}: lies outside of {scan.roots[0]}; move it inside")
    cost = scan.read(file)
    if not installed and cost > _MAX_COST:
        raise BadModel(
            f"{file}: the model is too large: its cost is {cost:,.0f}, at most {_MAX_COST:,} is allowed (one element"
            f" costs 1); the most expensive part is {scan.costliest}; make this part smaller"
        )
    if not installed and cost > SUBPROCESS_COST and (versions := tuple(scan.versions.items())) not in _compiled:
        _compile_in_subprocess(file)
        _compiled.add(versions)
    try:
        quiet_mujoco()
        spec = mujoco.MjSpec.from_file(str(file))
        if compiled or spec.compiler.settotalmass > 0:  # `write_masses` compiles it
            with warnings.catch_warnings():  # a deprecated attribute of the file
                warnings.simplefilter("ignore")
                spec.compile()
    except MUJOCO_ERRORS as error:
        if too_little := memory_error(error):
            raise too_little from None
        raise BadModel(f"{scan.file_of(str(error))}: {one_line(error)}") from None
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
    if task == "file":
        return package_roots(home.parent)
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
class _Text:
    """One MJCF file: its cost without other files, and how often each other file is copied into it."""

    cost: float = 0.0
    elements: float = 0.0
    """Number of elements after replication."""
    stored: float = 0.0
    """Sum of the `nuser_...` and `nkey` attributes of `size`: numbers that MuJoCo stores with elements of the model."""
    replicas: float = 0.0
    """Sum of the counts of the elements `replicate`."""
    free_sensors: int = 0
    """Sensors of no object, which MuJoCo doubles with every replica."""
    includes: list[tuple[float, Path]] = field(default_factory=list)
    """Number of copies, and file, of each include."""
    models: list[tuple[int, str, Path]] = field(default_factory=list)
    """Line and name of each model that elements `attach` may copy, and its file."""
    attached: dict[str, float] = field(default_factory=dict)
    """Name of a model -> how often it is attached."""


@dataclass(slots=True)
class _MjcfScan:
    """Parser that checks an MJCF (`main`) and all files that it includes or loads, which must lie in `roots`."""

    main: Path
    roots: list[Path]
    costliest: str = ""
    _max_cost: float = 0.0
    _texts: dict[Path, _Text] = field(default_factory=dict)
    _costs: dict[Path, float] = field(default_factory=dict)
    """Cost of each model for which it has been computed."""
    _asset_folders: set[str] = field(default_factory=lambda: {""})
    _strips_paths: bool = False
    """Whether MuJoCo may look for assets without their folders (`strippath`)."""
    _assets: list[tuple[Path, int, str, str]] = field(default_factory=list)
    """File, line, element and file name of each asset to load."""
    versions: dict[Path, tuple[int, int]] = field(default_factory=dict)
    """Modification time [ns] and size [bytes] of each file."""

    def read(self, file: Path) -> float:
        """Parse a model and the files that it refers to, and check the assets that it loads; return its cost.

        Raises:
            BadModel: if anything is refused.
        """
        self._read_text(file, 0)
        if len(self._assets) > _MAX_FILES:
            raise BadModel(f"{self.main}: loads more than {_MAX_FILES} files; use fewer meshes and textures")
        loaded = 0.0
        for source, line, element, name in self._assets:
            for found in self._allowed_files(source, line, element, name):
                loaded += self._asset_cost(found, source, line)
        return self._model_cost(file.resolve(), ()) + loaded

    def file_of(self, error: str) -> str:
        """Return the files, as text, that an error message of MuJoCo may be about: with the line and words it names.

        MuJoCo gives elements of included files the line 0.
        """
        place = re.search(r"line (?:number=)?(\d+)", error, re.IGNORECASE)
        number = int(place[1]) if place else 0
        words = [word for word in re.findall(r"'([^']+)'", error) if number == 0 or f"Element '{word}'" in error]
        files = [file for file in self._texts if number or file != self.main.resolve()]
        found = [str(file) for file in files if _has_words(file, number, words)]
        return " or ".join(found[:3]) or str(self.main)

    def _model_cost(self, file: Path, parents: tuple[Path, ...]) -> float:
        """Return the cost to compile a model and the models that it attaches. `parents` are the models that attach it.

        Raises:
            BadModel: if the model attaches itself, on which MuJoCo would crash.
        """
        if file in self._costs:
            return self._costs[file]
        parts = self._included(file, 1.0, ())
        models: dict[str, float] = {}
        for source, _, text in parts:
            for line, name, other in text.models:
                chain = (*parents, file, other)
                if other in chain[:-1]:
                    cycle = " -> ".join(each.name for each in chain[chain.index(other) :])
                    message = f"{source}:{line}: the model attaches itself: {cycle}"
                    raise BadModel(f"{message}; remove one of these attachments")
                models[name] = models.get(name, 0.0) + self._model_cost(other, (*parents, file))
        cost = sum(copies * text.cost for _, copies, text in parts) + sum(models.values())
        stored = sum(text.stored for _, _, text in parts)
        cost += stored * sum(copies * text.elements for _, copies, text in parts) / 1_000
        replicas = min(sum(text.replicas for _, _, text in parts), 50.0)
        sensors = sum(text.free_sensors for _, _, text in parts) * 2.0**replicas
        self._note_cost(sensors, f"sensors without an object in {file}, which every replica of `replicate` doubles")
        cost += sensors
        for _, copies, text in parts:
            for name, count in text.attached.items():
                attached = copies * count * models.get(name, max(models.values(), default=0.0))
                self._note_cost(attached, f"attach of model '{name}' in {file}")
                cost += attached
        self._costs[file] = min(cost, ENDLESS)
        return self._costs[file]

    def _included(self, file: Path, copies: float, parents: tuple[Path, ...]) -> list[tuple[Path, float, _Text]]:
        """Return (path, number of copies, content) of a file and of those that it includes; `parents` include it."""
        if file in parents:
            raise BadModel(f"{file}: the file includes itself; remove this include")
        text = self._texts[file]
        found = [(file, copies, text)]
        for count, other in text.includes:
            found += self._included(other, min(copies * count, ENDLESS), (*parents, file))
            if len(found) > _MAX_FILES:
                raise BadModel(f"{self.main}: includes more than {_MAX_FILES} files; use fewer")
        return found

    def _read_text(self, file: Path, level: int) -> None:
        """Parse a file and the files that it includes or attaches. `level`: how deep the file itself is included."""
        if file.suffix.lower() not in _TEXT:
            allowed = ", ".join(_TEXT)
            raise BadModel(f"{file}: not MJCF; give a text file ({allowed}): compiled models (.mjb) are not opened")
        if len(self._texts) >= _MAX_FILES:
            raise BadModel(f"{self.main}: includes more than {_MAX_FILES} files; use fewer files")
        if level > _MAX_LEVELS:
            raise BadModel(f"{file}: is included more than {_MAX_LEVELS} levels deep; use fewer levels")
        text = self._texts[file.resolve()] = _Text()
        try:
            data, status = read_plain(file, _MAX_TEXT), file.stat()
            self.versions[file.resolve()] = (status.st_mtime_ns, status.st_size)
        except OSError as error:
            raise BadModel(f"{file}: {error.strerror or error}") from None
        files: list[tuple[int, str, str, str, float]] = []
        copies: list[float] = [1.0]
        """How often each open element is replicated."""
        parser = expat.ParserCreate("utf-8")

        def start(name: str, attributes: dict[str, str]) -> None:
            line = parser.CurrentLineNumber
            if len(copies) > _MAX_DEPTH:
                raise BadModel(f"{file}:{line}: nested deeper than {_MAX_DEPTH} elements; use fewer levels")
            _check_numbers(file, line, name, attributes)
            if name == "plugin" and not (attributes.get("plugin") or attributes.get("instance")):
                raise BadModel(
                    f"{file}:{line}: the plugin has no name, on which MuJoCo may crash; give plugin= or instance="
                )
            count = max(1.0, number_of(attributes.get("count"))) if name == "replicate" else 1.0
            cost = min(copies[-1] * count * element_cost(name, attributes), ENDLESS)
            self._note_cost(cost, f"{name} at {file}:{line}")
            text.cost += cost
            text.elements += copies[-1]
            if name == "size":
                text.stored += sum(
                    number_of(attributes.get(key)) for key in attributes if key.startswith(("nuser_", "nkey"))
                )
            if name == "attach":
                model = attributes.get("model", "")
                text.attached[model] = text.attached.get(model, 0.0) + copies[-1]
            copies.append(min(copies[-1] * count, ENDLESS))
            text.replicas += count if name == "replicate" else 0.0
            text.free_sensors += name in _FREE_SENSORS and "objname" not in attributes
            self._strips_paths |= attributes.get("strippath", "false") != "false"
            for key in ("meshdir", "texturedir", "assetdir"):
                if key in attributes:
                    self._asset_folders.add(attributes[key].replace("\\", "/"))
            for key, value in attributes.items():
                if not key.startswith("file") or not value:
                    continue
                value = value.replace("\\", "/")  # as MuJoCo does on every system
                if value.lower().endswith((".mjb", ".mjz", ".zip")):
                    raise BadModel(f"{file}:{line}: {name}: '{value}' is a compiled model; give its MJCF text")
                if name in ("include", "model") or "xml" in attributes.get("content_type", ""):
                    files.append((line, name, value, attributes.get("name", ""), copies[-1]))
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
        for line, element, value, name, count in files:
            for found in self._allowed_files(file, line, element, value):
                if element == "include":
                    text.includes.append((count, found))
                else:
                    text.models.append((line, name, found))
                if found not in self._texts:
                    self._read_text(found, level + 1)

    def _note_cost(self, cost: float, source: str) -> None:
        if cost > self._max_cost:
            self._max_cost, self.costliest = cost, source

    def _allowed_files(self, file: Path, line: int, element: str, name: str) -> Iterator[Path]:
        """Yield the existing files that MuJoCo may open for the file name in an element of an MJCF."""
        if "\0" in name or "://" in name:
            raise BadModel(f"{file}:{line}: {element}: '{name}' is not a file name; correct it")
        seen: set[Path] = set()
        # MuJoCo looks in the folder of the main file and of the including one, with and without an asset folder
        folders = [base / inner for base in (self.main.parent, file.parent) for inner in self._asset_folders]
        names = [name, name.rpartition("/")[2]] if self._strips_paths else [name]
        for folder, part in itertools.product(folders, names):
            try:
                path = (folder / part).resolve()
                inside = any(path.is_relative_to(root) for root in self.roots)
                if path in seen or (inside and not path.exists()):
                    continue
                if not inside and (Path(part).is_absolute() or path.exists()):
                    where = " and ".join(str(root) for root in dict.fromkeys(self.roots))
                    raise BadModel(f"{file}:{line}: {element}: '{name}' lies outside of {where}; move it inside")
            except (OSError, RuntimeError) as error:
                raise BadModel(f"{file}:{line}: {element}: '{name}': {error}") from None
            if inside:
                seen.add(path)
                yield path

    def _asset_cost(self, path: Path, file: Path, line: int) -> float:
        if not path.is_file():
            raise BadModel(f"{file}:{line}: '{path}' is not a regular file; name a mesh or image file")
        size = (status := path.stat()).st_size
        self.versions[path] = (status.st_mtime_ns, size)
        if size > _MAX_ASSET:
            raise BadModel(f"{file}:{line}: '{path}' is too large; allowed are {_MAX_ASSET:,} bytes")
        cost = size / 20_000
        with path.open("rb") as opened:
            head = opened.read(24)
        if head[:8] == b"\x89PNG\r\n\x1a\n":  # a small file may decompress to a huge image: width x height
            cost = max(cost, int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big") / 10_000)
        self._note_cost(cost, f"'{path}'")
        return cost


def _has_words(file: Path, number: int, words: Sequence[str]) -> bool:
    """Return whether line `number` of a file (0: the whole file) has these words."""
    text = read_plain(file, _MAX_TEXT).decode("utf-8", "replace")
    lines = text.splitlines()
    part = text if number == 0 else lines[number - 1] if number <= len(lines) else ""
    return bool(part) and all(word in part for word in words)


def _check_numbers(file: Path, line: int, name: str, attributes: dict[str, str]) -> None:
    """Check the attributes of an element: no size too large, all numbers finite; only a range may be infinite."""
    for key, value in attributes.items():
        limit = _MAX_MEMORY if key == "memory" else 1_000_000
        if name == "size" and number_of(value) > limit:
            raise BadModel(f'{file}:{line}: size {key}="{value[:40]}" is too large; at most {limit:,} is allowed')
        if key in _NAMES or key.startswith("file") or name in ("text", "config") or not _NOT_FINITE.search(value):
            continue
        for word in value.split():
            number = mjcf_number(word)
            if (math.isnan(number) and _NOT_FINITE.match(word)) or (math.isinf(number) and "range" not in key):
                raise BadModel(f'{file}:{line}: {name} {key}="{shorten(value, 40)}" is not finite; give a number')


def _check_options(spec: mujoco.MjSpec, file: Path) -> None:
    """Check that a model has no options that MuJoCo accepts but with which no simulation works."""
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
        # the subprocess limits its CPU time itself; on a busy machine it takes longer
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=6 * TIME_S)
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
except Exception as error:
    print(str(error) or type(error).__name__)
    sys.exit(1)
"""
