"""From a job to its environment and trainer, at the boundary where training begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rlcli.envs.vec_env import make_env
from rlcli.errors import CheckpointError, RlcliError
from rlcli.random import derive
from rlcli.registry import load_object
from rlcli.rl import distributed
from rlcli.rl.checkpoint import open_checkpoint
from rlcli.rl.files import write_atomic
from rlcli.rl.job import Job, threads
from rlcli.rl.load import require_fit, require_same_policy, require_trainer
from rlcli.rl.rng import seed_generators
from rlcli.rl.saving import drop_after


def build(job: Job, device: str, say: Callable[[str], None] = lambda _: None) -> tuple[Any, Any]:
    """The trainer and its environment.

    Args:
        job: what is to be trained; its configuration is written once it is sure that it goes on.
        device: where.
        say: hears what is different from before.

    Raises:
        CheckpointError: if a checkpoint does not fit.
    """
    resolved, record = job.resolved, job.run.record
    assert resolved.trainer is not None
    assert resolved.agent is not None
    peers, saved = distributed.current(), job.resume_from
    state = None
    if saved is not None:  # what a stranger's files hold shows before anything is built
        require_trainer(saved, resolved.agent.trainer)
        state = saved.state()
    make = load_object(resolved.trainer.trainer)
    seed_generators(peers.seed(derive(record["seed"], "task"), "task"))  # some tasks draw from them as they are built
    env = make_env(resolved, seed=peers.seed(record["seed"], "environments"), device=device)
    torch_threads = int(record.get("torch_threads") or threads(resolved)[1])
    trainer = make(env, resolved.agent, seed=record["seed"], device=device, torch_threads=torch_threads)
    if saved is None or state is None:
        if job.init_from is not None:
            initial = open_checkpoint(job.init_from)
            require_fit(initial, env.layout)
            require_same_policy(initial, trainer.policy(), resolved.agent.trainer)
            _take(initial, lambda: trainer.load_weights(initial.tensors("policy")), "its weights do not fit the agent")
        if job.config is not None:
            write_atomic(job.run.config, job.config)
        trainer.start()
        return trainer, env
    require_fit(saved, env.layout)
    _take(saved, lambda: trainer.load(state), "it cannot be resumed")
    if (trainer.iteration, trainer.env_steps) != (saved.iteration, saved.step):
        raise CheckpointError(f"{saved.folder} cannot be resumed: its manifest and its state name different steps")
    processes = state.values.get("processes", 1)
    if processes != peers.size:
        say(f"saved by {processes} processes, going on in {peers.size}: every environment begins a new episode")
    if job.config is not None:  # only now is it sure that the run goes on
        write_atomic(job.run.config, job.config)
    dropped = drop_after(job.run.checkpoints, saved.step) if job.writes else []
    if dropped:
        say(f"removed {len(dropped)} later checkpoints: they are not what comes next")
    return trainer, env


def _take(saved: Any, load: Any, failure: str) -> None:
    try:
        load()
    except RlcliError:
        raise
    except Exception as error:  # whatever a stranger's numbers lead to
        raise CheckpointError(f"{saved.folder}: {failure}: {' '.join(str(error).split())}") from error
