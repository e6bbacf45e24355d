"""Which policy a command line means: a run's checkpoint, a bundle, or what is shipped with a task."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.config.load import Resolved, resolve
from rlcli.errors import CheckpointError, UsageError
from rlcli.registry import TaskSource
from rlcli.runs.bundle import Bundle, is_bundle, open_bundle
from rlcli.runs.restore import recorded_task, source_of
from rlcli.runs.run import Run
from rlcli.runs.run_ref import find_checkpoint, list_runs

SHIPPED = "shipped"
"""The reference of the policy that a task ships."""


@dataclass(frozen=True, slots=True)
class Choice:
    """A checkpoint or a bundle, and why it was chosen."""

    folder: Path
    why: str
    run: Run | None
    """The run of a checkpoint."""
    bundle: Bundle | None
    """What a bundle says."""

    def configure(
        self,
        named: TaskSource | None,
        *,
        play: bool = True,
        config_file: Path | None = None,
        overrides: Sequence[str] = (),
        flags: Mapping[str, Any] | None = None,
    ) -> Resolved:
        """The task to act in: that of the run as it was trained, or the installed one of a bundle.

        Args:
            named: the task that the command line names, if it does.
            play: apply the task's `play:` patch.
            config_file: see `rlcli.config.load.resolve`.
            overrides: likewise.
            flags: likewise.

        Raises:
            TaskError: if the task is not installed.
            CheckpointError: if the task is neither installed nor named.
        """
        source = self._bundle_source(named) if self.run is None else source_of(self.run, named)
        agent = None if self.bundle is None else self.bundle.agent
        return resolve(source, agent=agent, play=play, config_file=config_file, overrides=overrides, flags=flags)

    def _bundle_source(self, named: TaskSource | None) -> TaskSource:
        assert self.bundle is not None
        record = self.bundle.task
        if named is not None:
            return named
        if not record.get("distribution"):
            raise CheckpointError(
                f"{self.folder} is a policy for '{record['name']}', a task that was not installed",
                hint=f"name the task's folder: rlcli play FOLDER --checkpoint {self.folder}",
            )
        return recorded_task(record, f"the task of {self.folder}")


def choose(
    reference: str | None,
    runs_dir: Path,
    named: TaskSource | None,
    *,
    any_task: bool = False,
) -> Choice:
    """What a reference means; without one the task's newest run, else the policy shipped with the task.

    Args:
        reference: RUN, RUN@best, RUN@step:N, a folder, `latest` or `shipped`.
        runs_dir: the folder of runs.
        named: the task that the command line names, if it does.
        any_task: the policy may be of another task than that.

    Raises:
        CheckpointError: if there is no such policy.
        UsageError: if it is of another task than the one given.
    """
    name = None if named is None or any_task else named.name
    if reference == SHIPPED or (reference is None and _only_shipped(named, runs_dir)):
        return _shipped(named)
    if reference is not None and is_bundle(Path(reference)):
        found = open_bundle(Path(reference))
        if name is not None and found.task["name"] != name:
            raise UsageError(f"{reference} is a policy for {found.task['name']}, not for {name}", hint="leave out TASK")
        return Choice(found.folder, "as named", None, found)
    run, folder, why = find_checkpoint(reference or "latest", runs_dir, name)
    return Choice(folder, why, run, None)


def _only_shipped(named: TaskSource | None, runs_dir: Path) -> bool:
    """Whether a task has a policy that is shipped, and no run: not even one that is damaged, which is to be told."""
    if named is None or named.policy is None:
        return False
    if list_runs(runs_dir, named.name):
        return False
    records = (run / "run.json" for run in (runs_dir / named.name).glob("*"))
    return not any(os.path.lexists(record) for record in records)  # also a link that leads nowhere


def _shipped(named: TaskSource | None) -> Choice:
    if named is None:
        raise UsageError("--checkpoint shipped: with which task?", hint="name the task: rlcli play TASK")
    if named.policy is None:
        raise CheckpointError(f"{named.name} ships no policy", hint=f"rlcli train {named.name} makes one")
    owner = f"{named.distribution} {named.version}" if named.distribution else str(named.root)
    return Choice(named.policy, f"the policy shipped with {owner}", None, open_bundle(named.policy))
