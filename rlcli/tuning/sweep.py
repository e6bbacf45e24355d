"""Sweeps: search for good settings of a task or agent with Optuna.

A trial is a training with certain values of the varied settings; its run is in the sweep's folder. Any number of
processes can run trials of the same sweep at the same time.
"""

from __future__ import annotations

import contextlib
import platform
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from filelock import FileLock, Timeout

from rlcli.config.dump import to_yaml
from rlcli.errors import CheckpointError, MachineError, UsageError, listing
from rlcli.random import derive
from rlcli.reporting.matplotlib_plots import check_drawing, scatter
from rlcli.runs.atomic_io import disk_error, disk_errors, to_json, write_atomic
from rlcli.runs.run import STUDY, RecordedTask
from rlcli.runs.safe_io import Count, FileModel, PrintableText, check_json
from rlcli.runs.study import read_study, require_plain_study
from rlcli.tuning.optuna_storage import JOURNAL, open_study, without_password
from rlcli.tuning.search_space import Parameter, read_parameters

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

PRESET = "best.yaml"
PICTURE = "sweep.svg"
_SWEEP_LOCK, _TRIAL_LOCK = ".sweep", ".worker"
_SETTINGS = "rlcli"
"""Name of the user attribute of Optuna's study that stores the settings of the sweep."""
_LOCATION = "place"
"""Name of the user attribute of a trial that stores the machine and the folder where the trial can be resumed."""
_SURPLUS = "surplus"
"""Name of the user attribute of trials to ignore: those beyond `--trials`; another machine began the last one."""
_ENDED = ("COMPLETE", "PRUNED", "FAIL")


class _SweepSettings(FileModel):
    """Settings of a sweep, as stored in `study.json` and in the user attribute `rlcli` of Optuna's study."""

    task: PrintableText
    name: PrintableText
    agent: PrintableText
    objective: PrintableText
    direction: Literal["maximize", "minimize"]
    pruner: Literal["median", "none"]
    trials: Count
    episodes: Count
    seed: Count
    params: list[str]
    overrides: list[str]
    flags: dict[str, Any]
    config: str | None = None
    storage: PrintableText | None = None


class _SweepRecord(_SweepSettings):
    """Content of a sweep's `study.json`: its settings, and where its task comes from."""

    source: RecordedTask


class _TrialNotes(FileModel):
    """Entries that a sweep stores with a trial: training time [s], environment steps, error, reports to the pruner."""

    seconds: float | None = None
    step: Count | None = None
    why: str | None = None
    reports: list[float]


class _FinishedTrial(_TrialNotes):
    """Entries of a finished trial: those of every trial, and the value of the objective."""

    values: tuple[float]


@dataclass(slots=True)
class Trial:
    """Trial that this process runs: while the process holds the trial's lock, no other process runs the trial."""

    number: int
    folder: Path
    trial: optuna.Trial
    """Optuna's object for the trial."""
    values: dict[str, Any]
    """Key of a parameter -> value."""
    _lock: FileLock

    def release(self) -> None:
        """Release the trial's lock, so that another process can continue the trial."""
        self._lock.release()


