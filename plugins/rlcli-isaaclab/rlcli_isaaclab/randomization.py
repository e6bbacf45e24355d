"""Isaac Lab's randomisation events as those of `rlcli.mdp`: one of theirs may be several here, or none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlcli_isaaclab.scene_reader import SceneReader
    from rlcli_isaaclab.settings import Node

Made = dict[str, Any]
Parts = dict[str, Made]
"""The events that one becomes: what is added to its name -> the term's parameters."""
_OPERATIONS = {"abs": "set"}
_DISTRIBUTIONS = {"log_uniform": "loguniform"}


class Unfit(ValueError):
    """A parameter that is missing, or that is not what it should be."""


def translated(name: str, params: Node, scene: SceneReader) -> Parts:
    """The events that one of Isaac Lab's becomes; what is wrong with it goes into the report."""
    report = params.report
    try:
        parts = EVENTS[name](Given(params, scene))
    except Unfit as error:
        report.problem(params.key, str(error))
        return {}
    for key in params.data:
        if (*params.key, key) not in report.entries:
            report.problem((*params.key, key), f"'{name}' has no such parameter")
    return parts


class Given:
    """The parameters of one of Isaac Lab's events, and the elements that its `asset_cfg` picks."""

    def __init__(self, params: Node, scene: SceneReader) -> None:
        self.params, self.scene = params, scene
        asset = params.get("asset_cfg") or {}
        self.asset: Mapping[str, Any] = asset if isinstance(asset, Mapping) else vars(asset)
        self.name = str(self.asset.get("name") or "robot")
        self.key = (*params.key, "asset_cfg")

    def need(self, name: str) -> Any:
        """A value that must be there."""
        value = self.params.get(name)
        if value is None:
            raise Unfit(f"missing '{name}'")
        return value

    def range(self, name: str) -> Any:
        """A pair of numbers, or None."""
        value = self.params.get(name)
        return None if value is None else _pair(name, value)

    def entity(self) -> Made:
        """Which entity, if it is not the robot."""
        return {} if self.name == "robot" else {"entity": self.name}

    def chosen(self, kind: str) -> list[str] | None:
        """Names of the picked joints or bodies; None: all of them."""
        names = self.asset.get(f"{kind}_names")
        if names is None or names == ".*" or list(names) == [".*"]:
            return None
        preserve = bool(self.asset.get("preserve_order"))
        wanted = self.scene.ordered(self.name, kind, names, preserve, self.key)
        return [wanted] if isinstance(wanted, str) else wanted

    def picked(self, kind: str, parameter: str) -> Made:
        """The picked joints or bodies as a parameter."""
        names = self.chosen(kind)
        return {} if names is None else {parameter: names}

    def spread(self, operation: str, distribution: str = "uniform") -> Made:
        """How values are drawn and applied."""
        operation = self.params.get("operation", operation)
        distribution = self.params.get("distribution", distribution)
        return {
            "operation": _OPERATIONS.get(operation, operation),
            "distribution": _DISTRIBUTIONS.get(distribution, distribution),
        }

    def ignore(self, name: str, why: str) -> None:
        """Say that a parameter has no counterpart, if it is set."""
        value = self.params.data.get(name)
        if value is not None and any(value if isinstance(value, list | tuple) else [value]):
            self.params.report.entries[(*self.params.key, name)] = ("ignored", why)
        else:
            self.params.skip(name)

    def approximate(self, name: str, why: str) -> None:
        """Say that a parameter means nearly the same."""
        self.params.say("approximated", name, why)


def _mass(given: Given) -> Parts:
    made: Made = {"func": "randomize_body_mass", **given.entity(), **given.picked("body", "bodies")}
    made |= {
        "range": _pair("mass_distribution_params", given.need("mass_distribution_params")),
        **given.spread("scale"),
    }
    if given.params.get("recompute_inertia", True) is False:
        made["with_inertia"] = False
    given.ignore("min_mass", "no mass falls below what MuJoCo takes")
    return {"": made}


def _com(given: Given) -> Parts:
    ranges = _axes("com_range", given.need("com_range"), 0.0)
    picked = given.picked("body", "bodies")
    return {"": {"func": "randomize_body_com", **given.entity(), **picked, "range": ranges, "shared": True}}


def _material(given: Given) -> Parts:
    made: Made = {"func": "randomize_geom_friction", **given.entity()}
    bodies = given.chosen("body")
    if bodies is not None:
        made["geoms"] = given.scene.geoms_of(given.name, bodies, given.key)
    friction = given.range("dynamic_friction_range")
    static = given.range("static_friction_range")
    if friction is None and static is None:
        raise Unfit("missing 'dynamic_friction_range'")
    if static != friction:
        given.approximate("static_friction_range", "MuJoCo has one friction, the dynamic one")
    given.ignore("restitution_range", "MuJoCo's contacts have solref")
    given.params.skip("num_buckets", "make_consistent")
    return {"": {**made, "range": friction if friction is not None else static, "operation": "set"}}


