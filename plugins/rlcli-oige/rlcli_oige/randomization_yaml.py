"""The grammar of OmniIsaacGymEnvs' `domain_randomization:`, read into a list of gates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rlcli.config.strict_yaml import Path
from rlcli.errors import did_you_mean, listing
from rlcli.formats import Status

GATES = ("on_startup", "on_reset", "on_interval")
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
    "the sliding friction of the geoms; MuJoCo has one, and no restitution",
)
_NO_SCALE: tuple[Status, str] = ("ignored", "a model's geometry is the same in every environment")
_NO_TENDON: tuple[Status, str] = ("ignored", "tendons are the MJCF's")
ATTRIBUTES: Mapping[str, Mapping[str, tuple[Status, str]]] = {
    "articulation_views": {
        **_STATE,
        "stiffness": ("mapped", "gain of the joints' position drives"),
        "damping": ("mapped", "damping of the joints' position drives, or of the joints that have none"),
        "joint_friction": ("approximated", "dry friction of the joints [N m]: MuJoCo's does not grow with the load"),
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
        "joint_max_velocities": ("ignored", "MuJoCo limits no joint's velocity"),
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
        "contact_offset": ("ignored", "contacts begin at the MJCF's margin"),
        "rest_offset": ("ignored", "contacts begin at the MJCF's margin"),
    },
}  # fmt: skip
"""Kind of view -> attribute -> what becomes of it."""


@dataclass(frozen=True, slots=True)
class Gate:
    """One randomisation: of what, when, and by which distribution."""

    path: tuple[str, ...]
    """(observations,), (actions,), (simulation, gravity) or (kind of view, view, attribute)"""
    gate: str
    operation: str
    distribution: str
    parameters: Any
    interval: int = 1
    """Environment steps between two firings."""
    schedule: str | None = None
    schedule_steps: int = 0

    @property
    def name(self) -> str:
        """Unique among the gates of a task."""
        return ".".join((*self.path, self.gate))

    def strength(self, step: int) -> float:
        """How much of it acts after so many steps of training."""
        if self.schedule is None or self.schedule_steps <= 0:
            return 1.0
        if self.schedule == "constant":
            return 1.0 if step >= self.schedule_steps else 0.0
        return min(1.0, step / self.schedule_steps)


def gates(block: Mapping[str, Any]) -> list[Gate]:
    """The gates of a block that `check` found nothing wrong with, those that are ignored left out."""
    found = []
    for at, params in _entries(block):
        path = at[1:-1]
        if path[0] in VIEWS and ATTRIBUTES[path[0]][path[2]][0] == "ignored":
            continue
        found.append(
            Gate(
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
    """Report every key of a `domain_randomization:` block."""
    base: Path = ("domain_randomization",)
    if not isinstance(block, dict):
        problem(base, "expected a mapping", None)
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
                    problem((*at, attribute), f"'{attribute}' cannot be randomised", "of simulation: gravity")
        elif key not in ("observations", "actions"):
            groups = ("observations", "actions", "simulation", *VIEWS)
            problem(at, f"unknown key '{key}'", did_you_mean(key, groups) or f"keys: {listing(groups)}")
    for path, entry in _entries(block):
        _check_gate((*base, *path), path, entry, problem, note)


def _check_views(kind: str, views: Any, at: Path, problem: Callable[[Path, str, str | None], None]) -> None:
    for view, attributes in views.items() if isinstance(views, dict) else ():
        for attribute in attributes if isinstance(attributes, dict) else ():
            if attribute not in ATTRIBUTES[kind]:
                known = ATTRIBUTES[kind]
                near = did_you_mean(attribute, known) or f"attributes: {listing(known, 40)}"
                problem((*at, view, attribute), f"'{attribute}' cannot be randomised", near)


def _check_gate(
    at: Path,
    path: tuple[str, ...],
    entry: Any,
    problem: Callable[[Path, str, str | None], None],
    note: Callable[[Path, Status, str], None],
) -> None:
    gate, target = path[-1], path[1:-1]
    if target and target[0] in VIEWS and (len(target) < 3 or target[2] not in ATTRIBUTES[target[0]]):
        return  # that has been said
    if gate not in GATES:
        problem(at, f"unknown key '{gate}'", did_you_mean(gate, GATES) or f"gates: {listing(GATES)}")
        return
    if gate == "on_startup" and target[0] not in VIEWS:
        problem(at, f"{target[0]} cannot be randomised on_startup", "on_reset or on_interval")
    if not isinstance(entry, dict):
        problem(at, "expected a mapping", None)
        return
    for key in entry:
        if key not in _KEYS:
            problem((*at, key), f"unknown key '{key}'", did_you_mean(key, _KEYS) or f"keys: {listing(_KEYS)}")
    needed = ("operation", "distribution", "distribution_parameters")
    missing = [
        key for key in (*needed, *(("frequency_interval",) if gate == "on_interval" else ())) if key not in entry
    ]
    if missing:
        problem(at, f"needs {listing(missing)}", None)
        return
    for key, known in (("operation", OPERATIONS), ("distribution", tuple(DISTRIBUTIONS)), ("schedule", SCHEDULES)):
        if key in entry and entry[key] not in known:
            near = did_you_mean(str(entry[key]), known) or f"known: {listing(known)}"
            problem((*at, key), f"no {key} '{entry[key]}'", near)
    for key, least in (("frequency_interval", 1), ("schedule_steps", 0)):
        count = entry.get(key, least)
        if isinstance(count, bool) or not isinstance(count, int | float) or count != int(count) or count < least:
            problem((*at, key), f"expected a whole number >= {least}, found {count!r}", None)
    if entry["operation"] == "direct" and target[0] in ("observations", "actions"):
        problem((*at, "operation"), "noise is additive or scaling", None)
    _check_numbers((*at, "distribution_parameters"), entry, problem)
    status: tuple[Status, str] = ("mapped", "")
    if target[0] in VIEWS:
        status = ATTRIBUTES[target[0]][target[2]]
    note(at, *status)


def _check_numbers(at: Path, entry: Mapping[str, Any], problem: Callable[[Path, str, str | None], None]) -> None:
    given = entry["distribution_parameters"]
    rows = given if isinstance(given, list) and len(given) == 2 else None
    if rows is not None and all(isinstance(row, int | float) for row in rows):
        pairs = [(rows[0], rows[1])]
    elif rows is not None and all(isinstance(row, list) for row in rows) and len(rows[0]) == len(rows[1]):
        pairs = list(zip(rows[0], rows[1], strict=True))
    else:
        problem(at, f"expected [a, b] or [[a, ...], [b, ...]], found {given!r}", None)
        return
    if not all(isinstance(x, int | float) for pair in pairs for x in pair):
        problem(at, "expected numbers", None)
    elif entry["distribution"] in ("uniform", "loguniform", "log_uniform") and any(a > b for a, b in pairs):
        problem(at, "a lower end is above its upper end", None)
    elif entry["distribution"] in ("loguniform", "log_uniform") and any(a <= 0 for a, _ in pairs):
        problem(at, "a loguniform distribution lies above 0", None)
    elif entry["distribution"] in ("gaussian", "normal") and any(b < 0 for _, b in pairs):
        problem(at, "a standard deviation is not negative", None)


def _entries(block: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """(path below the block, content) of everything that stands where a gate does."""
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
