"""What a stress test changes in an environment: its model, and what lies between it and a policy.

Values are one an environment, so that one set of environments holds many variants of a task. Where a value is neutral
nothing is changed: the environment gives the same episodes as without perturbations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from rlcli import random
from rlcli.envs.layout import TermLayout
from rlcli.envs.observers import StepObserver
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import UsageError, listing
from rlcli.evaluation.model_perturbations import Physical
from rlcli.evaluation.stress_params import SIGNALS, Sweep
from rlcli.scene.names import NameProblem, match

Act = Callable[[Tensor], Tensor]


class Perturbations(StepObserver):
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
        self._physical: list[Physical] = []
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
        env.observers.add(self)

    def around(self, act: Act) -> Act:
        """A policy that sees and acts through what is perturbed."""
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
            self._physical.append(Physical(env, sweep, values))

    def before_step(self) -> None:
        """Hold the model's fields and push bodies."""
        self._hold()
        for push in self._pushes:
            push()

    def _hold(self) -> None:
        """Change the model where that has not been done, or an event of the task has written since."""
        env, changed, derived = self._env, False, None
        for physical in self._physical:
            rows = physical.hold()
            changed = changed or rows is not None
            if rows is not None and physical.derives:
                derived = rows if derived is None else derived | rows
        if changed:
            for physical in self._physical:  # what one has written is no event to another
                physical.note()
        if derived is not None:
            env.engine.set_constants(env.engine.select(derived, env.seed, env.episode_index))


class _Signal:
    """Something that happens to some columns on their way to the policy or from it."""

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor, columns: Tensor, of_action: bool) -> None:
        self.env, self.values, self.columns, self.of_action = env, values, columns, of_action
        self.stream = random.stream(f"stress.{sweep.name}")

    def __call__(self, signal: Tensor, is_first: Tensor) -> Tensor:
        """(num_envs, k) -> (num_envs, k); `is_first`: environments in the first step of an episode"""
        raise NotImplementedError


class _Noise(_Signal):
    """Gaussian, drawn anew in every step."""

    def __call__(self, signal: Tensor, is_first: Tensor) -> Tensor:
        env, count = self.env, len(self.columns)
        keys = _keys(env, _STEPS * env.episode_index + env.episode_length_buf)
        noise = torch.from_numpy(random.normal(keys, self.stream, 0, count)).to(signal.device)
        noisy = signal.clone()
        noisy[:, self.columns] += noise * self.values[:, None].to(signal.dtype)
        return noisy


class _Delay(_Signal):
    """What was there some steps ago: before an episode's first observation that one, before its first action none."""

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor, columns: Tensor, of_action: bool) -> None:
        super().__init__(env, sweep, values, columns, of_action)
        self._steps = values.long()
        shape = (int(self._steps.max()) + 1, env.num_envs, len(columns))
        self._past = torch.zeros(shape, device=env.device)
        self._everyone = torch.arange(env.num_envs, device=env.device)

    def __call__(self, signal: Tensor, is_first: Tensor) -> Tensor:
        now = signal[:, self.columns]
        self._past = torch.cat([now[None], self._past[:-1]])
        begin = torch.zeros_like(now) if self.of_action else now
        self._past[1:] = torch.where(is_first[:, None], begin, self._past[1:])
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
        uniform = random.uniform(_keys(env, env.episode_index), self._stream, 0, 2)
        moment = torch.from_numpy(1 + (uniform[:, 0] * (env.max_episode_length // 2)).astype(np.int64)).to(env.device)
        now = (env.episode_length_buf == moment) & (self._values > 0)
        selection = env.engine.select(now, env.seed, env.episode_index) if bool(now.any()) else None
        if selection is None:
            return
        way = torch.from_numpy(uniform[:, 1]).to(env.device)
        size = selection.read_view(self._values.float())
        way = selection.read_view(way)
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
        env.sim.on_moved(selection)
        for sensor in env.sensors.values():
            sensor.on_moved(selection)
        env.sim.forward_moved()


_STEPS = 1 << 32
"""More than an episode has."""


def _keys(env: VecEnv, counters: Tensor) -> random.Keys:
    """Keys of draws by life and counter. (num_envs,)"""
    ids = np.arange(env.num_envs) % (env.engine.shared_streams or env.num_envs)
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
