"""Storage of a sweep's trials by the library Optuna: a journal file in the sweep's folder, or a shared database."""

from __future__ import annotations

import contextlib
import importlib.util
import re
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from rlcli.errors import CheckpointError, DependencyError, MachineError, RlcliError, UsageError, one_line, pip_install
from rlcli.runs.atomic_io import disk_errors

if TYPE_CHECKING:
    import optuna

JOURNAL = "journal.log"
_CONNECT_S = 20
"""Time after which an error is raised if a database does not answer [s]."""
_WITH_CONNECT_TIMEOUT = ("postgresql", "psycopg", "psycopg2", "mysql", "mysqldb", "pymysql")
"""Database drivers of SQLAlchemy, and dialects that use them by default, which have the option `connect_timeout`."""
_MAX_JOURNAL = 512 * 2**20
"""Largest size of a journal file [bytes]."""
_ATTEMPTS = 5
"""Number of attempts to create the tables of a database: another machine may create them at the same time."""


def check_optuna() -> None:
    """Check that Optuna is installed.

    Raises:
        DependencyError: if not, with the command that installs Optuna.
    """
    if importlib.util.find_spec("optuna") is None:
        raise DependencyError("a sweep needs Optuna", hint=pip_install("rlcli[sweep]"))


def open_study(folder: Path, settings: Mapping[str, Any], storage: str | None, *, create: bool) -> optuna.Study:
    """Open the Optuna study that stores the trials of a sweep.

    Args:
        folder: the folder of the sweep, which contains the journal file.
        settings: settings of the sweep: `task`, `name`, `direction` (`maximize` or `minimize`), `pruner` (`median` or
            `none`).
        storage: URL of a database; None: the journal file in the folder.
        create: whether to create the study if it does not exist.

    Raises:
        CheckpointError: if the study does not exist and `create` is false, or if the journal is damaged.
        DependencyError: if a package for the database is not installed.
        MachineError: if the database cannot be reached, or the folder cannot be written.
        UsageError: if `storage` is not the URL of a database.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    name = f"rlcli/{settings['task']}/{settings['name']}"
    median = optuna.pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=30)
    pruner = median if settings["pruner"] == "median" else optuna.pruners.NopPruner()
    with disk_errors(folder / JOURNAL):
        with warnings.catch_warnings(action="ignore"):
            trials = _journal(folder, create) if storage is None else _database(storage)
        study: dict[str, Any] = {"study_name": name, "storage": trials, "pruner": pruner}
        try:
            if not create:
                return optuna.load_study(**study)
            return optuna.create_study(**study, direction=settings["direction"], load_if_exists=True)
        except KeyError:
            if storage is None and (folder / JOURNAL).stat().st_size > 0:
                raise _corrupt(folder / JOURNAL, ValueError(f"the file has no entry of the sweep '{name}'")) from None
            where = without_password(storage) if storage else folder
            raise CheckpointError(f"{where} has no sweep '{name}'; see `rlcli sweep show`") from None


@contextlib.contextmanager
def storage_errors(storage: str | None) -> Iterator[None]:
    """Convert errors of a sweep's database inside a `with` block to `MachineError`; raise other errors unchanged.

    Args:
        storage: URL of the database; None: the sweep has no database.

    Raises:
        MachineError: if the database cannot be reached.
    """
    try:
        yield
    except Exception as error:
        if storage is None or not _is_database_error(error):
            raise
        message = f"--storage {without_password(storage)} cannot be reached: {_first_line(error)}"
        raise MachineError(message, hint="start the database, then run the same command again to continue") from None


def without_password(url: str) -> str:
    """Return a URL without its password, which is before the `@` or in the query (`?password=`)."""
    url = re.sub(r"([?&][^=&]*(?:password|passwd|pwd|secret|token)[^=&]*)=[^&]*", r"\1=", url, flags=re.IGNORECASE)
    before, at, after = url.rpartition("@")
    if not at:
        return url
    scheme, _, user = before.partition("://")
    return f"{scheme}://{user.partition(':')[0]}@{after}"


def _journal(folder: Path, create: bool) -> optuna.storages.BaseStorage:
    """Return the storage in the journal file of a sweep's folder.

    Args:
        folder: the folder of the sweep.
        create: whether the file may be missing.

    Raises:
        CheckpointError: if the file is missing, too large or damaged.
    """
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    file = folder / JOURNAL
    if file.exists() and not (file.is_file() and file.stat().st_size <= _MAX_JOURNAL):
        raise CheckpointError(f"{file} is not a regular file of at most {_MAX_JOURNAL:,} bytes; choose another --name")
    if not create and not file.is_file():
        message = f"the sweep {folder} is damaged: the file {JOURNAL} with its trials is missing"
        raise CheckpointError(message, hint="restore the file, or choose another --name for a new sweep")

    lock: Any = FileLock(folder / f".{JOURNAL}")  # the operating system releases the lock when the process is killed

    class Backend(JournalFileBackend):
        """Optuna's journal file that removes an incomplete last line, and raises an error if the file is damaged."""

        def append_logs(self, logs: list[dict[str, Any]]) -> None:
            with lock, disk_errors(file):
                try:
                    _remove_partial_line(file)
                    super().append_logs(logs)
                except OSError:
                    with contextlib.suppress(OSError):
                        _remove_partial_line(file)
                    raise

        def read_logs(self, log_number_from: int) -> Iterator[dict[str, Any]]:  # type: ignore[override]
            try:
                for entry in super().read_logs(log_number_from):
                    if not isinstance(entry, dict) or not {"op_code", "worker_id"} <= entry.keys():
                        raise ValueError("a line is not an entry of a journal that Optuna has written")
                    yield entry
            except ValueError as error:
                raise _corrupt(file, error) from None
            except OSError as error:
                raise CheckpointError(f"{file} cannot be read: {error.strerror or error}; check the disk") from None

    try:
        return JournalStorage(Backend(str(file), lock_obj=lock))
    except (RlcliError, OSError, MemoryError):
        raise
    except Exception as error:  # Optuna raises many kinds of errors for wrong values, such as AssertionError
        raise _corrupt(file, error) from None


