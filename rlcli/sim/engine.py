"""Interface `Engine` of physics engines, which step many worlds of one model: a simulation for each environment.

`open_engine` returns the engine for a device: on a CPU or on a GPU.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, Protocol

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.schema import SimConfig
from rlcli.errors import ConfigError, DependencyError, Problem, pip_install
from rlcli.machine.devices import require_device
from rlcli.machine.native_output import descriptor_redirected
from rlcli.sim.divergence_report import HISTORY_MEMORY, Call, Divergence, StateHistory, StateLayout
from rlcli.sim.env_selection import Field, Groups, Selection


class EngineView(Protocol):
    """Part of an engine that observers, recorders and reports use.

    Fields are torch tensors `(num_envs, ...)` on `device`: float64 on a CPU, float32 on a GPU.
    """

    num_envs: int
    device: torch.device
    model: mujoco.MjModel
    threads: int
    shared_streams: int
    """Worlds i and i % shared_streams draw the same random numbers; 0: every world has its own stream."""
    asynchronous: bool
    """Whether the engine computes on a GPU, so that code in a step must not read a value in Python (a host sync)."""
    forces_after_reset: bool
    """Whether `forward` computes forces and accelerations (the acceleration stage); if not, `reset` sets them to 0."""

    @property
    def replayable(self) -> ReplayableView | None:
        """The engine itself if its steps can be repeated bit for bit; None on a GPU."""

    @property
    def warnings(self) -> dict[str, int]:
        """Number of MuJoCo's warnings that do not mean divergence, by name."""

    @property
    def divergence_causes(self) -> dict[str, int]:
        """Number of divergences since the start, by cause."""

    def field(self, name: str) -> Tensor:
        """Return a live view of an MjData field: state fields are writable, derived ones (xpos, ...) are not.

        Fields that depend on positions and velocities are current after `step` and `forward`. Fields that depend on
        accelerations (qacc, actuator_force, ...) have the values of the last physics step (substep). With
        `sim.derived_fields: substep` all derived fields have the values of the last physics step.

        On a CPU `np.asarray(field)` is an array of the same memory. For a copy write `np.array(field.numpy())`, because
        `np.array` of any tensor of torch 2.13 causes a DeprecationWarning.

        Raises:
            ValueError: if there is no such field.
        """

    def expanded_fields(self) -> list[str]:
        """Return the names of the model fields for which each world has its own values (see `Engine.expand`)."""


