"""Environment (`ShardedEnv`) whose parts are stepped by several processes at the same time."""

from __future__ import annotations

import contextlib
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter, methodcaller
from typing import Any

import torch
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.envs.environment_protocol import Environment
from rlcli.envs.make import make_env
from rlcli.envs.observers import Observers
from rlcli.envs.shard_range import Shard, split
from rlcli.envs.sharding import worker
from rlcli.envs.sharding.arrays import ArraySpec, map_tensors
from rlcli.envs.sharding.engine_view import ShardedEngine, sums
from rlcli.envs.sharding.shard_step import (
    SLOTS,
    Columns,
    Needs,
    ShardRunner,
    Stage,
    array_specs,
    counter_specs,
    read_episodes,
)
from rlcli.envs.sharding.state import join, join_states, split_state
from rlcli.envs.sharding.worker import Job
from rlcli.envs.sharding.worker_count import has_untested_code
from rlcli.envs.sharding.worker_pool import Worker, take_workers
from rlcli.envs.step_result import Episodes, StepRecord, StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, one_line
from rlcli.machine.cores import available_cores
from rlcli.registry.task_imports import imported_files
from rlcli.sim.divergence_report import MAX_DESCRIBED
from rlcli.sim.saved_tensors import mean_of, means


class ShardedEnv(Environment):
    """Environments of a task in shards: this process steps the first shard, and each worker process another one.

    All results are bit-identical to those of one process. `local` has the entities, managers and terms of the first
    shard.

    Args:
        resolved: a validated configuration.
        workers: number of processes that step environments, including this one.
        seed: seed of all random numbers of the environment.
        shared_streams: see `VecEnv`.

    Raises:
        ConfigError: with everything that does not fit the compiled model.
        MachineError: if a worker process ends.
    """

    def __init__(self, resolved: Resolved, *, workers: int, seed: int = 42, shared_streams: int = 0) -> None:
        total = resolved.task.scene.num_envs
        self._shards = split(total, workers)
        parts = _resolved_parts(resolved, self._shards)
        state, has_own_code = torch.get_rng_state(), has_untested_code(resolved)
        root = resolved.source.root.resolve()
        files = [
            (file, how) for file, how in imported_files() if file.is_relative_to(root) or root.is_relative_to(file)
        ]
        jobs = [
            Job(_pickled(part), seed, shared_streams, shard, number, files, has_own_code, state)
            for number, (part, shard) in enumerate(zip(parts, self._shards, strict=True))
        ]
        self._workers = take_workers(workers - 1)
        try:
            self._workers.build(jobs[1:])
            counters = map_tensors(self._workers.arrays, counter_specs(total))["counters"]
            first = replace(self._shards[0], counters=counters[:, self._shards[0].rows])
            self._local = make_env(parts[0], seed=seed, shared_streams=shared_streams, shard=first)
            self._workers.replies()
            self._specs = array_specs(self.local, total, workers)
            self._workers.request(worker.MAP, self._specs)
            self._arrays = map_tensors(self._workers.arrays, self._specs)
            self._workers.replies()
        except BaseException:
            self._workers.close()
            raise
        self._runner = ShardRunner(self.local, 0, self._arrays, self._reach)
        self._command, self._counts, self._seconds = (
            self._arrays[name].numpy() for name in ("command", "counts", "seconds")
        )
        self._columns: list[Columns | None] = [None] * workers
        self._slot = 0
        self._episodes: Episodes | None = None
        self._waiting: dict[Worker, tuple[Stage, Any]] = {}
        """Worker that waits for other shards -> the stage of the step that it has reached, and the data it sent."""
        self._stage: Stage | None = None
        """Stage whose observers are running; None: no observers are running."""
        self._is_broken = False
        self.resolved, self.config, self.seed = resolved, resolved.task, seed
        self.num_envs, self.device = total, self.local.device
        self.step_dt, self.physics_dt = self.local.step_dt, self.local.physics_dt
        self.max_episode_length = self.local.max_episode_length
        self.layout, self.default_state = self.local.layout, self.local.default_state
        self.final_obs_of = "finished"
        self.seconds = {"physics": 0.0, "step": 0.0}
        self.observers = Observers()
        self.episode_length_buf = counters[0]
        self.episode_index = counters[1]
        self.engine = ShardedEngine(self, total)
        self._last_obs: dict[str, Tensor] = {}

    # --- the interface of VecEnv ---

    @property
    def local(self) -> VecEnv:
        """The environment of the first shard."""
        return self._local

    def reset(self, seed: int | None = None, *, episode: int = 0) -> dict[str, Tensor]:
        """Start a new episode everywhere, and return observations by group; see `Environment.reset`."""
        self.seed = self.seed if seed is None else seed
        self._begin()
        with self._in_step():
            self._workers.request(worker.RESET, (seed, episode))
            self._runner.reset(seed, episode)
        return self._obs()

    def step(self, action: Tensor, restart: Tensor | None = None) -> StepResult:
        """Apply one action in every environment; see `Environment.step`."""
        if not self._playing:
            raise RuntimeError("the environment is paused; call pause(False) before step()")
        for before_step in self.observers.before_step:
            before_step()
        start = time.perf_counter()
        arrays = self._arrays
        self.local.check_action(action, (self.num_envs, self.layout.action_size), restart)
        arrays["action"].copy_(action)
        if restart is not None:
            arrays["restart"].copy_(restart)
        self._begin()
        self._command[2:4] = self.final_obs_of == "truncated", restart is not None
        with self._in_step():
            self._workers.request(worker.STEP)
            self._runner.step()
        slot = self._slot
        final_obs = None
        if self._counts[:, 1].any():
            final_obs = {group: arrays[f"final.{group}"] for group in self.layout.observations}
        reward, terminated, truncated = (arrays[name][slot] for name in ("reward", "terminated", "truncated"))
        if not self.observers.on_step:
            self._read_episodes()
        obs = self._obs()
        self.seconds["physics"] = float(self._seconds[:, 0].mean())
        self.seconds["step"] += time.perf_counter() - start
        return StepResult(obs, reward, terminated, truncated, final_obs, self._episodes)

    @property
    def workers(self) -> int:
        """Number of processes that step the environments."""
        return len(self._shards)

    def compute_success(self) -> Tensor | None:
        """Return where all conditions of success hold now; None without conditions. (num_envs,) bool"""
        parts = self.call_all(methodcaller("compute_success"))
        return None if parts[0] is None else torch.cat(parts)

    def check(self) -> None:
        """Do nothing: a CPU raises errors in the step."""

    def extras(self) -> dict[str, float]:
        """Return the values to log, by the names of the metrics; see `Environment.extras`."""
        return {**means(self._metric_values()), **sums(self.call_all(methodcaller("divergence_metrics")))}

    def step_metrics(self) -> dict[str, Tensor]:
        """Return the values that a direct task wrote to `extras` in this step, by name. (num_envs,) each"""
        return _joined_rows(self.call_all(methodcaller("step_metrics")))

    def reset_metrics(self) -> dict[str, Tensor]:
        """Return the values that a task logged about the episodes that ended in this step, by name. (num_envs,) each"""
        return _joined_rows(self.call_all(methodcaller("reset_metrics")))

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of everything that the next steps depend on, the same tensors as in a single process."""
        # of all saved values, only the means that curriculum terms log are computed over all environments
        logged = {name.removeprefix("Curriculum/"): value for name, value in self._metric_values().items()}
        averages = {f"workflow.curriculum.value.{name}": mean_of(value) for name, value in logged.items()}
        states = self.call_all(methodcaller("state_dict"))
        return join_states(
            [state | {name: averages[name] for name in averages.keys() & state.keys()} for state in states]
        )

    def load_state_dict(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Restore a state returned by `state_dict()`, also of an environment with another number of processes."""
        shapes = self.call_all(_state_shapes)
        present = {name: [part[name] for part in shapes] for name in shapes[0]}
        own, *others = split_state(state, present, self._shards)
        self._begin()
        with self._in_step():
            for process, part in zip(self._workers, others, strict=True):
                process.send(worker.LOAD, part)
            self._runner.load(own)
        self.seed = self.local.seed
        return self._obs()

    @property
    def common_step(self) -> int:
        """Number of steps since the start or the last reset with a seed, the same in all environments."""
        return self.local.common_step

    @property
    def causes(self) -> dict[str, int]:
        """Number of diverged simulations since the start, by cause."""
        return sums(self.call_all(attrgetter("causes")))

    @property
    def reward_names(self) -> list[str]:
        """Names of the reward terms."""
        return self.local.reward_names

    def stateful_objects(self) -> list[Any]:
        """Return the objects of the first shard whose attributes a step may change."""
        return self.local.stateful_objects()

    def unsaved_state(self) -> list[str]:
        """Return the names of attributes that `state_dict` cannot save."""
        return self.local.unsaved_state()

    def episode_dependencies(self) -> list[str]:
        """Return the parts of the configuration through which an episode depends on earlier ones."""
        return self.local.episode_dependencies()

    def close(self) -> None:
        """End the worker processes, and close the engine and the sensors."""
        self._workers.close()
        self.local.close()

    # --- calls of functions in the processes of the shards ---

    def share(self, specs: Mapping[str, ArraySpec]) -> dict[str, Tensor]:
        """Make tensors of zeros in shared memory, and return them by name.

        In each process the tensors are in `VecEnv.shard.shared`.
        """
        self._require_usable()
        self._specs = {**self._specs, **specs}
        self._workers.request(worker.SHARE, (self._specs, list(specs)))
        tensors = map_tensors(self._workers.arrays, self._specs)
        self._workers.replies()
        self.local.shard.shared.update({name: tensors[name] for name in specs})
        return self.local.shard.shared

    def call_all(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Return the results of `function(vec_env, *arguments)`, called in every shard, in order.

        `function` must be defined in a module, or be an `operator.attrgetter` or `methodcaller`.
        """
        self._require_usable()
        self._workers.request(worker.CALL, (function, arguments))
        with self._unread_replies():
            try:
                own = function(self.local, *arguments)
            except KeyboardInterrupt:
                raise
            except BaseException:  # otherwise the next call would read this reply
                self._workers.replies()
                raise
            values = self._workers.replies()
        return [own, *(value for (value,) in values)]

    def call_one(self, env: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return `function(vec_env, row, *arguments)`, called in the shard of environment `env`.

        `row` is the index of the environment in that shard.
        """
        self._require_usable()
        number = next(n for n, shard in enumerate(self._shards) if env < shard.first + shard.count)
        row = env - self._shards[number].first
        if number == 0:
            return function(self.local, row, *arguments)
        process = list(self._workers)[number - 1]
        process.send(worker.CALL, (function, (row, *arguments)))
        with self._unread_replies():
            return process.receive()[1][0]

    # --- a step in all processes ---

    def _begin(self) -> None:
        """Choose the shared buffer (slot) of the next result, and set the stages at which shards wait for observers."""
        self._require_usable()
        self._slot = (self._slot + 1) % SLOTS
        self._command[:2] = self._slot, Needs.of_observers(self.observers).value

    @contextlib.contextmanager
    def _in_step(self) -> Iterator[None]:
        """Mark the environment as broken if an error or a signal interrupts the processes in the middle of a step."""
        self._is_broken = True
        yield
        self._is_broken = False

    @contextlib.contextmanager
    def _unread_replies(self) -> Iterator[None]:
        """Mark the environment as broken if a signal interrupts the processes before their replies are read."""
        try:
            yield
        except KeyboardInterrupt:
            self._is_broken = True
            raise

    def _require_usable(self) -> None:
        if self._is_broken and not self._stage:
            raise RuntimeError("a step was interrupted, so the environment cannot be used any more; create a new one")

    def _reach(self, stage: Stage, content: Any) -> None:
        """Wait until all shards reach the stage of the first shard; run the observers of this and of earlier stages."""
        while True:
            for process in self._workers:
                if process not in self._waiting:
                    kind, reached = process.receive()
                    self._waiting[process] = Stage(kind[1]), reached
            now = min([stage, *(reached for reached, _ in self._waiting.values())])
            contents = [content if stage == now else None]
            contents += [self._waiting[p][1] if self._waiting[p][0] == now else None for p in self._workers]
            self._stage = now
            self._observe(now, contents)
            self._stage = None
            if now == Stage.DONE:
                self._waiting.clear()
                return
            for process in [p for p, (reached, _) in self._waiting.items() if reached == now]:
                process.send(worker.CONTINUE)
                del self._waiting[process]
            if now == stage:
                return

    def _observe(self, stage: Stage, contents: Sequence[Any]) -> None:
        """Run the observers of a stage.

        `contents` has the data that each shard sent for the observers; None for a shard at another stage.
        """
        if stage in (Stage.ON_STEP, Stage.DONE):
            for number, columns in enumerate(contents):
                self._columns[number] = columns or self._columns[number]
        if stage == Stage.ON_STEP:
            self._read_episodes()
            arrays = self._arrays
            reward = arrays["reward"][self._slot]
            self.observers.run_on_step(
                StepRecord(self._last_obs, arrays["action"], reward, arrays["reward_terms"], self._episodes)
            )
        elif stage == Stage.AFTER_PHYSICS:
            for after_physics in self.observers.after_physics:
                after_physics()
        elif stage in (Stage.DIVERGED, Stage.QUARANTINED):
            found = [divergence for content in contents for divergence in content or ()]
            self.observers.run_on_divergence(found[:MAX_DESCRIBED], pending=stage == Stage.QUARANTINED)

    def _read_episodes(self) -> None:
        self._episodes = read_episodes(self._arrays, self._shards, self._columns)

    def _obs(self) -> dict[str, Tensor]:
        self._last_obs = {group: self._arrays[f"obs.{group}"][self._slot] for group in self.layout.observations}
        return self._last_obs

    def _metric_values(self) -> dict[str, Tensor]:
        parts = self.call_all(methodcaller("metric_values"))
        return {name: self._joined_metric([part[name] for part in parts]) for name in _common_names(parts)}

    def _joined_metric(self, parts: Sequence[Tensor]) -> Tensor:
        """Return the values of a metric for all environments, joined from the shards.

        If each shard has a single value instead of one for each environment, return the mean of these values, weighted
        by the numbers of environments.
        """
        if parts[0].dim():
            return join(parts)
        counts = torch.tensor([shard.count for shard in self._shards], dtype=torch.float64)
        values = torch.stack([part.double() for part in parts])
        return values[0] if bool((values == values[0]).all()) else (values * counts).sum() / self.num_envs


def _resolved_parts(resolved: Resolved, shards: Sequence[Shard]) -> list[Resolved]:
    """Return the configuration of each shard, with its number of environments and its share of the engine's threads."""
    task = resolved.task
    threads, count = task.sim.engine_threads or available_cores(), len(shards)
    parts = []
    for number, shard in enumerate(shards):
        share = max(1, threads // count + (number < threads % count))
        update = {
            "scene": task.scene.model_copy(update={"num_envs": shard.count}),
            "sim": task.sim.model_copy(update={"engine_threads": share}),
        }
        parts.append(replace(resolved, task=task.model_copy(update=update)))
    return parts


def _pickled(resolved: Resolved) -> bytes:
    """Return a configuration as bytes of pickle, to send it to a worker.

    Raises:
        ConfigError: if the configuration has functions or classes that no module defines.
    """
    try:
        return pickle.dumps(resolved)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        message = f"the configuration cannot be sent to worker processes: {one_line(error)}"
        hint = "set scene.workers: 1, or define the functions and classes of the task in a module"
        raise ConfigError([resolved.problem(("scene", "workers"), message, hint)]) from None


def _joined_rows(parts: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
    return {name: torch.cat([part[name] for part in parts]) for name in _common_names(parts)}


def _common_names(parts: Sequence[dict[str, Tensor]]) -> list[str]:
    """Return the names that all shards have: a task may log a value only after the first episode has ended."""
    return [name for name in parts[0] if all(name in part for part in parts)]


def _state_shapes(env: VecEnv) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in env.state_dict().items()}
