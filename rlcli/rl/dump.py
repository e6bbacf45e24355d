"""Dumps: the engine calls that led to a divergence or to an episode's end, in one file that a replay steps again.

A file is safetensors with a JSON document in its header, as a recording's. Of each environment it holds the integration
states that its last engine calls began with, the state after the last one, and the model fields of its own. The model
is that of the task, as installed, with the configuration that the file holds. What the policy saw and did and what it
was paid in these steps is there of an episode that training kept (`rlcli.rl.autopsy`).
"""

from __future__ import annotations

import itertools
import json
import shlex
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import mujoco
import numpy as np
import safetensors.torch
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError, safe_open
from torch import Tensor

import rlcli
from rlcli.config.dump import to_data, to_yaml
from rlcli.config.load import Resolved, resolve
from rlcli.envs.vec_env import VecEnv, make_env
from rlcli.errors import CheckpointError, MachineError
from rlcli.registry import TaskSource
from rlcli.rl.environment import model_digest
from rlcli.rl.files import disk_error, write_atomic
from rlcli.rl.load import recorded_task
from rlcli.rl.recording import check_task, content_digest
from rlcli.rl.resimulation import Where, differs, follows, locate, open_world, step
from rlcli.sim.batch import BatchEngine
from rlcli.sim.guard import SHOWN, Call, Divergence

FORMAT = 1
KIND = "dump"
CALLS = 64
"""Engine calls that the dump of a divergence holds of an environment, where memory allows."""
MOST_SUBSTEPS = 300_000
"""Physics steps of a file that is stepped again."""
_LARGEST = 2**28
"""Bytes of a file that is read."""
_MOST = 2**53
"""Of whatever is counted."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Life(_Strict):
    """One environment of a dump."""

    env: int = Field(ge=0, le=_MOST)
    """Environment of the run."""
    cause: str
    """What the guard called it."""
    detail: str
    """Where, as the guard saw it."""
    nstep: list[Annotated[int, Field(ge=1, le=1000)]] = Field(min_length=1, max_length=MOST_SUBSTEPS)
    """Physics steps of each engine call."""
    follows: list[bool]
    """Of each call but the first: whether it began exactly where the one before ended, controls and forces aside; else
    an event wrote the state in between."""
    first: int = Field(ge=0)
    """The engine call that begins the environment step that went wrong."""
    where: Where | None
    """None where a single world shows nothing: then the cause lies outside of what is kept."""


Kind = Literal["diverged", "low return", "high return", "terminated"]
"""Why an episode was kept."""


class Ending(_Strict):
    """An episode that training kept the end of."""

    iteration: int = Field(ge=1, le=_MOST)
    """Iteration of the run in which it ended."""
    step: int = Field(ge=0, le=_MOST)
    """Environment steps of the run after that iteration."""
    episode: int = Field(ge=0, le=_MOST)
    """Number of the environment's episode."""
    length: int = Field(ge=1, le=_MOST)
    """Environment steps of all of it."""
    total_reward: float
    """Undiscounted sum of all of it."""
    causes: list[str]
    """Terminations that fired at its end."""
    truncated: bool
    """Ended by time alone."""
    kind: Kind
    """Why it was kept."""
    usual: tuple[float, float] | None
    """Quartiles of the returns of the episodes before; None where they were too few."""
    step_dt: float = Field(gt=0, le=1e6)
    """Control period [s]."""
    observations: list[str]
    """Columns of what the policy saw."""
    actions: list[str]
    """Columns of its actions."""
    reward_terms: list[str]
    """Terms of the reward."""


class Document(_Strict):
    """The header of a dump."""

    format: int
    kind: str
    rlcli: str
    mujoco: str
    task: dict[str, str | None]
    config: str
    model: str
    """Digest of the compiled model."""
    constants: bool
    """Whether constants follow the model fields of each environment's own."""
    num_envs: int
    step: int
    """Environment steps of the run before the one that went wrong."""
    lives: list[Life] = Field(min_length=1, max_length=SHOWN)
    ending: Ending | None = None
    """Of the one environment of a kept episode; None in the dump of a divergence."""


