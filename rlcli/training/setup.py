"""Build the environment and the trainer of a training; for a resumed run, load the checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from rlcli.config.load import Resolved
from rlcli.envs.environment_protocol import Environment
from rlcli.envs.sharding.training_env import make_training_env
from rlcli.errors import CheckpointError, RlcliError, one_line
from rlcli.random import derive
from rlcli.registry import load_object
from rlcli.rl import distributed
from rlcli.rl.rng import seed_generators
from rlcli.rl.trainer import Trainer, TrainerState
from rlcli.runs.atomic_io import write_atomic
from rlcli.runs.checkpoint_fit import require_fit, require_same_policy, require_trainer
from rlcli.runs.checkpoint_reader import Checkpoint, open_checkpoint
from rlcli.training.checkpoint_writer import drop_after
from rlcli.training.job import Job, threads

_log = logging.getLogger(__name__)


def build_trainer(job: Job, device: str) -> tuple[Trainer, Environment]:
    """Return the trainer and its environment, in the state in which training starts.

    A resumed run gets the state of its checkpoint. If its budget changes, `config.yaml` is written last, after all
    operations that may fail.

    Raises:
        CheckpointError: if a checkpoint is corrupt, or does not fit the task or the agent.
    """
    resolved, record, saved = job.resolved, job.run.record, job.resume_from
    agent, _ = resolved.require_agent()
    state = None
    if saved is not None:  # read and check the untrusted files before anything is built
        require_trainer(saved, agent.trainer)
        state = saved.state()
    torch_threads = int(record.get("torch_threads") or threads(resolved)[1])
    trainer, env = make_trainer(resolved, record["seed"], device, torch_threads)
    if saved is not None and state is not None:
        _load_state(saved, state, trainer, env)
    elif job.init_from is not None:
        initial = open_checkpoint(job.init_from)
        require_fit(initial, env.layout)
        require_same_policy(initial, trainer.policy(), agent.trainer)
        _load(initial, lambda: trainer.load_weights(initial.tensors("policy")), "the weights do not fit the agent")
    if job.config is not None:
        write_atomic(job.run.config, job.config)
    if saved is None:
        trainer.start()
    elif job.writes and (dropped := drop_after(job.run.checkpoints, saved.step)):
        _log.info("removed later checkpoints, which the resumed run replaces: %s", len(dropped))
    return trainer, env


def make_trainer(resolved: Resolved, seed: int, device: str, torch_threads: int) -> tuple[Trainer, Environment]:
    """Return a new trainer and environment for a configuration; each rank derives its own seeds from `seed`.

    `torch_threads` is the number of threads of torch in the update.
    """
    agent, spec = resolved.require_agent()
    ranks = distributed.current()
    seed_generators(ranks.seed(derive(seed, "task"), "task"))  # a task may draw random numbers while it is built
    env = make_training_env(resolved, seed=ranks.seed(seed, "environments"), device=device)
    try:
        make: Callable[..., Trainer] = load_object(spec.trainer)
        return make(env, agent, seed=seed, device=device, torch_threads=torch_threads), env
    except BaseException:
        env.close()
        raise


def _load_state(saved: Checkpoint, state: TrainerState, trainer: Trainer, env: Environment) -> None:
    """Load the state of a checkpoint into the trainer and its environment, to resume a training.

    Raises:
        CheckpointError: if the state does not fit.
    """
    require_fit(saved, env.layout)
    _load(saved, lambda: trainer.load(state), "the run cannot be resumed", hint="choose another checkpoint: RUN@step:N")
    if (trainer.iteration, trainer.env_steps) != (saved.iteration, saved.step):
        message = f"{saved.folder} is corrupt: manifest.json and state.json have different steps"
        raise CheckpointError(message, hint="choose another checkpoint: RUN@step:N")
    processes, size = state.values.get("processes", 1), distributed.current().world_size
    if processes != size:
        change = f"the run was saved with {processes} processes and is resumed with {size}"
        _log.info(f"{change}: every environment starts a new episode")


def _load(saved: Checkpoint, load: Callable[[], Any], failure: str, hint: str | None = None) -> None:
    """Call `load`, which loads data of a checkpoint; turn its errors into a CheckpointError with the text `failure`.

    An error of rlcli is raised unchanged.
    """
    try:
        load()
    except RlcliError:
        raise
    except Exception as error:
        raise CheckpointError(f"{saved.folder}: {failure}: {one_line(error)}", hint=hint) from error
