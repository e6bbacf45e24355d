"""The CPU engine, on `mujoco.batch.Batch`: a C++ thread pool over state rows, bit-identical at any thread count."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any, Self

import mujoco
import numpy as np
import torch
from mujoco.batch import DATA_FIELDS, SimulationError
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.schema import SimConfig
from rlcli.errors import did_you_mean
from rlcli.machine import available_cores
from rlcli.sim.acceleration_stage import ACCELERATION_FIELDS, force_sensors
from rlcli.sim.batch_model import engine_error
from rlcli.sim.batch_state import BatchState
from rlcli.sim.divergence_report import (
    DIVERGENCE_WARNINGS,
    ENGINE_ERROR,
    MAX_DESCRIBED,
    OTHER_WARNINGS,
    STATE_LIMIT,
    TOO_FAST,
    Divergence,
    DivergenceReporter,
)
from rlcli.sim.mujoco_private import STATE_FIELDS, forward_of, without_profiler
from rlcli.sim.selection import Field, IdSelection, Selection, ids_of
from rlcli.sim.skippable_work import FIELDS_OF_SKIPPED_WORK

_MOTION_FIELDS = frozenset(
    ["time", "qpos", "qvel", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "eq_active"]
)
"""Fields of a state of which physics changes positions and velocities alone, and what follows from these."""
_NONE, _VEL, _ACC = (
    int(s) for s in (mujoco.mjtStage.mjSTAGE_NONE, mujoco.mjtStage.mjSTAGE_VEL, mujoco.mjtStage.mjSTAGE_ACC)
)


class BatchEngine(BatchState):
    """Many worlds of one model on CPU threads. Physics is float64.

    Args:
        model: the compiled model.
        num_envs: worlds.
        config: of the simulation. With `external_forces`, `cfrc_ext` is computed exactly: Batch itself computes it for
            models with certain sensors alone, and with RK4 at the wrong one of a substep's stages.

    Raises:
        DeviceError: for more worlds than the machine's memory holds.
    """

    asynchronous = False

    def __init__(self, model: mujoco.MjModel, num_envs: int, config: SimConfig) -> None:
        threads = config.engine_threads or available_cores()
        super().__init__(model, num_envs, threads, persistent=config.external_forces)
        self.shared_streams = 0
        self.device = torch.device("cpu")
        self.divergence_causes: dict[str, int] = {}
        self.described_divergences: list[Divergence] = []
        self.warnings = dict.fromkeys(OTHER_WARNINGS, 0)
        self._warning_words = self._batch.warning.reshape(-1).view(np.int64)
        self._failed = np.zeros(num_envs, dtype=bool)
        self._error = ""
        self._only_motion = not any(size for name, size in self._sizes.items() if name not in _MOTION_FIELDS)
        self._max_velocity = config.max_velocity or STATE_LIMIT
        self._qvel = self._rows[:, self.state_layout.columns("qvel")]
        self._reporter = DivergenceReporter(
            self.state_layout, self._rows, self._batch.warning, self._expanded, self._max_velocity
        )
        self._bound_inputs: list[NDArray[np.float64]] = []
        """Bound fields of the state except positions and velocities: terms may write to them."""
        self._substep_fields = config.derived_fields == "substep"
        self.step_stage = _NONE
        """mjtStage that the last substep ends with, for the bound fields."""
        # a start state gets what `mj_forward` computes, warm start included
        self._forward_stage = _ACC if self._substep_fields else _NONE
        self._forward_rows = forward_of(self._batch)
        self._external: Tensor | None = None
        if config.external_forces:
            self._external = torch.zeros(num_envs, model.nbody, 6, dtype=torch.float64)
            self._fields["cfrc_ext"] = self._external
            self._contact_counts = self._batch.bind("ncon")
            self._data = mujoco.MjData(model)
        self.forces_after_reset = config.forces_after_reset
        self._reset_stage = _ACC if config.forces_after_reset else _VEL
        self._force_sensors = force_sensors(model)

    @property
    def replayable(self) -> Self:
        """This engine: its calls can be stepped again bit for bit."""
        return self

    @property
    def divergences(self) -> int:
        """Number of worlds that diverged, ever."""
        return sum(self.divergence_causes.values())

    def use_torch_stream(self) -> None:
        """Do nothing: calls return when their work is done."""

    def field(self, name: str) -> Tensor:
        """Return a live view of an MjData field. For a derived one, the last substep computes its stage from now on."""
        if name not in self._fields:
            if name not in DATA_FIELDS:
                raise ValueError(f"'{name}' is not an MjData field; {did_you_mean(name, DATA_FIELDS) or ''}")
            if name in FIELDS_OF_SKIPPED_WORK:
                self._skip_nothing()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torch has no read-only tensors; derived views must only be read
                bound = self._bind(name)
            if self._of_substep(name):
                self._forward_stage = _ACC
            if name not in STATE_FIELDS:
                if not self._substep_fields and not self._only_of_acceleration_stage(name):
                    self.step_stage = _VEL
                    self._forward_stage = max(self._forward_stage, _VEL)
                self._forward_all()  # until then, the new field holds zeros
            self._fields[name] = bound
            if name in STATE_FIELDS:
                if self.state_layout.columns(name).stop > self.history.width:
                    self._record_all_columns()
                if name not in ("qpos", "qvel"):
                    self._bound_inputs.append(bound.numpy())
        return self._fields[name]

    def _bind(self, name: str) -> Tensor:
        """Return a field as a tensor; a part of the state as a view of it, so that neighbours can be one view."""
        values = self._batch.bind(name)
        if name not in STATE_FIELDS:
            return torch.from_numpy(values)
        strides = [step // values.itemsize for step in values.strides]
        return self._state.as_strided(values.shape, strides, self.state_layout.columns(name).start)

    def step(self, nstep: int, *, derive: bool = True) -> None:
        """Advance every world by `nstep` physics steps; without `derive`, derived fields keep their values."""
        self.history.record(nstep)
        try:
            with without_profiler:
                self._batch.step(nstep=nstep, stage=self.step_stage if derive else _NONE)
        except SimulationError:
            self._failed |= self._batch.status != 0  # their rows are as they were; the others have been stepped
            self._error = " ".join(self._batch.error(int(self._failed.argmax())).split()) or self._error
        if self._external is not None and derive:
            self._compute_external_forces(self._external.numpy())

    def _compute_external_forces(self, forces: NDArray[np.float64]) -> None:
        """Compute `cfrc_ext` of the last substep. It is 0 where nothing touches, pushes or holds a body."""
        acts = self._contact_counts.reshape(-1) > 0
        if "xfrc_applied" in self._fields:
            acts |= self._fields["xfrc_applied"].numpy().any(axis=(1, 2))
        if self.model.neq:
            acts[:] = True
        forces[~acts] = 0.0
        for world in acts.nonzero()[0]:
            self._batch.get_data(world, self._data)
            mujoco.mj_rnePostConstraint(self.model, self._data)
            forces[world] = self._data.cfrc_ext

    def diverged(self, motion_is_finite: bool = False) -> Tensor | None:
        """Return the worlds that diverged since the last call; `described_divergences` then has the first of them.

        MuJoCo resets a diverging world by itself, to finite values, and clears its counters as it does: so they are
        read after every step and put back to zero, and the state alone would show nothing. What gives no warning is
        not finite afterwards: the sum of all states then is not, either. That sum takes longer than all other checks
        of a state. Where physics changes positions and velocities alone, and the caller has checked these, the inputs
        that terms may have written to are summed instead.
        """
        self.described_divergences = []
        warned = np.count_nonzero(self._warning_words) > 0
        finite = False
        if motion_is_finite and self._only_motion:
            finite = all([math.isfinite(np.add.reduce(values, axis=None)) for values in self._bound_inputs])
        # of whole rows: skipping the columns that nobody writes takes longer
        finite = finite or math.isfinite(self._state.sum().item()) or bool(self._state.isfinite().all())
        fast = self._max_velocity < STATE_LIMIT and bool((np.abs(self._qvel) > self._max_velocity).any())
        if not warned and finite and not self._error and not fast:
            return None
        bad, causes = self._find_diverged(finite)
        if not bad.any():
            return None
        names, counts = np.unique(causes[bad], return_counts=True)
        for name, count in zip(names.tolist(), counts.tolist(), strict=True):
            self.divergence_causes[name] = self.divergence_causes.get(name, 0) + count
        return torch.from_numpy(bad)

    def _find_diverged(self, finite: bool) -> tuple[NDArray[np.bool_], NDArray[np.object_]]:
        """Return which worlds diverged, and the cause of each; put the counters back to zero."""
        counts = self._batch.warning[:, :, 1]
        for name, kind in OTHER_WARNINGS.items():
            self.warnings[name] += int((counts[:, kind] > 0).sum())
        bad = self._failed if finite else self._failed | ~np.isfinite(self._rows).all(axis=1)
        causes = np.full(self.num_envs, "", dtype=object)
        causes[self._failed] = ENGINE_ERROR
        for name, kind in DIVERGENCE_WARNINGS.items():
            warned = counts[:, kind] > 0
            causes[warned & (causes == "")] = name
            bad = bad | warned
        fast = np.asarray((np.abs(self._qvel) > self._max_velocity).any(axis=1)) & ~bad
        causes[fast] = TOO_FAST
        bad = bad | fast
        for env in (bad & (causes == "")).nonzero()[0]:
            causes[env] = f"{self._reporter.nonfinite_field(env)} not finite"
        self.described_divergences = [
            self._reporter.describe(env, causes[env], self.history.last_state(env), self._error)
            for env in bad.nonzero()[0].tolist()[:MAX_DESCRIBED]
        ]
        self._batch.warning[:] = 0
        self._failed = np.zeros(self.num_envs, dtype=bool)
        self._error = ""
        return bad, causes

    def forward(self, selection: Selection) -> None:
        """Compute the bound derived fields of the selected worlds."""
        if self._external is not None:
            selection.write(self._external, 0.0)  # no contact has acted on a start state yet
        if self._forward_stage == _NONE:
            return
        forces = self._forces(selection) if self._reset_stage < self._forward_stage else []
        kept = [field[where].clone() for field, where in forces]
        try:
            with without_profiler:
                self._forward_rows(ids_of(selection), min(self._forward_stage, self._reset_stage))
        except SimulationError as error:
            raise engine_error(error) from None
        for (field, where), values in zip(forces, kept, strict=True):
            field[where] = values

    def _forces(self, selection: Selection) -> list[tuple[Tensor, Any]]:
        """Return the bound fields of the acceleration stage, and the index of the selected worlds' values in each."""
        ids = ids_of(selection)
        return [
            (field, ids if name in ACCELERATION_FIELDS else (ids[:, None], self._force_sensors))
            for name, field in self._fields.items()
            if self._of_substep(name)
        ]

    def reset(self, selection: Selection) -> None:
        """Put the selected worlds into the default state: the whole row, controls and warm start included."""
        ids = ids_of(selection)
        self._rows[ids] = self._default
        self.history.start_episodes(ids)
        if not self.forces_after_reset:
            for field, where in self._forces(selection):  # no force has acted on a start state yet
                field[where] = 0.0

    def as_field(self, tensor: Tensor) -> NDArray[Any]:
        """Return an array of the same memory."""
        return tensor.numpy()

    def select(self, mask: Field, seed: int, counters: Field) -> IdSelection | None:
        """Return the worlds where `mask` holds, as ids; None for none."""
        ids = (mask if isinstance(mask, np.ndarray) else mask.numpy()).nonzero()[0]
        if not len(ids):
            return None
        counted = counters if isinstance(counters, np.ndarray) else counters.numpy()
        return IdSelection(ids, seed, counted[ids], shared_streams=self.shared_streams)

    def rays(
        self,
        points: Tensor,
        directions: Tensor,
        *,
        groups: tuple[int, ...] | None = None,
        exclude: int = -1,
        selection: Selection | None = None,
    ) -> Tensor:
        """Return distances from points to the first geom along unit directions, -1 for none. (rows, rays)"""
        seen = None if groups is None else np.array([g in groups for g in range(mujoco.mjNGROUP)], dtype=np.uint8)
        ids = None if selection is None else ids_of(selection).astype(np.int32)
        try:
            with without_profiler:
                distance, _ = self._batch.ray(
                    points.double().numpy(), directions.double().numpy(), geomgroup=seen, bodyexclude=exclude, ids=ids
                )
        except SimulationError as error:
            raise engine_error(error) from None
        return torch.from_numpy(distance).float()

    def check_finite(self, values: Tensor, what: str) -> None:
        """Do nothing: on a CPU, values are checked where they are computed."""

    def report_nonfinite(self) -> list[str]:
        """Return nothing."""
        return []

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of what the worlds carry from step to step.

        Also of the bound fields of the last substep, which no forward pass from the state restores.
        """
        substep = {f"substep.{name}": value.clone() for name, value in self._fields.items() if self._of_substep(name)}
        return {**super().state_dict(), **substep}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned; compute derived fields anew.

        Raises:
            ValueError: for a model field that cannot differ between worlds, or of another shape.
        """
        super().load_state_dict(state)
        substep = {n.removeprefix("substep."): values for n, values in state.items() if n.startswith("substep.")}
        for name in substep:
            self.field(name)  # bound when the state was saved; here it may be bound later
        if self._forward_stage != _NONE:
            with without_profiler:
                self._batch.forward(stage=self._forward_stage)
        for name, values in substep.items():
            self._fields[name].copy_(values)

    def close(self) -> None:
        """Do nothing: Python frees everything."""

    def _forward_all(self) -> None:
        """Compute the bound fields of every world from its state; fields of the last substep keep their values."""
        kept = {name: value.clone() for name, value in self._fields.items() if self._of_substep(name)}
        try:
            with without_profiler:
                self._batch.forward(stage=self._forward_stage)
        except SimulationError as error:
            raise engine_error(error) from None
        for name, value in kept.items():
            self._fields[name].copy_(value)

    def _only_of_acceleration_stage(self, name: str) -> bool:
        """Return whether the acceleration stage alone writes the field, or every sensor of `sensordata`."""
        if name == "sensordata":
            return len(self._force_sensors) == int(self.model.nsensordata)
        return name in ACCELERATION_FIELDS

    def _of_substep(self, name: str) -> bool:
        """Return whether the field holds values that only a substep computes."""
        if name in ACCELERATION_FIELDS or (name == "sensordata" and self._force_sensors):
            return True
        return bool(self._substep_fields) and name not in STATE_FIELDS
