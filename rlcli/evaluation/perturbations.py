"""Perturbations of a stress test: changes of model parameters, noise and delay of observations and actions, and pushes.

Every environment has its own values, so that many variants of a task run at the same time. With a neutral value (factor
1, noise 0, ...) an environment runs the same episodes as without perturbations.
"""

import math
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli import random
from rlcli.envs.layout import TermLayout
from rlcli.envs.observers import StepObserver
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import UsageError, listing
from rlcli.evaluation.stress_parameters import PHYSICAL, SIGNALS, Sweep, unknown_parameter_error
from rlcli.scene.entity import KINDS
from rlcli.scene.model_fields import DERIVED_FROM, FIELDS
from rlcli.scene.names import NameProblem, match

Act = Callable[[Tensor], Tensor]

_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
_NO_BIAS, _AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)


class Perturbations(StepObserver):
    """Observer that applies all perturbations of a stress test to an environment.

    Args:
        env: the environment; from now on its steps are perturbed.
        sweeps: the perturbed parameters, such as the mass of a body.
        values: value of each parameter in every environment; NaN: not perturbed. (num_envs, number of sweeps) float64

    Raises:
        UsageError: for an unknown parameter or element, or if a parameter would change nothing.
    """

    def __init__(self, env: VecEnv, sweeps: Sequence[Sweep], values: Tensor) -> None:
        self._env = env
        self._physical: list[ModelPerturbation] = []
        self._inputs: list[_Signal] = []
        self._outputs: list[_Signal] = []
        self._pushes: list[_Push] = []
        values = values.to(env.device)
        for number, sweep in enumerate(sweeps):
            try:
                neutral = math.nan if sweep.neutral is None else sweep.neutral
                self._add(sweep, values[:, number].nan_to_num(neutral))
            except NameProblem as problem:
                raise UsageError(f"--sweep {sweep.name}: {problem}", hint=problem.hint) from None
        # a signal gets its noise before its delay
        for signals in (self._inputs, self._outputs):
            signals.sort(key=lambda signal: isinstance(signal, _Delay))
        self._apply_to_model()
        env.observers.add(self)

    def around(self, act: Act) -> Act:
        """Return the policy `act` with perturbed observations and actions, as a function of observations."""
        if not self._inputs and not self._outputs:
            return act

        def perturbed(obs: Tensor) -> Tensor:
            is_first = self._env.episode_length_buf == 0
            for signal in self._inputs:
                obs = signal(obs, is_first)
            action = act(obs)
            for signal in self._outputs:
                action = signal(action, is_first)
            return action

        return perturbed

    def _add(self, sweep: Sweep, values: Tensor) -> None:
        env, name = self._env, sweep.parameter
        if name == "push":
            self._pushes.append(_Push(env, sweep, values))
        elif name in SIGNALS:
            of_action = name.startswith("action")
            terms = env.layout.actions if of_action else env.layout.observations["policy"]
            columns = _columns(terms, sweep.element, "action" if of_action else "observation")
            make = _Delay if name.endswith("delay") else _Noise
            signal = make(env, sweep, values, columns.to(env.device), of_action)
            (self._outputs if of_action else self._inputs).append(signal)
        else:
            self._physical.append(ModelPerturbation(env, sweep, values))

    def before_step(self) -> None:
        """Apply pushes, and perturb the model again where an event of the task has overwritten the perturbed values."""
        self._apply_to_model()
        for push in self._pushes:
            push()

    def _apply_to_model(self) -> None:
        """Write perturbed values to the model: at the first call, and wherever an event of the task wrote since."""
        env, changed, derived = self._env, False, None
        for physical in self._physical:
            rows = physical.apply()
            changed = changed or rows is not None
            if rows is not None and physical.derives:
                derived = rows if derived is None else derived | rows
        if changed:
            # a perturbation treats changed values as written by an event, so each stores the values after these changes
            for physical in self._physical:
                physical.note_values()
        if derived is not None:
            env.engine.set_constants(env.engine.select(derived, env.seed, env.episode_index))


