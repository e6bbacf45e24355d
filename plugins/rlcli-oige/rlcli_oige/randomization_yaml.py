"""Reader of OmniIsaacGymEnvs' `domain_randomization:`: each of its entries becomes a `Randomization`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rlcli.config.strict_yaml import Path
from rlcli.errors import did_you_mean, listing
from rlcli.formats import Status

TRIGGERS = ("on_startup", "on_reset", "on_interval")
OPERATIONS = ("additive", "scaling", "direct")
DISTRIBUTIONS = {
    "uniform": "uniform",
    "gaussian": "gaussian",
    "normal": "gaussian",
    "loguniform": "loguniform",
    "log_uniform": "loguniform",
}
SCHEDULES = ("constant", "linear")
VIEWS = ("rigid_prim_views", "articulation_views")
_KEYS = (
    "operation", "distribution", "distribution_parameters", "frequency_interval", "num_buckets", "schedule",
    "schedule_steps",
)  # fmt: skip

_STATE: dict[str, tuple[Status, str]] = {
    "position": ("mapped", "the root's position [m]"),
    "orientation": ("mapped", "the root's orientation, as roll, pitch and yaw [rad]"),
    "linear_velocity": ("mapped", "the root's velocity [m/s]"),
    "angular_velocity": ("mapped", "the root's angular velocity [rad/s]"),
    "velocity": ("mapped", "the root's velocity, linear and angular"),
}
_MATERIAL: tuple[Status, str] = (
    "approximated",
    "sliding friction of the geoms; MuJoCo has one friction and no restitution",
)
_NO_SCALE: tuple[Status, str] = ("ignored", "all environments have the same geometry")
_NO_TENDON: tuple[Status, str] = ("ignored", "the MJCF sets the tendons")
ATTRIBUTES: Mapping[str, Mapping[str, tuple[Status, str]]] = {
    "articulation_views": {
        **_STATE,
        "stiffness": ("mapped", "gain of the joints' position drives"),
        "damping": ("mapped", "damping of the joints' position drives, or of joints without one"),
        "joint_friction": ("approximated", "dry friction of the joints [N m]: in MuJoCo independent of the load"),
        "joint_armatures": ("mapped", "armature [kg m^2]"),
        "max_efforts": ("mapped", "limits of set_joint_efforts [N m]"),
        "lower_dof_limits": ("mapped", "lower joint limits [rad]"),
        "upper_dof_limits": ("mapped", "upper joint limits [rad]"),
        "joint_positions": ("mapped", "joint positions [rad]"),
        "joint_velocities": ("mapped", "joint velocities [rad/s]"),
        "joint_efforts": ("mapped", "efforts on the joints [N m]"),
        "body_masses": ("mapped", "masses, inertias in proportion"),
        "body_inertias": ("mapped", "diagonals of the inertias"),
        "material_properties": _MATERIAL,
        "scale": _NO_SCALE,
        "joint_max_velocities": ("ignored", "MuJoCo has no joint velocity limits"),
        **{
            f"tendon_{key}": _NO_TENDON
            for key in (
                "stiffnesses", "dampings", "limit_stiffnesses", "lower_limits", "upper_limits", "rest_lengths",
                "offsets",
            )
        },
    },
    "rigid_prim_views": {
        **_STATE,
        "force": ("mapped", "a force at the centre of mass for one step [N]"),
        "mass": ("mapped", "mass, inertia in proportion"),
        "density": ("mapped", "mass and inertia in proportion"),
        "inertia": ("mapped", "diagonal of the inertia"),
        "material_properties": _MATERIAL,
        "scale": _NO_SCALE,
        "contact_offset": ("ignored", "the MJCF's margin sets where contacts begin"),
        "rest_offset": ("ignored", "the MJCF's margin sets where contacts begin"),
    },
}  # fmt: skip
"""Kind of view -> attribute that can be randomised -> status of its translation, and a note for the user."""


@dataclass(frozen=True, slots=True)
class Randomization:
    """One randomisation: its attribute, its key (`on_startup`, `on_reset` or `on_interval`) and its distribution."""

    path: tuple[str, ...]
    """(observations,), (actions,), (simulation, gravity) or (kind of view, view, attribute)"""
    trigger: str
    """`on_startup`, `on_reset` or `on_interval`."""
    operation: str
    distribution: str
    parameters: Any
    interval: int = 1
    """Environment steps between two samples of `on_interval`."""
    schedule: str | None = None
    schedule_steps: int = 0

    @property
    def name(self) -> str:
        """Name of the randomisation, unique in its task, such as `simulation.gravity.on_reset`."""
        return ".".join((*self.path, self.trigger))

    def strength(self, step: int) -> float:
        """Return the factor in [0, 1] that the schedule gives the randomisation at a training step."""
        if self.schedule is None or self.schedule_steps <= 0:
            return 1.0
        if self.schedule == "constant":
            return 1.0 if step >= self.schedule_steps else 0.0
        return min(1.0, step / self.schedule_steps)


def read_randomizations(block: Mapping[str, Any]) -> list[Randomization]:
    """Return the randomisations of a `domain_randomization:` mapping, without those that rlcli ignores.

    `check` must have accepted the mapping.
    """
    found = []
    for at, params in _entries(block):
        path = at[1:-1]
        if path[0] in VIEWS and ATTRIBUTES[path[0]][path[2]][0] == "ignored":
            continue
        found.append(
            Randomization(
                path,
                at[-1],
                params["operation"],
                DISTRIBUTIONS[params["distribution"]],
                params["distribution_parameters"],
                int(params.get("frequency_interval", 1)),
                params.get("schedule"),
                int(params.get("schedule_steps", 0)),
            )
        )
    return found


def check(
    block: Any, problem: Callable[[Path, str, str | None], None], note: Callable[[Path, Status, str], None]
) -> None:
    """Check a `domain_randomization:` mapping.

    Args:
        block: the mapping.
        problem: called with the path, the message and a hint (or None) for each mistake.
        note: called with the path, the status and a text for each translated key.
    """
    base: Path = ("domain_randomization",)
    if not isinstance(block, dict):
        problem(base, "expected a mapping", "write {randomize: true, randomization_params: {...}}")
        return
    for key in block:
        if key in ("randomize", "min_frequency"):
            note((*base, key), "mapped", "")
        elif key != "randomization_params":
            known = ("randomize", "min_frequency", "randomization_params")
            problem((*base, key), f"unknown key '{key}'", did_you_mean(key, known) or f"keys: {listing(known)}")
    params = block.get("randomization_params")
    for key, content in params.items() if isinstance(params, dict) else ():
        at = (*base, "randomization_params", key)
        if key in VIEWS:
            _check_views(key, content, at, problem)
        elif key == "simulation":
            for attribute in content if isinstance(content, dict) else ():
                if attribute != "gravity":
                    problem((*at, attribute), f"'{attribute}' cannot be randomised", "only gravity can")
        elif key not in ("observations", "actions"):
            groups = ("observations", "actions", "simulation", *VIEWS)
            problem(at, f"unknown key '{key}'", did_you_mean(key, groups) or f"keys: {listing(groups)}")
    for path, entry in _entries(block):
        _check_randomization((*base, *path), path, entry, problem, note)


def _check_views(kind: str, views: Any, at: Path, problem: Callable[[Path, str, str | None], None]) -> None:
    for view, attributes in views.items() if isinstance(views, dict) else ():
        for attribute in attributes if isinstance(attributes, dict) else ():
            if attribute not in ATTRIBUTES[kind]:
                known = ATTRIBUTES[kind]
                near = did_you_mean(attribute, known) or f"attributes: {listing(known, 40)}"
                problem((*at, view, attribute), f"'{attribute}' cannot be randomised", near)


def _check_randomization(
    at: Path,
    path: tuple[str, ...],
    entry: Any,
    problem: Callable[[Path, str, str | None], None],
    note: Callable[[Path, Status, str], None],
) -> None:
    trigger, target = path[-1], path[1:-1]
    if target and target[0] in VIEWS and (len(target) < 3 or target[2] not in ATTRIBUTES[target[0]]):
        return  # _check_views has reported it
    if trigger not in TRIGGERS:
        problem(at, f"unknown key '{trigger}'", did_you_mean(trigger, TRIGGERS) or f"keys: {listing(TRIGGERS)}")
        return
    if trigger == "on_startup" and target[0] not in VIEWS:
        problem(at, f"{target[0]} cannot be randomised on_startup", "use on_reset or on_interval")
    if not isinstance(entry, dict):
        problem(at, "expected a mapping", "write {operation: ..., distribution: ..., distribution_parameters: [...]}")
        return
    for key in entry:
        if key not in _KEYS:
            problem((*at, key), f"unknown key '{key}'", did_you_mean(key, _KEYS) or f"keys: {listing(_KEYS)}")
    needed = ("operation", "distribution", "distribution_parameters")
    missing = [
        key for key in (*needed, *(("frequency_interval",) if trigger == "on_interval" else ())) if key not in entry
    ]
    if missing:
        problem(at, f"missing keys: {listing(missing)}", "add each of these keys")
        return
    for key, known in (("operation", OPERATIONS), ("distribution", tuple(DISTRIBUTIONS)), ("schedule", SCHEDULES)):
        if key in entry and entry[key] not in known:
            near = did_you_mean(str(entry[key]), known) or f"known: {listing(known)}"
            problem((*at, key), f"unknown {key} '{entry[key]}'", near)
    for key, minimum in (("frequency_interval", 1), ("schedule_steps", 0)):
        count = entry.get(key, minimum)
        if isinstance(count, bool) or not isinstance(count, int | float) or count != int(count) or count < minimum:
            problem((*at, key), f"expected a whole number >= {minimum}, found {count!r}", None)
    if entry["operation"] == "direct" and target[0] in ("observations", "actions"):
        problem((*at, "operation"), f"expected additive or scaling for noise of {target[0]}, found direct", None)
    _check_numbers((*at, "distribution_parameters"), entry, problem)
    status: tuple[Status, str] = ("mapped", "")
    if target[0] in VIEWS:
        status = ATTRIBUTES[target[0]][target[2]]
    note(at, *status)


def _check_numbers(at: Path, entry: Mapping[str, Any], problem: Callable[[Path, str, str | None], None]) -> None:
    parameters = entry["distribution_parameters"]
    rows = parameters if isinstance(parameters, list) and len(parameters) == 2 else None
    if rows is not None and all(isinstance(row, int | float) for row in rows):
        pairs = [(rows[0], rows[1])]
    elif rows is not None and all(isinstance(row, list) for row in rows) and len(rows[0]) == len(rows[1]):
        pairs = list(zip(rows[0], rows[1], strict=True))
    else:
        problem(at, f"expected [a, b] or [[a, ...], [b, ...]], found {parameters!r}", None)
        return
    if not all(isinstance(x, int | float) for pair in pairs for x in pair):
        problem(at, "expected numbers in distribution_parameters", "as in [-0.1, 0.1]")
    elif entry["distribution"] in ("uniform", "loguniform", "log_uniform") and any(a > b for a, b in pairs):
        problem(at, "a lower bound is above its upper bound", "write [low, high]")
    elif entry["distribution"] in ("loguniform", "log_uniform") and any(a <= 0 for a, _ in pairs):
        problem(at, "a loguniform distribution needs bounds above 0", "raise them, or use uniform")
    elif entry["distribution"] in ("gaussian", "normal") and any(b < 0 for _, b in pairs):
        problem(at, "a standard deviation is negative", "write [mean, std] with std >= 0")


def _entries(block: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield each randomisation of a `domain_randomization:` mapping that is not checked yet: its path, and its value.

    The last part of the path is the trigger (`on_startup`, `on_reset` or `on_interval`), or a wrong key in its place.
    """
    params = block.get("randomization_params")
    for key, content in params.items() if isinstance(params, dict) else ():
        base: tuple[str, ...] = ("randomization_params", key)
        depth = 2 if key in VIEWS else 1 if key == "simulation" else 0
        yield from _below(base, content, depth)


def _below(at: tuple[str, ...], content: Any, depth: int) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, inner in content.items() if isinstance(content, dict) else ():
        if depth:
            yield from _below((*at, key), inner, depth - 1)
        elif inner is not None:
            yield (*at, key), inner
