"""A trained policy as one file that runs without rlcli, proven equal to the policy before it is put in place.

Nothing but the checkpoint is needed: neither the task's package nor the simulator is imported. The graph's input is
`obs`, its outputs are `action`, what `env.step` takes, and `command`, what the actuators receive.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import io
import json
import logging
import math
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from torch import Tensor, nn

from rlcli.errors import CheckpointError, DependencyError, MachineError, UsageError, VerdictError, did_you_mean
from rlcli.rl.checkpoint import Checkpoint
from rlcli.rl.files import sync_folder, write_synced
from rlcli.rl.load import policy_of
from rlcli.rl.policy import Policy
from rlcli.rl.run import RECORD

FORMATS = {"onnx": ".onnx", "torch": ".pt2"}
"""Format -> how its files end."""
SCHEMA = 1
"""Version of the metadata."""
KEY = "rlcli"
"""Where the metadata stands in a file: a property of the ONNX model, an extra file of the torch program."""
TOLERANCE = 1e-5
"""Largest accepted difference from the policy, relative to max(1, |value|)."""
_OPSET = 18
_RANDOM = 256

Run = Callable[[Tensor], dict[str, Tensor]]


class _Columns(BaseModel):
    """Columns of a term, as the checkpoint's layout has them."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    name: str
    size: int = Field(ge=1)
    elements: list[str]
    unit: str
    scale: list[float] | None

    @model_validator(mode="after")
    def _widths(self) -> Self:
        own = ("offset", "clip", "limits") if isinstance(self, ActionColumns) else ()
        for key in ("scale", *own):
            values = getattr(self, key)
            if values is not None and len(values) != self.size:
                raise ValueError(f"{key} has {len(values)} values for {self.size} columns")
        return self


class ObservationColumns(_Columns):
    """Columns of an observation term; with a history those of the oldest step first."""

    clip: tuple[float, float] | None
    history: int = Field(ge=1)
    modifiers: list[dict[str, Any]]


class ActionColumns(_Columns):
    """Columns of `action` and of `command`. Without a scale the command is the action, within `clip`."""

    offset: list[float] | None
    clip: list[tuple[float | None, float | None]] | None
    limits: list[tuple[float | None, float | None]] | None


class LayoutRecord(BaseModel):
    """What a checkpoint's manifest says of the environment that the policy was trained in."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    observations: dict[str, list[ObservationColumns]]
    actions: list[ActionColumns]
    step_dt: float = Field(gt=0)
    dt: float = Field(gt=0)
    decimation: int = Field(ge=1)


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written, and how far it was from the policy at most."""

    file: Path
    metadata: dict[str, Any]
    observations: int
    max_difference: float


class Deployed(nn.Module):
    """The policy and, behind it, what the action terms make of its action."""

    scale: Tensor
    offset: Tensor
    clip: Tensor | None
    limits: Tensor | None

    def __init__(self, policy: Policy, actions: list[ActionColumns]) -> None:
        super().__init__()
        self.policy = policy
        self.scaled = any(term.scale is not None for term in actions)
        self.register_buffer("scale", _row(term.scale or [1.0] * term.size for term in actions))
        self.register_buffer("offset", _row(term.offset or [0.0] * term.size for term in actions))
        free = [(None, None)]
        clip = [[_finite(pair) for pair in term.clip or free * term.size] for term in actions]
        limits = [[_finite(pair) for pair in term.limits or free * term.size] for term in actions]
        for name, pairs in (("clip", clip), ("limits", limits)):
            bounds = _row(pairs)
            self.register_buffer(name, bounds.T.contiguous() if bool(bounds.isfinite().any()) else None)

    def forward(self, obs: Tensor) -> dict[str, Tensor]:
        """(n, observation_size) -> action and command, (n, action_size) each"""
        action = self.policy(obs)
        command = action * self.scale + self.offset if self.scaled else action.clone()
        for bounds in (self.clip, self.limits):
            if bounds is not None:
                command = torch.minimum(torch.maximum(command, bounds[0]), bounds[1])
        return {"action": action, "command": command}


