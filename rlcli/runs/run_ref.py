"""Find the run or checkpoint that a command line names.

A reference is a folder, the name of a run, `latest`, `RUN@best` or `RUN@step:N`.
"""

import glob
import logging
import os
import re
from collections.abc import Iterable
from pathlib import Path

from rlcli.errors import CheckpointError, UsageError, did_you_mean, listing
from rlcli.registry.find import path_of
from rlcli.runs.run import RECORD, STUDY, Run, open_run, run_folders, runs_below, seconds_since
from rlcli.settings import setting

_log = logging.getLogger(__name__)


def find_run(reference: str, runs_dir: Path, task: str | None = None, *, with_policy: bool = False) -> tuple[Run, str]:
    """Find a run by its folder, its name, or `latest`; return the run and the reason for the choice, as text.

    Args:
        reference: the folder, the name, or `latest` (the run that was started last).
        runs_dir: the folder of runs.
        task: name of the task that the run must have; None: any.
        with_policy: whether `latest` skips runs that ended before they had a trained policy, with a warning.

    Raises:
        CheckpointError: if there is no such run.
        UsageError: if the run is of another task than `task`.
    """
    run, why = _find_run(reference, runs_dir, task, with_policy)
    if task is not None and not is_same_task(run.record["task"]["name"], task):
        raise UsageError(f"{run.folder} is a run of {run.record['task']['name']}, not of {task}", hint="leave out TASK")
    return run, why


def is_same_task(name: str, other: str) -> bool:
    """Return whether two names may be of one task: they are equal but for `-` and `_`.

    The installed task `pick-crane`, for example, has the folder `pick_crane`.
    """
    return name.replace("-", "_") == other.replace("-", "_")


def is_checkpoint_ref(reference: str) -> bool:
    """Return whether a reference names one checkpoint (its folder, or RUN@...) and not a run."""
    path = path_of(reference)
    return (path / "manifest.json").is_file() or ("@" in reference and not path.exists())


def find_runs(references: list[str], runs_dir: Path) -> list[Run]:
    """Find the runs of several references, each of which may name several runs.

    A reference is the folder or name of a run, `latest`, a task, a study, or a folder of runs.

    Raises:
        CheckpointError: if a reference names no run, or only broken ones.
    """
    found: list[Run] = []
    for reference in references:
        several = _runs_of_task(reference, runs_dir)
        if several:
            found += several
            continue
        run, why = find_run(reference, runs_dir)
        if reference == "latest":
            _log.info(f"{run.folder} ({why})")
        found.append(run)
    return found


def _runs_of_task(reference: str, runs_dir: Path) -> list[Run]:
    """Return the runs of a task, a study or a folder of runs; an empty list if the reference names a single run."""
    if reference == "latest" or (path_of(reference) / RECORD).is_file():
        return []
    found, refused = _list_runs(runs_dir, reference.rpartition(":")[2])
    studies = [] if os.sep in reference else sorted(runs_dir.glob(f"*/{glob.escape(reference)}"))
    for folder in (path_of(reference), runs_dir / reference, *studies):
        if not found and os.path.isdir(folder) and not (folder / RECORD).is_file():
            found, broken = _opened(runs_below(folder))
            refused = list(broken.values())
    if refused and not found:
        raise refused[0]
    _warn_of_skipped(refused)
    return found


def list_runs(runs_dir: Path, task: str | None) -> list[Run]:
    """Return the runs of a task (None: of all tasks) in the folder of runs, the oldest first, without broken ones."""
    return _list_runs(runs_dir, task)[0]


def _list_runs(runs_dir: Path, task: str | None) -> tuple[list[Run], list[CheckpointError]]:
    """Return the runs of a task (None: of all tasks), the oldest first, and the errors of runs that cannot be read."""
    runs, refused = _opened(run_folders(runs_dir))
    if task is None:
        return runs, list(refused.values())
    of_task = [error for folder, error in refused.items() if folder.is_relative_to(runs_dir / task)]
    return [run for run in runs if run.record["task"]["name"] == task], of_task


def _first_of(refused: list[CheckpointError]) -> str:
    """Return a text about the runs that cannot be read: the message of the first error, and the number of others."""
    more = f"; {len(refused) - 1} more are skipped" if len(refused) > 1 else ""
    return refused[0].message + more


def _warn_of_skipped(refused: list[CheckpointError]) -> None:
    if refused:
        _log.warning(f"a run is skipped: {_first_of(refused)}")


