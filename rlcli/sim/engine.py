"""The engine: many worlds of one model behind one protocol, whatever steps them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import SimConfig
from rlcli.errors import ConfigError, DependencyError, Problem
from rlcli.machine import available_cores, require_device
from rlcli.sim.capacity import capacity
from rlcli.sim.guard import LIMIT, MEMORY, Call, Divergence
from rlcli.sim.selection import Field, Selection

if TYPE_CHECKING:
    from collections.abc import Mapping


class Engine(Protocol):
    """`num_envs` worlds of `model`. Fields are torch tensors `(num_envs, ...)` on `device`, in the engine's dtype."""

    num_envs: int
    device: torch.device
    model: mujoco.MjModel
    threads: int
    warnings: dict[str, int]
    lives: int
    """World i draws as world i % lives does; 0: each lives a life of its own."""
    asynchronous: bool
    """Whether reading a value waits for a device: then nothing on the path of a step may."""
    forces_after_reset: bool
    """Whether `forward` computes fields of the acceleration stage; else `reset` puts them to 0."""

    @property
    def divergences(self) -> int:
        """Worlds that diverged, ever."""
        ...

    @property
    def causes(self) -> dict[str, int]:
        """The same by cause."""
        ...

    @property
    def found(self) -> list[Divergence]:
        """The first worlds of the last `diverged`, described; of an `asynchronous` engine the first one ever."""
        ...

    def remember(self, calls: int, memory: int = MEMORY) -> None:
        """Keep what the last calls of `step` began with, as many as asked for or fit into so many bytes."""
        ...

    def trace(self, env: int) -> list[Call]:
        """What is kept of a world in its running episode, the oldest call first; empty where nothing is kept."""
        ...

    def attach(self) -> None:
        """Called before a step: launch where torch launches."""
        ...

    def field(self, name: str) -> Tensor:
        """A live view of an MjData field: state fields are writable, derived ones (xpos, ...) must only be read.

        Position- and velocity-dependent fields are current after `step` and `forward`; acceleration-dependent ones
        (qacc, actuator_force, ...) are those of the last substep. With `sim.derived_fields: substep` all are.
        """
        ...

    def can_expand(self, name: str) -> bool:
        """Whether a model field may differ between worlds."""
        ...

    def expand(self, name: str) -> Tensor:
        """A model field with a value for every world, live and writable. (num_envs, ...)

        After writing masses, inertias, positions and the like, call `set_constants`.
        """
        ...

    def expanded(self, name: str) -> Tensor | None:
        """The same where somebody has asked for it before; None where all worlds share the model's value."""
        ...

    def expansions(self) -> list[str]:
        """The model fields that somebody has asked for."""
        ...

    def set_constants(self, selection: Selection | None = None) -> None:
        """Let the constants that MuJoCo derives from model fields follow what was written to expanded ones.

        Of the selected worlds, or of all; an `asynchronous` engine always does it for all.
        """
        ...

    def step(self, nstep: int, *, derive: bool = True) -> None:
        """Advance every world by `nstep` physics steps; without `derive` the derived fields stay behind."""
        ...

    def diverged(self, moves_finitely: bool = False) -> Tensor | None:
        """Worlds in which the last `step` went wrong, (num_envs,) bool; None for none. Asked once a step.

        An `asynchronous` engine has put them back into the state before by itself.

        Args:
            moves_finitely: whether the caller has looked at all positions and velocities, and found finite numbers.
        """
        ...

    def forward(self, selection: Selection) -> None:
        """Compute the derived fields of the selected worlds from their state."""
        ...

    def reset(self, selection: Selection) -> None:
        """Put the selected worlds into the default state; derived fields follow at `forward`."""
        ...

    def set_default(self, qpos: Tensor, qvel: Tensor) -> None:
        """The joint state that `reset` restores. (nq,), (nv,)"""
        ...

    def as_field(self, tensor: Tensor) -> Field:
        """The memory of a tensor in the form that `select` and its selections read and write at least cost."""
        ...

    def select(self, mask: Field, seed: int, counters: Field) -> Selection | None:
        """The worlds where `mask` holds, with their random streams; None where that is known to be nobody."""
        ...

    def rays(
        self,
        points: Tensor,
        directions: Tensor,
        *,
        groups: tuple[int, ...] | None = None,
        exclude: int = -1,
        selection: Selection | None = None,
    ) -> Tensor:
        """Distances from points to the first geom along unit directions, -1 where there is none. (rows, rays) float32

        Args:
            points: world frame [m]; a row for every world, or for those of the selection as it reads fields.
                (rows, rays, 3) float32
            directions: of length 1. (rows, rays, 3) float32
            groups: of the geoms that are seen; None: all.
            exclude: a body whose geoms are not.
            selection: the worlds; None: all.
        """
        ...

    def watch(self, values: Tensor, what: str) -> None:
        """Note, without waiting, if a value is not finite."""
        ...

    def noted(self) -> list[str]:
        """What `watch` found since the last call."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of everything the worlds carry from step to step."""
        ...

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        ...

    def world(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """One world as MuJoCo's own structures, for drawing and debugging."""
        ...

    def close(self) -> None:
        """Let go of threads and memory."""
        ...


def open_engine(model: mujoco.MjModel, num_envs: int, config: SimConfig, *, device: str = "cpu") -> Engine:
    """The engine for a device.

    Raises:
        DependencyError: if the GPU engine is not installed.
        ConfigError: for a model that the engine cannot run.
        DeviceError: for a device that is not there, or more worlds than its memory holds.
    """
    on_cpu = device.partition(":")[0] == "cpu"
    wanted = config.engine if config.engine != "auto" else "batch" if on_cpu else "warp"
    if wanted == "batch" and not on_cpu:
        message = f"sim.engine 'batch' runs on a CPU, not on '{device}'"
        raise ConfigError([Problem("sim", "sim.engine", message, "auto, or --device cpu")])
    if wanted == "batch":
        from rlcli.sim.batch import BatchEngine

        return BatchEngine(
            model,
            num_envs,
            config.engine_threads or available_cores(),
            config.forces_after_reset,
            late=config.derived_fields == "substep",
            external_forces=config.external_forces,
            max_velocity=config.max_velocity or LIMIT,
        )
    require_device(device)
    try:
        from rlcli.sim.warp import WarpEngine
    except ImportError as error:
        raise DependencyError(f"the GPU engine needs mujoco-warp: {error}", hint='pip install "rlcli[gpu]"') from None
    room = capacity(model, config.contacts_per_env, config.constraints_per_env)
    return WarpEngine(
        model,
        num_envs,
        device,
        room,
        config.forces_after_reset,
        late=config.derived_fields == "substep",
        external_forces=config.external_forces,
        max_velocity=config.max_velocity or LIMIT,
    )


_BODY_FORCE_SENSORS = [
    int(getattr(mujoco.mjtSensor, f"mjSENS_{kind}"))
    for kind in ("ACCELEROMETER", "FORCE", "TORQUE", "FRAMELINACC", "FRAMEANGACC")
]


def computes_body_forces(model: mujoco.MjModel) -> bool:
    """Whether a step computes `cacc`, `cfrc_int` and `cfrc_ext`: only for sensors that need them."""
    return bool(np.isin(model.sensor_type, _BODY_FORCE_SENSORS).any())


def add_body_forces(spec: mujoco.MjSpec) -> None:
    """Have the model compute `cacc`, `cfrc_int` and `cfrc_ext`, with a sensor of nobody's."""
    spec.add_sensor(
        name="body_forces",
        type=mujoco.mjtSensor.mjSENS_FRAMEANGACC,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        objname="world",
    )


def force_sensors(model: mujoco.MjModel) -> list[int]:
    """Columns of `sensordata` that belong to the acceleration stage."""
    acceleration = int(mujoco.mjtStage.mjSTAGE_ACC)
    sensors = [s for s in range(model.nsensor) if int(model.sensor_needstage[s]) == acceleration]
    return [int(model.sensor_adr[s]) + i for s in sensors for i in range(int(model.sensor_dim[s]))]
