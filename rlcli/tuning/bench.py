"""Benchmark of `rlcli bench`: speed of a task on this machine, and the sizes and threads that train fastest.

Sizes are the number of environments, the steps of a rollout and the number of minibatches. Workers are processes, each
of which steps a part of the environments (`scene.workers`).

A setting is recommended only if it learns as much in an iteration as the task's own setting: with the same number of
samples, and the same number and size of gradient steps. The setting with the shortest iteration is then the fastest.
More steps per second, but fewer gradient steps per sample, would be no gain.
"""

import contextlib
import itertools
import math
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from rlcli.config.load import Resolved
from rlcli.envs.sharding.training_env import make_training_env
from rlcli.envs.sharding.worker_count import number_of_workers
from rlcli.errors import ConfigError
from rlcli.machine.cores import available_cores
from rlcli.machine.memory import available_memory, resident_memory
from rlcli.rl.trainer import Trainer
from rlcli.training.job import threads
from rlcli.training.setup import make_trainer

SIZES = (16, 64, 256, 1_024, 4_096, 16_384)
"""Numbers of environments that are measured."""
HORIZONS = ("num_steps", "n_steps", "num_steps_per_env", "train_freq")
"""Configuration keys that agents use for the number of steps of each environment in an iteration."""
UNSTEADY = 0.15
"""Spread (see `Stepped.spread`) above which a measurement is repeated, and the machine is reported as busy."""
WORTH = 0.97
"""A setting is recommended only if its iteration takes less than this share of an iteration with the task's own one."""
_ACTIONS = 8
"""Number of batches of random actions with which the environments are stepped in turn."""
_ENV_BYTES = 256 * 2**10
"""Assumed memory of one environment before the first measurement [bytes]."""


@dataclass(frozen=True, slots=True)
class Pace:
    """Duration and number of the measurements of `rlcli bench`.

    A block is a series of calls (of `step`, or of a training iteration) that is timed as a whole.
    """

    block_s: float = 0.4
    """Shortest duration of a block of calls [s]."""
    blocks: int = 5
    """Number of blocks in a round."""
    rounds: int = 3
    """Largest number of rounds; after a round, another one follows only if the spread is above `UNSTEADY`."""
    longest_s: float = 4.0
    """Duration of a step of all environments [s] above which a number of environments is not measured."""


QUICK = Pace(block_s=0.05, blocks=3, rounds=1, longest_s=1.0)
"""Pace for `rlcli bench --quick`."""


@dataclass(frozen=True, slots=True)
class Stepped:
    """Measured speed of the environments with random actions, without training, for one number of environments."""

    num_envs: int
    engine_threads: int
    """Number of threads of the physics engine."""
    workers: int
    """Number of processes, each of which steps a part of the environments."""
    steps_per_s: float | None = None
    """Environment steps per second, summed over all environments; None: not measured."""
    physics: float | None = None
    """Share of the physics in the time of a step, from 0 to 1."""
    spread: float | None = None
    """Interquartile range of the durations of the blocks, divided by their median."""
    resident: int | None = None
    """Resident memory of the process [bytes]."""
    left_out: str | None = None
    """Reason why this size was not measured; None: it was measured."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Sizes and threads of a training that the benchmark compares."""

    num_envs: int
    horizon: int | None
    """Steps of each environment in an iteration; None: the agent has no such setting."""
    minibatches: int | None
    """Number of minibatches of an epoch; None: the agent has no such setting, or sets the minibatches' size."""
    engine_threads: int
    torch_threads: int
    workers: int
    """Number of processes, each of which steps a part of the environments."""


@dataclass(frozen=True, slots=True)
class Trained:
    """Speed of training iterations with a setting (sizes and threads)."""

    setting: Setting
    alike: bool
    """Whether an iteration has as many samples and gradient steps as with the task's own setting, so that a training
    learns equally."""
    samples: int = 0
    """Number of samples (environment steps) in an iteration."""
    seconds: float | None = None
    """Median duration of an iteration [s]; None: not measured."""
    shares: Mapping[str, float] = field(default_factory=dict)
    """Part of an iteration (physics, task, policy, update) -> its share of the time, from 0 to 1."""
    spread: float | None = None
    """Interquartile range of the durations of the blocks, divided by their median."""
    resident: int | None = None
    """Resident memory of the process [bytes]."""
    left_out: str | None = None
    """Reason why this setting was not measured; None: it was measured."""

    @property
    def steps_per_s(self) -> float | None:
        """Environment steps per second of rollout and update together; None: not measured."""
        return None if self.seconds is None else self.samples / self.seconds

    @property
    def milliseconds(self) -> float | None:
        """Median duration of an iteration [ms]; None: not measured."""
        return None if self.seconds is None else 1e3 * self.seconds


