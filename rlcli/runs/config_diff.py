"""Compare two configurations, and assign each difference a category: physics, MDP, agent or cosmetic.

`rlcli diff` prints the differences.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rlcli.config.layers import leaves
from rlcli.config.messages import dotted
from rlcli.config.strict_yaml import Path
from rlcli.runs.run import Run

if TYPE_CHECKING:
    from rlcli.config.load import Resolved

CATEGORIES = ("physics", "MDP", "agent", "cosmetic")
"""Categories of keys. physics: the simulation between two actions. MDP: observations, rewards, random numbers, and the
ends of episodes. agent: the policy and its training. cosmetic: rendering, names, threads and files kept on disk; no
result depends on them."""

_PHYSICS = frozenset(("sim", "scene"))
_AGENT = frozenset(("agent", "seed"))
_COSMETIC = frozenset(("summary", "viewer"))
_COSMETIC_KEYS = frozenset(
    [
        ("sim", "engine_threads"),
        ("scene", "workers"),
        ("sim", "render_interval"),
        ("scene", "env_spacing"),
        ("agents", "default"),
        *(("agent", name) for name in ("autopsy", "save_interval", "keep_last", "keep_every")),
    ]
)
_NOT_PHYSICS = frozenset(("init", "soft_joint_pos_limit_factor"))
"""Keys of an entity that do not change the physics: they set the start of episodes, or a limit that only terms read."""
_EMPTY: tuple[Any, ...] = (None, {})
"""Values that count as equal to a missing key."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference between two runs or configurations, which are called left and right."""

    where: str
    """The key, file, metric or tensor that differs."""
    left: Any
    """Value of the left side; None: the left side has no value."""
    right: Any
    """Value of the right side; None: the right side has no value."""
    left_from: str | None = None
    """Place where the left value was written, such as `config.yaml:12:3`; None: not known."""
    right_from: str | None = None
    """Place where the right value was written; None: not known."""
    category: str | None = None
    """One of `CATEGORIES` for a difference of configurations; None for other differences."""


@dataclass(frozen=True, slots=True)
class Section:
    """Result of the comparison of one part of two runs, such as their configurations."""

    name: str
    """Name of the part, such as `configuration`."""
    compared: str
    """What was compared, as text for the table, such as `120 keys`."""
    differences: list[Difference] = field(default_factory=list)


Values = dict[Path, tuple[Any, str | None]]
"""Path of a key -> its value, and the place where the value was written, such as `config.yaml:12:3`."""


def run_values(run: Run) -> Values:
    """Return every key of the configuration with which a run was trained, and the seed, with their values and places.

    Raises:
        CheckpointError: if the run's configuration cannot be read.
    """
    document = run.read_config()
    given = run.record.get("given", {})

    def written_at(path: Path) -> str:
        line, column = document.marks.get(path, (0, 0))
        return str(given.get(dotted(path)) or f"{run.config.name}:{line}:{column}")

    found: Values = {("seed",): (run.record["seed"], "run.json")}
    for path, value in leaves(document.data):
        found[_override_path(path, document.data)] = value, written_at(path)
    return found


def task_values(resolved: Resolved) -> Values:
    """Return every key of a task's configuration, with its value and place; a task has no seed."""
    from rlcli.config.dump import origins, to_data

    data, places = to_data(resolved), origins(resolved)
    return {_override_path(path, data): (value, places.get(dotted(path))) for path, value in leaves(data)}


def compare_values(left: Values, right: Values) -> Section:
    """Return every key whose values differ between two configurations, in the order of `CATEGORIES`."""
    absent = (None, None)
    keys = list(dict.fromkeys([*left, *right]))
    pairs = {path: (left.get(path, absent), right.get(path, absent)) for path in keys}
    # if the policy observes images, colours and lights are a part of the task
    images = any(path[-1] == "kind" and "camera" in (one[0], other[0]) for path, (one, other) in pairs.items())
    found = []
    for path, ((value, place), (twin, there)) in pairs.items():
        if as_text(value) != as_text(twin) and not (value in _EMPTY and twin in _EMPTY):
            kind = category(path, observes_images=images)
            found.append(Difference(dotted(path), value, twin, place, there, kind))
    return Section("configuration", f"{len(keys)} keys", sorted(found, key=lambda d: CATEGORIES.index(str(d.category))))


def compare_files(left: Mapping[str, str], right: Mapping[str, str]) -> Section:
    """Return the files that differ between two tasks. `left` and `right` map the name of a file to its SHA-256.

    Differences of Python files have the category MDP, those of other files (such as robot models) physics.
    """
    keys = list(dict.fromkeys([*left, *right]))
    found = [
        Difference(name, left.get(name), right.get(name), category="MDP" if name.endswith(".py") else "physics")
        for name in keys
        if left.get(name) != right.get(name)
    ]
    return Section("files", f"{len(keys)} files", sorted(found, key=lambda d: CATEGORIES.index(str(d.category))))


def category(path: Path, *, observes_images: bool = False) -> str:
    """Return the category of a key of a configuration, one of `CATEGORIES`.

    Args:
        path: the path of the key; `agent` stands for the chosen agent.
        observes_images: whether the policy observes images; then colours and lights are not cosmetic.
    """
    if path[0] == "play" and len(path) > 1:
        return category(path[1:], observes_images=observes_images)
    if path[0] in _COSMETIC or path[:2] in _COSMETIC_KEYS:
        return "cosmetic"
    if path[:2] == ("scene", "lights") or (path[:2] == ("scene", "entities") and path[3:4] == ("color",)):
        return "MDP" if observes_images else "cosmetic"
    if path[0] in _AGENT or path[:2] == ("scene", "num_envs"):
        return "agent"  # num_envs changes the amount of training data, but not the episodes of one environment
    if path[:2] == ("scene", "sensors"):
        return "MDP"
    if path[:2] == ("scene", "entities") and (path[3:4] and path[3] in _NOT_PHYSICS):
        return "MDP"
    if path[:2] == ("scene", "entities") and path[3:4] == ("joints",) and path[-1] == "velocity_limit":
        return "MDP"  # only terms read this limit, the physics does not
    return "physics" if path[0] in _PHYSICS else "MDP"


def as_text(value: object) -> str:
    """Return a value as JSON text, for comparisons: 1 and 1.0 differ, NaN equals NaN."""
    return json.dumps(value, sort_keys=True, default=str)


def _override_path(path: Path, data: Mapping[str, Any]) -> Path:
    """Return the path of a key as an override writes it: `agents.NAME` of the chosen agent becomes `agent`."""
    agents = data.get("agents")
    if path[0] != "agents" or len(path) < 2 or not isinstance(agents, dict):
        return path
    return ("agent", *path[2:]) if path[1] == agents.get("default") else path
