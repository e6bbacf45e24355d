"""Default state of an entity, to which resets return (positions and velocities of joints and root); speed limits.

The values come from the MJCF and from the configuration (`init`, `pos`, `quat`, `velocity_limit`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rlcli.scene.joint_and_actuator_setup import joint_settings
from rlcli.scene.names import NameProblem, match, match_values

if TYPE_CHECKING:
    from rlcli.scene.entity import Entity


def default_joint_state(entity: Entity) -> tuple[Tensor, Tensor]:
    """Return the default positions [m or rad] and velocities [m/s or rad/s] of an entity's joints. (k,), (k,)

    They are the MJCF's qpos0 and 0, overridden by the entity's `init`.

    Raises:
        NameProblem: if `init` names a joint that the model does not have.
    """
    position = torch.tensor(entity.engine.model.qpos0[entity.qpos_columns.cpu().numpy()], dtype=torch.float32)
    velocity = torch.zeros_like(position)
    init = entity.config.init
    for values, target in ((init.joint_pos, position), (init.joint_vel, velocity)):
        for pattern, value in values.items():
            target[match(pattern, entity.joint_names, "joint")] = value
    return position, velocity


def joint_speed_limits(entity: Entity) -> Tensor:
    """Return the speed limit of each joint; infinite for a joint without a limit. (k,) [m/s or rad/s]

    The limit is `velocity_limit` of the joint, or else that of its actuator model.
    """
    names, config = entity.joint_names, entity.config
    limits = torch.full((len(names),), torch.inf)
    for motor in config.actuators.values():
        if motor.velocity_limit is not None:
            with contextlib.suppress(NameProblem):  # building the actuator model reports the problem
                joints = match(motor.joints, names, "joint")
                limits[joints] = values_by_joint(motor.velocity_limit, [names[j] for j in joints])
    for joint, name in enumerate(names):
        limits[joint] = joint_settings(config, name).velocity_limit or limits[joint]
    return limits


def values_by_joint(value: float | Mapping[str, float], names: Sequence[str]) -> Tensor:
    """Return the value of each joint in `names`. (k,)

    `value` is one value for all joints, or a mapping from names or regular expressions to values.

    Raises:
        NameProblem: if the mapping has no value for a joint, or a key that matches no joint.
    """
    if isinstance(value, float | int):
        return torch.full((len(names),), float(value))
    values = match_values(value, names, "joint")
    if None in values:
        message = f"no value for joint '{names[values.index(None)]}'; add its name, or a pattern that matches the name"
        raise NameProblem(message)
    return torch.tensor(values, dtype=torch.float32)


def default_root_state(entity: Entity) -> Tensor:
    """Return the default pose and velocity of the root, world frame. (13,)

    The numbers are position [m], quaternion (w, x, y, z), linear velocity [m/s] and angular velocity [rad/s].

    Raises:
        NameProblem: if `init` has a velocity of the root, but the root has no free joint.
    """
    model = entity.engine.model
    if entity.root_qpos is not None:
        pose = model.qpos0[entity.root_qpos : entity.root_qpos + 7]
    elif not entity.root_body:  # the entity has no body, only geoms of the world
        pose = np.concatenate([entity.config.pos or np.zeros(3), entity.config.quat or [1.0, 0.0, 0.0, 0.0]])
    else:
        body = entity.root_body
        pose = np.concatenate([model.body_pos[body], model.body_quat[body]])
    velocity = [*entity.config.init.lin_vel, *entity.config.init.ang_vel]
    if entity.root_qpos is None and any(velocity):
        raise NameProblem(f"entity '{entity.name}' has no free joint at its root", "remove lin_vel and ang_vel of init")
    return torch.tensor([*pose, *velocity], dtype=torch.float32)
