"""Actuator models: what drives joints is computed between two physics steps, from targets and the joints' state.

MuJoCo's own actuators need none of this: they run inside one engine call for a whole environment step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rlcli.config.schema import ActuatorConfig
from rlcli.random import stream
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem, match, match_values
from rlcli.sim.column_views import as_index
from rlcli.sim.selection import Selection
from rlcli.sim.tensor_state import require_in_range

POSITION, VELOCITY, EFFORT = range(3)
"""Rows of the targets of a joint."""
_ROW = {"position": POSITION, "velocity": VELOCITY, "motor": EFFORT}


class ActuatorModel:
    """A PD controller, or a DC motor under one, on some joints of an entity in every environment.

    effort = stiffness x (position target - position) + damping x (velocity target - velocity) + effort target, then
    within the effort limit; of a DC motor also within saturation x (+-1 - velocity / velocity limit), the line between
    its stall torque and its no-load speed.
    """

    def __init__(self, name: str, config: ActuatorConfig, entity: Entity) -> None:
        self.name = name
        self.entity = entity
        self.config = config
        engine = entity.engine
        n, device = engine.num_envs, engine.device
        self.joints = match(config.joints, entity.joint_names, "joint")
        """Joint columns, in the order written."""
        names = [entity.joint_names[j] for j in self.joints]
        motors = dict(entity.actuators_of("motor"))
        controls = [motors[j] for j in self.joints]
        self._gear = torch.tensor(engine.model.actuator_gear[controls, 0], dtype=torch.float32, device=device)
        self._qpos, self._qvel, self._ctrl = engine.field("qpos"), engine.field("qvel"), engine.field("ctrl")
        self._qpos_columns = as_index(entity.qpos_columns[self.joints].tolist(), device)
        self._dof_columns = as_index(entity.dof_columns[self.joints].tolist(), device)
        self._controls = as_index(controls, device)
        k = len(self.joints)
        self.stiffness = _by_joint(config.stiffness, names, device).expand(n, -1).clone()
        """(num_envs, k) [N/m or N m/rad]"""
        self.damping = _by_joint(config.damping, names, device).expand(n, -1).clone()
        """(num_envs, k) [N s/m or N m s/rad]"""
        limit = torch.inf if config.effort_limit is None else config.effort_limit
        self.effort_limit = _by_joint(limit, names, device).expand(n, -1).clone()
        """(num_envs, k) [N or N m]"""
        self._stall, self._fastest = config.saturation_effort, config.velocity_limit
        self.targets = torch.zeros(n, 3, k, device=device)
        """Position, velocity and effort that are asked of each joint. (num_envs, 3, k)"""
        self.computed_effort = torch.zeros(n, k, device=device)
        """What the controller asked for in the last substep, before limits. (num_envs, k) [N or N m]"""
        self.applied_effort = torch.zeros(n, k, device=device)
        """What reached the joints. (num_envs, k) [N or N m]"""
        default = entity.data.default_joint_pos[:, self.joints]
        self._start = torch.stack([default, torch.zeros_like(default), torch.zeros_like(default)], dim=1)
        self._stream = stream(f"scene.entities.{entity.name}.actuators.{name}")
        low, high = config.delay
        self._low, self._options = low, high - low + 1
        self._frames = torch.zeros(n, high + 1, 3, k, device=device) if high else None
        self._lag = torch.zeros(n, dtype=torch.int64, device=device)
        self._fresh = torch.ones(n, dtype=torch.bool, device=device)

    def compute(self) -> None:
        """Write the efforts of the coming physics step."""
        position, velocity = self._qpos[:, self._qpos_columns].float(), self._qvel[:, self._dof_columns].float()
        target = self.targets if self._frames is None else self._delayed(self._frames)
        torch.mul(self.stiffness, target[:, POSITION] - position, out=self.computed_effort)
        self.computed_effort.addcmul_(self.damping, target[:, VELOCITY] - velocity).add_(target[:, EFFORT])
        low, high = -self.effort_limit, self.effort_limit
        if self._stall is not None and self._fastest is not None:
            most = self._fastest * (1.0 + self.effort_limit / self._stall)  # beyond it the two limits do not meet
            speed = velocity.clamp(-most, most) * (self._stall / self._fastest)
            low, high = torch.maximum(low, -self._stall - speed), torch.minimum(high, self._stall - speed)
        self.applied_effort.copy_(self.computed_effort.clamp(low, high))
        self._ctrl[:, self._controls] = (self.applied_effort / self._gear).to(self._ctrl.dtype)

    def reset(self, selection: Selection) -> None:
        """New episodes begin: hold the default pose, draw the delay."""
        selection.write(self.targets, selection.read_view(self._start))
        selection.write(self.computed_effort, 0.0)
        selection.write(self.applied_effort, 0.0)
        selection.write(self._fresh, True)
        if self._frames is not None:
            selection.write(self._lag, selection.stream(self._stream).choice(self._options) + self._low)

    def state_dict(self) -> dict[str, Tensor]:
        """What it carries from step to step."""
        return {name: tensor.clone() for name, tensor in self._tensors().items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        if self._frames is not None:
            require_in_range(state["lag"], 0, self._frames.shape[1] - 1, "lag")
        for name, tensor in self._tensors().items():
            tensor.copy_(state[name])

    def _delayed(self, frames: Tensor) -> Tensor:
        """The targets of `lag` physics steps ago; in an episode's first steps its first ones. (num_envs, 3, k)"""
        now = self.targets[:, None]
        frames.copy_(torch.where(self._fresh[:, None, None, None], now, torch.cat([frames[:, 1:], now], dim=1)))
        self._fresh.zero_()
        seen = (frames.shape[1] - 1 - self._lag)[:, None, None, None].expand(-1, 1, *frames.shape[2:])
        return frames.gather(1, seen)[:, 0]

    def _tensors(self) -> dict[str, Tensor]:
        own = {
            "targets": self.targets,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "effort_limit": self.effort_limit,
            "computed_effort": self.computed_effort,
            "applied_effort": self.applied_effort,
            "fresh": self._fresh,
        }
        return own if self._frames is None else {**own, "frames": self._frames, "lag": self._lag}


