"""A sweep: trials in Optuna's storage, shared by any number of processes, each a run in the sweep's folder."""

from __future__ import annotations

import contextlib
import importlib.util
import platform
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from rlcli.errors import CheckpointError, DependencyError, MachineError, UsageError
from rlcli.random import derive
from rlcli.rl.files import disk_error, to_json, write_atomic
from rlcli.rl.run import STUDY
from rlcli.rl.space import Parameter
from rlcli.rl.study import read_study

JOURNAL = "journal.log"
PRESET = "best.yaml"
_GUARD, _HELD = ".sweep", ".worker"
_SETTINGS = "rlcli"
"""Attribute of an Optuna study: what all of its processes agree on."""
_PLACE = "place"
"""Attribute of a trial: the machine and the folder of who works on it; only there its run can go on."""
_TRIES = 5
_ENDED = ("COMPLETE", "PRUNED", "FAIL")


def check_optuna() -> None:
    """Refuse where there is no Optuna.

    Raises:
        DependencyError: with the line that installs it.
    """
    if importlib.util.find_spec("optuna") is None:
        raise DependencyError("a sweep needs Optuna", hint='pip install "rlcli[sweep]"')


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
        """Optuna's trials, in order."""
        return list(self.study.get_trials(deepcopy=False))

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
                if trial.state.name == "RUNNING" and trial.number not in self._held and self._is_here(trial):
                    taken = self._take(trial.number)
                    if taken is not None:
                        return self._hold(taken, self._adopted(trial))
            if len(self.trials()) >= self.settings["trials"]:
                return None
            number = len(self.trials())
            self.study.sampler = _sampler(derive(self.settings["seed"], f"trial {number}"))
            asked = self.study.ask()
            asked.set_user_attr(_PLACE, self._here)
            if asked.number >= self.settings["trials"]:  # another machine was quicker
                self.study.tell(asked, state=_state("FAIL"))
                return None
            held = self._take(asked.number)
            if held is None:
                raise MachineError(f"{self.place(asked.number)} is being written to by another process")
            for parameter in self.parameters:
                parameter.draw(asked)
            return self._hold(held, asked)

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

    def _adopted(self, frozen: Any) -> Any:
        import optuna

        return optuna.trial.Trial(self.study, frozen._trial_id)

    def _hold(self, lock: FileLock, trial: Any) -> Trial:
        for parameter in self.parameters:
            parameter.draw(trial)  # of one that was begun: what it had drawn
        taken = Trial(trial.number, self.place(trial.number), trial, self.values(trial), lock)
        self._held[taken.number] = taken
        return taken


def open_search(
    folder: Path, settings: dict[str, Any], parameters: list[Parameter], storage: str | None, pruner: str
) -> Search:
    """Begin a sweep in a folder, or join the one that is there.

    Args:
        folder: of the sweep; made if it is not there.
        settings: what all processes of the sweep agree on; `trials` may grow.
        parameters: what is drawn.
        storage: URL of a database; None keeps a journal in the folder.
        pruner: median or none.

    Raises:
        UsageError: if the folder or the storage holds another sweep.
        MachineError: if the storage cannot be reached, or the folder not written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from error
    with _locked(folder / _GUARD):
        if (folder / STUDY).is_file():
            _require_same(folder, read_study(folder, "sweep"), settings)
        study = _open(folder, settings, storage, pruner, create=True)
        known = study.user_attrs.get(_SETTINGS)
        if known is not None:
            _require_same(storage or folder, known, settings)
        study.set_user_attr(_SETTINGS, settings)
        write_atomic(folder / STUDY, to_json({"kind": "sweep", **settings}))
    return Search(folder, settings, parameters, study)


def read_search(folder: Path, storage: str | None = None) -> Search:
    """A sweep to look at.

    Raises:
        CheckpointError: if there is none.
        MachineError: if its storage cannot be reached.
    """
    from rlcli.rl.space import read_parameters

    settings = read_study(folder, "sweep")
    texts, wanted = settings.get("params"), ("objective", "direction", "trials", "name")
    if not isinstance(texts, list) or any(key not in settings for key in wanted):
        raise CheckpointError(f"{folder / STUDY} is corrupt: it lacks what a sweep is told")
    if settings.get("storage") and storage is None:
        raise UsageError(f"{folder} keeps its trials in a database", hint="--storage URL, as it was begun")
    study = _open(folder, settings, storage, "none", create=False)
    return Search(folder, settings, read_parameters(texts), study)


def _open(folder: Path, settings: Mapping[str, Any], storage: str | None, pruner: str, *, create: bool) -> Any:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    name = f"rlcli/{settings['task']}/{settings['name']}"
    prune = optuna.pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=30) if pruner == "median" else None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            place = _journal(folder) if storage is None else _database(storage)
        if not create:
            return optuna.load_study(study_name=name, storage=place)
        return optuna.create_study(
            storage=place,
            study_name=name,
            load_if_exists=True,
            direction=settings["direction"],
            pruner=prune or optuna.pruners.NopPruner(),
        )
    except KeyError:
        raise CheckpointError(f"there is no sweep '{name}' in {storage or folder}") from None
    except OSError as error:
        raise disk_error(folder / JOURNAL, error) from error


def _journal(folder: Path) -> Any:
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    class Lock:
        """The system's lock: it is free again when whoever held it was killed."""

        def __init__(self) -> None:
            self._lock = FileLock(folder / f".{JOURNAL}")

        def acquire(self) -> bool:
            self._lock.acquire()
            return True

        def release(self) -> None:
            self._lock.release()

    file = folder / JOURNAL
    if file.is_symlink():
        raise CheckpointError(f"{file} is a link; it was not made by rlcli")
    lock: Any = Lock()
    return JournalStorage(JournalFileBackend(str(file), lock_obj=lock))


