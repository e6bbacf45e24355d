"""What training keeps of episodes that ended badly or unlike the others: their last seconds, for `rlcli autopsy`.

While training steps, the last seconds of all environments lie in rings in memory: the states that the engine's calls
began with (`rlcli.sim.guard.History`), what the policy saw and did, and what it was paid. Of the episodes that end in
an iteration one of every kind is copied out: the worst that a termination ended, the one whose return is farthest from
the others', the first that diverged. They become files with the next checkpoint, in the thread that writes it; what
has come later than a checkpoint is gone when training goes on from there, and comes again.

Nothing of it draws, and nothing writes to the environment: training is the same to the bit.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import AutopsyConfig
from rlcli.envs.layout import TermLayout
from rlcli.envs.step import Episodes, Lived
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError, RlcliError
from rlcli.managers.termination import DIVERGED
from rlcli.rl.dump import MOST_SUBSTEPS, Ending, Kind, Scene, Trace, put, read_dump, trace
from rlcli.rl.files import to_json
from rlcli.rl.reading import parse_json, read_file
from rlcli.sim.batch import BatchEngine
from rlcli.sim.guard import Divergence

FOLDER = "autopsy"
"""In a run."""
NAME = re.compile(r"(\d{12,15})-env-(\d{6,12})-episode-(\d{6,15})\.safetensors")
"""Environment steps of the run, environment, episode."""
RECENT = 1024
"""Returns of finished episodes that the next ones are compared with."""
LEAST = 64
"""Returns without which nothing is called unusual."""
FAR = 3.0
"""How many interquartile ranges beyond the quartiles a return is unusual (Tukey's outer fences)."""
_RETURNS = "recent.json"
_SLACK = 32
"""Steps after which ended episodes are looked at, at the latest: the rings are longer by as many."""
_SPREAD = 1e-3
"""Least interquartile range, as a share of the quartiles: alike to three digits is not unusual."""


@dataclass(slots=True)
class _Ended:
    """The episodes that ended in a step, and what is overwritten after it."""

    step: int
    calls: int
    """Calls of the engine until then."""
    ids: np.ndarray
    episodes: np.ndarray
    lengths: np.ndarray
    returns: np.ndarray
    truncated: np.ndarray
    causes: dict[str, np.ndarray]
    states: np.ndarray
    own: dict[str, np.ndarray]

    def at(self, row: int) -> dict[str, Any]:
        """Of one of them, the facts that do not depend on when it is written."""
        return {
            "episode": int(self.episodes[row]),
            "length": int(self.lengths[row]),
            "total_reward": float(self.returns[row]),
            "causes": [name for name, fired in self.causes.items() if fired[row]],
            "truncated": bool(self.truncated[row]),
        }


@dataclass(slots=True)
class _Case:
    """An episode that is kept."""

    kind: Kind
    traced: Trace
    facts: dict[str, Any]
    steps: dict[str, Tensor]
    constants: bool
    common_step: int


@dataclass(slots=True)
class _Entry:
    """A file of the folder, or one to be."""

    name: str
    kind: str
    case: _Case | None
    """None: it is on the disk."""
    ending: Ending | None = None


class Candidate(NamedTuple):
    """The most remarkable episode of its kind, so far in this iteration."""

    value: float
    """Less is more remarkable."""
    case: _Case


@dataclass(slots=True)
class Batch:
    """What goes to the disk with a checkpoint."""

    step: int
    write: list[_Entry]
    remove: list[str]
    returns: list[float]


class Keeper:
    """Watches the environment of a training, on a CPU.

    Args:
        env: the environment; it notes its last seconds from now on.
        config: how much is kept.
        folder: of the run; files go to `autopsy` in it.
        step: environment steps of the checkpoint that training goes on from; None: it begins.
        tell: takes what the user should read.
    """

    def __init__(
        self, env: VecEnv, config: AutopsyConfig, folder: Path, step: int | None, tell: Callable[[str], None]
    ) -> None:
        assert isinstance(env.engine, BatchEngine)
        self._env, self._engine, self._keep, self._tell = env, env.engine, config.keep, tell
        self._folder = folder / FOLDER
        self._scene: Scene | None = None
        self._columns: dict[str, Any] = {
            "observations": _names(env.layout.observations["policy"]),
            "actions": _names(env.layout.actions),
            "reward_terms": env.reward_names,
        }
        self._most, self._slack = self._room(config)
        slots, n = self._most + self._slack, env.num_envs
        widths = {"obs": env.layout.size(), "action": env.layout.action_size}
        self._rings = {name: np.empty((slots, n, width), np.float32) for name, width in widths.items()}
        self._rings["reward"] = np.empty((slots, n), np.float32)
        self._rings["reward_terms"] = np.empty((slots, len(env.reward_names), n), np.float32)
        self._step = 0
        self._ended: list[_Ended] = []
        self._diverging: dict[int, Trace] = {}
        self._pending: dict[tuple[str, ...], Candidate] = {}
        self._returns: list[np.ndarray] = []
        self._recent = np.zeros(0)
        self._usual: tuple[float, float] | None = None
        self._entries: list[_Entry] = []
        self._written: set[str] = set()
        self._failed = ""
        self._take_over(step)
        steps = sum(ring.nbytes for ring in self._rings.values())
        env.engine.remember(slots * env.calls_per_step, max(0, (config.memory_mib << 20) - steps))
        env.on_divergence.append(self._on_divergence)
        env.on_lived = self._on_lived

    @property
    def seconds(self) -> float:
        """How much of an episode's end is kept [s]."""
        return min(self._most, self._engine.history.calls // self._env.calls_per_step) * self._env.step_dt

    def close(self) -> None:
        """Watch no more."""
        self._env.on_lived = None
        if self._on_divergence in self._env.on_divergence:
            self._env.on_divergence.remove(self._on_divergence)
        if not self._env.on_divergence:
            self._engine.remember(1)

    # --- between iterations ---

    def commit(self, iteration: int, step: int) -> None:
        """Keep what an iteration brought: it is the boundary after it, with so many environment steps."""
        if self._failed:
            self._tell(f"ends of episodes are not kept any more: {self._failed}")
            self._failed = ""
            self.close()
        self._harvest()
        known = {entry.name for entry in self._entries}
        for _, case in self._pending.values():
            env, episode = case.traced.env, case.facts["episode"]
            name = f"{step:012d}-env-{env:06d}-episode-{episode:06d}.safetensors"
            if name in known:
                continue
            known.add(name)
            ending = Ending(
                iteration=iteration,
                step=step,
                kind=case.kind,
                usual=self._usual,
                step_dt=self._env.step_dt,
                **case.facts,
                **self._columns,
            )
            self._entries.append(_Entry(name, case.kind, case, ending))
        self._pending.clear()
        self._entries.sort(key=lambda entry: entry.name)  # as a folder is read: a resumed run makes room alike
        self._evict()
        self._learn()

    def take(self, step: int) -> Batch:
        """What is to be written with the checkpoint of such a step."""
        fresh = [entry for entry in self._entries if entry.name not in self._written]
        names = {entry.name for entry in self._entries}
        written = [replace(entry) for entry in fresh]
        batch = Batch(step, written, sorted(self._written - names), self._recent.tolist())
        for entry in fresh:
            entry.case = None
        self._written = names
        return batch

    def write(self, batch: Batch) -> None:
        """Write files; a disk that refuses ends the keeping and not the training. In the thread of the checkpoints."""
        try:
            if batch.write and self._scene is None:
                self._scene = Scene(self._env)
            for entry in batch.write:
                case = entry.case
                assert case is not None
                assert entry.ending is not None
                assert self._scene is not None
                kept = (entry.ending, case.steps)
                content = self._scene.encode([case.traced], case.constants, case.common_step, kept)
                put(self._folder / entry.name, content)
            if batch.returns:  # what the next episodes are compared with, also where none was kept yet
                put(self._folder / _RETURNS, to_json({"step": batch.step, "returns": batch.returns}).encode())
        except (RlcliError, OSError) as error:
            self._failed = str(error)

    def drop(self, batch: Batch) -> None:
        """Remove files that others have taken the place of."""
        for name in batch.remove:
            with contextlib.suppress(OSError):
                (self._folder / name).unlink(missing_ok=True)

    # --- in a step ---

    def _on_divergence(self, found: list[Divergence], pending: bool) -> None:
        for divergence in found:
            if ("diverged", divergence.cause) not in self._pending:
                self._diverging[divergence.env] = trace(self._env, divergence, pending)

    def _on_lived(self, lived: Lived) -> None:
        slot = self._step % len(self._rings["reward"])
        for name, value in (
            ("obs", lived.obs["policy"]),
            ("action", lived.action),
            ("reward", lived.reward),
            ("reward_terms", lived.reward_terms),
        ):
            np.copyto(self._rings[name][slot], value.detach().numpy())
        self._step += 1
        if lived.episodes is not None:
            self._ended.append(self._note(lived.episodes))
            if self._diverging:
                self._keep_diverged(self._ended[-1])
        self._diverging.clear()
        if self._ended and self._step - self._ended[0].step >= self._patience():
            self._harvest()

    def _patience(self) -> int:
        """Steps that ended episodes may wait: states that were wider than was known leave fewer."""
        return min(self._slack, max(1, self._engine.history.calls // self._env.calls_per_step // 4))

    def _note(self, episodes: Episodes) -> _Ended:
        ids = episodes.ids.numpy().copy()
        own = {name: self._engine.expand(name).numpy()[ids] for name in self._engine.expansions()}
        return _Ended(
            self._step,
            self._engine.history.count,
            ids,
            self._env.episode_index.numpy()[ids] - 1,
            episodes.lengths.numpy().copy(),
            episodes.returns.detach().numpy().copy(),
            episodes.truncated.numpy().copy(),
            {name: fired.numpy().copy() for name, fired in episodes.causes.items()},
            self._engine.rows(ids),
            own,
        )

    # --- which are kept ---

    def _keep_diverged(self, ended: _Ended) -> None:
        for row, env in enumerate(ended.ids.tolist()):
            traced = self._diverging.get(env)
            key = ("diverged", traced.cause if traced else "")
            if traced is None or key in self._pending:
                continue
            steps = min(int(ended.lengths[row]), self._most)
            per_step = self._env.calls_per_step
            whole = (len(traced.calls) - traced.last) // per_step
            steps = min(steps, whole + 1)
            traced.calls = traced.calls[-((steps - 1) * per_step + traced.last) :]
            self._keep_case(key, 0.0, "diverged", traced, ended, row, steps)

    def _harvest(self) -> None:
        """Look at the episodes that have ended since the last time, in the order in which they did."""
        for ended in self._ended:
            self._returns.append(ended.returns)
            low, high = self._fences()
            diverged = ended.causes.get(DIVERGED)
            judged = np.ones(len(ended.ids), bool) if diverged is None else ~diverged
            rest = judged
            unusual: list[tuple[Kind, np.ndarray, np.ndarray]] = [
                ("low return", ended.returns, ended.returns < low),
                ("high return", -ended.returns, ended.returns > high),
            ]
            for kind, value, mask in unusual:
                self._consider((kind,), kind, value, mask & judged, ended)
                rest = rest & ~mask
            self._consider_terminated(rest & ~ended.truncated, ended)
        self._ended.clear()

    def _consider_terminated(self, mask: np.ndarray, ended: _Ended) -> None:
        if not mask.any():
            return
        names = list(ended.causes)
        code = np.zeros(len(mask), np.int64)
        for number, fired in enumerate(ended.causes.values()):
            code |= fired.astype(np.int64) << (number % 62)
        for value in np.unique(code[mask]).tolist():
            key = ("terminated", *(name for number, name in enumerate(names) if value >> (number % 62) & 1))
            self._consider(key, "terminated", ended.returns, mask & (code == value), ended)

    def _consider(self, key: tuple[str, ...], kind: Kind, value: np.ndarray, mask: np.ndarray, ended: _Ended) -> None:
        if not mask.any():
            return
        row = int(np.where(mask, value, np.inf).argmin())
        before = self._pending.get(key)
        if before is not None and not value[row] < before.value:
            return
        if before is None and len(self._pending) >= self._keep:
            return
        steps, per_step = min(int(ended.lengths[row]), self._most), self._env.calls_per_step
        env = int(ended.ids[row])
        calls = self._engine.history.between(env, ended.calls - steps * per_step, ended.calls)
        steps = min(steps, len(calls) // per_step, ended.step)
        if steps == 0:
            return
        own = {name: torch.from_numpy(np.atleast_1d(values[row])) for name, values in ended.own.items()}
        traced = Trace(env, kind, "", calls[-steps * per_step :], ended.states[row], own, per_step, pending=False)
        self._keep_case(key, float(value[row]), kind, traced, ended, row, steps)

    def _keep_case(
        self, key: tuple[str, ...], value: float, kind: Kind, traced: Trace, ended: _Ended, row: int, steps: int
    ) -> None:
        slots = np.arange(ended.step - steps, ended.step) % len(self._rings["reward"])
        rings, env = self._rings, traced.env
        tensors = {
            "0.obs": rings["obs"][slots, env],
            "0.action": rings["action"][slots, env],
            "0.reward": rings["reward"][slots, env],
            "0.reward_terms": rings["reward_terms"][slots, :, env],
        }
        case = _Case(
            kind,
            traced,
            ended.at(row),
            {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in tensors.items()},
            self._engine.follows_constants,
            self._env.common_step,
        )
        self._pending[key] = Candidate(value, case)

    def _fences(self) -> tuple[float, float]:
        """Returns beyond which an episode is unlike the others."""
        if self._usual is None:
            return -np.inf, np.inf
        first, third = self._usual
        spread = max(third - first, _SPREAD * max(abs(first), abs(third)))
        return first - FAR * spread, third + FAR * spread

    def _learn(self) -> None:
        """The next iteration's episodes are compared with these."""
        if self._returns:
            self._recent = np.concatenate([self._recent, *self._returns])[-RECENT:]
            self._returns.clear()
        if len(self._recent) >= LEAST:
            first, third = np.quantile(self._recent, [0.25, 0.75]).tolist()
            self._usual = (first, third)

    def _evict(self) -> None:
        """Make room: of the kind that has the most, the oldest goes."""
        while len(self._entries) > self._keep:
            counts = Counter(entry.kind for entry in self._entries)
            most = max(counts.values())
            oldest = next(i for i, entry in enumerate(self._entries) if counts[entry.kind] == most)
            del self._entries[oldest]

    # --- where it begins ---

    def _room(self, config: AutopsyConfig) -> tuple[int, int]:
        """Environment steps that are kept, and further ones until somebody looks; both rings get so many."""
        env, engine = self._env, self._engine
        columns = env.layout.size() + env.layout.action_size + 1 + len(env.reward_names)
        bytes_per_step = env.num_envs * (8 * engine.history.width * env.calls_per_step + 4 * columns)
        fits = max(2, (config.memory_mib << 20) // bytes_per_step)
        most = min(max(1, round(config.seconds / env.step_dt)), max(1, MOST_SUBSTEPS // env.config.decimation - 1))
        slack = min(_SLACK, max(1, fits // 4))
        return max(1, min(most, fits - slack)), slack

    def _take_over(self, step: int | None) -> None:
        """Know the files that are there; those that come after the checkpoint go."""
        if not self._folder.is_dir():
            return
        for file in sorted(self._folder.iterdir()):
            named = NAME.fullmatch(file.name)
            kind = None
            if named is not None and step is not None and int(named[1]) <= step:
                with contextlib.suppress(CheckpointError):
                    ending = read_dump(file).document.ending
                    kind = None if ending is None else ending.kind
            if kind is not None:
                self._entries.append(_Entry(file.name, kind, None))
            elif named is not None:
                file.unlink(missing_ok=True)
        self._written = {entry.name for entry in self._entries}
        if step is not None:
            self._recall(step)
        self._evict()

    def _recall(self, step: int) -> None:
        """The returns that were compared with at a checkpoint, if they are there."""
        try:
            found = parse_json(read_file(self._folder / _RETURNS, 1 << 20), self._folder / _RETURNS)
        except (CheckpointError, FileNotFoundError):
            return
        returns = found.get("returns")
        if found.get("step") != step or not isinstance(returns, list) or len(returns) > RECENT:
            return
        if all(isinstance(value, float) for value in returns):
            self._recent = np.array(returns, dtype=np.float64)
            self._learn()


def open_keeper(
    env: VecEnv, config: AutopsyConfig | None, folder: Path, step: int | None, tell: Callable[[str], None]
) -> Keeper | None:
    """A keeper, if one is wanted and the engine is one whose steps can be stepped again: a GPU's cannot."""
    return None if config is None or env.engine.asynchronous else Keeper(env, config, folder, step, tell)


def _names(terms: tuple[TermLayout, ...]) -> list[str]:
    """The columns of terms: `joint_pos.hip`, `last_action[2]`, or the term's own name where it has one column."""
    names = []
    for term in terms:
        for index in range(term.size):
            if index < len(term.elements):
                names.append(f"{term.name}.{term.elements[index]}")
            else:
                names.append(term.name if term.size == 1 else f"{term.name}[{index}]")
    return names
