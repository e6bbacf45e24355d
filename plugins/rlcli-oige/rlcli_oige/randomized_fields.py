"""Attributes of views and of the model that domain randomisation reads and writes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rlcli.errors import did_you_mean, listing
from rlcli_oige.articulation_view import ArticulationView
from rlcli_oige.maths import normalize_angle
from rlcli_oige.rotations import get_euler_xyz, quat_from_euler_xyz, quat_mul
from rlcli_oige.views import RigidPrimView

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv

ROOT_AND_JOINT_STATE = (
    "position",
    "orientation",
    "linear_velocity",
    "angular_velocity",
    "velocity",
    "joint_positions",
    "joint_velocities",
)
"""Attributes that belong to the state of the simulation: an operation changes their current value, not the initial
one."""


class RandomizedField:
    """Attribute that differs between environments, with its initial values.

    `first` is the value after start-up: every `on_reset` starts from it. `base` is the value at the start of the
    episode: every `on_interval` starts from it.
    """

    def __init__(
        self,
        read: Callable[[Tensor], Tensor],
        write: Callable[[Tensor, Tensor], None],
        env: OigeEnv,
        change: Callable[[str, Tensor, Tensor], Tensor] | None = None,
        state: bool = False,
    ) -> None:
        self.read, self.write, self.change = read, write, change or apply_operation
        all_ids = torch.arange(env.num_envs, device=env.device)
        self._is_state = state
        self.first = torch.empty(0) if state else read(all_ids).clone()
        self.base = self.first.clone()
        self._started = False

    def restore(self, ids: Tensor) -> None:
        """Write the values after start-up back in the environments `ids`; attributes of the state stay."""
        if not self._is_state:
            self.write(ids, self.first[ids])

    def restore_episode_start(self, ids: Tensor) -> None:
        """Write the values at the start of the episode back in the environments `ids`, except those of the state."""
        if not self._is_state:
            self.write(ids, self.base[ids])

    def store_episode_start(self, ids: Tensor) -> None:
        """Store the current values as the episode's start; the first call also stores them as those after start-up."""
        if self._is_state:
            return
        self.base[ids] = self.read(ids)
        if not self._started:
            self.first, self._started = self.base.clone(), True


def apply_operation(operation: str, current: Tensor, sample: Tensor) -> Tensor:
    """Return `current + sample` for the operation additive, `current * sample` for scaling, `sample` for direct."""
    if operation == "additive":
        return current + sample
    return current * sample if operation == "scaling" else sample


def _apply_rotation(operation: str, current: Tensor, sample: Tensor) -> Tensor:
    """Return orientations rotated by roll, pitch and yaw [rad]. (n, 4 k), (n, 3 k) -> (n, 4 k)"""
    now, angles = current.reshape(-1, 4), sample.reshape(-1, 3)
    if operation == "scaling":
        angles = angles * normalize_angle(torch.stack(get_euler_xyz(now), dim=1))
    rotation = quat_from_euler_xyz(angles[:, 0], angles[:, 1], angles[:, 2]).to(current.dtype)
    return (quat_mul(rotation, now) if operation == "additive" else rotation).reshape(current.shape)


def make_field(path: tuple[str, ...], env: OigeEnv) -> RandomizedField:
    """Return the object that reads and writes a randomised attribute.

    Args:
        path: (simulation, gravity) or (kind of view, view, attribute).
        env: the environment.

    Raises:
        LookupError: if the task registered no such view.
    """
    if path[0] == "simulation":
        gravity = env.engine.expand("opt.gravity")

        def set_gravity(ids: Tensor, values: Tensor) -> None:
            gravity[ids] = values.to(gravity.dtype)

        return RandomizedField(lambda ids: gravity[ids], set_gravity, env)
    views: Any = env.handle.world.scene
    known = views.articulated_views if path[0] == "articulation_views" else views.rigid_prim_views
    if path[1] not in known:
        near = did_you_mean(path[1], known) or f"registered: {listing(known)}"
        raise LookupError(f"the task registers no view '{path[1]}'; {near}")
    view = known[path[1]]
    if path[2] in VIEW_STATE:
        return _state_field(view, path[2], env)
    if path[0] == "articulation_views":
        return _articulation_field(view, path[2], env)
    return _body_field(view, path[2], env)


VIEW_STATE = (*ROOT_AND_JOINT_STATE, "joint_efforts", "force")


