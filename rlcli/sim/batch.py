"""CPU engine on `mujoco.batch.Batch`, a thread pool in C++ that steps many worlds (simulations of environments).

Results are bit-identical for any number of threads.
"""

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
from rlcli.machine.cores import available_cores
from rlcli.sim import divergence_report as report
from rlcli.sim.acceleration_fields import ACCELERATION_FIELDS, force_sensor_columns
from rlcli.sim.batch_world_state import BatchWorlds, engine_call
from rlcli.sim.env_selection import Field, Groups, IdSelection, Selection, ids_of
from rlcli.sim.mujoco_private import STATE_FIELDS, forward_of, without_profiler
from rlcli.sim.saved_tensors import substate
from rlcli.sim.skippable_work import FIELDS_OF_SKIPPED_WORK

_MOTION_FIELDS = {"time", "qpos", "qvel", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "eq_active"}
"""Fields of the integration state of models without activations, plugins and the like.

If a model has only these, a physics step changes only positions, velocities, time and the warm start.
"""
_NONE, _VEL, _ACC = (
    int(s) for s in (mujoco.mjtStage.mjSTAGE_NONE, mujoco.mjtStage.mjSTAGE_VEL, mujoco.mjtStage.mjSTAGE_ACC)
)


class BatchEngine(BatchWorlds):
    """Engine that steps many worlds of one model on CPU threads, in float64.

    Args:
        model: the compiled model.
        num_envs: number of worlds.
        config: configuration of the simulation. With `external_forces`, `cfrc_ext` (forces on bodies) is computed
            exactly: Batch computes the field only for models with certain sensors, and with RK4 at the wrong stage of
            a physics step.

    Raises:
        DeviceError: for more worlds than the machine's memory holds.
    """

    asynchronous = False

    def __init__(self, model: mujoco.MjModel, num_envs: int, config: SimConfig) -> None:
        threads = config.engine_threads or available_cores()
        super().__init__(model, num_envs, threads, persistent=config.external_forces)
        self.shared_streams = 0
        self.stream_ids: NDArray[np.int64] | None = None
        """Index of each world's random stream; None: the index of the world. (num_envs,)"""
        self.device = torch.device("cpu")
        self.divergence_causes: dict[str, int] = {}
        self.described_divergences: list[report.Divergence] = []
        self.warnings = dict.fromkeys(report.OTHER_WARNINGS, 0)
        self._warning_words = self._batch.warning.reshape(-1).view(np.int64)
        self._failed = np.zeros(num_envs, dtype=bool)
        self._error = ""
        self._only_motion = not any(size for name, size in self._sizes.items() if name not in _MOTION_FIELDS)
        self._max_velocity = config.max_velocity or report.STATE_LIMIT
        self._qvel = self._rows[:, self.state_layout.columns("qvel")]
        self._reporter = report.DivergenceReporter(
            self.state_layout, self._rows, self._batch.warning, self._expanded, self._max_velocity
        )
        self._bound_inputs: list[NDArray[np.float64]] = []
        """Arrays of the state fields, except positions and velocities, that terms have requested and may write to."""
        self._substep_fields = config.derived_fields == "substep"
        self.step_stage = _NONE
        """Stage (mjtStage) up to which derived fields are computed after the last physics step of a call."""
        # start states get everything that `mj_forward` computes, including the warm start
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
        self._force_sensors = force_sensor_columns(model)

    @property
    def replayable(self) -> Self:
        """This engine: its steps can be repeated bit for bit."""
        return self

    def use_torch_stream(self) -> None:
        """Do nothing: a CPU has no streams."""

    def field(self, name: str) -> Tensor:
        """Return a live view of an MjData field, which each later step updates. (num_envs, ...)

        Raises:
            ValueError: if MjData has no such field.
        """
        if name not in self._fields:
            if name not in DATA_FIELDS:
                hint = did_you_mean(name, DATA_FIELDS) or "see mujoco/mjdata.h"
                raise ValueError(f"'{name}' is not an MjData field; {hint}")
            if name in FIELDS_OF_SKIPPED_WORK:
                self._skip_nothing()
            with warnings.catch_warnings(action="ignore"):  # torch warns about the read-only arrays of derived fields
                bound = self._bind(name)
            if self._of_substep(name):
                self._forward_stage = _ACC
            if name not in STATE_FIELDS:
                if not self._substep_fields and not self._only_of_acceleration_stage(name):
                    self.step_stage = _VEL
                    self._forward_stage = max(self._forward_stage, _VEL)
                self._forward_all()  # without this computation the new field would hold zeros
            self._fields[name] = bound
            if name in STATE_FIELDS:
                if self.state_layout.columns(name).stop > self.history.width:
                    self._record_all_columns()
                if name not in ("qpos", "qvel"):
                    self._bound_inputs.append(bound.numpy())
        return self._fields[name]

    def _bind(self, name: str) -> Tensor:
        """Return an MjData field as a tensor; a field of the state, such as qpos, is a view of `_state`."""
        values = self._batch.bind(name)
        if name not in STATE_FIELDS:
            return torch.from_numpy(values)
        strides = [step // values.itemsize for step in values.strides]
        return self._state.as_strided(values.shape, strides, self.state_layout.columns(name).start)

    def step(self, nstep: int, *, derive: bool = True) -> None:
        """Advance every world by `nstep` physics steps; then, with `derive`, update derived fields such as xpos."""
        self.history.record(nstep)
        try:
            with without_profiler:
                self._batch.step(nstep=nstep, stage=self.step_stage if derive else _NONE)
        except SimulationError:
            self._failed |= self._batch.status != 0  # failed worlds keep their old state; the others have stepped
            self._error = " ".join(self._batch.error(int(self._failed.argmax())).split()) or self._error
        if self._external is not None and derive:
            self._compute_external_forces(self._external.numpy())

    def _compute_external_forces(self, forces: NDArray[np.float64]) -> None:
        """Compute `cfrc_ext` of the last physics step; it is 0 in worlds without contacts, forces and equalities."""
        has_forces = self._contact_counts.reshape(-1) > 0
        if "xfrc_applied" in self._fields:
            has_forces |= self._fields["xfrc_applied"].numpy().any(axis=(1, 2))
        if self.model.neq:
            has_forces[:] = True
        forces[~has_forces] = 0.0
        for world in has_forces.nonzero()[0]:
            self._batch.get_data(world, self._data)
            mujoco.mj_rnePostConstraint(self.model, self._data)
            forces[world] = self._data.cfrc_ext

    def diverged(self, motion_is_finite: bool = False) -> Tensor | None:
        """Return whether each world diverged since the last call, (num_envs,) bool; None if no world diverged.

        `described_divergences` then has the first divergences. MuJoCo itself resets a diverging world to finite values,
        so the state does not show the divergence. MuJoCo's warning counters show it; they are read and cleared by every
        call. A divergence without a warning leaves a state that is not finite: the sum of all states is not finite.

        This sum takes longer than all other checks. If physics changes only positions and velocities, and the caller
        has checked these (`motion_is_finite`), only the inputs that terms may have written to are summed.
        """
        self.described_divergences = []
        warned = np.count_nonzero(self._warning_words) > 0
        finite = motion_is_finite and self._only_motion
        finite = finite and all([math.isfinite(np.add.reduce(values, axis=None)) for values in self._bound_inputs])
        # some columns never change, but a sum of whole rows is faster than a sum without these columns
        finite = finite or math.isfinite(self._state.sum().item()) or bool(self._state.isfinite().all())
        fast = self._max_velocity < report.STATE_LIMIT and bool((np.abs(self._qvel) > self._max_velocity).any())
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
        """Return whether each world diverged, and the cause (empty if it did not); clear the warning counters.

        `finite` is true if the state of every world is known to be finite.
        """
        counts = self._batch.warning[:, :, 1]
        for name, kind in report.OTHER_WARNINGS.items():
            self.warnings[name] += int((counts[:, kind] > 0).sum())
        bad = self._failed if finite else self._failed | ~np.isfinite(self._rows).all(axis=1)
        causes = np.full(self.num_envs, "", dtype=object)
        causes[self._failed] = report.ENGINE_ERROR
        for name, kind in report.DIVERGENCE_WARNINGS.items():
            warned = counts[:, kind] > 0
            causes[warned & (causes == "")] = name
            bad = bad | warned
        fast = np.asarray((np.abs(self._qvel) > self._max_velocity).any(axis=1)) & ~bad
        causes[fast] = report.TOO_FAST
        bad = bad | fast
        for env in (bad & (causes == "")).nonzero()[0]:
            causes[env] = f"{self._reporter.nonfinite_field(env)} not finite"
        self.described_divergences = [
            self._reporter.describe(env, causes[env], self.history.last_state(env), self._error)
            for env in bad.nonzero()[0].tolist()[: report.MAX_DESCRIBED]
        ]
        self._batch.warning[:] = 0
        self._failed = np.zeros(self.num_envs, dtype=bool)
        self._error = ""
        return bad, causes

    def forward(self, selection: Selection) -> None:
        """Compute the derived fields (xpos, ...) that have been requested with `field`, in the selected worlds."""
        if self._external is not None:
            selection.write(self._external, 0.0)  # no contact has acted on a start state yet
        if self._forward_stage == _NONE:
            return
        forces = self._forces(selection) if self._reset_stage < self._forward_stage else []
        saved = [field[index].clone() for field, index in forces]
        with engine_call():
            self._forward_rows(ids_of(selection), min(self._forward_stage, self._reset_stage))
        for (field, index), values in zip(forces, saved, strict=True):
            field[index] = values

    def _forces(self, selection: Selection) -> list[tuple[Tensor, Any]]:
        """Return (field, index of the selected worlds' values) for each requested field of forces or accelerations."""
        ids = ids_of(selection)
        return [
            (field, ids if name in ACCELERATION_FIELDS else (ids[:, None], self._force_sensors))
            for name, field in self._fields.items()
            if self._of_substep(name)
        ]

    def reset(self, selection: Selection) -> None:
        """Set the selected worlds to the default state, including controls and warm start."""
        ids = ids_of(selection)
        self._rows[ids] = self._default
        self.history.start_episodes(ids)
        if not self.forces_after_reset:
            for field, index in self._forces(selection):  # no force has acted on a start state yet
                field[index] = 0.0

    def as_field(self, tensor: Tensor) -> NDArray[Any]:
        """Return the tensor's memory as a NumPy array."""
        return tensor.numpy()

    def select(self, mask: Field, seed: int, counters: Field) -> IdSelection | None:
        """Return a selection of the worlds where `mask` is true, None if there are none; see `Engine.select`."""
        ids = np.asarray(mask).nonzero()[0]
        if not len(ids):
            return None
        return IdSelection(ids, seed, np.asarray(counters)[ids], stream_ids=self.stream_ids)

    def rays(
        self, points: Tensor, directions: Tensor, *, groups: Groups, exclude: int, selection: Selection | None
    ) -> Tensor:
        """Return the distance to the first geom on each ray, -1 without a hit; see `Engine.rays`. (rows, rays) [m]"""
        visible = None if groups is None else np.array([g in groups for g in range(mujoco.mjNGROUP)], dtype=np.uint8)
        ids = None if selection is None else ids_of(selection).astype(np.int32)
        start, along = points.double().numpy(), directions.double().numpy()
        with engine_call():
            distance, _ = self._batch.ray(start, along, geomgroup=visible, bodyexclude=exclude, ids=ids)
        return torch.from_numpy(distance).float()

    def check_finite(self, values: Tensor, what: str) -> None:
        """Do nothing: on a CPU, values are checked when they are computed."""

    def report_nonfinite(self) -> list[str]:
        """Return an empty list: `check_finite` does nothing."""
        return []

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the worlds' state, by name.

        The state includes the fields of forces and accelerations that have been requested with `field`, because
        MuJoCo's mj_forward cannot compute the values of the last physics step from the other fields.
        """
        substep = {f"substep.{name}": value.clone() for name, value in self._fields.items() if self._of_substep(name)}
        return {**super().state_dict(), **substep}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`, and compute derived fields again.

        Raises:
            ValueError: for a model field that cannot differ between environments, or that has another shape.
        """
        super().load_state_dict(state)
        substep = substate(state, "substep.")
        for name in substep:
            self.field(name)  # request the field here too: it was requested when the state was saved
        if self._forward_stage != _NONE:
            with without_profiler:
                self._batch.forward(stage=self._forward_stage)
        for name, values in substep.items():
            self._fields[name].copy_(values)

    def close(self) -> None:
        """Do nothing: Python frees threads and memory."""

    def _forward_all(self) -> None:
        """Compute the requested derived fields of every world from its state; forces keep their values."""
        saved = {name: value.clone() for name, value in self._fields.items() if self._of_substep(name)}
        with engine_call():
            self._batch.forward(stage=self._forward_stage)
        for name, value in saved.items():
            self._fields[name].copy_(value)

    def _only_of_acceleration_stage(self, name: str) -> bool:
        """Return whether MuJoCo computes all values of a field in the acceleration stage of a step."""
        if name == "sensordata":
            return len(self._force_sensors) == int(self.model.nsensordata)
        return name in ACCELERATION_FIELDS

    def _of_substep(self, name: str) -> bool:
        """Return whether a field has values of the last physics step that no state determines, such as forces."""
        if name in ACCELERATION_FIELDS or (name == "sensordata" and self._force_sensors):
            return True
        return bool(self._substep_fields) and name not in STATE_FIELDS