def _opened(folders: Iterable[Path]) -> tuple[list[Run], dict[Path, CheckpointError]]:
    """Open the runs in some folders; return the runs, the oldest first, and the error of each broken run by folder."""
    runs, refused = [], {}
    for folder in folders:
        try:
            runs.append(open_run(folder))
        except CheckpointError as error:
            if os.path.lexists(folder / RECORD):  # without run.json the folder is not a run
                refused[folder] = error
    return sorted(runs, key=lambda run: (str(run.record.get("started", "")), run.folder.name)), refused


def find_checkpoint(
    reference: str, runs_dir: Path, task: str | None = None, *, whole: bool = False
) -> tuple[Run, Path, str]:
    """Find a checkpoint by `RUN`, `RUN@best`, `RUN@step:N`, `latest` or its folder.

    `RUN` and `latest` stand for the newest valid checkpoint of the run. If only the policy is needed, `latest` skips
    runs that ended before they had a trained policy.

    Args:
        reference: the reference.
        runs_dir: the folder of runs.
        task: name of the task that the run must have; None: any. It is not checked for the folder of a checkpoint.
        whole: whether the whole checkpoint must be valid, so that it can be resumed; false: only its policy.

    Returns:
        The run, the checkpoint's folder, and the reason for the choice.

    Raises:
        CheckpointError: if there is no such checkpoint.
        UsageError: if the run is of another task than `task`.
    """
    from rlcli.runs.checkpoint_reader import steps

    folder = path_of(reference)
    if os.path.isfile(folder / "manifest.json"):  # Path.is_file raises an error for a name that is too long
        return open_run(folder.resolve().parent.parent), folder, "as named"
    name, _, which = (reference, "", "") if os.path.exists(folder) else reference.partition("@")
    run, why = find_run(name, runs_dir, task, with_policy=not whole)
    have = steps(run.checkpoints)
    if not have:
        message = f"{run.folder} has no complete checkpoint"
        raise CheckpointError(message, hint="choose another run, or train again with `rlcli train`")
    if not which:
        return run, *_newest_valid(run, have, why, whole)
    if which == "best":
        best = run.record.get("best")
        if best not in have:
            raise CheckpointError(
                f"{run.folder} has no best checkpoint: no evaluation during the training chose one, or it was deleted",
                hint="leave out @best to use the newest checkpoint, or train with agent.eval_interval=N",
            )
        return run, run.checkpoints / f"{best:012d}", "its best evaluation"
    kind, _, number = which.partition(":")
    if kind == "step" and re.fullmatch("[0-9]{1,30}", number):
        require_step(run, int(number))
        return run, run.checkpoints / f"{int(number):012d}", "as named"
    raise CheckpointError(
        f"'{reference}' does not name a checkpoint",
        hint="write RUN, RUN@best, RUN@step:N, the folder of a checkpoint, or latest",
    )


def require_step(run: Run, step: int) -> None:
    """Check that a run has a checkpoint at an environment step.

    Raises:
        CheckpointError: with the steps of the run's checkpoints.
    """
    from rlcli.runs.checkpoint_reader import steps

    have = steps(run.checkpoints)
    if step not in have:
        raise CheckpointError(
            f"{run.folder} has no checkpoint at step {step}",
            hint=f"the run has checkpoints at these steps: {listing(map(str, have))}",
        )


def _newest_valid(run: Run, have: list[int], why: str, whole: bool) -> tuple[Path, str]:
    """Return the newest valid checkpoint of a run, and the reason for the choice; log newer, corrupt checkpoints.

    Args:
        run: the run.
        have: environment steps of the run's checkpoints, ascending.
        why: the reason why the run was chosen.
        whole: whether the whole checkpoint must be valid; false: only its policy.

    Raises:
        CheckpointError: if no checkpoint is valid, the newest valid one has another format, or it is the untrained
            policy of step 0 although the run has newer, corrupt checkpoints.
    """
    from rlcli.runs.checkpoint_reader import FormatError, open_checkpoint

    for skipped, step in enumerate(reversed(have)):
        folder = run.checkpoints / f"{step:012d}"
        try:
            open_checkpoint(folder).verify(whole=whole)
        except FormatError:
            raise
        except CheckpointError as error:
            if skipped == len(have) - 1:
                raise
            _log.warning(f"checkpoint {folder.name} is skipped: {error.message}")
            continue
        if skipped and step == 0:
            message = f"{run.folder} has no intact checkpoint except for step 0, before the training"
            hint = "restore a newer checkpoint from a backup; to use the untrained policy, write RUN@step:0"
            raise CheckpointError(message, hint=hint)
        return folder, f"{why}, its newest {'good ' if skipped else ''}checkpoint"
    raise AssertionError("bug in rlcli: find_checkpoint must not pass a run without checkpoints")


