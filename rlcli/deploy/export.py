"""Export of a trained policy to one file that runs without rlcli.

The file is read back and compared with the policy before it gets its final name. Only the checkpoint is needed: neither
the task's package nor MuJoCo is imported. The graph has the input `obs` and the outputs `action` (the argument of
`env.step`) and `command` (what the actuators receive).
"""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rlcli.deploy import file_formats as formats
from rlcli.deploy.exported_module import DeployedPolicy
from rlcli.deploy.file_formats import FORMATS, PolicyFunction, require_self_contained
from rlcli.deploy.metadata import metadata_of, mjlab_properties
from rlcli.errors import MachineError, UsageError, VerdictError, require_known
from rlcli.rl.policy import PolicySpec
from rlcli.runs.atomic_io import remove_leftovers, require_writable, sync_folder, write_synced
from rlcli.runs.checkpoint_reader import Checkpoint
from rlcli.runs.layout_and_deployment import deployment_of, layout_of

__all__ = ["BUNDLE", "FORMATS", "TOLERANCE", "Exported", "check_target", "export", "require_self_contained"]

BUNDLE = "bundle"
"""Name of the format for a folder that rlcli itself reads, see `rlcli.runs.policy_bundle`."""
TOLERANCE = 1e-5
"""Largest accepted difference from the policy, relative to max(1, |value|)."""
_RANDOM = 256
"""Number of random observations with which an exported file is checked against the policy."""
_EPISODE = 32
"""Number of steps between resets of a recurrent policy's hidden state while an exported file is checked."""


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export: the written file, its metadata, and how much its outputs differ from the policy's."""

    file: Path
    metadata: dict[str, Any]
    observations: int
    """Number of test observations, on which the outputs of the file and of the policy were compared."""
    max_difference: float
    """Largest difference between an output of the file and of the policy, relative to max(1, |value|)."""


def check_target(format_: str, output: Path | None) -> None:
    """Check the options `--format` and `--output`: the format exists, and the file has the suffix of the format.

    Raises:
        UsageError: for an unknown format, or a file with another suffix.
        MachineError: if the file cannot be written.
    """
    require_known(format_, [*FORMATS, BUNDLE], "export format", "formats")
    if output is None:
        return
    other = next((name for name, suffix in FORMATS.items() if suffix == output.suffix), None)
    if format_ == BUNDLE:
        if other is not None:
            message = f"'{output}' has the suffix of format {other}, but a bundle is a folder"
            raise UsageError(message, hint=f"give --format {other}, or a folder as --output")
        return
    suffix = FORMATS[format_]
    if output.suffix != suffix:
        named = output.with_suffix(suffix) if output.name.strip(".") else "FILE"
        hint = f"--format {other}" if other else f"--output {named}"
        raise UsageError(f"'{output}' does not end in {suffix}, the suffix of format {format_}", hint=hint)
    try:
        require_writable(output)
    except MachineError as error:
        raise MachineError(error.message, hint="choose another folder with --output") from error


def _export_obstacle(spec: PolicySpec) -> str | None:
    """Return why a policy cannot be exported, as the end of `its policy has ...`; None if there is no obstacle."""
    if len(set(spec.memory)) > 1:
        return f"recurrent layers of different sizes ({', '.join(map(str, spec.memory))})"
    return None


def export(
    checkpoint: Checkpoint, file: Path, format_: str = "onnx", deployment: Mapping[str, Any] | None = None
) -> Exported:
    """Write the policy of a checkpoint to one file, and check that the file computes the same outputs.

    Args:
        checkpoint: the checkpoint.
        file: the file to write.
        format_: one of `FORMATS`.
        deployment: description of the environment (`rlcli.deploy.env_description.describe`) for a checkpoint that does
            not contain one.

    Raises:
        UsageError: for an unknown format, a wrong suffix, or a policy that cannot be exported.
        DependencyError: if a package that writes or checks the format is not installed.
        CheckpointError: if the checkpoint is corrupt, or has no layout of the policy's columns.
        MachineError: if the file cannot be written.
        VerdictError: if the outputs of the file differ from those of the policy, or its metadata cannot be read back;
            the file is deleted.
    """
    check_target(format_, file)
    formats.require_packages(format_)
    policy = checkpoint.policy()
    reason = _export_obstacle(policy.spec)
    if reason is not None:
        raise UsageError(
            f"{checkpoint.folder} cannot be exported: its policy has {reason}",
            hint="use the policy in Python: rlcli.runs.checkpoint_reader.open_checkpoint(FOLDER).policy()",
        )
    layout = layout_of(checkpoint, policy)
    graph = DeployedPolicy(policy, layout.actions).eval().requires_grad_(False)
    metadata = metadata_of(checkpoint, graph, layout, deployment_of(checkpoint, policy, deployment))
    observations = _observations(checkpoint, policy.spec.observation_size)
    with _temporary_file(file) as temporary, torch.no_grad():
        text = json.dumps(metadata, allow_nan=False)
        write_synced(temporary, formats.write(format_, graph, text, mjlab_properties(metadata)))
        run, found = formats.read(format_, temporary)
        if json.loads(found) != metadata:
            raise VerdictError(f"{file} was not written: its metadata cannot be read back", hint="report this bug")
        difference = _require_equal(run, graph, observations, file)
    return Exported(file, metadata, len(observations), difference)


