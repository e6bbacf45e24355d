"""Actuator models: PD controllers and DC motors that rlcli, not MuJoCo, computes before each physics step."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from rlcli.config.schema import ActuatorConfig
from rlcli.random import stream
from rlcli.scene.entity import Entity
from rlcli.scene.initial_state import values_by_joint
from rlcli.scene.names import match
from rlcli.sim.column_views import as_index
from rlcli.sim.env_selection import Selection
from rlcli.sim.saved_tensors import TensorState, require_in_range

POSITION, VELOCITY, EFFORT = range(3)
"""Indices of the position, velocity and effort targets in the second dimension of `ActuatorModel.targets`."""
Controller = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""Controller: a function (targets, joint positions, joint velocities) -> (efforts before limits, efforts after limits).

Targets are (num_envs, 3, k), all others (num_envs, k), where k is the number of joints.
"""


class ActuatorModel(TensorState):
    """PD controller on some joints of an entity in every environment, optionally with the limits of a DC motor.

    effort = stiffness x (position target - position) + damping x (velocity target - velocity) + effort target. The
    effort is clamped to the effort limit. The effort of a DC motor is also clamped to its torque-speed curve,
    saturation effort x (+-1 - velocity / velocity limit): the line from the stall torque to the no-load speed. In
    shapes, k is the number of the model's joints.
    """

    def __init__(self, name: str, config: ActuatorConfig, entity: Entity) -> None:
        self.name = name
        self.entity = entity
        self.config = config
        engine = entity.engine
        n, device = engine.num_envs, engine.device
        self.joints = match(config.joints, entity.joint_names, "joint")
        """Indices of the joints among the entity's joints, in the order of the configuration."""
        self.columns = as_index(self.joints, device)
        """Index that selects the driven joints in tensors with one column for each joint of the entity."""
        names = [entity.joint_names[j] for j in self.joints]
        motors = dict(entity.actuators_of("motor"))
        self.controls = [motors[j] for j in self.joints]
        """Index in MuJoCo's `ctrl` of each joint's motor."""
        self._gear = torch.tensor(engine.model.actuator_gear[self.controls, 0], dtype=torch.float32, device=device)
        self._qpos, self._qvel, self._ctrl = engine.field("qpos"), engine.field("qvel"), engine.field("ctrl")
        self._qpos_columns = as_index(entity.qpos_columns[self.joints].tolist(), device)
        self._dof_columns = as_index(entity.dof_columns[self.joints].tolist(), device)
        self._controls = as_index(self.controls, device)
        k = len(self.joints)
        self.stiffness = values_by_joint(config.stiffness, names).to(device).expand(n, -1).clone()
        """Stiffness of each joint's controller. (num_envs, k) [N/m or N m/rad]"""
        self.damping = values_by_joint(config.damping, names).to(device).expand(n, -1).clone()
        """Damping of each joint's controller. (num_envs, k) [N s/m or N m s/rad]"""
        limit = torch.inf if config.effort_limit is None else config.effort_limit
        self.effort_limit = values_by_joint(limit, names).to(device).expand(n, -1).clone()
        """Effort limit of each joint. (num_envs, k) [N or N m]"""
        self._saturation_effort, speed = config.saturation_effort, config.velocity_limit
        self._velocity_limit = values_by_joint(speed, names).to(device) if isinstance(speed, Mapping) else speed
        self.controller: Controller | None = None
        """Function that replaces the PD controller and its limits; None: the PD controller."""
        self.targets = torch.zeros(n, 3, k, device=device)
        """Position, velocity and effort targets of each joint. (num_envs, 3, k)"""
        self.computed_effort = torch.zeros(n, k, device=device)
        """Efforts of the controller in the last physics step, before limits. (num_envs, k) [N or N m]"""
        self.applied_effort = torch.zeros(n, k, device=device)
        """Efforts on the joints in the last physics step, after limits. (num_envs, k) [N or N m]"""
        default = entity.data.default_joint_pos[:, self.joints]
        self._default_targets = torch.stack([default, torch.zeros_like(default), torch.zeros_like(default)], dim=1)
        self._stream = stream(f"scene.entities.{entity.name}.actuators.{name}")
        low, high = config.delay  # numbers of physics steps
        self._min_delay, self._num_delays = low, high - low + 1
        self._target_history = torch.zeros(n, high + 1, 3, k, device=device) if high else None
        """Targets of the last physics steps, the newest last. (num_envs, longest delay + 1, 3, k)"""
        self._delay = torch.zeros(n, dtype=torch.int64, device=device)
        self._is_first_step = torch.ones(n, dtype=torch.bool, device=device)

    def compute(self) -> None:
        """Compute the efforts for the next physics step and write them to the motors' controls."""
        position, velocity = self._qpos[:, self._qpos_columns].float(), self._qvel[:, self._dof_columns].float()
        target = self.targets if self._target_history is None else self._delayed_targets(self._target_history)
        if self.controller is None:
            self._compute_pd(target, position, velocity)
        else:
            computed, applied = self.controller(target, position, velocity)
            self.computed_effort.copy_(computed)
            self.applied_effort.copy_(applied)
        self._ctrl[:, self._controls] = (self.applied_effort / self._gear).to(self._ctrl.dtype)

    def _compute_pd(self, target: Tensor, position: Tensor, velocity: Tensor) -> None:
        """Compute the efforts of the PD controller. target (num_envs, 3, k), position and velocity (num_envs, k)"""
        torch.mul(self.stiffness, target[:, POSITION] - position, out=self.computed_effort)
        self.computed_effort.addcmul_(self.damping, target[:, VELOCITY] - velocity).add_(target[:, EFFORT])
        low, high = -self.effort_limit, self.effort_limit
        if self._saturation_effort is not None and self._velocity_limit is not None:
            # at higher speeds the torque-speed curve lies outside the effort limit, and low would exceed high
            max_speed = self._velocity_limit * (1.0 + self.effort_limit / self._saturation_effort)
            drop = velocity.clamp(-max_speed, max_speed) * (self._saturation_effort / self._velocity_limit)
            low = torch.maximum(low, -self._saturation_effort - drop)
            high = torch.minimum(high, self._saturation_effort - drop)
        self.applied_effort.copy_(self.computed_effort.clamp(low, high))

    def reset(self, selection: Selection) -> None:
        """Start episodes in the selected environments: the targets become the default pose, and delays are drawn."""
        selection.write(self.targets, selection.read_view(self._default_targets))
        selection.write(self.computed_effort, 0.0)
        selection.write(self.applied_effort, 0.0)
        selection.write(self._is_first_step, True)
        if self._target_history is not None:
            selection.write(self._delay, selection.stream(self._stream).choice(self._num_delays) + self._min_delay)

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""
        if self._target_history is not None:
            require_in_range(state["lag"], 0, self._target_history.shape[1] - 1, "lag")
        super().load_state_dict(state)

    def _delayed_targets(self, history: Tensor) -> Tensor:
        """Return the targets from `delay` physics steps ago, or the first targets of the episode. (num_envs, 3, k)

        `history` has the targets of the last steps. (num_envs, longest delay + 1, 3, k)
        """
        now = self.targets[:, None]
        # the first step of an episode fills the whole history
        is_first = self._is_first_step[:, None, None, None]
        history.copy_(torch.where(is_first, now, torch.cat([history[:, 1:], now], dim=1)))
        self._is_first_step.zero_()
        index = (history.shape[1] - 1 - self._delay)[:, None, None, None].expand(-1, 1, *history.shape[2:])
        return history.gather(1, index)[:, 0]

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that are saved in a checkpoint, by name."""
        own = {
            "targets": self.targets,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "effort_limit": self.effort_limit,
            "computed_effort": self.computed_effort,
            "applied_effort": self.applied_effort,
            "fresh": self._is_first_step,
        }
        return own if self._target_history is None else {**own, "frames": self._target_history, "lag": self._delay}
