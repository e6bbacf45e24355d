"""Observation and action terms as formulas: plain data that says how code without rlcli computes them from MjData.

A formula is a list of numbers; `{"field": NAME, "at": [...]}`, elements of a field of MjData, flattened;
`{"given": NAME, "at": [...]}`, what the caller knows: `last_action`, `steps` of the episode, `command/NAME`, or the
policy's outputs `action` and `command`; or `{"op": NAME, "of": [formulas]}`. Every value is a row of float32.

Of a term that has none only its own code can be asked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rlcli.managers.command import CommandTerm
from rlcli.managers.term import BoundTerm
from rlcli.mdp import actions, observations
from rlcli.scene.entity import Entity
from rlcli.sim.selection import Columns

if TYPE_CHECKING:
    from rlcli.envs.vec_env import VecEnv

Formula = Any


class NoFormula(Exception):
    """Depends on what MjData does not hold."""


def observation_formula(env: VecEnv, term: BoundTerm) -> Formula | None:
    """What the function of an observation term computes; None where plain code cannot."""
    function = getattr(term.call, "func", None)
    make = _OBSERVATIONS.get(getattr(function, "__name__", "")) if _is_ours(function, observations) else None
    if make is None:
        return None
    try:
        return make(env, **term.call.keywords)  # type: ignore[attr-defined]
    except NoFormula:
        return None


def control_formula(env: VecEnv, term: BoundTerm, columns: tuple[int, int]) -> tuple[list[int], Formula] | None:
    """Controls of the model, and what an action term writes to them; None where plain code cannot.

    Args:
        env: the environment.
        term: the action term.
        columns: of the policy's vector that it takes.
    """
    action = term.instance
    make = _ACTIONS.get(type(action).__name__) if _is_ours(type(action), actions) else None
    if make is None or None in action.actuators:
        return None
    value = make(action, list(range(*columns)))
    gear = torch.tensor(env.engine.model.actuator_gear[action.actuators, 0], dtype=torch.float32)
    factor = 1.0 / gear if action.actuator == "motor" else gear
    return list(action.actuators), op("mul", value, numbers(factor)) if bool((factor != 1.0).any()) else value


def field(name: str, at: Any) -> Formula:
    """Elements of a field of MjData."""
    return {"field": name, "at": [int(i) for i in at]}


def given(name: str, at: Any = None) -> Formula:
    """What the caller knows, or some elements of it."""
    return {"given": name} if at is None else {"given": name, "at": [int(i) for i in at]}


def op(name: str, *of: Formula) -> Formula:
    """An operation on formulas."""
    return {"op": name, "of": list(of)}


def numbers(values: Tensor) -> Formula:
    """Constants."""
    return [float(value) for value in values.detach().cpu().float().flatten().tolist()]


def _is_ours(function: Any, module: Any) -> bool:
    return bool(getattr(function, "__module__", None) == module.__name__)


# --- what terms are made of ---


def _shared(values: Tensor) -> Formula:
    """A quantity that all environments have alike. (num_envs, k)"""
    if not bool((values == values[:1]).all()):
        raise NoFormula
    return numbers(values[0])


def _joints(entity: Entity, joints: Columns) -> tuple[list[int], list[int]]:
    """Addresses in qpos and in qvel."""
    return entity.qpos_columns[joints].tolist(), entity.dof_columns[joints].tolist()


def _bodies(entity: Entity, bodies: Columns) -> list[int]:
    return torch.from_numpy(entity.body_ids)[_host(bodies)].tolist()


def _sites(entity: Entity, sites: Columns) -> list[int]:
    return torch.from_numpy(entity.site_ids)[_host(sites)].tolist()


def _host(columns: Columns) -> Columns:
    return columns if isinstance(columns, slice) else columns.cpu()


def _of(name: str, number: int, width: int, begin: int = 0, count: int | None = None) -> Formula:
    start = number * width + begin
    return field(name, range(start, start + (width if count is None else count)))


def _root(entity: Entity, name: str, address: int | None, start: int, stop: int, default: int) -> Formula:
    """Elements `start` to `stop` of the root's part of qpos or qvel; a fixed root has those of the default state."""
    if address is None:
        return numbers(entity.data.default_root_state[0, default : default + stop - start])
    return field(name, range(address + start, address + stop))


def _root_pos(entity: Entity) -> Formula:
    is_mocap = entity.mocap >= 0
    return _of("mocap_pos", entity.mocap, 3) if is_mocap else _root(entity, "qpos", entity.root_qpos, 0, 3, 0)


