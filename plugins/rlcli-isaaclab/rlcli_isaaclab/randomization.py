"""Translation of Isaac Lab's randomisation events. Each event becomes zero, one or several events of rlcli."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlcli_isaaclab.scene_reader import SceneReader
    from rlcli_isaaclab.settings import Node

TermConfig = dict[str, Any]
EventConfigs = dict[str, TermConfig]
"""Events of rlcli that replace one event of Isaac Lab: suffix of the event's name -> settings of the term."""
_OPERATIONS = {"abs": "set"}
_DISTRIBUTIONS = {"log_uniform": "loguniform"}


class ParameterError(ValueError):
    """A parameter that is missing or has a wrong value."""


def translate_event(name: str, params: Node, scene: SceneReader) -> EventConfigs:
    """Return the rlcli events that replace one event of Isaac Lab. Mistakes are added to the report."""
    report = params.report
    try:
        parts = EVENTS[name](EventParameters(params, scene))
    except ParameterError as error:
        report.problem(params.key, str(error))
        return {}
    for key in params.data:
        if (*params.key, key) not in report.entries:
            report.problem((*params.key, key), f"'{name}' has no parameter '{key}'; remove it")
    return parts


class EventParameters:
    """Parameters of one of Isaac Lab's events, with the elements that its `asset_cfg` selects."""

    def __init__(self, params: Node, scene: SceneReader) -> None:
        self.params, self.scene = params, scene
        asset = params.get("asset_cfg") or {}
        self.asset: Mapping[str, Any] = asset if isinstance(asset, Mapping) else vars(asset)
        self.name = str(self.asset.get("name") or "robot")
        self.key = (*params.key, "asset_cfg")

    def require(self, name: str) -> Any:
        """Return the value of a parameter.

        Raises:
            ParameterError: if it is missing.
        """
        value = self.params.get(name)
        if value is None:
            raise ParameterError(f"missing '{name}'; give it a value")
        return value

    def range(self, name: str) -> Any:
        """Return a parameter that is a pair of numbers, or None if it is not set."""
        value = self.params.get(name)
        if value is None:
            return None
        pair = _pair(name, value)
        # as in Isaac Lab, the ends of a uniform distribution may be written from high to low
        return pair if self.params.data.get("distribution") == "gaussian" else sorted(pair)

    def entity(self) -> TermConfig:
        """Return {"entity": name} for rlcli's term; empty if the entity is `robot`, which is the default."""
        return {} if self.name == "robot" else {"entity": self.name}

    def selected(self, kind: str) -> list[str] | None:
        """Return the names of the selected joints or bodies; None: all of them."""
        names = self.asset.get(f"{kind}_names")
        if names is None or names == ".*" or list(names) == [".*"]:
            return None
        preserve = bool(self.asset.get("preserve_order"))
        wanted = self.scene.order_names(self.name, kind, names, preserve, self.key)
        return [wanted] if isinstance(wanted, str) else wanted

    def selection(self, kind: str, parameter: str) -> TermConfig:
        """Return the selected joints or bodies as a parameter of the term; empty if all are selected."""
        names = self.selected(kind)
        return {} if names is None else {parameter: names}

    def sampling(self, operation: str, distribution: str = "uniform") -> TermConfig:
        """Return rlcli's keys `operation` and `distribution` with the values of Isaac Lab's parameters.

        The arguments are Isaac Lab's defaults, for parameters that the task does not set.
        """
        operation = self.params.get("operation", operation)
        distribution = self.params.get("distribution", distribution)
        return {
            "operation": _OPERATIONS.get(operation, operation),
            "distribution": _DISTRIBUTIONS.get(distribution, distribution),
        }

    def ignore(self, name: str, why: str) -> None:
        """Report a parameter as ignored for the reason `why`, if the parameter is set."""
        value = self.params.data.get(name)
        if value is not None and any(value if isinstance(value, list | tuple) else [value]):
            self.params.report.entries[(*self.params.key, name)] = ("ignored", why)
        else:
            self.params.mark_mapped(name)

    def approximate(self, name: str, why: str) -> None:
        """Report that rlcli's parameter has nearly the same meaning; `why` is the difference."""
        self.params.note("approximated", name, why)


