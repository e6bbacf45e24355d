"""Training a run again: the same configuration, seed and threads, in a new run, to be compared with the first."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rlcli.config.load import Resolved
from rlcli.errors import CheckpointError, RlcliError, UsageError
from rlcli.rl import distributed
from rlcli.rl.checkpoint import open_checkpoint, steps
from rlcli.rl.compare import reached
from rlcli.rl.environment import built_record, differences
from rlcli.rl.load import require_fit, require_same_policy
from rlcli.rl.loggers import open_loggers
from rlcli.rl.run import Run, create_run
from rlcli.rl.stop import StopRequest
from rlcli.rl.train import Budget, Progress, fit

IRRELEVANT = ("engine_threads",)
"""Entries of the environment that change no bit: physics is the same at any number of threads."""


def require_reproducible(run: Run) -> None:
    """Bits are promised of a run by one process on the CPU.

    Raises:
        UsageError: for any other run, and for one without an iteration.
    """
    device, processes = str(run.record.get("device", "cpu")), run.record.get("processes", 1)
    if device != "cpu":
        raise UsageError(
            f"{run.folder} was trained on {device}, where sums have no fixed order: no bits are promised there",
            hint="train again with other seeds, and compare the policies with rlcli eval",
        )
    if processes != 1:
        raise UsageError(f"{run.folder} was trained by {processes} processes; one trains other bits")
    if reached(run) < 1:
        raise UsageError(f"{run.folder} has no iteration to reproduce")


def changed(run: Run, now: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """What the bits of a run depend on and is not as it was: (name, then, now)."""
    return [row for row in differences(run.record, now) if row[0] not in IRRELEVANT]


def milestones(run: Run, until: int) -> list[int]:
    """The iterations at which a run was saved, up to one, and that one."""
    saved = [open_checkpoint(run.checkpoints / f"{step:012d}").manifest for step in steps(run.checkpoints)]
    iterations = [entry["iteration"] for entry in saved if isinstance(entry.get("iteration"), int)]
    return sorted({i for i in iterations if 0 < i < until} | {until})


def train_again(
    original: Run,
    resolved: Resolved,
    runs_dir: Path,
    name: str,
    until: int,
    record: Mapping[str, Any],
    *,
    accept: Callable[[list[tuple[str, Any, Any]]], None],
    stop: StopRequest,
    show: Callable[[Progress], None] = lambda _: None,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Run, int]:
    """Train up to an iteration in a new run, saved where the original was; the run, and the step it reached.

    Args:
        original: the run to do again.
        resolved: its configuration.
        runs_dir: where the new run goes.
        name: part of its folder's name.
        until: the last iteration.
        record: what the environment is now, before anything was built.
        accept: told what differs once the environment is built; raises if that will not do.
        stop: asks to stop.
        show: told of the progress.
        tell: told the trainer's notes.
    """
    was = original.record
    kept: dict[str, Any] = {
        key: was[key]
        for key in ("seed", "device", "task", "agent", "init_from", "init_from_sha256", "given")
        if key in was
    }
    entries: dict[str, Any] = {**record, **kept, "torch_threads": int(was["torch_threads"]), "loggers": []}
    run = create_run(
        runs_dir,
        was["task"]["name"],
        name,
        original.config.read_text(encoding="utf-8"),
        {**entries, "reproduces": str(original.folder)},
    )
    try:
        trainer, env = _build(run, resolved)
        built = built_record(env.engine.model, "cpu")
        accept(changed(original, built))
    except BaseException:
        run.discard()
        raise
    state = "failed"
    sinks: list[Any] = []
    manifest = {
        **{key: run.record[key] for key in ("task", "agent", "seed")},
        "trainer": _agent(resolved).trainer,
        "layout": env.layout.record(),
        "versions": {"rlcli": run.record["rlcli"], **run.record["versions"]},
    }
    try:
        run.update(**built)
        sinks += open_loggers(run, [])
        for iteration in milestones(original, until):
            fit(
                trainer,
                run,
                Budget(iteration, None),
                loggers=sinks,
                save_interval=until + 1,
                manifest=manifest,
                show=show,
                tell=tell,
                divergences=lambda: env.divergences,
                stop=stop,
            )
        state = "finished"
    except BaseException:
        state = "stopped" if stop.signal is not None else "failed"
        raise
    finally:
        for sink in sinks:
            sink.close()
        with contextlib.suppress(OSError, RlcliError):
            run.update(state=state, step=trainer.env_steps, iteration=trainer.iteration)
        run.unlock()
        env.close()
    return run, trainer.env_steps


def _build(run: Run, resolved: Resolved) -> Any:
    """The environment and the trainer at the boundary where training begins, as `rlcli train` makes them."""
    from rlcli.envs.vec_env import make_env
    from rlcli.registry import load_object

    assert resolved.trainer is not None
    record, agent = run.record, _agent(resolved)
    env = make_env(resolved, seed=distributed.current().seed(record["seed"], "environments"))
    make = load_object(resolved.trainer.trainer)
    trainer = make(env, agent, seed=record["seed"], device="cpu", torch_threads=record["torch_threads"])
    if record.get("init_from"):
        initial = open_checkpoint(Path(record["init_from"]))
        was = record.get("init_from_sha256")
        if was is not None and initial.manifest["files"].get("policy.safetensors", {}).get("sha256") != was:
            raise CheckpointError(f"{initial.folder}: its policy is not the one that the run began with")
        require_fit(initial, env.layout)
        require_same_policy(initial, trainer.policy(), agent.trainer)
        trainer.load_weights(initial.tensors("policy"))
    trainer.start()
    return trainer, env


def _agent(resolved: Resolved) -> Any:
    assert resolved.agent is not None
    return resolved.agent