def check_target(format_: str, output: Path | None) -> None:
    """What is asked for must be something that can be written.

    Raises:
        UsageError: for an unknown format, or a file that does not end as the format's do.
    """
    if format_ not in FORMATS:
        near = did_you_mean(format_, FORMATS) or f"formats: {', '.join(FORMATS)}"
        raise UsageError(f"no export format '{format_}'", hint=near)
    suffix = FORMATS[format_]
    if output is not None and output.suffix != suffix:
        other = next((name for name, ending in FORMATS.items() if ending == output.suffix), None)
        hint = f"--format {other}" if other else f"--output {output.with_suffix(suffix) if output.name else 'FILE'}"
        raise UsageError(f"'{output}' does not end in {suffix}, as files of format {format_} do", hint=hint)


def export(checkpoint: Checkpoint, file: Path, format_: str = "onnx") -> Exported:
    """Write the policy of a checkpoint to one file.

    Raises:
        UsageError: for an unknown format or a wrong suffix.
        DependencyError: if what writes or checks the format is not installed.
        CheckpointError: if the checkpoint is corrupt, or does not say what the policy's columns are.
        MachineError: if the file cannot be written.
        VerdictError: if the file does not compute what the policy does; it is not kept.
    """
    check_target(format_, file)
    if format_ == "onnx":
        _require_onnx()
    policy = policy_of(checkpoint)
    if policy.memory is not None:
        raise UsageError(
            f"a policy with a memory ({policy.spec.kind}) cannot be exported",
            hint="rlcli.rl.load.policy_of opens it in Python; train without agent.rnn to export",
        )
    layout = _layout(checkpoint, policy)
    graph = Deployed(policy, layout.actions).eval().requires_grad_(False)
    metadata = describe(checkpoint, policy, layout)
    observations = _observations(checkpoint, policy.spec.observation_size)
    write, read = (_onnx_bytes, _read_onnx) if format_ == "onnx" else (_torch_bytes, _read_torch)
    with _placed(file) as temporary, torch.no_grad():
        write_synced(temporary, write(graph, json.dumps(metadata, allow_nan=False)))
        run, found = read(temporary)
        if json.loads(found) != metadata:
            raise VerdictError(f"{file} is not kept: its metadata does not read back as written")
        difference = _require_equal(run, graph, observations, file)
    return Exported(file, metadata, len(observations), difference)


def describe(checkpoint: Checkpoint, policy: Policy, layout: LayoutRecord) -> dict[str, Any]:
    """The metadata: everything that whoever runs the file must know."""
    manifest, spec = checkpoint.manifest, policy.spec
    task, run = manifest.get("task") or {}, checkpoint.folder.resolve().parent.parent
    normalized = getattr(policy, "normalizer", None) is not None
    terms = layout.observations[spec.group]
    return {
        "schema": SCHEMA,
        "input": {
            "name": "obs",
            "shape": ["batch", spec.observation_size],
            "dtype": "float32",
            "meaning": f"the environment's observation group '{spec.group}': each term's value after its `modifiers`,"
            " clipped to `clip`, then times `scale`; its last `history` steps, the oldest first; side by side in the"
            " order of `observations`; nothing else is done to it outside",
        },
        "outputs": {
            "action": {
                "shape": ["batch", spec.action_size],
                "dtype": "float32",
                "meaning": "exactly what env.step takes: the deterministic action, within +-`action_bound`",
            },
            "command": {
                "shape": ["batch", spec.action_size],
                "dtype": "float32",
                "meaning": "what reaches the actuators, in the `unit` of each term of `actions`: action x `scale` +"
                " `offset`, then within `clip`, then within `limits`. Where `command` of a term is 'task', the task's"
                " own code makes the actuators' command of it, and it is the action within `clip`",
            },
        },
        "observations": [
            {**term.model_dump(mode="json"), "columns": columns}
            for term, columns in zip(terms, _columns(terms), strict=True)
        ],
        "actions": [
            {
                **term.model_dump(mode="json"),
                "columns": columns,
                "command": "actuator" if term.scale is not None else "task",
            }
            for term, columns in zip(layout.actions, _columns(layout.actions), strict=True)
        ],
        "applied": {
            "before_obs": ["observations.modifiers", "observations.clip", "observations.scale"],
            "inside": [*(["normalizer"] if normalized else []), "action_bound"],
            "between_action_and_command": ["actions.scale", "actions.offset", "actions.clip", "actions.limits"],
        },
        "normalizer": normalized,
        "action_bound": spec.action_bound,
        "step_dt": layout.step_dt,
        "dt": layout.dt,
        "decimation": layout.decimation,
        "quaternions": "wxyz",
        "policy": spec.kind,
        "task": {key: task.get(key) for key in ("name", "distribution", "version")},
        "agent": manifest.get("agent"),
        "run": run.name if (run / RECORD).is_file() else None,
        "step": checkpoint.step,
        "seed": manifest.get("seed"),
        "versions": {key: (manifest.get("versions") or {}).get(key) for key in ("rlcli", "torch", "mujoco")},
    }


