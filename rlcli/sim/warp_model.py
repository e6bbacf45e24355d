"""Model of the GPU engine's worlds (one per environment), and the model fields that differ between worlds."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from rlcli.config.schema import SimConfig
from rlcli.errors import did_you_mean, listing
from rlcli.sim.capacity import required_capacity
from rlcli.sim.quiet_mujoco import quiet_mujoco
from rlcli.sim.selection import Selection
from rlcli.sim.warp_memory import put_on_device

_CONSTANTS = (
    *("body_subtreemass", "dof_invweight0", "body_invweight0", "tendon_invweight0", "tendon_length0"),
    *("actuator_acc0", "eq_data"),
)
"""Model fields that `set_const` derives from others."""
_BOUNDS = ("geom_aabb", "geom_rbound")
"""Model fields that `set_const` derives from the sizes of geoms."""


class WarpModel:
    """Base of the GPU engine: its worlds on a device of Warp, and the model fields that differ between them.

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
        with self._setting_up():
            self._model, self._data = put_on_device(model, num_envs, self.device, self.capacity)

    def can_expand(self, name: str) -> bool:
        """Return whether a model field may differ between worlds."""
        owner, attribute = self._owner(name)
        return attribute in _batched_fields(owner) and getattr(owner, attribute, None) is not None

    def expand(self, name: str) -> Tensor:
        """Return a model field with a value for every world."""
        if name not in self._expanded:
            owner, attribute = self._owner(name)
            if not self.can_expand(name):
                known = sorted(_batched_fields(owner))
                hint = did_you_mean(attribute, known) or f"fields that can: {listing(known)}"
                raise ValueError(f"'{name}' cannot differ between environments; {hint}")
            array = getattr(owner, attribute)
            values = np.repeat(array.numpy()[:1], self.num_envs, axis=0)
            wide = wp.array(values, dtype=array.dtype, device=self._device)
            setattr(owner, attribute, wide)
            self._expanded[name] = wp.to_torch(wide)
            self._graphs.clear()
        return self._expanded[name]

    def expanded(self, name: str) -> Tensor | None:
        """Return a model field that has a value for each world; None if all worlds share the model's value."""
        return self._expanded.get(name)

    def expanded_fields(self) -> list[str]:
        """Return the names of the model fields that have a value for each world."""
        return list(self._expanded)

    def set_constants(self, selection: Selection | None = None) -> None:
        """Recompute the constants that MuJoCo derives from model fields, in all worlds."""
        for name in (*_CONSTANTS, *(_BOUNDS if "geom_size" in self._expanded else ())):
            array = getattr(self._model, name, None)
            if array is not None and array.size:
                self.expand(name)
        with self._launching():
            mjw.set_const(self._model, self._data)

    def _owner(self, name: str) -> tuple[Any, str]:
        """Return the structure of MuJoCo Warp that has a model field, and the field's name in it."""
        return (self._model.opt, name[4:]) if name.startswith("opt.") else (self._model, name)

    def _launching(self) -> wp.ScopedDevice:
        """Return a context in which Warp launches on the engine's device."""
        return wp.ScopedDevice(self._device)

    @contextlib.contextmanager
    def _setting_up(self) -> Iterator[None]:
        """Launch on the engine's device and, on a GPU, on torch's stream."""
        is_gpu = self.device.type == "cuda"
        stream = wp.stream_from_torch(torch.cuda.current_stream(self.device)) if is_gpu else None
        with self._launching(), wp.ScopedStream(stream):
            yield


def _batched_fields(owner: Any) -> set[str]:
    """Return the array fields of a dataclass of MuJoCo Warp that have a row for each world."""
    shapes = {field.name: getattr(field.type, "shape", ()) for field in dataclasses.fields(owner)}
    return {name for name, shape in shapes.items() if next(iter(shape), None) == "*"}