@dataclass(frozen=True, slots=True)
class Dump:
    """A dump that was read and is what was written."""

    file: Path
    document: Document
    tensors: dict[str, Tensor]

    def resolved(self, named: TaskSource | None = None) -> Resolved:
        """The configuration of the run, for one environment, with the task's code and models as installed.

        Args:
            named: see `Recording.resolved`.

        Raises:
            TaskError: if the task is not installed any more.
            CheckpointError: if it is code that the user never named.
            ConfigError: if the installed one does not take this configuration.
        """
        source = recorded_task(self.document.task, f"the task of {self.file}", named=named)
        with tempfile.TemporaryDirectory() as folder:
            config = Path(folder) / "task.yaml"
            config.write_text(self.document.config)
            return resolve(replace(source, config=config), flags={"scene.num_envs": 1})


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where a replay and its dump part."""

    env: int
    call: int
    field: str
    recorded: list[float]
    replayed: list[float]


@dataclass(frozen=True, slots=True)
class Replay:
    """What came of stepping a dump again."""

    calls: int
    """Engine calls that were stepped."""
    compared: int
    """States that were compared bit by bit."""
    difference: Difference | None
    where: dict[int, Where | None]
    """Environment -> where it went wrong now."""
    same_model: bool
    """Whether the installed task's model is the dumped one."""


class Watch:
    """Tells of the first divergence of an environment, once, and writes the dump of it.

    Args:
        env: the environment; it keeps its last engine calls from now on.
        folder: where the dump goes; made when there is one.
        tell: takes what the user should read.
    """

    def __init__(self, env: VecEnv, folder: Path, tell: Callable[[str], None]) -> None:
        self._env, self._folder, self._tell = env, folder, tell
        env.engine.remember(CALLS)
        env.on_divergence.append(self)

    def __call__(self, found: list[Divergence], pending: bool) -> None:
        """Called by the environment, with what it found and whether the next engine call is the one to go wrong."""
        if not found:
            return
        env = self._env
        said = (
            f"the simulation diverged for the first time, in step {env.common_step + 1}: {found[0]}; its episode ends"
        )
        if env.engine.asynchronous:
            said += "; there is no dump: what a GPU computes cannot be replayed"
        else:
            try:
                file = write_dump(env, found, pending, self._folder)
                said += f"; dump {file}; see rlcli replay {shlex.quote(str(file))}"
            except MachineError as error:
                said += f"; there is no dump: {error.message}"
        env.on_divergence.remove(self)
        if not env.on_divergence:
            env.engine.remember(1)
        self._tell(said)


@dataclass(slots=True)
class Trace:
    """An environment's last engine calls, copied: what is slow is done with it later, elsewhere."""

    env: int
    cause: str
    detail: str
    calls: list[Call]
    after: np.ndarray
    """The state after the last call; or, of a call that is yet to come, before it."""
    own: dict[str, Tensor]
    """Model fields of the environment's own."""
    last: int
    """How many of the calls belong to the last environment step."""
    pending: bool
    """Whether the last call is yet to come."""


def trace(env: VecEnv, found: Divergence, pending: bool) -> Trace:
    """What led to a divergence, as the divergence left the environment; see `write_dump`."""
    engine = env.engine
    assert isinstance(engine, BatchEngine)
    calls, after = engine.trace(found.env), engine.row(found.env)
    if pending:
        calls = [*calls, Call(after, env.config.decimation)]
    own = {name: torch.from_numpy(np.atleast_1d(values)) for name, values in engine.own_model(found.env).items()}
    return Trace(found.env, found.cause, found.detail, calls, after, own, 1 if pending else env.calls_per_step, pending)


