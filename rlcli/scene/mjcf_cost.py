"""Estimate the cost (time and memory) of compiling an untrusted MJCF; an ordinary element costs 1.

`mjcf_safety_check` adds up the costs, and refuses a model that is too expensive.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

ENDLESS = 1e18
"""Value to which costs and numbers of copies are limited, so that a product of a few of them does not overflow."""

REFERENCES = {
    *(
        "actuator",
        "tendon",
        "tendon1",
        "tendon2",
        "objname",
        "refname",
        "body",
        "body1",
        "body2",
        "subtree1",
        "subtree2",
    ),
    *("joint", "joint1", "joint2", "jointinparent", "geom", "geom1", "geom2", "site", "site1", "site2", "sidesite"),
    *("cranksite", "slidersite", "refsite"),
}
"""Attributes whose value is the name of another element: of sensors, actuators, tendons, constraints, tuples, skins."""
_CHAIN = 4
"""Length of the longest chain of references that is followed: tuple -> sensor -> actuator -> tendon."""

_GROWING = ("size", "elements", "referring", "keys", "assets")
"""Parts of a model's cost that are proportional to its number of copies."""


@dataclass(frozen=True, slots=True)
class ModelCost:
    """Cost of a model, in ordinary elements; 0 by default."""

    size: float = 0.0
    """Cost of the model's elements, including the elements of attached models."""
    loads: float = 0.0
    """Cost of reading the models that are attached; their copies are counted in `size`."""
    elements: float = 0.0
    """Number of elements."""
    referring: float = 0.0
    """Number of elements such as sensors and actuators, which refer to others."""
    stored: dict[str, float] = field(default_factory=dict)
    """Name of an array, such as `nuser_geom` -> number of user values that MuJoCo stores with each element (geom)."""
    keys: float = 0.0
    """Number of keyframes."""
    assets: float = 0.0
    """Cost of the files of meshes and images, which MuJoCo loads when it compiles the model."""

    @property
    def total(self) -> float:
        """Estimate of the work to load and compile the model, in ordinary elements, for the limits."""
        per_element = sum(self.stored.values()) + self.keys
        return min(self.size + self.assets + self.loads + self.elements * per_element / 1_000, ENDLESS)

    def beside(self, other: ModelCost) -> ModelCost:
        """Return the cost of a model that has the elements of this model and of `other`."""
        names = self.stored.keys() | other.stored.keys()
        stored = {name: max(self.stored.get(name, 0.0), other.stored.get(name, 0.0)) for name in names}
        summed = ("loads", *_GROWING)
        sums = {name: min(getattr(self, name) + getattr(other, name), ENDLESS) for name in summed}
        return ModelCost(stored=stored, **sums)

    def loading(self, other: ModelCost) -> ModelCost:
        """Return the cost of this model with the cost of reading the model `other`, which it attaches."""
        return replace(self, loads=min(self.loads + other.size + other.loads, ENDLESS))

    def times(self, copies: float, *, with_loads: bool = True) -> ModelCost:
        """Return the cost of several copies of the model.

        Args:
            copies: number of copies.
            with_loads: whether the result has `loads`, which does not grow with the number of copies; False if the
                caller has counted `loads` already.
        """
        scaled = {name: min(getattr(self, name) * copies, ENDLESS) for name in _GROWING}
        return replace(self, loads=self.loads if with_loads else 0.0, **scaled)


