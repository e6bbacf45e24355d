"""Environment loop of manager-based and direct tasks.

Autoreset is same-step: the observation returned with a finished episode is the first one of the next episode, and
`final_obs` has the last observation. `terminated` and `truncated` are always separate tensors.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.envs.build import build_simulation, grid, open_scene
from rlcli.envs.counters import EpisodeCounters
from rlcli.envs.divergence import DivergenceGuard
from rlcli.envs.observers import Observers
from rlcli.envs.saved_state import load_state, save_state
from rlcli.envs.shard_range import Shard
from rlcli.envs.step_result import Episodes, StepRecord, StepResult
from rlcli.envs.workflow import Workflow
from rlcli.machine.devices import require_device
from rlcli.managers.term_binding import Binder
from rlcli.registry.plugin_imports import current_folder_kept
from rlcli.sim.engine import Engine
from rlcli.sim.env_selection import Field, Selection
from rlcli.sim.saved_tensors import means


class VecEnv(Workflow):
    """`num_envs` copies of a task, stepped together.

    The constructor compiles the model and resolves every name of the configuration.

    Args:
        resolved: a validated configuration.
        seed: seed of all random numbers of the environment.
        device: device of the engine and of all tensors.
        shared_streams: environments i and i % shared_streams draw the same random numbers; 0: every environment has its
            own stream.
        shard: the part of the task's environments that this object has; None: all of them.

    Raises:
        ConfigError: with everything that does not fit the compiled model.
        DeviceError: for a device that does not exist.
    """

    engine: Engine

    def __init__(
        self,
        resolved: Resolved,
        *,
        seed: int = 42,
        device: str = "cpu",
        shared_streams: int = 0,
        shard: Shard | None = None,
    ) -> None:
        require_device(device)
        self.resolved, self.config, self.seed = resolved, resolved.task, seed
        self.device = torch.device(device)
        self.step_dt, self.physics_dt = self.config.step_dt, self.config.sim.dt
        self.max_episode_length = self.config.max_episode_length
        self.num_envs = self.config.scene.num_envs
        self.shard = shard or Shard(0, self.num_envs, self.num_envs)
        self.final_obs_of = "finished"
        self.seconds = {"physics": 0.0, "step": 0.0}
        self.observers = Observers()
        self.physics_override: Callable[[], None] | None = None
        """Function that replaces the engine's physics step and writes states and derived fields; None: the engine."""
        self._last_obs: dict[str, Tensor] = {}
        self._read_finals: Field = torch.zeros(self.num_envs, dtype=torch.bool)  # where `final_obs` is valid
        self._counters = EpisodeCounters(self.shard, self.device)
        self.episode_length_buf = self._counters.lengths
        """Steps of the running episode. (num_envs,) int64"""
        self.episode_index = self._counters.indices
        """Index of the running episode, from 0; the random numbers depend on it. (num_envs,) int64"""
        self._guard = DivergenceGuard(self)
        self._build(shared_streams)

    def _build(self, shared_streams: int) -> None:
        """Build the simulation, then the terms of the workflow."""
        self._binder = Binder(self, self.resolved)
        scene = open_scene(self.resolved)
        self._prepare_scene(scene)
        distinct = shared_streams or self.shard.total
        streams = self._counters.ids % distinct
        self.stream_ids = streams.numpy(force=True) if shared_streams or self.shard.first else None
        """Index of each environment's random stream; None: the index of its row. (num_envs,)"""
        built = build_simulation(scene, self._binder, self.device, self.seed, streams)
        built.engine.shared_streams = shared_streams
        if built.engine.replayable is not None:
            built.engine.replayable.stream_ids = self.stream_ids
        self.spec, self.views = scene.spec, scene.views
        self.engine, self.sim, self.entities = built.engine, built.data, built.entities
        self.actuators = built.actuators
        """`entity.name` -> actuator model, in the order of the configuration."""
        self.sensors = built.sensors
        """Sensors of `scene.sensors`, by name."""
        self.default_state = built.default_state
        """Joint state at the start of episodes, before reset events. qpos (nq,), qvel (nv,)"""
        self.terrain = built.terrain
        self.origins = built.origins
        """Start position of each environment in its world: zeros without a terrain. (num_envs, 3) [m]"""
        self.env_origins = grid(distinct, self.config.scene.env_spacing).to(self.device)[streams]
        """Position of each environment on a grid. (num_envs, 3) [m]

        In task formats of other frameworks all environments are in one world, side by side; these formats need the
        positions."""
        self._counters.attach(self.engine)
        self._bind_terms()
        success = self._binder.bind_all("success")
        self._binder.raise_problems()
        self._build_workflow()
        self.layout = self._make_layout()
        self._action_shape = (self.num_envs, self.layout.action_size)
        self._action_columns = self.layout.action_columns()
        self._counters.set_success(success, self.step_dt)

    @current_folder_kept()  # a hook of the task may change it
    def reset(self, seed: int | None = None, *, episode: int = 0) -> dict[str, Tensor]:
        """Start a new episode everywhere, and return observations by group; see `Environment.reset`."""
        if seed is not None:
            self.seed = seed
            self.episode_index.fill_(episode)
            self._counters.common_step.zero_()
            if self.terrain is not None:
                self.terrain.start(seed)
        else:
            self.episode_index += 1
        self.engine.use_torch_stream()
        self._before_full_reset()
        self._reset_envs(self._select_all())
        return self._observe()

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # a diverging simulation: the guard reports it
    @current_folder_kept()
    def step(self, action: Tensor, restart: Tensor | None = None) -> StepResult:
        """Apply one action for `decimation` physics steps; for arguments and errors see `Environment.step`.

        1. Observers run `before_step`; the action is checked.
        2. The action becomes controls; physics runs; diverged environments return to their last finite state.
        3. Observers run `after_physics`; counters and sensors advance.
        4. Terminations, rewards and the conditions of success are computed.
        5. Final observations and `Episodes` of the episodes that end are computed.
        6. Observers run `on_step`.
        7. Environments whose episode ended, and the environments in `restart`, are reset.
        8. Commands and interval events run. Environments that they or a reset put out of bounds return to a good state;
           their episode ends with the next step.
        9. Observations are computed.
        """
        if not self._playing:
            raise RuntimeError("the environment is paused; call pause(False) before step()")
        for before_step in self.observers.before_step:
            before_step()
        start = time.perf_counter()
        action = self.check_action(action, self._action_shape, restart)
        self._apply_action(action)
        diverged = self._simulate()
        for after_physics in self.observers.after_physics:
            after_physics()
        self._counters.advance()
        for sensor in self.sensors.values():
            sensor.update(self.step_dt)
        reward, terminated, truncated = self._compute_rewards_and_dones(diverged)
        self._counters.count_success(reward)
        if restart is not None:
            reward, terminated = reward.masked_fill(restart, 0.0), terminated & ~restart
            truncated = truncated & ~restart
        ended, final_obs, episodes = self._end_episodes(terminated, truncated)
        if self.observers.on_step:
            self.observers.run_on_step(StepRecord(self._last_obs, action, reward, self._reward_terms(), episodes))
        self._reset_ended(ended, restart)
        obs = self._observe()
        self.seconds["step"] += time.perf_counter() - start
        return StepResult(obs, reward, terminated, truncated, final_obs, episodes)

    def check_action(self, action: Tensor, shape: tuple[int, int], restart: Tensor | None) -> Tensor:
        """Check an action, and return it with zeros where an environment restarts.

        Raises:
            ValueError: for another shape.
            DivergedError: for a value that is not finite.
        """
        if action.shape != shape:
            raise ValueError(f"action has shape {tuple(action.shape)}; pass shape {shape}")
        self.engine.use_torch_stream()
        if restart is not None:
            action = action.masked_fill(restart[:, None], 0.0)
        self._guard.require_finite(action, "the policy's action", self._action_columns)
        return action

    def _simulate(self) -> Tensor | None:
        """Run the physics of a step; return the environments that diverged, (num_envs,) bool, or None."""
        start = time.perf_counter()
        if self.physics_override is not None:
            self.physics_override()
        elif not self.actuators:
            self.engine.step(self.config.decimation)
        else:
            for left in reversed(range(self.config.decimation)):
                self.compute_efforts()
                self.engine.step(1, derive=left == 0)
        self.seconds["physics"] += time.perf_counter() - start
        return self._guard.after_physics()

    def _end_episodes(
        self, terminated: Tensor, truncated: Tensor
    ) -> tuple[Selection | None, dict[str, Tensor] | None, Episodes | None]:
        """End the episodes that are terminated or truncated; return (None, None, None) if no episode ends.

        Returns:
            Selection of the environments whose episode ends; last observations by group, (num_envs, d) each, or None
            if no trainer or observer needs them; the ended episodes.
        """
        finished, timed_out = self._counters.end(terminated, truncated)
        ended = self._select(finished)
        if ended is None:
            return None, None, None
        self._read_finals = finished if self.final_obs_of == "finished" else timed_out
        # on a GPU, the last operand would force a host sync
        wanted = self.final_obs_of == "finished" or self.engine.asynchronous or len(timed_out.nonzero()[0]) > 0
        final_obs = self._compute_final_obs() if wanted else None
        returns, terms, causes = self._episode_returns_and_causes(ended)
        truncated_rows = ended.read_view(timed_out)
        episodes = Episodes(
            ended.read_view(self._counters.id_field),
            returns,
            ended.read(self._counters.length_field),
            terms,
            causes,
            truncated_rows,
            metrics=self._episode_metrics(ended),
            mask=finished if isinstance(finished, Tensor) else None,
            **self._counters.succeeded(ended, truncated_rows),
        )
        return ended, final_obs, episodes

    def _reset_ended(self, ended: Selection | None, restart: Tensor | None) -> None:
        if ended is not None:
            self._before_reset(ended)
            self._reset_envs(ended, self.config.keep_state_at_reset)
        again = None if restart is None else self._select(restart)
        if again is not None:
            self._reset_envs(again)  # the episode index is unchanged, so the draws repeat

    def _reset_envs(self, selection: Selection, keep_state: bool = False) -> None:
        """Start the next episode of the selected environments, in the default or (`keep_state`) the present state."""
        fields = [self.engine.field(name) for name in ("qpos", "qvel")] if keep_state else []
        kept = [selection.read(field) for field in fields]
        self.engine.reset(selection)
        if self.terrain is not None:
            self.terrain.place_entities(self.entities.values(), selection)
        for field, values in zip(fields, kept, strict=True):
            selection.write(field, values)
        self.sim.refresh_rows(selection)  # reset events then read this state
        for actuator in self.actuators.values():
            actuator.reset(selection)
        self._reset_workflow(selection)
        self._counters.reset(selection)
        self.sim.on_moved(selection)
        for sensor in self.sensors.values():
            sensor.reset(selection)

    def on_moved(self, selection: Selection) -> None:
        """Mark derived values and sensors of the selected environments as outdated, after a write to their state."""
        self.sim.on_moved(selection)
        for sensor in self.sensors.values():
            sensor.on_moved(selection)

    def _observe(self) -> dict[str, Tensor]:
        """Update commands, run interval events, and return the observations of the resulting state."""
        self._update_commands_and_events()
        self.sim.forward_moved()
        self._guard.quarantine_out_of_bounds()
        self._last_obs = self._compute_observations()
        return self._last_obs

    def _select(self, mask: Field) -> Selection | None:
        return self.engine.select(mask, self.seed, self._counters.index_field)

    def _select_all(self) -> Selection:
        selection = self._select(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
        assert selection is not None
        return selection

    @property
    def local(self) -> VecEnv:
        """The environments that this process steps, with their terms and managers: this object."""
        return self

    def success_conditions(self, env_id: int) -> list[str]:
        """Return each condition of success in one environment, as in `speed 0.21, at most 0.3: has held for 0.4 s`."""
        return [condition.describe(env_id, self.step_dt) for condition in self._counters.conditions]

    def condition_shares(self) -> dict[str, float]:
        """Return the share of environments in which each condition of success held in the newest step."""
        return {each.name: float((each.steps > 0.0).float().mean()) for each in self._counters.conditions}

    def success_reward_gap(self) -> tuple[float, float] | None:
        """Return how much the newest rewards depend on success: (difference of means, its standard error).

        The difference is the mean reward of environments where all conditions of success hold, minus the mean reward of
        the other environments. None if too few environments are in either group.
        """
        return self._counters.reward_gap()

    def compute_success(self) -> Tensor | None:
        """Return where all conditions of success hold in the current state; None without conditions. (num_envs,)"""
        held = [condition.holds_for_tensors() for condition in self._counters.conditions]
        return functools.reduce(torch.logical_and, held) if held else None

    def check(self) -> None:
        """Raise the pending `DivergedError` of the steps since the last call; on a CPU, `step` has raised the error."""
        self._guard.check()

    @property
    def common_step(self) -> int:
        """Number of steps since the start or the last reset with a seed, the same in all environments."""
        return int(self._counters.common_step)

    @property
    def causes(self) -> dict[str, int]:
        """Number of diverged simulations since the start, by cause: see `Divergence.cause`."""
        return dict(self._guard.causes)

    def compute_efforts(self) -> None:
        """Write the controls of the actuator models for the next physics step."""
        for actuator in self.actuators.values():
            actuator.compute()

    def extras(self) -> dict[str, float]:
        """Return the values to log, by the names of the metrics; see `Environment.extras`."""
        return {**means(self.metric_values()), **self.divergence_metrics()}

    def divergence_metrics(self) -> dict[str, float]:
        """Return the metrics `Sim/diverged/CAUSE`: numbers of environments that diverged since the last call."""
        return self._guard.metrics()

    def close(self) -> None:
        """Close the engine and the sensors that render."""
        for sensor in self.sensors.values():
            sensor.close()
        self.engine.close()

    def world(self, env: int = 0) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return the model and the state of one environment as an MjModel and an MjData."""
        return self.engine.world(env)

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of everything that the next steps depend on; call it between two steps."""
        return save_state(self)

    def load_state_dict(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Restore the state returned by `state_dict()`; see `Environment.load_state_dict`."""
        load_state(self, state)
        self._last_obs = self._restore_observations()
        return self._last_obs
