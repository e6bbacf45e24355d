"""Default state of an entity: its joints and its root, from the MJCF and the entity's configuration."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from rlcli.scene.names import NameProblem, match

if TYPE_CHECKING:
    from rlcli.scene.entity import Entity


def default_joint_state(entity: Entity) -> tuple[Tensor, Tensor]:
    """Return default joint positions and velocities: the MJCF's qpos0, overridden by the entity's `init`. (k,), (k,)

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


def default_root_state(entity: Entity) -> Tensor:
    """Return the default root pose and velocity, from the MJCF and the entity's configuration. (13,)

    Raises:
        NameProblem: if `init` has a velocity and the root is fixed.
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
        raise NameProblem(f"entity '{entity.name}' has no free joint at its root", "remove lin_vel and ang_vel")
    return torch.tensor([*pose, *velocity], dtype=torch.float32)
