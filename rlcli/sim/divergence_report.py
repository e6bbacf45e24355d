"""Divergence of a simulation: its causes by name, and the engine calls that led there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

STATE_LIMIT = 1e10
"""Largest magnitude of a position, a velocity or an acceleration that MuJoCo goes on with."""
MAX_DESCRIBED = 4
"""Environments of a divergence that are described one by one."""
ENGINE_ERROR = "engine error"
"""Cause of an environment that the engine could not step."""
TOO_FAST = "qvel out of bounds"
"""Cause of an environment that moves faster than its task allows."""
HISTORY_MEMORY = 64 * 2**20
"""Default limit of a history [bytes]."""
MORE_MEMORY = "a larger <size memory=...> in the MJCF mends a full contact arena"
"""Hint for an engine error."""
_W = mujoco.mjtWarning
DIVERGENCE_WARNINGS = {
    "BADCTRL": int(_W.mjWARN_BADCTRL),
    "BADQPOS": int(_W.mjWARN_BADQPOS),
    "BADQVEL": int(_W.mjWARN_BADQVEL),
    "BADQACC": int(_W.mjWARN_BADQACC),
}
"""Warnings after which MuJoCo resets a world or drops its controls; of several, the first is the cause."""
OTHER_WARNINGS = {
    "contact_full": int(_W.mjWARN_CONTACTFULL),
    "constraint_full": int(_W.mjWARN_CNSTRFULL),
    "inertia": int(_W.mjWARN_INERTIA),
}
"""Warnings that are counted, and after which a world goes on."""
WARNING_FIELDS = {"BADQPOS": "qpos", "BADQVEL": "qvel", "BADQACC": "qacc", "BADCTRL": "ctrl"}
"""Warning -> the field in which it holds an index."""
_INPUTS_FIRST = (
    *("mocap_pos", "mocap_quat", "ctrl", "xfrc_applied", "qfrc_applied", "act", "eq_active", "userdata", "history"),
    *("plugin_state", "plastic", "qpos", "qvel", "qacc_warmstart", "time"),
)
"""Fields of the integration state, the inputs of a simulation before its results."""


@dataclass(frozen=True, slots=True)
class Divergence:
    """An environment whose simulation diverged."""

    env: int
    """Environment."""
    cause: str
    """MuJoCo's warning without its prefix (`BADQACC`), `FIELD not finite`, `qvel out of bounds`, or `engine error`."""
    detail: str = ""
    """The element of the model in which it was detected, if known."""
    index: int = -1
    """For a warning: the index in its field."""

    def __str__(self) -> str:
        """Return `environment 3: BADQACC (joint 'swing')`."""
        return f"environment {self.env}: {self.cause}{f' ({self.detail})' if self.detail else ''}"


@dataclass(frozen=True, slots=True)
class Call:
    """One call of the engine, in one environment."""

    state: NDArray[np.float64]
    """The integration state before the call. (nstate,)"""
    nstep: int
    """Physics steps."""


