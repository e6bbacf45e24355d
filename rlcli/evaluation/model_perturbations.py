"""Model parameters that a stress test changes, with a value for each environment."""

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import listing
from rlcli.evaluation.stress_sweeps import PHYSICAL, Sweep, unknown_parameter
from rlcli.scene.entity import KINDS
from rlcli.scene.model_fields import DERIVED_FROM, FIELDS
from rlcli.scene.names import NameProblem, match

_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
_NO_BIAS, _AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)


class ModelPerturbation:
    """One parameter of the model, for one or more elements.

    Args:
        env: the environment.
        sweep: the parameter.
        values: its value in each environment; NaN: not changed. (num_envs,) float64

    Raises:
        NameProblem: if the model lacks the parameter or an element, or if the values would change nothing.
    """

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor) -> None:
        field = PHYSICAL.get(sweep.parameter, sweep.parameter)
        if field not in FIELDS:
            raise unknown_parameter(sweep.parameter, [name for name in FIELDS if "." not in name])
        if not env.engine.can_expand(field):
            raise NameProblem(f"'{field}' cannot differ between environments on a GPU; use --device cpu")
        self._sweep, self._values = sweep, values
        rows, names = _rows(env, field, sweep.element)
        self._parts = [_Part(env, field, rows, _axes(env, field, sweep))]
        if field == "body_mass":
            self._parts.append(_Part(env, "body_inertia", rows, None))
        if sweep.parameter == "actuator_gain":
            _require_affine(env.engine.model, rows, names)
            self._parts.append(_Part(env, "actuator_biasprm", rows, None))
        self.derives = any(part.field in DERIVED_FROM for part in self._parts)
        now = self._parts[0].now()
        if (not sweep.absolute or sweep.parameter == "gravity") and bool((now == 0).all()):
            hint = "write abs:LOW:HIGH" if field != "opt.gravity" else "add sim.gravity=[0,0,-9.81]"
            raise NameProblem(f"the value is 0 for {listing(names)}, so a factor changes nothing", hint)
        if field == "body_mass" and bool((now == 0).any()):
            massless = [name for name, mass in zip(names, now[0].tolist(), strict=True) if mass == 0]
            raise NameProblem(f"no mass to change on {listing(massless)}", "name other bodies")
        if sweep.parameter == "effort_limit":
            limited = env.engine.model.actuator_forcelimited[rows].astype(bool).tolist()
            if unlimited := [name for name, has in zip(names, limited, strict=True) if not has]:
                raise NameProblem(f"{listing(unlimited)} has no effort limit", "give its joint an effort_limit")
        self._affected = ~values.isnan() & ((values != 1.0) | sweep.absolute)

    def apply(self) -> Tensor | None:
        """Change the values that the task has written since `note_values`.

        Returns:
            The changed environments, (num_envs,) bool; None if there are none.
        """
        written = [part.written() & self._affected[:, None] for part in self._parts]
        rows = torch.stack([mask.any(dim=1) for mask in written]).any(dim=0)
        if not bool(rows.any()):
            return None
        for part, mask, values in zip(self._parts, written, self._targets(self._parts[0].now()), strict=True):
            part.write(mask, values)
        return rows

    def note_values(self) -> None:
        """Store the current values, to detect later writes of the task."""
        for part in self._parts:
            part.held = part.now()

    def _targets(self, now: Tensor) -> list[Tensor]:
        """Return the values that each part must have. (num_envs, values) each"""
        value = self._values[:, None]
        if not self._sweep.absolute:
            return [part.now() * value for part in self._parts]
        if self._sweep.parameter == "effort_limit":
            ends = torch.tensor([-1.0, 1.0], dtype=now.dtype, device=now.device)
            return [value * ends.repeat(now.shape[1] // 2)]
        if self._sweep.parameter == "gravity":
            return [now * (value / now.square().sum(dim=1, keepdim=True).sqrt())]  # keeps its direction
        if self._sweep.parameter == "body_mass":
            return [part.now() * (value / now).repeat_interleave(part.width, dim=1) for part in self._parts]
        return [value.expand_as(now)]


class _Part:
    """Some values of a model field in every environment."""

    def __init__(self, env: VecEnv, field: str, rows: list[int], axes: list[int] | None) -> None:
        self.field = field
        self._live = env.engine.expand(field).view(env.num_envs, -1)
        total = 1 if field == "opt.gravity" else len(getattr(env.engine.model, field))
        width = self._live.shape[1] // total
        axes = list(range(width)) if axes is None else axes
        self.width = len(axes)
        self.held: Tensor | None = None
        """The values after the last change; None before the first. (num_envs, elements x axes)"""
        self._columns = torch.tensor([row * width + axis for row in rows for axis in axes], device=env.device)

    def now(self) -> Tensor:
        """Return a copy of the values. (num_envs, elements x axes)"""
        return self._live[:, self._columns]

    def written(self) -> Tensor:
        """Return which values the task has written since the last change. (num_envs, elements x axes) bool"""
        now = self.now()
        return torch.ones_like(now, dtype=torch.bool) if self.held is None else now != self.held

    def write(self, mask: Tensor, values: Tensor) -> None:
        """Set the values where a mask holds. (num_envs, elements x axes) each"""
        self._live[:, self._columns] = torch.where(mask, values.to(self._live.dtype), self.now())


def _rows(env: VecEnv, field: str, pattern: str | None) -> tuple[list[int], list[str]]:
    """Return rows of a model field, and the names of the elements that they belong to.

    Raises:
        NameProblem: if the model has no such element.
    """
    model, kind = env.engine.model, FIELDS[field]
    if not kind:
        if pattern is not None:
            raise NameProblem("the parameter belongs to the whole world", f"leave out '{pattern}'")
        return [0], ["the world"]
    entities = [f"{name}/" for name in env.entities]
    ids: list[int] = []
    names: list[str] = []
    object_type, count_field = KINDS[kind]
    for number in range(1 if kind == "Bodies" else 0, getattr(model, count_field)):
        name = mujoco.mj_id2name(model, object_type, number) or ""
        short = next((name.removeprefix(prefix) for prefix in entities if name.startswith(prefix)), name)
        ids.append(number)
        names.append(short if short and short not in names else name or f"#{number}")
    if pattern is None:
        chosen = list(range(len(ids)))
        if field == "body_mass":
            chosen = [i for i in chosen if model.body_mass[ids[i]] > 0]
    else:
        chosen = match(pattern, names, {"Bodies": "body"}.get(kind, kind[:-1].lower()))
    if not chosen:
        raise NameProblem(f"the model has no {kind.lower()}; choose another parameter")
    return [row for i in chosen for row in _elements(model, field, ids[i])], [names[i] for i in chosen]


def _elements(model: mujoco.MjModel, field: str, number: int) -> list[int]:
    """Return the rows of an element in a field; a joint has one for each degree of freedom or coordinate."""
    if field.startswith("dof_"):
        return [dof for dof in range(model.nv) if model.dof_jntid[dof] == number]
    if field in ("qpos0", "qpos_spring"):
        ends = [*model.jnt_qposadr.tolist(), model.nq]
        return list(range(ends[number], ends[number + 1]))
    return [number]


def _axes(env: VecEnv, field: str, sweep: Sweep) -> list[int] | None:
    """Return the columns of an element's row that are changed; None: all.

    Raises:
        NameProblem: if a row has several values, and all would be set to the same value.
    """
    if field == "geom_friction":
        return [0]  # sliding friction; the other two are torsional and rolling friction
    own = sweep.parameter in PHYSICAL
    value = np.asarray(getattr(env.engine.model, field)) if field != "opt.gravity" else np.zeros((1, 3))
    width = value[:1].size
    if sweep.absolute and not own and width > 1:
        raise NameProblem(f"abs: would make the {width} values of {field} equal", "use a factor: leave out abs:")
    return None


def _require_affine(model: mujoco.MjModel, rows: list[int], names: list[str]) -> None:
    kinds = [(int(model.actuator_gaintype[row]), int(model.actuator_biastype[row])) for row in rows]
    unsupported = [
        name
        for name, (gain, bias) in zip(names, kinds, strict=True)
        if gain not in (_FIXED, _AFFINE) or bias not in (_NO_BIAS, _AFFINE_BIAS)
    ]
    if unsupported:
        hint = "choose motors, position or velocity actuators"
        raise NameProblem(f"{listing(unsupported)} cannot be scaled as a whole", hint)
