"""Experiment trackers: Weights & Biases, MLflow and trackio, each on this machine alone unless the user's settings say
otherwise, and none of them able to stop a training or to make it wait.
"""

from __future__ import annotations

import contextlib
import contextvars
import importlib
import logging
import math
import netrc
import os
import queue
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol
from urllib.parse import urlsplit

from rlcli.errors import MachineError, one_line
from rlcli.rl.rng import undisturbed
from rlcli.runs.run import Run

if TYPE_CHECKING:
    from rlcli.training.loggers import Logger

_log = logging.getLogger(__name__)

_MOST_ROWS = 100_000
"""Longest queue of iterations before a tracker is given up."""
_PATIENCE_S = 60.0
"""Longest time that the end of a training waits for a tracker [s]."""
_ID = re.compile(r"[A-Za-z0-9_.-]{1,128}")
_MOST_STEPS = 2**53


class Tracker(Protocol):
    """Library that stores the metrics of a run."""

    id: str
    """The library's name of the run, by which a resumed run is continued."""

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Record one iteration."""
        ...

    def close(self, state: str) -> None:
        """Close, with the state of the run: finished, stopped, diverged or failed."""
        ...


class FailSafeLogger:
    """Logger whose failure is logged once; training continues without it.

    Args:
        name: its name in messages.
        logger: the logger.
        after: the last environment step that it has already.
    """

    def __init__(self, name: str, logger: Logger | BackgroundTracker, after: int) -> None:
        self._logger: Logger | BackgroundTracker | None = logger
        self._name, self._after = name, after

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Record one iteration, unless the logger has failed."""
        if self._logger is None or step <= self._after:
            return
        try:
            self._logger.write(iteration, step, metrics)
        except Exception as error:  # of any library or server
            self._logger = None
            reason = one_line(error, 300)
            _log.warning("the logger %s has failed and is left out from now on: %s", self._name, reason)

    def close(self, state: str = "finished") -> None:
        """Close the logger."""
        if self._logger is None:
            return
        try:
            self._logger.close(state)
        except Exception as error:
            _log.warning("the logger %s may lack the last iterations: %s", self._name, one_line(error, 300))


class BackgroundTracker:
    """Tracker in a background thread: only the end of training waits for it, for a limited time."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._rows: queue.SimpleQueue[tuple[int, int, dict[str, float]] | str] = queue.SimpleQueue()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="tracker", daemon=True)
        self._thread.start()

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Queue one iteration, or raise the error of an earlier one."""
        if self._failure is not None:
            raise self._failure
        if self._rows.qsize() > _MOST_ROWS:
            raise TimeoutError(f"it is {_MOST_ROWS} iterations behind")
        self._rows.put((iteration, step, {name: value for name, value in metrics.items() if math.isfinite(value)}))

    def close(self, state: str) -> None:
        """Wait until everything is written.

        Raises:
            TimeoutError: if that takes too long.
        """
        with _without_stdout():
            self._rows.put(state)
            self._thread.join(_PATIENCE_S)
        if self._thread.is_alive():
            raise TimeoutError(f"it did not finish within {_PATIENCE_S:g} s")
        if self._failure is not None:
            raise self._failure

    def _work(self) -> None:
        try:
            while not isinstance(row := self._rows.get(), str):
                self._tracker.write(*row)
            self._tracker.close(row)
        except Exception as error:
            self._failure = error


