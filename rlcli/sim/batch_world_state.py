"""Base class of the CPU engine that holds its worlds (one for each environment) and their states.

For domain randomisation, the class also gives each world its own values of model fields.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS, SimulationError
from numpy.typing import NDArray
from torch import Tensor

from rlcli.errors import DivergedError, did_you_mean, listing, one_line
from rlcli.machine.memory import require_memory
from rlcli.sim.divergence_report import HISTORY_MEMORY, MORE_MEMORY, Call, StateHistory, StateLayout
from rlcli.sim.env_selection import Selection, ids_of
from rlcli.sim.mujoco_private import (
    STATE_FIELDS,
    expand_disable_flags,
    expanded_fields,
    make_batch,
    state_columns,
    without_profiler,
)
from rlcli.sim.quiet_mujoco import quiet_mujoco
from rlcli.sim.saved_tensors import require_matching_tensors, substate
from rlcli.sim.skippable_work import FIELDS_OF_FRICTION, skippable_flags

INTEGRATION_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_FLAGS = {
    *("geom_contype", "geom_conaffinity", "geom_priority", "geom_group", "jnt_limited", "jnt_actgravcomp"),
    *("jnt_actfrclimited", "tendon_limited", "tendon_actfrclimited", "actuator_ctrllimited", "actuator_actlimited"),
    *("actuator_forcelimited", "eq_active0", "opt.disableactuator"),
}
"""Integer fields of a model that are flags: unlike an index, a flag cannot make MuJoCo read outside of its arrays."""
_MIN_STATES_PER_ENV = 3
"""Lower bound of an environment's memory, in sizes of its integration state; built-in tasks need 3.3 to 16 sizes."""


