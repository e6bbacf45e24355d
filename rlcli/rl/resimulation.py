"""Stepping single worlds again from states that were kept: the same bits, and where they go wrong."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.sim.batch import BatchEngine
from rlcli.sim.engine import Engine, open_engine
from rlcli.sim.guard import FIELD_OF, Call, Divergence


class Where(BaseModel):
    """The physics step in which an environment went wrong, and what showed it."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    call: int = Field(ge=0)
    """Number of the engine call in the dump."""
    substep: int = Field(ge=0)
    """Physics step of that call, counted from 0."""
    time: float
    """Simulated time at its beginning [s]."""
    cause: str
    """As `rlcli.sim.guard.Divergence`."""
    place: str
    """The joint, actuator or element."""
    value: str
    """What was found there, as Python writes it: `nan`, `1e+30`."""

    def __str__(self) -> str:
        """One line."""
        what = f"{self.place} = {self.value}" if self.value else self.place
        return f"{self.cause} in physics step {self.substep} of call {self.call}, t = {self.time:.6g} s: {what}"


def open_world(model: mujoco.MjModel, resolved: Resolved, own: Mapping[str, Tensor], constants: bool) -> BatchEngine:
    """One world of the model, with model fields of its own."""
    config = resolved.task.sim.model_copy(update={"engine": "batch", "engine_threads": 1})
    world: Engine = open_engine(model, 1, config)
    assert isinstance(world, BatchEngine)
    for name, values in own.items():
        world.take_model(name, values.reshape(world.expand(name).shape))
    if constants:
        world.set_constants()
    return world


def step(world: BatchEngine, call: Call) -> np.ndarray:
    """The state after a call."""
    world.put(0, call.state)
    world.step(call.nstep)
    world.diverged()
    return world.row(0)


def follows(world: BatchEngine, call: Call, following: Call) -> bool:
    """Whether a call begins exactly where the one before it ended, controls and forces aside."""
    return differs(world, following.state, step(world, call), whole=False) is None


def differs(
    world: BatchEngine, recorded: np.ndarray, now: np.ndarray, *, whole: bool
) -> tuple[str, list[float], list[float]] | None:
    """The first field whose bits differ: of all, or of those that only physics writes."""
    for name, columns in world.state_layout.fields():
        if whole or name in ("time", "qpos", "qvel", "act", "qacc_warmstart"):
            left, right = recorded[columns], now[columns]
            if left.tobytes() != right.tobytes():
                return name, left.tolist(), right.tolist()
    return None


def locate(world: BatchEngine, calls: list[Call], first: int) -> Where | None:
    """The first physics step that goes wrong, from a call on."""
    layout = world.state_layout
    for number, call in enumerate(calls[first:], start=first):
        world.put(0, call.state)
        for substep in range(call.nstep):
            before = world.row(0)
            world.step(1)
            if world.diverged() is None:
                continue
            found = world.found[0]
            place, value = _what(world, found, before)
            return Where(
                call=number,
                substep=substep,
                time=float(before[layout.columns("time")][0]),
                cause=found.cause,
                place=place,
                value=value,
            )
    return None


def _what(world: BatchEngine, found: Divergence, before: np.ndarray) -> tuple[str, str]:
    """The element that a divergence showed itself at, and its value."""
    layout, field = world.state_layout, FIELD_OF.get(found.cause)
    if field is None:
        name = found.cause.removesuffix(" not finite")
        values = world.own_model(0).get(name)
        if values is None and name in dict(layout.fields()):
            values = world.row(0)[layout.columns(name)]
        if values is None:
            return found.detail, ""
        flat = np.asarray(values).flatten()
        index = int((~np.isfinite(flat)).argmax())
        return f"{name}[{index}]", repr(float(flat[index]))
    if field == "qacc":
        world.put(0, before)
        _, data = world.world(0)
        values = data.qacc
    else:
        values = before[layout.columns(field)]
    value = f"{field} {float(values[found.index])!r}" if 0 <= found.index < len(values) else ""
    return found.detail, value