def _root_quat(entity: Entity) -> Formula:
    is_mocap = entity.mocap >= 0
    return _of("mocap_quat", entity.mocap, 4) if is_mocap else _root(entity, "qpos", entity.root_qpos, 3, 7, 3)


def _root_lin_vel_w(entity: Entity) -> Formula:
    return _root(entity, "qvel", entity.root_dof, 0, 3, 7)


def _root_ang_vel_b(entity: Entity) -> Formula:
    return _root(entity, "qvel", entity.root_dof, 3, 6, 10)


def _down(entity: Entity) -> Formula:
    if entity.engine.expanded("opt.gravity") is not None:
        raise NoFormula
    return _shared(entity.data.down_w)


def _at_home(env: VecEnv) -> None:
    """Positions count from the environment's origin, which is the world's where there is no terrain."""
    if env.terrain is not None:
        raise NoFormula


def _velocity_at(entity: Entity, body: int, point: Formula) -> Formula:
    """Velocity of a point of a body: MjData has that at the centre of mass of the body's tree."""
    root = int(entity.engine.model.body_rootid[body])
    arm = op("sub", point, _of("subtree_com", root, 3))
    return op("add", _of("cvel", body, 6, 3, 3), op("cross", _of("cvel", body, 6, 0, 3), arm))


def _site_quat(entity: Entity, site: int) -> Formula:
    model = entity.engine.model
    turn = numbers(torch.tensor(model.site_quat[site]))
    return op("product", _of("xquat", int(model.site_bodyid[site]), 4), turn)


def _parts(*formulas: Formula) -> Formula:
    return formulas[0] if len(formulas) == 1 else op("cat", *formulas)


# --- observation terms, by the names of their functions ---


def _joint_pos_rel(env: VecEnv, entity: Entity, joints: Columns) -> Formula:
    default = _shared(entity.data.default_joint_pos[:, joints])
    return op("sub", field("qpos", _joints(entity, joints)[0]), default)


def _joint_vel_rel(env: VecEnv, entity: Entity, joints: Columns) -> Formula:
    default = _shared(entity.data.default_joint_vel[:, joints])
    return op("sub", field("qvel", _joints(entity, joints)[1]), default)


def _joint_angle_sum(env: VecEnv, entity: Entity, joints: Columns) -> Formula:
    qpos = field("qpos", _joints(entity, joints)[0])
    return op("wrap", op("dot", qpos, [1.0] * len(_joints(entity, joints)[0])))


def _joint_pos_limit_normalized(env: VecEnv, entity: Entity, joints: Columns) -> Formula:
    low, high = entity.data.soft_joint_pos_limits[joints].unbind(dim=1)
    limited = high - low < torch.inf
    low, high = torch.where(limited, low, 0.0), torch.where(limited, high, 1.0)
    twice = op("mul", [2.0], field("qpos", _joints(entity, joints)[0]))
    scaled = op("div", op("sub", op("sub", twice, numbers(low)), numbers(high)), numbers(high - low))
    return scaled if bool(limited.all()) else op("mul", scaled, numbers(limited))


def _base_pos_z(env: VecEnv, entity: Entity) -> Formula:
    _at_home(env)
    return op("take", _root_pos(entity), [2.0])


def _root_pos_w(env: VecEnv, entity: Entity) -> Formula:
    _at_home(env)
    return _root_pos(entity)


def _root_quat_w(env: VecEnv, entity: Entity, make_quat_unique: bool = False) -> Formula:
    return op("unique", _root_quat(entity)) if make_quat_unique else _root_quat(entity)


def _roll(entity: Entity) -> Formula:
    return op("angle", op("take", op("unrotate", _root_quat(entity), [0.0, 0.0, 1.0]), [2.0, 1.0]))


def _pitch(entity: Entity) -> Formula:
    sine = op("take", op("rotate", _root_quat(entity), [1.0, 0.0, 0.0]), [2.0])
    return op("asin", op("clip", op("mul", sine, [-1.0]), [-1.0], [1.0]))


def _yaw(entity: Entity) -> Formula:
    return op("angle", op("rotate", _root_quat(entity), [1.0, 0.0, 0.0]))


def _way(env: VecEnv, entity: Entity, target: Iterable[float]) -> tuple[Formula, Formula]:
    """Horizontally: the root's forward axis, and the way from it to a point."""
    _at_home(env)
    point = [float(value) for value in target][:2]
    way = op("sub", point, op("take", _root_pos(entity), [0.0, 1.0]))
    return op("take", op("rotate", _root_quat(entity), [1.0, 0.0, 0.0]), [0.0, 1.0]), way


