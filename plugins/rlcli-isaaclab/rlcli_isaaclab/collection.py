"""Collections of rigid objects: each object is an entity of the scene, named COLLECTION_OBJECT."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.scene_facade import Asset
from rlcli_isaaclab.sensor_facade import find_elements


def entity_name(collection: str, item: str) -> str:
    """Return the name in rlcli's scene of one object of a collection: COLLECTION_OBJECT."""
    return f"{collection}_{item}"


class CollectionData:
    """State of a collection: `object_X` has the attribute `root_X` of all its objects. (num_envs, objects, ...)"""

    def __init__(self, objects: list[Asset]) -> None:
        self._objects = objects

    def __getattr__(self, name: str) -> Any:
        root = name.replace("object_", "root_") if "object_" in name else name
        if name.startswith("__"):
            raise AttributeError(name)
        return torch.stack([getattr(item.data, root) for item in self._objects], dim=1)


class RigidObjectCollection:
    """Collection of rigid objects: one asset that reads and writes several objects at once."""

    def __init__(self, cfg: Any, objects: dict[str, Asset]) -> None:
        self.cfg, self.object_names = cfg, list(objects)
        self._objects = list(objects.values())
        self.num_objects, self.num_instances = len(objects), self._objects[0].num_instances
        self.device, self.data = self._objects[0].device, CollectionData(self._objects)
        self.joint_names: list[str] = []
        self.body_names = self.object_names

    def find_objects(self, name_keys: Any, preserve_order: bool = False) -> Any:
        """Return (indices, names) of the objects whose names match `name_keys`, names or regexes."""
        return find_elements(name_keys, self.object_names, self.object_names, "object", preserve_order)

    def write_object_state_to_sim(self, object_state: Tensor, env_ids: Any = None, object_ids: Any = None) -> None:
        """Set poses, and velocities of the centres of mass, world frame. (rows, objects, 13)"""
        self.write_object_pose_to_sim(object_state[..., :7], env_ids, object_ids)
        self.write_object_velocity_to_sim(object_state[..., 7:], env_ids, object_ids)

    def write_object_pose_to_sim(self, object_pose: Tensor, env_ids: Any = None, object_ids: Any = None) -> None:
        """Set the poses of objects: positions [m] and quaternions (w, x, y, z), world frame. (rows, objects, 7)"""
        for item, values in self._each(object_pose, object_ids):
            item.write_root_pose_to_sim(values, env_ids)

    def write_object_velocity_to_sim(
        self, object_velocity: Tensor, env_ids: Any = None, object_ids: Any = None
    ) -> None:
        """Set velocities of the centres of mass and angular velocities, world frame. (rows, objects, 6) [m/s, rad/s]"""
        for item, values in self._each(object_velocity, object_ids):
            item.write_root_velocity_to_sim(values, env_ids)

    write_object_link_pose_to_sim, write_object_com_velocity_to_sim = (
        write_object_pose_to_sim, write_object_velocity_to_sim,
    )  # fmt: skip

    def _each(self, values: Tensor, object_ids: Any) -> list[tuple[Asset, Tensor]]:
        """Return (object, its values) for each object of `object_ids`; None: all objects.

        `values` has the shape (rows, objects, ...). Without the first dimension, the values apply to all environments.
        """
        values = values if values.dim() == 3 else values[None]
        ids = list(range(self.num_objects))
        if object_ids is not None and not isinstance(object_ids, slice):
            ids = torch.as_tensor(object_ids).tolist()
        return [(self._objects[i], values[:, column]) for column, i in enumerate(ids)]

    def reset(self, env_ids: Any = None, object_ids: Any = None) -> None:
        """Remove the forces on all objects in the environments `env_ids`; None: in all environments."""
        for item in self._objects:
            item.reset(env_ids)

    def write_data_to_sim(self) -> None:
        """Do nothing: states are written when they are set."""

    def update(self, dt: float) -> None:
        """Do nothing: data are computed when they are read."""
