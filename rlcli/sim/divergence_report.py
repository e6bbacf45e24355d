"""Describe diverged simulations: the cause of the divergence, and the recorded engine calls before it.

Logs and crash dumps show the descriptions. The columns of the integration state (`StateLayout`) are here, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

STATE_LIMIT = 1e10
"""Largest position, velocity or acceleration that MuJoCo accepts (mjMAXVAL)."""
MAX_DESCRIBED = 4
"""Largest number of environments that are described after a divergence."""
ENGINE_ERROR = "engine error"
"""Cause: the engine could not step the environment."""
TOO_FAST = "qvel out of bounds"
"""Cause: a velocity is above the limit of the task."""
HISTORY_MEMORY = 64 * 2**20
"""Default memory limit of a `StateHistory` [bytes]."""
MORE_MEMORY = "if the contact arena is full, set a larger <size memory=...> in the MJCF"
"""Hint for an error of the engine; its usual cause is too little memory for contacts."""
WARNING_FIELDS = {"BADCTRL": "ctrl", "BADQPOS": "qpos", "BADQVEL": "qvel", "BADQACC": "qacc"}
"""MuJoCo warning that means divergence -> MjData field to which the index stored with the warning belongs."""
DIVERGENCE_WARNINGS = {name: int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in WARNING_FIELDS}
"""Warnings after which MuJoCo resets a world or ignores its controls: name -> index (mjtWarning).

If a world has several warnings, the first one in this order is the cause.
"""
OTHER_WARNINGS = {
    "contact_full": int(mujoco.mjtWarning.mjWARN_CONTACTFULL),
    "constraint_full": int(mujoco.mjtWarning.mjWARN_CNSTRFULL),
    "inertia": int(mujoco.mjtWarning.mjWARN_INERTIA),
}
"""Warnings of MuJoCo that are counted, but do not mean divergence: name -> index (mjtWarning)."""
_INPUTS_FIRST = (
    *("mocap_pos", "mocap_quat", "ctrl", "xfrc_applied", "qfrc_applied", "act", "eq_active", "userdata", "history"),
    *("plugin_state", "plastic", "qpos", "qvel", "qacc_warmstart", "time"),
)
"""Fields of the integration state, inputs first: the first field that is not finite is the likely cause of others."""

States = NDArray[np.float64]
"""Integration states (mjSTATE_INTEGRATION): a row for each environment, or the state of one environment."""


@dataclass(frozen=True, slots=True)
class Divergence:
    """Divergence of the simulation of one environment."""

    env: int
    """Index of the environment."""
    cause: str
    """MuJoCo's warning without its prefix (`BADQACC`), `FIELD not finite`, `FIELD out of bounds`, or `engine error`."""
    detail: str = ""
    """Element of the model (such as a joint) with the bad value, and a field that was not finite before.

    For the cause `engine error`, the error message of the engine.
    """
    index: int = -1
    """Index of the bad value in the field of the warning or in `qvel`; -1 if unknown."""

    def __str__(self) -> str:
        """Return a text such as `environment 3: BADQACC (joint 'swing')`."""
        return f"environment {self.env}: {self.cause}{f' ({self.detail})' if self.detail else ''}"


@dataclass(frozen=True, slots=True)
class Call:
    """Record of a call of `Engine.step` in one environment."""

    state: States
    """Integration state before the call. (nstate,)"""
    nstep: int
    """Number of physics steps of the call."""