def _base_heading_proj(env: VecEnv, entity: Entity, target: Iterable[float]) -> Formula:
    ahead, way = _way(env, entity, target)
    return op("div", op("dot", ahead, way), op("sqrt", op("dot", way, way)))


def _base_angle_to_target(env: VecEnv, entity: Entity, target: Iterable[float]) -> Formula:
    ahead, way = _way(env, entity, target)
    return op("wrap", op("sub", op("angle", way), op("angle", ahead)))


def _body_pose_w(env: VecEnv, entity: Entity, bodies: Columns) -> Formula:
    _at_home(env)
    return _parts(
        *(part for b in _bodies(entity, bodies) for part in (_of("xpos", b, 3), _of("xquat", b, 4))),
    )


def _body_projected_gravity_b(env: VecEnv, entity: Entity, bodies: Columns) -> Formula:
    down = _down(entity)
    return _parts(*(op("unrotate", _of("xquat", b, 4), down) for b in _bodies(entity, bodies)))


def _body_state_b(env: VecEnv, entity: Entity, bodies: Columns) -> Formula:
    root, parts = _root_quat(entity), []
    for b in _bodies(entity, bodies):
        parts += [
            op("unrotate", root, op("sub", _of("xpos", b, 3), _root_pos(entity))),
            op("product", op("inverse", root), _of("xquat", b, 4)),
            op("unrotate", root, _velocity_at(entity, b, _of("xpos", b, 3))),
            op("unrotate", root, _of("cvel", b, 6, 0, 3)),
        ]
    return op("cat", *parts)


def _sensor(env: VecEnv, entity: Entity, sensors: Columns) -> Formula:
    return field("sensordata", torch.arange(entity.engine.model.nsensordata)[_host(sensors)].tolist())


def _foot_height(env: VecEnv, entity: Entity, sites: Columns) -> Formula:
    _at_home(env)
    return field("site_xpos", [3 * s + 2 for s in _sites(entity, sites)])


def _ee_pos(env: VecEnv, entity: Entity, sites: Columns) -> Formula:
    _at_home(env)
    return field("site_xpos", [3 * s + i for s in _sites(entity, sites) for i in range(3)])


def _ee_quat(env: VecEnv, entity: Entity, sites: Columns, make_quat_unique: bool = True) -> Formula:
    quats = [_site_quat(entity, s) for s in _sites(entity, sites)]
    return _parts(*(op("unique", q) if make_quat_unique else q for q in quats))


def _ee_velocity(env: VecEnv, entity: Entity, sites: Columns) -> Formula:
    body = entity.engine.model.site_bodyid
    velocities = [_velocity_at(entity, int(body[s]), _of("site_xpos", s, 3)) for s in _sites(entity, sites)]
    return _parts(*(op("unrotate", _root_quat(entity), velocity) for velocity in velocities))


def _object_position(env: VecEnv, entity: Entity, object: Entity) -> Formula:
    return op("unrotate", _root_quat(entity), op("sub", _root_pos(object), _root_pos(entity)))


def _object_quat(env: VecEnv, entity: Entity, object: Entity) -> Formula:
    return op("product", op("inverse", _root_quat(entity)), _root_quat(object))


def _ee_to_object(env: VecEnv, entity: Entity, sites: Columns, object: Entity) -> Formula:
    (site,) = _sites(entity, sites)
    return op("sub", _root_pos(object), _of("site_xpos", site, 3))


def _generated_commands(env: VecEnv, command: CommandTerm) -> Formula:
    terms = getattr(env, "command_manager").terms  # noqa: B009 (only managed environments have commands)
    return given(next(f"command/{term.name}" for term in terms if term.instance is command))


