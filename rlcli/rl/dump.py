"""Dumps: the engine calls that led to a divergence, in one file that a replay steps again bit by bit.

A file is safetensors with a JSON document in its header, as a recording's. Of each environment it holds the integration
states that its last engine calls began with, the state after the last one, and the model fields of its own. The model
is that of the task, as installed, with the configuration that the file holds.
"""

from __future__ import annotations

import itertools
import json
import shlex
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

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
from rlcli.rl.recording import content_digest
from rlcli.sim.batch import BatchEngine
from rlcli.sim.engine import Engine, open_engine
from rlcli.sim.guard import FIELD_OF, SHOWN, Call, Divergence

FORMAT = 1
KIND = "dump"
CALLS = 64
"""Engine calls that a dump holds of an environment, where memory allows."""
_LARGEST = 2**28
"""Bytes of a file that is read."""


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Where(_Strict):
    """The physics step in which an environment went wrong, and what showed it."""

    call: int = Field(ge=0)
    """Number of the engine call in the dump."""
    substep: int = Field(ge=0)
    """Physics step of that call, counted from 0."""
    time: float
    """Simulated time at its beginning [s]."""
    cause: str
    """As `rlcli.sim.guard.Divergence`."""
    place: str
    """The joint, actuator or element."""
    value: str
    """What was found there, as Python writes it: `nan`, `1e+30`."""

    def __str__(self) -> str:
        """One line."""
        what = f"{self.place} = {self.value}" if self.value else self.place
        return f"{self.cause} in physics step {self.substep} of call {self.call}, t = {self.time:.6g} s: {what}"


class Life(_Strict):
    """One environment of a dump."""

    env: int = Field(ge=0)
    """Environment of the run."""
    cause: str
    """What the guard called it."""
    detail: str
    """Where, as the guard saw it."""
    nstep: list[Annotated[int, Field(ge=1, le=1000)]] = Field(min_length=1, max_length=CALLS + 1)
    """Physics steps of each engine call."""
    follows: list[bool]
    """Of each call but the first: whether it began exactly where the one before ended, controls and forces aside; else
    an event wrote the state in between."""
    first: int = Field(ge=0)
    """The engine call that begins the environment step that went wrong."""
    where: Where | None
    """None where a single world shows nothing: then the cause lies outside of what is kept."""


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
        env.on_divergence = self

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
        env.on_divergence = None
        env.engine.remember(1)
        self._tell(said)


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
    lives, tensors = [], {}
    for number, divergence in enumerate(found[:SHOWN]):
        calls, after = engine.trace(divergence.env), engine.row(divergence.env)
        own = {name: torch.from_numpy(np.atleast_1d(v)) for name, v in engine.own_model(divergence.env).items()}
        world = _world(engine.model, env.resolved, own, engine.follows_constants)
        if pending:
            calls = [*calls, Call(after, env.config.decimation)]
            after = _step(world, calls[-1])
        first = max(0, len(calls) - (1 if pending else env.calls_per_step))
        lives.append(
            Life(
                env=divergence.env,
                cause=divergence.cause,
                detail=divergence.detail,
                nstep=[call.nstep for call in calls],
                follows=[_follows(world, *pair) for pair in itertools.pairwise(calls)],
                first=first,
                where=_locate(world, calls, first),
            )
        )
        tensors[f"{number}.state"] = torch.from_numpy(np.stack([call.state for call in calls]))
        tensors[f"{number}.after"] = torch.from_numpy(after)
        tensors |= {f"{number}.model.{name}": values for name, values in own.items()}
    document = Document(
        format=FORMAT,
        kind=KIND,
        rlcli=rlcli.__version__,
        mujoco=mujoco.__version__,
        task=env.resolved.source.record(),
        config=to_yaml(to_data(env.resolved)),
        model=model_digest(engine.model),
        constants=engine.follows_constants,
        num_envs=env.num_envs,
        step=env.common_step,
        lives=lives,
    ).model_dump(mode="json")
    document["sha256"] = content_digest(tensors, document)
    file = folder / f"step-{env.common_step:012d}.safetensors"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from error
    write_atomic(file, safetensors.torch.save(tensors, metadata={"rlcli": json.dumps(document)}))
    return file


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
        )
        if not fits:
            raise CheckpointError(f"{file} is corrupt: its states are not those of its engine calls")
    return Dump(file, document, tensors)