def _database(url: str) -> Any:
    try:
        import sqlalchemy
        from optuna.storages import RDBStorage
    except ImportError:
        raise DependencyError("a shared storage needs SQLAlchemy", hint='pip install "rlcli[sweep]"') from None
    try:
        closed_after_use = {"poolclass": sqlalchemy.pool.NullPool}  # a trial lasts longer than a connection
        for _ in range(_TRIES):
            with contextlib.suppress(sqlalchemy.exc.IntegrityError, sqlalchemy.exc.ProgrammingError):
                return RDBStorage(url, engine_kwargs=closed_after_use)
            time.sleep(1.0)  # another machine makes the same tables at this moment
        return RDBStorage(url, engine_kwargs=closed_after_use)
    except ModuleNotFoundError as error:
        raise DependencyError(f"--storage needs the driver {error.name}", hint=f"pip install {error.name}") from None
    except (sqlalchemy.exc.ArgumentError, sqlalchemy.exc.NoSuchModuleError) as error:
        raise UsageError(
            f"--storage '{_hidden(url)}' is no address of a database: {_first_line(error)}",
            hint="as in postgresql+psycopg://user@host/name",
        ) from None
    except (sqlalchemy.exc.SQLAlchemyError, OSError) as error:
        raise MachineError(f"--storage {_hidden(url)} cannot be reached: {_first_line(error)}") from None


def _hidden(url: str) -> str:
    """An address without its password."""
    before, at, after = url.rpartition("@")
    if not at:
        return url
    scheme, _, user = before.partition("://")
    return f"{scheme}://{user.partition(':')[0]}@{after}"


def _first_line(error: BaseException) -> str:
    cause = getattr(error, "orig", None) or error
    return (str(cause).strip().splitlines() or [type(cause).__name__])[0][:300]


def _require_same(place: Any, known: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Processes of one sweep were told the same.

    Raises:
        UsageError: naming what differs.
    """
    differing = [key for key in settings if key != "trials" and known.get(key) != settings[key]]
    if differing:
        said = "; ".join(f"{key}: {known.get(key)!r} there, {settings[key]!r} here" for key in differing[:3])
        where = _hidden(str(place))
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


def preset(search: Search, overrides: Sequence[str]) -> str | None:
    """The best trial as a file for `--config`, with a comment that says where it is from."""
    from rlcli.config.dump import to_yaml
    from rlcli.rl.space import nested

    best = search.best()
    if best is None:
        return None
    data = nested([*overrides, *search.overrides(search.values(best))])
    score = f"{search.settings['objective']} = {best.value:.6g}"
    return f"# {search.settings['task']}: trial {best.number} of {search.folder.name}, {score}\n{to_yaml(data)}"