def _corrupt(file: Path, error: Exception) -> CheckpointError:
    """Return the error for a damaged journal file."""
    hint = "choose another --name for a new sweep; the runs of the trials are not damaged"
    return CheckpointError(f"{file} is corrupt: {type(error).__name__}: {one_line(error)}", hint=hint)


def _remove_partial_line(file: Path) -> None:
    """Remove an incomplete last line of a journal file; the caller holds the lock of the file."""
    with file.open("r+b") as journal:
        size = begin = journal.seek(0, 2)
        tail = b""
        while begin > 0 and b"\n" not in tail:
            begin, end = max(0, begin - 4096), begin
            journal.seek(begin)
            tail = journal.read(end - begin) + tail
        whole = begin + tail.rfind(b"\n") + 1
        if whole < size:
            journal.truncate(whole)


def _database(url: str) -> optuna.storages.BaseStorage:
    """Return the storage in a database; see `open_study` for the errors."""
    try:
        import sqlalchemy
        from optuna.storages import RDBStorage
    except ImportError:
        raise DependencyError("--storage needs the package sqlalchemy", hint=pip_install("rlcli[sweep]")) from None
    try:
        options: dict[str, Any] = {"poolclass": sqlalchemy.pool.NullPool}  # connections time out during a trial
        driver = sqlalchemy.make_url(url).drivername.rpartition("+")[2]
        if driver in _WITH_CONNECT_TIMEOUT and "connect_timeout" not in url:
            options["connect_args"] = {"connect_timeout": _CONNECT_S}
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(sqlalchemy.exc.IntegrityError, sqlalchemy.exc.ProgrammingError):
                return RDBStorage(url, engine_kwargs=options)
            time.sleep(1.0)  # another machine creates the same tables at the same time
        return RDBStorage(url, engine_kwargs=options)
    except ImportError as error:
        driver = getattr(error.__cause__ or error, "name", None) or url.partition(":")[0]
        raise DependencyError(f"--storage needs the database driver {driver}", hint=pip_install(driver)) from None
    except (sqlalchemy.exc.ArgumentError, sqlalchemy.exc.NoSuchModuleError, ValueError, LookupError) as error:
        message = f"--storage '{without_password(url)}' is not the URL of a database: {_first_line(error)}"
        raise UsageError(message, hint="write a URL such as postgresql+psycopg://user@host/name") from None
    except (sqlalchemy.exc.SQLAlchemyError, OSError) as error:
        message = f"--storage {without_password(url)} cannot be reached: {_first_line(error)}"
        raise MachineError(message, hint="start the database, or correct the URL") from None


def _is_database_error(error: BaseException) -> bool:
    from optuna.exceptions import StorageInternalError

    sqlalchemy: Any = sys.modules.get("sqlalchemy")
    return isinstance(error, StorageInternalError) or (
        sqlalchemy is not None and isinstance(error, sqlalchemy.exc.SQLAlchemyError)
    )


def _first_line(error: BaseException) -> str:
    """Return the first line of an error's text, of the database driver's error if there is one."""
    cause = error.__cause__ or error
    cause = getattr(cause, "orig", None) or cause
    return (str(cause).strip().splitlines() or [type(cause).__name__])[0][:300]
