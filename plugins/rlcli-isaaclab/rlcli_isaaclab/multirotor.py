"""Flying robots that thrusters drive.

A task of Isaac Lab that imports a name from `isaaclab_contrib` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli.scene.names import match_values
from rlcli_isaaclab.scene_facade import Asset
from rlcli_isaaclab.utils.math import sample_uniform


class Thruster:
    """Group of rotors. The speed of a rotor follows its target with a time constant; thrust is constant x speed^2.

    d(speed)/dt = clamp(mixing x (target - speed), +-max_thrust_rate), mixing = 1 / (dt + tau) or 1 / tau; tau is drawn
    for rising and for falling thrust.
    """

    def __init__(
        self, cfg: Any, thruster_names: list[str], thruster_ids: list[int], num_envs: int, device: Any,
        init_thruster_rps: Tensor,
    ) -> None:  # fmt: skip
        if cfg.integration_scheme not in ("euler", "rk4"):
            raise ValueError(f"integration_scheme is '{cfg.integration_scheme}'; write euler or rk4")
        self.cfg, self.thruster_names, self.thruster_indices = cfg, thruster_names, thruster_ids
        self.num_motors, self._device, self._start_speed = len(thruster_names), device, init_thruster_rps
        self.tau_inc_s, self.tau_dec_s, self.thrust_const, self.curr_thrust = (
            torch.zeros(num_envs, self.num_motors, device=device) for _ in range(4)
        )
        self.computed_thrust = self.applied_thrust = self.curr_thrust
        self.reset(slice(None))

    def reset(self, env_ids: Any) -> None:
        """Sample time and thrust constants in the environments `env_ids`, and set the rotors to their initial speed."""
        cfg = self.cfg
        shape = self.tau_inc_s[env_ids].shape
        for target, ends in (
            (self.tau_inc_s, cfg.tau_inc_range), (self.tau_dec_s, cfg.tau_dec_range),
            (self.thrust_const, cfg.thrust_const_range),
        ):  # fmt: skip
            target[env_ids] = sample_uniform(ends[0], ends[1], shape, self._device)
        self.thrust_const.clamp_(min=1e-6)
        self.curr_thrust[env_ids] = self.thrust_const[env_ids] * self._start_speed[env_ids].square()

    def compute(self, target: Tensor) -> Tensor:
        """Advance the rotors by one physics step to thrust targets; return the thrusts. (num_envs, rotors) [N] each"""
        low, high = self.cfg.thrust_range
        target = target.clamp(low, high)
        falls = self.curr_thrust.sign() * (target - self.curr_thrust).sign() < 0
        tau = torch.where(falls, self.tau_dec_s, self.tau_inc_s)
        mixing = 1.0 / (tau + (self.cfg.dt if self.cfg.use_discrete_approximation else 0.0))
        speed = (self.curr_thrust / self.thrust_const).clamp(min=0.0).sqrt()
        error = (target / self.thrust_const).clamp(min=0.0).sqrt() - speed
        self.curr_thrust[:] = self.thrust_const * (speed + self._change(error, mixing)).square()
        self.computed_thrust, self.applied_thrust = self.curr_thrust, self.curr_thrust.clamp(low, high)
        return self.applied_thrust

    def _change(self, error: Tensor, mixing: Tensor) -> Tensor:
        """Return the change of speed in one physics step, from `error` = target - speed and `mixing` [1/s]."""
        dt, most = self.cfg.dt, self.cfg.max_thrust_rate

        def rate(wanted: Tensor) -> Tensor:
            return (mixing * wanted).clamp(-most, most)

        first = rate(error)
        if self.cfg.integration_scheme == "euler":
            return first * dt
        # Runge-Kutta as in Isaac Lab, which adds the stages to the error
        second = rate(error + 0.5 * dt * first)
        third = rate(error + 0.5 * dt * second)
        fourth = rate(error + dt * third)
        return dt / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)


class Multirotor(Asset):
    """A robot that thrusters drive; their forces act on its first body, in its frame."""

    def start(self) -> None:
        """Create the thrusters. Call this after `cfg` and the entity are set."""
        self.actuators: dict[str, Thruster] = {}
        groups = {group: self.find_bodies(cfg.thruster_names_expr)[1] for group, cfg in self.cfg.actuators.items()}
        self.thruster_names = [name for names in groups.values() for name in names]
        self.num_thrusters = len(self.thruster_names)
        speeds = match_values(dict(self.cfg.init_state.rps), self.thruster_names, "thruster")
        row = torch.tensor([0.0 if speed is None else float(speed) for speed in speeds], device=self.device)
        data: Any = self.data  # Isaac Lab adds these tensors to the data of its articulations
        data.default_thruster_rps = row.expand(self.num_instances, -1).clone()
        for name in ("thrust_target", "computed_thrust", "applied_thrust"):
            setattr(data, name, torch.zeros_like(data.default_thruster_rps))
        data.thruster_names = self.thruster_names
        self.allocation_matrix = torch.tensor(self.cfg.allocation_matrix, dtype=torch.float32, device=self.device)
        for group, names in groups.items():
            cfg, ids = self.cfg.actuators[group], [self.thruster_names.index(name) for name in names]
            start = self.data.default_thruster_rps[:, ids]
            made = cfg.class_type if isinstance(cfg.class_type, type) else Thruster
            self.actuators[group] = made(cfg, names, ids, self.num_instances, self.device, start)

    def set_thrust_target(self, target: Tensor, thruster_ids: Any = None, env_ids: Any = None) -> None:
        """Set thrust targets of thrusters in the environments `env_ids`; None: of all. (rows, thrusters) [N]"""
        rows = torch.arange(self.num_instances) if env_ids is None else torch.as_tensor(env_ids)
        columns = torch.arange(self.num_thrusters)[slice(None) if thruster_ids is None else thruster_ids]
        self.data.thrust_target[rows[:, None], columns] = target

    def reset(self, env_ids: Any = None) -> None:
        """Reset the thrusters in the environments `env_ids`; None: in all environments."""
        super().reset(env_ids)
        rows = slice(None) if env_ids is None else env_ids
        # as in Isaac Lab, the first target is the speed
        self.data.thrust_target[rows] = self.data.default_thruster_rps[rows]
        for actuator in self.actuators.values():
            actuator.reset(rows)

    def write_data_to_sim(self) -> None:
        """Write the forces of the thrusters for the next physics step."""
        data = self.data
        for actuator in self.actuators.values():
            ids = actuator.thruster_indices
            data.applied_thrust[:, ids] = actuator.compute(data.thrust_target[:, ids])
            data.computed_thrust[:, ids] = actuator.computed_thrust
        wrench = (data.applied_thrust @ self.allocation_matrix.T)[:, None]
        self.set_external_force_and_torque(wrench[..., :3], wrench[..., 3:], body_ids=[0])

    def state(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint contains."""
        found = {"thrust_target": self.data.thrust_target}
        for group, actuator in self.actuators.items():
            for name in ("tau_inc_s", "tau_dec_s", "thrust_const", "curr_thrust"):
                found[f"{group}.{name}"] = getattr(actuator, name)
        return found
