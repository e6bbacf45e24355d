"""How a training begins: as a new run, as one that goes on, or as one process of several that follows its leader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.console import console
from rlcli.cli.options import choose_device

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.registry import TaskSource
    from rlcli.rl.job import Job
    from rlcli.rl.run import Run


def created(
    resolved: Resolved,
    runs: Path,
    name: str | None,
    record: dict[str, Any],
    logger: list[str] | None,
    init_from: str | None,
    video_every: int | None,
) -> Job:
    """A new run, its folder written before anything heavy is imported."""
    from rlcli.config.dump import to_data, to_yaml
    from rlcli.rl.job import Job
    from rlcli.rl.run import create_run

    record = begun(resolved, runs, record, logger, init_from, video_every)
    run = create_run(runs, resolved.source.name, name, to_yaml(to_data(resolved)), record)
    console.info(f"run {run.folder}")
    initial = record["init_from"]
    return Job(
        run,
        resolved,
        record["loggers"],
        init_from=Path(initial) if initial else None,
        video_every=record["video_every"],
    )


def begun(
    resolved: Resolved,
    runs: Path,
    record: dict[str, Any],
    logger: list[str] | None,
    init_from: str | None,
    video_every: int | None,
) -> dict[str, Any]:
    """What a new run's run.json says besides its seed and device."""
    from rlcli.config.dump import given
    from rlcli.config.settings import setting
    from rlcli.rl.environment import environment_record, file_digest
    from rlcli.rl.job import threads
    from rlcli.rl.loggers import check_loggers

    loggers = check_loggers(logger or setting("loggers"))
    _require_drawing(video_every)
    initial = None
    if init_from is not None:
        from rlcli.rl.choice import choose

        choice = choose(init_from, runs, resolved.source, any_task=True, tell=console.warn)
        initial = choice.folder
        console.info(f"weights of {initial} ({choice.why})")
    return record | {
        "task": resolved.source.record() | {"file": resolved.source.config.name},
        "agent": resolved.agent_name,
        "loggers": loggers,
        "video_every": video_every or 0,
        "init_from": str(initial) if initial else None,
        "init_from_sha256": file_digest(initial / "policy.safetensors") if initial else None,
        "given": given(resolved),
        **environment_record(resolved, *threads(resolved)),
    }


def resumed(
    reference: str,
    runs: Path,
    named: TaskSource | None,
    budget: dict[str, Any],
    logger: list[str] | None,
    video_every: int | None,
) -> Job | None:
    """A run to go on with; None if there is nothing left to do."""
    from rlcli.config.dump import to_data, to_yaml
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.job import Job
    from rlcli.rl.load import resolve_run
    from rlcli.rl.loggers import check_loggers
    from rlcli.rl.run import WAITING, require_own

    run, folder, why = _where_to_begin(reference, runs, None if named is None else named.name)
    if run.record.get("state") == "finished" and not budget and folder is not None:
        console.info(f"{run.folder} ({why}) is finished; --max-iterations N trains on")
        console.data(str(run.folder))
        step = open_checkpoint(folder).step
        console.document("train", run=str(run.folder), state="finished", checkpoint=str(folder), step=step)
        return None
    resolved = resolve_run(run, play=False, flags=budget, named=named)
    require_parallel(resolved)
    loggers = check_loggers(logger or run.record.get("loggers") or ["none"])
    every = run.record.get("video_every", 0) if video_every is None else video_every
    _require_drawing(every)
    require_own(run, ".")
    run.lock()
    try:
        from rlcli.rl.saving import clean

        clean(run.checkpoints)
        saved = None if folder is None else open_checkpoint(folder)
    except BaseException:
        run.unlock()
        raise
    if run.record.get("state") == WAITING:
        console.info(f"run {run.folder}")
    elif folder is None:
        console.info(f"{run.folder} ({why}) ended before its first checkpoint: it begins again")
    else:
        console.info(f"resuming {folder} ({why})")
    initial = run.record.get("init_from") if folder is None else None
    config = to_yaml(to_data(resolved)) if budget else None
    return Job(
        run,
        resolved,
        loggers,
        resume_from=saved,
        created=False,
        init_from=Path(initial) if initial else None,
        config=config,
        video_every=every,
    )


def _require_drawing(video_every: int | None) -> None:
    """What the first clip would fail for is said before training.

    Raises:
        DependencyError: if imageio is not installed.
        MachineError: if nothing on this machine can draw.
    """
    if not video_every:
        return
    from rlcli.sim.gl import open_context
    from rlcli.viewer.writer import check_video

    check_video(Path("clip.mp4"))
    context, _ = open_context(64, 64)
    context.free()