def open_tracker(
    name: str,
    kind: Callable[..., Tracker],
    run: Run,
    config: Mapping[str, Any],
    resume: tuple[int, int] | None,
) -> FailSafeLogger:
    """Open a tracker of a run; a resumed run is continued in it without writing a step twice.

    `run.json` stores the tracker's own name of the run, and the last step that the tracker had when the run was
    resumed.

    Args:
        name: the logger's name.
        kind: its class.
        run: the run.
        config: the resolved configuration.
        resume: the last iteration and step before the run was resumed.

    Raises:
        MachineError: if it cannot be opened.
    """
    known, after = _stored_mark(run, name) if resume is not None else (None, 0)
    if known is not None and resume is not None:
        after = max(after, resume[1])
    try:
        with undisturbed(), _without_stdout():  # a library may draw random names
            tracker = contextvars.copy_context().run(kind, run, config, known)  # trackio sets a context variable
    except Exception as error:
        raise MachineError(
            f"the logger {name} cannot be opened: {one_line(error, 300)}", hint="--logger none trains without it"
        ) from error
    marks = run.record.get("trackers") or {}
    run.update(trackers={**marks, name: {"id": tracker.id, "step": after if tracker.id == known else 0}})
    return FailSafeLogger(name, BackgroundTracker(tracker), after if tracker.id == known else 0)


class _LibraryRun:
    """Base of trackers whose library has a run with `log` and `finish`."""

    _run: Any

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Log at the environment step."""
        self._run.log({**metrics, "iteration": iteration}, step=step)

    def close(self, state: str) -> None:
        """Finish, and wait for pending uploads."""
        self._run.finish()


class Wandb(_LibraryRun):
    """Tracker of Weights & Biases: online with the user's key, else offline; its files lie in the run."""

    def __init__(self, run: Run, config: Mapping[str, Any], known: str | None) -> None:
        _set_default_variables(WANDB_ERROR_REPORTING="false", WANDB_SILENT="true")
        wandb = importlib.import_module("wandb")
        mode = os.environ.get("WANDB_MODE")
        if mode is None and not _has_key():
            mode = "offline"
            folder = run.folder / "wandb"
            _log.warning("wandb has no key: it writes offline; `wandb sync %s/offline-run-*` uploads", folder)
        self.id = known or f"{int(time.time()):x}{os.urandom(4).hex()}"
        self._folder = run.folder / "wandb"
        quiet = {"console": "off", "silent": True, "disable_git": True, "save_code": False, "symlink": False}
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT") or "rlcli",
            group=run.record["task"]["name"],
            name=run.folder.name,
            id=self.id,
            resume="allow",
            dir=str(run.folder),
            mode=mode,
            config={**config, "seed": run.record["seed"]},
            settings=wandb.Settings(**quiet, x_disable_stats=True, x_disable_machine_info=True),
        )
        _drop_links(self._folder)

    def close(self, state: str) -> None:
        """Finish, and wait for pending uploads."""
        self._run.finish(exit_code=0 if state == "finished" else 1)
        _drop_links(self._folder)