@dataclass(slots=True)
class Sweep:
    """Hyperparameter search: its folder, its settings, the varied parameters, and Optuna's study with the trials."""

    folder: Path
    settings: dict[str, Any]
    parameters: list[Parameter]
    study: optuna.Study
    _claimed: dict[int, Trial] = field(default_factory=dict)

    def trials(self) -> list[FrozenTrial]:
        """Return the trials in the order of their numbers, without trials beyond the number `--trials`.

        Raises:
            CheckpointError: if the storage holds damaged entries of a trial, such as a result that is not finite.
        """
        trials = [trial for trial in self.study.get_trials(deepcopy=False) if _SURPLUS not in trial.user_attrs]
        for trial in trials:
            kind = _FinishedTrial if trial.state.name == "COMPLETE" else _TrialNotes
            reports = list(trial.intermediate_values.values())
            notes = {**trial.user_attrs, "values": trial.values, "reports": reports}
            check_json(kind, notes, self.folder, f"trial {trial.number}")
            for parameter in self.parameters:
                known = parameter.key in trial.params
                if not (parameter.is_valid(trial.params[parameter.key]) if known else kind is not _FinishedTrial):
                    message = f"{self.folder} is corrupt: trial {trial.number} has no valid value of {parameter.key}"
                    raise CheckpointError(message, hint="choose another --name for a new sweep")
        return trials

    def ended(self) -> list[FrozenTrial]:
        """Return the trials that are finished, pruned or failed."""
        return [trial for trial in self.trials() if trial.state.name in _ENDED]

    def same_objective(self) -> float | None:
        """Return the objective's value if at least two trials are finished and all have the same value; else None."""
        values = [trial.value for trial in self._finished()]
        return values[0] if len(values) > 1 and len(set(values)) == 1 else None

    def _finished(self) -> list[FrozenTrial]:
        return [trial for trial in self.trials() if trial.state.name == "COMPLETE"]

    def best(self) -> FrozenTrial | None:
        """Return the finished trial with the best objective (the first of equal ones); None if no trial is finished."""
        done = self._finished()
        if not done:
            return None
        better = max if self.settings["direction"] == "maximize" else min
        return better(done, key=lambda trial: (trial.value, -trial.number if better is max else trial.number))

    def values(self, trial: FrozenTrial | optuna.Trial) -> dict[str, Any]:
        """Return the values of a trial's parameters: dotted key -> value."""
        return {p.key: p.value(trial.params[p.key]) for p in self.parameters if p.key in trial.params}

    def overrides(self, values: Mapping[str, Any]) -> list[str]:
        """Return a trial's values (the result of `values`) as overrides: `KEY=VALUE` for each parameter."""
        return [p.override(values[p.key]) for p in self.parameters if p.key in values]

    def trial_folder(self, number: int) -> Path:
        """Return the folder of the run of a trial, which has the number `number`."""
        return self.folder / f"trial-{number:04d}"

    def document(self, trial: FrozenTrial) -> dict[str, Any]:
        """Return a trial as JSON data: number, state, objective, parameters, run, training time, steps, error."""
        folder = self.trial_folder(trial.number)
        return {
            "trial": trial.number,
            "state": trial.state.name.lower(),
            "value": trial.value if trial.state.name == "COMPLETE" else None,
            "params": self.values(trial),
            "run": str(folder) if folder.is_dir() else None,
            "seconds": trial.user_attrs.get("seconds"),
            "step": trial.user_attrs.get("step"),
            "why": trial.user_attrs.get("why"),
        }

    def claim(self) -> Trial | None:
        """Return a trial for this process to run; None if `--trials` trials have started.

        An unfinished trial whose process has ended comes first, then a new trial. Because of locks, a trial runs in
        only one process, and at most `--trials` trials start.
        """
        with _locked(self.folder / _SWEEP_LOCK):
            for trial in self.trials():
                if trial.state.name != "RUNNING" or trial.number in self._claimed or not self._is_here(trial):
                    continue
                lock = self._lock_trial(trial.number)
                if lock is None:
                    continue
                # another process may have ended this trial before the lock was taken
                if any(other.number == trial.number for other in self.ended()):
                    lock.release()
                    continue
                return self._claim(lock, self._with_own_sampler(trial))
            if len(self.trials()) >= self.settings["trials"]:
                return None
            new = self.study.ask()
            new.set_user_attr(_LOCATION, self._here)
            if sum(trial.number < new.number for trial in self.trials()) >= self.settings["trials"]:
                new.set_user_attr(_SURPLUS, True)  # another machine has started the last trial
                self.study.tell(new, state=_state("FAIL"))
                return None
            lock = self._lock_trial(new.number)
            if lock is None:
                folder = self.trial_folder(new.number)
                raise MachineError(f"another process writes to {folder}; wait until that process has ended")
            return self._claim(lock, self._with_own_sampler(new))

    def tell(self, trial: Trial, value: float | None = None, *, state: str | None = None, **notes: Any) -> None:
        """Store the result of an ended trial, and release its lock.

        Args:
            trial: the trial.
            value: value of the objective; None for a trial without a result.
            state: state of a trial without a result: `PRUNED` or `FAIL`.
            notes: entries to store with the trial: `seconds` (training time [s]), `step` (environment steps), `why`.
        """
        for key, note in notes.items():
            trial.trial.set_user_attr(key, note)
        self.study.tell(trial.trial, value, state=_state(state))
        self._claimed.pop(trial.number, None)
        trial.release()

    def write_preset(self, data: Callable[[Mapping[str, Any]], Mapping[str, Any]]) -> Path | None:
        """Write a `--config` file with the settings of the best trial; return the file, None if no trial is finished.

        Args:
            data: returns the content of the file for a trial's values (key -> value).

        Raises:
            MachineError: if the file cannot be written.
        """
        with _locked(self.folder / _SWEEP_LOCK):  # another process may have stored a better trial
            best = self.best()
            if best is None:
                return None
            score = f"{self.settings['objective']} = {best.value:.6g}"
            title = f"# {self.settings['task']}: trial {best.number} of {self.folder.name}, {score}\n"
            write_atomic(self.folder / PRESET, title + to_yaml(dict(data(self.values(best)))))
        return self.folder / PRESET

    def release(self) -> None:
        """Release the locks of this process's unfinished trials, so that other processes can continue the trials."""
        for trial in self._claimed.values():
            trial.release()
        self._claimed.clear()

    @property
    def _here(self) -> str:
        """`MACHINE:FOLDER` of this process, where its trials can be resumed."""
        return f"{platform.node()}:{self.folder.resolve()}"

    def _is_here(self, trial: FrozenTrial) -> bool:
        """Return whether a trial was started in this folder on this machine, so that it can be resumed here.

        Without a database, all trials of the sweep were started here, because their list is a file in the folder.
        """
        return self.settings["storage"] is None or trial.user_attrs.get(_LOCATION) == self._here

    def _lock_trial(self, number: int) -> FileLock | None:
        """Create the folder of a trial, and return its lock; None if another process holds the lock."""
        folder = self.trial_folder(number)
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / _TRIAL_LOCK)
        with contextlib.suppress(Timeout):
            lock.acquire(timeout=0)
            return lock
        return None

    def _with_own_sampler(self, trial: FrozenTrial | optuna.Trial) -> optuna.Trial:
        """Return Optuna's object for a trial, which draws values with a sampler of its own.

        The sampler's seed depends only on the sweep's seed and the trial's number. Existing values are kept.
        """
        import optuna

        self.study.sampler = _sampler(derive(self.settings["seed"], f"trial {trial.number}"))
        return optuna.trial.Trial(self.study, trial._trial_id)

    def _claim(self, lock: FileLock, trial: optuna.Trial) -> Trial:
        """Draw the values of a trial whose lock this process holds, and return the trial."""
        for parameter in self.parameters:
            parameter.suggest(trial)
        taken = Trial(trial.number, self.trial_folder(trial.number), trial, self.values(trial), lock)
        self._claimed[taken.number] = taken
        return taken