class StateHistory:
    """The states before the last engine calls, in a ring of bounded size.

    Only the columns that the environment writes are recorded; all others have the values of `default`.

    Args:
        state: the engine's rows, live. (n, nstate)
        width: leading columns that are recorded.
        default: the state after a reset. (nstate,)
        calls: how many to record, if they fit.
        memory: limit of the ring [bytes].
        count: calls that an earlier history recorded.
    """

    def __init__(
        self,
        state: NDArray[np.float64],
        width: int,
        default: NDArray[np.float64],
        calls: int,
        *,
        memory: int = HISTORY_MEMORY,
        count: int = 0,
    ) -> None:
        self._default = default
        self._source = state[:, :width]
        self.width = width
        """Leading columns that are recorded."""
        self.memory = memory
        self.requested_calls = calls
        self.calls = max(1, min(calls, memory // max(1, self._source.nbytes)))
        """Length of the ring."""
        self._ring = np.empty((self.calls, *self._source.shape))
        self._nstep = [0] * self.calls
        self.count = self._oldest = count
        """Calls that were recorded, ever."""
        self._episode_start = np.full(len(state), count, dtype=np.int64)

    def record(self, nstep: int) -> None:
        """Record the states; called before the engine steps."""
        slot = self.count % self.calls
        self._ring[slot] = self._source
        self._nstep[slot] = nstep
        self.count += 1

    def clear(self) -> None:
        """Forget all calls; called when all worlds get another state."""
        self._oldest = self.count
        self._episode_start[:] = self.count

    def start_episodes(self, envs: NDArray[np.int64]) -> None:
        """Begin new episodes of some environments: calls before belong to other ones."""
        self._episode_start[envs] = self.count

    def last_state(self, env: int) -> NDArray[np.float64]:
        """Return the state before the newest call; the default state if the episode has no call yet."""
        if self._episode_start[env] == self.count:
            return self._default.copy()
        return self._state(env, self.count - 1)

    def calls_of(self, env: int) -> list[Call]:
        """Return the calls of an environment in its running episode, the oldest first."""
        return self.calls_between(env, int(self._episode_start[env]), self.count)

    def calls_between(self, env: int, first: int, stop: int) -> list[Call]:
        """Return the calls of an environment from one number to another, as far as the ring still has them."""
        first = max(first, self._oldest, self.count - self.calls)
        numbers = range(first, min(stop, self.count))
        return [Call(self._state(env, number), self._nstep[number % self.calls]) for number in numbers]

    def _state(self, env: int, number: int) -> NDArray[np.float64]:
        state = self._default.copy()
        state[: self.width] = self._ring[number % self.calls, env]
        return state


class StateLayout:
    """Columns of an integration state by field.

    Args:
        model: the compiled model.
        columns: field -> first column and size, in the order of the columns.
    """

    def __init__(self, model: mujoco.MjModel, columns: Mapping[str, tuple[int, int]]) -> None:
        self._model = model
        self._columns = {name: slice(start, start + size) for name, (start, size) in columns.items()}

    def columns(self, name: str) -> slice:
        """Return the columns of a field."""
        return self._columns[name]

    def fields(self) -> list[tuple[str, slice]]:
        """Return every field with its columns."""
        return list(self._columns.items())

    def nonfinite_fields(self, state: NDArray[np.float64]) -> list[str]:
        """Return the fields of a state that are not finite, the inputs of a simulation before its results."""
        known = [name for name in _INPUTS_FIRST if name in self._columns]
        return [name for name in known if not np.isfinite(state[self._columns[name]]).all()]

    def element_at(self, name: str, index: int) -> str:
        """Return the element that an index of a field belongs to: `joint 'swing'`."""
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
    """Finds out what is wrong with a diverged world of the CPU engine.

    Args:
        layout: columns of the integration state.
        states: the engine's rows, live. (n, nstate)
        warnings: MuJoCo's counters, live: last index and count by kind. (n, kinds, 2)
        model_fields: model fields that differ between worlds, live: name -> (n, ...)
        max_velocity: limit of the velocities [m/s, rad/s].
    """

    layout: StateLayout
    states: NDArray[np.float64]
    warnings: NDArray[Any]
    model_fields: Mapping[str, NDArray[Any]]
    max_velocity: float

    def nonfinite_field(self, env: int) -> str:
        """Return the first field that is not finite: of the world's own model fields, else of its state."""
        return [*self._nonfinite_model_fields(env), *self.layout.nonfinite_fields(self.states[env])][0]

    def describe(self, env: int, cause: str, before: NDArray[np.float64], error: str) -> Divergence:
        """Return what went wrong in a world.

        Args:
            env: number of the world.
            cause: of its divergence.
            before: its state before the step.
            error: message of the engine.
        """
        if cause == ENGINE_ERROR:
            return Divergence(env, cause, f"{error}; {MORE_MEMORY}")
        place, index = "", -1
        if cause in WARNING_FIELDS:
            index = int(self.warnings[env, DIVERGENCE_WARNINGS[cause], 0])
            place = self.layout.element_at(WARNING_FIELDS[cause], index)
        elif cause == TOO_FAST:
            qvel = self.states[env, self.layout.columns("qvel")]
            index = int((np.abs(qvel) > self.max_velocity).argmax())
            place = f"{self.layout.element_at('qvel', index)} = {qvel[index]:g}, beyond {self.max_velocity:g}"
        nonfinite = [f"model field {name}" for name in self._nonfinite_model_fields(env)]
        nonfinite += self.layout.nonfinite_fields(before)
        source = f"{nonfinite[0]} was not finite before the step" if nonfinite else ""
        return Divergence(env, cause, "; ".join(part for part in (place, source) if part), index)

    def _nonfinite_model_fields(self, env: int) -> list[str]:
        own = {name: values[env] for name, values in self.model_fields.items()}
        return [name for name, value in own.items() if value.dtype.kind == "f" and not np.isfinite(value).all()]


def _element_name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int, word: str) -> str:
    return f"{word} '{mujoco.mj_id2name(model, kind, index) or index}'"
