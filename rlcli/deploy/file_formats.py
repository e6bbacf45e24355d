"""Writers of the file formats of exported policies (ONNX, torch, numpy), and readers to check the files.

`rlcli.deploy.export` calls this module.
"""

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

from rlcli.deploy.exported_module import DeployedPolicy
from rlcli.deploy.numpy_export import numpy_bytes, read_numpy
from rlcli.errors import CheckpointError, DependencyError, pip_install
from rlcli.machine.memory import require_address_space

KEY = "rlcli"
"""Key of the metadata in a file: a property of the ONNX model, an extra file of the torch program."""
FORMATS = {"onnx": ".onnx", "torch": ".pt2", "numpy": ".py"}
"""Format -> suffix of its files."""
_OPSET = 18
_ONNX_ADDRESS_SPACE = 3 << 29
"""Memory limit of a process (`ulimit -v`) [bytes] below which onnxruntime ends the process without a message."""

PolicyFunction = Callable[[dict[str, Tensor]], dict[str, Tensor]]
"""Exported policy as a function: inputs by name -> outputs by name."""


def write(format_: str, graph: DeployedPolicy, metadata: str, extra_properties: dict[str, str]) -> bytes:
    """Return the content of a file with an exported policy.

    Args:
        format_: one of `FORMATS`.
        graph: the policy.
        metadata: the metadata as JSON text.
        extra_properties: further metadata, name -> text; only ONNX files store them.
    """
    if format_ == "onnx":
        return _onnx_bytes(graph, {KEY: metadata, **extra_properties})
    return _torch_bytes(graph, metadata) if format_ == "torch" else numpy_bytes(graph, metadata)


def read(format_: str, file: Path) -> tuple[PolicyFunction, str]:
    """Read a file with an exported policy; return the policy as a function, and the metadata as JSON text.

    A Python file is executed, so call this only with a file that this process has written.
    """
    return {"onnx": _read_onnx, "torch": _read_torch, "numpy": read_numpy}[format_](file)


def require_packages(format_: str) -> None:
    """Check that the packages that write and check a file format are installed.

    Raises:
        DependencyError: if one of these packages is not installed.
        MachineError: if a limit such as `ulimit -v` leaves too little memory for onnxruntime.
    """
    if format_ != "onnx":
        return
    require_address_space(_ONNX_ADDRESS_SPACE)
    try:
        with _quiet():
            for module in ("onnx", "onnxscript", "onnxruntime"):
                importlib.import_module(module)
    except ImportError as error:
        message = f"ONNX export needs onnx, onnxscript and onnxruntime: {error}"
        raise DependencyError(message, hint=pip_install("rlcli[export]")) from None


def _example_inputs(graph: DeployedPolicy) -> tuple[Tensor, ...]:
    rows = 2  # torch.export treats a batch of one row as a constant
    return (torch.zeros(rows, graph.policy.spec.observation_size), *graph.initial_state(rows).values())


def _dynamic_shapes(graph: DeployedPolicy) -> dict[str, dict[int, Any] | None]:
    batch = torch.export.Dim("batch")
    return {name: {0 if name == "obs" else 1: batch} for name in graph.inputs}


def _onnx_bytes(graph: DeployedPolicy, properties: dict[str, str]) -> bytes:
    import onnx

    with _quiet():
        program = torch.onnx.export(
            graph.for_onnx(),
            _example_inputs(graph),
            dynamo=True,
            external_data=False,
            input_names=graph.inputs,
            output_names=graph.outputs,
            dynamic_shapes=_dynamic_shapes(graph),
            opset_version=_OPSET,
            verbose=False,
        )
    assert program is not None
    for node in program.model.graph:
        node.metadata_props.clear()  # these entries hold stack traces with paths of this machine
    program.model.producer_name = "rlcli"
    program.model.metadata_props.update(properties)
    model = program.model_proto
    onnx.checker.check_model(model, full_check=True)
    content: bytes = model.SerializeToString()
    return content


def _read_onnx(file: Path) -> tuple[PolicyFunction, str]:
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
    """Check that an ONNX file does not store tensors in other files, whose paths may lead anywhere on the disk.

    Args:
        data: the content of the file.
        file: its path, for the message.

    Raises:
        CheckpointError: if `data` is not an ONNX file, or stores a tensor in another file.
    """
    import onnx
    from google.protobuf.message import DecodeError

    try:
        model = onnx.load_from_string(data)
    except DecodeError:
        raise CheckpointError(f"{file} is not a valid ONNX file; export it again") from None
    for value in _external_tensors(model):
        where = next((entry.value for entry in value.external_data if entry.key == "location"), "?")
        raise CheckpointError(
            f"{file} stores '{value.name[:60]}' in another file, {where[:80]!r}; export it as one file"
        )


def _external_tensors(part: Any) -> Iterator[Any]:
    """Yield the tensors in an ONNX model, or in a part of it, whose values are stored in another file."""
    from google.protobuf.message import Message

    if part.DESCRIPTOR.name == "TensorProto":
        if part.external_data or part.data_location:
            yield part
        return
    for _, value in part.ListFields():
        for inner in (value,) if isinstance(value, Message | str | bytes | int | float) else value:
            if isinstance(inner, Message):
                yield from _external_tensors(inner)


def _torch_bytes(graph: DeployedPolicy, metadata: str) -> bytes:
    file = io.BytesIO()
    with _quiet():
        program = torch.export.export(graph, _example_inputs(graph), dynamic_shapes=_dynamic_shapes(graph))
        torch.export.save(program, file, extra_files={KEY: metadata})
    return file.getvalue()


def _read_torch(file: Path) -> tuple[PolicyFunction, str]:
    extra: dict[str, Any] = {KEY: ""}
    with _quiet():
        program = torch.export.load(file, extra_files=extra)
    found, module = extra[KEY], program.module()
    return lambda inputs: module(*inputs.values()), found.decode() if isinstance(found, bytes) else found


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress output of torch's exporters, which print progress, and log and warn about missing features."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(action="ignore"), contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        logging.disable(before)