class Scene:
    """What the files of one environment have in common: its model and its configuration."""

    def __init__(self, env: VecEnv) -> None:
        self._model, self._resolved, self._num_envs = env.engine.model, env.resolved, env.num_envs
        self._config, self._digest = to_yaml(to_data(env.resolved)), model_digest(env.engine.model)

    def encode(
        self, traces: list[Trace], constants: bool, step: int, kept: tuple[Ending, dict[str, Tensor]] | None = None
    ) -> bytes:
        """The content of a file.

        Args:
            traces: one an environment.
            constants: whether constants follow the model fields of each environment's own.
            step: environment steps of the run before.
            kept: of an episode that was kept, how it ended and the tensors of its last steps.
        """
        lives, tensors = [], {}
        ending, more = kept or (None, {})
        for number, traced in enumerate(traces):
            life, after = self._life(traced, constants, diverged=ending is None or ending.kind == "diverged")
            lives.append(life)
            tensors[f"{number}.state"] = torch.from_numpy(np.stack([call.state for call in traced.calls]))
            tensors[f"{number}.after"] = torch.from_numpy(after)
            tensors |= {f"{number}.model.{name}": values for name, values in traced.own.items()}
        document = Document(
            format=FORMAT,
            kind=KIND,
            rlcli=rlcli.__version__,
            mujoco=mujoco.__version__,
            task=self._resolved.source.record(),
            config=self._config,
            model=self._digest,
            constants=constants,
            num_envs=self._num_envs,
            step=step,
            lives=lives,
            ending=ending,
        ).model_dump(mode="json")
        if ending is None:
            del document["ending"]
        tensors |= more
        document["sha256"] = content_digest(tensors, document)
        return safetensors.torch.save(tensors, metadata={"rlcli": json.dumps(document)})

    def _life(self, traced: Trace, constants: bool, *, diverged: bool) -> tuple[Life, np.ndarray]:
        """What stepping the calls again shows, and the state after the last one."""
        world = open_world(self._model, self._resolved, traced.own, constants)
        calls = traced.calls
        first = max(0, len(calls) - traced.last)
        after = step(world, calls[-1]) if traced.pending else traced.after
        life = Life(
            env=traced.env,
            cause=traced.cause,
            detail=traced.detail,
            nstep=[call.nstep for call in calls],
            follows=[follows(world, *pair) for pair in itertools.pairwise(calls)],
            first=first,
            where=locate(world, calls, first) if diverged else None,
        )
        return life, after


def write_dump(env: VecEnv, found: list[Divergence], pending: bool, folder: Path) -> Path:
    """Write the last engine calls of the environments that were found.

    Args:
        env: the environment, as the divergence left it.
        found: what is to be dumped.
        pending: whether the calls lead to a state that the engine has not stepped yet.
        folder: made if it is not there.

    Raises:
        MachineError: if the disk refuses.
    """
    engine = env.engine
    assert isinstance(engine, BatchEngine)
    traces = [trace(env, divergence, pending) for divergence in found[:SHOWN]]
    for traced in traces:
        traced.calls = traced.calls[-CALLS - 1 :]
    file = folder / f"step-{env.common_step:012d}.safetensors"
    put(file, Scene(env).encode(traces, engine.follows_constants, env.common_step))
    return file


