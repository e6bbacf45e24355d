"""Formulas of observation and action terms, with which a program without rlcli computes observations and controls.

A formula is data for JSON. A program evaluates the formula with the values of an MjData; every value is a row of
float32. A formula is one of these:

- A list of numbers.
- `{"field": NAME, "at": [...]}`: elements of a flattened field of MjData.
- `{"given": NAME, "at": [...]}`: elements of an input. Inputs are `last_action`, `steps` (of the episode),
  `command/NAME` (a command of the task, such as a target velocity), `observation/NAME` (the value of an observation
  term without a formula), `target/NAME` (the target of an action term, for actuator models), and the policy's outputs
  `action` (raw) and `command` (with scale, offset and limits).
- `{"op": NAME, "of": [formulas]}`: an operation; `deployed/run_policy.py` implements all of them.

A term without a formula can only be computed by its own code.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.managers.command import CommandTerm
from rlcli.managers.term_binding import BoundTerm
from rlcli.mdp import actions, observations
from rlcli.mdp.term_helpers import column_numbers
from rlcli.scene.entity import Entity
from rlcli.sim.env_selection import Columns

Formula = Any


class NoFormula(Exception):
    """Error for a term that depends on values that MjData does not contain, so that it has no formula."""


def observation_formula(env: VecEnv, term: BoundTerm) -> Formula | None:
    """Return the formula of an observation term, without its modifiers, clip and scale; None if no formula exists."""
    function = getattr(term.call, "func", None)
    make = _OBSERVATIONS.get(getattr(function, "__name__", "")) if _is_defined_in(observations, function) else None
    if make is None:
        return None
    try:
        return make(env, **term.call.keywords)  # type: ignore[attr-defined]
    except NoFormula:
        return None


def control_formula(env: VecEnv, term: BoundTerm, columns: tuple[int, int]) -> tuple[list[int], Formula] | None:
    """Return the indices in `MjData.ctrl` that an action term writes, and the formula of their values.

    At a joint with an actuator model the value is the model's target, and the model computes the control from it.
    Return None if the term has no formula.

    Args:
        env: the environment.
        term: the action term.
        columns: first column of the term in the policy's action, and the column after the term's last column.
    """
    action = term.instance
    make = _ACTIONS.get(type(action).__name__) if _is_defined_in(actions, type(action)) else None
    if make is None:
        return None
    value = make(action, list(range(*columns)))
    motors = {joint: ctrl for m in action.entity.actuators for joint, ctrl in zip(m.joints, m.controls, strict=True)}
    driven = column_numbers(action.joints, len(action.entity.joint_names))
    ctrl = [motors[joint] if own is None else own for joint, own in zip(driven, action.actuators, strict=True)]
    gear = torch.tensor(env.engine.model.actuator_gear[ctrl, 0], dtype=torch.float32)
    factor = 1.0 / gear if action.actuator == "motor" else gear
    factor[[native is None for native in action.actuators]] = 1.0
    return ctrl, op("mul", value, numbers(factor)) if bool((factor != 1.0).any()) else value


def field(name: str, at: Any) -> Formula:
    """Return the formula for the elements `at` of the flattened field `name` of MjData."""
    return {"field": name, "at": [int(i) for i in at]}


def given(name: str, at: Any = None) -> Formula:
    """Return the formula for the input `name`, such as `action`, or for its elements `at`."""
    return {"given": name} if at is None else {"given": name, "at": [int(i) for i in at]}


def op(name: str, *of: Formula) -> Formula:
    """Return the formula for the operation `name`, such as `add`, applied to the formulas `of`."""
    return {"op": name, "of": list(of)}


def numbers(values: Tensor) -> Formula:
    """Return the formula for constant values."""
    return [float(value) for value in values.detach().cpu().float().flatten().tolist()]


def _is_defined_in(module: Any, function: Any) -> bool:
    """Return whether a module of rlcli defines this function or class; a task may define another of the same name."""
    return bool(getattr(function, "__module__", None) == module.__name__)


# --- parts of formulas ---


def _shared(values: Tensor) -> Formula:
    """Return the constant formula for a quantity that is equal in all environments. (num_envs, k)

    Raises:
        NoFormula: if the quantity differs between environments.
    """
    if not bool((values == values[:1]).all()):
        raise NoFormula
    return numbers(values[0])


def _joint_field(entity: Entity, name: str, joints: Columns) -> Formula:
    """Return the formula for the elements of some joints in `name`: qpos, or a field with one element for each dof."""
    return field(name, (entity.qpos_columns if name == "qpos" else entity.dof_columns)[joints].tolist())


def _selected(ids: np.ndarray, columns: Columns) -> list[int]:
    """Return the ids in the model of the bodies, sites or sensors that `columns`, an index into `ids`, selects."""
    return torch.from_numpy(ids)[columns if isinstance(columns, slice) else columns.cpu()].tolist()


def _row_of(name: str, number: int, width: int, begin: int = 0, count: int | None = None) -> Formula:
    """Return the formula for row `number` of a field (n, width), or for `count` of its elements from `begin` on."""
    start = number * width + begin
    return field(name, range(start, start + (width if count is None else count)))


def _root(entity: Entity, name: str, start: int, stop: int, default: int) -> Formula:
    """Return the formula for the elements `start` to `stop` - 1 of the root's part of `name`, qpos or qvel.

    A fixed root has constants instead: the values of its default state from index `default` on.
    """
    address = entity.root_qpos if name == "qpos" else entity.root_dof
    if address is None:
        return numbers(entity.data.default_root_state[0, default : default + stop - start])
    return field(name, range(address + start, address + stop))


def _root_pos(entity: Entity) -> Formula:
    return _row_of("mocap_pos", entity.mocap, 3) if entity.mocap >= 0 else _root(entity, "qpos", 0, 3, 0)


def _root_quat(entity: Entity) -> Formula:
    return _row_of("mocap_quat", entity.mocap, 4) if entity.mocap >= 0 else _root(entity, "qpos", 3, 7, 3)


def _root_lin_vel_w(entity: Entity) -> Formula:
    velocity = _root(entity, "qvel", 0, 3, 7)
    if entity.config.velocity_point == "origin" or not entity.is_floating:
        return velocity
    if entity.engine.expanded("body_ipos") is not None:  # the centre of mass differs between environments
        raise NoFormula
    com = numbers(torch.tensor(entity.engine.model.body_ipos[entity.root_body]))
    return op("add", velocity, op("rotate", _root_quat(entity), op("cross", _root_ang_vel_b(entity), com)))


def _root_ang_vel_b(entity: Entity) -> Formula:
    return _root(entity, "qvel", 3, 6, 10)


def _down(entity: Entity) -> Formula:
    """Return the formula for the unit vector of gravity in the world frame."""
    if entity.engine.expanded("opt.gravity") is not None:  # gravity differs between environments
        raise NoFormula
    return _shared(entity.data.down_w)


def _require_no_terrain(env: VecEnv) -> None:
    """Check that an environment has no terrain, so that its origin, to which positions relate, is the world's origin.

    Raises:
        NoFormula: if the environment has a terrain.
    """
    if env.terrain is not None:
        raise NoFormula


def _velocity_at(entity: Entity, body: int, point: Formula) -> Formula:
    """Return the formula for the velocity of a point of a body in the world frame.

    MjData's `cvel` is [angular, linear] velocity at the centre of mass of the body's kinematic tree.
    """
    root = int(entity.engine.model.body_rootid[body])
    arm = op("sub", point, _row_of("subtree_com", root, 3))
    return op("add", _row_of("cvel", body, 6, 3, 3), op("cross", _row_of("cvel", body, 6, 0, 3), arm))


def _concatenated(*formulas: Formula) -> Formula:
    return formulas[0] if len(formulas) == 1 else op("cat", *formulas)


# --- observation terms, by the names of their functions ---


def _joint_angle_sum(env: VecEnv, entity: Entity, joints: Columns) -> Formula:
    qpos = _joint_field(entity, "qpos", joints)
    return op("wrap", op("dot", qpos, [1.0] * len(qpos["at"])))


def _joint_pos_limit_normalized(env: VecEnv, entity: Entity, joints: Columns) -> Formula:
    if entity.engine.expanded("jnt_range") is not None:  # the limits differ between environments
        raise NoFormula
    low, high = entity.data.soft_joint_pos_limits[joints].unbind(dim=1)
    limited = high - low < torch.inf
    low, high = torch.where(limited, low, 0.0), torch.where(limited, high, 1.0)
    twice = op("mul", [2.0], _joint_field(entity, "qpos", joints))
    # (2 q - low - high) / (high - low) in the order of the term's own code, so that both round alike
    scaled = op("div", op("sub", op("sub", twice, numbers(low)), numbers(high)), numbers(high - low))
    return scaled if bool(limited.all()) else op("mul", scaled, numbers(limited))


def _root_pos_w(env: VecEnv, entity: Entity) -> Formula:
    _require_no_terrain(env)
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


def _heading_and_path(env: VecEnv, entity: Entity, target: Iterable[float]) -> tuple[Formula, Formula]:
    """Return the formulas of the root's forward axis and of the vector from the root to `target`, both (x, y)."""
    _require_no_terrain(env)
    point = [float(value) for value in target][:2]
    path = op("sub", point, op("take", _root_pos(entity), [0.0, 1.0]))
    return op("take", op("rotate", _root_quat(entity), [1.0, 0.0, 0.0]), [0.0, 1.0]), path