class _Signal:
    """Perturbation of some columns of the observations or actions: base class of noise and delay."""

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor, columns: Tensor, of_action: bool) -> None:
        self.env, self.values, self.columns, self.of_action = env, values, columns, of_action
        self.stream = random.stream(f"stress.{sweep.name}")

    def __call__(self, signal: Tensor, is_first: Tensor) -> Tensor:
        """Return the perturbed observations or actions. `is_first` (num_envs,) marks the first step of an episode."""
        raise NotImplementedError


class _Noise(_Signal):
    """Gaussian noise, sampled in every step."""

    def __call__(self, signal: Tensor, is_first: Tensor) -> Tensor:
        env, count = self.env, len(self.columns)
        keys = _keys(env, _STEPS * env.episode_index + env.episode_length_buf)
        noise = torch.from_numpy(random.normal(keys, self.stream, 0, count)).to(signal.device)
        noisy = signal.clone()
        noisy[:, self.columns] += noise * self.values[:, None].to(signal.dtype)
        return noisy


class _Delay(_Signal):
    """Delay of observations or actions by some steps.

    At the start of an episode, the delayed observation is the first one of the episode, and the delayed action is 0.
    """

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor, columns: Tensor, of_action: bool) -> None:
        super().__init__(env, sweep, values, columns, of_action)
        self._steps = values.long()
        shape = (int(self._steps.max()) + 1, env.num_envs, len(columns))
        self._past = torch.zeros(shape, device=env.device)
        self._all_envs = torch.arange(env.num_envs, device=env.device)

    def __call__(self, signal: Tensor, is_first: Tensor) -> Tensor:
        now = signal[:, self.columns]
        self._past = torch.cat([now[None], self._past[:-1]])
        begin = torch.zeros_like(now) if self.of_action else now
        self._past[1:] = torch.where(is_first[:, None], begin, self._past[1:])
        late = signal.clone()
        late[:, self.columns] = self._past[self._steps, self._all_envs]
        return late


