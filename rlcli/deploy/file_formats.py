"""The formats of exported policies: how each is written, and how it is read back to be checked."""

from __future__ import annotations

import contextlib
import importlib
import io
import logging
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rlcli.deploy.graph import Deployed
from rlcli.deploy.numpy_export import numpy_bytes, read_numpy
from rlcli.errors import CheckpointError, DependencyError

KEY = "rlcli"
"""Where the metadata stands in a file: a property of the ONNX model, an extra file of the torch program."""
FORMATS = {"onnx": ".onnx", "torch": ".pt2", "numpy": ".py"}
"""Format -> how its files end."""
_OPSET = 18

Run = Callable[[dict[str, Tensor]], dict[str, Tensor]]
"""Inputs by name -> outputs by name."""


def write(format_: str, graph: Deployed, metadata: str, further: dict[str, str]) -> bytes:
    """A file's content.

    Args:
        format_: one of `FORMATS`.
        graph: what it computes.
        metadata: JSON.
        further: properties that an ONNX file has besides.
    """
    if format_ == "onnx":
        return _onnx_bytes(graph, {KEY: metadata, **further})
    return _torch_bytes(graph, metadata) if format_ == "torch" else numpy_bytes(graph, metadata)


def read(format_: str, file: Path) -> tuple[Run, str]:
    """What a file computes, and its metadata. A file of Python is run: only one that was written here is read."""
    return {"onnx": _read_onnx, "torch": _read_torch, "numpy": read_numpy}[format_](file)


def require(format_: str) -> None:
    """What writes and checks a format must be there.

    Raises:
        DependencyError: if it is not installed.
    """
    if format_ != "onnx":
        return
    try:
        with _quiet():
            for module in ("onnx", "onnxscript", "onnxruntime"):
                importlib.import_module(module)
    except ImportError as error:
        raise DependencyError(
            f"ONNX export needs onnx, onnxscript and onnxruntime: {error}", hint='pip install "rlcli[export]"'
        ) from None


def _example(graph: Deployed) -> tuple[Tensor, ...]:
    rows = 2  # one row would be taken for a constant batch
    return (torch.zeros(rows, graph.policy.spec.observation_size), *graph.start(rows).values())


def _shapes(graph: Deployed) -> dict[str, dict[int, Any] | None]:
    batch = torch.export.Dim("batch")
    return {name: {0 if name == "obs" else 1: batch} for name in graph.inputs}


def _onnx_bytes(graph: Deployed, properties: dict[str, str]) -> bytes:
    import onnx

    with _quiet():
        program = torch.onnx.export(
            graph.plain(),
            _example(graph),
            dynamo=True,
            external_data=False,
            input_names=graph.inputs,
            output_names=graph.outputs,
            dynamic_shapes=_shapes(graph),
            opset_version=_OPSET,
            verbose=False,
        )
    assert program is not None
    for node in program.model.graph:
        node.metadata_props.clear()  # stack traces, with paths of this machine
    program.model.producer_name = "rlcli"
    program.model.metadata_props.update(properties)
    model = program.model_proto
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString()
    return content


def _read_onnx(file: Path) -> tuple[Run, str]:
    import onnxruntime

    data = file.read_bytes()
    require_self_contained(data, file)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def run(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        values = session.run(names, {name: value.numpy() for name, value in inputs.items()})
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
        program = torch.export.export(graph, _example(graph), dynamic_shapes=_shapes(graph))
        torch.export.save(program, file, extra_files={KEY: metadata})
    return file.getvalue()


def _read_torch(file: Path) -> tuple[Run, str]:
    extra: dict[str, Any] = {KEY: ""}
    with _quiet():
        program = torch.export.load(file, extra_files=extra)
    found, module = extra[KEY], program.module()
    return lambda inputs: module(*inputs.values()), found.decode() if isinstance(found, bytes) else found


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
