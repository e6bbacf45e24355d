"""Start a training: create or resume its run, and return the `Job` (the run and its settings).

With several processes (ranks), rank 0 does this and broadcasts the job to the other ranks.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.config.dump import explicit_values, to_data, to_yaml
from rlcli.config.load import Resolved, resolve
from rlcli.envs.sharding.worker_count import number_of_workers
from rlcli.envs.sharding.worker_pool import close_early, start_early
from rlcli.errors import CheckpointError, DeviceError, UsageError
from rlcli.machine.devices import choose_device
from rlcli.rl import distributed
from rlcli.runs.provenance import environment_record, file_digest
from rlcli.runs.run import RECORD, WAITING, Run, create_run, initialize_run, open_run, require_own
from rlcli.settings import setting
from rlcli.training.job import Job, TrainingResult, threads
from rlcli.training.loggers import check_loggers

if TYPE_CHECKING:
    from rlcli.envs.environment_protocol import Environment
    from rlcli.registry import TaskSource
    from rlcli.rl.trainer import Trainer
    from rlcli.training.signals import StopRequest

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class TrainingRequest:
    """Options of `rlcli train`: a task with changes of its configuration, or a run to resume."""

    runs: Path
    """Folder of all runs."""
    source: TaskSource | None = None
    """The task; may be None if a run is resumed."""
    resume: str | None = None
    """Reference of the run to resume; None: a new run."""
    agent: str | None = None
    device: str = "auto"
    gpus: int | None = None
    """Number of processes to start on this machine, with one GPU each; None: not given."""
    config: Path | None = None
    overrides: list[str] = field(default_factory=list)
    flags: dict[str, Any] = field(default_factory=dict)
    """Dotted key -> value of settings that options such as `--num-envs` set."""
    budget: dict[str, Any] = field(default_factory=dict)
    """Dotted key -> value of the budget (`agent.max_iterations` and so on); empty: the agent's own budget."""
    seed: int = 42
    loggers: list[str] | None = None
    """Names of loggers; None: the user's setting, else TensorBoard if it is installed."""
    init_from: str | None = None
    """Reference of the checkpoint whose weights a new run starts with; None: random weights."""
    video_every: int | None = None
    """Number of iterations between videos; 0: no videos; None: as before for a resumed run, else no videos."""
    name: str | None = None
    """Text to add to the name of a new run's folder; None: no text."""

    def resolve(self, changes: Sequence[str] = ()) -> tuple[Resolved, str]:
        """Return the configuration and the device of a new run.

        Args:
            changes: overrides (`KEY=VALUE`) in addition to those of the command line.

        Raises:
            ConfigError: if the configuration is not valid.
            DeviceError: if the device is not available.
            UsageError: if the trainer does not support the device, or several processes.
        """
        assert self.source is not None
        device = process_device(self.device, self.gpus)
        resolved = resolve(
            self.source,
            agent=self.agent,
            device=device,
            config_file=self.config,
            overrides=[*self.overrides, *changes],
            flags={**self.flags, **self.budget},
        )
        _require_parallel(resolved, self.gpus or 1)
        return resolved, _trainer_device(resolved, device, self.device)


def broadcast_job(request: TrainingRequest, resolved: Resolved | None, device: str) -> Job | TrainingResult | None:
    """Create or resume the run on rank 0 and broadcast the job to the other ranks.

    Args:
        request: task and settings of the training, or the run to resume.
        resolved: configuration of a new run; None resumes a run.
        device: device of this process.

    Returns:
        The job. If the run is already finished: its result on rank 0, None on the other ranks.
    """
    if not distributed.is_rank_zero():
        message = distributed.join(device).broadcast_object()
        return None if message is None else _job_of_other_rank(message, request, resolved)
    try:
        job = resume_run(request) if resolved is None else new_run(request, resolved, device)
    except Exception:
        distributed.join(device).broadcast_object(None)  # the other ranks block until they receive a message
        raise
    if not isinstance(job, Job):
        distributed.join(device).broadcast_object(None)
        return job
    try:
        ranks = distributed.join(device)
        if ranks.world_size > 1 and job.created:
            job.run.update(processes=ranks.world_size)
        ranks.broadcast_object(job.message())
    except BaseException:
        if job.created:
            job.run.discard()
        raise
    return job


