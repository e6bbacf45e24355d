"""Domain randomisation by OmniIsaacGymEnvs' grammar, through the engine's per-environment model fields.

`on_startup` changes the model once; `on_reset` starts from that and holds for an episode; `on_interval` acts on top of
what `on_reset` left. The second parameter of a gaussian is its standard deviation. Draws depend on the seed, the
environment and the episode or the step, and on nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from rlcli.errors import ConfigError, Problem, TaskError, did_you_mean, listing
from rlcli.random import stream
from rlcli.sim.selection import IdSelection
from rlcli_oige.maths import normalize_angle
from rlcli_oige.randomization_yaml import Gate, gates
from rlcli_oige.rotations import get_euler_xyz, quat_from_euler_xyz, quat_mul
from rlcli_oige.views import ArticulationView, RigidPrimView

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv

_CONSTANTS = ("body_masses", "body_inertias", "mass", "density", "inertia", "joint_armatures")
"""Attributes from which MuJoCo derives constants of the model."""
_STATE = (
    "position",
    "orientation",
    "linear_velocity",
    "angular_velocity",
    "velocity",
    "joint_positions",
    "joint_velocities",
)
"""Attributes of the state: an operation acts on what is, not on what was at the start."""


class Randomizer:
    """`self._dr_randomizer`: reads the YAML's block, and is run by the environment.

    The calls that OmniIsaacGymEnvs wants from a task (`set_up_domain_randomization` and its kin, and
    `dr.physics_view.step_randomization`) are accepted; the environment does their work at the right moments.
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
        self._fields: dict[tuple[str, ...], _Field] = {}
        self._noise = {kind: [g for g in self.gates if g.path == (kind,)] for kind in ("observations", "actions")}
        self._held: dict[str, Tensor] = {}
        self._noisy: dict[str, Tensor] = {}
        self._since: Tensor | None = None

    # --- what a task may call ---

    def apply_on_startup_domain_randomization(self, task: Any) -> None:
        """Nothing: it is applied by itself."""

    def set_up_domain_randomization(self, task: Any) -> None:
        """Nothing: it is set up by itself."""

    def step_randomization(self, reset_inds: Any = None) -> None:
        """Nothing: the environment does it."""

    def get_initial_dr_distribution_parameters(self, *path: str) -> np.ndarray:
        """Parameters of a distribution as the YAML has them."""
        return np.array(self.active_domain_randomizations[self._known(path)])

    def get_dr_distribution_parameters(self, *path: str) -> Any:
        """Parameters of a distribution as they are now."""
        return self._parameters[self._known(path)]

    def set_dr_distribution_parameters(self, distribution_parameters: Any, *path: str) -> None:
        """Replace the parameters of a distribution: a schedule of the task's own."""
        self._parameters[self._known(path)] = np.asarray(distribution_parameters).tolist()

    # --- what the environment calls ---

    def start(self) -> None:
        """Look up views, remember the model as it is, and apply what is applied once.

        Raises:
            ConfigError: for a view that is not registered.
        """
        env = self._env
        self._since = torch.full((env.num_envs,), self.min_frequency, dtype=torch.int64, device=env.device)
        problems = []
        for gate in self.gates:
            if gate.path[0] in ("observations", "actions") or gate.path in self._fields:
                continue
            try:
                self._fields[gate.path] = self._field(gate.path)
            except LookupError as problem:
                at = ("oige", "domain_randomization", "randomization_params", *gate.path[:2])
                problems.append(env.resolved.problem(at, str(problem.args[0])))
        if problems:
            raise ConfigError(problems)
        everyone = torch.arange(env.num_envs, device=env.device)
        for gate in self.gates:
            if gate.gate == "on_startup":
                self._fire(gate, everyone, 0)
        for field in self._fields.values():
            field.settle(everyone)
        self._set_constants([gate for gate in self.gates if gate.gate == "on_startup"])

    def before_reset(self, ids: Tensor) -> None:
        """Episodes begin in these environments: what holds for an episode is drawn."""
        if not self.gates or self._since is None or not len(ids):
            return
        due = ids[self._since[ids] >= self.min_frequency]
        self._since[due] = 0
        fired = [g for g in self.gates if g.gate == "on_reset" and g.path in self._fields and not self._after(g)]
        for gate in fired:
            if len(due):
                self._fields[gate.path].restore(due)
                self._fire(gate, due, None)
                self._fields[gate.path].settle(due)
        if len(due):
            self._set_constants(fired)
        for kind, gates_of in self._noise.items():
            for gate in gates_of:
                if gate.gate == "on_reset":
                    self._draw_noise(gate, kind, ids, None)

    def after_reset(self, ids: Tensor) -> None:
        """The task has written start states: those of its attributes that belong to the state are changed."""
        for gate in self.gates:
            if gate.gate == "on_reset" and self._after(gate) and len(ids):
                self._fire(gate, ids, None)

    def after_step(self) -> None:
        """A step was taken: what is done again and again is done where it is due."""
        if not self.gates or self._since is None:
            return
        env = self._env
        self._since += 1
        step = env.common_step
        fired = [g for g in self.gates if g.gate == "on_interval" and g.path in self._fields and not step % g.interval]
        everyone = torch.arange(env.num_envs, device=env.device)
        for gate in fired:
            if not self._after(gate):
                self._fields[gate.path].unstack(everyone)
            self._fire(gate, everyone, step)
        self._set_constants(fired)
        for kind, gates_of in self._noise.items():
            for gate in gates_of:
                if gate.gate == "on_interval":
                    self._noisy.pop(gate.name, None)
                    if not step % gate.interval:
                        self._draw_noise(gate, kind, everyone, step)

    def noisy_actions(self, action: Tensor) -> Tensor:
        """The action with its noise."""
        return self._add_noise("actions", action.clone()) if self._noise["actions"] else action

    def noisy_observations(self, obs: Tensor) -> None:
        """Put noise on observations, in place."""
        if self._noise["observations"]:
            self._add_noise("observations", obs)

    def state(self) -> dict[str, Tensor]:
        """What it carries from step to step."""
        found = {f"held.{name}": value.clone() for name, value in self._held.items()}
        found |= {f"noisy.{name}": value.clone() for name, value in self._noisy.items()}
        for path, field in self._fields.items():
            found[f"base.{'.'.join(path)}"] = field.base.clone()
        if self._since is not None and self.gates:
            found["since"] = self._since.clone()
        return found

    def load(self, state: dict[str, Tensor]) -> None:
        """Take back what `state` gave."""
        self._held = {n.removeprefix("held."): v.clone() for n, v in state.items() if n.startswith("held.")}
        self._noisy = {n.removeprefix("noisy."): v.clone() for n, v in state.items() if n.startswith("noisy.")}
        for path, field in self._fields.items():
            if f"base.{'.'.join(path)}" in state:
                field.base = state[f"base.{'.'.join(path)}"].clone()
        if "since" in state and self._since is not None:
            self._since.copy_(state["since"])

    # --- helpers ---

    def _known(self, path: tuple[str, ...]) -> tuple[str, ...]:
        if path not in self.active_domain_randomizations:
            known = [".".join(p) for p in self.active_domain_randomizations]
            name = ".".join(path)
            raise TaskError(
                f"nothing randomises '{name}'", hint=did_you_mean(name, known) or f"there: {listing(known)}"
            )
        return path

    def _after(self, gate: Gate) -> bool:
        """Whether it acts on the state, which the task's reset writes first."""
        return gate.path[-1] in (*_STATE, "joint_efforts", "force")

    def _draw(self, gate: Gate, ids: Tensor, step: int | None, size: int, shape: tuple[int, ...]) -> Tensor:
        """Draws of a gate, one row an environment; a step keys those that are made again within an episode."""
        env = self._env
        numbers = ids.cpu().numpy()
        counters = env.episode_index.cpu().numpy()[numbers] if step is None else np.full(len(numbers), step)
        device = None if env.device.type == "cpu" else env.device
        rows = IdSelection(numbers, env.seed, counters, stream(f"oige.{gate.name}"), device, env.engine.shared_streams)
        low, high = self._bounds(gate, size)
        if gate.distribution == "gaussian":
            drawn = rows.normal(0.0, 1.0, (size,)) * high + low
        elif gate.distribution == "loguniform":
            drawn = torch.exp(rows.uniform(0.0, 1.0, (size,)) * (high.log() - low.log()) + low.log())
        else:
            drawn = rows.uniform(0.0, 1.0, (size,)) * (high - low) + low
        strength = gate.strength(env.common_step)
        neutral = 1.0 if gate.operation == "scaling" else 0.0
        if strength < 1.0 and gate.operation != "direct":
            drawn = neutral + strength * (drawn - neutral)
        return drawn.reshape(len(numbers), *shape)

    def _bounds(self, gate: Gate, size: int) -> tuple[Tensor, Tensor]:
        rows = torch.tensor(self._parameters[(*gate.path, gate.gate)], dtype=torch.float32, device=self._env.device)
        if rows.dim() == 1:
            rows = rows[:, None]
        width = rows.shape[1]
        if width not in (1, size) and (width != 3 or size % 3):
            at = ("oige", "domain_randomization", "randomization_params", *gate.path, gate.gate)
            message = f"distribution_parameters have {width} columns, {'.'.join(gate.path)} has {size}"
            place = self._env.resolved.place(at)
            raise ConfigError([Problem(place, gate.name, message, "one pair for all, or one column each")])
        rows = rows.repeat(1, size // width)
        return rows[0], rows[1]

    def _fire(self, gate: Gate, ids: Tensor, step: int | None) -> None:
        field = self._fields[gate.path]
        current = field.read(ids)
        shape = tuple(current.shape[1:]) if field.change is _changed else (current.shape[1] // 4 * 3,)  # or angles
        drawn = self._draw(gate, ids, step, math.prod(shape), shape).to(current.dtype)
        field.write(ids, field.change(gate.operation, current, drawn))

    def _set_constants(self, fired: list[Gate]) -> None:
        if any(gate.path[-1] in _CONSTANTS for gate in fired):
            self._env.engine.set_constants()

    def _draw_noise(self, gate: Gate, kind: str, ids: Tensor, step: int | None) -> None:
        env, task = self._env, self._env.task
        size = task.num_observations if kind == "observations" else task.num_actions
        store = self._held if gate.gate == "on_reset" else self._noisy
        if gate.name not in store:
            neutral = 1.0 if gate.operation == "scaling" else 0.0
            store[gate.name] = torch.full((env.num_envs, size), neutral, device=env.device)
        store[gate.name][ids] = self._draw(gate, ids, step, size, (size,))

    def _add_noise(self, kind: str, values: Tensor) -> Tensor:
        for store, when in ((self._held, "on_reset"), (self._noisy, "on_interval")):
            for gate in self._noise[kind]:
                if gate.gate == when and gate.name in store:
                    if gate.operation == "scaling":
                        values *= store[gate.name]
                    else:
                        values += store[gate.name]
        return values

    def _field(self, path: tuple[str, ...]) -> _Field:
        env = self._env
        if path[0] == "simulation":
            gravity = env.engine.expand("opt.gravity")
            return _Field(lambda ids: gravity[ids], lambda ids, values: _put(gravity, ids, None, values), env)
        views: Any = env.handle.world.scene
        known = views.articulated_views if path[0] == "articulation_views" else views.rigid_prim_views
        if path[1] not in known:
            near = did_you_mean(path[1], known) or f"registered: {listing(known)}"
            raise LookupError(f"no view '{path[1]}' is registered by the task; {near}")
        view = known[path[1]]
        if path[2] in _VIEW_STATE:
            return _state_field(view, path[2], env)
        if path[0] == "articulation_views":
            return _articulation_field(view, path[2], env)
        return _body_field(view, path[2], env)


class _Field:
    """Something that differs between environments: read and written by environment, with what it was at first.

    `base` is what an `on_reset` of an episode starts from, until `settle`; then what `on_interval` acts on.
    """

    def __init__(
        self,
        read: Callable[[Tensor], Tensor],
        write: Callable[[Tensor, Tensor], None],
        env: OigeEnv,
        change: Callable[[str, Tensor, Tensor], Tensor] | None = None,
        state: bool = False,
    ) -> None:
        self.read, self.write, self.change = read, write, change or _changed
        everyone = torch.arange(env.num_envs, device=env.device)
        self._of_state = state
        self.first = torch.empty(0) if state else read(everyone).clone()
        self.base = self.first.clone()
        self._started = False

    def restore(self, ids: Tensor) -> None:
        """Back to what it was after start-up."""
        if not self._of_state:
            self.write(ids, self.first[ids])

    def unstack(self, ids: Tensor) -> None:
        """Back to what the episode began with."""
        if not self._of_state:
            self.write(ids, self.base[ids])

    def settle(self, ids: Tensor) -> None:
        """What it is now is what the episode begins with, and at the first time what all episodes begin with."""
        if self._of_state:
            return
        self.base[ids] = self.read(ids)
        if not self._started:
            self.first, self._started = self.base.clone(), True


def _changed(operation: str, current: Tensor, drawn: Tensor) -> Tensor:
    if operation == "additive":
        return current + drawn
    return current * drawn if operation == "scaling" else drawn


def _turned(operation: str, current: Tensor, drawn: Tensor) -> Tensor:
    """Orientations, changed by roll, pitch and yaw. (n, 4 k), (n, 3 k) -> (n, 4 k)"""
    now, angles = current.reshape(-1, 4), drawn.reshape(-1, 3)
    if operation == "scaling":
        angles = angles * normalize_angle(torch.stack(get_euler_xyz(now), dim=1))
    turn = quat_from_euler_xyz(angles[:, 0], angles[:, 1], angles[:, 2]).to(current.dtype)
    return (quat_mul(turn, now) if operation == "additive" else turn).reshape(current.shape)


_VIEW_STATE = (*_STATE, "joint_efforts", "force")


def _state_field(view: Any, attribute: str, env: OigeEnv) -> _Field:
    def rows(ids: Tensor) -> Tensor:
        """Rows of a view with several bodies an environment."""
        per = view._per_env
        return ids if per == 1 else (ids[:, None] * per + torch.arange(per, device=ids.device)).reshape(-1)

    def flat(values: Tensor, width: int) -> Tensor:
        return values.reshape(-1, width)

    def grouped(values: Tensor, ids: Tensor) -> Tensor:
        return values.reshape(len(ids), -1)

    readers: dict[str, Callable[[Tensor], Tensor]] = {
        "position": lambda ids: grouped(view.get_world_poses(rows(ids))[0], ids),
        "orientation": lambda ids: grouped(view.get_world_poses(rows(ids))[1], ids),
        "linear_velocity": lambda ids: grouped(view.get_velocities(rows(ids))[:, :3], ids),
        "angular_velocity": lambda ids: grouped(view.get_velocities(rows(ids))[:, 3:], ids),
        "velocity": lambda ids: grouped(view.get_velocities(rows(ids)), ids),
        "joint_positions": lambda ids: view.get_joint_positions(ids),
        "joint_velocities": lambda ids: view.get_joint_velocities(ids),
        "joint_efforts": lambda ids: view.get_applied_joint_efforts(ids),
        "force": lambda ids: torch.zeros(len(ids), 3 * view._per_env, device=env.device),
    }
    writers: dict[str, Callable[[Tensor, Tensor], None]] = {
        "position": lambda ids, v: view.set_world_poses(flat(v, 3), None, rows(ids)),
        "orientation": lambda ids, v: view.set_world_poses(None, flat(v, 4), rows(ids)),
        "linear_velocity": lambda ids, v: view.set_linear_velocities(flat(v, 3), rows(ids)),
        "angular_velocity": lambda ids, v: view.set_angular_velocities(flat(v, 3), rows(ids)),
        "velocity": lambda ids, v: view.set_velocities(flat(v, 6), rows(ids)),
        "joint_positions": lambda ids, v: view.set_joint_positions(v, ids),
        "joint_velocities": lambda ids, v: view.set_joint_velocities(v, ids),
        "joint_efforts": lambda ids, v: view.set_joint_efforts(v, ids),
        "force": lambda ids, v: env.push_later(view, rows(ids), flat(v, 3)),
    }
    change = _turned if attribute == "orientation" else _changed
    return _Field(readers[attribute], writers[attribute], env, change, state=True)


def _articulation_field(view: ArticulationView, attribute: str, env: OigeEnv) -> _Field:
    engine, model, entity = env.engine, env.engine.model, view.entity
    joints = torch.tensor(entity.joint_ids, device=env.device)[view._order]
    drives = view._drives["position"][1]
    bodies = torch.tensor(view._body_ids, device=env.device)
    dofs = view._dof_columns
    if attribute == "stiffness":
        gain, bias = engine.expand("actuator_gainprm"), engine.expand("actuator_biasprm")

        def set_stiffness(ids: Tensor, values: Tensor) -> None:
            gain[ids[:, None], drives, 0] = values
            bias[ids[:, None], drives, 1] = -values

        return _Field(lambda ids: gain[ids[:, None], drives, 0], set_stiffness, env)
    if attribute == "damping" and len(drives):
        bias = engine.expand("actuator_biasprm")

        def set_damping(ids: Tensor, values: Tensor) -> None:
            bias[ids[:, None], drives, 2] = -values

        return _Field(lambda ids: -bias[ids[:, None], drives, 2], set_damping, env)
    if attribute == "damping":
        return _column_field(engine.expand("dof_damping"), dofs, env)
    if attribute in ("lower_dof_limits", "upper_dof_limits"):
        end, ranges = int(attribute == "upper_dof_limits"), engine.expand("jnt_range")

        def set_limit(ids: Tensor, values: Tensor) -> None:
            ranges[ids[:, None], joints, end] = values

        return _Field(lambda ids: ranges[ids[:, None], joints, end], set_limit, env)
    if attribute == "max_efforts":
        return _Field(lambda ids: view.get_max_efforts(ids), lambda ids, values: view.set_max_efforts(values, ids), env)
    if attribute == "material_properties":
        return _friction_field(view._body_ids, env)
    if attribute in ("body_masses", "body_inertias"):
        return _mass_field(bodies, attribute == "body_masses", env)
    name = {"joint_friction": "dof_frictionloss", "joint_armatures": "dof_armature"}[attribute]
    del model
    return _column_field(engine.expand(name), dofs, env)


def _body_field(view: RigidPrimView, attribute: str, env: OigeEnv) -> _Field:
    if attribute == "material_properties":
        return _friction_field(view._bodies, env)
    return _mass_field(torch.tensor(view._bodies, device=env.device), attribute in ("mass", "density"), env)


def _column_field(field: Tensor, columns: Tensor, env: OigeEnv) -> _Field:
    return _Field(lambda ids: field[ids[:, None], columns], lambda ids, values: _put(field, ids, columns, values), env)


def _mass_field(bodies: Tensor, mass: bool, env: OigeEnv) -> _Field:
    masses, inertias = env.engine.expand("body_mass"), env.engine.expand("body_inertia")
    if not mass:
        return _column_field(inertias, bodies, env)

    def write(ids: Tensor, values: Tensor) -> None:
        before = masses[ids[:, None], bodies]
        inertias[ids[:, None], bodies] *= torch.where(before > 0, values / before, torch.ones_like(before))[..., None]
        masses[ids[:, None], bodies] = values

    return _Field(lambda ids: masses[ids[:, None], bodies], write, env)


def _friction_field(bodies: list[int], env: OigeEnv) -> _Field:
    """Static friction, dynamic friction and restitution of each geom; only the second is MuJoCo's."""
    model = env.engine.model
    geoms = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in bodies]
    columns, friction = torch.tensor(geoms, device=env.device), env.engine.expand("geom_friction")

    def read(ids: Tensor) -> Tensor:
        sliding = friction[ids[:, None], columns, 0]
        return torch.stack([sliding, sliding, torch.zeros_like(sliding)], dim=-1)

    def write(ids: Tensor, values: Tensor) -> None:
        friction[ids[:, None], columns, 0] = values[..., 1].clamp(min=0.0)

    return _Field(read, write, env)


def _put(field: Tensor, ids: Tensor, columns: Tensor | None, values: Tensor) -> None:
    if columns is None:
        field[ids] = values.to(field.dtype)
    else:
        field[ids[:, None], columns] = values.to(field.dtype)