def _state_field(view: Any, attribute: str, env: OigeEnv) -> RandomizedField:
    def rows(ids: Tensor) -> Tensor:
        """Return the view's rows of environments; a view may have several bodies per environment."""
        per = view._per_env
        return ids if per == 1 else (ids[:, None] * per + torch.arange(per, device=ids.device)).reshape(-1)

    def flat(values: Tensor, width: int) -> Tensor:
        return values.reshape(-1, width)

    def grouped(values: Tensor, ids: Tensor) -> Tensor:
        return values.reshape(len(ids), -1)

    readers: dict[str, Callable[[Tensor], Tensor]] = {
        "position": lambda ids: grouped(view.get_world_poses(rows(ids))[0], ids),
        "orientation": lambda ids: grouped(view.get_world_poses(rows(ids))[1], ids),
        "linear_velocity": lambda ids: grouped(view.get_velocities(rows(ids))[:, :3], ids),
        "angular_velocity": lambda ids: grouped(view.get_velocities(rows(ids))[:, 3:], ids),
        "velocity": lambda ids: grouped(view.get_velocities(rows(ids)), ids),
        "joint_positions": lambda ids: view.get_joint_positions(ids),
        "joint_velocities": lambda ids: view.get_joint_velocities(ids),
        "joint_efforts": lambda ids: view.get_applied_joint_efforts(ids),
        "force": lambda ids: torch.zeros(len(ids), 3 * view._per_env, device=env.device),
    }
    writers: dict[str, Callable[[Tensor, Tensor], None]] = {
        "position": lambda ids, v: view.set_world_poses(flat(v, 3), None, rows(ids)),
        "orientation": lambda ids, v: view.set_world_poses(None, flat(v, 4), rows(ids)),
        "linear_velocity": lambda ids, v: view.set_linear_velocities(flat(v, 3), rows(ids)),
        "angular_velocity": lambda ids, v: view.set_angular_velocities(flat(v, 3), rows(ids)),
        "velocity": lambda ids, v: view.set_velocities(flat(v, 6), rows(ids)),
        "joint_positions": lambda ids, v: view.set_joint_positions(v, ids),
        "joint_velocities": lambda ids, v: view.set_joint_velocities(v, ids),
        "joint_efforts": lambda ids, v: view.set_joint_efforts(v, ids),
        "force": lambda ids, v: env.queue_forces(view, rows(ids), flat(v, 3)),
    }
    change = _apply_rotation if attribute == "orientation" else apply_operation
    return RandomizedField(readers[attribute], writers[attribute], env, change, state=True)


def _articulation_field(view: ArticulationView, attribute: str, env: OigeEnv) -> RandomizedField:
    engine, entity = env.engine, view.entity
    joints = torch.tensor(entity.joint_ids, device=env.device)[view._order]
    drives = view._drives["position"][1]
    bodies = torch.tensor(view._body_ids, device=env.device)
    dofs = view._dof_columns
    if attribute == "stiffness":
        gain, bias = engine.expand("actuator_gainprm"), engine.expand("actuator_biasprm")

        def set_stiffness(ids: Tensor, values: Tensor) -> None:
            gain[ids[:, None], drives, 0] = values
            bias[ids[:, None], drives, 1] = -values

        return RandomizedField(lambda ids: gain[ids[:, None], drives, 0], set_stiffness, env)
    if attribute == "damping" and len(drives):
        bias = engine.expand("actuator_biasprm")

        def set_damping(ids: Tensor, values: Tensor) -> None:
            bias[ids[:, None], drives, 2] = -values

        return RandomizedField(lambda ids: -bias[ids[:, None], drives, 2], set_damping, env)
    if attribute == "damping":
        return _column_field(engine.expand("dof_damping"), dofs, env)
    if attribute in ("lower_dof_limits", "upper_dof_limits"):
        end, ranges = int(attribute == "upper_dof_limits"), engine.expand("jnt_range")

        def set_limit(ids: Tensor, values: Tensor) -> None:
            ranges[ids[:, None], joints, end] = values

        return RandomizedField(lambda ids: ranges[ids[:, None], joints, end], set_limit, env)
    if attribute == "max_efforts":

        def set_max_efforts(ids: Tensor, values: Tensor) -> None:
            view.set_max_efforts(values, ids)

        return RandomizedField(view.get_max_efforts, set_max_efforts, env)
    if attribute == "material_properties":
        return _friction_field(view._body_ids, env)
    if attribute in ("body_masses", "body_inertias"):
        return _mass_field(bodies, attribute == "body_masses", env)
    name = {"joint_friction": "dof_frictionloss", "joint_armatures": "dof_armature"}[attribute]
    return _column_field(engine.expand(name), dofs, env)


def _body_field(view: RigidPrimView, attribute: str, env: OigeEnv) -> RandomizedField:
    if attribute == "material_properties":
        return _friction_field(view._bodies, env)
    return _mass_field(torch.tensor(view._bodies, device=env.device), attribute in ("mass", "density"), env)


def _column_field(field: Tensor, columns: Tensor, env: OigeEnv) -> RandomizedField:
    def write(ids: Tensor, values: Tensor) -> None:
        field[ids[:, None], columns] = values.to(field.dtype)

    return RandomizedField(lambda ids: field[ids[:, None], columns], write, env)


def _mass_field(bodies: Tensor, mass: bool, env: OigeEnv) -> RandomizedField:
    masses, inertias = env.engine.expand("body_mass"), env.engine.expand("body_inertia")
    if not mass:
        return _column_field(inertias, bodies, env)

    def write(ids: Tensor, values: Tensor) -> None:
        before = masses[ids[:, None], bodies]
        inertias[ids[:, None], bodies] *= torch.where(before > 0, values / before, torch.ones_like(before))[..., None]
        masses[ids[:, None], bodies] = values

    return RandomizedField(lambda ids: masses[ids[:, None], bodies], write, env)


def _friction_field(bodies: list[int], env: OigeEnv) -> RandomizedField:
    """Return the attribute `material_properties` of bodies: static friction, dynamic friction, restitution.

    MuJoCo has one friction: both columns read the sliding friction of the geoms, and the dynamic one is written.
    Restitution reads 0 and is not written.
    """
    model = env.engine.model
    geoms = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in bodies]
    columns, friction = torch.tensor(geoms, device=env.device), env.engine.expand("geom_friction")

    def read(ids: Tensor) -> Tensor:
        sliding = friction[ids[:, None], columns, 0]
        return torch.stack([sliding, sliding, torch.zeros_like(sliding)], dim=-1)

    def write(ids: Tensor, values: Tensor) -> None:
        friction[ids[:, None], columns, 0] = values[..., 1].clamp(min=0.0)

    return RandomizedField(read, write, env)