def relative_difference(found: Tensor, expected: Tensor) -> Tensor:
    """Return the difference relative to max(1, |expected|), element by element."""
    return (found - expected).abs() / expected.abs().clamp(min=1.0)


def _observations(checkpoint: Checkpoint, size: int) -> Tensor:
    """Return test observations: those recorded in training (if any), random ones, and both times 1000. (n, size)"""
    random = torch.randn(_RANDOM, size, generator=torch.Generator().manual_seed(0))
    has_trainer = "trainer.safetensors" in checkpoint.manifest["files"]  # a bundle has no recorded observations
    recorded = checkpoint.tensors("trainer").get("observations") if has_trainer else None
    if recorded is not None and recorded.shape[1:] == (size,) and bool(recorded.isfinite().all()):
        random = torch.cat([recorded.float(), random])
    return torch.cat([random, 1000.0 * random])


def _require_equal(run: PolicyFunction, graph: DeployedPolicy, observations: Tensor, file: Path) -> float:
    """Check that an exported file and the policy give the same outputs; return the largest difference.

    The outputs are compared for batches of 1, 7 and all observations. For a recurrent policy the batches are successive
    steps of episodes; the file and the policy each keep a hidden state.

    Args:
        run: the exported policy as a function, read from the file.
        graph: the policy.
        observations: the test inputs.
        file: the file, for the message.
    """
    worst = 0.0
    for batch in (1, 7, len(observations)):
        hidden: Tensor | None = None
        state = graph.initial_state(batch)
        for number, rows in enumerate(torch.split(observations, batch)):
            if graph.policy.memory is not None and (number % _EPISODE == 0 or len(rows) != batch):
                hidden, state = None, graph.initial_state(len(rows))
            action, hidden = graph.policy.step(rows, hidden)
            found = run({"obs": rows, **state})
            state = {name: found[name.replace("_in", "_out")] for name in state}
            for name, values in graph.with_command(action).items():
                difference = relative_difference(found[name], values)
                if found[name].shape != values.shape or not bool((difference <= TOLERANCE).all()):
                    raise VerdictError(
                        f"{file} was not written: with batch size {batch}, its output '{name}' differs from that of the"
                        f" policy by {float(difference.max()):.3g} (relative); at most {TOLERANCE:g} is allowed",
                        hint="report this bug with the versions of torch, onnx and onnxruntime",
                    )
                worst = max(worst, float(difference.max()))
    return worst


@contextlib.contextmanager
def _temporary_file(file: Path) -> Iterator[Path]:
    """Yield a temporary file, which becomes `file` at the end of the `with` block.

    After an error, the temporary file and the folders that were created for it are removed.
    """
    temporary = file.with_name(f".{file.stem}.tmp-{os.getpid()}{file.suffix}")
    made: list[Path] = []
    try:
        made = [folder for folder in (file.parent, *file.parent.parents) if not folder.exists()]
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.unlink(missing_ok=True)
        temporary.touch(exist_ok=False)  # fail now, not after the export, if the folder is read-only
        yield temporary
        os.replace(temporary, file)
        made = []
        remove_leftovers(file.parent, file.stem)
        sync_folder(file.parent)
    except OSError as error:
        message = f"cannot write {file}: {error.strerror or error}"
        raise MachineError(message, hint="choose another path with --output FILE") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
