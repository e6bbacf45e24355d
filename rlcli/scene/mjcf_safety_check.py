"""Check an untrusted MJCF before MuJoCo opens the file.

The XML is parsed, the files that the model loads are checked, and the cost of compiling the model is estimated.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.parsers import expat

from rlcli.machine.plain_files import read_plain
from rlcli.safe_text import shorten
from rlcli.scene.mjcf_cost import (
    ENDLESS,
    REFERENCES,
    ModelCost,
    References,
    element_cost,
    mjcf_number,
    number_of,
    stored_arrays,
)

MAX_COST = 1_000_000
"""Cost above which a model or a scene is refused; unit: one element."""
MAX_MEMORY = 2 * 1024**3
"""Limit of the memory that a model may ask for, and of the compiling subprocess [bytes]."""
_MAX_TEXT = 16 * 1024 * 1024
"""Largest MJCF file [bytes]."""
_MAX_ASSET = 256 * 1024 * 1024
"""Largest mesh or image file [bytes]."""
_MAX_FILES = 1000
_MAX_DEPTH = 200
"""Largest depth of nested elements."""
_MAX_LEVELS = 50
"""Largest depth of nested includes."""
_MAX_ATTRIBUTES = 200
"""Largest number of attributes of an element: MuJoCo compares each attribute with all others. MJCF has up to 60."""
_MAX_LOOKUPS = 50_000
"""Largest product of the number of assets and the number of folders in which MuJoCo may look for them."""
_LOOKUP_COST = 0.2
"""Cost of an element that refers to others, for each replica in the model: MuJoCo resolves the references again."""
_TEXT = (".xml", ".mjcf", ".urdf")
_LARGEST_NUMBER = 1e30
"""Largest absolute value of a number in MJCF, except in ranges: products of a few larger numbers are infinite."""
_NOT_NEGATIVE = ("armature", "frictionloss")
"""Attributes of joints and tendons whose negative values are refused here; MuJoCo accepts them."""
_PERHAPS_WRONG = re.compile(r"[-+]?(nan|inf)|[eE]\+?\d{2}|\d{30}", re.IGNORECASE)
"""Pattern of text that may be a number too large or not finite: nan, inf, an exponent of two digits, thirty digits."""
_NAMES = REFERENCES | {
    *("name", "class", "childclass", "prefix", "model", "frame", "target", "instance", "plugin", "key", "material"),
    *("mesh", "hfield", "texture", "camera", "flex", "node"),
}
"""Attributes that contain names, which may look like numbers, as `inf` does."""
_FREE_SENSORS = ("clock", "e_potential", "e_kinetic", "user", "plugin")
"""Tags of sensors that need not refer to an element of the model."""


class BadModel(ValueError):
    """Error for a model that is refused; the message has the file and the reason."""


@dataclass(slots=True)
class _Text:
    """Content of one MJCF file: its cost without included and attached files, and the list of these files."""

    cost: float = 0.0
    elements: float = 0.0
    """Number of elements after replication."""
    assets: float = 0.0
    """Cost of the meshes and images that the file loads."""
    stored: dict[str, float] = field(default_factory=dict)
    """Name -> largest size of the arrays that MuJoCo stores with every element of the model, see `ModelCost.stored`."""
    keys: float = 0.0
    """Number of keyframes, which store numbers of every joint."""
    replicas: float = 0.0
    """Sum of the attribute `count` of all elements `replicate`."""
    free_sensors: int = 0
    """Number of sensors without an object, which MuJoCo doubles with every replica."""
    references: References = field(default_factory=References)
    """References between elements by name."""
    includes: list[tuple[float, Path]] = field(default_factory=list)
    """(number of copies, file) of each `include`."""
    models: list[tuple[int, str, Path]] = field(default_factory=list)
    """(line, name, file) of each `model` in the assets, which an element `attach` may copy."""
    attached: dict[str, float] = field(default_factory=dict)
    """Name of a model -> how often it is attached."""


@dataclass(slots=True)
class MjcfScan:
    """Check of an MJCF, and of all files that it includes or loads."""

    main: Path
    """The MJCF."""
    roots: list[Path]
    """Folders in which all files must lie."""
    limited: bool = True
    """Whether a model that costs more than `MAX_COST` is refused."""
    costliest: str = ""
    """The most expensive part of the model, as text for the message."""
    versions: dict[Path, tuple[int, int]] = field(default_factory=dict)
    """Modification time [ns] and size [bytes] of each file."""
    _max_cost: float = 0.0
    _read_cost: float = 0.0
    """Cost of the elements that have been parsed, before they are copied."""
    _texts: dict[Path, _Text] = field(default_factory=dict)
    _costs: dict[Path, ModelCost] = field(default_factory=dict)
    """Cost of each model for which it has been computed."""
    _asset_folders: set[str] = field(default_factory=lambda: {""})
    _strips_paths: bool = False
    """Whether MuJoCo may look for assets without their folders (`strippath`)."""
    _assets: list[tuple[Path, int, str, str, float]] = field(default_factory=list)
    """File, line, element, file name and number of copies of each asset to load."""

    def read(self) -> ModelCost:
        """Parse the model and the files that it refers to, and check the assets that it loads; return its cost.

        Raises:
            BadModel: if the model or one of its files is refused.
        """
        self._read_text(self.main, 0)
        if len(self._assets) > _MAX_FILES:
            raise BadModel(f"{self.main}: loads more than {_MAX_FILES} files; use fewer meshes and textures")
        if len(self._assets) * len(self._asset_folders) > _MAX_LOOKUPS:
            raise BadModel(f"{self.main}: names {len(self._asset_folders)} folders of assets; use fewer folders")
        for source, line, element, name, copies in self._assets:
            for found in self._allowed_files(source, line, element, name):
                loaded = min(copies * self._asset_cost(found, source, line), ENDLESS)
                self._note_cost(loaded, f"'{found}'")
                self._texts[source.resolve()].assets += loaded
        cost = self._model_cost(self.main.resolve(), ())
        self.require_cost(cost.total)
        return cost

    def require_cost(self, cost: float) -> None:
        """Check a cost of this model.

        Raises:
            BadModel: if the cost is too high.
        """
        if self.limited and cost > MAX_COST:
            raise BadModel(
                f"{self.main}: the model is too large: its cost is {cost:,.0f}; at most {MAX_COST:,} is allowed (one"
                f" element costs 1); the most expensive part is {self.costliest}; make this part smaller"
            )

    def file_of(self, error: str) -> str:
        """Return, as text, the names of the files that may contain the mistake that MuJoCo's message `error` describes.

        These files have the quoted words of the message in the line that the message names. For elements of included
        files MuJoCo names line 0; then the whole files are searched.
        """
        place = re.search(r"line (?:number=)?(\d+)", error, re.IGNORECASE)
        number = int(place[1]) if place else 0
        words = [word for word in re.findall(r"'([^']+)'", error) if number == 0 or f"Element '{word}'" in error]
        files = [file for file in self._texts if number or file != self.main.resolve()]
        found = [str(file) for file in files if _has_words(file, number, words)]
        return " or ".join(found[:3]) or str(self.main)

    def _model_cost(self, file: Path, parents: tuple[Path, ...]) -> ModelCost:
        """Return the cost to compile a model together with the models that it attaches.

        `parents` are the models that attach this model, directly or indirectly.

        Raises:
            BadModel: if the model attaches itself, on which MuJoCo would crash.
        """
        if file in self._costs:
            return self._costs[file]
        parts = self._included(file, 1.0, ())
        models: dict[str, ModelCost] = {}
        for source, _, text in parts:
            for line, name, other in text.models:
                chain = (*parents, file, other)
                if other in chain[:-1]:
                    cycle = " -> ".join(each.name for each in chain[chain.index(other) :])
                    message = f"{source}:{line}: the model attaches itself: {cycle}"
                    raise BadModel(f"{message}; remove one of these attachments")
                models[name] = models.get(name, ModelCost()).beside(self._model_cost(other, (*parents, file)))
        replicas = sum(text.replicas for _, _, text in parts)
        sensors = sum(text.free_sensors for _, _, text in parts) * 2.0 ** min(replicas, 50.0)
        self._note_cost(sensors, f"sensors without an object in {file}, which every replica of `replicate` doubles")
        references = References()
        for _, copies, text in parts:
            references.extend(text.references, copies)
        cost = ModelCost(size=sensors, referring=references.count())
        any_model = ModelCost()
        for model in models.values():
            cost = cost.loading(model)
            any_model = any_model.beside(model)
        for _, copies, text in parts:
            own = ModelCost(text.cost, 0.0, text.elements, 0.0, text.stored, text.keys, text.assets)
            cost = cost.beside(own.times(copies))
            for name, count in text.attached.items():
                attached = models.get(name, any_model).times(copies * count, with_loads=False)
                self._note_cost(attached.size + attached.assets, f"attach of model '{name}' in {file}")
                cost = cost.beside(attached)
        lookups = min(replicas * cost.referring * _LOOKUP_COST, ENDLESS)
        self._note_cost(lookups, f"{cost.referring:,.0f} sensors, actuators and the like in {file}, with `replicate`")
        cost = replace(cost, loads=min(cost.loads + lookups, ENDLESS))
        self._costs[file] = cost
        return cost

    def _included(self, file: Path, copies: float, parents: tuple[Path, ...]) -> list[tuple[Path, float, _Text]]:
        """Return (path, number of copies, content) of a file and of the files that it includes.

        `parents` are the files that include this file, directly or indirectly.
        """
        if file in parents:
            raise BadModel(f"{file}: the file includes itself; remove this include")
        text = self._texts[file]
        found = [(file, copies, text)]
        for count, other in text.includes:
            found += self._included(other, min(copies * count, ENDLESS), (*parents, file))
            if len(found) > _MAX_FILES:
                raise BadModel(f"{self.main}: includes more than {_MAX_FILES} files; use fewer files")
        return found

    def _read_text(self, file: Path, level: int) -> None:
        """Parse a file and the files that it includes or attaches; `level` is the depth of includes of the file."""
        if file.suffix.lower() not in _TEXT:
            allowed = ", ".join(_TEXT)
            raise BadModel(f"{file}: not MJCF; give a text file ({allowed}): compiled models (.mjb) are not opened")
        if len(self._texts) >= _MAX_FILES:
            raise BadModel(f"{self.main}: includes more than {_MAX_FILES} files; use fewer files")
        if level > _MAX_LEVELS:
            raise BadModel(f"{file}: is included through more than {_MAX_LEVELS} files; use fewer levels of includes")
        text = self._texts[file.resolve()] = _Text()
        try:
            data, status = read_plain(file, _MAX_TEXT), file.stat()
            self.versions[file.resolve()] = (status.st_mtime_ns, status.st_size)
        except OSError as error:
            raise BadModel(f"{file}: {error.strerror or error}") from None
        text.cost = len(data) / 1_000
        self._add_read_cost(text.cost)
        files: list[tuple[int, str, str, str, float]] = []
        copies: list[float] = [1.0]
        """How often each open element is replicated."""
        names: list[str] = [""]
        """Name of each open element, or of the element around it."""
        parser = expat.ParserCreate("utf-8")

        def start(name: str, attributes: dict[str, str]) -> None:
            line = parser.CurrentLineNumber
            if len(copies) > _MAX_DEPTH:
                raise BadModel(f"{file}:{line}: elements are nested deeper than {_MAX_DEPTH} levels; use fewer levels")
            if len(attributes) > _MAX_ATTRIBUTES:
                raise BadModel(
                    f"{file}:{line}: the element has more than {_MAX_ATTRIBUTES} attributes; remove some attributes"
                )
            _check_numbers(file, line, name, attributes)
            if name == "plugin" and not (attributes.get("plugin") or attributes.get("instance")):
                raise BadModel(
                    f"{file}:{line}: the plugin has no name, on which MuJoCo may crash; give plugin= or instance="
                )
            count = 1.0
            if name == "replicate":
                count = max(1.0, number_of(attributes.get("count")))
                if number_of(attributes.get("count", "0")) < 0:
                    raise BadModel(f"{file}:{line}: replicate count is below 0; give a whole number from 0")
            once = element_cost(name, attributes)
            cost = min(copies[-1] * count * once, ENDLESS)
            self._note_cost(cost, f"{name} at {file}:{line}")
            self._add_read_cost(once)
            text.cost += cost
            text.elements += copies[-1]
            text.keys += name == "key"
            for array, number in stored_arrays(name, attributes):
                text.stored[array] = max(text.stored.get(array, 0.0), number)
            if name == "attach":
                model = attributes.get("model", "")
                text.attached[model] = text.attached.get(model, 0.0) + copies[-1]
            names.append(attributes.get("name") or names[-1])
            text.references.add(names[-1], attributes, copies[-1])
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
                value = value.replace("\\", "/")  # MuJoCo accepts both separators
                if value.lower().endswith((".mjb", ".mjz", ".zip")):
                    raise BadModel(f"{file}:{line}: {name}: '{value}' is a compiled model; give its MJCF text")
                if name in ("include", "model") or "xml" in attributes.get("content_type", ""):
                    files.append((line, name, value, attributes.get("name", ""), copies[-1]))
                elif key != "filename" or name in ("mesh", "texture"):
                    self._assets.append((file, line, name, value, copies[-1]))
                if len(files) > _MAX_FILES:
                    raise BadModel(f"{self.main}: includes more than {_MAX_FILES} files; use fewer files")

        def refuse(*_: Any) -> None:
            raise BadModel(f"{file}:{parser.CurrentLineNumber}: a DOCTYPE is not allowed; remove the DOCTYPE")

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda name: (copies.pop(), names.pop())
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

    def _add_read_cost(self, cost: float) -> None:
        """Add the cost of a part that is parsed; stop as soon as the parts are too expensive."""
        self._read_cost += cost
        if self._read_cost > MAX_COST:
            self.require_cost(self._read_cost)

    def _note_cost(self, cost: float, source: str) -> None:
        if cost > self._max_cost:
            self._max_cost, self.costliest = cost, source

    def _allowed_files(self, file: Path, line: int, element: str, name: str) -> Iterator[Path]:
        """Yield the existing files that MuJoCo may open for the file name in an element of an MJCF."""
        if "\0" in name or "://" in name:
            raise BadModel(f"{file}:{line}: {element}: '{name}' is not a file name; write the path of a file")
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
                    message = f"{file}:{line}: {element}: '{name}' lies outside of {where}"
                    raise BadModel(f"{message}; move the file into this folder")
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
            raise BadModel(f"{file}:{line}: '{path}' is too large; at most {_MAX_ASSET:,} bytes are allowed")
        cost = size / 20_000
        with path.open("rb") as opened:
            head = opened.read(24)
        if head[:8] == b"\x89PNG\r\n\x1a\n":  # a small file may decompress to a huge image: width x height
            cost = max(cost, int.from_bytes(head[16:20], "big") * int.from_bytes(head[20:24], "big") / 10_000)
        return cost


def _has_words(file: Path, number: int, words: Sequence[str]) -> bool:
    """Return whether line `number` of a file (0: the whole file) has all words."""
    text = read_plain(file, _MAX_TEXT).decode("utf-8", "replace")
    lines = text.splitlines()
    part = text if number == 0 else lines[number - 1] if number <= len(lines) else ""
    return bool(part) and all(word in part for word in words)


def _check_numbers(file: Path, line: int, name: str, attributes: dict[str, str]) -> None:
    """Check that no number in the attributes of an element is too large or, except in a range, infinite."""
    for key, value in attributes.items():
        limit = MAX_MEMORY if key == "memory" else 1_000_000
        if name == "size" and number_of(value) > limit:
            raise BadModel(f'{file}:{line}: size {key}="{value[:40]}" is too large; at most {limit:,} is allowed')
        found = f'{file}:{line}: {name} {key}="{shorten(value, 40)}"'
        dissipates = key in _NOT_NEGATIVE or (key == "damping" and name in ("joint", "tendon", "spatial", "fixed"))
        if dissipates and any(mjcf_number(word) < 0 for word in value.split()):
            raise BadModel(f"{found} is negative; give a number of at least 0")
        if key in _NAMES or key.startswith("file") or name in ("text", "config") or not _PERHAPS_WRONG.search(value):
            continue
        for word in value.split():
            number = mjcf_number(word)
            if (math.isnan(number) and _PERHAPS_WRONG.match(word)) or (math.isinf(number) and "range" not in key):
                raise BadModel(f"{found} is not finite; give a finite number")
            if abs(number) > _LARGEST_NUMBER and "range" not in key:
                raise BadModel(f"{found} is too large; at most {_LARGEST_NUMBER:g} is allowed")