def _mass(event: EventParameters) -> EventConfigs:
    config: TermConfig = {"func": "randomize_body_mass", **event.entity(), **event.selection("body", "bodies")}
    config |= {
        "range": _pair("mass_distribution_params", event.require("mass_distribution_params")),
        **event.sampling("scale"),
    }
    if event.params.get("recompute_inertia", True) is False:
        config["with_inertia"] = False
    event.ignore("min_mass", "masses never fall below MuJoCo's minimum")
    return {"": config}


def _com(event: EventParameters) -> EventConfigs:
    ranges = _axes("com_range", event.require("com_range"), 0.0)
    selection = event.selection("body", "bodies")
    return {"": {"func": "randomize_body_com", **event.entity(), **selection, "range": ranges, "shared": True}}


def _material(event: EventParameters) -> EventConfigs:
    config: TermConfig = {"func": "randomize_geom_friction", **event.entity()}
    bodies = event.selected("body")
    if bodies is not None:
        config["geoms"] = event.scene.geoms_of_bodies(event.name, bodies, event.key)
    friction = event.range("dynamic_friction_range")
    static = event.range("static_friction_range")
    if friction is None and static is None:
        raise ParameterError("missing 'dynamic_friction_range'; give [low, high]")
    if static != friction:
        event.approximate("static_friction_range", "MuJoCo has no static friction, only dynamic friction")
    event.ignore("restitution_range", "in MuJoCo, solref of a geom sets how contacts bounce")
    event.params.mark_mapped("num_buckets", "make_consistent")
    return {"": {**config, "range": friction if friction is not None else static, "operation": "set"}}


def _offsets(event: EventParameters) -> EventConfigs:
    config: TermConfig = {"func": "randomize_model_field", **event.entity(), "field": "geom_margin"}
    bodies = event.selected("body")
    if bodies is not None:
        config["names"] = event.scene.geoms_of_bodies(event.name, bodies, event.key)
    event.ignore("rest_offset_distribution_params", "write randomize_model_field with field geom_gap")
    contact = event.range("contact_offset_distribution_params")
    if contact is None:
        return {}
    return {"": {**config, "range": contact, **event.sampling("abs"), "operation": "set"}}


def _gravity(event: EventParameters) -> EventConfigs:
    ends = event.require("gravity_distribution_params")
    is_pair = isinstance(ends, list | tuple) and len(ends) == 2
    if not is_pair or any(not isinstance(end, list | tuple) or len(end) != 3 for end in ends):
        raise ParameterError(f"gravity_distribution_params: expected (lowest, highest), each [x, y, z]; found {ends}")
    pairs = [_pair("gravity_distribution_params", pair) for pair in zip(*ends, strict=True)]
    event.approximate("gravity_distribution_params", "every environment has its own gravity")
    return {"": {"func": "randomize_gravity", "axes": [0, 1, 2], "range": pairs, **event.sampling("add")}}


def _gains(event: EventParameters) -> EventConfigs:
    stiffness, damping = (event.range(f"{name}_distribution_params") for name in ("stiffness", "damping"))
    found = event.scene.gains_of_joints(event.name, event.selected("joint"))
    sampling, parts = {**event.entity(), **event.sampling("abs")}, EventConfigs()
    gains = {key: pair for key, pair in (("kp", stiffness), ("kv", damping)) if pair is not None and found[key]}
    for names in dict.fromkeys(str(found[key]) for key in gains):  # one event if the same actuators have both gains
        both = {key: pair for key, pair in gains.items() if str(found[key]) == names}
        name = "native" if len(both) == len(gains) else f"native_{next(iter(both))}"
        actuators = found[next(iter(both))]
        parts[name] = {"func": "randomize_actuator_gains", "actuators": actuators, **both, **sampling}
    if stiffness is not None and sampling["operation"] != "scale" and found["kp"] != found["kv"]:
        event.approximate("stiffness_distribution_params", "joints without stiffness keep 0")
    if damping is not None and found.get("damping"):
        parts["joint"] = {"func": "randomize_joint_damping", "joints": found["damping"], "range": damping, **sampling}
    gains = {key: pair for key, pair in (("stiffness", stiffness), ("damping", damping)) if pair is not None}
    if found.get("explicit") and gains:
        parts["explicit"] = {"func": "randomize_pd_gains", "joints": found["explicit"], **gains, **sampling}
    if not parts:
        event.params.report.problem(
            event.key, f"no actuator of '{event.name}' has a gain to randomise; remove the event"
        )
    return parts