class ReplayableView(EngineView, Protocol):
    """Part of a CPU engine for replays: steps from a stored integration state can be repeated bit for bit."""

    state_layout: StateLayout

    @property
    def step_stage(self) -> int:
        """Stage (mjtStage) up to which `step` recomputes derived fields, such as xpos, after its last physics step."""

    @property
    def own_constants(self) -> bool:
        """Whether each world has its own values of the constants that MuJoCo derives (`set_constants`)."""

    @property
    def history(self) -> StateHistory:
        """Record of the states before the last calls of `step`."""

    def record_calls(self, calls: int, memory: int = HISTORY_MEMORY) -> None:
        """Record the states before the last `calls` calls of `step`; fewer calls if `memory` bytes are too little."""

    def recorded_calls(self, env: int) -> list[Call]:
        """Return the recorded calls of `step` in a world's present episode, the oldest first."""

    def state_row(self, env: int) -> NDArray[np.float64]:
        """Return a copy of a world's integration state (mjSTATE_INTEGRATION). (nstate,)"""

    def state_rows(self, envs: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return copies of the integration states (mjSTATE_INTEGRATION) of the worlds `envs`. (n, nstate)"""

    def own_model_fields(self, env: int) -> dict[str, NDArray[Any]]:
        """Return copies of one world's values of the model fields that differ between worlds, by name."""


class Engine(EngineView, Protocol):
    """Engine that steps `num_envs` worlds of `model`."""

    @property
    def replayable(self) -> ReplayableEngine | None:
        """The engine itself if its steps can be repeated bit for bit; None on a GPU."""

    @property
    def described_divergences(self) -> list[Divergence]:
        """First divergences that the last call of `diverged` found; on a GPU, the first divergence since the start."""

    def use_torch_stream(self) -> None:
        """Launch GPU kernels on torch's current CUDA stream from now on; environments call this before each step."""

    def can_expand(self, name: str) -> bool:
        """Return whether a model field may differ between worlds."""

    def expand(self, name: str) -> Tensor:
        """Give every world its own values of a model field; return a writable view of the values. (num_envs, ...)

        After a write to masses, inertias, positions and the like, call `set_constants`.

        Raises:
            ValueError: if the field cannot differ between worlds.
        """

    def expanded(self, name: str) -> Tensor | None:
        """Return a model field for which each world has its own values, (num_envs, ...); None if all share a value."""

    def set_constants(self, selection: Selection | None = None) -> None:
        """Recompute the constants that MuJoCo derives from model fields, after a write to expanded fields.

        Args:
            selection: the worlds; None: all. A GPU engine always recomputes all worlds.
        """

    def step(self, nstep: int, *, derive: bool = True) -> None:
        """Advance every world by `nstep` physics steps; then, with `derive`, update derived fields such as xpos."""

    def diverged(self, motion_is_finite: bool = False) -> Tensor | None:
        """Return whether each world diverged in the last `step`, (num_envs,) bool; None if no world did.

        Call this once per step. A GPU engine has already restored the state that these worlds had before the step.

        Args:
            motion_is_finite: whether the caller has checked that all positions and velocities are finite.
        """

    def forward(self, selection: Selection) -> None:
        """Compute the derived fields (xpos, ...) of the selected worlds from their state."""

    def reset(self, selection: Selection) -> None:
        """Set the selected worlds to the default state; `forward` then computes their derived fields."""

    def set_default_state(self, qpos: Tensor, qvel: Tensor) -> None:
        """Set the joint state that `reset` restores. (nq,), (nv,)"""

    def as_field(self, tensor: Tensor) -> Field:
        """Return a tensor in the form that `Selection.write` writes fastest.

        On a CPU this is a NumPy array that shares the tensor's memory, on a GPU the tensor itself.
        """

    def select(self, mask: Field, seed: int, counters: Field) -> Selection | None:
        """Return a selection of the worlds where `mask` is true; None if it is known to be empty.

        Args:
            mask: the worlds. (num_envs,) bool
            seed: seed of the selection's random numbers.
            counters: index of each world's random sequence, usually its episode. (num_envs,) int64
        """

    def rays(
        self, points: Tensor, directions: Tensor, *, groups: Groups, exclude: int, selection: Selection | None
    ) -> Tensor:
        """Return distances from points to the first geom along unit directions, -1 without a hit. (rows, rays) [m]

        Args:
            points: start points, world frame; one row per world, or per row of `selection`. (rows, rays, 3) float32
            directions: vectors of length 1. (rows, rays, 3) float32
            groups: geom groups that the rays can hit; None: all.
            exclude: a body whose geoms the rays cannot hit; -1: none.
            selection: the worlds; None: all.
        """

    def check_finite(self, values: Tensor, what: str) -> None:
        """Start a check that values are finite, on a GPU without a host sync; `report_nonfinite` returns the result.

        `what` is the name of the values for messages. A CPU engine does nothing: there, values are checked when they
        are computed.
        """

    def report_nonfinite(self) -> list[str]:
        """Return the names of the values for which `check_finite` failed since the last call."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the worlds' state, by name."""

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""

    def world(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return the model and the data of one world, for viewers and debugging."""

    def close(self) -> None:
        """Free threads and memory."""


class ReplayableEngine(Engine, ReplayableView, Protocol):
    """Engine with integration states on the CPU: steps from a stored state can be repeated bit for bit."""

    stream_ids: NDArray[np.int64] | None
    """Index of each world's random stream; None: the index of the world. (num_envs,)"""

    def set_state_row(self, env: int, row: NDArray[np.float64]) -> None:
        """Set the integration state of a world; derived fields keep their values."""

    def copy_data(self, env: int, data: mujoco.MjData) -> None:
        """Set the integration state and the derived fields of a world to those of an MjData."""

    def load_model_field(self, name: str, values: Tensor) -> None:
        """Give every world its own values of a model field, which were read from a file.

        Raises:
            ValueError: for values of another shape or type, or that could make MuJoCo read outside of its arrays.
        """

    def write_own_model(self, env: int, model: mujoco.MjModel) -> None:
        """Write one world's values of all model fields into `model`, a copy of the engine's model.

        The disable flags of `model` stay as in the engine's model, unless they differ between worlds.
        """


def open_engine(model: mujoco.MjModel, num_envs: int, config: SimConfig, *, device: str = "cpu") -> Engine:
    """Return the engine for a device: `sim.engine` of the configuration, by default `batch` on a CPU, `warp` on a GPU.

    Args:
        model: the compiled model.
        num_envs: number of worlds, one for each environment.
        config: configuration of the simulation.
        device: cpu, cuda or cuda:N.

    Raises:
        DependencyError: if MuJoCo Warp, which the GPU engine needs, is not installed.
        ConfigError: for a model that the engine cannot run, or an engine that does not run on the device.
        DeviceError: if the device is missing, or its memory does not hold all worlds.
    """
    on_cpu = device.partition(":")[0] == "cpu"
    engine = config.engine if config.engine != "auto" else "batch" if on_cpu else "warp"
    if engine == "batch" and not on_cpu:
        hint = "set sim.engine: auto, or give --device cpu"
        raise ConfigError([Problem("sim", "sim.engine", f"sim.engine 'batch' runs on a CPU, not on '{device}'", hint)])
    if engine == "batch":
        return open_cpu_engine(model, num_envs, config)
    require_device(device)
    try:
        with descriptor_redirected(2) if device == "cpu" else contextlib.nullcontext():
            from rlcli.sim.warp import WarpEngine  # without a GPU, Warp's libraries warn that there is no driver
    except ImportError as error:
        raise DependencyError(f"the GPU engine needs mujoco-warp: {error}", hint=pip_install("rlcli[gpu]")) from None
    return WarpEngine(model, num_envs, config, device)


def open_cpu_engine(model: mujoco.MjModel, num_envs: int, config: SimConfig) -> ReplayableEngine:
    """Return the CPU engine.

    Raises:
        DeviceError: for more worlds than the machine's memory holds.
    """
    from rlcli.sim.batch import BatchEngine

    return BatchEngine(model, num_envs, config)