_OBSERVATIONS: Mapping[str, Callable[..., Formula]] = {
    "joint_pos": lambda env, entity, joints: field("qpos", _joints(entity, joints)[0]),
    "joint_vel": lambda env, entity, joints: field("qvel", _joints(entity, joints)[1]),
    "joint_pos_rel": _joint_pos_rel,
    "joint_vel_rel": _joint_vel_rel,
    "joint_angle": lambda env, entity, joints: op("wrap", field("qpos", _joints(entity, joints)[0])),
    "joint_angle_sum": _joint_angle_sum,
    "joint_pos_limit_normalized": _joint_pos_limit_normalized,
    "joint_effort": lambda env, entity, joints: field("qfrc_actuator", _joints(entity, joints)[1]),
    "base_pos_z": _base_pos_z,
    "base_lin_vel": lambda env, entity: op("unrotate", _root_quat(entity), _root_lin_vel_w(entity)),
    "base_ang_vel": lambda env, entity: _root_ang_vel_b(entity),
    "projected_gravity": lambda env, entity: op("unrotate", _root_quat(entity), _down(entity)),
    "root_pos_w": _root_pos_w,
    "root_quat_w": _root_quat_w,
    "root_lin_vel_w": lambda env, entity: _root_lin_vel_w(entity),
    "root_ang_vel_w": lambda env, entity: op("rotate", _root_quat(entity), _root_ang_vel_b(entity)),
    "base_yaw_roll": lambda env, entity: op("cat", _yaw(entity), _roll(entity)),
    "base_roll_pitch": lambda env, entity: op("cat", _roll(entity), _pitch(entity)),
    "base_up_proj": lambda env, entity: op(
        "mul", op("take", op("unrotate", _root_quat(entity), _down(entity)), [2.0]), [-1.0]
    ),
    "base_heading_proj": _base_heading_proj,
    "base_angle_to_target": _base_angle_to_target,
    "body_pose_w": _body_pose_w,
    "body_projected_gravity_b": _body_projected_gravity_b,
    "body_state_b": _body_state_b,
    "last_action": lambda env: given("last_action"),
    "generated_commands": _generated_commands,
    "current_time_s": lambda env: op("mul", given("steps"), [env.step_dt]),
    "remaining_time_s": lambda env: op(
        "mul", op("sub", [float(env.max_episode_length)], given("steps")), [env.step_dt]
    ),
    "sensor_data": _sensor,
    "imu_orientation": _sensor,
    "imu_projected_gravity": lambda env, entity, sensors: op("unrotate", _sensor(env, entity, sensors), _down(entity)),
    "imu_ang_vel": _sensor,
    "imu_lin_acc": _sensor,
    "foot_height": _foot_height,
    "ee_pos": _ee_pos,
    "ee_frame_pos": _ee_pos,
    "ee_quat": _ee_quat,
    "ee_velocity": _ee_velocity,
    "object_position_in_robot_root_frame": _object_position,
    "object_quat_b": _object_quat,
    "rel_ee_object_distance": _ee_to_object,
    "ee_to_object_distance": lambda env, entity, sites, object: op(
        "unrotate", _root_quat(entity), _ee_to_object(env, entity, sites, object)
    ),
}


# --- action terms, by the names of their classes ---


def _scaled(action: Any, columns: list[int]) -> Formula:
    scale = torch.as_tensor(action._scale, dtype=torch.float32).expand(action.size)
    return op("mul", given("action", columns), numbers(scale))


def _clipped(action: Any, value: Formula) -> Formula:
    if action._clip is None:
        return value
    low, high = (bound.nan_to_num(posinf=3e38, neginf=-3e38) for bound in action._clip)
    return op("clip", value, numbers(low), numbers(high))


def _relative(action: Any, columns: list[int]) -> Formula:
    positions = field("qpos", _joints(action.entity, action.joints)[0])
    return _clipped(action, op("add", positions, _scaled(action, columns)))


def _to_limits(action: Any, columns: list[int]) -> Formula:
    low, high = action.entity.data.soft_joint_pos_limits[action.joints].unbind(-1)
    raw = _scaled(action, columns)
    if not action.rescale_to_limits:
        ends = (bound.nan_to_num(posinf=3e38, neginf=-3e38) for bound in (low, high))
        return _clipped(action, op("clip", raw, *map(numbers, ends)))
    stretched = op("mul", op("clip", raw, [-1.0], [1.0]), numbers(high - low))
    total = op("add", op("add", stretched, numbers(high)), numbers(low))
    return _clipped(action, op("mul", [0.5], total))


def _binary(action: Any, columns: list[int]) -> Formula:
    return op(
        "below", given("action", columns), [float(action.threshold)], numbers(action._close), numbers(action._open)
    )


def _affine(action: Any, columns: list[int]) -> Formula:
    return given("command", columns)


_ACTIONS: Mapping[str, Callable[[Any, list[int]], Formula]] = {
    "JointEffort": _affine,
    "JointPosition": _affine,
    "JointVelocity": _affine,
    "RelativeJointPosition": _relative,
    "JointPositionToLimits": _to_limits,
    "BinaryJointPosition": _binary,
    "BinaryJointVelocity": _binary,
}