def _joints(event: EventParameters) -> EventConfigs:
    common = {**event.entity(), **event.selection("joint", "joints")}
    sampling, parts = event.sampling("abs"), EventConfigs()
    for theirs, ours in (("friction", "friction_loss"), ("armature", "armature")):
        pair = event.range(f"{theirs}_distribution_params")
        if pair is not None:
            parts[ours] = {"func": f"randomize_joint_{ours}", **common, "range": pair, **sampling}
    limits = {end: event.range(f"{end}_limit_distribution_params") for end in ("lower", "upper")}
    limits = {end: pair for end, pair in limits.items() if pair is not None}
    if limits:
        parts["range"] = {"func": "randomize_joint_range", **common, **limits, **sampling}
    return parts


def _tendons(event: EventParameters) -> EventConfigs:
    names = event.asset.get("fixed_tendon_names")
    common = {**event.entity(), **({} if names is None else {"tendons": names})}
    sampling, parts = event.sampling("abs"), EventConfigs()
    for kind in ("stiffness", "damping"):
        pair = event.range(f"{kind}_distribution_params")
        if pair is not None:
            parts[kind] = {"func": f"randomize_tendon_{kind}", **common, "range": pair, **sampling}
    for kind in ("limit_stiffness", "lower_limit", "upper_limit", "rest_length", "offset"):
        event.ignore(f"{kind}_distribution_params", "this setting cannot differ between environments in MuJoCo")
    return parts


def _scale(event: EventParameters) -> EventConfigs:
    value = event.require("scale_range")
    config: TermConfig = {"func": "randomize_geom_size", **event.entity(), "operation": "scale"}
    event.params.mark_mapped("relative_child_path")
    if isinstance(value, Mapping):
        return {"": {**config, "range": _axes("scale_range", value, 1.0)}}
    event.approximate("scale_range", "every axis of a shape samples its own scale")
    return {"": {**config, "range": _pair("scale_range", value)}}


def _gaussian(event: EventParameters) -> EventConfigs:
    pair = _pair("mean, std", [event.require("mean"), event.require("std")])
    selection = event.selection("joint", "joints")
    return {"": {"func": "reset_joints_by_gaussian", **event.entity(), **selection, "position": pair}}


def _axes(name: str, ranges: Any, neutral: float) -> list[list[float]]:
    if not isinstance(ranges, Mapping) or not set(ranges) <= {"x", "y", "z"}:
        raise ParameterError(f"{name}: expected ranges for x, y and z, {{x: [low, high], ...}}, found {ranges}")
    return [_pair(f"{name}.{axis}", ranges.get(axis, (neutral, neutral))) for axis in ("x", "y", "z")]


def _pair(name: str, value: Any) -> list[float]:
    numbers = isinstance(value, list | tuple) and all(isinstance(end, int | float) for end in value)
    if not numbers or len(value) != 2:
        raise ParameterError(f"{name}: expected two numbers, [low, high], found {value}")
    return [float(end) for end in value]


EVENTS: dict[str, Callable[[EventParameters], EventConfigs]] = {
    "randomize_rigid_body_mass": _mass,
    "randomize_rigid_body_com": _com,
    "randomize_rigid_body_material": _material,
    "randomize_rigid_body_collider_offsets": _offsets,
    "randomize_rigid_body_scale": _scale,
    "randomize_physics_scene_gravity": _gravity,
    "randomize_actuator_gains": _gains,
    "randomize_joint_parameters": _joints,
    "randomize_fixed_tendon_parameters": _tendons,
    "randomize_joint_by_gaussian_offset": _gaussian,
}
"""Isaac Lab's name -> function that returns the events that replace it."""
