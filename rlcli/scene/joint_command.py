"""Writer of commands for joints, to MuJoCo's own actuators or to actuator models."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rlcli.scene.actuators import EFFORT, POSITION, VELOCITY
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem
from rlcli.sim.column_views import as_index

_ROW = {"position": POSITION, "velocity": VELOCITY, "motor": EFFORT}


class JointCommand:
    """Writer of an action term's commands (efforts, positions or velocities) to some joints of a robot.

    The joints are driven by MuJoCo's own actuators or by actuator models of the configuration.

    Args:
        entity: the robot.
        kind: motor (efforts), position or velocity.
        columns: indices of the joints in the robot, in the order of the commands.

    Raises:
        NameProblem: for a joint without an actuator of this kind.
    """

    def __init__(self, entity: Entity, kind: str, columns: Sequence[int]) -> None:
        model, device = entity.engine.model, entity.engine.device
        modelled = {joint for actuator in entity.actuators for joint in actuator.joints}
        native = dict(entity.actuators_of(kind))
        missing = [entity.joint_names[c] for c in columns if c not in modelled and c not in native]
        if missing:
            raise NameProblem(f"no {kind} actuator drives {', '.join(missing)}; set actuator: {kind} in scene.entities")
        self.actuators = [None if c in modelled else native[c] for c in columns]
        """Id of the MuJoCo actuator of each column; None where an actuator model drives the joint."""
        self.sinks = [f"{entity.name}/{entity.joint_names[c]} {kind}" if c in modelled else native[c] for c in columns]
        """Actuator or joint to which each column writes; two action terms must not write to the same one."""
        sources = [i for i, c in enumerate(columns) if c not in modelled]
        controls = [native[columns[i]] for i in sources]
        gear = torch.tensor(model.actuator_gear[controls, 0], dtype=torch.float32, device=device)
        self._factor = (1.0 / gear if kind == "motor" else gear) if bool((gear != 1.0).any()) else None
        self._ctrl = entity.engine.field("ctrl")
        self._sources, self._controls = as_index(sources, device), as_index(controls, device)
        self._has_native = bool(sources)
        self._all_native = len(sources) == len(columns)
        # consecutive controls: a view of the engine's field, made once
        self._view = self._ctrl[:, self._controls] if sources and isinstance(self._controls, slice) else None
        self._model_targets = []
        for actuator in entity.actuators:
            pairs = [(i, actuator.joints.index(c)) for i, c in enumerate(columns) if c in actuator.joints]
            if pairs:
                from_columns, to_joints = (as_index(part, device) for part in zip(*pairs, strict=True))
                self._model_targets.append((actuator.targets[:, _ROW[kind]], from_columns, to_joints))

    def write(self, command: Tensor) -> None:
        """Set the commands of the joints, which hold until the next call. command (num_envs, columns)

        Commands are efforts [N or N m], positions [m or rad] or velocities [m/s or rad/s], by the constructor's `kind`.
        """
        if self._has_native:
            own = command if self._all_native else command[:, self._sources]
            own = own if self._factor is None else own * self._factor
            if self._view is not None:
                self._view.copy_(own)
            else:
                self._ctrl[:, self._controls] = own.to(self._ctrl.dtype)
        for targets, from_columns, to_joints in self._model_targets:
            targets[:, to_joints] = command[:, from_columns]