def _base_heading_proj(env: VecEnv, entity: Entity, target: Iterable[float]) -> Formula:
    heading, path = _heading_and_path(env, entity, target)
    return op("div", op("dot", heading, path), op("sqrt", op("dot", path, path)))


def _base_angle_to_target(env: VecEnv, entity: Entity, target: Iterable[float]) -> Formula:
    heading, path = _heading_and_path(env, entity, target)
    return op("wrap", op("sub", op("angle", path), op("angle", heading)))


def _body_pose_w(env: VecEnv, entity: Entity, bodies: Columns) -> Formula:
    _require_no_terrain(env)
    poses = ((_row_of("xpos", b, 3), _row_of("xquat", b, 4)) for b in _selected(entity.body_ids, bodies))
    return _concatenated(*(part for pose in poses for part in pose))


def _body_projected_gravity_b(env: VecEnv, entity: Entity, bodies: Columns) -> Formula:
    down, ids = _down(entity), _selected(entity.body_ids, bodies)
    return _concatenated(*(op("unrotate", _row_of("xquat", b, 4), down) for b in ids))


def _body_state_b(env: VecEnv, entity: Entity, bodies: Columns) -> Formula:
    root, parts = _root_quat(entity), []
    point = "xpos" if entity.config.velocity_point == "origin" else "xipos"
    for b in _selected(entity.body_ids, bodies):
        parts += [
            op("unrotate", root, op("sub", _row_of("xpos", b, 3), _root_pos(entity))),
            op("product", op("inverse", root), _row_of("xquat", b, 4)),
            op("unrotate", root, _velocity_at(entity, b, _row_of(point, b, 3))),
            op("unrotate", root, _row_of("cvel", b, 6, 0, 3)),
        ]
    return op("cat", *parts)


