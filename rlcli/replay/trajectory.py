"""Read and write trajectory files: recorded steps that `rlcli replay` simulates again and compares bit by bit.

A file is in safetensors format with a JSON document under the key `rlcli` of its header; reading a file executes no
code. There are three kinds of files:

- recording: whole episodes of an evaluation. The tensors `start.*` hold the state of all environments at the beginning,
  `actions` every action since then, `episode.K.*` the states, actions and rewards of episode K.
- failure: the last steps of one episode of a training. `episode.0.*` holds observations, actions and rewards,
  `world.0.*` the engine calls (an engine call simulates one or more physics steps).
- crash: the last engine calls of environments whose simulation diverged, in `world.K.*` for the K-th environment.

`world.K.states` holds the integration state at the beginning of each engine call, `world.K.final` the state after the
last one, and `world.K.model.*` the model fields that differ between environments.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import mujoco
import torch
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from safetensors import SafetensorError, safe_open
from torch import Tensor

import rlcli
from rlcli.config.dump import to_data, to_yaml
from rlcli.config.load import Resolved, resolve
from rlcli.envs.environment_protocol import Environment
from rlcli.envs.layout import TermLayout
from rlcli.envs.step_result import Episodes
from rlcli.errors import CheckpointError
from rlcli.registry import TaskSource
from rlcli.runs.atomic_io import disk_errors, write_atomic
from rlcli.runs.provenance import model_digest
from rlcli.runs.recorded_task import recorded_task
from rlcli.runs.safe_io import check_json
from rlcli.runs.tensor_bytes import tensor_bytes
from rlcli.sim.divergence_report import MAX_DESCRIBED

FORMAT = 2
STATE_FIELDS = ("qpos", "qvel", "act", "ctrl")
"""Fields of MuJoCo's state that a recording holds for each step."""
MAX_SUBSTEPS = 300_000
"""Largest number of physics steps in a failure or crash file."""
_MAX_BYTES = 2**28
"""Size limit of failure and crash files; a recording has none."""

