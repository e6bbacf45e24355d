"""Perturbations of a stress test: of the model, of the signals between environment and policy, and pushes.

Every environment has its own values, so that one set of environments holds many variants of a task. A neutral value
changes nothing: the environment runs the same episodes as without perturbations.
"""

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
from rlcli.evaluation.model_perturbations import ModelPerturbation
from rlcli.evaluation.stress_sweeps import SIGNALS, Sweep
from rlcli.scene.names import NameProblem, match

Act = Callable[[Tensor], Tensor]


class Perturbations(StepObserver):
    """Observer that applies all perturbations to an environment.

    Args:
        env: the environment; from now on its steps are perturbed.
        sweeps: the parameters.
        values: value of each parameter in every environment; NaN: not changed. (num_envs, sweeps) float64

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
        """Return the action function with perturbed observations and actions."""
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
        """Change the model's fields where necessary, and push bodies."""
        self._apply_to_model()
        for push in self._pushes:
            push()

    def _apply_to_model(self) -> None:
        """Change the model for the first time, or after an event of the task has written to it."""
        env, changed, derived = self._env, False, None
        for physical in self._physical:
            rows = physical.apply()
            changed = changed or rows is not None
            if rows is not None and physical.derives:
                derived = rows if derived is None else derived | rows
        if changed:
            for physical in self._physical:  # so that no one takes another's values for those of an event
                physical.note_values()
        if derived is not None:
            env.engine.set_constants(env.engine.select(derived, env.seed, env.episode_index))


class _Signal:
    """Perturbation of some columns of the observations or of the actions."""

    def __init__(self, env: VecEnv, sweep: Sweep, values: Tensor, columns: Tensor, of_action: bool) -> None:
        self.env, self.values, self.columns, self.of_action = env, values, columns, of_action
        self.stream = random.stream(f"stress.{sweep.name}")

    def __call__(self, signal: Tensor, is_first: Tensor) -> Tensor:
        """Perturb a signal (num_envs, k); `is_first` (num_envs,) marks the first step of an episode."""
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
    """Delay by some steps. Before enough steps, an episode's first observation is repeated, and the action is 0."""

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
    """Push once in an episode, at a random step of its first half: a jump of a velocity in a random direction."""

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
                reason = "no entity floats" if not floating else "several entities float"
                hint = f"write push.NAME, NAME one of {listing([*floating, *joints])}"
                raise NameProblem(f"{reason}: name the entity or joint to push", hint)
            self._root, self._joint = next(iter(floating.values()), None), None
            return
        names = [*floating, *joints]
        found = match(sweep.element, names, "entity or joint")
        if len(found) != 1:
            raise NameProblem(f"the pattern matches several names: {listing(names[i] for i in found)}", "choose one")
        name = names[found[0]]
        self._root, self._joint = floating.get(name), joints.get(name)

    def __call__(self) -> None:
        """Push the environments that have reached their random step."""
        env = self._env
        # columns: the step of the push, and its direction
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
"""More steps than an episode has: step t of episode e has the counter e * _STEPS + t."""


def _keys(env: VecEnv, counters: Tensor) -> random.Keys:
    """Return the keys of random numbers by random stream and counter. (num_envs,)"""
    ids = np.arange(env.num_envs) % (env.engine.shared_streams or env.num_envs)
    return random.row_keys(env.seed, ids, counters.cpu().numpy())


def _columns(terms: Sequence[TermLayout], pattern: str | None, what: str) -> Tensor:
    """Return the columns of the terms, or of the elements `term.element`, that match a pattern. (k,)"""
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
