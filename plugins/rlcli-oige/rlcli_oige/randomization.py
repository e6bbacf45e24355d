"""Domain randomisation with OmniIsaacGymEnvs' syntax, through the engine's per-environment model fields.

`on_startup` changes the model once. `on_reset` starts from the result of `on_startup` and holds for an episode.
`on_interval` starts from the values at the start of the episode. The second parameter of a gaussian is its standard
deviation. Samples depend only on the seed, the environment, and the episode or step.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from rlcli.errors import ConfigError, Problem, TaskError, did_you_mean, listing
from rlcli.random import stream
from rlcli.sim.env_selection import IdSelection
from rlcli_oige.randomization_yaml import Randomization, read_randomizations
from rlcli_oige.randomized_fields import VIEW_STATE, RandomizedField, apply_operation, make_field

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv

_CONSTANTS = ("body_masses", "body_inertias", "mass", "density", "inertia", "joint_armatures")
"""Attributes from which MuJoCo derives constants of the model."""


class Randomizer:
    """Domain randomisation of a task. The task reads this object as `self._dr_randomizer`; the environment calls it.

    A task may call `set_up_domain_randomization`, `dr.physics_view.step_randomization` and the like. They do nothing:
    the environment randomises at the right moments.
    """

    def __init__(self, env: OigeEnv) -> None:
        self._env = env
        block = env.settings["task"].get("domain_randomization") or {}
        self.randomize = bool(block.get("randomize", False)) and bool(block.get("randomization_params"))
        self.min_frequency = int(block.get("min_frequency", 1))
        self.randomizations: list[Randomization] = read_randomizations(block) if self.randomize else []
        self.active_domain_randomizations = {
            (*entry.path, entry.trigger): entry.parameters for entry in self.randomizations
        }
        self._parameters = dict(self.active_domain_randomizations)
        self.dr = self
        self.physics_view = self
        self._fields: dict[tuple[str, ...], RandomizedField] = {}
        self._noise = {
            kind: [g for g in self.randomizations if g.path == (kind,)] for kind in ("observations", "actions")
        }
        self._episode_noise: dict[str, Tensor] = {}
        self._step_noise: dict[str, Tensor] = {}
        self._steps_since_reset: Tensor | None = None

    # --- called by tasks ---

    def apply_on_startup_domain_randomization(self, task: Any) -> None:
        """Do nothing: the environment applies the startup randomisation."""

    def set_up_domain_randomization(self, task: Any) -> None:
        """Do nothing: the environment sets up the randomisation."""

    def step_randomization(self, reset_inds: Any = None) -> None:
        """Do nothing: the environment randomises in each step."""

    def get_initial_dr_distribution_parameters(self, *path: str) -> np.ndarray:
        """Return the `distribution_parameters` of the YAML, a pair of numbers or of lists.

        `path` has the keys of the YAML below `randomization_params`, such as `("observations", "on_reset")`.
        """
        return np.array(self.active_domain_randomizations[self._check_path(path)])

    def get_dr_distribution_parameters(self, *path: str) -> Any:
        """Return the current `distribution_parameters`; `path` as in `get_initial_dr_distribution_parameters`."""
        return self._parameters[self._check_path(path)]

    def set_dr_distribution_parameters(self, distribution_parameters: Any, *path: str) -> None:
        """Replace the current `distribution_parameters`, from the next sample on.

        `path` is as in `get_initial_dr_distribution_parameters`.

        Raises:
            TaskError: if the YAML has no randomisation at the path.
        """
        self._parameters[self._check_path(path)] = np.asarray(distribution_parameters).tolist()

    # --- called by the environment ---

    def start(self) -> None:
        """Look up the views, store the initial model, and apply `on_startup`.

        Raises:
            ConfigError: if a view is not registered.
        """
        env = self._env
        self._steps_since_reset = torch.full((env.num_envs,), self.min_frequency, dtype=torch.int64, device=env.device)
        problems = []
        for entry in self.randomizations:
            if entry.path[0] in ("observations", "actions") or entry.path in self._fields:
                continue
            try:
                self._fields[entry.path] = make_field(entry.path, env)
            except LookupError as problem:
                at = ("oige", "domain_randomization", "randomization_params", *entry.path[:2])
                problems.append(env.resolved.problem(at, str(problem.args[0])))
        if problems:
            raise ConfigError(problems)
        all_ids = torch.arange(env.num_envs, device=env.device)
        for entry in self.randomizations:
            if entry.trigger == "on_startup":
                self._apply(entry, all_ids, 0)
        for field in self._fields.values():
            field.store_episode_start(all_ids)
        self._set_constants([entry for entry in self.randomizations if entry.trigger == "on_startup"])

    def before_reset(self, ids: Tensor) -> None:
        """Apply the `on_reset` randomisations of the model, and sample new episodes' noise, before the task's reset."""
        if not self.randomizations or self._steps_since_reset is None or not len(ids):
            return
        due = ids[self._steps_since_reset[ids] >= self.min_frequency]
        self._steps_since_reset[due] = 0
        model_entries = [g for g in self.randomizations if g.path in self._fields and not self._acts_on_state(g)]
        applied = [g for g in model_entries if g.trigger == "on_reset"]
        for entry in applied:
            if len(due):
                self._fields[entry.path].restore(due)
                self._apply(entry, due, None)
                self._fields[entry.path].store_episode_start(due)
        if len(due):
            self._set_constants(applied)
        for kind, kind_entries in self._noise.items():
            for entry in kind_entries:
                if entry.trigger == "on_reset":
                    self._sample_noise(entry, kind, ids, None)

    def after_reset(self, ids: Tensor) -> None:
        """Apply the `on_reset` randomisations of the state, after the task's reset has written the initial state."""
        for entry in self.randomizations:
            if entry.trigger == "on_reset" and self._acts_on_state(entry) and len(ids):
                self._apply(entry, ids, None)

    def after_step(self) -> None:
        """Apply the `on_interval` randomisations that are due."""
        if not self.randomizations or self._steps_since_reset is None:
            return
        env = self._env
        self._steps_since_reset += 1
        step = env.common_step
        due_entries = [g for g in self.randomizations if g.trigger == "on_interval" and not step % g.interval]
        applied = [g for g in due_entries if g.path in self._fields]
        all_ids = torch.arange(env.num_envs, device=env.device)
        for entry in applied:
            if not self._acts_on_state(entry):
                self._fields[entry.path].restore_episode_start(all_ids)
            self._apply(entry, all_ids, step)
        self._set_constants(applied)
        for kind, kind_entries in self._noise.items():
            for entry in kind_entries:
                if entry.trigger == "on_interval":
                    self._step_noise.pop(entry.name, None)
                    if not step % entry.interval:
                        self._sample_noise(entry, kind, all_ids, step)

    def add_action_noise(self, action: Tensor) -> Tensor:
        """Return a copy of the action with the noise of `actions:`; without such noise the action itself."""
        return self._add_noise("actions", action.clone()) if self._noise["actions"] else action

    def add_observation_noise(self, obs: Tensor) -> None:
        """Add the noise of `observations:` to the observations (num_envs, d), in place."""
        if self._noise["observations"]:
            self._add_noise("observations", obs)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors to save: the current noise, and the values from which episodes start."""
        found = {f"held.{name}": value.clone() for name, value in self._episode_noise.items()}
        found |= {f"noisy.{name}": value.clone() for name, value in self._step_noise.items()}
        for path, field in self._fields.items():
            found[f"base.{'.'.join(path)}"] = field.base.clone()
        if self._steps_since_reset is not None and self.randomizations:
            found["since"] = self._steps_since_reset.clone()
        return found

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        self._episode_noise = {n.removeprefix("held."): v.clone() for n, v in state.items() if n.startswith("held.")}
        self._step_noise = {n.removeprefix("noisy."): v.clone() for n, v in state.items() if n.startswith("noisy.")}
        for path, field in self._fields.items():
            if f"base.{'.'.join(path)}" in state:
                field.base = state[f"base.{'.'.join(path)}"].clone()
        if "since" in state and self._steps_since_reset is not None:
            self._steps_since_reset.copy_(state["since"])

    # --- helpers ---

    def _check_path(self, path: tuple[str, ...]) -> tuple[str, ...]:
        if path not in self.active_domain_randomizations:
            known = [".".join(p) for p in self.active_domain_randomizations]
            name = ".".join(path)
            raise TaskError(
                f"the YAML has no randomisation of '{name}'",
                hint=did_you_mean(name, known) or f"randomised: {listing(known)}",
            )
        return path

    def _acts_on_state(self, entry: Randomization) -> bool:
        """Return whether a randomisation acts on the state, which the task's reset overwrites, and not on the model."""
        return entry.path[-1] in VIEW_STATE

    def _sample(self, entry: Randomization, ids: Tensor, step: int | None, size: int, shape: tuple[int, ...]) -> Tensor:
        """Sample the values of one randomisation, one row per environment.

        Args:
            entry: attribute and distribution.
            ids: environments.
            step: environment step on which the samples of `on_interval` depend; None: they depend on the episode index.
            size: number of values per environment.
            shape: shape of the values of one environment.
        """
        env = self._env
        numbers = ids.cpu().numpy()
        counters = env.episode_index.cpu().numpy()[numbers] if step is None else np.full(len(numbers), step)
        device = None if env.device.type == "cpu" else env.device
        rows = IdSelection(numbers, env.seed, counters, stream(f"oige.{entry.name}"), device, env.stream_ids)
        low, high = self._bounds(entry, size)
        if entry.distribution == "gaussian":
            sample = rows.normal(0.0, 1.0, (size,)) * high + low
        elif entry.distribution == "loguniform":
            sample = torch.exp(rows.uniform(0.0, 1.0, (size,)) * (high.log() - low.log()) + low.log())
        else:
            sample = rows.uniform(0.0, 1.0, (size,)) * (high - low) + low
        strength = entry.strength(env.common_step)
        neutral = 1.0 if entry.operation == "scaling" else 0.0
        if strength < 1.0 and entry.operation != "direct":
            sample = neutral + strength * (sample - neutral)
        return sample.reshape(len(numbers), *shape)

    def _bounds(self, entry: Randomization, size: int) -> tuple[Tensor, Tensor]:
        rows = torch.tensor(
            self._parameters[(*entry.path, entry.trigger)], dtype=torch.float32, device=self._env.device
        )
        if rows.dim() == 1:
            rows = rows[:, None]
        width = rows.shape[1]
        if width not in (1, size) and (width != 3 or size % 3):
            at = ("oige", "domain_randomization", "randomization_params", *entry.path, entry.trigger)
            message = f"distribution_parameters have {width} pairs, {'.'.join(entry.path)} has {size} columns"
            where = self._env.resolved.place(at)
            hint = "give one pair for all columns, or one pair per column"
            raise ConfigError([Problem(where, entry.name, message, hint)])
        rows = rows.repeat(1, size // width)
        return rows[0], rows[1]

    def _apply(self, entry: Randomization, ids: Tensor, step: int | None) -> None:
        field = self._fields[entry.path]
        current = field.read(ids)
        shape = tuple(current.shape[1:])
        if field.change is not apply_operation:  # orientations: three angles are sampled for each quaternion
            shape = (current.shape[1] // 4 * 3,)
        sample = self._sample(entry, ids, step, math.prod(shape), shape).to(current.dtype)
        field.write(ids, field.change(entry.operation, current, sample))

    def _set_constants(self, applied: list[Randomization]) -> None:
        if any(entry.path[-1] in _CONSTANTS for entry in applied):
            self._env.engine.set_constants()

    def _sample_noise(self, entry: Randomization, kind: str, ids: Tensor, step: int | None) -> None:
        env, task = self._env, self._env.task
        size = task.num_observations if kind == "observations" else task.num_actions
        store = self._episode_noise if entry.trigger == "on_reset" else self._step_noise
        if entry.name not in store:
            neutral = 1.0 if entry.operation == "scaling" else 0.0
            store[entry.name] = torch.full((env.num_envs, size), neutral, device=env.device)
        store[entry.name][ids] = self._sample(entry, ids, step, size, (size,))

    def _add_noise(self, kind: str, values: Tensor) -> Tensor:
        for store, when in ((self._episode_noise, "on_reset"), (self._step_noise, "on_interval")):
            for entry in self._noise[kind]:
                if entry.trigger == when and entry.name in store:
                    if entry.operation == "scaling":
                        values *= store[entry.name]
                    else:
                        values += store[entry.name]
        return values