class _Push:
    """Push of a robot or joint: it adds a velocity in a random direction, once in an episode.

    The push comes at a random step of the first half of the longest episode.
    """

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor) -> None:
        self._env, self._values = env, values
        self._stream = random.stream(f"stress.{sweep.name}")
        floating = {name: entity for name, entity in env.entities.items() if entity.is_floating}
        joints = {
            joint: (entity, column)
            for entity in env.entities.values()
            for column, joint in enumerate(entity.joint_names)
        }
        if sweep.element is None:
            if len(floating) != 1:
                reason = "no entity has a floating base" if not floating else "several entities have a floating base"
                hint = f"write push.NAME, NAME one of {listing([*floating, *joints])}"
                raise NameProblem(f"{reason}: name the entity or joint to push", hint)
            self._root, self._joint = next(iter(floating.values()), None), None
            return
        names = [*floating, *joints]
        found = match(sweep.element, names, "entity or joint")
        if len(found) != 1:
            raise NameProblem(
                f"the pattern matches several names: {listing(names[i] for i in found)}", "write one of these names"
            )
        name = names[found[0]]
        self._root, self._joint = floating.get(name), joints.get(name)

    def __call__(self) -> None:
        """Push in the environments whose episode has reached the random step of its push."""
        env = self._env
        # the random numbers are the step of the push and its direction
        uniform = random.uniform(_keys(env, env.episode_index), self._stream, 0, 2)
        push_step = 1 + (uniform[:, 0] * (env.max_episode_length // 2)).astype(np.int64)
        now = (env.episode_length_buf == torch.from_numpy(push_step).to(env.device)) & (self._values > 0)
        selection = env.engine.select(now, env.seed, env.episode_index) if bool(now.any()) else None
        if selection is None:
            return
        direction = torch.from_numpy(uniform[:, 1]).to(env.device)
        size = selection.read_view(self._values.float())
        direction = selection.read_view(direction)
        if self._joint is not None:
            entity, column = self._joint
            velocity = selection.read(entity.data.joint_vel)[:, column] + size * torch.where(direction < 0.5, -1.0, 1.0)
            entity.write_joint_velocities(selection, velocity[:, None], slice(column, column + 1))
        else:
            assert self._root is not None
            linear, angular = self._root.read_root_velocity(selection)
            angle = 2.0 * torch.pi * direction
            push = torch.stack([angle.cos() * size, angle.sin() * size, torch.zeros_like(size)], dim=1)
            self._root.write_root_velocity(selection, linear + push, angular)
        env.on_moved(selection)
        env.sim.forward_moved()


_STEPS = 1 << 32
"""Upper bound of the steps of an episode; step t of episode e has the unique counter e * _STEPS + t."""


def _keys(env: VecEnv, counters: Tensor) -> random.Keys:
    """Return a random key for each environment, from the index of its random stream and its counter. (num_envs,)"""
    ids = np.arange(env.num_envs) % (env.engine.shared_streams or env.num_envs)
    return random.row_keys(env.seed, ids, counters.cpu().numpy())


def _columns(terms: Sequence[TermLayout], pattern: str | None, what: str) -> Tensor:
    """Return the indices of columns whose term, or `term.element`, matches a regular expression. (k,) int64

    Args:
        terms: layout of the observations or of the actions.
        pattern: the regular expression; None: all columns.
        what: `observation` or `action`, for messages.
    """
    total = sum(term.size for term in terms)
    if pattern is None:
        return torch.arange(total)
    places: dict[str, list[int]] = {}
    start = 0
    for term in terms:
        for column in range(term.size):
            element = term.elements[column % len(term.elements)] if term.elements else str(column)
            places.setdefault(term.name, []).append(start + column)
            places.setdefault(f"{term.name}.{element}", []).append(start + column)
        start += term.size
    names = list(places)
    return torch.tensor(sorted({column for i in match(pattern, names, what) for column in places[names[i]]}))


# --- parameters of the model ---


class ModelPerturbation:
    """Perturbation of one parameter of the model, such as the mass, for one or more bodies, joints and so on.

    Args:
        env: the environment.
        sweep: the parameter.
        values: value of the parameter in each environment; NaN: not changed. (num_envs,) float64

    Raises:
        NameProblem: if the model lacks the parameter or an element, or if the values would change nothing.
    """

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor) -> None:
        field = PHYSICAL.get(sweep.parameter, sweep.parameter)
        if field not in FIELDS:
            raise unknown_parameter_error(sweep.parameter, [name for name in FIELDS if "." not in name])
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
            raise NameProblem(f"{sweep.parameter} is 0 for {listing(names)}, so a factor changes nothing", hint)
        if field == "body_mass" and bool((now == 0).any()):
            massless = [name for name, mass in zip(names, now[0].tolist(), strict=True) if mass == 0]
            raise NameProblem(f"the bodies {listing(massless)} have no mass to change", "name other bodies")
        if sweep.parameter == "effort_limit":
            limited = env.engine.model.actuator_forcelimited[rows].astype(bool).tolist()
            if unlimited := [name for name, has in zip(names, limited, strict=True) if not has]:
                hint = "give the joint an effort_limit, or name other actuators"
                raise NameProblem(f"the actuators {listing(unlimited)} have no effort limit to change", hint)
        self._affected = ~values.isnan() & ((values != 1.0) | sweep.absolute)

    def apply(self) -> Tensor | None:
        """Perturb the model values that the task has written since the last call of `note_values`.

        Returns:
            Whether each environment was changed, (num_envs,) bool; None if no environment was changed.
        """
        written = [part.written() & self._affected[:, None] for part in self._parts]
        rows = torch.stack([mask.any(dim=1) for mask in written]).any(dim=0)
        if not bool(rows.any()):
            return None
        for part, mask, values in zip(self._parts, written, self._targets(self._parts[0].now()), strict=True):
            part.write(mask, values)
        return rows

    def note_values(self) -> None:
        """Store the current model values, so that `apply` detects later writes of the task."""
        for part in self._parts:
            part.held = part.now()

    def _targets(self, now: Tensor) -> list[Tensor]:
        """Return the perturbed values of each changed field, (num_envs, values) each.

        `now` are the present values of the first field.
        """
        value = self._values[:, None]
        if not self._sweep.absolute:
            return [part.now() * value for part in self._parts]
        if self._sweep.parameter == "effort_limit":
            ends = torch.tensor([-1.0, 1.0], dtype=now.dtype, device=now.device)
            return [value * ends.repeat(now.shape[1] // 2)]
        if self._sweep.parameter == "gravity":
            return [now * (value / now.square().sum(dim=1, keepdim=True).sqrt())]  # the direction stays the same
        if self._sweep.parameter == "body_mass":
            return [part.now() * (value / now).repeat_interleave(part.width, dim=1) for part in self._parts]
        return [value.expand_as(now)]


class _Part:
    """The values of one model field that a perturbation changes, in every environment."""

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
        """Return a copy of the present values. (num_envs, elements x axes)"""
        return self._live[:, self._columns]

    def written(self) -> Tensor:
        """Return which values the task has written since they were perturbed. (num_envs, elements x axes) bool"""
        now = self.now()
        return torch.ones_like(now, dtype=torch.bool) if self.held is None else now != self.held

    def write(self, mask: Tensor, values: Tensor) -> None:
        """Set the values where the mask is true. (num_envs, elements x axes) each"""
        self._live[:, self._columns] = torch.where(mask, values.to(self._live.dtype), self.now())


def _rows(env: VecEnv, field: str, pattern: str | None) -> tuple[list[int], list[str]]:
    """Return the rows of a model field whose elements (bodies, joints, ...) match a pattern, and the elements' names.

    Without a pattern, all elements match.

    Raises:
        NameProblem: if the model has no such element.
    """
    model, kind = env.engine.model, FIELDS[field]
    if not kind:
        if pattern is not None:
            raise NameProblem("the parameter belongs to the whole world, not to an element", f"leave out '{pattern}'")
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
    """Return the rows of a model field that belong to the element with index `number`.

    A joint has one row for each degree of freedom (fields `dof_...`) or coordinate (`qpos0`).
    """
    if field.startswith("dof_"):
        return [dof for dof in range(model.nv) if model.dof_jntid[dof] == number]
    if field in ("qpos0", "qpos_spring"):
        ends = [*model.jnt_qposadr.tolist(), model.nq]
        return list(range(ends[number], ends[number + 1]))
    return [number]


def _axes(env: VecEnv, field: str, sweep: Sweep) -> list[int] | None:
    """Return the indices of the values that a sweep changes in a row of a model field; None: all values.

    Raises:
        NameProblem: if a row has several values, and all of them would be set to the same value.
    """
    if field == "geom_friction":
        return [0]  # index 0 is sliding friction; 1 and 2 are torsional and rolling friction
    own = sweep.parameter in PHYSICAL
    value = np.asarray(getattr(env.engine.model, field)) if field != "opt.gravity" else np.zeros((1, 3))
    width = value[:1].size
    if sweep.absolute and not own and width > 1:
        raise NameProblem(
            f"`abs:` would set all {width} values of {field} to one number", "leave out `abs:`, to scale them"
        )
    return None


def _require_affine(model: mujoco.MjModel, rows: list[int], names: list[str]) -> None:
    """Check that actuators have an affine gain and bias, so that scaled parameters scale their force.

    Args:
        model: the model.
        rows: ids of the actuators.
        names: names of the actuators.

    Raises:
        NameProblem: with the actuators of another type.
    """
    kinds = [(int(model.actuator_gaintype[row]), int(model.actuator_biastype[row])) for row in rows]
    unsupported = [
        name
        for name, (gain, bias) in zip(names, kinds, strict=True)
        if gain not in (_FIXED, _AFFINE) or bias not in (_NO_BIAS, _AFFINE_BIAS)
    ]
    if unsupported:
        hint = "choose motors, position or velocity actuators"
        raise NameProblem(f"{listing(unsupported)}: actuators of this type have no gain that can be scaled", hint)