def put(file: Path, content: bytes) -> None:
    """Write a file into a folder that is made if it is not there.

    Raises:
        MachineError: if the disk refuses.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(file.parent, error) from error
    write_atomic(file, content)


def is_dump(file: Path) -> bool:
    """Whether a file says that it is a dump; no more of it than its header is read."""
    if not file.is_file():
        return False  # a pipe would be waited for
    try:
        with safe_open(file, "pt") as opened:
            header = (opened.metadata() or {}).get("rlcli", "")
        document = json.loads(header)
        return isinstance(document, dict) and document.get("kind") == KIND
    except (SafetensorError, OSError, ValueError, RecursionError):
        return False


def read_dump(file: Path) -> Dump:
    """Open a dump.

    Raises:
        CheckpointError: if it is missing, corrupt or of another format.
    """
    try:
        if file.exists() and not file.is_file():
            raise CheckpointError(f"{file} is no plain file")  # a pipe would be waited for
        if file.stat().st_size > _LARGEST:
            raise CheckpointError(f"{file} is too large for a dump: more than {_LARGEST >> 20} MiB")
        with safe_open(file, "pt") as opened:
            header = (opened.metadata() or {}).get("rlcli", "")
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 (not a mapping)
        data = json.loads(header)
        found = data.pop("sha256", None)
        if data.get("format") != FORMAT:
            raise CheckpointError(f"{file} has dump format {data.get('format')}; this rlcli reads {FORMAT}")
        document = Document.model_validate_json(json.dumps(data))
    except FileNotFoundError:
        raise CheckpointError(f"there is no dump {file}") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise CheckpointError(f"{file} is corrupt, or no dump: {place}: {first['msg']}") from None
    except (SafetensorError, OSError, ValueError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{file} is corrupt, or no dump: {' '.join(str(error).split())}") from None
    check_task(file, document.task)
    if found != content_digest(tensors, data):
        raise CheckpointError(f"{file} is corrupt: it is not what was written")
    for number, life in enumerate(document.lives):
        state, after = tensors.get(f"{number}.state"), tensors.get(f"{number}.after")
        fits = (
            state is not None
            and after is not None
            and state.dtype == after.dtype == torch.float64
            and state.dim() == 2
            and after.shape == state.shape[1:]
            and len(state) == len(life.nstep) == len(life.follows) + 1
            and life.first < len(state)
        )
        if not fits:
            raise CheckpointError(f"{file} is corrupt: its states are not those of its engine calls")
    if sum(count for life in document.lives for count in life.nstep) > MOST_SUBSTEPS:
        raise CheckpointError(f"{file} is not stepped again: it has more than {MOST_SUBSTEPS} physics steps")
    if document.ending is not None:
        _check_ending(file, document, document.ending, tensors)
    return Dump(file, document, tensors)


def _check_ending(file: Path, document: Document, ending: Ending, tensors: Mapping[str, Tensor]) -> None:
    """The steps of a kept episode are there, as many of everything."""
    rewards = tensors.get("0.reward")
    count = 0 if rewards is None or rewards.dim() != 1 else len(rewards)
    widths = {"obs": ending.observations, "action": ending.actions, "reward_terms": ending.reward_terms}
    shapes = {f"0.{name}": (count, len(columns)) for name, columns in widths.items()} | {"0.reward": (count,)}
    found = {name: (tuple(tensors[name].shape), tensors[name].dtype) for name in shapes if name in tensors}
    whole = len(document.lives) == 1 and 1 <= count <= ending.length
    if not whole or document.lives[0].first < count - 1 or document.lives[0].first % max(1, count - 1):
        raise CheckpointError(f"{file} is corrupt: it does not hold the end of one episode")
    for name, shape in shapes.items():
        if found.get(name) != (shape, torch.float32):
            raise CheckpointError(f"{file} is corrupt: its {name[2:]} is not that of its steps")


@dataclass(frozen=True, slots=True)
class Staged:
    """A dump with worlds of the installed task to step it in."""

    resolved: Resolved
    model: mujoco.MjModel
    same_model: bool
    worlds: list[tuple[Life, BatchEngine, list[Call], np.ndarray]]
    """Of each environment the world, its calls, and the state after the last one."""


def stage(dump: Dump, named: TaskSource | None = None) -> Staged:
    """Build the task of a dump, and a world for each of its environments.

    Raises:
        TaskError: if the task is not installed any more.
        ConfigError: if the installed one does not take the dump's configuration.
        CheckpointError: if the states or model fields do not fit it.
    """
    resolved = dump.resolved(named)
    env = make_env(resolved)
    model = env.engine.model
    env.close()
    worlds = []
    for number, life in enumerate(dump.document.lives):
        prefix = f"{number}.model."
        own = {n.removeprefix(prefix): v for n, v in dump.tensors.items() if n.startswith(prefix)}
        states, after = dump.tensors[f"{number}.state"].numpy(), dump.tensors[f"{number}.after"].numpy()
        try:
            world = open_world(model, resolved, own, dump.document.constants)
            if world.row(0).shape != after.shape:
                raise ValueError(f"a state has {len(after)} numbers, the model's {len(world.row(0))}")
        except (ValueError, RuntimeError) as error:
            raise CheckpointError(
                f"{dump.file} does not fit the installed task: {' '.join(str(error).split())}",
                hint=f"install the version that made it: {dump.document.task}",
            ) from None
        calls = [Call(state, nstep) for state, nstep in zip(states, life.nstep, strict=True)]
        worlds.append((life, world, calls, after))
    return Staged(resolved, model, model_digest(model) == dump.document.model, worlds)


def replay_dump(dump: Dump, named: TaskSource | None = None) -> Replay:
    """Step every engine call of a dump again, and compare every state that must come out, bit by bit.

    Raises:
        CheckpointError, ConfigError, TaskError: see `stage`.
    """
    staged, ending = stage(dump, named), dump.document.ending
    calls = compared = 0
    where: dict[int, Where | None] = {}
    for life, world, steps, after in staged.worlds:
        for index, call in enumerate(steps):
            now = step(world, call)
            calls += 1
            last = index == len(steps) - 1
            if not last and not life.follows[index]:
                continue
            compared += 1
            difference = differs(world, after if last else steps[index + 1].state, now, whole=last)
            if difference is not None:
                field, recorded, replayed = difference
                where[life.env] = locate(world, steps, life.first)
                different = Difference(life.env, index, field, recorded, replayed)
                return Replay(calls, compared, different, where, staged.same_model)
        went_wrong = ending is None or ending.kind == "diverged"
        where[life.env] = locate(world, steps, life.first) if went_wrong else None
    return Replay(calls, compared, None, where, staged.same_model)
