"""A sweep: trials in Optuna's storage, shared by any number of processes, each a run in the sweep's folder."""

from __future__ import annotations

import contextlib
import platform
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from rlcli.errors import CheckpointError, MachineError, UsageError
from rlcli.random import derive
from rlcli.rl.files import disk_error, to_json, write_atomic
from rlcli.rl.run import STUDY
from rlcli.rl.space import Parameter
from rlcli.rl.storage import hidden, open_study
from rlcli.rl.study import read_study

PRESET = "best.yaml"
_GUARD, _HELD = ".sweep", ".worker"
_SETTINGS = "rlcli"
"""Attribute of an Optuna study: what all of its processes agree on."""
_PLACE = "place"
"""Attribute of a trial: the machine and the folder of who works on it; only there its run can go on."""
_SURPLUS = "surplus"
"""Attribute of a trial that was begun at the same moment as the last one wanted; it is none."""
_KINDS: dict[str, type] = {
    **dict.fromkeys(("task", "name", "agent", "objective", "direction", "pruner"), str),
    **dict.fromkeys(("trials", "episodes", "seed"), int),
    **dict.fromkeys(("params", "overrides"), list),
    **dict.fromkeys(("source", "flags"), dict),
}
"""What `study.json` says of a sweep."""
_ENDED = ("COMPLETE", "PRUNED", "FAIL")


@dataclass(slots=True)
class Trial:
    """A trial that this process works on."""

    number: int
    folder: Path
    trial: Any
    """Optuna's."""
    values: dict[str, Any]
    """Key -> value of its parameters."""
    _held: FileLock | None = None

    def let_go(self) -> None:
        """Let another process take it."""
        if self._held is not None:
            self._held.release()
            self._held = None


@dataclass(slots=True)
class Search:
    """One sweep: its folder, what it was told, and Optuna's study."""

    folder: Path
    settings: dict[str, Any]
    parameters: list[Parameter]
    study: Any
    _held: dict[int, Trial] = field(default_factory=dict)

    def trials(self) -> list[Any]:
        """Optuna's trials, in order; those that were begun beyond what was wanted are none."""
        return [trial for trial in self.study.get_trials(deepcopy=False) if _SURPLUS not in trial.user_attrs]

    def ended(self) -> list[Any]:
        """Those that need nothing more."""
        return [trial for trial in self.trials() if trial.state.name in _ENDED]

    def best(self) -> Any | None:
        """The best finished trial, if there is one."""
        done = [trial for trial in self.trials() if trial.state.name == "COMPLETE"]
        if not done:
            return None
        better = max if self.settings["direction"] == "maximize" else min
        return better(done, key=lambda trial: (trial.value, -trial.number if better is max else trial.number))

    def values(self, trial: Any) -> dict[str, Any]:
        """The parameters of a trial."""
        known = {parameter.key: parameter for parameter in self.parameters}
        return {key: known[key].value(value) for key, value in trial.params.items() if key in known}

    def overrides(self, values: Mapping[str, Any]) -> list[str]:
        """What a trial changes, as overrides."""
        known = {parameter.key: parameter for parameter in self.parameters}
        return [known[key].override(value) for key, value in values.items()]

    def place(self, number: int) -> Path:
        """The folder of a trial, which is a run."""
        return self.folder / f"trial-{number:04d}"

    def claim(self) -> Trial | None:
        """A trial to work on: one whose process is gone, or a new one; None if there is none to be had.

        One process claims at a time, so no trial is begun twice and none too many.
        """
        with _locked(self.folder / _GUARD):
            for trial in self.trials():
                if trial.state.name != "RUNNING" or trial.number in self._held or not self._is_here(trial):
                    continue
                taken = self._take(trial.number)
                if taken is None:
                    continue
                if any(other.number == trial.number for other in self.ended()):  # until now it was another's
                    taken.release()
                    continue
                return self._hold(taken, self._adopted(trial))
            if len(self.trials()) >= self.settings["trials"]:
                return None
            asked = self.study.ask()
            asked.set_user_attr(_PLACE, self._here)
            if sum(trial.number < asked.number for trial in self.trials()) >= self.settings["trials"]:
                asked.set_user_attr(_SURPLUS, True)  # another machine was quicker
                self.study.tell(asked, state=_state("FAIL"))
                return None
            held = self._take(asked.number)
            if held is None:
                raise MachineError(f"{self.place(asked.number)} is being written to by another process")
            return self._hold(held, self._adopted(asked))

    def tell(self, trial: Trial, value: float | None = None, *, state: str | None = None, **notes: Any) -> None:
        """A trial has ended; `notes` are kept with it."""
        for key, note in notes.items():
            trial.trial.set_user_attr(key, note)
        if state is None:
            self.study.tell(trial.trial, value)
        else:
            self.study.tell(trial.trial, state=_state(state))
        self._held.pop(trial.number, None)
        trial.let_go()

    def keep_preset(self, data: Callable[[Mapping[str, Any]], Mapping[str, Any]]) -> Path | None:
        """Write the best trial as a file for `--config`, with a comment that says where it is from.

        Args:
            data: the content of such a file, of the values of a trial.

        Raises:
            MachineError: if it cannot be written.
        """
        from rlcli.config.dump import to_yaml

        with _locked(self.folder / _GUARD):  # the best that one process knows may be an older one than another's
            best = self.best()
            if best is None:
                return None
            score = f"{self.settings['objective']} = {best.value:.6g}"
            title = f"# {self.settings['task']}: trial {best.number} of {self.folder.name}, {score}\n"
            write_atomic(self.folder / PRESET, title + to_yaml(dict(data(self.values(best)))))
        return self.folder / PRESET

    def let_go(self) -> None:
        """Leave unfinished trials to whoever goes on with the sweep."""
        for trial in self._held.values():
            trial.let_go()
        self._held.clear()

    @property
    def _here(self) -> str:
        return f"{platform.node()}:{self.folder.resolve()}"

    def _is_here(self, trial: Any) -> bool:
        """Whether a trial was begun in this folder, on this machine or one that shares the folder."""
        return self.settings["storage"] is None or trial.user_attrs.get(_PLACE) == self._here

    def _take(self, number: int) -> FileLock | None:
        place = self.place(number)
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise disk_error(place, error) from error
        lock = FileLock(place / _HELD)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return None
        return lock

    def _adopted(self, trial: Any) -> Any:
        """A trial whose values are those of its number, whoever draws them; what it had drawn, it keeps."""
        import optuna

        self.study.sampler = _sampler(derive(self.settings["seed"], f"trial {trial.number}"))
        return optuna.trial.Trial(self.study, trial._trial_id)

    def _hold(self, lock: FileLock, trial: Any) -> Trial:
        for parameter in self.parameters:
            parameter.draw(trial)
        taken = Trial(trial.number, self.place(trial.number), trial, self.values(trial), lock)
        self._held[taken.number] = taken
        return taken