def _sensor(env: VecEnv, entity: Entity, sensors: Columns) -> Formula:
    return field("sensordata", _selected(np.arange(entity.engine.model.nsensordata), sensors))


def _site_pos(env: VecEnv, entity: Entity, sites: Columns, axes: Iterable[int] = (0, 1, 2)) -> Formula:
    _require_no_terrain(env)
    return field("site_xpos", [3 * s + axis for s in _selected(entity.site_ids, sites) for axis in axes])


def _ee_quat(env: VecEnv, entity: Entity, sites: Columns, make_quat_unique: bool = True) -> Formula:
    model, quats = entity.engine.model, []
    for site in _selected(entity.site_ids, sites):
        # MjData has the orientation of a site only as a matrix: multiply the quaternions of body and site
        body_quat = _row_of("xquat", int(model.site_bodyid[site]), 4)
        quats.append(op("product", body_quat, numbers(torch.tensor(model.site_quat[site]))))
    return _concatenated(*(op("unique", q) if make_quat_unique else q for q in quats))


def _ee_velocity(env: VecEnv, entity: Entity, sites: Columns) -> Formula:
    body, ids = entity.engine.model.site_bodyid, _selected(entity.site_ids, sites)
    velocities = [_velocity_at(entity, int(body[s]), _row_of("site_xpos", s, 3)) for s in ids]
    return _concatenated(*(op("unrotate", _root_quat(entity), velocity) for velocity in velocities))


