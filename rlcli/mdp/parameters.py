"""Types of the objects that the terms of this package receive for names. No terms.

As in `rlcli.task`, a default is the name ("robot") and the function body uses the object, so each is `Any` as well;
beside it stands the object's class, by which a type checker checks the body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.managers.command import CommandTerm
    from rlcli.scene import camera, entity, sensors

Entity: TypeAlias = "Any | entity.Entity"
ContactSensor: TypeAlias = "Any | sensors.ContactSensor"
RaySensor: TypeAlias = "Any | sensors.RaySensor"
CameraSensor: TypeAlias = "Any | camera.CameraSensor"
Command: TypeAlias = "Any | CommandTerm"
Address: TypeAlias = "Any | Tensor"