def _layout(checkpoint: Checkpoint, policy: Policy) -> LayoutRecord:
    file, spec = checkpoint.folder / "manifest.json", policy.spec
    try:
        layout = LayoutRecord.model_validate(checkpoint.manifest.get("layout"))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, ("layout", *first["loc"])))
        raise CheckpointError(
            f"{file} does not say what the policy's columns are: {place}: {first['msg']}",
            hint="checkpoints of this rlcli do: train again",
        ) from None
    sizes = (
        ("observations", sum(t.size for t in layout.observations.get(spec.group, [])), spec.observation_size),
        ("actions", sum(t.size for t in layout.actions), spec.action_size),
    )
    for what, found, expected in sizes:
        if found != expected:
            raise CheckpointError(f"{file} does not fit policy.json: {found} columns of {what}, expected {expected}")
    return layout


def _columns(terms: list[Any]) -> list[list[int]]:
    ends = [sum(term.size for term in terms[: i + 1]) for i in range(len(terms))]
    return [[end - term.size, end] for term, end in zip(terms, ends, strict=True)]


def _row(terms: Iterable[list[Any]]) -> Tensor:
    return torch.tensor([value for values in terms for value in values], dtype=torch.float32)


def _finite(pair: tuple[float | None, float | None] | None) -> tuple[float, float]:
    low, high = pair or (None, None)
    return -math.inf if low is None else low, math.inf if high is None else high


def _observations(checkpoint: Checkpoint, size: int) -> Tensor:
    """What the file is checked on: recorded in training where there is a record, random, and both x 1000. (n, size)"""
    random = torch.randn(_RANDOM, size, generator=torch.Generator().manual_seed(0))
    recorded = checkpoint.tensors("trainer").get("observations")
    if recorded is not None and recorded.shape[1:] == (size,) and bool(recorded.isfinite().all()):
        random = torch.cat([recorded.float(), random])
    return torch.cat([random, 1000.0 * random])


def _require_equal(run: Run, graph: Deployed, observations: Tensor, file: Path) -> float:
    """The largest difference between what was written and the policy, at batches of 1, 7 and all."""
    worst = 0.0
    for batch in (1, 7, len(observations)):
        for rows in observations.split(batch):
            expected, found = graph(rows), run(rows)
            for name, values in expected.items():
                difference = (found[name] - values).abs() / values.abs().clamp(min=1.0)
                if found[name].shape != values.shape or not bool((difference <= TOLERANCE).all()):
                    raise VerdictError(
                        f"{file} is not kept: at batch {batch} its '{name}' differs from the policy's by"
                        f" {float(difference.max()):.3g}, allowed is {TOLERANCE:g}",
                        hint="please report it with the versions of torch, onnx and onnxruntime",
                    )
                worst = max(worst, float(difference.max()))
    return worst


def _onnx_bytes(graph: Deployed, metadata: str) -> bytes:
    import onnx

    with _quiet():
        program = torch.onnx.export(
            _with_plain_elu(graph),
            (_example(graph),),
            dynamo=True,
            external_data=False,
            input_names=["obs"],
            output_names=["action", "command"],
            dynamic_shapes={"obs": {0: torch.export.Dim("batch")}},
            opset_version=_OPSET,
            verbose=False,
        )
    assert program is not None
    for node in program.model.graph:
        node.metadata_props.clear()  # stack traces, with paths of this machine
    program.model.producer_name = "rlcli"
    program.model.metadata_props[KEY] = metadata
    model = program.model_proto
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _read_onnx(file: Path) -> tuple[Run, str]:
    import onnxruntime

    data = file.read_bytes()
    require_self_contained(data, file)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    names = ["action", "command"]

    def run(obs: Tensor) -> dict[str, Tensor]:
        values = session.run(names, {"obs": obs.numpy()})
        return {name: torch.from_numpy(value) for name, value in zip(names, values, strict=True)}

    return run, session.get_modelmeta().custom_metadata_map[KEY]


