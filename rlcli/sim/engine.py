"""The engine: many worlds of one model behind one protocol, whatever steps them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import mujoco
import torch
from torch import Tensor

from rlcli.errors import DeviceError
from rlcli.machine import available_cores
from rlcli.sim.selection import Selection

if TYPE_CHECKING:
    from collections.abc import Mapping


class Engine(Protocol):
    """`num_envs` worlds of `model`. Fields are torch tensors `(num_envs, ...)` on `device`, in the engine's dtype."""

    num_envs: int
    device: torch.device
    model: mujoco.MjModel
    threads: int
    warnings: dict[str, int]

    def field(self, name: str) -> Tensor:
        """A live view of an MjData field: state fields are writable, derived ones (xpos, ...) must only be read.

        Position- and velocity-dependent fields are current after `step` and `forward`; acceleration-dependent ones
        (qacc, actuator_force, ...) are those of the last substep.
        """
        ...

    def expand(self, name: str) -> Tensor:
        """A model field with a value for every world, live and writable. (num_envs, ...)

        After writing masses, inertias, positions and the like, call `set_constants`.
        """
        ...

    def set_constants(self) -> None:
        """Let the constants that MuJoCo derives from model fields follow what was written to expanded ones."""
        ...

    def step(self, nstep: int) -> None:
        """Advance every world by `nstep` physics steps."""
        ...

    def diverged(self) -> Tensor | None:
        """Worlds in which the last `step` went wrong, (num_envs,) bool; None for none. Asked once a step."""
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

    def select(self, mask: Tensor, seed: int, counters: Tensor) -> Selection | None:
        """The worlds where `mask` holds, with their random streams; None where that is known to be nobody."""
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


def open_engine(model: mujoco.MjModel, num_envs: int, *, device: str = "cpu", threads: int | None = None) -> Engine:
    """The engine for a device.

    Raises:
        DeviceError: for a device that no engine serves.
    """
    if torch.device(device).type != "cpu":
        raise DeviceError(f"no simulation engine for device '{device}'", hint="use --device cpu")
    from rlcli.sim.batch import BatchEngine

    return BatchEngine(model, num_envs, threads or available_cores())


def quiet_mujoco() -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT into the user's folder and warnings onto the terminal.

    The guard reads the engine's warning counters instead.
    """
    config = mujoco.MjLogConfig()
    config.logto_file = False
    config.logto_console = False
    config.set()
