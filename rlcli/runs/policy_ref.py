"""Find the policy that a command line names: a checkpoint of a run, a bundle, or the policy shipped with a task.

A bundle is a folder with a policy alone, which `rlcli export --format bundle` writes. Shipped policies are bundles.
"""

import os
from dataclasses import dataclass
from pathlib import Path

from rlcli.errors import CheckpointError, UsageError
from rlcli.registry import TaskSource
from rlcli.registry.find import path_of
from rlcli.registry.task_location import task_reference
from rlcli.runs.checkpoint_reader import Checkpoint
from rlcli.runs.policy_bundle import is_bundle, open_bundle
from rlcli.runs.recorded_task import recorded_task, source_of
from rlcli.runs.run import Run
from rlcli.runs.run_ref import find_checkpoint, is_same_task, list_runs

SHIPPED = "shipped"
"""Word that refers to the policy which comes with a task, as in `--checkpoint shipped`."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The policy that a command uses: the folder of a checkpoint or a bundle, and the reason for the choice."""

    folder: Path
    why: str
    """The reason for the choice, as text for the user, such as `as named`."""
    run: Run | None
    """The run of a checkpoint; None for a bundle, and for a checkpoint folder outside a run."""
    bundle: Checkpoint | None
    """The bundle; None for any other checkpoint."""

    @property
    def agent(self) -> str | None:
        """Name of the agent that a bundle was trained with; None for a run, whose configuration names it."""
        return None if self.bundle is None else self.bundle.manifest.get("agent")

    def source(self, named: TaskSource | None) -> TaskSource:
        """Return the task of the policy: for a run its recorded configuration, for a bundle the installed task.

        Args:
            named: the task on the command line; None: no task was named.

        Raises:
            TaskError: if the task is not installed.
            CheckpointError: if the task is not trusted, or is neither installed nor named.
        """
        if self.run is not None:
            return source_of(self.run, named)
        assert self.bundle is not None
        record = self.bundle.manifest["task"]
        if named is not None:
            return named
        if not record.get("distribution"):
            message = (
                f"{self.folder} is a policy for the task '{record['name']}', which is not part of an installed package"
            )
            hint = f"name the folder of the task: `rlcli play FOLDER --checkpoint {self.folder}`"
            raise CheckpointError(message, hint=hint)
        return recorded_task(record, f"the task of {self.folder}")


def choose(
    reference: str | None,
    runs_dir: Path,
    named: TaskSource | None,
    *,
    any_task: bool = False,
) -> Choice:
    """Return the policy that a reference names.

    Without a reference, return the policy of the task's newest run; if the task has no run, its shipped policy.

    Args:
        reference: RUN, RUN@best, RUN@step:N, a folder, `latest` or `shipped`.
        runs_dir: the folder of runs.
        named: the task on the command line; None: no task was named.
        any_task: whether a policy of another task is accepted.

    Raises:
        CheckpointError: if there is no such policy.
        UsageError: if the policy is for another task than `named`, or `shipped` is given without a task.
    """
    name = None if named is None or any_task else named.name
    if reference == SHIPPED or (reference is None and _has_only_shipped(named, runs_dir)):
        return _shipped(named)
    if reference is not None and is_bundle(path_of(reference)):
        found = open_bundle(Path(reference))
        owner = found.manifest["task"]["name"]
        if name is not None and not is_same_task(owner, name):
            raise UsageError(f"{reference} is a policy for {owner}, not for {name}", hint="leave out the task")
        return Choice(found.folder, "as named", None, found)
    run, folder, why = find_checkpoint(reference or "latest", runs_dir, name)
    return Choice(folder, why, run, None)


def _has_only_shipped(named: TaskSource | None, runs_dir: Path) -> bool:
    """Return whether a task ships a policy and has no run. A damaged run counts, so that its error is reported."""
    if named is None or named.policy is None:
        return False
    if list_runs(runs_dir, named.name):
        return False
    records = (run / "run.json" for run in (runs_dir / named.name).glob("*"))
    return not any(os.path.lexists(record) for record in records)  # True also for a broken link


def _shipped(named: TaskSource | None) -> Choice:
    if named is None:
        raise UsageError("--checkpoint shipped needs a task", hint="name the task: `rlcli play TASK`")
    if named.policy is None:
        raise CheckpointError(
            f"{named.name} ships no policy", hint=f"rlcli train {task_reference(named.record())} trains one"
        )
    owner = f"{named.distribution} {named.version}" if named.distribution else str(named.root)
    return Choice(named.policy, f"the policy shipped with {owner}", None, open_bundle(named.policy))
