"""Types of the parameters of terms: the environment, and the objects that terms receive for the names in the YAML.

A parameter's default is a name (`entity: Entity = "robot"`), but the function body uses the object with that name. Each
type is therefore `Any | CLASS`: `Any` allows the default, and a type checker uses the class for the body. The types are
strings, so that importing this module imports no environment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.envs import managed, vec_env
    from rlcli.managers.command import CommandTerm
    from rlcli.scene import camera, entity, sensors

ManagedEnv: TypeAlias = "managed.ManagedEnv"
VecEnv: TypeAlias = "vec_env.VecEnv"
Entity: TypeAlias = "Any | entity.Entity"
ContactSensor: TypeAlias = "Any | sensors.ContactSensor"
RaySensor: TypeAlias = "Any | sensors.RaySensor"
CameraSensor: TypeAlias = "Any | camera.CameraSensor"
Command: TypeAlias = "Any | CommandTerm"
Address: TypeAlias = "Any | Tensor"
"""Setting that a curriculum changes, written in YAML as `rewards.NAME.weight` and the like."""
