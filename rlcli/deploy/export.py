"""A trained policy as one file that runs without rlcli, proven equal to the policy before it is put in place.

Nothing but the checkpoint is needed: neither the task's package nor the simulator is imported. The graph's input is
`obs`, its outputs are `action`, what `env.step` takes, and `command`, what the actuators receive.
"""

from __future__ import annotations

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
from rlcli.deploy.file_formats import FORMATS, Run, require_self_contained
from rlcli.deploy.graph import Deployed
from rlcli.deploy.metadata import metadata_of, mjlab_properties
from rlcli.errors import MachineError, UsageError, VerdictError, require_known
from rlcli.rl.policy import Policy, PolicySpec
from rlcli.runs.atomic_io import sync_folder, write_synced
from rlcli.runs.checkpoint import Checkpoint
from rlcli.runs.checkpoint_manifest import deployment_of, layout_of

__all__ = ["BUNDLE", "FORMATS", "TOLERANCE", "Exported", "check_target", "export", "refusal", "require_self_contained"]

BUNDLE = "bundle"
"""The format that is a folder, `rlcli.runs.bundle`: the policy for rlcli itself."""
TOLERANCE = 1e-5
"""Largest accepted difference from the policy, relative to max(1, |value|)."""
_RANDOM = 256
_EPISODE = 32
"""Steps after which a memory is reset while a file is checked."""


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written, and how far it was from the policy at most."""

    file: Path
    metadata: dict[str, Any]
    observations: int
    max_difference: float


def check_target(format_: str, output: Path | None) -> None:
    """Check that a format and an output file can be written.

    Raises:
        UsageError: for an unknown format, or a file that does not end as the format's do.
    """
    known = [*FORMATS, BUNDLE]
    require_known(format_, known, "export format", "formats")
    if format_ == BUNDLE:
        other = None if output is None else next((n for n, ending in FORMATS.items() if ending == output.suffix), None)
        if other is not None:
            raise UsageError(f"'{output}' is a file, and a bundle is a folder", hint=f"--format {other}")
        return
    suffix = FORMATS[format_]
    if output is not None and output.suffix != suffix:
        other = next((name for name, ending in FORMATS.items() if ending == output.suffix), None)
        hint = f"--format {other}" if other else f"--output {output.with_suffix(suffix) if output.name else 'FILE'}"
        raise UsageError(f"'{output}' does not end in {suffix}, as files of format {format_} do", hint=hint)


def refusal(spec: PolicySpec) -> str | None:
    """Why a policy cannot be exported; None: it can."""
    if len(set(spec.memory)) > 1:
        return f"a memory whose layers differ in size ({', '.join(map(str, spec.memory))})"
    return None


def export(
    checkpoint: Checkpoint, file: Path, format_: str = "onnx", deployment: Mapping[str, Any] | None = None
) -> Exported:
    """Write the policy of a checkpoint to one file.

    Args:
        checkpoint: the checkpoint.
        file: where to.
        format_: one of `FORMATS`.
        deployment: what `rlcli.deploy.env_description.describe` gives, for a checkpoint that does not say it.

    Raises:
        UsageError: for an unknown format, a wrong suffix, or a policy that cannot be exported.
        DependencyError: if what writes or checks the format is not installed.
        CheckpointError: if the checkpoint is corrupt, or does not say what the policy's columns are.
        MachineError: if the file cannot be written.
        VerdictError: if the file does not compute what the policy does; it is not kept.
    """
    check_target(format_, file)
    formats.require(format_)
    policy = checkpoint.policy()
    reason = refusal(policy.spec)
    if reason is not None:
        raise UsageError(
            f"{checkpoint.folder} cannot be exported: its policy has {reason}",
            hint="rlcli.runs.checkpoint.open_checkpoint(FOLDER).policy() opens it in Python",
        )
    layout = layout_of(checkpoint, policy)
    graph = Deployed(policy, layout.actions).eval().requires_grad_(False)
    metadata = metadata_of(checkpoint, graph, layout, deployment_of(checkpoint, policy, deployment))
    observations = _observations(checkpoint, policy.spec.observation_size)
    with _placed(file) as temporary, torch.no_grad():
        text = json.dumps(metadata, allow_nan=False)
        write_synced(temporary, formats.write(format_, graph, text, mjlab_properties(metadata)))
        run, found = formats.read(format_, temporary)
        if json.loads(found) != metadata:
            raise VerdictError(f"{file} is not kept: its metadata does not read back as written")
        difference = _require_equal(run, graph, observations, file)
    return Exported(file, metadata, len(observations), difference)


def _observations(checkpoint: Checkpoint, size: int) -> Tensor:
    """What the file is checked on: recorded in training where there is a record, random, and both x 1000. (n, size)"""
    random = torch.randn(_RANDOM, size, generator=torch.Generator().manual_seed(0))
    held = "trainer.safetensors" in checkpoint.manifest["files"]  # a bundle has none
    recorded = checkpoint.tensors("trainer").get("observations") if held else None
    if recorded is not None and recorded.shape[1:] == (size,) and bool(recorded.isfinite().all()):
        random = torch.cat([recorded.float(), random])
    return torch.cat([random, 1000.0 * random])


def _require_equal(run: Run, graph: Deployed, observations: Tensor, file: Path) -> float:
    """The largest difference between what was written and the policy, at batches of 1, 7 and all.

    A policy with a memory takes the rows as steps of an episode; each side has its own memory.
    """
    worst = 0.0
    for batch in (1, 7, len(observations)):
        memory: Tensor | None = None
        state = graph.start(batch)
        for number, rows in enumerate(torch.split(observations, batch)):
            if graph.policy.memory is not None and (number % _EPISODE == 0 or len(rows) != batch):
                memory, state = None, graph.start(len(rows))
            expected, memory = _expected(graph, rows, memory)
            found = run({"obs": rows, **state})
            state = {name: found[name.replace("_in", "_out")] for name in state}
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


def _expected(graph: Deployed, rows: Tensor, memory: Tensor | None) -> tuple[dict[str, Tensor], Tensor | None]:
    """What the policy itself gives, and what it remembers."""
    policy: Policy = graph.policy
    action, memory = policy.step(rows, memory)
    return graph.commanded(action), memory


@contextlib.contextmanager
def _placed(file: Path) -> Iterator[Path]:
    """A temporary neighbour of `file`, which takes its place if all goes well; otherwise nothing is left."""
    temporary = file.with_name(f".{file.stem}.tmp-{os.getpid()}{file.suffix}")
    made: list[Path] = []
    try:
        made = [folder for folder in (file.parent, *file.parent.parents) if not folder.exists()]
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.unlink(missing_ok=True)
        temporary.touch(exist_ok=False)  # a place that cannot be written shows before the work is done
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