def new_run(request: TrainingRequest, resolved: Resolved, device: str) -> Job:
    """Create and lock a run, without importing torch and MuJoCo; return the job.

    Raises:
        CheckpointError, DependencyError: see `run_record`.
        MachineError: if the folder cannot be written.
    """
    record = run_record(request, resolved, device)
    config = to_yaml(to_data(resolved))
    run = create_run(request.runs, resolved.source.name, request.name, config, record)
    _log.info("run %s", run.shown)
    init_from = record["init_from"] and Path(record["init_from"])
    return Job(run, resolved, record["loggers"], init_from=init_from, video_every=record["video_every"])


def prepare_run(folder: Path, request: TrainingRequest, changes: Sequence[str] = ()) -> str:
    """Create a run in the state `waiting` in a folder, if the folder has no run yet; return the run's device.

    `changes` are overrides (`KEY=VALUE`) in addition to those of the request.

    Raises:
        UsageError: if the folder contains a run with other settings.
    """
    resolved, device = request.resolve(changes)
    if (folder / RECORD).is_file():
        recorded = open_run(folder).record.get("given")
        if recorded is not None and _overrides_in(recorded) != _overrides_in(explicit_values(resolved)):
            message = f"the folder {folder} has a run of a sweep with other settings"
            raise UsageError(message, hint="start a new sweep with another --name")
        return device
    for file in ("config.yaml", "checkpoints"):  # files of a process that was killed while it created the run
        path = folder / file
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
    record = run_record(request, resolved, device)
    initialize_run(folder, to_yaml(to_data(resolved)), {**record, "state": WAITING}).unlock()
    return device


def run_record(request: TrainingRequest, resolved: Resolved, device: str) -> dict[str, Any]:
    """Return the content of a new run's run.json.

    Raises:
        CheckpointError: if the checkpoint of `init_from` does not exist.
        DependencyError: if a logger or the video encoder is not installed.
    """
    loggers = check_loggers(request.loggers or setting("loggers"))
    _require_video(request.video_every)
    initial = None
    if request.init_from is not None:
        from rlcli.runs.policy_ref import choose

        choice = choose(request.init_from, request.runs, resolved.source, any_task=True)
        initial = choice.folder
        _log.info("starting with the weights of %s (%s)", initial, choice.why)
    return {
        "seed": request.seed,
        "device": device,
        "task": resolved.source.record() | {"file": resolved.source.config.name},
        "agent": resolved.agent_name,
        "loggers": loggers,
        "video_every": request.video_every or 0,
        "init_from": str(initial) if initial else None,
        "init_from_sha256": file_digest(initial / "policy.safetensors") if initial else None,
        "given": explicit_values(resolved),
        **environment_record(resolved, *threads(resolved)),
    }


