"""Domain randomization with OmniIsaacGymEnvs' syntax, through the engine's per-environment model fields.

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
from rlcli_oige.randomization_yaml import Gate, gates
from rlcli_oige.randomized_fields import VIEW_STATE, RandomizedField, apply_operation, make_field

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv

_CONSTANTS = ("body_masses", "body_inertias", "mass", "density", "inertia", "joint_armatures")
"""Attributes from which MuJoCo derives constants of the model."""


class Randomizer:
    """`self._dr_randomizer` of a task. It reads the YAML's block; the environment calls it.

    A task may call `set_up_domain_randomization`, `dr.physics_view.step_randomization` and the like. They do nothing:
    the environment randomizes at the right moments.
    """

    def __init__(self, env: OigeEnv) -> None:
        self._env = env
        block = env.settings["task"].get("domain_randomization") or {}
        self.randomize = bool(block.get("randomize", False)) and bool(block.get("randomization_params"))
        self.min_frequency = int(block.get("min_frequency", 1))
        self.gates: list[Gate] = gates(block) if self.randomize else []
        self.active_domain_randomizations = {(*gate.path, gate.gate): gate.parameters for gate in self.gates}
        self._parameters = dict(self.active_domain_randomizations)
        self.dr = self
        self.physics_view = self
        self._fields: dict[tuple[str, ...], RandomizedField] = {}
        self._noise = {kind: [g for g in self.gates if g.path == (kind,)] for kind in ("observations", "actions")}
        self._episode_noise: dict[str, Tensor] = {}
        self._step_noise: dict[str, Tensor] = {}
        self._steps_since_reset: Tensor | None = None

    # --- called by tasks ---

    def apply_on_startup_domain_randomization(self, task: Any) -> None:
        """Do nothing: the environment applies the startup randomization."""

    def set_up_domain_randomization(self, task: Any) -> None:
        """Do nothing: the environment sets up the randomization."""

    def step_randomization(self, reset_inds: Any = None) -> None:
        """Do nothing: the environment randomizes in each step."""

    def get_initial_dr_distribution_parameters(self, *path: str) -> np.ndarray:
        """Return the `distribution_parameters` of the YAML; `path` has the keys that lead to them."""
        return np.array(self.active_domain_randomizations[self._check_path(path)])

    def get_dr_distribution_parameters(self, *path: str) -> Any:
        """Return the current `distribution_parameters`; `path` has the YAML's keys that lead to them."""
        return self._parameters[self._check_path(path)]

    def set_dr_distribution_parameters(self, distribution_parameters: Any, *path: str) -> None:
        """Replace `distribution_parameters` during the training; `path` has the YAML's keys that lead to them."""
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
        for gate in self.gates:
            if gate.path[0] in ("observations", "actions") or gate.path in self._fields:
                continue
            try:
                self._fields[gate.path] = make_field(gate.path, env)
            except LookupError as problem:
                at = ("oige", "domain_randomization", "randomization_params", *gate.path[:2])
                problems.append(env.resolved.problem(at, str(problem.args[0])))
        if problems:
            raise ConfigError(problems)
        all_ids = torch.arange(env.num_envs, device=env.device)
        for gate in self.gates:
            if gate.gate == "on_startup":
                self._apply(gate, all_ids, 0)
        for field in self._fields.values():
            field.store_episode_start(all_ids)
        self._set_constants([gate for gate in self.gates if gate.gate == "on_startup"])

    def before_reset(self, ids: Tensor) -> None:
        """Apply `on_reset` to the model, and sample noise for the new episodes, before the task's reset."""
        if not self.gates or self._steps_since_reset is None or not len(ids):
            return
        due = ids[self._steps_since_reset[ids] >= self.min_frequency]
        self._steps_since_reset[due] = 0
        model_gates = [g for g in self.gates if g.path in self._fields and not self._acts_on_state(g)]
        applied = [g for g in model_gates if g.gate == "on_reset"]
        for gate in applied:
            if len(due):
                self._fields[gate.path].restore(due)
                self._apply(gate, due, None)
                self._fields[gate.path].store_episode_start(due)
        if len(due):
            self._set_constants(applied)
        for kind, kind_gates in self._noise.items():
            for gate in kind_gates:
                if gate.gate == "on_reset":
                    self._sample_noise(gate, kind, ids, None)

    def after_reset(self, ids: Tensor) -> None:
        """Apply `on_reset` to attributes of the state, after the task's reset has written the initial state."""
        for gate in self.gates:
            if gate.gate == "on_reset" and self._acts_on_state(gate) and len(ids):
                self._apply(gate, ids, None)

    def after_step(self) -> None:
        """Apply `on_interval` where it is due."""
        if not self.gates or self._steps_since_reset is None:
            return
        env = self._env
        self._steps_since_reset += 1
        step = env.common_step
        due_gates = [g for g in self.gates if g.gate == "on_interval" and not step % g.interval]
        applied = [g for g in due_gates if g.path in self._fields]
        all_ids = torch.arange(env.num_envs, device=env.device)
        for gate in applied:
            if not self._acts_on_state(gate):
                self._fields[gate.path].restore_episode_start(all_ids)
            self._apply(gate, all_ids, step)
        self._set_constants(applied)
        for kind, kind_gates in self._noise.items():
            for gate in kind_gates:
                if gate.gate == "on_interval":
                    self._step_noise.pop(gate.name, None)
                    if not step % gate.interval:
                        self._sample_noise(gate, kind, all_ids, step)

    def add_action_noise(self, action: Tensor) -> Tensor:
        """Return the action with noise."""
        return self._add_noise("actions", action.clone()) if self._noise["actions"] else action

    def add_observation_noise(self, obs: Tensor) -> None:
        """Add noise to observations, in place."""
        if self._noise["observations"]:
            self._add_noise("observations", obs)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors that keep their values between steps."""
        found = {f"held.{name}": value.clone() for name, value in self._episode_noise.items()}
        found |= {f"noisy.{name}": value.clone() for name, value in self._step_noise.items()}
        for path, field in self._fields.items():
            found[f"base.{'.'.join(path)}"] = field.base.clone()
        if self._steps_since_reset is not None and self.gates:
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
                f"the YAML has no randomization of '{name}'",
                hint=did_you_mean(name, known) or f"randomized: {listing(known)}",
            )
        return path

    def _acts_on_state(self, gate: Gate) -> bool:
        """Return whether a randomization acts on the state, which the task's reset overwrites, and not on the model."""
        return gate.path[-1] in VIEW_STATE

    def _sample(self, gate: Gate, ids: Tensor, step: int | None, size: int, shape: tuple[int, ...]) -> Tensor:
        """Sample the values of one randomization, one row per environment.

        Args:
            gate: attribute and distribution.
            ids: environments.
            step: environment step that keys the samples of `on_interval`; None: the episode index keys them.
            size: number of values per environment.
            shape: shape of the values of one environment.
        """
        env = self._env
        numbers = ids.cpu().numpy()
        counters = env.episode_index.cpu().numpy()[numbers] if step is None else np.full(len(numbers), step)
        device = None if env.device.type == "cpu" else env.device
        rows = IdSelection(numbers, env.seed, counters, stream(f"oige.{gate.name}"), device, env.stream_ids)
        low, high = self._bounds(gate, size)
        if gate.distribution == "gaussian":
            sample = rows.normal(0.0, 1.0, (size,)) * high + low
        elif gate.distribution == "loguniform":
            sample = torch.exp(rows.uniform(0.0, 1.0, (size,)) * (high.log() - low.log()) + low.log())
        else:
            sample = rows.uniform(0.0, 1.0, (size,)) * (high - low) + low
        strength = gate.strength(env.common_step)
        neutral = 1.0 if gate.operation == "scaling" else 0.0
        if strength < 1.0 and gate.operation != "direct":
            sample = neutral + strength * (sample - neutral)
        return sample.reshape(len(numbers), *shape)

    def _bounds(self, gate: Gate, size: int) -> tuple[Tensor, Tensor]:
        rows = torch.tensor(self._parameters[(*gate.path, gate.gate)], dtype=torch.float32, device=self._env.device)
        if rows.dim() == 1:
            rows = rows[:, None]
        width = rows.shape[1]
        if width not in (1, size) and (width != 3 or size % 3):
            at = ("oige", "domain_randomization", "randomization_params", *gate.path, gate.gate)
            message = f"distribution_parameters have {width} pairs, {'.'.join(gate.path)} has {size} columns"
            where = self._env.resolved.place(at)
            hint = "give one pair for all columns, or one pair per column"
            raise ConfigError([Problem(where, gate.name, message, hint)])
        rows = rows.repeat(1, size // width)
        return rows[0], rows[1]

    def _apply(self, gate: Gate, ids: Tensor, step: int | None) -> None:
        field = self._fields[gate.path]
        current = field.read(ids)
        shape = tuple(current.shape[1:])
        if field.change is not apply_operation:  # orientations: three angles are sampled for each quaternion
            shape = (current.shape[1] // 4 * 3,)
        sample = self._sample(gate, ids, step, math.prod(shape), shape).to(current.dtype)
        field.write(ids, field.change(gate.operation, current, sample))

    def _set_constants(self, applied: list[Gate]) -> None:
        if any(gate.path[-1] in _CONSTANTS for gate in applied):
            self._env.engine.set_constants()

    def _sample_noise(self, gate: Gate, kind: str, ids: Tensor, step: int | None) -> None:
        env, task = self._env, self._env.task
        size = task.num_observations if kind == "observations" else task.num_actions
        store = self._episode_noise if gate.gate == "on_reset" else self._step_noise
        if gate.name not in store:
            neutral = 1.0 if gate.operation == "scaling" else 0.0
            store[gate.name] = torch.full((env.num_envs, size), neutral, device=env.device)
        store[gate.name][ids] = self._sample(gate, ids, step, size, (size,))

    def _add_noise(self, kind: str, values: Tensor) -> Tensor:
        for store, when in ((self._episode_noise, "on_reset"), (self._step_noise, "on_interval")):
            for gate in self._noise[kind]:
                if gate.gate == when and gate.name in store:
                    if gate.operation == "scaling":
                        values *= store[gate.name]
                    else:
                        values += store[gate.name]
        return values
