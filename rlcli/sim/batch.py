"""The CPU engine, on `mujoco.batch.Batch`: a C++ thread pool over state rows, bit-identical at any thread count."""

from __future__ import annotations

import copy
import math
import sys
import warnings
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import DATA_FIELDS, MODEL_FIELDS, Batch, SimulationError
from numpy.typing import NDArray
from torch import Tensor

from rlcli import machine
from rlcli.errors import DeviceError, DivergedError, did_you_mean
from rlcli.sim.engine import force_sensors
from rlcli.sim.guard import (
    ENGINE_ERROR,
    FIELD_OF,
    LIMIT,
    MEMORY,
    SHOWN,
    TOO_FAST,
    Call,
    Divergence,
    History,
    StateLayout,
)
from rlcli.sim.lean import SHOWS_IT, needless, unprofiled
from rlcli.sim.mjcf import quiet_mujoco
from rlcli.sim.selection import Field, IdSelection, Selection, ids_of

_STATE = mujoco.mjtState
_STATE_FIELDS = mujoco.batch._STATE_FIELDS
_NOT_DERIVED = frozenset(_STATE_FIELDS)
_ACCELERATION = frozenset(
    [
        "qacc",
        "qacc_smooth",
        "actuator_force",
        "qfrc_actuator",
        "qfrc_smooth",
        "qfrc_constraint",
        "qfrc_inverse",
        "act_dot",
        "cacc",
        "cfrc_int",
        "cfrc_ext",
    ]
)
"""Fields of the acceleration stage: read as the last substep left them, so they ask for no stage of their own."""

_MOVES_ALONE = frozenset(
    ["time", "qpos", "qvel", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "eq_active"]
)
"""Parts of a state of which physics changes positions and velocities alone, and what follows from these."""

_W = mujoco.mjtWarning
_FLAGS = frozenset(
    [
        *("geom_contype", "geom_conaffinity", "geom_priority", "geom_group", "jnt_limited", "jnt_actgravcomp"),
        *("jnt_actfrclimited", "tendon_limited", "tendon_actfrclimited", "actuator_ctrllimited", "actuator_actlimited"),
        *("actuator_forcelimited", "eq_active0", "opt.disableactuator"),
    ]
)
"""Integers of a model that are no address, number or kind of anything."""
_DIVERGED = {
    "BADCTRL": int(_W.mjWARN_BADCTRL),
    "BADQPOS": int(_W.mjWARN_BADQPOS),
    "BADQVEL": int(_W.mjWARN_BADQVEL),
    "BADQACC": int(_W.mjWARN_BADQACC),
}
"""Warnings after which MuJoCo resets a world or drops its controls; of several, the first is the cause."""
_NOTED = {
    "contact_full": int(_W.mjWARN_CONTACTFULL),
    "constraint_full": int(_W.mjWARN_CNSTRFULL),
    "inertia": int(_W.mjWARN_INERTIA),
}
_NONE, _VEL, _ACC = (
    int(s) for s in (mujoco.mjtStage.mjSTAGE_NONE, mujoco.mjtStage.mjSTAGE_VEL, mujoco.mjtStage.mjSTAGE_ACC)
)