class MLflow:
    """Tracker of MLflow: at MLFLOW_TRACKING_URI, else files in the run."""

    def __init__(self, run: Run, config: Mapping[str, Any], known: str | None) -> None:
        _set_default_variables(
            MLFLOW_DISABLE_TELEMETRY="true",
            MLFLOW_ALLOW_FILE_STORE="true",  # a database would need more packages
            MLFLOW_HTTP_REQUEST_MAX_RETRIES="2",
            MLFLOW_HTTP_REQUEST_TIMEOUT="20",
        )
        mlflow = importlib.import_module("mlflow")
        self._entities = importlib.import_module("mlflow.entities")
        place = os.environ.get("MLFLOW_TRACKING_URI") or (run.folder / "mlflow").resolve().as_uri()
        self._client = mlflow.MlflowClient(place)
        if known is not None and self._exists(known):
            self._client.update_run(known, status="RUNNING")
            self.id = known
            return
        name = run.record["task"]["name"]
        experiment = self._client.get_experiment_by_name(name)
        number = self._client.create_experiment(name) if experiment is None else experiment.experiment_id
        tags = {"agent": str(run.record.get("agent")), "rlcli": str(run.record.get("rlcli")), "run": str(run.folder)}
        self.id = self._client.create_run(number, run_name=run.folder.name, tags=tags).info.run_id
        values = {
            "seed": run.record["seed"],
            **_flat("agent", (config.get("agents") or {}).get(run.record.get("agent"))),
        }
        params = [self._entities.Param(_mlflow_name(key), str(value)[:500]) for key, value in values.items()]
        self._client.log_batch(self.id, params=params[:100])

    def _exists(self, known: str) -> bool:
        try:
            self._client.get_run(known)
        except Exception:  # another server than before, or a folder that was cleared
            return False
        return True

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Log at the environment step."""
        now, metric = int(time.time() * 1000), self._entities.Metric
        rows = {**metrics, "iteration": float(iteration)}
        self._client.log_batch(self.id, metrics=[metric(_mlflow_name(key), v, now, step) for key, v in rows.items()])

    def close(self, state: str) -> None:
        """Set the final status."""
        states = {"finished": "FINISHED", "stopped": "KILLED"}
        self._client.set_terminated(self.id, states.get(state, "FAILED"))


class Trackio(_LibraryRun):
    """Tracker of trackio: a database in TRACKIO_DIR, else in the run."""

    def __init__(self, run: Run, config: Mapping[str, Any], known: str | None) -> None:
        _set_default_variables(
            TRACKIO_DIR=str((run.folder / "trackio").resolve()),
            HF_HUB_DISABLE_TELEMETRY="1",
            GRADIO_ANALYTICS_ENABLED="False",
        )
        if not any(os.environ.get(name) for name in ("TRACKIO_SPACE_ID", "TRACKIO_SERVER_URL")):
            _set_default_variables(HF_HUB_OFFLINE="1")  # it would ask whose key this is
        trackio = importlib.import_module("trackio")
        self.id = known or run.folder.name
        self._run = trackio.init(
            project=re.sub(r"[^\w.-]", "-", run.record["task"]["name"]),
            name=self.id,
            resume="never" if known is None else "allow",
            config={**config, "seed": run.record["seed"]},
            embed=False,
            auto_log_gpu=False,
            auto_log_cpu=False,
        )


def _stored_mark(run: Run, name: str) -> tuple[str | None, int]:
    """Return a tracker's name of the run and the last step that it has; run.json is untrusted."""
    mark = (run.record.get("trackers") or {}).get(name)
    if not isinstance(mark, dict):
        return None, 0
    known, step = mark.get("id"), mark.get("step")
    if not (isinstance(known, str) and _ID.fullmatch(known) and type(step) is int and 0 <= step <= _MOST_STEPS):
        return None, 0
    return known, step


def _has_key() -> bool:
    """Return whether there is a key: in the environment, or from `wandb login`."""
    if os.environ.get("WANDB_API_KEY") or os.environ.get("WANDB_IDENTITY_TOKEN_FILE"):
        return True
    host = urlsplit(os.environ.get("WANDB_BASE_URL") or "https://api.wandb.ai").hostname or ""
    places = [os.environ["NETRC"]] if os.environ.get("NETRC") else ["~/.netrc", "~/_netrc"]
    for place in places:
        with contextlib.suppress(OSError, netrc.NetrcParseError, UnicodeDecodeError):
            if netrc.netrc(str(Path(place).expanduser())).authenticators(host):
                return True
    return False


def _drop_links(folder: Path) -> None:
    """Remove links: wandb links a log outside of the run, and a run must not hold links."""
    with contextlib.suppress(OSError):
        for file in folder.glob("*/logs/*"):
            if file.is_symlink():
                file.unlink()


def _set_default_variables(**variables: str) -> None:
    """Set environment variables that the user has not set."""
    for name, value in variables.items():
        os.environ.setdefault(name, value)


@contextlib.contextmanager
def _without_stdout() -> Iterator[None]:
    """Discard what a library prints: stdout is for the command's result."""
    with open(os.devnull, "w", encoding="utf-8") as nothing, contextlib.redirect_stdout(nothing):
        yield


def _flat(prefix: str, value: object) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        return {prefix: value}
    return {name: inner for key in value for name, inner in _flat(f"{prefix}.{key}", value[key]).items()}


def _mlflow_name(name: str) -> str:
    return re.sub(r"[^\w\-./: ]", "_", name)[:250]