def resume_run(request: TrainingRequest) -> Job | TrainingResult:
    """Open and lock a run, and return the job that continues the run.

    If the run is finished and the request has no new budget, return the run's result instead. A finished run that has
    lost its last checkpoints is continued, unless the request names a certain checkpoint.

    Raises:
        CheckpointError: if the run or its checkpoint cannot be read.
        UsageError: if the new budget is already spent.
        MachineError: if another process writes to the run.
    """
    from rlcli.runs.checkpoint_reader import open_checkpoint
    from rlcli.runs.recorded_task import resolve_run
    from rlcli.runs.run_ref import is_checkpoint_ref

    run, folder, why = _find_checkpoint(request)
    if run.record.get("state") == "finished" and not request.budget and folder is not None:
        step, last = open_checkpoint(folder).step, run.record.get("step", 0)
        if step >= last or is_checkpoint_ref(request.resume or ""):
            _log.info("%s (%s) is finished; --max-iterations N continues the run", run.folder, why)
            return TrainingResult(run.folder, folder, step)
        _log.warning(
            "%s has lost its last checkpoint: it was finished at step %s, and its newest good checkpoint has step %s;"
            " the training continues from there",
            run.folder,
            last,
            step,
        )
    _require_larger_budget(request, run, folder)
    resolved = resolve_run(run, play=False, flags=request.budget, named=request.source)
    _require_parallel(resolved)
    loggers = check_loggers(request.loggers or run.record.get("loggers") or ["none"])
    video_every = run.record.get("video_every", 0) if request.video_every is None else request.video_every
    _require_video(video_every)
    require_own(run, ".")
    run.lock()
    try:
        from rlcli.training.checkpoint_writer import remove_temporary_files

        remove_temporary_files(run.checkpoints)
        saved = None if folder is None else open_checkpoint(folder)
    except BaseException:
        run.unlock()
        raise
    if run.record.get("state") == WAITING:
        _log.info("run %s", run.shown)
    elif folder is None:
        _log.info("%s (%s) ended before its first checkpoint, so the training starts again", run.shown, why)
    else:
        _log.info("resuming %s (%s)", folder, why)
    initial = run.record.get("init_from") if folder is None else None
    return Job(
        run,
        resolved,
        loggers,
        resume_from=saved,
        created=False,
        init_from=Path(initial) if initial else None,
        config=to_yaml(to_data(resolved)) if request.budget else None,
        video_every=video_every,
    )


def setup_job(
    job: Job, device: str, stop: StopRequest, check_model: Callable[[Environment], None] = lambda _: None
) -> tuple[Trainer, Environment]:
    """Return the trainer and its environment, after all slow imports; if that fails, remove a new run.

    Args:
        job: run and settings of the training.
        device: device of the training.
        stop: stores signals; a signal ends the setup.
        check_model: called with the environment; raises an error if training must not start.

    Raises:
        Stopped: on a signal.
    """
    try:
        with stop.before_training(interruptible=not distributed.launched()):
            start_early(number_of_workers(job.resolved, device) - 1)
            from rlcli.training.setup import build_trainer

            trainer, env = build_trainer(job, device)
            check_model(env)
    except BaseException:
        close_early()
        if job.created and job.writes:
            job.run.discard()
        job.run.unlock()
        raise
    return trainer, env


def _job_of_other_rank(message: dict[str, Any], request: TrainingRequest, resolved: Resolved | None) -> Job:
    """Return the job of a rank other than 0, from the message that rank 0 has broadcast (`Job.message`).

    Such a rank does not write the run.
    """
    from rlcli.runs.checkpoint_reader import open_checkpoint
    from rlcli.runs.recorded_task import resolve_run

    folder = Path(message["run"])
    run = open_run(folder) if resolved is None else Run(folder, message["record"])
    if resolved is None:
        resolved = resolve_run(run, play=False, flags=request.budget, named=request.source)
    saved = None if message["resume_from"] is None else open_checkpoint(Path(message["resume_from"]))
    settings = {"created": message["created"], "init_from": message["init_from"], "writes": False}
    return Job(run, resolved, [], resume_from=saved, **settings)


def process_device(wanted: str, gpus: int | None) -> str:
    """Return the device of this process: with several processes, the GPU whose index is the process's local rank.

    Args:
        wanted: the option --device.
        gpus: the option --gpus; None: not given.

    Raises:
        DeviceError: if there are fewer GPUs than processes.
        UsageError: if --gpus and --device contradict each other.
    """
    if gpus is not None and wanted == "auto":
        wanted = "cuda"
    if gpus is not None and wanted != "cuda":
        raise UsageError(f"--gpus {gpus} and --device {wanted} contradict each other", hint="leave out --device")
    device = choose_device(wanted)
    one_process = gpus is None and not distributed.launched()
    if one_process or device == "cpu" or ":" in wanted:
        return device
    import torch

    local_rank, local_size = distributed.local_rank_and_size()
    need, have = max(gpus or 1, local_size), torch.cuda.device_count()
    if have < need:
        raise DeviceError(f"{need} processes need a GPU each, but torch finds {have}", hint=f"use --gpus {have}")
    return f"cuda:{local_rank}"