def require_self_contained(data: bytes, file: Path) -> None:
    """An ONNX file may name other files for its numbers, anywhere on the disk: such a one is not opened.

    Args:
        data: its content.
        file: its name, for the message.

    Raises:
        CheckpointError: if it is no ONNX file, or not the whole of it.
    """
    import onnx
    from google.protobuf.message import DecodeError

    try:
        model = onnx.load_from_string(data)
    except DecodeError:
        raise CheckpointError(f"{file} is corrupt, or no ONNX file") from None
    for value in _tensors_elsewhere(model):
        where = next((entry.value for entry in value.external_data if entry.key == "location"), "?")
        raise CheckpointError(f"{file} keeps '{value.name[:60]}' in another file, {where[:80]!r}; it is not opened")


def _tensors_elsewhere(part: Any) -> Iterator[Any]:
    """Tensors below a part of an ONNX model whose numbers are in another file."""
    from google.protobuf.message import Message

    if part.DESCRIPTOR.name == "TensorProto":
        if part.external_data or part.data_location:
            yield part
        return
    for _, value in part.ListFields():
        for inner in (value,) if isinstance(value, Message | str | bytes | int | float) else value:
            if isinstance(inner, Message):
                yield from _tensors_elsewhere(inner)


def _torch_bytes(graph: Deployed, metadata: str) -> bytes:
    file = io.BytesIO()
    with _quiet():
        shapes = {"obs": {0: torch.export.Dim("batch")}}
        program = torch.export.export(graph, (_example(graph),), dynamic_shapes=shapes)
        torch.export.save(program, file, extra_files={KEY: metadata})
    return file.getvalue()


def _read_torch(file: Path) -> tuple[Run, str]:
    extra: dict[str, Any] = {KEY: ""}
    with _quiet():
        program = torch.export.load(file, extra_files=extra)
    found = extra[KEY]
    return program.module(), found.decode() if isinstance(found, bytes) else found


def _example(graph: Deployed) -> Tensor:
    return torch.zeros(2, graph.policy.spec.observation_size)  # one row would be taken for a constant batch


def _with_plain_elu(graph: Deployed) -> Deployed:
    """The same graph without ONNX's Elu, which runtimes have in float32 only."""
    graph = copy.deepcopy(graph)
    for module in list(graph.modules()):
        for name, child in module.named_children():
            if isinstance(child, nn.ELU):
                setattr(module, name, _Elu())
    return graph


class _Elu(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return torch.where(x > 0, x, x.clamp(max=0.0).exp() - 1.0)


def _require_onnx() -> None:
    try:
        with _quiet():
            for module in ("onnx", "onnxscript", "onnxruntime"):
                importlib.import_module(module)
    except ImportError as error:
        raise DependencyError(
            f"ONNX export needs onnx, onnxscript and onnxruntime: {error}", hint='pip install "rlcli[export]"'
        ) from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Exporters talk: about steps on stdout, about what they miss in the log."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


@contextlib.contextmanager
def _placed(file: Path) -> Iterator[Path]:
    """A temporary neighbour of `file`, which takes its place if all goes well; otherwise nothing is left."""
    temporary = file.with_name(f".{file.stem}.tmp-{os.getpid()}{file.suffix}")
    made: list[Path] = []
    try:
        made = [folder for folder in (file.parent, *file.parent.parents) if not folder.exists()]
        file.parent.mkdir(parents=True, exist_ok=True)
        write_synced(temporary, b"")  # a place that cannot be written shows before the work is done
        yield temporary
        os.replace(temporary, file)
        made = []
        sync_folder(file.parent)
    except OSError as error:
        raise MachineError(
            f"cannot write {file}: {error.strerror or error}", hint="choose another place with --output FILE"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
