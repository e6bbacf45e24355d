"""Recorder of the last seconds of failed and outlier episodes of a training, for `rlcli autopsy`.

Ring buffers hold the last seconds of all environments: the states at the beginning of each engine call (`StateHistory`
in `rlcli.sim.divergence_report`), observations, actions and rewards. In each iteration, one episode of every kind is
copied: for each set of terminations the episode with the lowest return, the outliers with the lowest and the highest
return, and for each cause of divergence the first episode. The copies are written to files with the next checkpoint.
When a training resumes, files that were written after its checkpoint are removed, because their episodes are run again.

Recording draws no random numbers and writes nothing to the environment, so that a training with recording has the same
weights, bit for bit, as a training without recording.
"""

import contextlib
import logging
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from rlcli.config.schema import AutopsyConfig
from rlcli.envs.environment_protocol import Environment
from rlcli.envs.observers import StepObserver
from rlcli.envs.step_result import Episodes, StepRecord
from rlcli.errors import CheckpointError, MachineError, RlcliError
from rlcli.managers.termination import DIVERGED
from rlcli.replay.crash_dump import CallTrace, describe_traces, stop_observing_divergences, trace_calls
from rlcli.replay.failure_cases import FILE_NAME, FOLDER
from rlcli.replay.trajectory import (
    MAX_SUBSTEPS,
    Episode,
    Failure,
    FailureKind,
    Header,
    read_trajectory,
    write_trajectory,
)
from rlcli.runs.atomic_io import disk_errors, write_atomic
from rlcli.runs.safe_io import read_file
from rlcli.sim.divergence_report import Divergence

_log = logging.getLogger(__name__)
RECENT = 1024
"""Number of recent episodes with whose returns a new return is compared."""
LEAST = 64
"""Number of recent returns that are needed before a new return can be an outlier."""
FAR = 3.0
"""Distance from the quartiles, in interquartile ranges, above which a return is an outlier (Tukey's outer fences)."""
_RETURNS_FILE = "recent.json"
_MIN_SPREAD = 1e-3
"""Lower limit of the interquartile range, as a fraction of the larger quartile.

Without a limit, nearly equal returns would have outliers that differ only in the fourth digit.
"""

_Key = tuple[FailureKind, *tuple[str, ...]]
"""Kind of an episode, and the causes of its end: for each key, one episode is kept per iteration."""


@dataclass(frozen=True, slots=True)
class KeptEpisode:
    """The last steps of a failed or outlier episode, in memory, before they are written to a file."""

    value: float
    """Number by which episodes of one kind are compared, such as the return; the episode with the lowest is kept."""
    kind: FailureKind
    episode: Episode
    trace: CallTrace
    """The last engine calls of the episode's environment."""
    tensors: dict[str, Tensor]
    """Observations, actions and rewards of the steps, by their names in a trajectory file (`episode.0.*`)."""
    follows_constants: bool
    """Whether MuJoCo derives its constants again from the environment's own model fields."""


@dataclass(frozen=True, slots=True)
class FailureBatch:
    """Files of failure cases that are written and removed together with a checkpoint."""

    step: int
    """Environment steps of the checkpoint."""
    write: dict[str, tuple[KeptEpisode, Failure]]
    """File name -> content of the files to write."""
    remove: list[str]
    """Names of the files to remove after the checkpoint is complete."""
    returns: list[float]
    """Returns of recent episodes, with which a resumed training recognises outliers."""