Count = Annotated[int, Field(ge=0, le=2**53)]
Kind = Literal["recording", "failure", "crash"]
FailureKind = Literal["diverged", "low return", "high return", "terminated"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Columns(_Strict):
    """Names of the columns of observations, actions and reward terms."""

    observations: list[str]
    actions: list[str]
    reward_terms: list[str]


class Episode(_Strict):
    """Facts about one recorded episode: its environment, length, return and end."""

    env: Count
    """Index of the environment."""
    index: Count
    """Index of the episode in its environment, from 0."""
    begin: Count
    """Index of the first step of the episode in the recording, from 0; 0 in a failure file."""
    length: int = Field(ge=1, le=2**53)
    """Length in environment steps."""
    kept: int = Field(ge=1, le=2**53)
    """Number of steps in the file: the last ones in a failure file, all in a recording."""
    total_reward: float
    """Undiscounted sum of rewards of the whole episode."""
    truncated: bool
    """Whether the episode ended only because of its time limit."""
    success: bool | None
    """Whether the episode met the task's success conditions; None if the task has none."""
    causes: list[str]
    """Names of the terminations that ended the episode."""

    @staticmethod
    def of(env: Environment, ended: Episodes, row: int, begin: int = 0, kept: int | None = None) -> Episode:
        """Return the facts about an episode that ends in the current step; call it before the environment is reset.

        Args:
            env: the environments.
            ended: the episodes that end in this step.
            row: the row of the episode in `ended`.
            begin: index of the first step of the episode in the recording, from 0.
            kept: number of steps of the episode in the file; None: all.
        """
        number, length = int(ended.ids[row]), int(ended.lengths[row])
        return Episode(
            env=number,
            index=int(env.episode_index[number]) - 1,
            begin=begin,
            length=length,
            kept=length if kept is None else kept,
            total_reward=float(ended.returns[row]),
            truncated=bool(ended.truncated[row]),
            success=None if ended.success is None else bool(ended.success[row]),
            causes=[name for name, fired in ended.causes.items() if bool(fired[row])],
        )

    @property
    def succeeded(self) -> bool:
        """Whether the episode met the success conditions; in a task without them, whether it ended by a time-out."""
        return self.truncated if self.success is None else self.success


class DivergencePoint(_Strict):
    """The physics step in which a simulation diverged, and the value that showed it."""

    call: Count
    """Index of the engine call in the file, from 0."""
    substep: Count
    """Index of the physics step in that call, from 0."""
    time: float
    """Simulated time at the beginning of the physics step [s]."""
    cause: str
    """The cause, such as MuJoCo's warning `BADQACC` or `qpos not finite`."""
    place: str
    """The joint, actuator or array element whose value shows the divergence."""
    value: str
    """The value as text: `nan` for an array element, `qacc 1e+30` for a joint or actuator; empty if not known."""

    def __str__(self) -> str:
        """Return cause, physics step, time, place and value on one line."""
        what = f"{self.place} = {self.value}" if self.value else self.place
        return f"{self.cause} in physics step {self.substep} of call {self.call}, t = {self.time:.6g} s: {what}"


class World(_Strict):
    """The engine calls of one environment that a failure or crash file holds."""

    env: Count
    """Index of the environment in the training or evaluation."""
    cause: str
    """Cause of the divergence, or why the episode was kept."""
    detail: str
    """The joint, actuator or element that diverged, if the engine reports it."""
    nstep: list[Annotated[int, Field(ge=1, le=1000)]] = Field(min_length=1, max_length=MAX_SUBSTEPS)
    """Number of physics steps of each engine call."""
    follows: list[bool]
    """For each call except the first: whether the call started from the state after the previous call, apart from
    controls and forces. False if an event changed the state in between."""
    first: Count
    """Index of the first call of the last environment step, from 0."""
    diverged_at: DivergencePoint | None
    """Where the simulation diverged; None if it did not diverge, or if simulating the calls again does not show it."""

    @property
    def ended_by(self) -> str:
        """The cause of the divergence, and the joint, actuator or element that diverged, as one text."""
        return f"{self.cause}{f' ({self.detail})' if self.detail else ''}"


class Failure(_Strict):
    """Why and when a training recorded the end of an episode."""

    kind: FailureKind
    """The simulation diverged, the return was an outlier (low or high), or a termination ended the episode."""
    iteration: Count
    """Iteration of the run in which the episode ended."""
    step: Count
    """Number of environment steps of the run at the end of that iteration."""
    usual_returns: tuple[float, float] | None
    """First and third quartile of the returns of earlier episodes; None if there were too few episodes."""


class Header(_Strict):
    """The JSON document of a trajectory file: everything except its tensors."""

    format: int
    kind: Kind
    rlcli: str
    """Version of rlcli."""
    mujoco: str
    """Version of MuJoCo."""
    task: dict[str, str | None]
    """By what the task is found again: its name, and its folder or its package."""
    config: str
    """The resolved configuration, as YAML."""
    model: str
    """SHA-256 of the compiled model's numbers."""
    device: str
    """The device on which the steps were simulated, such as `cpu`."""
    num_envs: Count
    step_dt: float = Field(gt=0, le=1e6)
    """Simulated time of an environment step [s]."""
    follows_constants: bool
    """Whether MuJoCo's constants were derived again from model fields that differ between environments."""
    columns: Columns
    episodes: list[Episode]
    """Episodes of the file; empty in a crash file."""
    worlds: list[World] = Field(max_length=MAX_DESCRIBED)
    """Environments with recorded engine calls; empty in a recording."""
    failure: Failure | None
    """Why a training recorded the episode; only in a failure file."""

    @staticmethod
    def of(env: Environment) -> Header:
        """Return the header of a recording without episodes, with the task and configuration of `env`.

        Callers replace `kind`, `episodes` and other values by `model_copy`.
        """
        columns = Columns(
            observations=_column_names(env.layout.observations["policy"]),
            actions=_column_names(env.layout.actions),
            reward_terms=env.reward_names,
        )
        return Header(
            format=FORMAT,
            kind="recording",
            rlcli=rlcli.__version__,
            mujoco=mujoco.__version__,
            task=env.resolved.source.record(),
            config=to_yaml(to_data(env.resolved)),
            model=model_digest(env.engine.model),
            device=str(env.device),
            num_envs=env.num_envs,
            step_dt=env.step_dt,
            follows_constants=False,
            columns=columns,
            episodes=[],
            worlds=[],
            failure=None,
        )

    @field_validator("task")
    @classmethod
    def _check_task(cls, task: dict[str, str | None]) -> dict[str, str | None]:
        names = [value for value in task.values() if value is not None]
        if not task.get("name") or not all(name.isprintable() for name in names):
            raise ValueError("task: the name is missing, or a text has unprintable characters; the file is damaged")
        if not (task.get("folder") or task.get("distribution")):
            raise ValueError("task: neither a folder nor a distribution (package) is given; the file is damaged")
        return task

    @model_validator(mode="after")
    def _check_parts(self) -> Header:
        """Check that the numbers of steps, calls and episodes fit each other and the kind of the file."""
        for world in self.worlds:
            if len(world.follows) != len(world.nstep) - 1 or world.first >= len(world.nstep):
                message = f"`nstep`, `follows` and `first` of environment {world.env} do not fit together"
                raise ValueError(f"the file is damaged: {message}")
        if sum(count for world in self.worlds for count in world.nstep) > MAX_SUBSTEPS:
            raise ValueError(f"the file is damaged: it has more than {MAX_SUBSTEPS} physics steps")
        for number, e in enumerate(self.episodes):
            if e.env >= self.num_envs or e.kept > e.length or (self.kind == "recording" and e.kept != e.length):
                raise ValueError(f"the file is damaged: numbers of episode {number} do not fit together")
        if self.kind == "failure":
            if len(self.worlds) != 1 or len(self.episodes) != 1 or self.failure is None:
                raise ValueError("the file is damaged: a failure case must have the end of exactly one episode")
            first, steps_before = self.worlds[0].first, self.episodes[0].kept - 1
            if first < steps_before or first % max(1, steps_before):
                raise ValueError("the file is damaged: the number of engine calls does not fit the number of steps")
        elif self.failure is not None or bool(self.worlds) != (self.kind == "crash"):
            raise ValueError(f"the file is damaged: it is of kind '{self.kind}', but has the content of another kind")
        return self


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Content of a trajectory file (a recording, failure or crash file), after all checks."""

    file: Path
    header: Header
    tensors: dict[str, Tensor]

    def part(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names begin with a prefix, by their names without the prefix."""
        return {n.removeprefix(prefix): tensor for n, tensor in self.tensors.items() if n.startswith(prefix)}

    def of_episodes(self) -> dict[int, dict[str, Tensor]]:
        """Return the tensors of each episode: result[episode number][name without the prefix `episode.K.`]."""
        found: dict[int, dict[str, Tensor]] = {number: {} for number in range(len(self.header.episodes))}
        for name, tensor in self.part("episode.").items():
            number, _, rest = name.partition(".")
            if number.isdecimal() and int(number) in found:
                found[int(number)][rest] = tensor
        return found

    def resolved(self, named: TaskSource | None = None) -> Resolved:
        """Return the recorded configuration with the task's installed code and models.

        For a failure or crash file, `scene.num_envs` is 1, because each recorded environment is simulated on its own.

        Args:
            named: the task on the command line; it replaces the recorded task if both are local files or folders.

        Raises:
            TaskError: if the task is not installed any more.
            CheckpointError: if the task's code is not trusted (see `recorded_task`); or
                if header and configuration do not agree.
            ConfigError: if the installed task does not accept the recorded configuration.
        """
        source = recorded_task(self.header.task, f"the task of {self.file}", named=named)
        with tempfile.TemporaryDirectory() as folder:
            config = Path(folder) / "task.yaml"
            config.write_text(self.header.config, encoding="utf-8")
            flags = {"scene.num_envs": 1} if self.header.worlds else {}
            resolved = resolve(replace(source, config=config, shown=self.file), flags=flags)
        if not flags and resolved.task.scene.num_envs != self.header.num_envs:
            message = f"{self.file} is corrupt: num_envs differs between header and configuration; record it again"
            raise CheckpointError(message)
        return resolved

    def mismatch_error(self, error: Exception) -> CheckpointError:
        """Return the error for a file whose states do not fit the installed task; `error` is the exception raised."""
        message = f"{self.file} does not fit the installed task: {' '.join(str(error).split())}"
        words = ", ".join(f"{key} {value}" for key, value in self.header.task.items() if value is not None)
        return CheckpointError(message, hint=f"install the version of the task that made the file: {words}")


def write_trajectory(file: Path, header: Header, tensors: Mapping[str, Tensor], *, parents: bool = True) -> None:
    """Write a trajectory file; its folder is created if it does not exist.

    Args:
        file: the file to write.
        header: the JSON document of the file.
        tensors: name -> tensor, with the names that the module's docstring lists.
        parents: whether missing folders above the file's folder are created, too. In a run they are not: a run that
            was moved away during its training must not be created again.

    Raises:
        MachineError: if the disk reports an error.
    """
    document = header.model_dump(mode="json")
    copies = {
        name: tensor.detach().cpu().clone(memory_format=torch.contiguous_format) for name, tensor in tensors.items()
    }
    document["sha256"] = content_digest(copies, document)
    with disk_errors(file.parent):
        file.parent.mkdir(parents=parents, exist_ok=True)
    write_atomic(file, tensor_bytes(copies, metadata={"rlcli": json.dumps(document)}))


def read_trajectory(file: Path) -> Trajectory:
    """Read and check a trajectory file.

    Raises:
        CheckpointError: if the file is missing, corrupt, too large or of another format.
    """
    try:
        if file.exists() and not file.is_file():
            raise ValueError("the path is not a regular file")  # reading a pipe would block
        with safe_open(file, "pt") as opened:
            data = json.loads((opened.metadata() or {}).get("rlcli", "{}"))
            if not isinstance(data, dict) or "format" not in data:
                raise ValueError("the file was not written by rlcli: it has no header of rlcli")
            if data["format"] != FORMAT:
                raise CheckpointError(f"{file} has format {data['format']}; this rlcli reads {FORMAT}: record it again")
            if data.get("kind") != "recording" and file.stat().st_size > _MAX_BYTES:
                raise ValueError(f"the file is larger than {_MAX_BYTES >> 20} MiB")
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 (not a mapping)
        if isinstance(data.get("episodes"), list) and len(data["episodes"]) > len(tensors):
            raise ValueError(f"the file is damaged: {len(data['episodes'])} episodes, but only {len(tensors)} tensors")
        if data.pop("sha256", None) != content_digest(tensors, data):
            raise CheckpointError(f"{file} is corrupt: its hash does not match; record it again")
        header = check_json(Header, data, file)
        _check_tensors(header, tensors)
    except FileNotFoundError:
        message = f"there is no recording, crash dump or failure case {file}"
        raise CheckpointError(message, hint="check the path; rlcli eval TASK --record FILE makes a recording") from None
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        message = f"{file} is not a valid recording, crash dump or failure case: {' '.join(str(error).split())}"
        raise CheckpointError(message, hint="check the path; rlcli eval TASK --record FILE makes a recording") from None
    return Trajectory(file, header, tensors)


def content_digest(tensors: Mapping[str, Tensor], document: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a trajectory file's tensors and JSON document."""
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode())
    for name in sorted(tensors):
        value = tensors[name].contiguous()
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        # `data` is a view: the tensor is not copied
        digest.update(value.flatten().view(torch.uint8).numpy().data if value.numel() else b"")
    return digest.hexdigest()


def _check_tensors(header: Header, tensors: Mapping[str, Tensor]) -> None:
    """Check the shapes and types of the tensors that a replay reads.

    Raises:
        ValueError: if a tensor is missing, or has another shape or type than in the header.
    """
    shapes: dict[str, tuple[int | None, ...]] = {}
    if header.kind == "recording":
        shapes["actions"] = (None, header.num_envs, None)
    for number, e in enumerate(header.episodes):
        prefix = f"episode.{number}."
        shapes |= {f"{prefix}actions": (e.kept, len(header.columns.actions)), f"{prefix}rewards": (e.kept,)}
        if header.kind == "recording":
            shapes |= {prefix + name: (e.length + 1, None) for name in STATE_FIELDS}
        else:
            shapes[f"{prefix}observations"] = (e.kept, len(header.columns.observations))
            shapes[f"{prefix}reward_terms"] = (e.kept, len(header.columns.reward_terms))
    for number, world in enumerate(header.worlds):
        shapes[f"world.{number}.states"] = (len(world.nstep), None)
        shapes[f"world.{number}.final"] = (None,)
    for name, shape in shapes.items():
        tensor = tensors.get(name)
        if (
            tensor is None
            or len(shape) != tensor.dim()
            or any(size not in (None, found) for size, found in zip(shape, tensor.shape, strict=True))
        ):
            raise ValueError(f"the file is damaged: tensor {name} is missing, or its shape differs from the header")
        expected = torch.float64 if name.startswith("world.") else torch.float32
        if tensor.dtype != expected and not name.endswith(STATE_FIELDS):  # states have the engine's precision
            raise ValueError(f"the file is damaged: tensor {name} has type {tensor.dtype}, expected {expected}")
    for number, e in enumerate(header.episodes):
        if header.kind == "recording" and e.begin + e.length > len(tensors["actions"]):
            raise ValueError(f"the file is damaged: episode {number} is longer than the recording")


def _column_names(terms: tuple[TermLayout, ...]) -> list[str]:
    """Return a name for each column: `joint_pos.hip`, `last_action[2]`, or the term's name if it has one column."""
    names = []
    for term in terms:
        for index in range(term.size):
            if index < len(term.elements):
                names.append(f"{term.name}.{term.elements[index]}")
            else:
                names.append(term.name if term.size == 1 else f"{term.name}[{index}]")
    return names
