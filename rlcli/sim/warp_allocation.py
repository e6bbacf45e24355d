"""Allocation of the GPU engine's memory: model, worlds, and the capacity for contacts and constraints."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp

from rlcli.errors import ConfigError, DeviceError, DivergedError, Problem, one_line
from rlcli.sim.contact_capacity import Capacity
from rlcli.sim.skippable_work import skippable_flags

_MAX_DENSE = 60
"""Largest number of degrees of freedom for which MuJoCo Warp has dense matrices."""
_BIT = mjw.OverflowType
OVERFLOW_SETTINGS = {
    **dict.fromkeys((_BIT.NEFC, _BIT.NJMAX_NNZ), "constraints_per_env"),
    **dict.fromkeys((_BIT.BROADPHASE, _BIT.NARROWPHASE, _BIT.CCD, _BIT.HFIELD, _BIT.EPA_HORIZON), "contacts_per_env"),
}
"""Kind of overflow that MuJoCo Warp reports -> setting of `sim` that raises the exceeded capacity."""


def put_on_device(
    model: mujoco.MjModel, num_envs: int, device: torch.device, capacity: Capacity
) -> tuple[mjw.Model, mjw.Data]:
    """Allocate a model and its worlds on a device, which must be Warp's current device; return model and data.

    Args:
        model: the compiled model.
        num_envs: number of worlds.
        device: the device.
        capacity: numbers of contacts and constraints for which each world gets memory.

    Raises:
        ConfigError: for a model that MuJoCo Warp cannot run.
        DeviceError: for more worlds than the device's memory holds.
    """
    try:
        with warnings.catch_warnings(action="ignore"), _storage_for_warp(model):
            on_device = mjw.put_model(model)
        if not on_device.nsensorcollision:  # distance sensors need the collision pass
            on_device.opt.disableflags |= skippable_flags(model) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        on_device.opt.warn_overflow = 0  # printing waits for the device; `report_nonfinite` raises instead
        if device.type == "cpu":
            on_device.opt.graph_conditional = False
    except (NotImplementedError, ValueError) as error:
        message = f"the GPU engine (MuJoCo Warp) cannot run this model: {one_line(error)}"
        hint = "use --device cpu, or change the option in the MJCF"
        raise ConfigError([Problem("scene", "", message, hint)]) from None
    try:
        return on_device, _make_data(model, num_envs, capacity)
    except RuntimeError as error:
        if "alloc" not in str(error) and "memory" not in str(error):
            raise
        raise _memory_error(model, num_envs, device, capacity) from None


def overflow_error(found: int, capacity: Capacity) -> DivergedError:
    """Return the error for exceeded capacities; `found` is the sum of their flags (keys of `OVERFLOW_SETTINGS`)."""
    settings = {setting for bit, setting in OVERFLOW_SETTINGS.items() if found & int(bit)}
    kinds = " and ".join(bit.name.lower() for bit in OVERFLOW_SETTINGS if found & int(bit) and bit.name)
    now = {"contacts_per_env": capacity.contacts, "constraints_per_env": capacity.constraints}
    advice = " ".join(f"sim.{setting}={2 * now[setting]}" for setting in sorted(settings))
    return DivergedError(
        f"the GPU engine exceeded its capacity ({kinds}): it has room for {capacity.contacts} contacts and"
        f" {capacity.constraints} constraints per environment; the results since then are wrong",
        hint=f"raise the capacity: {advice}",
    )


def _make_data(model: mujoco.MjModel, num_envs: int, capacity: Capacity) -> mjw.Data:
    with _storage_for_warp(model):
        return mjw.make_data(model, nworld=num_envs, nconmax=capacity.contacts, njmax=capacity.constraints)


@contextmanager
def _storage_for_warp(model: mujoco.MjModel) -> Iterator[None]:
    """Let MuJoCo Warp choose how it stores the Jacobian of a large model: it has no dense matrices for large models.

    The storage does not change the physics. A model is dense because of its MJCF, or of `avoid_sparse_newton`, whose
    bug MuJoCo Warp does not have.
    """
    chosen = model.opt.jacobian
    if chosen == mujoco.mjtJacobian.mjJAC_DENSE and model.nv > _MAX_DENSE:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    try:
        yield
    finally:
        model.opt.jacobian = chosen


def _memory_error(model: mujoco.MjModel, num_envs: int, device: torch.device, capacity: Capacity) -> DeviceError:
    """Return an error with the needed and the free memory, and a number of environments that would fit."""
    sample = 64
    each = sum(_byte_count(value) for value in vars(_make_data(model, sample, capacity)).values()) / sample
    free = wp.device_from_torch(device).free_memory if device.type == "cuda" else 0
    needed, fits = each * num_envs / 2**30, max(1, int(0.8 * free / each))
    return DeviceError(
        f"{num_envs} environments need {needed:.1f} GiB of memory, but {free / 2**30:.1f} GiB are free on {device}",
        hint=f"use at most --num-envs {fits}",
    )


def _byte_count(value: object) -> int:
    """Return the bytes of a Warp array, or of all arrays in a dataclass."""
    if isinstance(value, wp.array):
        return int(value.capacity)
    if dataclasses.is_dataclass(value):
        return sum(_byte_count(getattr(value, f.name)) for f in dataclasses.fields(value))
    return 0