class _RecentReturns(BaseModel):
    """Content of the file with the returns of recent episodes at a checkpoint (environment step `step`)."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    step: int
    returns: list[float] = Field(max_length=RECENT)


class FailureRecorder(StepObserver):
    """Observer that records the last steps of failed and outlier episodes of a training on a CPU.

    Args:
        env: the environments; their engine is set to keep the calls of the last seconds.
        config: limits of time, memory and number of files (`autopsy:` of the agent).
        folder: folder of the run; the files are written to its subfolder `autopsy`.
        step: environment steps of the checkpoint from which training resumes; None: a new training.
    """

    def __init__(self, env: Environment, config: AutopsyConfig, folder: Path, step: int | None) -> None:
        engine = env.engine.replayable
        assert engine is not None
        self._env, self._engine, self._keep = env, engine, config.keep
        self._folder = folder / FOLDER
        memory, n, terms = config.memory_mib << 20, env.num_envs, len(env.reward_names)
        self._slots = slots = self._steps_that_fit(config.seconds, memory)
        self._rings = {
            "observations": np.empty((slots, n, env.layout.size()), np.float32),
            "actions": np.empty((slots, n, env.layout.action_size), np.float32),
            "rewards": np.empty((slots, n), np.float32),
            "reward_terms": np.empty((slots, terms, n), np.float32),
        }
        self._step = 0
        self._diverging: dict[int, CallTrace] = {}
        self._pending: dict[_Key, KeptEpisode] = {}
        """(kind, causes) -> the recorded episode of this iteration."""
        self._returns: list[NDArray[np.float32]] = []
        self._recent = np.zeros(0)
        self._quartiles: tuple[float, float] | None = None
        self._files: dict[str, str] = {}
        """Name -> kind of every file of the folder, written or not, in the order of the names."""
        self._unwritten: dict[str, tuple[KeptEpisode, Failure]] = {}
        self._written: set[str] = set()
        self._failed = ""
        self._read_folder(step)
        left = memory - sum(ring.nbytes for ring in self._rings.values())
        engine.record_calls(slots * env.calls_per_step, max(0, left))
        env.observers.add(self)

    @property
    def seconds(self) -> float:
        """Longest simulated time before the end of an episode that is recorded [s]."""
        return min(self._slots, self._engine.history.calls // self._env.calls_per_step) * self._env.step_dt

    def close(self) -> None:
        """Stop recording; if nothing else observes divergences, set the engine to keep only its newest call."""
        stop_observing_divergences(self._env, self)

    # --- called after iterations and at checkpoints ---

    def commit(self, iteration: int, step: int) -> None:
        """Add the recorded episodes of a finished iteration to the files that the next checkpoint writes.

        The training loop calls this method after each iteration. `step` is the number of environment steps so far.
        """
        if self._failed:
            _log.warning("failed episodes are not recorded any more: %s", self._failed)
            self._failed = ""
            self.close()
        for kept in self._pending.values():
            e = kept.episode
            name = f"{step:012d}-env-{e.env:06d}-episode-{e.index:06d}.safetensors"
            if name not in self._files:
                self._files[name] = kept.kind
                failure = Failure(kind=kept.kind, iteration=iteration, step=step, usual_returns=self._quartiles)
                self._unwritten[name] = kept, failure
        self._pending.clear()
        self._evict()
        self._update_quartiles()

    def take(self, step: int) -> FailureBatch:
        """Return the files to write and to remove with a checkpoint; the next call returns only later files.

        `step` is the number of environment steps of the checkpoint.
        """
        names = set(self._files)
        batch = FailureBatch(step, self._unwritten, sorted(self._written - names), self._recent.tolist())
        self._unwritten, self._written = {}, names
        return batch

    def write(self, batch: FailureBatch) -> None:
        """Write the files of a batch; a disk error ends the recording, but not the training.

        The thread that writes checkpoints calls this method.
        """
        try:
            for name, (kept, failure) in batch.write.items():
                worlds, tensors = describe_traces(
                    [kept.trace],
                    self._engine.model,
                    self._env.resolved,
                    kept.follows_constants,
                    diverged=kept.kind == "diverged",
                )
                parts = {"kind": "failure", "episodes": [kept.episode], "worlds": worlds, "failure": failure}
                header = self._header.model_copy(update={**parts, "follows_constants": kept.follows_constants})
                write_trajectory(self._folder / name, header, tensors | kept.tensors, parents=False)
            if batch.returns:  # a resumed training needs these returns, even if no episode is recorded yet
                with disk_errors(self._folder):
                    self._folder.mkdir(exist_ok=True)
                recent = _RecentReturns(step=batch.step, returns=batch.returns)
                write_atomic(self._folder / _RETURNS_FILE, recent.model_dump_json(indent=2) + "\n")
        except (RlcliError, OSError) as error:
            self._failed = str(error)

    def drop(self, batch: FailureBatch) -> None:
        """Remove the files in `batch.remove` from the folder; call it after the checkpoint is complete."""
        for name in batch.remove:
            with contextlib.suppress(MachineError), disk_errors(self._folder / name):
                (self._folder / name).unlink(missing_ok=True)

    @cached_property
    def _header(self) -> Header:
        return Header.of(self._env)

    # --- called in every step ---

    def on_divergence(self, found: list[Divergence], pending: bool) -> None:
        """Copy the last engine calls of environments that diverged; `on_step` then keeps their episodes.

        In each iteration only the first divergence of each cause is copied. `pending`: see `trace_calls`.
        """
        for divergence in found:
            if ("diverged", divergence.cause) not in self._pending:
                self._diverging[divergence.env] = trace_calls(self._env, divergence, pending)

    def on_step(self, record: StepRecord) -> None:
        """Write the step into the ring buffers, and keep the failed and outlier episodes that end in this step."""
        slot = self._step % self._slots
        for name, value in (
            ("observations", record.obs["policy"]),
            ("actions", record.action),
            ("rewards", record.reward),
            ("reward_terms", record.reward_terms),
        ):
            np.copyto(self._rings[name][slot], value.detach().numpy())
        self._step += 1
        if record.episodes is not None:
            self._choose(record.episodes)
        self._diverging.clear()

    def _choose(self, ended: Episodes) -> None:
        """Keep some of the ended episodes that diverged, have an outlier return, or were terminated.

        One episode of each kind is kept per iteration: the first one for each cause of divergence, the outliers with
        the lowest and the highest return, and for each set of terminations the episode with the lowest return.
        """
        returns, rest = ended.returns.detach().numpy().copy(), ~ended.truncated.numpy()
        self._returns.append(returns)
        if DIVERGED in ended.causes:
            diverged = ended.causes[DIVERGED].numpy()
            for row, env in enumerate(ended.ids.tolist() if self._diverging else ()):
                trace = self._diverging.get(env)
                if trace is not None and ("diverged", trace.divergence.cause) not in self._pending:
                    self._keep_episode(("diverged", trace.divergence.cause), 0.0, ended, row, trace)
        else:
            diverged = np.zeros(len(returns), bool)
        low, high = self._fences()
        unusual: list[tuple[FailureKind, NDArray[np.float32], NDArray[np.bool_]]] = [
            ("low return", returns, returns < low),
            ("high return", -returns, returns > high),
        ]
        for kind, value, mask in unusual:
            self._keep_lowest((kind,), value, mask & ~diverged, ended)
            rest = rest & ~mask
        rest &= ~diverged
        if not rest.any():
            return
        code = np.zeros(len(rest), np.int64)  # bit n: termination n has fired; 62 bits fit into int64
        for number, fired in enumerate(ended.causes.values()):
            code |= fired.numpy().astype(np.int64) << number % 62
        for causes in np.unique(code[rest]).tolist():
            names = [name for number, name in enumerate(ended.causes) if causes >> number % 62 & 1]
            self._keep_lowest(("terminated", *names), returns, rest & (code == causes), ended)

    def _keep_lowest(self, key: _Key, value: NDArray[np.float32], mask: NDArray[np.bool_], ended: Episodes) -> None:
        """Keep the episode with the lowest value under a key, if no episode with a lower value is kept there already.

        Args:
            key: kind of the episode, and the causes of its end.
            value: `KeptEpisode.value` of each ended episode. (ended,)
            mask: whether an ended episode is of this kind. (ended,)
            ended: the ended episodes.
        """
        if not mask.any():
            return
        row = int(np.where(mask, value, np.inf).argmin())
        kept = self._pending.get(key)
        wanted = len(self._pending) < self._keep if kept is None else bool(value[row] < kept.value)
        if wanted:
            trace = trace_calls(self._env, Divergence(int(ended.ids[row]), key[0]))
            self._keep_episode(key, float(value[row]), ended, row, trace)

    def _keep_episode(self, key: _Key, value: float, ended: Episodes, row: int, trace: CallTrace) -> None:
        """Copy the last steps of an ended episode, as many as are in both the ring buffers and the trace.

        Args:
            key: kind of the episode, and the causes of its end.
            value: `KeptEpisode.value` of the episode.
            ended: the ended episodes.
            row: the row of the episode in `ended`.
            trace: the last engine calls of the episode's environment; older calls are removed from `trace`.
        """
        per_step, env = self._env.calls_per_step, trace.divergence.env
        whole = (len(trace.calls) - trace.last) // per_step
        steps = min(int(ended.lengths[row]), self._slots, self._step, whole + 1)
        if steps == 0:
            return
        trace.calls = trace.calls[-((steps - 1) * per_step + trace.last) :]
        slots = np.arange(self._step - steps, self._step) % self._slots
        arrays = {name: ring[slots, env] for name, ring in self._rings.items() if name != "reward_terms"}
        arrays["reward_terms"] = self._rings["reward_terms"][slots, :, env]
        tensors = {f"episode.0.{name}": torch.from_numpy(values) for name, values in arrays.items()}
        episode = Episode.of(self._env, ended, row, kept=steps)
        self._pending[key] = KeptEpisode(value, key[0], episode, trace, tensors, self._engine.own_constants)

    def _fences(self) -> tuple[float, float]:
        """Return the lowest and highest return that is not an outlier; infinite before there are `LEAST` returns."""
        if self._quartiles is None:
            return -np.inf, np.inf
        first, third = self._quartiles
        spread = max(third - first, _MIN_SPREAD * max(abs(first), abs(third)))
        return first - FAR * spread, third + FAR * spread

    def _update_quartiles(self) -> None:
        """Add the returns of the finished iteration to the returns of recent episodes, and compute the quartiles."""
        if self._returns:
            self._recent = np.concatenate([self._recent, *self._returns])[-RECENT:]
            self._returns.clear()
        if len(self._recent) >= LEAST:
            first, third = np.quantile(self._recent, [0.25, 0.75]).tolist()
            self._quartiles = (first, third)

    def _evict(self) -> None:
        """Drop files until at most as many are left as the agent's setting `autopsy.keep` allows.

        Each time the oldest file of the most frequent kind is dropped, so that every kind of failure stays. The next
        checkpoint removes the dropped files from the disk.
        """
        self._files = dict(sorted(self._files.items()))  # a resumed run reads the folder in this order
        while len(self._files) > self._keep:
            counts = Counter(self._files.values())
            most = max(counts.values())
            oldest = next(name for name, kind in self._files.items() if counts[kind] == most)
            del self._files[oldest]
            self._unwritten.pop(oldest, None)

    # --- start of the recording ---

    def _steps_that_fit(self, seconds: float, memory: int) -> int:
        """Return the number of environment steps that the ring buffers hold; at least 1.

        As many as last `seconds` [s], fit into `memory` [bytes] and can be simulated again by a replay.
        """
        env, engine = self._env, self._engine
        columns = env.layout.size() + env.layout.action_size + 1 + len(env.reward_names)
        bytes_per_step = env.num_envs * (8 * engine.history.width * env.calls_per_step + 4 * columns)
        most = MAX_SUBSTEPS // env.config.decimation - 1
        return max(1, min(round(seconds / env.step_dt), most, memory // bytes_per_step))

    def _read_folder(self, step: int | None) -> None:
        """List the failure cases that the folder already has, and remove those written after the checkpoint.

        `step` is the number of environment steps of the checkpoint from which training resumes; None: a new training,
        which removes all failure cases. A file that cannot be read is kept.
        """
        if not self._folder.is_dir():
            return
        for file in sorted(self._folder.iterdir()):
            named = FILE_NAME.fullmatch(file.name)
            if named is None:
                continue
            try:
                failure = read_trajectory(file).header.failure
            except CheckpointError:
                continue
            if step is None or int(named[1]) > step or failure is None:
                file.unlink(missing_ok=True)
            else:
                self._files[file.name] = failure.kind
        self._written = set(self._files)
        self._evict()
        with contextlib.suppress(CheckpointError, FileNotFoundError, ValidationError):
            recent = _RecentReturns.model_validate_json(read_file(self._folder / _RETURNS_FILE, 1 << 20))
            if recent.step == step:
                self._recent = np.array(recent.returns, dtype=np.float64)
                self._update_quartiles()


def open_failure_recorder(
    env: Environment, config: AutopsyConfig | None, folder: Path, step: int | None
) -> FailureRecorder | None:
    """Return a recorder of failed and outlier episodes; None if `config` is None, and on a GPU.

    Steps on a GPU cannot be replayed. The arguments are those of `FailureRecorder`.
    """
    return None if config is None or env.engine.replayable is None else FailureRecorder(env, config, folder, step)