class JointCommand:
    """Writes commands of one kind to some joints, whether MuJoCo's actuators or an actuator model drive them.

    Args:
        entity: the robot.
        kind: motor (efforts), position or velocity.
        columns: joint columns, in the order of the commands.

    Raises:
        NameProblem: for a joint that nothing of this kind drives.
    """

    def __init__(self, entity: Entity, kind: str, columns: Sequence[int]) -> None:
        model, device = entity.engine.model, entity.engine.device
        by_model = {j: (m, i) for m in entity.actuators for i, j in enumerate(m.joints)}
        driven = dict(entity.actuators_of(kind))
        missing = [entity.joint_names[c] for c in columns if c not in by_model and c not in driven]
        if missing:
            raise NameProblem(f"no {kind} actuator drives {', '.join(missing)}")
        native = [i for i, c in enumerate(columns) if c not in by_model]
        self.actuators = [None if c in by_model else driven[c] for c in columns]
        """MuJoCo's actuator behind each column; None where a model drives the joint."""
        self.sinks = [f"{entity.name}/{entity.joint_names[c]} {kind}" if c in by_model else driven[c] for c in columns]
        """What each column writes to, so that two terms that write to the same are found."""
        controls = [driven[columns[i]] for i in native]
        gear = torch.tensor(model.actuator_gear[controls, 0], dtype=torch.float32, device=device)
        self._factor = (1.0 / gear if kind == "motor" else gear) if bool((gear != 1.0).any()) else None
        self._ctrl = entity.engine.field("ctrl")
        self._from, self._to = as_index(native, device), as_index(controls, device)
        self._takes_all = len(native) == len(columns)
        # consecutive controls: a view of the engine's own, made once
        self._target = self._ctrl[:, self._to] if native and isinstance(self._to, slice) else None
        self._models = []
        for m in dict.fromkeys(m for m, _ in by_model.values()):
            pairs = [(i, by_model[c][1]) for i, c in enumerate(columns) if c in by_model and by_model[c][0] is m]
            if pairs:
                given, taken = (as_index(part, device) for part in zip(*pairs, strict=True))
                self._models.append((m.targets[:, _ROW[kind]], given, taken))
        self._native = bool(native)

    def write(self, command: Tensor) -> None:
        """Set what is asked from now on. (num_envs, columns)"""
        if self._native:
            own = command if self._takes_all else command[:, self._from]
            own = own if self._factor is None else own * self._factor
            if self._target is not None:
                self._target.copy_(own)
            else:
                self._ctrl[:, self._to] = own.to(self._ctrl.dtype)
        for targets, given, taken in self._models:
            targets[:, taken] = command[:, given]


def _by_joint(value: float | Mapping[str, float], names: Sequence[str], device: torch.device) -> Tensor:
    """A number for each joint; of a mapping, by name or regex. (k,)

    Raises:
        NameProblem: where a mapping leaves a joint out, or names one that is not there.
    """
    if isinstance(value, float | int):
        return torch.full((len(names),), float(value), device=device)
    values = match_values(value, names, "joint")
    if None in values:
        raise NameProblem(f"no value for joint '{names[values.index(None)]}'")
    return torch.tensor(values, dtype=torch.float32, device=device)
