"""Recordings: whole episodes with their states and actions, in one file that a replay steps again bit by bit.

A file is safetensors with a JSON document in its header, so that it can be opened without running anybody's code. It
holds the state of all environments where the recording began and every action since, which is what a replay needs,
and of each episode that is kept its states, actions and rewards, which is what a replay compares and a reader wants.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

import rlcli
from rlcli.config.dump import to_data, to_yaml
from rlcli.config.load import Resolved, resolve
from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError, ConfigError
from rlcli.registry import TaskSource
from rlcli.rl.files import write_atomic
from rlcli.rl.load import recorded_task

FORMAT = 1
_STATES = ("qpos", "qvel", "act", "ctrl")


@dataclass(frozen=True, slots=True)
class Episode:
    """One recorded episode."""

    env: int
    """Environment."""
    begin: int
    """Steps of the recording before its first."""
    length: int
    """Environment steps."""
    total_reward: float
    """Undiscounted sum of rewards."""
    truncated: bool
    """Ended by time alone."""
    success: bool | None
    """Met the task's success condition; None where the task has none."""
    causes: list[str]
    """Terminations that fired at its end."""

    @property
    def succeeded(self) -> bool:
        """Whether it counts as a success: of a task that defines none, whether time alone ended it."""
        return self.truncated if self.success is None else self.success