class BatchEngine:
    """Many worlds of one model on CPU threads. Physics is float64.

    Args:
        model: the compiled model.
        num_envs: worlds.
        threads: that step them.
        forces_after_reset: whether `forward` computes the acceleration stage, or leaves zeros there.
        late: derived fields are left as the last substep made them.
        external_forces: compute `cfrc_ext`, exactly. Batch itself does so for models with certain sensors alone, and
            with RK4 at the wrong one of a substep's stages.
        max_velocity: a velocity beyond it is a divergence [m/s, rad/s].

    Raises:
        DeviceError: for more worlds than the machine's memory holds.
    """

    asynchronous = False

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        threads: int,
        forces_after_reset: bool = True,
        *,
        late: bool = False,
        external_forces: bool = False,
        max_velocity: float = LIMIT,
    ) -> None:
        quiet_mujoco()
        _require_memory(model, num_envs)
        self.model = model
        self.num_envs = num_envs
        self.lives = 0
        self.device = torch.device("cpu")
        self.threads = threads
        self.causes: dict[str, int] = {}
        self.found: list[Divergence] = []
        self.warnings = dict.fromkeys(_NOTED, 0)
        self._batch = _batch_of(model, num_envs, threads, external_forces)
        self._state = torch.from_numpy(self._batch.state)
        self._warning_words = self._batch.warning.reshape(-1).view(np.int64)
        self._failed = np.zeros(num_envs, dtype=bool)
        self._error = ""
        self._default = self._default_row()
        columns = {n: self._batch._component(kind) for n, kind in _STATE_FIELDS.items()}
        self.state_layout = StateLayout(model, columns)
        self._moves_alone = not any(size for name, (_, size) in columns.items() if name not in _MOVES_ALONE)
        self._max_velocity = max_velocity
        self._qvel = self._batch.state[:, self.state_layout.columns("qvel")]
        self._history = History(self._batch.state, self.state_layout.until("ctrl"), self._default, 1)
        self._fields: dict[str, Tensor] = {}
        self._given: list[NDArray] = []
        """Bound parts of the state but for positions and velocities: what somebody may write to."""
        self._worlds: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}
        self._late = late
        self.step_stage = _NONE
        """mjtStage that the last substep ends with, for what is bound."""
        self._forward_stage = _ACC if late else _NONE  # a start state gets what `mj_forward` makes, warm start included
        self._external: Tensor | None = None
        if external_forces:
            self._external = torch.zeros(num_envs, model.nbody, 6, dtype=torch.float64)
            self._fields["cfrc_ext"] = self._external
            self._contacts = self._batch.bind("ncon")
            self._world = mujoco.MjData(model)
        self._own_constants = False
        self._lean, self._disabled = True, model.opt.disableflags
        """Whether steps leave out what changes no state, and what they left out if they did not."""
        self.forces_after_reset = forces_after_reset
        self._reset_stage = _ACC if forces_after_reset else _VEL
        self._force_sensors = force_sensors(model)

    @property
    def divergences(self) -> int:
        """Worlds that diverged, ever."""
        return sum(self.causes.values())

    @property
    def history(self) -> History:
        """What the last calls began with."""
        return self._history

    def remember(self, calls: int, memory: int = MEMORY) -> None:
        """Keep what the last calls began with, for `trace`: as many as asked for, or as fit into so many bytes."""
        self._history = self._fresh_history(self._history.width, calls, memory)

    def _fresh_history(self, width: int, calls: int, memory: int) -> History:
        state, count = self._batch.state, self._history.count
        return History(state, width, self._default, calls, memory=memory, count=count)

    def trace(self, env: int) -> list[Call]:
        """The last calls of a world in its running episode, the oldest first."""
        return self._history.of(env)

    @property
    def follows_constants(self) -> bool:
        """Whether `set_constants` has been called."""
        return self._own_constants

    def row(self, env: int) -> np.ndarray:
        """A copy of a world's integration state. (nstate,)"""
        return self._batch.state[env].copy()

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Copies of the integration states of some worlds. (n, nstate)"""
        return self._batch.state[ids]

    def own_model(self, env: int) -> dict[str, np.ndarray]:
        """Copies of the model fields of a world's own."""
        return {name: np.array(values[env]) for name, values in self._batch._expanded.items()}

    def give_model(self, env: int, model: mujoco.MjModel) -> None:
        """Write the model fields of a world's own into a copy of the model."""
        self._write_model(env, model)

    def put(self, env: int, row: np.ndarray) -> None:
        """Give a world an integration state; derived fields stay behind."""
        self._batch.state[env] = row
        self._batch.warning[env] = 0

    def take(self, env: int, data: mujoco.MjData) -> None:
        """Give a world the state of an MjData, and its derived fields."""
        mujoco.mj_getState(self.model, data, self._batch.state[env], int(_STATE.mjSTATE_INTEGRATION))
        for name, field in self._fields.items():
            if name not in _NOT_DERIVED and hasattr(data, name):
                field[env] = torch.from_numpy(np.array(getattr(data, name))).reshape(field[env].shape)

    def attach(self) -> None:
        """Nothing to do: calls return when their work is done."""

    def field(self, name: str) -> Tensor:
        """A live view of an MjData field; binding a derived one makes the last substep compute its stage."""
        if name not in self._fields:
            if name not in DATA_FIELDS:
                raise ValueError(f"'{name}' is not an MjData field; {did_you_mean(name, DATA_FIELDS) or ''}")
            if name in SHOWS_IT:
                self._leave_nothing_out()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # torch has no read-only tensors; derived views must only be read
                bound = self._bind(name)
            if self._of_substep(name):
                self._forward_stage = _ACC
            if name not in _NOT_DERIVED and not self._late and not self._of_forces_alone(name):
                self.step_stage = _VEL
                self._forward_stage = max(self._forward_stage, _VEL)
            if name not in _NOT_DERIVED:
                self._forward_all()  # a field asked for late holds zeros until then
            self._fields[name] = bound
            if name in _NOT_DERIVED:
                self._keep(name)
                if name not in ("qpos", "qvel"):
                    self._given.append(bound.numpy())
        return self._fields[name]

    def _bind(self, name: str) -> Tensor:
        """A field as a tensor; what is part of the state as a view of that, so that neighbours can be one view."""
        values, state = self._batch.bind(name), self._batch.state
        start = (values.ctypes.data - state.ctypes.data) // state.itemsize
        if values.dtype != state.dtype or not 0 <= start < self._batch.nstate:
            return torch.from_numpy(values)
        return self._state.as_strided(values.shape, [step // values.itemsize for step in values.strides], start)

    def _keep(self, name: str) -> None:
        """Have the history hold a field that somebody may write to from now on."""
        if self.state_layout.until(name) > self._history.width:
            self._history = self._fresh_history(self._batch.nstate, self._history.wanted, self._history.memory)

    def can_expand(self, name: str) -> bool:
        """Whether a model field may differ between worlds."""
        return name in MODEL_FIELDS

    def expand(self, name: str) -> Tensor:
        """A model field with a value for every world."""
        if name not in MODEL_FIELDS:
            raise ValueError(f"'{name}' cannot differ between worlds; {did_you_mean(name, MODEL_FIELDS) or ''}")
        values = torch.from_numpy(self._batch.expand(name))
        if not values.is_floating_point():
            self._leave_nothing_out()
        return values

    def expanded(self, name: str) -> Tensor | None:
        """The same where somebody has asked for it before; None where all worlds share the model's value."""
        return self.expand(name) if name in self._batch._expanded else None

    def expansions(self) -> list[str]:
        """The model fields that somebody has asked for."""
        return list(self._batch._expanded)

    def set_constants(self, selection: Selection | None = None) -> None:
        """Let the constants that MuJoCo derives from model fields follow what was written to expanded ones."""
        try:
            with unprofiled:
                self._batch.set_const(None if selection is None else ids_of(selection).astype(np.int32))
        except SimulationError as error:
            raise _engine_error(error) from None
        self._own_constants = True

    def step(self, nstep: int, *, derive: bool = True) -> None:
        """Advance every world by `nstep` physics steps; without `derive` the derived fields stay behind."""
        self._history.note(nstep)
        try:
            with unprofiled:
                self._batch.step(nstep=nstep, stage=self.step_stage if derive else _NONE)
        except SimulationError:
            self._failed |= self._batch.status != 0  # their rows are as they were; the others have been stepped
            self._error = " ".join(self._batch.error(int(self._failed.argmax())).split()) or self._error
        if self._external is not None and derive:
            self._feel(self._external.numpy())

    def _feel(self, forces: np.ndarray) -> None:
        """Compute `cfrc_ext` of the last substep. It is 0 where nothing touches, pushes or holds a body."""
        acts = self._contacts.reshape(-1) > 0
        if "xfrc_applied" in self._fields:
            acts |= self._fields["xfrc_applied"].numpy().any(axis=(1, 2))
        if self.model.neq:
            acts[:] = True
        forces[~acts] = 0.0
        for world in acts.nonzero()[0]:
            self._batch.get_data(world, self._world)
            mujoco.mj_rnePostConstraint(self.model, self._world)
            forces[world] = self._world.cfrc_ext

    def diverged(self, moves_finitely: bool = False) -> Tensor | None:
        """Worlds that went wrong since the last call; `found` then says what in the first of them.

        MuJoCo resets a diverging world by itself, to finite values, and clears its counters as it does: so they are
        read after every step and put back to zero, and the state alone would show nothing. What gives no warning is
        not finite afterwards: the sum of all states then is not, either. That sum takes longer than all other looks at
        a state. Where nothing but positions and velocities moves, and the caller has looked at these, what else
        somebody may have written to is summed instead.
        """
        self.found = []
        warned = np.count_nonzero(self._warning_words) > 0
        finite = False
        if moves_finitely and self._moves_alone:
            finite = all([math.isfinite(np.add.reduce(given, axis=None)) for given in self._given])
        # of whole rows: skipping the columns that nobody writes takes longer
        finite = finite or math.isfinite(self._state.sum().item()) or bool(self._state.isfinite().all())
        fast = self._max_velocity < LIMIT and bool((np.abs(self._qvel) > self._max_velocity).any())
        if not warned and finite and not self._error and not fast:
            return None
        bad, causes = self._judge(finite)
        if not bad.any():
            return None
        names, counts = np.unique(causes[bad], return_counts=True)
        for name, count in zip(names.tolist(), counts.tolist(), strict=True):
            self.causes[name] = self.causes.get(name, 0) + count
        return torch.from_numpy(bad)

    def _judge(self, finite: bool) -> tuple[np.ndarray, np.ndarray]:
        """Which worlds went wrong, and the cause of each; the counters are put back to zero."""
        counts = self._batch.warning[:, :, 1]
        for name, kind in _NOTED.items():
            self.warnings[name] += int((counts[:, kind] > 0).sum())
        bad = self._failed if finite else self._failed | ~np.isfinite(self._batch.state).all(axis=1)
        causes = np.full(self.num_envs, "", dtype=object)
        causes[self._failed] = ENGINE_ERROR
        for name, kind in _DIVERGED.items():
            warned = counts[:, kind] > 0
            causes[warned & (causes == "")] = name
            bad = bad | warned
        fast = np.asarray((np.abs(self._qvel) > self._max_velocity).any(axis=1)) & ~bad
        causes[fast] = TOO_FAST
        bad = bad | fast
        for env in (bad & (causes == "")).nonzero()[0]:
            causes[env] = f"{self._unfit(int(env))} not finite"
        self.found = [self._describe(int(env), causes[env]) for env in bad.nonzero()[0][:SHOWN]]
        self._batch.warning[:] = 0
        self._failed = np.zeros(self.num_envs, dtype=bool)
        self._error = ""
        return bad, causes

    def _unfit(self, env: int) -> str:
        """The field that made a world's state not finite: of its own model, or the first of the state."""
        own = self._unfit_model(env)
        return own[0] if own else self.state_layout.unfit(self._batch.state[env])[0]

    def _unfit_model(self, env: int) -> list[str]:
        values = {name: values[env] for name, values in self._batch._expanded.items()}
        return [n for n, value in values.items() if value.dtype.kind == "f" and not np.isfinite(value).all()]

    def _describe(self, env: int, cause: str) -> Divergence:
        """What went wrong in a world, and where it came from, as far as that can be seen afterwards."""
        if cause == ENGINE_ERROR:
            return Divergence(env, cause, f"{self._error}; {_MORE_MEMORY}")
        place, index = "", -1
        if cause in FIELD_OF:
            index = int(self._batch.warning[env, _DIVERGED[cause], 0])
            place = self.state_layout.place(FIELD_OF[cause], index)
        elif cause == TOO_FAST:
            index = int((np.abs(self._qvel[env]) > self._max_velocity).argmax())
            place = f"{self.state_layout.place('qvel', index)} = {self._qvel[env, index]:g}"
            place += f", beyond {self._max_velocity:g}"
        before = self._history.last(env)
        known = np.concatenate([before, self._default[len(before) :]]) if before is not None else self._default
        unfit = [f"model field {name}" for name in self._unfit_model(env)] + self.state_layout.unfit(known)
        source = f"{unfit[0]} was not finite before the step" if unfit else ""
        return Divergence(env, cause, "; ".join(part for part in (place, source) if part), index)

    def forward(self, selection: Selection) -> None:
        """Compute what is bound of the derived fields of the selected worlds."""
        if self._external is not None:
            selection.write(self._external, 0.0)  # no contact has acted on a start state yet
        if self._forward_stage == _NONE:
            return
        forces = self._forces(selection) if self._reset_stage < self._forward_stage else []
        kept = [field[where].clone() for field, where in forces]
        try:
            # past the wrapper: it looks for what is wrong with the ids, which takes longer than the numbers of a few
            ids = ids_of(selection).astype(np.int32)
            with unprofiled:
                self._batch._check(ids, self._batch._b.forward(ids, min(self._forward_stage, self._reset_stage)))
        except SimulationError as error:
            raise _engine_error(error) from None
        for (field, where), values in zip(forces, kept, strict=True):
            field[where] = values

    def _forces(self, selection: Selection) -> list[tuple[Tensor, Any]]:
        """Bound fields of the acceleration stage, and where in them what belongs to the selected worlds lies."""
        ids = ids_of(selection)
        return [
            (field, ids if name in _ACCELERATION else (ids[:, None], self._force_sensors))
            for name, field in self._fields.items()
            if self._of_substep(name)
        ]

    def reset(self, selection: Selection) -> None:
        """Put the selected worlds into the default state: the whole row, controls and warm start included."""
        ids = ids_of(selection)
        self._batch.state[ids] = self._default
        self._history.forget(ids)
        if not self.forces_after_reset:
            for field, where in self._forces(selection):  # no force has acted on a start state yet
                field[where] = 0.0

    def set_default(self, qpos: Tensor, qvel: Tensor) -> None:
        """The joint state that `reset` restores."""
        for name, values in (("qpos", qpos), ("qvel", qvel)):
            view = self._batch.bind(name)
            start = (view.ctypes.data - self._batch.state.ctypes.data) // view.itemsize
            self._default[start : start + len(values)] = values.numpy()

    def as_field(self, tensor: Tensor) -> NDArray:
        """An array of the same memory."""
        return tensor.numpy()

    def select(self, mask: Field, seed: int, counters: Field) -> IdSelection | None:
        """The worlds where `mask` holds, as ids; None for none."""
        ids = (mask if isinstance(mask, np.ndarray) else mask.numpy()).nonzero()[0]
        if not len(ids):
            return None
        counted = counters if isinstance(counters, np.ndarray) else counters.numpy()
        return IdSelection(ids, seed, counted[ids], lives=self.lives)

    def rays(
        self,
        points: Tensor,
        directions: Tensor,
        *,
        groups: tuple[int, ...] | None = None,
        exclude: int = -1,
        selection: Selection | None = None,
    ) -> Tensor:
        """Distances from points to the first geom along unit directions, -1 where there is none. (rows, rays)"""
        seen = None if groups is None else np.array([g in groups for g in range(mujoco.mjNGROUP)], dtype=np.uint8)
        ids = None if selection is None else ids_of(selection).astype(np.int32)
        try:
            with unprofiled:
                distance, _ = self._batch.ray(
                    points.double().numpy(), directions.double().numpy(), geomgroup=seen, bodyexclude=exclude, ids=ids
                )
        except SimulationError as error:
            raise _engine_error(error) from None
        return torch.from_numpy(distance).float()

    def watch(self, values: Tensor, what: str) -> None:
        """Never needed: values are checked where they are made."""

    def noted(self) -> list[str]:
        """Nothing."""
        return []

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of the state rows, of the warning counters and of the model fields that differ between worlds.

        Also of the bound fields of the last substep, which no forward from the state gives back.
        """
        expanded = {f"model.{name}": torch.from_numpy(np.array(v)) for name, v in self._batch._expanded.items()}
        warning = torch.from_numpy(np.array(self._batch.warning))
        substep = {f"substep.{name}": value.clone() for name, value in self._fields.items() if self._of_substep(name)}
        constants = torch.tensor(self._own_constants)
        return {"state": self._state.clone(), "warning": warning, "constants": constants, **expanded, **substep}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take back what `state_dict` gave; derived fields are computed anew.

        Raises:
            ValueError: if a model field is not one that may differ between worlds, or of another shape.
        """
        self._state.copy_(state["state"])
        width = self._history.width
        if not np.array_equal(
            self._batch.state[:, width:],
            np.broadcast_to(self._default[width:], (self.num_envs, self._batch.nstate - width)),
        ):
            self._keep("plastic")
        self._history.forget_all()
        self._batch.warning[:] = state["warning"].numpy()
        for name, values in state.items():
            if name.startswith("model."):
                self.take_model(name.removeprefix("model."), values)
        if bool(state["constants"]):
            self.set_constants()
        substep = {n.removeprefix("substep."): values for n, values in state.items() if n.startswith("substep.")}
        for name in substep:
            self.field(name)  # whoever saved had asked for it; here that may come later
        if self._forward_stage != _NONE:
            with unprofiled:
                self._batch.forward(stage=self._forward_stage)
        for name, values in substep.items():
            self._fields[name].copy_(values)

    def take_model(self, name: str, values: Tensor) -> None:
        """Take the values of a model field from a file.

        Raises:
            ValueError: for one that does not fit, or that could send MuJoCo outside of its arrays.
        """
        target = self.expand(name)
        if target.shape != values.shape or target.dtype != values.dtype:
            raise ValueError(f"model field '{name}' is {tuple(values.shape)}, not {tuple(target.shape)}")
        if not target.dtype.is_floating_point and name not in _FLAGS and not torch.equal(target, values):
            raise ValueError(f"model field '{name}' is part of the model's structure, and not the model's")
        target.copy_(values)

    def world(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """One world as MjModel and MjData, forwarded; asked again for the same world, the same two objects, updated."""
        if new := env not in self._worlds:
            self._worlds[env] = (copy.copy(self.model), self._batch.get_data(env))
        model, data = self._worlds[env]
        if new or self._batch._expanded:
            self._write_model(env, model)
        self._batch.get_data(env, data)
        mujoco.mj_forward(model, data)
        return model, data

    def close(self) -> None:
        """Nothing is held that Python does not free."""

    def _leave_nothing_out(self) -> None:
        """Have MuJoCo compute all that it computes for the model as it is, from now on."""
        if self._lean:
            self._lean = False
            flags = self._batch._b.expand("opt.disableflags").view(np.int32)  # past the wrapper: nobody asked for it
            flags[:] = self._disabled

    def _write_model(self, env: int, model: mujoco.MjModel) -> None:
        self._batch.get_model(env, model)
        if "opt.disableflags" not in self._batch._expanded:
            model.opt.disableflags = self._disabled  # whoever steps it is left everything

    def _forward_all(self) -> None:
        """Compute what is bound from the state of every world; fields of the last substep keep their values."""
        kept = {name: value.clone() for name, value in self._fields.items() if self._of_substep(name)}
        try:
            with unprofiled:
                self._batch.forward(stage=self._forward_stage)
        except SimulationError as error:
            raise _engine_error(error) from None
        for name, value in kept.items():
            self._fields[name].copy_(value)

    def _senses(self, name: str) -> bool:
        """Whether the field holds sensors of the acceleration stage."""
        return name == "sensordata" and bool(self._force_sensors)

    def _of_forces_alone(self, name: str) -> bool:
        """Whether the acceleration stage alone writes the field; of sensors, whether there are no others."""
        if name == "sensordata":
            return len(self._force_sensors) == self.model.nsensordata
        return name in _ACCELERATION

    def _of_substep(self, name: str) -> bool:
        return name in _ACCELERATION or self._senses(name) or (self._late and name not in _NOT_DERIVED)

    def _default_row(self) -> np.ndarray:
        data = mujoco.MjData(self.model)
        row = np.empty(self._batch.nstate)
        mujoco.mj_getState(self.model, data, row, int(_STATE.mjSTATE_INTEGRATION))
        return row


def _batch_of(model: mujoco.MjModel, num_envs: int, threads: int, persistent: bool) -> Batch:
    """A batch of worlds that leaves out what changes nothing; the model, which others may step, stays as it is."""
    lean = copy.copy(model)
    lean.opt.disableflags |= needless(model)
    return Batch(lean, num_envs, threads, persistent=persistent)


_STATES_AN_ENV = 3
"""What an environment takes at the least, in states of its world; the built-in tasks take 3.3 to 16."""


def _require_memory(model: mujoco.MjModel, num_envs: int) -> None:
    """Refuse what memory cannot hold: a kernel that promises more than it has ends the process later, without a word.

    Raises:
        DeviceError: if it does not fit.
    """
    each = _STATES_AN_ENV * 8 * mujoco.mj_stateSize(model, int(_STATE.mjSTATE_INTEGRATION))
    free = min(machine.memory(), machine.memory_limit() or sys.maxsize)
    if each * num_envs > free:
        raise DeviceError(
            f"{num_envs} environments need {each * num_envs / 2**30:.1f} GiB at the least,"
            f" {free / 2**30:.1f} GiB are free on this machine",
            hint="fewer environments: --num-envs",
        )


_MORE_MEMORY = "a larger <size memory=...> in the MJCF mends a full contact arena"


def _engine_error(error: SimulationError) -> DivergedError:
    return DivergedError(f"the physics engine stopped: {' '.join(str(error).split())}", hint=_MORE_MEMORY)