def open_search(
    folder: Path,
    settings: dict[str, Any],
    source: Mapping[str, Any],
    parameters: list[Parameter],
    storage: str | None,
) -> Search:
    """Begin a sweep in a folder, or join the one that is there.

    Args:
        folder: of the sweep; made if it is not there.
        settings: what all processes of the sweep agree on; `trials` may grow.
        source: where the task is from, which all processes that share the folder agree on.
        parameters: what is drawn.
        storage: URL of a database; None keeps a journal in the folder.

    Raises:
        UsageError: if the folder or the storage holds another sweep.
        CheckpointError: if what the folder holds is damaged.
        MachineError: if the storage cannot be reached, or the folder not written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from error
    about = {"kind": "sweep", **settings, "source": dict(source)}
    with _locked(folder / _GUARD):
        begun = (folder / STUDY).is_file()
        if begun:
            _require_same(folder, read_study(folder, "sweep"), about)
        study = open_study(folder, settings, storage, create=storage is not None or not begun)
        known = study.user_attrs.get(_SETTINGS)
        if known is not None:
            _require_same(storage or folder, known, settings)
        study.set_user_attr(_SETTINGS, settings)
        write_atomic(folder / STUDY, to_json(about))
    return Search(folder, settings, parameters, study)


def read_search(folder: Path, storage: str | None = None) -> Search:
    """A sweep to look at.

    Raises:
        CheckpointError: if there is none, or it is damaged.
        MachineError: if its storage cannot be reached.
    """
    from rlcli.rl.space import read_parameters

    settings = read_study(folder, "sweep")
    if any(not isinstance(settings.get(key), kind) for key, kind in _KINDS.items()):
        raise CheckpointError(f"{folder / STUDY} is corrupt: it lacks what a sweep is told")
    if settings.get("storage") and storage is None:
        raise UsageError(f"{folder} keeps its trials in a database", hint="--storage URL, as it was begun")
    study = open_study(folder, settings, storage, create=False)
    return Search(folder, settings, read_parameters(settings["params"]), study)


def _require_same(place: Any, known: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Processes of one sweep were told the same.

    Raises:
        UsageError: naming what differs.
    """
    differing = [key for key in settings if key != "trials" and known.get(key) != settings[key]]
    if differing:
        said = "; ".join(f"{key}: {known.get(key)!r} there, {settings[key]!r} here" for key in differing[:3])
        where = hidden(str(place))
        raise UsageError(f"{where} is another sweep ({said})", hint="another --name, or the same command again")


def _sampler(seed: int) -> Any:
    import optuna

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True, n_startup_trials=8)


def _state(name: str) -> Any:
    import optuna

    return optuna.trial.TrialState[name]


@contextlib.contextmanager
def _locked(file: Path) -> Iterator[None]:
    lock = FileLock(file)
    try:
        lock.acquire(timeout=120)
    except Timeout:
        raise MachineError(f"{file} is held by another process") from None
    except OSError as error:
        raise disk_error(file, error) from error
    try:
        yield
    finally:
        lock.release()