class Recorder:
    """Watches an environment, from its first action on.

    Args:
        env: the environment.
        act: what acts in it.
        episodes: how many to keep; how many each environment contributes is fixed beforehand, as in an evaluation.
        only: the one environment that contributes them; None: all.
    """

    def __init__(self, env: VecEnv, act: Callable[[Tensor], Tensor], episodes: int, *, only: int | None = None) -> None:
        self._env, self._act = env, act
        self._quota = [episodes // env.num_envs + (i < episodes % env.num_envs) for i in range(env.num_envs)]
        if only is not None:
            self._quota = [episodes * (i == only) for i in range(env.num_envs)]
        self._start: dict[str, Tensor] = {}
        self._before: list[dict[str, Tensor]] = []
        self._after: list[dict[str, Tensor]] = []
        self._actions: list[Tensor] = []
        self._rewards: list[Tensor] = []
        self._models: dict[tuple[int, int], dict[str, Tensor]] = {}
        self._began = [0] * env.num_envs
        self.episodes: list[Episode] = []
        """What has been recorded, in the order in which the episodes ended."""

    def __enter__(self) -> Recorder:
        self._env.after_physics = lambda: self._after.append(_state(self._env))
        return self

    def __exit__(self, *_: object) -> None:
        self._env.after_physics = None

    def act(self, obs: Tensor) -> Tensor:
        """The action, noted with the state that it is taken in."""
        if not self._start:
            self._start = self._env.state_dict()
            self._begin(range(self._env.num_envs))
        action = self._act(obs)
        self._before.append(_state(self._env))
        self._actions.append(action.detach().cpu().clone())
        return action

    def on_step(self, step: StepResult) -> None:
        """Note what a step gave."""
        self._rewards.append(step.reward.cpu().clone())
        if step.episodes is None:
            return
        ended = step.episodes.ended()
        ids = ended.ids.tolist()
        for row, env in enumerate(ids):
            if self._quota[env] > 0:
                self._quota[env] -= 1
                self.episodes.append(
                    Episode(
                        env,
                        self._began[env],
                        int(ended.lengths[row]),
                        float(ended.returns[row]),
                        bool(ended.truncated[row]),
                        None if ended.success is None else bool(ended.success[row]),
                        [name for name, fired in ended.causes.items() if bool(fired[row])],
                    )
                )
        self._begin(ids)

    def save(self, file: Path, mode: str = "all") -> list[Path]:
        """Write the episodes that a mode keeps: all, succeeded, failed, or separate (a file for each of the two).

        Returns:
            The files that were written.

        Raises:
            MachineError: if the disk refuses.
        """
        if mode != "separate":
            kept = [e for e in self.episodes if mode == "all" or e.succeeded == (mode == "succeeded")]
            return [self._write(file, kept)]
        files = []
        for word, wanted in (("succeeded", True), ("failed", False)):
            target = file.with_name(f"{file.stem}-{word}{file.suffix}")
            files.append(self._write(target, [e for e in self.episodes if e.succeeded == wanted]))
        return files

    def _begin(self, ids: Iterable[int]) -> None:
        engine = self._env.engine
        fields = {name: engine.expand(name) for name in engine.expansions()}
        for env in ids:
            self._began[env] = len(self._rewards)
            if fields:
                rows = {name: values[env].detach().cpu().clone() for name, values in fields.items()}
                self._models[env, self._began[env]] = rows

    def _write(self, file: Path, episodes: list[Episode]) -> Path:
        last = max((e.begin + e.length for e in episodes), default=0)
        actions = torch.stack(self._actions[:last]) if last else torch.zeros(0, self._env.num_envs, 0)
        tensors = {"session.actions": actions, **{f"session.start.{n}": v.cpu() for n, v in self._start.items()}}
        for number, e in enumerate(episodes):
            steps = range(e.begin, e.begin + e.length)
            for name in _STATES:
                rows = [self._before[e.begin][name][e.env], *(self._after[t][name][e.env] for t in steps)]
                tensors[f"episode.{number}.{name}"] = torch.stack(rows)
            tensors[f"episode.{number}.actions"] = torch.stack([self._actions[t][e.env] for t in steps])
            tensors[f"episode.{number}.rewards"] = torch.stack([self._rewards[t][e.env] for t in steps])
            for name, value in self._models.get((e.env, e.begin), {}).items():
                tensors[f"episode.{number}.model.{name}"] = value
        env = self._env
        document = {
            "format": FORMAT,
            "rlcli": rlcli.__version__,
            "task": env.resolved.source.record(),
            "config": to_yaml(to_data(env.resolved)),
            "device": str(env.device),
            "num_envs": env.num_envs,
            "step_dt": env.step_dt,
            "episodes": [asdict(e) for e in episodes],
        }
        tensors = {name: value.detach().clone().contiguous() for name, value in tensors.items()}
        document["sha256"] = content_digest(tensors, document)
        write_atomic(file, safetensors.torch.save(tensors, metadata={"rlcli": json.dumps(document)}))
        return file


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording that was read and is what was written."""

    file: Path
    document: dict[str, Any]
    tensors: dict[str, Tensor]
    episodes: list[Episode]

    def resolved(self, named: TaskSource | None = None) -> Resolved:
        """The configuration that was recorded, with the task's code and models as installed.

        Args:
            named: the task that the command line names, if it does: of a task that is not installed its code is taken.

        Raises:
            TaskError: if the task is not installed any more.
            CheckpointError: if it is code that the user never named.
            ConfigError: if the installed one does not take this configuration.
        """
        source = recorded_task(self.document["task"], f"the task of {self.file}", named=named)
        with tempfile.TemporaryDirectory() as folder:
            config = Path(folder) / "task.yaml"
            config.write_text(self.document["config"], encoding="utf-8")
            try:
                resolved = resolve(replace(source, config=config))
            except ConfigError as error:
                raise ConfigError(
                    replace(p, where=p.where.replace(str(config), str(self.file))) for p in error.problems
                ) from None
        if resolved.task.scene.num_envs != self.document["num_envs"]:
            raise CheckpointError(f"{self.file} is corrupt: it and its configuration name different environments")
        return resolved

    @property
    def steps(self) -> int:
        """Steps of the recording."""
        return len(self.tensors["session.actions"])


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where a replay and its recording part."""

    episode: int
    step: int
    field: str
    recorded: list[float]
    replayed: list[float]


def read_recording(file: Path) -> Recording:
    """Open a recording.

    Raises:
        CheckpointError: if it is missing, corrupt or of another format.
    """
    try:
        if not file.is_file() and file.exists():
            raise ValueError("it is not a plain file")
        with safe_open(file, "pt") as opened:
            header = (opened.metadata() or {}).get("rlcli")
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 (not a mapping)
        document = json.loads(header) if header is not None else None
    except FileNotFoundError:
        raise CheckpointError(f"there is no recording {file}", hint="rlcli eval TASK --record FILE makes one") from None
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file} is corrupt, or no recording: {' '.join(str(error).split())}") from None
    if not isinstance(document, dict):
        raise CheckpointError(f"{file} is no recording: it has no header of rlcli")
    if document.get("format") != FORMAT:
        raise CheckpointError(f"{file} has recording format {document.get('format')}; this rlcli reads {FORMAT}")
    if document.pop("sha256", None) != content_digest(tensors, document):
        raise CheckpointError(f"{file} is corrupt: it is not what was written")
    _check(file, document, tensors)
    return Recording(file, document, tensors, [Episode(**entry) for entry in document["episodes"]])


def check_task(file: Path, task: Any) -> None:
    """The record of a task names it, and says where it is from.

    Raises:
        CheckpointError: if not.
    """
    task = task if isinstance(task, dict) else {}
    names = [value for value in task.values() if value is not None]
    if not task.get("name") or not all(isinstance(name, str) and name.isprintable() for name in names):
        raise CheckpointError(f"{file} is corrupt: its task is malformed")
    if not (task.get("folder") or task.get("distribution")):
        raise CheckpointError(f"{file} is corrupt: it does not say where the task is from")