def replay_dump(dump: Dump, named: TaskSource | None = None) -> Replay:
    """Step every engine call of a dump again, and compare every state that must come out, bit by bit.

    Raises:
        TaskError: if the task is not installed any more.
        ConfigError: if the installed one does not take the dump's configuration.
        CheckpointError: if the states or model fields do not fit it.
    """
    resolved = dump.resolved(named)
    env = make_env(resolved)
    model = env.engine.model
    env.close()
    calls = compared = 0
    where: dict[int, Where | None] = {}
    same = model_digest(model) == dump.document.model
    for number, life in enumerate(dump.document.lives):
        prefix = f"{number}.model."
        own = {n.removeprefix(prefix): v for n, v in dump.tensors.items() if n.startswith(prefix)}
        states, after = dump.tensors[f"{number}.state"].numpy(), dump.tensors[f"{number}.after"].numpy()
        try:
            world = _world(model, resolved, own, dump.document.constants)
            if world.row(0).shape != after.shape:
                raise ValueError(f"a state has {len(after)} numbers, the model's {len(world.row(0))}")
        except (ValueError, RuntimeError) as error:
            raise CheckpointError(
                f"{dump.file} does not fit the installed task: {' '.join(str(error).split())}",
                hint=f"install the version that made it: {dump.document.task}",
            ) from None
        steps = [Call(state, nstep) for state, nstep in zip(states, life.nstep, strict=True)]
        for index, call in enumerate(steps):
            now = _step(world, call)
            calls += 1
            last = index == len(steps) - 1
            if not last and not life.follows[index]:
                continue
            compared += 1
            difference = _differs(world, after if last else steps[index + 1].state, now, whole=last)
            if difference is not None:
                field, recorded, replayed = difference
                where[life.env] = _locate(world, steps, life.first)
                different = Difference(life.env, index, field, recorded, replayed)
                return Replay(calls, compared, different, where, same)
        where[life.env] = _locate(world, steps, life.first)
    return Replay(calls, compared, None, where, same)


def _world(model: mujoco.MjModel, resolved: Resolved, own: Mapping[str, Tensor], constants: bool) -> BatchEngine:
    """One world of the model, with model fields of its own."""
    config = resolved.task.sim.model_copy(update={"engine": "batch", "engine_threads": 1})
    world: Engine = open_engine(model, 1, config)
    assert isinstance(world, BatchEngine)
    for name, values in own.items():
        world.take_model(name, values.reshape(world.expand(name).shape))
    if constants:
        world.set_constants()
    return world


def _step(world: BatchEngine, call: Call) -> np.ndarray:
    """The state after a call."""
    world.put(0, call.state)
    world.step(call.nstep)
    world.diverged()
    return world.row(0)


def _follows(world: BatchEngine, call: Call, following: Call) -> bool:
    return _differs(world, following.state, _step(world, call), whole=False) is None


def _differs(
    world: BatchEngine, recorded: np.ndarray, now: np.ndarray, *, whole: bool
) -> tuple[str, list[float], list[float]] | None:
    """The first field whose bits differ: of all, or of those that only physics writes."""
    for name, columns in world.state_layout.fields():
        if whole or name in ("time", "qpos", "qvel", "act", "qacc_warmstart"):
            left, right = recorded[columns], now[columns]
            if left.tobytes() != right.tobytes():
                return name, left.tolist(), right.tolist()
    return None


def _locate(world: BatchEngine, calls: list[Call], first: int) -> Where | None:
    """The first physics step that goes wrong, from a call on."""
    layout = world.state_layout
    for number, call in enumerate(calls[first:], start=first):
        world.put(0, call.state)
        for substep in range(call.nstep):
            before = world.row(0)
            world.step(1)
            if world.diverged() is None:
                continue
            found = world.found[0]
            place, value = _what(world, found, before)
            return Where(
                call=number,
                substep=substep,
                time=float(before[layout.columns("time")][0]),
                cause=found.cause,
                place=place,
                value=value,
            )
    return None


def _what(world: BatchEngine, found: Divergence, before: np.ndarray) -> tuple[str, str]:
    """The element that a divergence showed itself at, and its value."""
    layout, field = world.state_layout, FIELD_OF.get(found.cause)
    if field is None:
        name = found.cause.removesuffix(" not finite")
        values = world.own_model(0).get(name)
        if values is None and name in dict(layout.fields()):
            values = world.row(0)[layout.columns(name)]
        if values is None:
            return found.detail, ""
        flat = np.asarray(values).flatten()
        index = int((~np.isfinite(flat)).argmax())
        return f"{name}[{index}]", repr(float(flat[index]))
    if field == "qacc":
        world.put(0, before)
        _, data = world.world(0)
        values = data.qacc
    else:
        values = before[layout.columns(field)]
    value = f"{field} {float(values[found.index])!r}" if 0 <= found.index < len(values) else ""
    return found.detail, value