def open_sweep(
    folder: Path,
    settings: dict[str, Any],
    source: Mapping[str, Any],
    parameters: list[Parameter],
    storage: str | None,
) -> Sweep:
    """Create a sweep in a folder, or join the existing one.

    Args:
        folder: the folder of the sweep; created if it does not exist.
        settings: entries of `_SweepSettings`; except for `trials`, they must equal those of the existing sweep.
        source: entries of `RecordedTask`, with the place of the task; they must equal those of the existing sweep.
        parameters: the keys of the task or agent that the sweep varies, with their ranges.
        storage: URL of a database for the trials; None: the file `JOURNAL` in the folder.

    Raises:
        UsageError: if the folder or the storage holds a sweep with other settings, or another kind of study.
        CheckpointError: if the files of the sweep are damaged.
        MachineError: if the storage cannot be reached, or the folder cannot be written.
    """
    require_plain_study(folder)
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    record = {"kind": "sweep", **settings, "source": dict(source)}
    with _locked(folder / _SWEEP_LOCK):
        exists = (folder / STUDY).is_file()
        if exists:
            _require_same(folder, _read_record(folder), record)
        study = open_study(folder, settings, storage, create=storage is not None or not exists)
        known = study.user_attrs.get(_SETTINGS)
        if known is not None:
            where = folder / JOURNAL if storage is None else Path(without_password(storage))
            check_json(_SweepSettings, known, where, _SETTINGS)
            _require_same(storage or folder, known, settings)
        study.set_user_attr(_SETTINGS, settings)
        write_atomic(folder / STUDY, to_json(record))
    return Sweep(folder, record, parameters, study)


def read_sweep(folder: Path, storage: str | None = None) -> Sweep:
    """Open an existing sweep for reading; `storage` is the URL of the database with its trials, None if none is used.

    Raises:
        CheckpointError: if the sweep does not exist or is damaged.
        MachineError: if its storage cannot be reached.
        UsageError: if the trials are in a database and `storage` is None.
    """
    settings = _read_record(folder)
    if settings.get("storage") and storage is None:
        raise UsageError(f"{folder} has its trials in a database", hint="add the --storage URL of the sweep")
    study = open_study(folder, settings, storage, create=False)
    try:
        parameters = read_parameters(settings["params"])
    except UsageError as error:
        hint = "restore the file from a backup, or start a new sweep in another folder"
        raise CheckpointError(f"{folder / STUDY} is corrupt: params: {error.message}", hint=hint) from None
    return Sweep(folder, settings, parameters, study)