@dataclass(slots=True)
class Findings:
    """All measurements of a benchmark so far, and the recommended setting."""

    stepped: list[Stepped] = field(default_factory=list)
    trained: list[Trained] = field(default_factory=list)
    """All measured settings; the first is the task's own setting."""
    present: Trained | None = None
    """The task's own setting, measured in alternation with the fastest one; None: not measured yet."""
    recommended: Trained | None = None
    """The recommended setting; equal to `present` if no setting is clearly faster; None: not measured yet."""

    @property
    def unsteady(self) -> bool:
        """Whether the measurements vary so much that other programs probably load the machine."""
        rows: list[Stepped | Trained] = [*self.stepped, *self.trained]
        spreads = [row.spread for row in rows if row.spread is not None]
        return bool(spreads) and statistics.median(spreads) > UNSTEADY

    def record(self) -> dict[str, Any]:
        """Return the measurements as JSON data, with the entries `environment`, `training` and `unsteady`."""
        rows = []
        for one in self.trained:
            entries = asdict(one)
            rows.append({**entries.pop("setting"), **entries, "steps_per_s": one.steps_per_s})
        return {"environment": [asdict(one) for one in self.stepped], "training": rows, "unsteady": self.unsteady}


@dataclass(slots=True)
class _Training:
    """Training that is measured: its trainer and the durations of its iterations."""

    trainer: Trainer
    blocks: list[float] = field(default_factory=list)
    """Mean duration of an iteration in each block of repeated calls [s]."""
    seconds: list[Mapping[str, float]] = field(default_factory=list)
    """Part -> duration [s], for each iteration."""

    def iterate(self) -> None:
        """Run a training iteration, and add the durations of its parts to `seconds`."""
        self.seconds.append(self.trainer.iterate().seconds)

    def row(self, setting: Setting, *, alike: bool) -> Trained:
        """Return the speed of the iterations so far.

        Args:
            setting: sizes and threads of the training.
            alike: whether a training learns as much as with the task's own setting, see `Trained.alike`.
        """
        total = sum(sum(parts.values()) for parts in self.seconds)
        names = dict.fromkeys(name for parts in self.seconds for name in parts)
        shares = {name: sum(parts.get(name, 0.0) for parts in self.seconds) / total for name in names}
        samples, median = self.trainer.steps_per_iteration, statistics.median(self.blocks)
        return Trained(setting, alike, samples, median, shares, _spread(self.blocks), resident_memory())