class BatchWorlds:
    """Base class of the CPU engine: its worlds, their states, and the model fields that differ between worlds.

    Raises:
        DeviceError: for more worlds than the machine's memory holds.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, threads: int, *, persistent: bool) -> None:
        quiet_mujoco()
        each = _MIN_STATES_PER_ENV * 8 * mujoco.mj_stateSize(model, INTEGRATION_STATE)
        require_memory(each * num_envs, f"{num_envs} environments")
        self.model = model
        self.num_envs = num_envs
        self.threads = threads
        self._disable_flags = model.opt.disableflags
        self._skipped = skippable_flags(model)
        """Disable flags (mjtDisableBit) set for computations that steps skip because they do not change the state."""
        self._batch = make_batch(model, num_envs, threads, disable_flags=self._skipped, persistent=persistent)
        self._expanded = expanded_fields(self._batch)
        self.own_constants = False
        """Whether each world has its own values of the constants that MuJoCo derives (`set_constants`)."""
        columns = state_columns(self._batch)
        self.state_layout = StateLayout(model, columns)
        self._sizes = {name: size for name, (_, size) in columns.items()}
        self._rows: NDArray[np.float64] = self._batch.state
        self._state = torch.from_numpy(self._rows)
        self._default = np.empty(self._batch.nstate)
        mujoco.mj_getState(model, mujoco.MjData(model), self._default, INTEGRATION_STATE)
        self.history = StateHistory(self._rows, self.state_layout.columns("ctrl").stop, self._default, 1)
        self._fields: dict[str, Tensor] = {}
        """Fields of MjData that have been requested with `field`, by name."""
        self._worlds: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}

    def can_expand(self, name: str) -> bool:
        """Return whether a model field may differ between worlds."""
        return name in MODEL_FIELDS

    def expand(self, name: str) -> Tensor:
        """Give every world its own values of a model field; return a writable view of the values. (num_envs, ...)

        Raises:
            ValueError: if the field cannot differ between worlds.
        """
        if name not in MODEL_FIELDS:
            hint = did_you_mean(name, MODEL_FIELDS) or f"fields that can: {listing(sorted(MODEL_FIELDS))}"
            raise ValueError(f"model field '{name}' cannot differ between environments; {hint}")
        values = torch.from_numpy(self._batch.expand(name))
        adds_constraints = name in FIELDS_OF_FRICTION and self._skipped & int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        if adds_constraints or not values.is_floating_point():
            self._skip_nothing()
        return values

    def expanded(self, name: str) -> Tensor | None:
        """Return a model field for which each world has its own values, (num_envs, ...); None if all share a value."""
        return self.expand(name) if name in self._expanded else None

    def expanded_fields(self) -> list[str]:
        """Return the names of the model fields for which each world has its own values (see `Engine.expand`)."""
        return list(self._expanded)

    def set_constants(self, selection: Selection | None = None) -> None:
        """Recompute the constants that MuJoCo derives from model fields such as masses (mj_setConst).

        `selection` are the worlds; None: all.
        """
        with engine_call():
            self._batch.set_const(None if selection is None else ids_of(selection).astype(np.int32))
        self.own_constants = True

    def own_model_fields(self, env: int) -> dict[str, NDArray[Any]]:
        """Return copies of one world's values of the model fields that differ between worlds, by name."""
        return {name: np.array(values[env]) for name, values in self._expanded.items()}

    def load_model_field(self, name: str, values: Tensor) -> None:
        """Give every world its own values of a model field, which were read from a file.

        Raises:
            ValueError: for values of another shape or type, or that could make MuJoCo read outside of its arrays.
        """
        target = self.expand(name)
        require_matching_tensors({name: values}, {name: target}, "model field")
        if not target.dtype.is_floating_point and name not in _FLAGS and not torch.equal(target, values):
            message = f"model field '{name}' differs from the saved values"
            raise ValueError(f"{message}; restore the MJCF with which the state was saved")
        target.copy_(values)

    def write_own_model(self, env: int, model: mujoco.MjModel) -> None:
        """Write one world's values of all model fields into `model`, a copy of the engine's model.

        The disable flags of `model` stay as in the engine's model unless they differ between worlds.
        """
        self._batch.get_model(env, model)
        if "opt.disableflags" not in self._expanded:
            model.opt.disableflags = self._disable_flags

    def record_calls(self, calls: int, memory: int = HISTORY_MEMORY) -> None:
        """Record the states before the last `calls` calls of `step`; fewer calls if `memory` bytes are too little."""
        self._new_history(self.history.width, calls, memory)

    def recorded_calls(self, env: int) -> list[Call]:
        """Return the recorded calls of `step` in a world's present episode, the oldest first."""
        return self.history.calls_of(env)

    def state_row(self, env: int) -> NDArray[np.float64]:
        """Return a copy of a world's integration state (mjSTATE_INTEGRATION). (nstate,)"""
        row: NDArray[np.float64] = self._rows[env].copy()
        return row

    def state_rows(self, envs: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return copies of the integration states (mjSTATE_INTEGRATION) of the worlds `envs`. (n, nstate)"""
        return self._rows[envs]

    def set_state_row(self, env: int, row: NDArray[np.float64]) -> None:
        """Set the integration state of a world; derived fields keep their values."""
        self._rows[env] = row
        self._batch.warning[env] = 0

    def copy_data(self, env: int, data: mujoco.MjData) -> None:
        """Set the integration state and the derived fields of a world to those of an MjData."""
        mujoco.mj_getState(self.model, data, self._rows[env], INTEGRATION_STATE)
        for name, field in self._fields.items():
            if name not in STATE_FIELDS and hasattr(data, name):
                field[env] = torch.from_numpy(np.array(getattr(data, name))).reshape(field[env].shape)

    def set_default_state(self, qpos: Tensor, qvel: Tensor) -> None:
        """Set the positions and velocities that `reset` restores. (nq,), (nv,)"""
        for name, values in (("qpos", qpos), ("qvel", qvel)):
            self._default[self.state_layout.columns(name)] = values.numpy()

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the states, the warning counters and the model fields that differ between worlds."""
        return {
            "state": self._state.clone(),
            "warning": torch.from_numpy(np.array(self._batch.warning)),
            "constants": torch.tensor(self.own_constants),
            **{f"model.{name}": torch.from_numpy(np.array(values)) for name, values in self._expanded.items()},
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`.

        Raises:
            ValueError: for a model field that cannot differ between environments, or that has another shape.
        """
        self._state.copy_(state["state"])
        width = self.history.width
        if (self._rows[:, width:] != self._default[width:]).any():
            self._record_all_columns()
        self.history.clear()
        self._batch.warning[:] = state["warning"].numpy()
        for name, values in substate(state, "model.").items():
            self.load_model_field(name, values)
        if bool(state["constants"]):
            self.set_constants()

    def world(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return (model, data) of a world after `mj_forward`; a later call for the same world updates these objects."""
        is_new = env not in self._worlds
        if is_new:
            self._worlds[env] = (copy.copy(self.model), self._batch.get_data(env))
        model, data = self._worlds[env]
        if is_new or self._expanded:
            self.write_own_model(env, model)
        self._batch.get_data(env, data)
        mujoco.mj_forward(model, data)
        return model, data

    def _record_all_columns(self) -> None:
        self._new_history(self._batch.nstate, self.history.requested_calls, self.history.memory)

    def _new_history(self, width: int, calls: int, memory: int) -> None:
        count = self.history.count
        self.history = StateHistory(self._rows, width, self._default, calls, memory=memory, count=count)

    def _skip_nothing(self) -> None:
        """Let MuJoCo compute everything from now on: set the disable flags back to those of the original model."""
        if self._skipped:
            self._skipped = 0
            expand_disable_flags(self._batch)[:] = self._disable_flags


@contextlib.contextmanager
def engine_call() -> Iterator[None]:
    """Turn MuJoCo's profiler off in the `with` block, and convert errors of `mujoco.batch` to errors of rlcli.

    Raises:
        DivergedError: if `mujoco.batch` raises an error.
    """
    try:
        with without_profiler:
            yield
    except SimulationError as error:
        raise DivergedError(f"the physics engine stopped: {one_line(error)}", hint=MORE_MEMORY) from None