def _offsets(given: Given) -> Parts:
    made: Made = {"func": "randomize_model_field", **given.entity(), "field": "geom_margin"}
    bodies = given.chosen("body")
    if bodies is not None:
        made["names"] = given.scene.geoms_of(given.name, bodies, given.key)
    given.ignore("rest_offset_distribution_params", "write randomize_model_field with field geom_gap")
    contact = given.range("contact_offset_distribution_params")
    if contact is None:
        return {}
    return {"": {**made, "range": contact, **given.spread("abs"), "operation": "set"}}


def _gravity(given: Given) -> Parts:
    ends = given.need("gravity_distribution_params")
    if (
        not isinstance(ends, list | tuple)
        or len(ends) != 2
        or any(not isinstance(end, list | tuple) or len(end) != 3 for end in ends)
    ):
        raise Unfit(f"gravity_distribution_params: expected ([x, y, z], [x, y, z]), found {ends}")
    pairs = [_pair("gravity_distribution_params", pair) for pair in zip(*ends, strict=True)]
    given.approximate("gravity_distribution_params", "each environment has its own gravity, not all the same")
    return {"": {"func": "randomize_gravity", "axes": [0, 1, 2], "range": pairs, **given.spread("add")}}


def _gains(given: Given) -> Parts:
    stiffness, damping = (given.range(f"{name}_distribution_params") for name in ("stiffness", "damping"))
    native, explicit = given.scene.drives_of(given.name, given.chosen("joint"))
    spread, parts = {**given.entity(), **given.spread("abs")}, Parts()
    gains = {key: pair for key, pair in (("kp", stiffness), ("kv", damping)) if pair is not None}
    if native and gains:
        parts["native"] = {"func": "randomize_actuator_gains", "actuators": native, **gains, **spread}
    gains = {key: pair for key, pair in (("stiffness", stiffness), ("damping", damping)) if pair is not None}
    if explicit and gains:
        parts["explicit"] = {"func": "randomize_pd_gains", "joints": explicit, **gains, **spread}
    if not parts:
        given.params.report.problem(given.key, f"no actuator of '{given.name}' has a gain to randomise")
    return parts


def _joints(given: Given) -> Parts:
    common = {**given.entity(), **given.picked("joint", "joints")}
    spread, parts = given.spread("abs"), Parts()
    for theirs, ours in (("friction", "friction_loss"), ("armature", "armature")):
        pair = given.range(f"{theirs}_distribution_params")
        if pair is not None:
            parts[ours] = {"func": f"randomize_joint_{ours}", **common, "range": pair, **spread}
    limits = {end: given.range(f"{end}_limit_distribution_params") for end in ("lower", "upper")}
    limits = {end: pair for end, pair in limits.items() if pair is not None}
    if limits:
        parts["range"] = {"func": "randomize_joint_range", **common, **limits, **spread}
    return parts


def _tendons(given: Given) -> Parts:
    names = given.asset.get("fixed_tendon_names")
    common = {**given.entity(), **({} if names is None else {"tendons": names})}
    spread, parts = given.spread("abs"), Parts()
    for kind in ("stiffness", "damping"):
        pair = given.range(f"{kind}_distribution_params")
        if pair is not None:
            parts[kind] = {"func": f"randomize_tendon_{kind}", **common, "range": pair, **spread}
    for kind in ("limit_stiffness", "lower_limit", "upper_limit", "rest_length", "offset"):
        given.ignore(f"{kind}_distribution_params", "MuJoCo's tendons have no such number that may differ")
    return parts


def _scale(given: Given) -> Parts:
    value = given.need("scale_range")
    made: Made = {"func": "randomize_geom_size", **given.entity(), "operation": "scale"}
    given.params.skip("relative_child_path")
    if isinstance(value, Mapping):
        return {"": {**made, "range": _axes("scale_range", value, 1.0)}}
    given.approximate("scale_range", "each axis of a shape draws its own scale")
    return {"": {**made, "range": _pair("scale_range", value)}}


def _gaussian(given: Given) -> Parts:
    pair = _pair("mean, std", [given.need("mean"), given.need("std")])
    picked = given.picked("joint", "joints")
    return {"": {"func": "reset_joints_by_gaussian", **given.entity(), **picked, "position": pair}}


def _axes(name: str, ranges: Any, still: float) -> list[list[float]]:
    if not isinstance(ranges, Mapping) or not set(ranges) <= {"x", "y", "z"}:
        raise Unfit(f"{name}: expected ranges for x, y and z, found {ranges}")
    return [_pair(f"{name}.{axis}", ranges.get(axis, (still, still))) for axis in ("x", "y", "z")]


def _pair(name: str, value: Any) -> list[float]:
    numbers = isinstance(value, list | tuple) and all(isinstance(end, int | float) for end in value)
    if not numbers or len(value) != 2:
        raise Unfit(f"{name}: expected two numbers, found {value}")
    return [float(end) for end in value]


EVENTS: dict[str, Callable[[Given], Parts]] = {
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
"""Isaac Lab's name -> what it becomes."""