def _is_of_sweep(run: Run) -> bool:
    """Return whether a run is in the folder of a sweep."""
    from rlcli.runs.study import read_study

    if not (run.folder.parent / STUDY).is_file():
        return False
    try:
        read_study(run.folder.parent, "sweep")
    except CheckpointError:
        return False
    return True


def default_runs_dir() -> Path:
    """Return the folder of runs: RLCLI_RUNS_DIR, else the user's setting, else `runs` in the current folder."""
    return Path(os.environ.get("RLCLI_RUNS_DIR") or os.path.expanduser(setting("runs_dir") or "runs"))


def _has_trained_policy(run: Run) -> bool:
    """Return whether a run has a checkpoint; that of step 0 counts only until the training has ended early."""
    from rlcli.runs.checkpoint_reader import steps

    have = steps(run.checkpoints)
    return bool(have) and (have != [0] or run.record.get("state") not in ("failed", "diverged", "stopped"))


def _find_run(reference: str, runs_dir: Path, task: str | None, with_policy: bool) -> tuple[Run, str]:
    if reference == "latest":
        runs, refused = _list_runs(runs_dir, task)
        of_task = f" of {task}" if task else ""
        if not runs and refused:
            message = f"there is no valid run{of_task} in {runs_dir}: {_first_of(refused)}"
            raise CheckpointError(message, hint=refused[0].hint)
        if not runs:
            near = (
                did_you_mean(task, [run.record["task"]["name"] for run in list_runs(runs_dir, None)]) if task else None
            )
            hint = "; ".join(filter(None, (near, f"rlcli train {task or 'TASK'} starts one")))
            raise CheckpointError(f"there is no run{of_task} in {runs_dir.absolute()}", hint=hint)
        # trials of a sweep may be pruned or have poor settings, so they are used only if the user names them
        newest = next((run for run in reversed(runs) if not _is_of_sweep(run)), runs[-1])
        is_trial = _is_of_sweep(newest)
        what = "newest trial of a sweep" if is_trial else "newest run"
        if with_policy and not _has_trained_policy(newest):
            earlier = (run for run in reversed(runs) if _is_of_sweep(run) == is_trial and _has_trained_policy(run))
            trained = next(earlier, newest)
            if trained is not newest:
                _log.warning(f"{newest.folder} is skipped: it has no trained policy ({newest.record.get('state')})")
                newest, what = trained, f"{what} with a trained policy"
        if seconds_since(newest.record.get("started")) < -60:
            _log.warning(
                f"{newest.folder} started in the future by this machine's clock, so that `latest` may not be the run"
                " that was started last; name the run"
            )
        _warn_of_skipped(refused)
        return newest, f"{what} of {task}" if task else f"{what} in {runs_dir}"
    for candidate in (path_of(reference), runs_dir / reference, *([runs_dir / task / reference] if task else [])):
        if os.path.isfile(candidate / RECORD):
            return open_run(candidate), "as named"
        if os.path.isfile(candidate / STUDY):
            inside = sorted(file.parent.name for file in candidate.glob(f"*/{RECORD}"))
            message = f"{candidate} is a study of several runs"
            draws = f"`rlcli plot {candidate}` plots all of its runs"
            first = f"name one, such as {candidate / inside[0]} ({listing(inside)}); " if inside else ""
            raise CheckpointError(message, hint=first + draws)
    runs, broken = _opened(run_folders(runs_dir))
    matches = [run for run in runs if run.folder.name == reference]
    if len(matches) == 1:
        return matches[0], "as named"
    for folder, error in broken.items():
        if folder.name == reference:
            raise error
    if os.path.isfile(path_of(reference)):
        raise CheckpointError(
            f"'{reference}' is a file, not the folder of a run, a checkpoint or a bundle",
            hint="of exported policies, rlcli reads only bundles: rlcli export --format bundle",
        )
    folders = [run.folder.parent if (run.folder.parent / STUDY).is_file() else run.folder for run in runs]
    names = list(dict.fromkeys(folder.name for folder in folders))
    named = [repr(name) for name in names if name.endswith(f"-{reference}")]  # a folder's name is TIME-NAME
    near = f"did you mean {' or '.join(named[-3:])}?" if named else None
    near = near or did_you_mean(reference, [*names, *(run.folder.name for run in runs), "latest", "shipped"])
    raise CheckpointError(f"no run '{reference}'", hint=near or f"runs in {runs_dir.absolute()}: {listing(names[-5:])}")
