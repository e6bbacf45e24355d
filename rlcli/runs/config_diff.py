"""Where two configurations differ, and what of: the physics, the decision process, the learner, or nothing computed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rlcli.config.layers import leaves
from rlcli.config.messages import dotted
from rlcli.runs.run import Run

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.config.strict_yaml import Path

CATEGORIES = ("physics", "MDP", "agent", "cosmetic")
"""What a key is of. physics: what one world does between two actions. MDP: what is observed, rewarded, drawn at
random, and when an episode ends. agent: who learns, and how. cosmetic: pictures, names, threads, what is kept on disk:
nothing that is computed depends on it."""

_PHYSICS = frozenset(("sim", "scene"))
_AGENT = frozenset(("agent", "seed"))
_COSMETIC = frozenset(("summary", "viewer"))
_COSMETIC_KEYS = frozenset(
    [
        ("sim", "engine_threads"),
        ("sim", "render_interval"),
        ("scene", "env_spacing"),
        ("agents", "default"),
        *(("agent", name) for name in ("autopsy", "save_interval", "keep_last", "keep_every")),
    ]
)
_NOT_PHYSICS = frozenset(("init", "soft_joint_pos_limit_factor"))
"""Of an entity: where episodes start, and what terms judge by."""
_NOTHING: tuple[Any, ...] = (None, {})
"""A key that is not there, one that is null, and one that holds none."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One place where two sides differ; None stands for what one of them does not have."""

    where: str
    left: Any
    right: Any
    left_from: str | None = None
    """Where the value was written."""
    right_from: str | None = None
    category: str | None = None
    """Of a configuration: one of `CATEGORIES`."""


@dataclass(frozen=True, slots=True)
class Section:
    """What comparing one part of two sides gave; `compared` says in words how much there was."""

    name: str
    compared: str
    differences: list[Difference] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Values:
    """A configuration as values by path, and where each was written."""

    values: Mapping[Path, tuple[Any, str | None]]

    @classmethod
    def of_run(cls, run: Run) -> Values:
        """What a run was trained with, the seed included.

        Raises:
            CheckpointError: if its file cannot be read.
        """
        document = run.read_config()
        given = run.record.get("given", {})

        def place(path: Path) -> str:
            line, column = document.marks.get(path, (0, 0))
            return str(given.get(dotted(path)) or f"{run.config.name}:{line}:{column}")

        found: dict[Path, tuple[Any, str | None]] = {("seed",): (run.record["seed"], "run.json")}
        return cls(found | {_chosen(path, document.data): (v, place(path)) for path, v in leaves(document.data)})

    @classmethod
    def of_task(cls, resolved: Resolved) -> Values:
        """A task with its chosen agent, all defaults filled in."""
        from rlcli.config.dump import origins, to_data

        data, places = to_data(resolved), origins(resolved)
        return cls({_chosen(path, data): (value, places.get(dotted(path))) for path, value in leaves(data)})

    def without_seed(self) -> Values:
        """The same, to be compared with what has none."""
        return Values({path: value for path, value in self.values.items() if path != ("seed",)})

    @property
    def observes_images(self) -> bool:
        """Whether images are observed: colours and lights are then a part of the task."""
        return any(path[-1] == "kind" and value == "camera" for path, (value, _) in self.values.items())


def compare_values(left: Values, right: Values) -> Section:
    """Every key in which two configurations differ, physics first."""
    one, other = left.values, right.values
    images = left.observes_images or right.observes_images
    absent = (None, None)
    keys = list(dict.fromkeys([*one, *other]))
    found = []
    for path in keys:
        (value, place), (twin, there) = one.get(path, absent), other.get(path, absent)
        if as_text(value) != as_text(twin) and not (value in _NOTHING and twin in _NOTHING):
            kind = category(path, observes_images=images)
            found.append(Difference(dotted(path), value, twin, place, there, kind))
    return Section("configuration", f"{len(keys)} keys", sorted(found, key=lambda d: CATEGORIES.index(str(d.category))))


def compare_files(left: Mapping[str, str], right: Mapping[str, str]) -> Section:
    """The models and the code of two tasks, each a file's name and its sha256."""
    keys = list(dict.fromkeys([*left, *right]))
    found = [
        Difference(name, left.get(name), right.get(name), category="MDP" if name.endswith(".py") else "physics")
        for name in keys
        if left.get(name) != right.get(name)
    ]
    return Section("files", f"{len(keys)} files", sorted(found, key=lambda d: CATEGORIES.index(str(d.category))))


def category(path: Path, *, observes_images: bool = False) -> str:
    """What a key of a configuration is of, one of `CATEGORIES`.

    Args:
        path: its path; `agent` stands for the chosen agent.
        observes_images: whether the policy gets images.
    """
    if path[0] == "play" and len(path) > 1:
        return category(path[1:], observes_images=observes_images)
    if path[0] in _COSMETIC or path[:2] in _COSMETIC_KEYS:
        return "cosmetic"
    if path[:2] == ("scene", "lights") or (path[:2] == ("scene", "entities") and path[3:4] == ("color",)):
        return "MDP" if observes_images else "cosmetic"
    if path[0] in _AGENT or path[:2] == ("scene", "num_envs"):
        return "agent"  # how many worlds there are changes what is learned from, not what happens in one
    if path[:2] == ("scene", "sensors"):
        return "MDP"
    if path[:2] == ("scene", "entities") and (path[3:4] and path[3] in _NOT_PHYSICS):
        return "MDP"
    if path[:2] == ("scene", "entities") and path[3:4] == ("joints",) and path[-1] == "velocity_limit":
        return "MDP"  # terms judge by it, the physics does not
    return "physics" if path[0] in _PHYSICS else "MDP"


def as_text(value: object) -> str:
    """One text a value: equal numbers of other types differ, NaN equals itself."""
    return json.dumps(value, sort_keys=True, default=str)


def _chosen(path: Path, data: Mapping[str, Any]) -> Path:
    """The path as an override has it: the settings of the chosen agent, whatever it is called."""
    agents = data.get("agents")
    if path[0] != "agents" or len(path) < 2 or not isinstance(agents, dict):
        return path
    return ("agent", *path[2:]) if path[1] == agents.get("default") else path
