"""What a stress test changes in an environment: its model, and what lies between it and a policy.

Values are one an environment, so that one set of environments holds many variants of a task. Where a value is neutral
nothing is touched, and the environment lives as it does without.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli import random
from rlcli.envs.vec_env import TermLayout, VecEnv
from rlcli.errors import UsageError, listing
from rlcli.rl.sweeps import PHYSICAL, SIGNALS, Sweep, known
from rlcli.sim.model_fields import DERIVED_FROM, FIELDS
from rlcli.sim.names import NameProblem, match

Act = Callable[[Tensor], Tensor]
_OBJECTS = {
    "Bodies": mujoco.mjtObj.mjOBJ_BODY,
    "Joints": mujoco.mjtObj.mjOBJ_JOINT,
    "Geoms": mujoco.mjtObj.mjOBJ_GEOM,
    "Sites": mujoco.mjtObj.mjOBJ_SITE,
    "Actuators": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "Tendons": mujoco.mjtObj.mjOBJ_TENDON,
    "Pairs": mujoco.mjtObj.mjOBJ_PAIR,
}
_FIXED, _AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
_NO_BIAS, _AFFINE_BIAS = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)


class Perturbations:
    """Everything that is changed in an environment.

    Args:
        env: the environment; from now on its steps are perturbed.
        sweeps: the parameters.
        values: of each in every environment, NaN where it stays as it is. (num_envs, sweeps) float64

    Raises:
        UsageError: for a parameter or an element that there is not, or where it would change nothing.
    """

    def __init__(self, env: VecEnv, sweeps: Sequence[Sweep], values: Tensor) -> None:
        self._env = env
        self._physical: list[_Physical] = []
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
        # in the order in which a signal meets them: sensors are noisy before they are late, actions before they are
        for signals in (self._inputs, self._outputs):
            signals.sort(key=lambda signal: isinstance(signal, _Delay))
        self._hold()
        env.before_step = self._before_step

    def around(self, act: Act) -> Act:
        """A policy that sees and acts through what is perturbed."""
        if not self._inputs and not self._outputs:
            return act

        def perturbed(obs: Tensor) -> Tensor:
            fresh = self._env.episode_length_buf == 0
            for signal in self._inputs:
                obs = signal(obs, fresh)
            action = act(obs)
            for signal in self._outputs:
                action = signal(action, fresh)
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
            self._physical.append(_Physical(env, sweep, values))

    def _before_step(self) -> None:
        self._hold()
        for push in self._pushes:
            push()

    def _hold(self) -> None:
        """Change the model where that has not been done, or an event of the task has written since."""
        env, derived = self._env, None
        for physical in self._physical:
            changed = physical.hold()
            if changed is not None and physical.derives:
                derived = changed if derived is None else derived | changed
        if derived is not None:
            env.engine.set_constants(env.engine.select(derived, env.seed, env.episode_index))


class _Physical:
    """A number of the model."""

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor) -> None:
        field = PHYSICAL.get(sweep.parameter, sweep.parameter)
        if field not in FIELDS:
            raise known(sweep.parameter, [name for name in FIELDS if "." not in name])
        if not env.engine.can_expand(field):
            raise NameProblem(f"'{field}' cannot differ between environments on this engine")
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
            hint = "abs:LOW:HIGH sets it" if field != "opt.gravity" else "sim.gravity=[0,0,-9.81] gives it a direction"
            raise NameProblem(f"it is 0 of {listing(names)}, and a factor changes nothing", hint)
        if field == "body_mass" and bool((now == 0).any()):
            bare = [name for name, mass in zip(names, now[0].tolist(), strict=True) if mass == 0]
            raise NameProblem(f"no mass to change on {listing(bare)}", "name other bodies")
        if sweep.parameter == "effort_limit":
            limited = env.engine.model.actuator_forcelimited[rows].astype(bool).tolist()
            if bare := [name for name, has in zip(names, limited, strict=True) if not has]:
                raise NameProblem(f"{listing(bare)} has no effort limit", "give its joint an effort_limit")
        self._touched = ~values.isnan() & ((values != 1.0) | sweep.absolute)
        self._held: Tensor | None = None

    def hold(self) -> Tensor | None:
        """Change what has been written since; where something was. (num_envs,) bool"""
        now = self._parts[0].now()
        written = self._touched if self._held is None else self._touched & (now != self._held).any(dim=1)
        if not bool(written.any()):
            return None
        for part, values in zip(self._parts, self._targets(now), strict=True):
            part.write(written, values)
        self._held = self._parts[0].now()
        return written

    def _targets(self, now: Tensor) -> list[Tensor]:
        """What each part is to be. (num_envs, values) each"""
        value = self._values[:, None]
        if not self._sweep.absolute:
            return [part.now() * value for part in self._parts]
        if self._sweep.parameter == "effort_limit":
            ends = torch.tensor([-1.0, 1.0], dtype=now.dtype, device=now.device)
            return [value * ends.repeat(now.shape[1] // 2)]
        if self._sweep.parameter == "gravity":
            return [now * (value / now.square().sum(dim=1, keepdim=True).sqrt())]  # it keeps its direction
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
        self._columns = torch.tensor([row * width + axis for row in rows for axis in axes], device=env.device)

    def now(self) -> Tensor:
        """A copy of the values. (num_envs, elements x axes)"""
        return self._live[:, self._columns]

    def write(self, rows: Tensor, values: Tensor) -> None:
        """Set the values of the environments where `rows` holds."""
        self._live[:, self._columns] = torch.where(rows[:, None], values.to(self._live.dtype), self.now())


class _Signal:
    """Something that happens to some columns on their way to the policy or from it."""

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor, columns: Tensor, of_action: bool) -> None:
        self.env, self.values, self.columns, self.of_action = env, values, columns, of_action
        self.stream = random.stream(f"stress.{sweep.name}")

    def __call__(self, signal: Tensor, fresh: Tensor) -> Tensor:
        """(num_envs, k) -> (num_envs, k); `fresh`: where an episode has just begun"""
        raise NotImplementedError


class _Noise(_Signal):
    """Gaussian, drawn anew in every step."""

    def __call__(self, signal: Tensor, fresh: Tensor) -> Tensor:
        env, count = self.env, len(self.columns)
        keys = _keys(env, _STEPS * env.episode_index + env.episode_length_buf)
        drawn = torch.from_numpy(random.normal(keys, self.stream, 0, count)).to(signal.device)
        noisy = signal.clone()
        noisy[:, self.columns] += drawn * self.values[:, None].to(signal.dtype)
        return noisy


class _Delay(_Signal):
    """What was there some steps ago: before an episode's first observation that one, before its first action none."""

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor, columns: Tensor, of_action: bool) -> None:
        super().__init__(env, sweep, values, columns, of_action)
        self._steps = values.long()
        shape = (int(self._steps.max()) + 1, env.num_envs, len(columns))
        self._past = torch.zeros(shape, device=env.device)
        self._everyone = torch.arange(env.num_envs, device=env.device)

    def __call__(self, signal: Tensor, fresh: Tensor) -> Tensor:
        now = signal[:, self.columns]
        self._past = torch.cat([now[None], self._past[:-1]])
        begin = torch.zeros_like(now) if self.of_action else now
        self._past[1:] = torch.where(fresh[:, None], begin, self._past[1:])
        late = signal.clone()
        late[:, self.columns] = self._past[self._steps, self._everyone]
        return late


