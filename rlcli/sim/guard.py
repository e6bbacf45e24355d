"""What went wrong in a simulation, by name, and the engine calls that led there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

LIMIT = 1e10
"""Largest magnitude of a position, a velocity or an acceleration that MuJoCo goes on with."""
SHOWN = 4
"""Environments of a divergence that are described one by one."""
ENGINE_ERROR = "engine error"
"""Cause of an environment that the engine could not step."""
TOO_FAST = "qvel out of bounds"
"""Cause of an environment that moves faster than its task allows."""
MEMORY = 64 * 2**20
"""Bytes that a history may take, if nobody says otherwise."""


@dataclass(frozen=True, slots=True)
class Divergence:
    """An environment whose simulation went wrong."""

    env: int
    """Environment."""
    cause: str
    """MuJoCo's warning without its prefix (`BADQACC`), `FIELD not finite`, `qvel out of bounds`, or `engine error`."""
    detail: str = ""
    """Where, as far as it is known at once."""
    index: int = -1
    """Of a warning: the index in the field that it is about."""

    def __str__(self) -> str:
        """`environment 3: BADQACC (joint 'swing')`."""
        return f"environment {self.env}: {self.cause}{f' ({self.detail})' if self.detail else ''}"


@dataclass(frozen=True, slots=True)
class Call:
    """One call of the engine, as one environment lived it."""

    state: np.ndarray
    """The integration state that it began with. (nstate,)"""
    nstep: int
    """Physics steps."""


class History:
    """The states that the last engine calls began with, in a ring of bounded size.

    Only the columns that anybody writes are kept, as long as nobody asks for the rest: they are those of `default`.

    Args:
        state: the engine's rows, live. (n, nstate)
        width: leading columns that are kept.
        default: a row nobody has written to. (nstate,)
        calls: how many to keep, if they fit.
        memory: bytes that the ring may take.
        count: calls that were noted before, elsewhere.
    """

    def __init__(
        self,
        state: np.ndarray,
        width: int,
        default: np.ndarray,
        calls: int,
        *,
        memory: int = MEMORY,
        count: int = 0,
    ) -> None:
        self._state, self._default = state, default
        self._kept = state[:, :width]
        self.memory = memory
        self.wanted = calls
        """How many were asked for."""
        self.calls = max(1, min(calls, memory // max(1, self._kept.nbytes)))
        """How many are kept."""
        self._ring = np.empty((self.calls, *self._kept.shape))
        self._nstep = [0] * self.calls
        self.count = self._floor = count
        """Calls that were noted, ever."""
        self._begin = np.full(len(state), count, dtype=np.int64)

    @property
    def width(self) -> int:
        """Leading columns that are kept."""
        return self._kept.shape[1]

    def note(self, nstep: int) -> None:
        """Called before the engine steps."""
        slot = self.count % self.calls
        self._ring[slot] = self._kept
        self._nstep[slot] = nstep
        self.count += 1

    def forget_all(self) -> None:
        """Called when all worlds are put elsewhere: nothing that was before leads there."""
        self._floor = self.count
        self._begin[:] = self.count

    def forget(self, rows: np.ndarray) -> None:
        """Called when worlds begin anew: what was before belongs to another episode."""
        self._begin[rows] = self.count

    def last(self, env: int) -> np.ndarray | None:
        """What the newest call began with, of one environment."""
        if self._begin[env] == self.count:
            return None
        return self._ring[(self.count - 1) % self.calls, env]

    def of(self, env: int) -> list[Call]:
        """The calls of an environment since its episode began, the oldest first."""
        return self.between(env, int(self._begin[env]), self.count)

    def between(self, env: int, first: int, stop: int) -> list[Call]:
        """The calls of an environment from one number to another, as far as they are still kept."""
        calls = []
        for number in range(max(first, self._floor, self.count - self.calls), min(stop, self.count)):
            row = self._default.copy()
            row[: self.width] = self._ring[number % self.calls, env]
            calls.append(Call(row, self._nstep[number % self.calls]))
        return calls


class StateLayout:
    """Which columns of an integration state are what."""

    def __init__(self, model: mujoco.MjModel, columns: Mapping[str, tuple[int, int]]) -> None:
        self._model = model
        self._columns = columns
        """Field -> first column and size, in the order of the columns."""

    def columns(self, name: str) -> slice:
        """The columns of a field."""
        start, size = self._columns[name]
        return slice(start, start + size)

    def fields(self) -> list[tuple[str, slice]]:
        """Every field with its columns."""
        return [(name, self.columns(name)) for name in self._columns]

    def until(self, name: str) -> int:
        """Columns up to a field and with it."""
        return self.columns(name).stop

    def unfit(self, row: np.ndarray) -> list[str]:
        """Fields of a state that are not finite, what is written to a simulation before what comes out of it."""
        return [
            name for name in _INPUTS_FIRST if name in self._columns and not np.isfinite(row[self.columns(name)]).all()
        ]

    def unbounded(self, row: np.ndarray) -> tuple[str, int] | None:
        """The first position or velocity that MuJoCo would not take: field and index."""
        for name in ("qpos", "qvel"):
            bad = ~(np.abs(row[self.columns(name)]) <= LIMIT)
            if bad.any():
                return name, int(bad.argmax())
        return None

    def place(self, name: str, index: int) -> str:
        """What a column of a field belongs to: `joint 'swing'`."""
        m = self._model
        if name == "qpos" and 0 <= index < m.nq:
            joint = int(np.searchsorted(m.jnt_qposadr, index, side="right")) - 1
            return _called(m, mujoco.mjtObj.mjOBJ_JOINT, joint, "joint")
        if name in ("qvel", "qacc") and 0 <= index < m.nv:
            return _called(m, mujoco.mjtObj.mjOBJ_JOINT, int(m.dof_jntid[index]), "joint")
        if name == "ctrl" and 0 <= index < m.nu:
            return _called(m, mujoco.mjtObj.mjOBJ_ACTUATOR, index, "actuator")
        return f"{name}[{index}]"


_INPUTS_FIRST = (
    *("mocap_pos", "mocap_quat", "ctrl", "xfrc_applied", "qfrc_applied", "act", "eq_active", "userdata", "history"),
    *("plugin_state", "plastic", "qpos", "qvel", "qacc_warmstart", "time"),
)
FIELD_OF = {"BADQPOS": "qpos", "BADQVEL": "qvel", "BADQACC": "qacc", "BADCTRL": "ctrl"}
"""Warning -> the field whose index it holds."""


def _called(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int, word: str) -> str:
    return f"{word} '{mujoco.mj_id2name(model, kind, index) or index}'"
