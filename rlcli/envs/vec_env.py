"""The one environment loop: act, simulate, judge, restart what ended, observe.

Autoreset is same-step: the observation returned with a finished episode is already the next episode's first, and the
finished one's true last observation is in `final_obs`. `terminated` and `truncated` are two tensors everywhere.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import torch
from torch import Tensor

from rlcli.config.load import Resolved, resolve
from rlcli.config.python import source_of
from rlcli.config.schema import InitialStateConfig, TaskConfig
from rlcli.envs.layout import Layout
from rlcli.envs.markers import Marker
from rlcli.envs.step import Episodes, Lived, StepResult
from rlcli.errors import DivergedError
from rlcli.machine import collect_as_usual, require_device
from rlcli.managers.term import Binder, check_shape, first_value
from rlcli.sim.actuators import ActuatorModel
from rlcli.sim.engine import open_engine
from rlcli.sim.entity import Entity
from rlcli.sim.guard import LIMIT, SHOWN, Divergence, StateLayout
from rlcli.sim.names import NameProblem
from rlcli.sim.rotations import rotate_inverse
from rlcli.sim.saved import require_alike
from rlcli.sim.scene import Scene
from rlcli.sim.selection import Field, Selection, in_place
from rlcli.sim.sensors import Sensor, make_sensors
from rlcli.sim.state import SimData, is_finite
from rlcli.sim.terrain import Terrain


class VecEnv(ABC):
    """`num_envs` copies of a task, stepped together.

    Building one compiles the model and resolves every name of the configuration (phase 2 of validation).

    Args:
        resolved: a validated configuration.
        seed: of every random draw of the environment.
        device: where the engine and all tensors live.
        lives: environment i lives the life of i % lives, under equal actions: what differs between the two is what
            somebody makes differ; 0: each lives its own.

    Raises:
        ConfigError: with everything that does not fit the compiled model.
        DeviceError: for a device that is not there.
    """

    def __init__(self, resolved: Resolved, *, seed: int = 42, device: str = "cpu", lives: int = 0) -> None:
        require_device(device)
        self._lives = lives
        self.config = resolved.task
        self.resolved = resolved
        self.seed = seed
        self.device = torch.device(device)
        self.step_dt = self.config.step_dt
        self.physics_dt = self.config.sim.dt
        self.max_episode_length = self.config.max_episode_length
        self.num_envs = self.config.scene.num_envs
        self.final_obs_of = "finished"
        self.seconds = {"physics": 0.0, "step": 0.0}
        self.before_step: Callable[[], None] | None = None
        """Called before anything is done in a step, which it may prevent by raising."""
        self.after_physics: Callable[[], None] | None = None
        """Called in every step with the state that it is judged by, before anything ends or begins."""
        self.instead_of_physics: Callable[[], None] | None = None
        """Called to step the simulations in the engine's place; it leaves their states and derived fields there."""
        self.on_divergence: list[Callable[[list[Divergence], bool], None]] = []
        """Called where simulations have diverged, as `engine.trace` still shows them, with the first of them and
        whether their next call of the engine is the one that goes wrong: then an event or a reset wrote the state."""
        self.on_lived: Callable[[Lived], None] | None = None
        """Called in every step once it is judged, as the engine still shows it: before anything begins anew."""
        self._seen: dict[str, Tensor] = {}
        self._written_causes: dict[str, int] = {}
        self._told_causes: dict[str, int] = {}
        self._playing = True
        self._counters()
        self._open(resolved)
        self._bind()
        success = self._binder.success()
        self._success = None if success is None else success.call
        self._binder.raise_problems()
        self._build()
        self._hold_steps = math.ceil(self.config.success.hold_s / self.step_dt - 1e-6) if self.config.success else 0
        self.layout = self._layout()
        self._action_shape = (self.num_envs, self.layout.action_size)
        self._action_columns = [
            f"{term.name}[{index}]" if index >= len(term.elements) else f"{term.name}.{term.elements[index]}"
            for term in self.layout.actions
            for index in range(term.size)
        ]
        if success is not None:
            check_shape(success, first_value(success), (self.num_envs,))

    # --- what callers use ---

    def reset(self, seed: int | None = None, *, episode: int = 0) -> dict[str, Tensor]:
        """Start a new episode everywhere. With a seed, the random streams start over as in a new environment.

        Args:
            seed: of every draw from now on; None: draws go on.
            episode: with a seed, the number of the episode that begins; what `carried` names is not as it would be
                after those before it.

        Returns:
            Group -> observations. (num_envs, d) float32
        """
        if seed is not None:
            self.seed = seed
            self.episode_index.fill_(episode)
            self._steps.zero_()
            if self.terrain is not None:
                self.terrain.start(seed)
        else:
            self.episode_index += 1
        self.engine.attach()
        self._start_over()
        self._restart(self._everyone())
        self._between()
        self.sim.settle()
        self._set_aside()
        self._seen = self._observe()
        return self._seen

    def step(self, action: Tensor, begin: Tensor | None = None) -> StepResult:
        """Apply one action for `decimation` physics steps. action (num_envs, a) float32

        Args:
            action: of every environment.
            begin: environments that sit this step out: in its end they are where their running episode began, with
                reward 0. (num_envs,) bool

        Raises:
            DivergedError: for an action, observation or reward that is not finite; divergence of the simulation is not
                an error, it ends the episode of that environment.
        """
        if not self._playing:
            raise RuntimeError("the environment is paused")
        if self.before_step is not None:
            self.before_step()
        start = time.perf_counter()
        if action.shape != self._action_shape:
            raise ValueError(f"action has shape {tuple(action.shape)}, expected {self._action_shape}")
        self.engine.attach()
        if begin is not None:
            action = action.masked_fill(begin[:, None], 0.0)
        self._require_finite(action, "the policy's action", self._action_columns)

        self._act(action)
        diverged = self._simulate()
        if self.after_physics is not None:
            self.after_physics()
        self._lengths += 1
        self._clock += 1
        for sensor in self.sensors.values():
            sensor.update(self.step_dt)
        reward, terminated, truncated = self._judge(diverged)
        self._hold_success()

        if begin is not None:
            reward, terminated, truncated = reward.masked_fill(begin, 0.0), terminated & ~begin, truncated & ~begin
        final_obs, episodes = None, None
        failed, late = self.engine.as_field(terminated), self.engine.as_field(truncated)
        finished = failed | late
        self._indices += finished  # before the selection: what begins now draws from its own counter
        ended = self._select(finished)
        if ended is not None:
            timed_out = late > failed  # and not terminated
            if self.final_obs_of == "finished" or self._maybe(timed_out):
                final_obs = self._final()
            episodes = self._episodes(ended, finished, timed_out)
        if self.on_lived is not None:
            self.on_lived(Lived(self._seen, action, reward, self._paid(), episodes))
        if ended is not None:
            self._conclude(ended)
            self._restart(ended)
        again = None if begin is None else self._select(begin)
        if again is not None:
            self._restart(again)  # its draws are those of the same episode: it begins alike
        self._between()
        self.sim.settle()
        self._set_aside()
        obs = self._seen = self._observe()
        self.seconds["step"] += time.perf_counter() - start
        return StepResult(obs, reward, terminated, truncated, final_obs, episodes)

    def succeeding(self) -> Tensor | None:
        """Where the success condition holds as things are; None for a task without one. (num_envs,) bool"""
        return None if self._success is None else self._success()

    def holders(self) -> list[Any]:
        """Objects that carry something of their own from step to step: terms with memory, a direct task."""
        return []

    def check(self) -> None:
        """Raise what a device has found in the steps since the last call; a CPU raises at once.

        Raises:
            DivergedError: as `step`, or because the device ran out of room for contacts.
        """
        noted = self.engine.noted()
        if self.engine.asynchronous and self.on_divergence and self.engine.found:
            self._tell_divergence(self.engine.found, False)
        for what in noted:
            raise DivergedError(f"{what} is not finite, within the last steps before step {self.common_step}")

    @property
    def common_step(self) -> int:
        """Steps since the start, the same in all environments."""
        return int(self._steps)

    @property
    def divergences(self) -> int:
        """Environments whose simulation diverged, ever."""
        return sum(self.causes.values())

    @property
    def causes(self) -> dict[str, int]:
        """The same by cause: MuJoCo's warning (`BADQACC`), `FIELD not finite`, `engine error`."""
        causes = dict(self._written_causes)
        for cause, count in self.engine.causes.items():
            causes[cause] = causes.get(cause, 0) + count
        return causes

    @property
    def calls_per_step(self) -> int:
        """Calls of the engine in an environment step: one, or one a physics step where actuator models act between."""
        return self.config.decimation if self._actuators else 1

    def compute_efforts(self) -> None:
        """Let the actuator models write the controls of the coming physics step."""
        for actuator in self._actuators.values():
            actuator.compute()

    def carried(self) -> list[str]:
        """What makes an episode depend on those before it, by its place in the configuration; empty: nothing known."""
        return ["scene.terrain"] if self.terrain is not None else []

    @property
    def reward_names(self) -> list[str]:
        """The terms of the reward, in the order of `Lived.reward_terms`; none where the task pays one sum."""
        return []

    def is_playing(self) -> bool:
        """False while paused; no step runs then."""
        return self._playing

    def pause(self, paused: bool = True) -> None:
        """Pause or go on."""
        self._playing = not paused

    def extras(self) -> dict[str, float]:
        """Further numbers to log, by the metric's name: the task's as of the last step, divergences by cause since the
        last call.
        """
        causes = self.causes
        new = {cause: count - self._told_causes.get(cause, 0) for cause, count in causes.items()}
        self._told_causes = causes
        diverged = {f"Sim/diverged/{cause.replace(' ', '_')}": float(count) for cause, count in new.items() if count}
        return {**self._extras(), **diverged}

    def measured(self) -> dict[str, Tensor]:
        """The task's own numbers to log, of the state that a step was judged by: what `on_lived` may ask for.

        Means over episodes of what commands measure are in `Episodes.metrics`. (num_envs,) each
        """
        return {}

    def unsaved(self) -> list[str]:
        """What the task keeps from step to step that `state_dict` cannot hold; empty: it goes on exactly."""
        return []

    def close(self) -> None:
        """Let go of the engine and of what draws."""
        for sensor in self.sensors.values():
            sensor.close()
        self.engine.close()

    def world(self, env: int = 0) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """One environment as MuJoCo's own structures."""
        return self.engine.world(env)

    def markers(self) -> list[Marker]:
        """What is drawn beside the bodies, as things are; a viewer asks, no step does."""
        return []

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of everything that the next steps depend on, at a step boundary."""
        own = {
            "episode_length": self.episode_length_buf.clone(),
            "episode_index": self.episode_index.clone(),
            "common_step": self._steps.clone(),
            "seed": torch.tensor(self.seed),
            "success_hold": self._success_hold.clone(),
            "set_aside": self._aside.clone(),
        }
        engine = {f"engine.{name}": value for name, value in self.engine.state_dict().items()}
        models = {
            f"actuator.{name}.{key}": value
            for name, model in self._actuators.items()
            for key, value in model.state_dict().items()
        }
        sensors = {
            f"sensors.{name}.{key}": value
            for name, sensor in self.sensors.items()
            for key, value in sensor.state_dict().items()
        }
        terrain = {} if self.terrain is None else self.terrain.state_dict()
        return {
            **own,
            **engine,
            **models,
            **{f"terrain.{name}": value for name, value in terrain.items()},
            **sensors,
            **{f"workflow.{name}": value for name, value in self._workflow_state().items()},
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Take back what `state_dict` gave; returns the observations of that moment.

        Raises:
            KeyError: if something is missing.
            ValueError: if something is of another shape or type: what was saved of other environments.
        """
        require_alike(state, {k: v for k, v in self.state_dict().items() if not k.startswith("workflow.")}, "env")
        self.episode_length_buf.copy_(state["episode_length"])
        self.episode_index.copy_(state["episode_index"])
        self._steps.copy_(state["common_step"])
        self.seed = int(state["seed"])
        self._success_hold.copy_(state["success_hold"])
        self._aside.copy_(state["set_aside"]) if "set_aside" in state else self._aside.zero_()
        self._any_aside = bool(self._aside.any())
        self.engine.load_state_dict(_below(state, "engine."))
        for name, model in self._actuators.items():
            model.load_state_dict(_below(state, f"actuator.{name}."))
        self.sim.refresh()
        self.sim.keep()
        if self.terrain is not None:
            self.terrain.load_state_dict(_below(state, "terrain."))
        for name, sensor in self.sensors.items():
            sensor.load_state_dict(_below(state, f"sensors.{name}."))
        self._load_workflow_state(_below(state, "workflow."))
        self._seen = self._observe_again()
        return self._seen

    # --- the workflow's part ---

    @abstractmethod
    def _prepare(self, scene: Scene) -> None:
        """Complete the scene before it is compiled."""

    def _bind(self) -> None:
        """Resolve the names of the configuration, once entities exist."""

    @abstractmethod
    def _build(self) -> None:
        """Make managers, or start the task."""

    @abstractmethod
    def _layout(self) -> Layout:
        """Observation and action columns."""

    @abstractmethod
    def _act(self, action: Tensor) -> None:
        """Turn the policy's action into controls."""

    @abstractmethod
    def _judge(self, diverged: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Reward, terminated, truncated. (num_envs,) each"""

    @abstractmethod
    def _final(self) -> dict[str, Tensor]:
        """True last observations, before anything is reset."""

    @abstractmethod
    def _terms_of(self, ended: Selection) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """Returns, reward terms and causes of the episodes that end. (n,) each"""

    @abstractmethod
    def _restart_workflow(self, selection: Selection) -> None:
        """Write the start states of new episodes and forget the old ones."""

    @abstractmethod
    def _observe(self) -> dict[str, Tensor]:
        """Observations of the state as it is."""

    def _observe_again(self) -> dict[str, Tensor]:
        """The observations that were made of the state that has just been taken back."""
        return self._observe()

    def _metrics_of(self, ended: Selection) -> dict[str, Tensor]:
        """Means over the episodes that end. (n,) each"""
        return {}

    def _extras(self) -> dict[str, float]:
        """The task's own numbers to log."""
        return {}

    def _paid(self) -> Tensor:
        """What each term of the reward paid in the step. (terms, num_envs)"""
        return torch.zeros(0, self.num_envs, device=self.device)

    def _conclude(self, ended: Selection) -> None:
        """Called with the environments whose episode ends, before anything of it is forgotten."""

    def _explain(self, what: str) -> None:
        """Called with what is not finite: raise a DivergedError that names the term, if it can be named."""

    def _start_over(self) -> None:
        """Called before a reset of all environments."""

    def _between(self) -> None:
        """After resets, before observations: commands and interval events."""

    @abstractmethod
    def _workflow_state(self) -> dict[str, Tensor]:
        """What the workflow carries from step to step."""

    @abstractmethod
    def _load_workflow_state(self, state: Mapping[str, Tensor]) -> None:
        """Take back what `_workflow_state` gave."""

    # --- shared parts of the loop ---

    def _simulate(self) -> Tensor | None:
        start = time.perf_counter()
        if self.instead_of_physics is not None:
            self.instead_of_physics()
        elif not self._actuators:
            self.engine.step(self.config.decimation)
        else:
            for left in reversed(range(self.config.decimation)):
                self.compute_efforts()
                self.engine.step(1, derive=left == 0)
        self.seconds["physics"] += time.perf_counter() - start
        if self.engine.asynchronous:
            diverged = self.engine.diverged()
            self.sim.refresh()
            return diverged
        self.sim.refresh()
        diverged = self.engine.diverged(self.sim.is_finite())
        if diverged is not None:
            self._tell_divergence(self.engine.found, False)
        if self._any_aside:
            diverged = self._aside.clone() if diverged is None else diverged | self._aside
            self._aside.zero_()
            self._any_aside = False
        if diverged is not None:
            self._put_back(diverged)
            self.sim.refresh()
        self.sim.keep()
        return diverged

    def _tell_divergence(self, found: list[Divergence], pending: bool) -> None:
        for told in list(self.on_divergence):  # a copy: who has heard enough leaves
            told(found, pending)

    def _put_back(self, diverged: Tensor) -> None:
        """Return diverged worlds to their last finite state: they are judged by that, not by MuJoCo's own reset."""
        selection = self._select(diverged)
        if selection is None:
            return
        self.engine.reset(selection)
        self.sim.restore_rows(selection)
        try:
            self.engine.forward(selection)
        except DivergedError:  # the engine cannot compute where they are, either
            self.engine.reset(selection)
            self.engine.forward(selection)

    def _set_aside(self) -> None:
        """Take worlds back that an event or a reset has put where physics cannot go on; they end with the next step.

        Until then they are where they were before the event, or in the default state where their episode has just
        begun. A GPU, which must not be asked, finds them in the next step.
        """
        if self.engine.asynchronous:
            return
        bad = self.sim.out_of_bounds(LIMIT)
        if bad is not None:
            self._take_back(bad)
        self.sim.keep()

    def _take_back(self, bad: Tensor) -> None:
        found = [self._written_badly(env) for env in bad.nonzero().flatten().tolist()]
        for divergence in found:
            self._written_causes[divergence.cause] = self._written_causes.get(divergence.cause, 0) + 1
        self._tell_divergence(found[:SHOWN], True)
        begun = bad & (self.episode_length_buf == 0)
        for rows, restore in ((bad & ~begun, True), (begun, False)):
            selection = self._select(rows)
            if selection is None:
                continue
            self.engine.reset(selection)
            if restore:
                self.sim.restore_rows(selection)
            self.engine.forward(selection)
            self.sim.refresh_rows(selection)
            for sensor in self.sensors.values():
                sensor.moved(selection)
        self._aside |= bad
        self._any_aside = True

    def _written_badly(self, env: int) -> Divergence:
        columns, field = self.sim.qpos[env], "qpos"
        if bool((columns.abs() <= LIMIT).all()):
            columns, field = self.sim.qvel[env], "qvel"
        index = int((~(columns.abs() <= LIMIT)).nonzero()[0, 0])
        place = StateLayout(self.engine.model, {}).place(field, index)
        who = "a reset" if int(self.episode_length_buf[env]) == 0 else "an event"
        what = "out of bounds" if bool(columns.isfinite().all()) else "not finite"
        return Divergence(env, f"{field} {what}", f"{place} = {float(columns[index]):g}, written by {who}")

    def _hold_success(self) -> None:
        if self._success is not None:
            self._holds += 1.0
            self._holds *= self.engine.as_field(self._success())

    def _episodes(self, ended: Selection, finished: Field, late: Field) -> Episodes:
        returns, terms, causes = self._terms_of(ended)
        timed_out = ended.peek(late)
        success = None
        if self._success is not None:
            success = timed_out & (ended.peek(self._holds) >= self._hold_steps)
        return Episodes(
            ended.peek(self._numbers),
            returns,
            ended.read(self._lengths),
            terms,
            causes,
            timed_out,
            success,
            self._metrics_of(ended),
            finished if isinstance(finished, Tensor) else None,
        )

    def _restart(self, selection: Selection) -> None:
        self.engine.reset(selection)
        self._place(selection)
        self.sim.refresh_rows(selection)  # a reset event or reset_idx reads the default state, not the last episode's
        for actuator in self._actuators.values():
            actuator.reset(selection)
        self._restart_workflow(selection)
        selection.write(self._lengths, 0)
        if self._success is not None:
            selection.write(self._holds, 0.0)
        self.sim.moved(selection)
        for sensor in self.sensors.values():
            sensor.reset(selection)

    def _place(self, selection: Selection) -> None:
        """Move what can move from its default place to the environment's own."""
        if self.terrain is None:
            return
        for entity in self.entities.values():
            if entity.is_floating or entity.mocap >= 0:
                default = selection.peek(entity.data.default_root_state)
                place = default[:, :3] + selection.peek(self.origins)
                entity.write_root_pose(selection, place, default[:, 3:7])

    def _select(self, mask: Field) -> Selection | None:
        return self.engine.select(mask, self.seed, self._indices)

    def _everyone(self) -> Selection:
        everyone = self._select(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
        assert everyone is not None
        return everyone

    def _maybe(self, mask: Field) -> bool:
        """Whether a mask holds anywhere, as far as that is known without waiting for a device."""
        return self.engine.asynchronous or len(mask.nonzero()[0]) > 0

    def _require_finite(self, values: Tensor, what: str, columns: Sequence[str] = ()) -> None:
        """Stop with the environments, and the first of `columns` that is not finite."""
        if self.engine.asynchronous:
            self.engine.watch(values, what)
            return
        if is_finite(values):
            return
        self._explain(what)
        bad = ~values.isfinite()
        rows = bad.any(dim=1) if bad.dim() > 1 else bad
        first = int(rows.nonzero()[0, 0])
        column = int(bad[first].nonzero()[0, 0]) if bad.dim() > 1 else 0
        name = f" in column {columns[column]}" if column < len(columns) else ""
        raise DivergedError(
            f"{what} is not finite in {int(rows.sum())} of {self.num_envs} environments, first in environment"
            f" {first}{name} (step {self.common_step})"
        )

    # --- construction ---

    def _open(self, resolved: Resolved) -> None:
        config = self.config
        scene = Scene(
            config.scene, config.sim, resolved.source.root, installed=resolved.source.distribution is not None
        )
        self._binder = Binder(self, resolved)
        self._prepare(scene)
        self._binder.problems += [resolved.problem(p.path, str(p), p.hint) for p in scene.problems]
        if any(problem.path[-1] == "model" for problem in scene.problems):
            self._binder.raise_problems()  # there is no model to look other names up in
        scene.spec.visual.global_.offwidth = config.viewer.width
        scene.spec.visual.global_.offheight = config.viewer.height
        self.spec = scene.spec
        model = scene.compile()
        self.engine = open_engine(model, self.num_envs, config.sim, device=str(self.device))
        self.engine.lives = self._lives
        counters = (self.episode_length_buf, self.episode_index, self._ids, self._success_hold)
        self._lengths, self._indices, self._numbers, self._holds = map(self.engine.as_field, counters)
        self.sim: SimData = SimData(self.engine)
        self.entities: dict[str, Entity] = {}
        for name, entity in scene.config.entities.items():  # a direct task may have added some
            try:
                self.entities[name] = Entity(name, entity, self.engine, self.sim)
            except NameProblem as problem:
                path = ("scene", "entities", name, "init")
                self._binder.problems.append(resolved.problem(path, str(problem), problem.hint))
                blank = entity.model_copy(update={"init": InitialStateConfig()})  # to go on to the other problems
                self.entities[name] = Entity(name, blank, self.engine, self.sim)
        self._actuators: dict[str, ActuatorModel] = {}
        """`entity.name` -> actuator model, in the order of the configuration."""
        for built in self.entities.values():
            self._add_actuators(built)
        self.sensors: dict[str, Sensor] = make_sensors(scene.sensors, self.sim, self.entities)
        """Those of `scene.sensors`, by name."""
        self._set_default(model)
        self.views = scene.views
        self.origins = torch.zeros(self.num_envs, 3, device=self.device)
        """Where each environment's start place lies in its world: zeros without a terrain. (num_envs, 3) [m]"""
        terrain = config.scene.terrain
        self.terrain: Terrain | None = None
        if terrain is not None and scene.ground is not None:
            self.terrain = Terrain(scene.ground, terrain, self.origins, self.seed, self._lives)
        own = self._lives or self.num_envs
        self.env_origins: Tensor = grid(own, config.scene.env_spacing).to(self.device)[self._ids % own]

    def _add_actuators(self, entity: Entity) -> None:
        for name, config in entity.config.actuators.items():
            try:
                model = ActuatorModel(name, config, entity)
            except NameProblem as problem:
                path = ("scene", "entities", entity.name, "actuators", name)
                self._binder.problems.append(self.resolved.problem(path, str(problem), problem.hint))
                continue
            entity.actuators.append(model)
            self._actuators[f"{entity.name}.{name}"] = model

    def _set_default(self, model: mujoco.MjModel) -> None:
        qpos, qvel = torch.tensor(model.qpos0), torch.zeros(model.nv, dtype=torch.float64)
        for entity in self.entities.values():
            qpos[entity.qpos_columns.cpu()] = entity.data.default_joint_pos[0].double().cpu()
            qvel[entity.dof_columns.cpu()] = entity.data.default_joint_vel[0].double().cpu()
            if entity.is_floating:
                _, dof = entity.floating()
                root = entity.data.default_root_state[:1].double().cpu()
                local = rotate_inverse(root[:, 3:7], root[:, 10:])  # a free joint's is in the body's frame
                qvel[dof : dof + 6] = torch.cat([root[:, 7:10], local], dim=1)[0]
        self.default_state = {"qpos": qpos, "qvel": qvel}
        """What episodes start from, but for what resets draw. (nq,), (nv,)"""
        self.engine.set_default(qpos, qvel)
        self.engine.reset(self._everyone())
        self.sim.refresh()

    def _counters(self) -> None:
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        """Steps of the running episode. (num_envs,)"""
        # the first reset of a new environment begins episode 0, as a reset with a seed does
        self.episode_index = torch.full((self.num_envs,), -1, dtype=torch.int64, device=self.device)
        """Episodes begun before the running one; random streams are keyed by it. (num_envs,)"""
        self._success_hold = torch.zeros(self.num_envs, device=self.device)
        self._aside = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._any_aside = False
        self._ids = torch.arange(self.num_envs, device=self.device)
        self._steps: Tensor = torch.zeros((), dtype=torch.int64, device=self.device)
        self._clock = in_place(self._steps)


def grid(num_envs: int, spacing: float) -> Tensor:
    """Origins of environments on a square grid about the world's origin. (num_envs, 3) [m]"""
    rows = math.ceil(math.sqrt(num_envs))
    index = torch.arange(num_envs)
    xy = torch.stack([index // rows, index % rows], dim=1).float() - (rows - 1) / 2
    return torch.cat([xy * spacing, torch.zeros(num_envs, 1)], dim=1)


def make_env(
    task: Resolved | TaskConfig, *, seed: int = 42, device: str = "cpu", root: Path | None = None, lives: int = 0
) -> VecEnv:
    """The environment of a task, in the task's own workflow.

    `task` is a resolved one, or a `TaskConfig` built in Python, whose models lie in `root` (by default here).
    """
    collect_as_usual()  # what is large has been imported; from here on a command runs
    resolved = task if isinstance(task, Resolved) else resolve(source_of(task, root))
    if resolved.source.task is None:
        from rlcli.envs.managed import ManagedEnv

        return ManagedEnv(resolved, seed=seed, device=device, lives=lives)
    if resolved.task.oige:
        from rlcli.oige.env import OigeEnv

        return OigeEnv(resolved, seed=seed, device=device, lives=lives)
    from rlcli.envs.direct import DirectEnv

    return DirectEnv(resolved, seed=seed, device=device, lives=lives)


def _below(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


__all__ = ["VecEnv", "grid", "make_env"]
