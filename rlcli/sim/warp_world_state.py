"""Base class of the GPU engine that holds its worlds (one for each environment) and their states.

For domain randomisation, the class also gives each world its own values of model fields.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from rlcli.config.schema import SimConfig
from rlcli.errors import did_you_mean, listing
from rlcli.sim.contact_capacity import required_capacity
from rlcli.sim.env_selection import Selection
from rlcli.sim.quiet_mujoco import quiet_mujoco
from rlcli.sim.saved_tensors import require_matching_tensors, substate
from rlcli.sim.warp_allocation import put_on_device
from rlcli.sim.warp_field_stages import FORCE, INPUTS, KINEMATICS, STATE, VELOCITY, FieldStages

_CONSTANTS = (
    *("body_subtreemass", "dof_invweight0", "body_invweight0", "tendon_invweight0", "tendon_length0"),
    *("actuator_acc0", "eq_data"),
)
"""Model fields that `set_const` derives from others."""
_BOUNDS = ("geom_aabb", "geom_rbound")
"""Model fields that `set_const` derives from the sizes of geoms."""
_HOLDING_EQUALITIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
"""Types of equality constraints that hold bodies together."""


class WarpWorlds:
    """Base class of the GPU engine: its worlds, their states, and the model fields that differ between worlds.

    Raises:
        ConfigError: for a model that MuJoCo Warp cannot run.
        DeviceError: for more worlds than the device's memory holds.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, config: SimConfig, device: str) -> None:
        quiet_mujoco()
        self.model = model
        self.num_envs = num_envs
        self.capacity = required_capacity(model, config.contacts_per_env, config.constraints_per_env)
        self.device = torch.device(device)
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self._device = wp.device_from_torch(self.device)
        self._graphs: dict[tuple[int, bool], Any] = {}
        """CUDA graphs of `step`, by `nstep` and `derive`."""
        self._expanded: dict[str, Tensor] = {}
        self._fields: dict[str, Tensor] = {}
        """Fields of MjData that have been requested with `field`, by name."""
        self._start_inputs: dict[str, Tensor] = {}
        """Default values of the requested `INPUTS`, which a reset restores."""
        self._last_derived: dict[str, Tensor] = {}
        """Derived fields of each world's last state that did not diverge."""
        self._derived: set[int] = set()
        """Stages of a MuJoCo step that have to run, because they compute a requested derived field."""
        self._needs_only_motion = True
        """Whether the requested fields can be derived from positions and velocities, without contacts and inertias."""
        self._overwritten: dict[str, wp.array] = {}
        """Copies of fields that `fwd_velocity` overwrites."""
        self._substep_fields = config.derived_fields == "substep"
        self._stages = FieldStages(model)
        self._holds_bodies = bool(np.isin(model.eq_type, _HOLDING_EQUALITIES).any())
        self._worlds: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}
        with self._setting_up():
            self._model, self._data = put_on_device(model, num_envs, self.device, self.capacity)
            self._arrays = {name: getattr(self._data, name) for name in STATE}
            qpos, qvel, _ = (self.field(name) for name in ("qpos", "qvel", "qacc_warmstart"))
            self._last_qpos, self._last_qvel = qpos.clone(), qvel.clone()

    def can_expand(self, name: str) -> bool:
        """Return whether a model field may differ between worlds."""
        owner, attribute = self._owner(name)
        return attribute in _batched_fields(owner) and getattr(owner, attribute, None) is not None

    def expand(self, name: str) -> Tensor:
        """Give every world its own values of a model field; return a writable view of the values. (num_envs, ...)

        Raises:
            ValueError: if the field cannot differ between worlds.
        """
        if name not in self._expanded:
            owner, attribute = self._owner(name)
            if not self.can_expand(name):
                known = sorted(_batched_fields(owner))
                hint = did_you_mean(attribute, known) or f"fields that can: {listing(known)}"
                raise ValueError(f"model field '{name}' cannot differ between environments; {hint}")
            array = getattr(owner, attribute)
            values = np.repeat(array.numpy()[:1], self.num_envs, axis=0)
            wide = wp.array(values, dtype=array.dtype, device=self._device)
            setattr(owner, attribute, wide)
            self._expanded[name] = wp.to_torch(wide)
            self._graphs.clear()
        return self._expanded[name]

    def expanded(self, name: str) -> Tensor | None:
        """Return a model field for which each world has its own values, (num_envs, ...); None if all share a value."""
        return self._expanded.get(name)

    def expanded_fields(self) -> list[str]:
        """Return the names of the model fields for which each world has its own values (see `Engine.expand`)."""
        return list(self._expanded)

    def set_constants(self, selection: Selection | None = None) -> None:
        """Recompute the constants that MuJoCo derives from model fields, in all worlds; `selection` is not used."""
        for name in (*_CONSTANTS, *(_BOUNDS if "geom_size" in self._expanded else ())):
            array = getattr(self._model, name, None)
            if array is not None and array.size:
                self.expand(name)
        with self._launching():
            mjw.set_const(self._model, self._data)

    def field(self, name: str) -> Tensor:
        """Return a live view of an MjData field, which each later step updates. (num_envs, ...)

        Raises:
            ValueError: if MuJoCo Warp's data has no such field with a row for each world.
        """
        if name not in self._fields:
            array = getattr(self._data, name, None)
            if not isinstance(array, wp.array) or array.ndim == 0 or array.shape[0] != self.num_envs:
                names = [f.name for f in dataclasses.fields(self._data)]
                if name in names:
                    raise ValueError(
                        f"field '{name}' of mujoco_warp.Data is shared by all environments; use a field with a row for"
                        " each environment, such as qpos or xpos"
                    )
                hint = did_you_mean(name, names) or "see mujoco_warp.Data"
                raise ValueError(f"'{name}' is not a field of MuJoCo Warp's data; {hint}")
            saved = self._substep_values()
            self._fields[name] = wp.to_torch(array)
            if name in INPUTS:  # a new input field still has the value of the model
                self._start_inputs[name] = self._fields[name].view(self.num_envs, -1).clone()
            stages = self._stages.stages_of(name)
            self._derived |= stages
            self._needs_only_motion = all(map(self._stages.needs_only_motion, self._fields))
            # the velocity stage uses the memory of these fields for intermediate values
            if name in ("cacc", "cfrc_int"):
                self._overwritten[name] = wp.empty_like(array)
            self._graphs.clear()  # the recorded graphs do not compute the new field
            if stages:
                with self._launching():
                    self._update_velocities()
                    mjw.forward(self._model, self._data)  # compute the new field from the present state
                for other, values in saved.items():
                    self._fields[other].copy_(values)
                if FORCE in stages or (self._substep_fields and self._fields[name].dtype == torch.float32):
                    self._last_derived[name] = self._fields[name].clone()
        return self._fields[name]

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the state, the requested inputs and the model fields that differ between worlds, by name."""
        inputs = [name for name in INPUTS if name in self._fields]
        return {
            **{name: self.field(name).clone() for name in (*STATE, *inputs)},
            "last_qpos": self._last_qpos.clone(),
            "last_qvel": self._last_qvel.clone(),
            **{f"model.{name}": values.clone() for name, values in self._expanded.items()},
            **{f"substep.{name}": self.field(name).clone() for name in self._of_substep()},
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`, and compute derived fields again."""
        for name, values in substate(state, "model.").items():
            if not values.is_floating_point() and self.expanded(name) is None:
                raise ValueError(
                    f"the saved state has values of model field '{name}' for each environment, but the task has none;"
                    " restore the events and the code with which the state was saved"
                )
            require_matching_tensors({name: values}, {name: self.expand(name)}, "engine")
            self.expand(name).copy_(values)
        substep = substate(state, "substep.")
        for name in substep:
            self.field(name)  # request the field: it was requested when the state was saved
        for name, values in state.items():
            if name in (*STATE, *INPUTS):
                self.field(name).copy_(values)
        self._last_qpos.copy_(state["last_qpos"])
        self._last_qvel.copy_(state["last_qvel"])
        with self._launching():
            self._derive()
        for name, values in substep.items():
            self.field(name).copy_(values)
        for name, last in self._last_derived.items():
            last.copy_(self._fields[name])

    def world(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return (model, data) of a world after `mj_forward`; a later call for the same world updates these objects."""
        if env not in self._worlds:
            model = copy.copy(self.model)
            self._worlds[env] = (model, mujoco.MjData(model))
        model, data = self._worlds[env]
        for name, values in self._expanded.items():
            owner, attribute = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
            value, current = values[env].cpu().numpy(), getattr(owner, attribute)
            if np.ndim(current):
                current[:] = value.reshape(current.shape)
            else:
                setattr(owner, attribute, float(value))
        for name in (*STATE[:-1], *(n for n in INPUTS if n in self._fields)):
            target = getattr(data, name)
            target[:] = self.field(name)[env].cpu().numpy().reshape(target.shape)
        data.time = float(self.field("time")[env])
        mujoco.mj_forward(model, data)
        return model, data

    def _update_velocities(self) -> None:
        """Compute the velocities of bodies, which connect and weld constraints use in the next step.

        MuJoCo Warp 4.0 computes these constraints before it updates the velocities, so the constraints would use the
        velocities of the previous step or episode.
        """
        if self._holds_bodies:
            mjw.fwd_kinematics(self._model, self._data)
            mjw.com_vel(self._model, self._data)

    def _derive(self) -> None:
        """Compute the requested derived fields from the state, except those of the acceleration stage."""
        m, d = self._model, self._data
        if VELOCITY not in self._derived:
            if KINEMATICS in self._derived:
                mjw.fwd_kinematics(m, d)
            return
        if self._needs_only_motion:
            mjw.fwd_kinematics(m, d)
            mjw.com_vel(m, d)
        else:
            self._update_velocities()
            mjw.fwd_position(m, d, factorize=False)
            for name, saved in self._overwritten.items():
                wp.copy(saved, getattr(d, name))
            mjw.fwd_velocity(m, d)
            for name, saved in self._overwritten.items():
                wp.copy(getattr(d, name), saved)
        if "sensordata" in self._fields:
            mjw.sensor_pos(m, d)
            mjw.sensor_vel(m, d)

    def _of_substep(self) -> list[str]:
        """Return the requested fields with values of the last physics step, which the state does not determine."""
        stages = {name: self._stages.stages_of(name) for name in self._fields}
        return [name for name, groups in stages.items() if FORCE in groups or (self._substep_fields and groups)]

    def _substep_values(self) -> dict[str, Tensor]:
        """Return copies of the fields of the last physics step, which MuJoCo's mj_forward would overwrite."""
        names = [*self._of_substep(), "qacc_warmstart"]
        return {name: self._fields[name].clone() for name in names if name in self._fields}

    def _owner(self, name: str) -> tuple[Any, str]:
        """Return the structure of MuJoCo Warp (Model or Option) that has a model field, and the field's name in it."""
        return (self._model.opt, name[4:]) if name.startswith("opt.") else (self._model, name)

    def _launching(self) -> wp.ScopedDevice:
        """Return a context in which Warp launches kernels on the engine's device."""
        return wp.ScopedDevice(self._device)

    @contextlib.contextmanager
    def _setting_up(self) -> Iterator[None]:
        """Let Warp launch kernels in a `with` block on the engine's device and, on a GPU, on torch's stream."""
        is_gpu = self.device.type == "cuda"
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if is_gpu else None
        with self._launching(), wp.ScopedStream(stream):
            yield


def _batched_fields(owner: Any) -> set[str]:
    """Return the names of the arrays in a dataclass of MuJoCo Warp that have a row for each world."""
    shapes = {field.name: getattr(field.type, "shape", ()) for field in dataclasses.fields(owner)}
    return {name for name, shape in shapes.items() if next(iter(shape), None) == "*"}