class Bench:
    """Benchmark of one task and agent.

    Args:
        resolve: returns the task's configuration, changed by the given values (dotted key -> value).
        pace: duration and number of the measurements.
        announce: called before each measurement with a description of the measurement.
        show: called after each measurement with all measurements so far.

    Raises:
        ConfigError: if the configuration has no agent.
    """

    def __init__(
        self,
        resolve: Callable[[Mapping[str, Any]], Resolved],
        pace: Pace,
        announce: Callable[[str], None] = lambda _: None,
        show: Callable[[Findings], None] = lambda _: None,
    ) -> None:
        self.findings = Findings()
        self._resolve, self._pace, self._announce, self._show = resolve, pace, announce, show
        present = resolve({})
        agent, _ = present.require_agent()
        self.horizon_key = next((key for key in HORIZONS if isinstance(getattr(agent, key, None), int)), None)
        engine, update = threads(present)
        horizon = None if self.horizon_key is None else int(getattr(agent, self.horizon_key))
        fixed_size = getattr(agent, "minibatch_size", None) is not None
        minibatches = None if fixed_size else getattr(agent, "num_minibatches", None)
        workers = number_of_workers(present, "cpu")
        self.present = Setting(present.task.scene.num_envs, horizon, minibatches, engine, update, workers)

    def run(self) -> Findings:
        """Run all measurements and return them; after an interrupt, `findings` has the finished measurements.

        Raises:
            ConfigError: if a training with the task's own setting cannot be made.
        """
        self._step_all()
        self._train_all()
        return self.findings

    def changes(self, setting: Setting) -> dict[str, Any]:
        """Return a setting as changes of the configuration: dotted key -> value."""
        changed: dict[str, Any] = {
            "scene.num_envs": setting.num_envs,
            "sim.engine_threads": setting.engine_threads,
            "agent.torch_threads": setting.torch_threads,
            "scene.workers": setting.workers,
        }
        if self.horizon_key is not None:
            changed[f"agent.{self.horizon_key}"] = setting.horizon
        if setting.minibatches is not None:
            changed["agent.num_minibatches"] = setting.minibatches
        return changed

    # --- the environment alone ---

    def _step_all(self) -> None:
        """Measure the speed of the environments without training, for each size, number of threads and workers."""
        present = self.present
        threads, workers, counts = present.engine_threads, present.workers, _powers(available_cores())
        sizes = [(num_envs, threads, min(workers, num_envs // 2)) for num_envs in SIZES]
        sizes += [(present.num_envs, count, workers) for count in counts if count != threads]
        sizes += [(present.num_envs, threads, count) for count in counts if count != workers]
        for size in sizes:
            self.findings.stepped.append(self._step(*size))
            self._show(self.findings)

    def _step(self, num_envs: int, engine_threads: int, workers: int) -> Stepped:
        self._announce(f"{num_envs:,} environments, {engine_threads} engine threads, workers {workers}")
        reason = self._too_large(num_envs)
        if reason is not None:
            return Stepped(num_envs, engine_threads, workers, left_out=reason)
        torch.set_num_threads(1)  # one thread, as in a rollout
        flags = {"scene.num_envs": num_envs, "sim.engine_threads": engine_threads, "scene.workers": workers}
        try:
            env = make_training_env(self._resolve(flags), seed=42, device="cpu")
        except ConfigError as error:
            return Stepped(num_envs, engine_threads, workers, left_out=error.problems[0].message)
        with contextlib.closing(env), torch.inference_mode():
            generator = torch.Generator().manual_seed(42)
            shape = (_ACTIONS, num_envs, env.layout.action_size)
            actions = itertools.cycle(torch.rand(shape, generator=generator) * 2.0 - 1.0)
            env.reset(seed=42)
            for _ in range(3):  # warm-up
                env.step(next(actions))
            before = dict(env.seconds)
            blocks = _blocks(lambda: env.step(next(actions)), self._pace)
            physics = (env.seconds["physics"] - before["physics"]) / (env.seconds["step"] - before["step"])
            rate = num_envs / statistics.median(blocks)
            return Stepped(num_envs, engine_threads, workers, rate, physics, _spread(blocks), resident_memory())

    def _too_large(self, num_envs: int) -> str | None:
        """Return why a number of environments is not measured (too much memory or time); None if it can be measured."""
        smaller = [row for row in self.findings.stepped if row.left_out is None and row.num_envs < num_envs]
        measured = sorted(smaller, key=lambda row: row.num_envs)
        first, last = (measured[0], measured[-1]) if measured else (None, None)
        env_bytes, more_envs = _ENV_BYTES, last.num_envs - first.num_envs if first and last else 0
        if first and last and more_envs and first.resident is not None and last.resident is not None:
            # memory grows linearly with the number of environments
            env_bytes = max(4096, (last.resident - first.resident) // more_envs)
        if env_bytes * num_envs > available_memory() // 2:
            return f"needs about {env_bytes * num_envs / 2**30:.1f} GiB"
        if last and last.steps_per_s and num_envs / last.steps_per_s > self._pace.longest_s:
            return f"a step would take about {num_envs / last.steps_per_s:.0f} s"
        return None

    # --- training ---

    def _train_all(self) -> None:
        best = self._add_trained(self.present)
        cores = available_cores()
        for key, most in (("torch_threads", min(16, cores)), ("engine_threads", cores), ("workers", cores)):
            others = [count for count in _powers(most) if count != getattr(best.setting, key)]
            best = _fastest([best, *(self._add_trained(replace(best.setting, **{key: count})) for count in others)])
        best = _fastest([best, *(self._add_trained(setting) for setting in self._sizes(best.setting))])
        if best.setting.minibatches is not None:
            for count in (best.setting.minibatches // 2, best.setting.minibatches * 2):
                if count:
                    self._add_trained(replace(best.setting, minibatches=count))
        self._compare(best)

    def _sizes(self, setting: Setting) -> Iterator[Setting]:
        """Yield two settings: half the environments and twice the steps of a rollout, and the opposite.

        The number of samples in an iteration stays equal. Nothing is yielded for an agent without such a setting.
        """
        if setting.horizon is None:
            return
        samples = setting.num_envs * setting.horizon
        for num_envs in (setting.num_envs // 2, setting.num_envs * 2):
            if num_envs and samples % num_envs == 0 and samples // num_envs > 1:
                yield replace(setting, num_envs=num_envs, horizon=samples // num_envs)

    def _add_trained(self, setting: Setting) -> Trained:
        row = self._train(setting)
        self.findings.trained.append(row)
        self._show(self.findings)
        return row

    def _train(self, setting: Setting) -> Trained:
        self._announce(f"training: {_describe(setting)}")
        alike = setting.minibatches == self.present.minibatches
        reason = None if setting == self.present else self._too_large(setting.num_envs)
        if reason is not None:
            return Trained(setting, alike, left_out=reason)
        try:
            with self._open_training(setting) as training:
                training.iterate()  # warm-up
                training.seconds.clear()
                training.blocks = _blocks(training.iterate, self._pace)
                return training.row(setting, alike=alike)
        except ConfigError as error:
            if setting == self.present:
                raise
            return Trained(setting, alike, left_out=error.problems[0].message)

    @contextlib.contextmanager
    def _open_training(self, setting: Setting) -> Iterator[_Training]:
        """Build a training with a setting for a `with` block, and start its first episodes."""
        trainer, env = make_trainer(self._resolve(self.changes(setting)), 42, "cpu", setting.torch_threads)
        with contextlib.closing(env):
            trainer.start()
            yield _Training(trainer)

    def _compare(self, best: Trained) -> None:
        """Measure the fastest and the task's own setting again, in alternation, and store which of them is recommended.

        Because of the alternation, other programs that load the machine slow down both settings equally.
        """
        present = self.findings.trained[0]
        if best.setting == present.setting:
            self.findings.present = self.findings.recommended = present
            return
        settings = (present.setting, best.setting)
        self._announce(f"in alternation: {' and '.join(map(_describe, settings))}")
        with contextlib.ExitStack() as stack:
            trainings = [stack.enter_context(self._open_training(setting)) for setting in settings]
            for _ in range(1 + max(3, self._pace.blocks)):
                for training in trainings:
                    training.blocks.append(_block(training.iterate, self._pace.block_s))
            for training in trainings:
                del training.blocks[0]  # warm-up
            present, best = (training.row(each, alike=True) for training, each in zip(trainings, settings, strict=True))
        assert present.seconds is not None
        assert best.seconds is not None
        noise = max(present.spread or 0.0, best.spread or 0.0)
        better = best.seconds < present.seconds * min(WORTH, 1.0 - noise)
        self.findings.present, self.findings.recommended = present, best if better else present


def system_load() -> float | None:
    """Return the mean number of running processes in the last minute (the system's load); None if unknown."""
    with contextlib.suppress(AttributeError, OSError):
        return os.getloadavg()[0]
    return None


def _blocks(call: Callable[[], object], pace: Pace) -> list[float]:
    """Call a function repeatedly, in blocks; return the mean duration of a call in each block [s].

    While the spread is above `UNSTEADY`, further rounds follow, up to `pace.rounds`.
    """
    blocks: list[float] = []
    for _ in range(pace.rounds):
        blocks += [_block(call, pace.block_s) for _ in range(pace.blocks)]
        if _spread(blocks) <= UNSTEADY:
            break
    return blocks


def _block(call: Callable[[], object], min_s: float) -> float:
    """Call a function repeatedly for at least `min_s` seconds; return the mean duration of a call [s]."""
    begin, calls = time.perf_counter(), 0
    while True:
        call()
        calls += 1
        took = time.perf_counter() - begin
        if took >= min_s:
            return took / calls


def _spread(blocks: list[float]) -> float:
    """Return the interquartile range of the blocks' durations, divided by their median."""
    low, middle, high = statistics.quantiles(blocks, n=4, method="inclusive")
    return (high - low) / middle


def _powers(most: int) -> list[int]:
    """Return the numbers of threads or workers to measure: 1, 2, 4, ... up to `most`, and `most` itself."""
    return sorted({*(2**n for n in range(int(math.log2(most)) + 1)), most})


def _fastest(rows: list[Trained]) -> Trained:
    """Return the row with the shortest iteration among the measured rows with `alike`."""
    measured = [row for row in rows if row.alike and row.seconds is not None]
    return min(measured, key=lambda row: row.seconds or math.inf)


def _describe(setting: Setting) -> str:
    """Return a setting as text, such as `64 environments, 32 steps, engine threads 4, torch threads 1, workers 1`."""
    parts = [f"{setting.num_envs:,} environments"]
    if setting.horizon is not None:
        parts.append(f"{setting.horizon} steps")
    if setting.minibatches is not None:
        parts.append(f"{setting.minibatches} minibatches")
    threads = f"engine threads {setting.engine_threads}, torch threads {setting.torch_threads}"
    return ", ".join([*parts, threads, f"workers {setting.workers}"])