def _check(file: Path, document: dict[str, Any], tensors: Mapping[str, Tensor]) -> None:
    """The document has the fields that are read, and its episodes lie within the recording.

    Raises:
        CheckpointError: naming the first that does not.
    """
    check_task(file, document.get("task"))
    episodes = document.get("episodes")
    if not isinstance(document.get("config"), str):
        raise CheckpointError(f"{file} is corrupt: its configuration is malformed")
    actions = tensors.get("session.actions")
    if actions is None or actions.dim() != 3 or document.get("num_envs") != actions.shape[1]:
        raise CheckpointError(f"{file} is corrupt: its actions are not those of its environments")
    steps, envs = actions.shape[:2]
    for number, entry in enumerate(episodes if isinstance(episodes, list) else [None]):
        spans: list[Any] = [entry.get(key) for key in ("env", "begin", "length")] if isinstance(entry, dict) else []
        whole = len(spans) == 3 and all(type(value) is int and value >= 0 for value in spans)
        if not whole or set(entry) != {field.name for field in fields(Episode)}:
            raise CheckpointError(f"{file} is corrupt: its episode {number} is malformed")
        env, begin, length = map(int, spans)
        if env >= envs or begin + length > steps:
            raise CheckpointError(f"{file} is corrupt: its episode {number} does not lie in the recording")
        sizes = {name: length + (name in _STATES) for name in (*_STATES, "actions", "rewards")}
        for name, size in sizes.items():
            tensor = tensors.get(f"episode.{number}.{name}")
            if tensor is None or tensor.dim() < 1 or len(tensor) != size:
                raise CheckpointError(f"{file} is corrupt: the {name} of its episode {number} are not there")


def replay(
    recording: Recording,
    env: VecEnv,
    episodes: Iterable[int],
    on_state: Callable[[int], None] = lambda step: None,
) -> Difference | None:
    """Step the actions again and compare every state and reward of some episodes, bit by bit.

    Args:
        recording: what to replay.
        env: an environment of its configuration.
        episodes: which to compare.
        on_state: called before each step with its number.

    Raises:
        CheckpointError: if the recording does not fit the environment.
    """
    wanted = sorted(episodes)
    spans = {number: recording.episodes[number] for number in wanted}
    start = {
        n.removeprefix("session.start."): v for n, v in recording.tensors.items() if n.startswith("session.start.")
    }
    actions = recording.tensors["session.actions"]
    now: list[dict[str, Tensor]] = []
    try:
        env.load_state_dict(start)
    except (KeyError, RuntimeError, ValueError) as error:
        raise CheckpointError(
            f"{recording.file} does not fit the installed task: {' '.join(str(error).split())}",
            hint=f"install the version that made it: {recording.document['task']}",
        ) from None
    env.after_physics = lambda: now.append(_state(env))
    try:
        for t in range(max((e.begin + e.length for e in spans.values()), default=0)):
            on_state(t)
            running = {n: e for n, e in spans.items() if e.begin <= t < e.begin + e.length}
            before = _state(env)
            reward = env.step(actions[t].to(env.device)).reward.cpu()
            after = now.pop()
            for number, e in running.items():
                if t == e.begin and (found := _differs(recording, number, e, 0, before)):
                    return found
                if found := _differs(recording, number, e, t - e.begin + 1, after):
                    return found
                recorded = recording.tensors[f"episode.{number}.rewards"][t - e.begin]
                if not _same(recorded, reward[e.env]):
                    return Difference(number, t - e.begin + 1, "reward", [float(recorded)], [float(reward[e.env])])
    finally:
        env.after_physics = None
    return None


def _differs(
    recording: Recording, number: int, episode: Episode, step: int, state: Mapping[str, Tensor]
) -> Difference | None:
    for name in _STATES:
        recorded, found = recording.tensors[f"episode.{number}.{name}"][step], state[name][episode.env]
        if not _same(recorded, found):
            return Difference(number, step, name, recorded.tolist(), found.tolist())
    return None


def _same(left: Tensor, right: Tensor) -> bool:
    """Whether the bits are equal: a NaN is itself, and 0 is not -0."""
    return left.shape == right.shape and left.numpy().tobytes() == right.numpy().tobytes()


def _state(env: VecEnv) -> dict[str, Tensor]:
    return {name: env.engine.field(name).detach().cpu().clone() for name in _STATES}


def content_digest(tensors: Mapping[str, Tensor], document: Mapping[str, Any]) -> str:
    """sha256 of what a file of tensors and a document holds."""
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.flatten().view(torch.uint8).numpy().data if value.numel() else b"")  # no copy of it
    return digest.hexdigest()
