"""Integration states of the CPU engine's worlds: access, recording and checkpoints."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.sim.batch_model import INTEGRATION_STATE, BatchModel
from rlcli.sim.divergence_report import HISTORY_MEMORY, Call, StateHistory, StateLayout
from rlcli.sim.mujoco_private import STATE_FIELDS, state_columns
from rlcli.sim.saved_tensors import substate


class BatchState(BatchModel):
    """Base of the CPU engine: its worlds and their integration states."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, threads: int, *, persistent: bool) -> None:
        super().__init__(model, num_envs, threads, persistent=persistent)
        columns = state_columns(self._batch)
        self.state_layout = StateLayout(model, columns)
        self._sizes = {name: size for name, (_, size) in columns.items()}
        self._rows: NDArray[np.float64] = self._batch.state
        self._state = torch.from_numpy(self._rows)
        self._default = np.empty(self._batch.nstate)
        mujoco.mj_getState(model, mujoco.MjData(model), self._default, INTEGRATION_STATE)
        # the columns after ctrl usually keep their defaults, so the history omits them until one of them differs
        self.history = StateHistory(self._rows, self.state_layout.columns("ctrl").stop, self._default, 1)
        self._fields: dict[str, Tensor] = {}
        """Fields of MjData that are in use (requested with `field`)."""
        self._worlds: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}

    def record_calls(self, calls: int, memory: int = HISTORY_MEMORY) -> None:
        """Record the last calls of `step`: `calls` of them, or as many as fit into `memory` bytes."""
        self._new_history(self.history.width, calls, memory)

    def recorded_calls(self, env: int) -> list[Call]:
        """Return the recorded calls of a world in its present episode, the oldest first."""
        return self.history.calls_of(env)

    def state_row(self, env: int) -> NDArray[np.float64]:
        """Return a copy of a world's integration state. (nstate,)"""
        row: NDArray[np.float64] = self._rows[env].copy()
        return row

    def state_rows(self, envs: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return copies of the integration states of some worlds. (n, nstate)"""
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
        """Set the joint state that `reset` restores."""
        for name, values in (("qpos", qpos), ("qvel", qvel)):
            self._default[self.state_layout.columns(name)] = values.numpy()

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the state rows, the warning counters and the model fields with a value for each world."""
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
        """Return the model and the data of a world after `mj_forward`; a later call for it updates the same objects."""
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
