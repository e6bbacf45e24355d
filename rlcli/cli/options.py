"""Options that several commands share, so that a flag means the same everywhere."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from rlcli.cli.completion import agents, checkpoints, words
from rlcli.cli.console import console

CHOOSE = "auto"
"""Stands for a value that an option may leave out (`--video`)."""

Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="[KEY.PATH=VALUE]...", help="Overrides; agent.x=... addresses the chosen agent."),
]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
Debug = Annotated[bool, typer.Option("--debug", help="Tracebacks of errors.")]


def _less(given: bool) -> bool:
    if given:
        console.quiet, console.verbose = True, False
    return given


def _more(given: bool) -> bool:
    if given:
        console.quiet, console.verbose = False, True
    return given


Quiet = Annotated[bool, typer.Option("--quiet", "-q", callback=_less, help="Errors and results only.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", callback=_more, help="Say more; of -q and -v the last holds.")
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="YAML merged over the task; `agent:` in it addresses the chosen agent."),
]
Agent = Annotated[str | None, typer.Option("--agent", autocompletion=agents, help="Which of the task's agents.")]
NumEnvs = Annotated[int | None, typer.Option("--num-envs", help="Short for scene.num_envs=N.")]
MAX_SEED = 2**62
Seed = Annotated[
    int,
    typer.Option("--seed", min=-1, max=MAX_SEED, help="Seed of everything random; -1 draws one and records it."),
]
Device = Annotated[
    str, typer.Option("--device", autocompletion=words("auto", "cpu", "cuda"), help="auto, cpu, cuda or cuda:N.")
]
RunsDir = Annotated[Path | None, typer.Option("--runs-dir", help="Runs folder; else RLCLI_RUNS_DIR, settings, runs/.")]
Record = Annotated[
    Path | None, typer.Option("--record", help="Write the episodes, states and actions, to FILE; `replay` steps them.")
]
RecordMode = Annotated[
    str,
    typer.Option(
        "--record-mode",
        autocompletion=words("all", "succeeded", "failed", "separate"),
        help="Which episodes: all, succeeded, failed, or separate (a file each).",
    ),
]
CheckpointRef = Annotated[
    str | None,
    typer.Option(
        "--checkpoint",
        autocompletion=checkpoints,
        help="RUN, RUN@best, RUN@step:N, a checkpoint folder, a bundle, latest, or shipped (the task's own policy).",
    ),
]
Headless = Annotated[bool, typer.Option("--headless", hidden=True, help="Accepted; nothing opens a window unasked.")]


def flags(**values: Any) -> Mapping[str, Any]:
    """Flag values by dotted key, without those that were not given."""
    return {key.replace("__", "."): value for key, value in values.items() if value is not None}


def tell_notes(resolved: Any) -> None:
    """Say what became of the keys of a task in another tool's form; -v says it of each."""
    from rlcli.config.notes import summary

    for line in summary(resolved.notes):
        console.info(line)
    for note in resolved.notes:
        console.detail(str(note))


def draw_seed(seed: int) -> int:
    """The seed, drawn if it is -1."""
    if seed != -1:
        return seed
    import secrets

    return secrets.randbelow(2**31)


def choose_device(wanted: str) -> str:
    """auto, cpu, cuda or cuda:N -> a torch device that exists; auto is the GPU where there is one and rlcli[gpu] is.

    Raises:
        UsageError: for something else.
        DeviceError: for a device that is not there.
        DependencyError: for a GPU without rlcli[gpu].
    """
    from importlib.util import find_spec
    from re import fullmatch

    from rlcli.errors import DependencyError, UsageError
    from rlcli.machine import require_device

    if wanted == "cpu" or (wanted == "auto" and not _may_have_gpu()):
        return "cpu"
    if wanted == "auto":
        import torch

        return "cuda" if torch.cuda.is_available() and find_spec("mujoco_warp") else "cpu"
    if not fullmatch(r"cuda(:[0-9]+)?", wanted):
        raise UsageError(f"no device '{wanted}'", hint="auto, cpu, cuda or cuda:N")
    require_device(wanted)
    if find_spec("mujoco_warp") is None:
        raise DependencyError("the GPU engine needs mujoco-warp", hint='pip install "rlcli[gpu]"')
    return wanted


def _may_have_gpu() -> bool:
    """Whether there is a driver to ask, found out without importing torch."""
    from pathlib import Path
    from shutil import which

    return Path("/dev/nvidiactl").exists() or Path("/proc/driver/nvidia").exists() or which("nvidia-smi") is not None