def _where_to_begin(reference: str, runs: Path, task: str | None) -> tuple[Run, Path | None, str]:
    """A run, the checkpoint to go on from, and why; no checkpoint if the run ended before it wrote one."""
    from rlcli.errors import CheckpointError, UsageError
    from rlcli.rl.run import find_checkpoint, find_run

    try:
        return find_checkpoint(reference, runs, task, whole=True, tell=console.warn)
    except CheckpointError:
        try:
            run, why = find_run(reference, runs, task)
        except (CheckpointError, UsageError):
            run = None
        if run is None or not _never_began(run):
            raise
        return run, None, why


def _never_began(run: Run) -> bool:
    """Whether a run's process was killed before the first checkpoint; one that has lost its checkpoints is damaged."""
    from rlcli.rl.checkpoint import steps

    return run.checkpoints.is_dir() and not steps(run.checkpoints) and "step" not in run.record


def agree(
    begin: Callable[[], Job | None],
    resolved: Resolved | None,
    named: TaskSource | None,
    budget: dict[str, Any],
    device: str,
) -> Job | None:
    """What is to be done: the process that leads says it, the others hear it."""
    from rlcli.rl import distributed

    if not distributed.leads():
        return _followed(distributed.join(device).share(), resolved, named, budget)
    try:
        job = begin()
    except Exception:
        distributed.join(device).share(None)  # the others wait for word
        raise
    try:
        peers = distributed.join(device)
        if job is not None and peers.size > 1 and job.created:
            job.run.update(processes=peers.size)
        peers.share(None if job is None else job.word())
    except BaseException:
        if job is not None and job.created:
            job.run.discard()
        raise
    return job


def _followed(
    word: dict[str, Any] | None, resolved: Resolved | None, named: TaskSource | None, budget: dict[str, Any]
) -> Job | None:
    """The job of a process that does not lead: nothing of it is written."""
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.job import Job
    from rlcli.rl.load import resolve_run
    from rlcli.rl.run import Run, open_run

    if word is None:
        return None
    folder = Path(word["run"])
    if resolved is not None:
        return Job(Run(folder, word["record"]), resolved, [], init_from=word["init_from"], writes=False)
    run = open_run(folder)
    resolved = resolve_run(run, play=False, flags=budget, named=named)
    saved = None if word["resume_from"] is None else open_checkpoint(Path(word["resume_from"]))
    return Job(run, resolved, [], resume_from=saved, created=word["created"], init_from=word["init_from"], writes=False)


def process_device(wanted: str, gpus: int | None) -> str:
    """The device of this process."""
    from rlcli.errors import DeviceError, UsageError
    from rlcli.rl import distributed

    several = gpus is not None or distributed.launched()
    if gpus is not None and wanted == "auto":
        wanted = "cuda"
    if gpus is not None and wanted != "cuda":
        raise UsageError(f"--gpus {gpus} and --device {wanted} contradict each other", hint="--gpus alone")
    device = choose_device(wanted)
    if not several or device == "cpu" or ":" in wanted:
        return device
    import torch

    number, processes = distributed.local()
    need, have = max(gpus or 1, processes), torch.cuda.device_count()
    if have < need:
        raise DeviceError(f"{need} processes need a GPU each, and torch sees {have}", hint=f"--gpus {have}")
    return f"cuda:{number}"


def fitting_device(resolved: Resolved, device: str, wanted: str) -> str:
    """The device, or the CPU where the GPU was not asked for and the trainer cannot use it."""
    from rlcli.errors import UsageError

    assert resolved.agent is not None
    assert resolved.trainer is not None
    if device == "cpu" or resolved.trainer.gpu:
        return device
    if wanted == "auto":
        return "cpu"
    raise UsageError(
        f"agent '{resolved.agent_name}' (trainer {resolved.agent.trainer}) trains on the CPU only, not on '{device}'",
        hint="--device cpu, or an agent whose trainer uses the GPU (trainer: ppo)",
    )


def require_parallel(resolved: Resolved, gpus: int = 1) -> None:
    """Several processes want a trainer that works in several.

    Raises:
        UsageError: if it does not.
    """
    from rlcli.errors import UsageError
    from rlcli.rl import distributed

    resolved.require_agent()
    assert resolved.agent is not None
    assert resolved.trainer is not None
    if (gpus > 1 or distributed.launched()) and not resolved.trainer.parallel:
        raise UsageError(
            f"trainer '{resolved.agent.trainer}' of agent '{resolved.agent_name}' trains in one process",
            hint="name an agent of trainer ppo with --agent",
        )