def _object_position(env: VecEnv, entity: Entity, object: Entity) -> Formula:
    return op("unrotate", _root_quat(entity), op("sub", _root_pos(object), _root_pos(entity)))


def _object_quat(env: VecEnv, entity: Entity, object: Entity) -> Formula:
    return op("product", op("inverse", _root_quat(entity)), _root_quat(object))


def _ee_to_object(env: VecEnv, entity: Entity, sites: Columns, object: Entity) -> Formula:
    (site,) = _selected(entity.site_ids, sites)
    return op("sub", _root_pos(object), _row_of("site_xpos", site, 3))


def _generated_commands(env: VecEnv, command: CommandTerm, columns: list[int] | None) -> Formula:
    terms = getattr(env, "command_manager").terms  # noqa: B009 (only manager-based environments have commands)
    whole = given(next(f"command/{term.name}" for term in terms if term.instance is command))
    return whole if columns is None else op("take", whole, [float(column) for column in columns])


def _body_to_goal(
    env: VecEnv, entity: Entity, bodies: Columns, command: CommandTerm, columns: list[int] | None
) -> Formula:
    (body,) = _selected(entity.body_ids, bodies)
    goal = _generated_commands(env, command, [0, 1, 2])
    place = op("unrotate", _root_quat(entity), op("sub", _row_of("xpos", body, 3), _root_pos(entity)))
    offset = op("sub", goal, place)
    return offset if columns is None else op("take", offset, [float(column) for column in columns])


_OBSERVATIONS: Mapping[str, Callable[..., Formula]] = {
    "joint_pos": lambda env, entity, joints: _joint_field(entity, "qpos", joints),
    "joint_vel": lambda env, entity, joints: _joint_field(entity, "qvel", joints),
    "joint_pos_rel": lambda env, entity, joints: op(
        "sub", _joint_field(entity, "qpos", joints), _shared(entity.data.default_joint_pos[:, joints])
    ),
    "joint_vel_rel": lambda env, entity, joints: op(
        "sub", _joint_field(entity, "qvel", joints), _shared(entity.data.default_joint_vel[:, joints])
    ),
    "joint_angle": lambda env, entity, joints: op("wrap", _joint_field(entity, "qpos", joints)),
    "joint_angle_sum": _joint_angle_sum,
    "joint_pos_limit_normalized": _joint_pos_limit_normalized,
    "joint_effort": lambda env, entity, joints: _joint_field(entity, "qfrc_actuator", joints),
    "base_pos_z": lambda env, entity: op("take", _root_pos_w(env, entity), [2.0]),
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
    "body_to_goal": _body_to_goal,
    "current_time_s": lambda env: op("mul", given("steps"), [env.step_dt]),
    "remaining_time_s": lambda env: op(
        "mul", op("sub", [float(env.max_episode_length)], given("steps")), [env.step_dt]
    ),
    **dict.fromkeys(("sensor_data", "imu_orientation", "imu_ang_vel", "imu_lin_acc"), _sensor),
    "imu_projected_gravity": lambda env, entity, sensors: op("unrotate", _sensor(env, entity, sensors), _down(entity)),
    "foot_height": lambda env, entity, sites: _site_pos(env, entity, sites, [2]),
    **dict.fromkeys(("ee_pos", "ee_frame_pos"), _site_pos),
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
    positions = _joint_field(action.entity, "qpos", action.joints)
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
    closed, opened = numbers(action._close), numbers(action._open)
    return op("below", given("action", columns), [float(action.threshold)], closed, opened)


_ACTIONS: Mapping[str, Callable[[Any, list[int]], Formula]] = {
    # the policy's output `command` already has scale, offset and limits of these terms
    **dict.fromkeys(
        ("JointEffort", "JointPosition", "JointVelocity"), lambda action, columns: given("command", columns)
    ),
    "RelativeJointPosition": _relative,
    "JointPositionToLimits": _to_limits,
    **dict.fromkeys(("BinaryJointPosition", "BinaryJointVelocity"), _binary),
}