@dataclass(slots=True)
class References:
    """References by name between the elements of a model: sensors, actuators and tendons refer to other elements.

    MuJoCo copies an element with each replica of an element that it refers to.
    """

    _copies: dict[str, float] = field(default_factory=dict)
    """Name of an element -> its number of replicas."""
    _used: list[tuple[str, tuple[str, ...]]] = field(default_factory=list)
    """(name of a referring element, or of the tendon, tuple or skin around it; names of the elements referred to)."""

    def add(self, owner: str, attributes: dict[str, str], copies: float) -> None:
        """Add an element.

        Args:
            owner: name of the element, or, if the element has no name, of the element around it, such as a tendon.
            attributes: attributes of the element.
            copies: how often `replicate` copies it.
        """
        if name := attributes.get("name"):
            self._copies[name] = max(self._copies.get(name, 1.0), copies)
        used = tuple(word for key in REFERENCES & attributes.keys() for word in attributes[key].split())
        if used:
            self._used.append((owner, used))

    def extend(self, other: References, copies: float) -> None:
        """Add the elements of an included file, which is copied `copies` times."""
        for name, count in other._copies.items():
            self._copies[name] = max(self._copies.get(name, 1.0), min(count * copies, ENDLESS))
        self._used += other._used

    def count(self) -> float:
        """Return the number of referring elements after all elements are replicated."""
        copies = dict(self._copies)
        total = 0.0
        for _ in range(_CHAIN):
            total = 0.0
            for name, used in self._used:
                count = max(copies.get(word, 1.0) for word in used)
                copies[name] = max(copies.get(name, 1.0), count)
                total += count
        return min(total, ENDLESS)


def stored_arrays(name: str, attributes: dict[str, str]) -> Iterator[tuple[str, float]]:
    """Yield (name, size) of the arrays of user data that MuJoCo enlarges for many elements because of this element.

    `name` is the tag of the element. For the names of arrays see `ModelCost.stored`.
    """
    if name == "size":
        for key in attributes:
            if key.startswith(("nuser_", "nkey")):
                yield key, number_of(attributes[key])
    elif "user" in attributes:  # MuJoCo then stores this number of values with every element of the same kind
        yield name, float(len(attributes["user"].split()))


def element_cost(name: str, attributes: dict[str, str]) -> float:
    """Return the cost of an MJCF element: how many ordinary elements take as much time and memory to compile.

    `name` is the tag of the element, such as `mesh`.
    """

    def numbers(key: str) -> list[float]:
        return [max(1.0, number_of(word)) for word in attributes.get(key, "").split()]

    def product(*keys: str) -> float:
        return math.prod(number for key in keys for number in numbers(key))

    if name == "flexcomp":
        return 1.0 + 10.0 * product("count", "cellcount")
    if name == "hfield":
        return 1.0 + product("nrow", "ncol") / 1_000
    if name == "texture":
        width = number_of(attributes.get("width"))
        return 1.0 + width * max(width, number_of(attributes.get("height"))) / 10_000
    if name == "mesh":  # a built-in shape; the first number of some is the resolution in both directions
        params = numbers("params")
        return 1.0 + math.prod(params) * max(params, default=1.0) / 10 + len(attributes.get("vertex", "")) / 10_000
    if name == "size":
        return 1.0 + sum(number_of(attributes.get(key)) for key in attributes if key != "memory") / 100
    if name == "lengthrange":  # the compiler simulates this number of steps for every muscle
        total, timestep = attributes.get("inttotal", "10"), attributes.get("timestep", "0.01")
        return 1.0 + number_of(total) / max(number_of(timestep), 1e-9) / 10
    if name == "config" and attributes.get("key") in ("size", "nchannel"):  # of the plugin touch_grid
        return 1.0 + math.prod(max(1.0, number_of(word)) for word in attributes.get("value", "").split()) / 10
    stored = product("num", "dim", "nsample", "actdim", "resolution", *(["size"] if name == "numeric" else []))
    return 1.0 + stored / 100 + sum(len(value) for value in attributes.values()) / 10_000


def mjcf_number(text: str) -> float:
    """Return the number in an attribute of an MJCF; NaN for text that is not a number."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def number_of(text: str | None) -> float:
    """Return the number in an attribute, which may end in K, M, G, T, P or E (`10M`); 0 for any other text.

    MuJoCo refuses such text later.
    """
    text = (text or "").strip()
    factor = {"k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40, "p": 2**50, "e": 2**60}.get(text[-1:].lower(), 1)
    value = mjcf_number(text[:-1] if factor != 1 else text)
    return 0.0 if math.isnan(value) else min(value * factor, ENDLESS)