def _trainer_device(resolved: Resolved, device: str, wanted: str) -> str:
    """Return `device`, but `cpu` if the trainer cannot use a GPU and the option --device (`wanted`) is auto.

    Raises:
        UsageError: if the trainer cannot use the device that the user gave.
    """
    agent, trainer = resolved.require_agent()
    if device == "cpu" or trainer.gpu:
        return device
    if wanted == "auto":
        return "cpu"
    message = f"agent '{resolved.agent_name}' (trainer {agent.trainer}) trains on the CPU only, not on '{device}'"
    raise UsageError(message, hint="use --device cpu, or choose an agent with trainer: ppo")


def _require_parallel(resolved: Resolved, gpus: int = 1) -> None:
    """Check that the trainer supports several processes, if there are several.

    Raises:
        UsageError: if the trainer does not support several processes.
    """
    agent, trainer = resolved.require_agent()
    if (gpus > 1 or distributed.launched()) and not trainer.parallel:
        message = f"trainer '{agent.trainer}' of agent '{resolved.agent_name}' trains in one process only"
        raise UsageError(message, hint="choose an agent with trainer ppo: --agent NAME")


def _require_video(video_every: int | None) -> None:
    """Check before training that videos can be rendered and encoded.

    Raises:
        DependencyError: if imageio is not installed.
        MachineError: if this machine cannot render.
    """
    if not video_every:
        return
    from rlcli.sim.gl import open_context
    from rlcli.viewer.video_writer import check_video

    check_video(Path("clip.mp4"))
    context, _ = open_context(64, 64)
    context.free()


def _find_checkpoint(request: TrainingRequest) -> tuple[Run, Path | None, str]:
    """Return the run to resume, its checkpoint, and as text how the run was chosen.

    The checkpoint is None if the run ended before its first checkpoint.
    """
    from rlcli.runs.checkpoint_reader import steps
    from rlcli.runs.run_ref import find_checkpoint, find_run

    assert request.resume is not None
    task = None if request.source is None else request.source.name
    try:
        return find_checkpoint(request.resume, request.runs, task, whole=True)
    except CheckpointError:
        try:
            run, why = find_run(request.resume, request.runs, task)
        except (CheckpointError, UsageError):
            run = None
        # a run whose record has a step has had checkpoints: without any it is damaged
        if run is None or not run.checkpoints.is_dir() or steps(run.checkpoints) or "step" in run.record:
            raise
        return run, None, why


def _require_larger_budget(request: TrainingRequest, run: Run, folder: Path | None) -> None:
    """Check that a new --max-iterations or --max-steps of a resumed run is above what the checkpoint has done.

    Both options count from the start of the training. `folder` is the checkpoint; None: the run has no checkpoint.

    Raises:
        UsageError: if a new limit leaves nothing to train.
    """
    from rlcli.runs.checkpoint_reader import open_checkpoint

    if folder is None:
        return
    saved = open_checkpoint(folder)
    done = {"iterations": saved.iteration, "steps": saved.step}
    for unit, number in done.items():
        wanted = request.budget.get(f"agent.max_{unit}")
        if wanted is not None and wanted <= number:
            option = f"--max-{unit}"
            done_text = f"{run.folder} has {number:,} {unit}"
            message = f"{done_text}, and {option} counts from the run's start: {wanted:,} leaves nothing to train"
            hint = f"give more than {number}, or leave out {option} to keep the run's budget"
            raise UsageError(message, hint=hint)


def _overrides_in(given: object) -> Any:
    """Return the items of `given` whose values come from overrides of the command line.

    `given` is an entry of run.json: key of a setting -> origin of its value.
    """
    if not isinstance(given, dict):
        return given
    return {key: origin for key, origin in given.items() if str(origin).startswith("override")}
