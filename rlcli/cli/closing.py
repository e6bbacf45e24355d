"""`export --verify`: builds the environment that judges, lets the file drive, and says what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.cli.console import console

_SEED = 42
_MOST = 10
"""Places that are named."""


@dataclass(slots=True)
class Referee:
    """The run's environment, as an evaluation has it, and what plain code must know of it."""

    env: Any
    deployment: dict[str, Any]


def open_referee(choice: Any, checkpoint: Any, task: str | None) -> Referee:
    """Build the environment that a policy is for, without what corrupts observations: no file can know that.

    Args:
        choice: the `rlcli.rl.choice.Choice` that found the policy.
        checkpoint: what it found, opened.
        task: what the command line names.
    """
    import torch

    from rlcli.envs.deployment import describe
    from rlcli.envs.vec_env import make_env
    from rlcli.random import derive
    from rlcli.rl.load import require_fit
    from rlcli.rl.rng import seed_generators
    from rlcli.rl.trust import named_task

    named = None if task is None else named_task(task)
    resolved = choice.configure(named)
    corrupted = [name for name, group in resolved.task.observations.items() if group.enable_corruption]
    if corrupted:
        clean = [f"observations.{name}.enable_corruption=false" for name in corrupted]
        resolved = choice.configure(named, overrides=clean)
    torch.set_num_threads(1)
    seed_generators(derive(_SEED, "task"))
    env = make_env(resolved, seed=derive(_SEED, "evaluation"))
    require_fit(checkpoint, env.layout)
    return Referee(env, describe(env))


def close(referee: Referee, checkpoint: Any, file: Path, format_: str, episodes: int) -> dict[str, Any]:
    """Write the model and the program, drive, and tell. What is given back is the document's."""
    from rlcli.errors import listing
    from rlcli.random import derive
    from rlcli.rl.export_bundle import PROGRAM, program, write_model, write_program
    from rlcli.rl.export_record import unlike
    from rlcli.rl.load import policy_of
    from rlcli.rl.verify import verify

    env = referee.env
    model = write_model(env.spec, env.engine.model, file.parent)
    code = program(file, model, format_)
    if not write_program(file.parent, code):
        console.warn(
            f"{file.parent / PROGRAM} is not what would be written, and stays as it is: remove it for a new one"
        )
    console.info(f"{file.name} drives plain MuJoCo with {model.name} for {episodes} episodes")
    differing = unlike(checkpoint, env.layout.record(), referee.deployment, _draws(env))
    seed = derive(_SEED, "task")
    verdict = verify(env, policy_of(checkpoint), code, file, model, episodes, seed, differing)
    for what, terms in (("the metadata", verdict.by_metadata), ("the task's own code", verdict.by_task)):
        if terms:
            console.info(f"closed by {what}: {', '.join(terms)}")
    console.table(
        ["", "FOUND", "ALLOWED", ""],
        [[what, f"{x:.2e}", f"{most:g}", "holds" if held else "FAILS"] for what, x, most, held in verdict.rows()],
    )
    if differing:
        console.info(f"the metadata says something else than the task of {listing(differing[:_MOST])}")
    console.info(
        f"{verdict.episodes} episodes, mean return {verdict.driven:.6g} in plain MuJoCo, {verdict.evaluated:.6g} in"
        " the run's evaluation"
    )
    if verdict.beside is not None:
        console.info(
            f"every number agrees, and yet the returns part by {verdict.unaided:.2%}: the motion magnifies rounding;"
            f" lived side by side, with rounding set aside in each step, the mean return is {verdict.beside:.6g}, and"
            f" {verdict.parted} steps did not agree"
        )
    return {
        "passed": verdict.holds,
        "episodes": verdict.episodes,
        "steps": verdict.steps,
        "model": str(model),
        "program": str(file.parent / PROGRAM),
        "return": verdict.driven,
        "evaluation_return": verdict.evaluated,
        "side_by_side": None if verdict.beside is None else {"return": verdict.beside, "parted": verdict.parted},
        "checks": [
            {"check": what, "found": found, "allowed": allowed, "passed": held}
            for what, found, allowed, held in verdict.rows()
        ],
        "unlike": differing,
        "closed_by_metadata": verdict.by_metadata,
        "closed_by_task": verdict.by_task,
    }


def _draws(env: Any) -> bool:
    """Whether a task may draw gains or the state to start from: one that does more than to reset."""
    from rlcli.envs.direct import DirectEnv

    events = env.config.events.values()
    return isinstance(env, DirectEnv) or not all(event.func.startswith("reset_") for event in events)