class _Push:
    """A blow once in an episode, at a moment of its first half that its life draws: a jump of a velocity."""

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
                what = "nothing floats" if not floating else "several things float"
                raise NameProblem(f"{what}: say what is pushed", f"push.NAME, of {listing([*floating, *joints])}")
            self._root, self._joint = next(iter(floating.values()), None), None
            return
        names = [*floating, *joints]
        found = match(sweep.element, names, "entity or joint")
        if len(found) != 1:
            raise NameProblem(f"it names {len(found)}: {listing(names[i] for i in found)}", "push one of them")
        name = names[found[0]]
        self._root, self._joint = floating.get(name), joints.get(name)

    def __call__(self) -> None:
        """Push where the moment has come."""
        env = self._env
        drawn = random.uniform(_keys(env, env.episode_index), self._stream, 0, 2)
        moment = torch.from_numpy(1 + (drawn[:, 0] * (env.max_episode_length // 2)).astype(np.int64)).to(env.device)
        now = (env.episode_length_buf == moment) & (self._values > 0)
        selection = env.engine.select(now, env.seed, env.episode_index) if bool(now.any()) else None
        if selection is None:
            return
        way = torch.from_numpy(drawn[:, 1]).to(env.device)
        size = selection.peek(self._values.float())
        way = selection.peek(way)
        if self._joint is not None:
            entity, column = self._joint
            velocity = selection.read(entity.data.joint_vel)[:, column] + size * torch.where(way < 0.5, -1.0, 1.0)
            entity.write_joint_velocities(selection, velocity[:, None], slice(column, column + 1))
        else:
            assert self._root is not None
            linear, angular = self._root.read_root_velocity(selection)
            angle = 2.0 * torch.pi * way
            blow = torch.stack([angle.cos() * size, angle.sin() * size, torch.zeros_like(size)], dim=1)
            self._root.write_root_velocity(selection, linear + blow, angular)
        env.sim.moved(selection)
        for sensor in env.sensors.values():
            sensor.moved(selection)
        env.sim.settle()


_STEPS = 1 << 32
"""More than an episode has."""


def _keys(env: VecEnv, counters: Tensor) -> random.Keys:
    """Keys of draws by life and counter. (num_envs,)"""
    ids = np.arange(env.num_envs) % (env.engine.lives or env.num_envs)
    return random.row_keys(env.seed, ids, counters.cpu().numpy())


def _columns(terms: Sequence[TermLayout], pattern: str | None, what: str) -> Tensor:
    """Columns of the terms, or of the elements `term.element`, that a pattern matches. (k,)"""
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


def _rows(env: VecEnv, field: str, pattern: str | None) -> tuple[list[int], list[str]]:
    """Rows of a model field, and the names of what they belong to.

    Raises:
        NameProblem: for what the model does not have.
    """
    model, kind = env.engine.model, FIELDS[field]
    if not kind:
        if pattern is not None:
            raise NameProblem(f"it is of the whole world, and not of '{pattern}'", "leave the name out")
        return [0], ["the world"]
    entities = [f"{name}/" for name in env.entities]
    ids: list[int] = []
    names: list[str] = []
    for number in range(1 if kind == "Bodies" else 0, _count(model, kind)):
        name = mujoco.mj_id2name(model, _OBJECTS[kind], number) or ""
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
        raise NameProblem(f"the model has no {kind.lower()}")
    return [row for i in chosen for row in _elements(model, field, ids[i])], [names[i] for i in chosen]


def _count(model: mujoco.MjModel, kind: str) -> int:
    counts = {"Bodies": "nbody", "Joints": "njnt", "Geoms": "ngeom", "Sites": "nsite"}
    counts |= {"Actuators": "nu", "Tendons": "ntendon", "Pairs": "npair"}
    return int(getattr(model, counts[kind]))


def _elements(model: mujoco.MjModel, field: str, number: int) -> list[int]:
    """Rows of an element in a field: of a joint one for each of its degrees of freedom."""
    if field.startswith("dof_"):
        return [dof for dof in range(model.nv) if model.dof_jntid[dof] == number]
    if field in ("qpos0", "qpos_spring"):
        last = model.njnt - 1
        stop = model.jnt_qposadr[number + 1] if number < last else model.nq
        return list(range(int(model.jnt_qposadr[number]), int(stop)))
    return [number]


def _axes(env: VecEnv, field: str, sweep: Sweep) -> list[int] | None:
    """Which of an element's values are meant; None: all.

    Raises:
        NameProblem: if one value were to be set on several.
    """
    if field == "geom_friction":
        return [0]
    own = sweep.parameter in PHYSICAL
    value = np.asarray(getattr(env.engine.model, field)) if field != "opt.gravity" else np.zeros((1, 3))
    width = value[:1].size
    if sweep.absolute and not own and width > 1:
        raise NameProblem(f"{field} has {width} values each, and they cannot all be one", "a factor: leave out abs:")
    return None


def _require_affine(model: mujoco.MjModel, rows: list[int], names: list[str]) -> None:
    kinds = [(int(model.actuator_gaintype[row]), int(model.actuator_biastype[row])) for row in rows]
    odd = [
        name
        for name, (gain, bias) in zip(names, kinds, strict=True)
        if gain not in (_FIXED, _AFFINE) or bias not in (_NO_BIAS, _AFFINE_BIAS)
    ]
    if odd:
        raise NameProblem(f"{listing(odd)} cannot be scaled as a whole", "motors, position and velocity actuators can")