class StateHistory:
    """Ring buffer of the states of all environments before the last calls of `Engine.step`, from which replays start.

    Only the first `width` columns of the states are recorded; in the other columns every state equals `default`.

    Args:
        state: the engine's integration states, a live view. (n, nstate)
        width: number of leading columns that are recorded.
        default: the state after a reset. (nstate,)
        calls: number of calls to record, if they fit.
        memory: memory limit of the ring buffer [bytes].
        count: number of calls that an earlier history recorded.
    """

    def __init__(
        self, state: States, width: int, default: States, calls: int, *, memory: int = HISTORY_MEMORY, count: int = 0
    ) -> None:
        self._default = default
        self._source = state[:, :width]
        self.width = width
        """Number of leading columns that are recorded."""
        self.memory = memory
        self.requested_calls = calls
        self.calls = max(1, min(calls, memory // max(1, self._source.nbytes)))
        """Length of the ring buffer, in calls."""
        self._ring = np.empty((self.calls, *self._source.shape))
        self._nstep = [0] * self.calls
        self.count = self._oldest = count
        """Number of calls recorded since the start, including those of earlier histories."""
        self._episode_start = np.full(len(state), count, dtype=np.int64)

    def record(self, nstep: int) -> None:
        """Record the present states; the engine calls this before a call of `nstep` physics steps."""
        slot = self.count % self.calls
        self._ring[slot] = self._source
        self._nstep[slot] = nstep
        self.count += 1

    def clear(self) -> None:
        """Drop all recorded calls, after all worlds were given another state."""
        self._oldest = self.count
        self._episode_start[:] = self.count

    def start_episodes(self, envs: NDArray[np.int64]) -> None:
        """Start new episodes of the environments `envs`; their earlier calls are dropped."""
        self._episode_start[envs] = self.count

    def last_state(self, env: int) -> States:
        """Return the state before the last call; the default state if the episode has no call yet."""
        if self._episode_start[env] == self.count:
            return self._default.copy()
        return self._state_before(env, self.count - 1)

    def calls_of(self, env: int) -> list[Call]:
        """Return the calls of an environment in its present episode, the oldest first."""
        return self.calls_between(env, int(self._episode_start[env]), self.count)

    def calls_between(self, env: int, first: int, stop: int) -> list[Call]:
        """Return the calls of an environment with the numbers `first` to `stop` - 1, as far as the buffer has them."""
        first = max(first, self._oldest, self.count - self.calls)
        numbers = range(first, min(stop, self.count))
        return [Call(self._state_before(env, number), self._nstep[number % self.calls]) for number in numbers]

    def _state_before(self, env: int, call: int) -> States:
        """Return a copy of the integration state of an environment before call number `call`. (nstate,)"""
        state = self._default.copy()
        state[: self.width] = self._ring[call % self.calls, env]
        return state


class StateLayout:
    """Columns of each field (qpos, qvel, ...) in an integration state.

    Args:
        model: the compiled model.
        columns: field -> first column and number of columns, in the order of the columns.
    """

    def __init__(self, model: mujoco.MjModel, columns: Mapping[str, tuple[int, int]]) -> None:
        self._model = model
        self._columns = {name: slice(start, start + size) for name, (start, size) in columns.items()}

    def columns(self, name: str) -> slice:
        """Return the columns of a field in the integration state."""
        return self._columns[name]

    def fields(self) -> list[tuple[str, slice]]:
        """Return every field of the integration state with its columns."""
        return list(self._columns.items())

    def nonfinite_fields(self, state: States) -> list[str]:
        """Return the names of the fields of a state (nstate,) that are not finite, inputs of the simulation first."""
        names = [name for name in _INPUTS_FIRST if name in self._columns]
        return [name for name in names if not np.isfinite(state[self._columns[name]]).all()]

    def element_at(self, name: str, index: int) -> str:
        """Return the element of the model to which entry `index` of field `name` belongs, such as `joint 'swing'`."""
        m = self._model
        if name == "qpos" and 0 <= index < m.nq:
            joint = int(np.searchsorted(m.jnt_qposadr, index, side="right")) - 1
            return _element_name(m, mujoco.mjtObj.mjOBJ_JOINT, joint, "joint")
        if name in ("qvel", "qacc") and 0 <= index < m.nv:
            return _element_name(m, mujoco.mjtObj.mjOBJ_JOINT, int(m.dof_jntid[index]), "joint")
        if name == "ctrl" and 0 <= index < m.nu:
            return _element_name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, index, "actuator")
        return f"{name}[{index}]"


@dataclass(frozen=True, slots=True)
class DivergenceReporter:
    """Finder of the causes of divergences in the worlds of the CPU engine.

    Args:
        layout: columns of the integration state.
        states: the engine's integration states, a live view. (n, nstate)
        warnings: MuJoCo's warning counters, a live view: last index and count of each kind. (n, kinds, 2)
        model_fields: model fields that differ between worlds, name -> live view (n, ...).
        max_velocity: limit of the velocities [m/s, rad/s].
    """

    layout: StateLayout
    states: States
    warnings: NDArray[Any]
    model_fields: Mapping[str, NDArray[Any]]
    max_velocity: float

    def nonfinite_field(self, env: int) -> str:
        """Return the name of the first field that is not finite, of a world's model fields or else of its state."""
        return [*self._nonfinite_model_fields(env), *self.layout.nonfinite_fields(self.states[env])][0]

    def describe(self, env: int, cause: str, before: States, error: str) -> Divergence:
        """Return the description of a world's divergence.

        Args:
            env: index of the world.
            cause: cause of the divergence.
            before: state of the world before the step. (nstate,)
            error: error message of the engine; used if the cause is `ENGINE_ERROR`.
        """
        if cause == ENGINE_ERROR:
            return Divergence(env, cause, f"{error}; {MORE_MEMORY}")
        element, index = "", -1
        if cause in WARNING_FIELDS:
            index = int(self.warnings[env, DIVERGENCE_WARNINGS[cause], 0])
            element = self.layout.element_at(WARNING_FIELDS[cause], index)
        elif cause == TOO_FAST:
            qvel = self.states[env, self.layout.columns("qvel")]
            index = int((np.abs(qvel) > self.max_velocity).argmax())
            element = f"{self.layout.element_at('qvel', index)} = {qvel[index]:g}, beyond {self.max_velocity:g}"
        nonfinite = [f"model field {name}" for name in self._nonfinite_model_fields(env)]
        nonfinite += self.layout.nonfinite_fields(before)
        source = f"{nonfinite[0]} was not finite before the step" if nonfinite else ""
        return Divergence(env, cause, "; ".join(part for part in (element, source) if part), index)

    def _nonfinite_model_fields(self, env: int) -> list[str]:
        own = {name: values[env] for name, values in self.model_fields.items()}
        return [name for name, value in own.items() if value.dtype.kind == "f" and not np.isfinite(value).all()]


def _element_name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int, word: str) -> str:
    return f"{word} '{mujoco.mj_id2name(model, kind, index) or index}'"