def _read_record(folder: Path) -> dict[str, Any]:
    """Return the content of a sweep's `study.json`.

    Raises:
        CheckpointError: if the folder has no sweep, or an entry has a wrong type.
    """
    record = read_study(folder, "sweep")
    check_json(_SweepRecord, record, folder / STUDY, hint="start a new sweep with another --name")
    return record


def find_sweep(words: Sequence[str], runs: Path, storage: str | None) -> Sweep:
    """Open a sweep by its folder or its name; without a name, open the newest sweep.

    Args:
        words: folder or name of the sweep; empty: the newest sweep.
        runs: folder of all runs.
        storage: URL of the database with the trials; None: the trials are in the sweep's folder.

    Raises:
        CheckpointError: if there is no such sweep, or its files are damaged.
        UsageError: for several names, or a name that several sweeps have.
    """
    if len(words) > 1:
        raise UsageError("more than one sweep is named", hint="give one folder of a sweep or one name")
    known = sorted(file.parent for file in runs.glob(f"*/sweep-*/{STUDY}"))
    if not words:
        found = sorted(known, key=lambda folder: (folder / STUDY).stat().st_mtime)[-1:]
    elif (Path(words[0]) / STUDY).is_file():
        found = [Path(words[0])]
    else:
        found = [folder for folder in known if folder.name in (words[0], f"sweep-{words[0]}")]
    if len(found) > 1:
        raise UsageError(f"several tasks have a sweep '{words[0]}'", hint=f"give a folder: {listing(map(str, found))}")
    if not found:
        hint = f"sweeps: {listing(map(str, known))}" if known else "`rlcli sweep TASK --param ...` starts one"
        raise CheckpointError(f"no sweep{f' {words[0]!r}' if words else ''} in {runs}", hint=hint)
    return read_sweep(found[0], storage)


def draw_sweep(sweep: Sweep) -> Path:
    """Plot the objective over each parameter, one point per trial, into a file in the sweep's folder; return the file.

    Raises:
        UsageError: if no trial is finished yet.
        DependencyError: without matplotlib.
    """
    check_drawing()
    done = [trial for trial in sweep.trials() if trial.state.name == "COMPLETE"]
    if not done:
        raise UsageError("nothing to plot: no trial of the sweep is finished yet; wait for the first one")
    panels = [("trial", [trial.number for trial in done], False)]
    panels += [(p.key, [sweep.values(trial)[p.key] for trial in done], p.log) for p in sweep.parameters]
    values = [trial.value for trial in done if trial.value is not None]  # a finished trial has a value
    picture = scatter(panels, values, sweep.settings["objective"], title=sweep.folder.name)
    return write_atomic(sweep.folder / PICTURE, picture)


def _require_same(location: object, known: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Check that the settings of an existing sweep (`known`) and of this command are equal, except for `--trials`.

    Raises:
        UsageError: with the settings that differ.
    """
    differing = [key for key in settings if key != "trials" and known.get(key) != settings[key]]
    if differing:
        changes = (f"{key}: {known.get(key)!r} in the sweep, {settings[key]!r} now" for key in differing[:3])
        where = without_password(str(location))
        message = f"{where} is a sweep with other settings ({'; '.join(changes)})"
        raise UsageError(message, hint="choose another --name for a new sweep, or give the same settings")


def _sampler(seed: int) -> optuna.samplers.BaseSampler:
    import optuna

    with warnings.catch_warnings(action="ignore", category=optuna.exceptions.ExperimentalWarning):
        return optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True, n_startup_trials=8)


def _state(name: str | None) -> optuna.trial.TrialState | None:
    import optuna

    return None if name is None else optuna.trial.TrialState[name]


@contextlib.contextmanager
def _locked(file: Path) -> Iterator[None]:
    """Hold the lock `file` during a `with` block; raise `MachineError` if another process holds it for 2 minutes."""
    try:
        lock = FileLock(file).acquire(timeout=120)
    except Timeout:
        raise MachineError(f"another process has locked {file}; wait until the process has ended") from None
    except OSError as error:
        raise disk_error(file, error) from error
    with lock:
        yield
