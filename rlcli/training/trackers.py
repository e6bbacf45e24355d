"""Loggers that send the metrics of a training to an experiment tracker: Weights & Biases, MLflow or trackio.

Without settings of the user a tracker writes only to this machine. A tracker that fails after its start does not stop
the training. A slow tracker delays only the end of the training, by at most a minute.
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
from typing import Annotated, Any, Protocol
from urllib.parse import urlsplit

from pydantic import Field, ValidationError

from rlcli.config.layers import leaves
from rlcli.errors import MachineError, one_line
from rlcli.rl.rng import undisturbed
from rlcli.runs.run import Run
from rlcli.runs.safe_io import FileModel

_log = logging.getLogger(__name__)

_MAX_ROWS = 100_000
"""Largest number of iterations whose metrics wait for a tracker; with more, the tracker counts as failed."""
_TIMEOUT_S = 60.0
"""Time after which the end of a training no longer waits for a tracker [s]."""


class Logger(Protocol):
    """Protocol of loggers, which receive the metrics of every iteration of a training."""

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Record the metrics of one iteration."""

    def close(self, state: str) -> None:
        """Flush and close, with the state of the run: finished, stopped, diverged or failed."""


class Tracker(Logger, Protocol):
    """Logger that stores the metrics of a run with an experiment tracker such as MLflow."""

    id: str
    """Identifier of the run in the tracker; a resumed run of rlcli continues the same run there."""


class FailSafeLogger:
    """Wrapper of a logger. If the logger fails, a warning is logged once and training continues without the logger.

    Args:
        name: name of the logger in messages.
        logger: the logger.
        last_step: environment steps up to which the logger has the metrics from before the run was resumed.
    """

    def __init__(self, name: str, logger: Logger, last_step: int) -> None:
        self._logger: Logger | None = logger
        self._name, self._last_step = name, last_step

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Record one iteration, if the logger works and has not recorded this iteration before."""
        if self._logger is None or step <= self._last_step:
            return
        try:
            self._logger.write(iteration, step, metrics)
        except Exception as error:  # libraries and servers raise any kind of error
            self._logger = None
            _log.warning("the logger %s has failed and records nothing more: %s", self._name, one_line(error, 300))

    def close(self, state: str) -> None:
        """Close the logger; log a warning if that fails."""
        if self._logger is None:
            return
        try:
            self._logger.close(state)
        except Exception as error:
            _log.warning("the logger %s may lack the last iterations: %s", self._name, one_line(error, 300))


class BackgroundTracker:
    """Wrapper that runs a tracker in a background thread; only the end of a training waits for the thread.

    The wait is at most `_TIMEOUT_S`.
    """

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._rows: queue.SimpleQueue[tuple[int, int, dict[str, float]] | str] = queue.SimpleQueue()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="tracker", daemon=True)
        self._thread.start()

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Queue the metrics of one iteration, or raise the error of the background thread."""
        if self._failure is not None:
            raise self._failure
        if self._rows.qsize() > _MAX_ROWS:
            raise TimeoutError(f"more than {_MAX_ROWS} iterations wait for the upload; check the connection")
        self._rows.put((iteration, step, {name: value for name, value in metrics.items() if math.isfinite(value)}))

    def close(self, state: str) -> None:
        """Close the tracker and wait until everything is written.

        Raises:
            TimeoutError: if closing takes longer than `_TIMEOUT_S`.
        """
        with _without_stdout():
            self._rows.put(state)
            self._thread.join(_TIMEOUT_S)
        if self._thread.is_alive():
            raise TimeoutError(f"the upload did not finish within {_TIMEOUT_S:g} s; check the connection")
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
    name: str, kind: Callable[..., Tracker], run: Run, config: Mapping[str, Any], resume: tuple[int, int] | None
) -> FailSafeLogger:
    """Open a tracker for a run. A resumed run continues the same run in the tracker, and no step is recorded twice.

    `run.json` stores the identifier of the run in the tracker, and the last step that the tracker had when the run was
    resumed.

    Args:
        name: name of the logger.
        kind: class of the tracker.
        run: the run.
        config: the resolved configuration.
        resume: last iteration and step before the run was resumed; None: the run is new.

    Raises:
        MachineError: if the tracker cannot be opened.
    """
    stored = None if resume is None else _stored_tracker(run, name)
    try:
        with undisturbed(), _without_stdout():  # a library may draw random numbers for names
            # in a copy of the context: trackio sets a context variable
            tracker = contextvars.copy_context().run(kind, run, config, stored and stored.id)
    except Exception as error:
        message = f"the logger {name} cannot be opened: {one_line(error, 300)}"
        raise MachineError(message, hint="use --logger none to train without this logger") from error
    last_step = 0
    if resume is not None and stored is not None and tracker.id == stored.id:
        last_step = max(stored.step, resume[1])
    trackers = run.record.get("trackers") or {}
    run.update(trackers={**trackers, name: {"id": tracker.id, "step": last_step}})
    return FailSafeLogger(name, BackgroundTracker(tracker), last_step)


class _LibraryRun:
    """Base class of trackers whose library has a run object with `log` and `finish`."""

    _run: Any

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Log the metrics of an iteration at the environment step."""
        self._run.log({**metrics, "iteration": iteration}, step=step)

    def close(self, state: str) -> None:
        """Finish the run of wandb, as failed unless `state` is `finished`, and wait for pending uploads."""
        self._run.finish()


class Wandb(_LibraryRun):
    """Tracker for Weights & Biases: online with an API key, else offline; its files are in the run's folder.

    `config` is the resolved configuration, `resume_id` the identifier of the run in the tracker; None: a new run.
    """

    def __init__(self, run: Run, config: Mapping[str, Any], resume_id: str | None) -> None:
        _set_default_variables(WANDB_ERROR_REPORTING="false", WANDB_SILENT="true")
        wandb = importlib.import_module("wandb")
        self._folder = run.folder / "wandb"
        mode = os.environ.get("WANDB_MODE")
        if mode is None and not _has_key():
            mode = "offline"
            sync = f"wandb sync {self._folder}/offline-run-*"
            _log.warning(f"there is no API key (`wandb login`): wandb writes to disk; to upload later: `{sync}`")
        self.id = resume_id or f"{int(time.time()):x}{os.urandom(4).hex()}"
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
        """Finish the run of wandb, as failed unless `state` is `finished`, and wait for pending uploads."""
        self._run.finish(exit_code=0 if state == "finished" else 1)
        _drop_links(self._folder)


class MLflow:
    """Tracker for MLflow: at MLFLOW_TRACKING_URI, else in files in the run's folder.

    `config` is the resolved configuration, `resume_id` the identifier of the run in the tracker; None: a new run.
    """

    def __init__(self, run: Run, config: Mapping[str, Any], resume_id: str | None) -> None:
        _set_default_variables(
            MLFLOW_DISABLE_TELEMETRY="true",
            MLFLOW_ALLOW_FILE_STORE="true",  # the default, a database, would need more packages
            MLFLOW_HTTP_REQUEST_MAX_RETRIES="2",
            MLFLOW_HTTP_REQUEST_TIMEOUT="20",
        )
        mlflow = importlib.import_module("mlflow")
        self._entities = importlib.import_module("mlflow.entities")
        uri = os.environ.get("MLFLOW_TRACKING_URI") or (run.folder / "mlflow").resolve().as_uri()
        self._client = mlflow.MlflowClient(uri)
        if resume_id is not None and self._exists(resume_id):
            self._client.update_run(resume_id, status="RUNNING")
            self.id = resume_id
            return
        name = run.record["task"]["name"]
        experiment = self._client.get_experiment_by_name(name)
        number = self._client.create_experiment(name) if experiment is None else experiment.experiment_id
        tags = {"agent": str(run.record.get("agent")), "rlcli": str(run.record.get("rlcli")), "run": str(run.folder)}
        self.id = self._client.create_run(number, run_name=run.folder.name, tags=tags).info.run_id
        agent = (config.get("agents") or {}).get(run.record.get("agent"))
        values = {
            "seed": run.record["seed"],
            **{".".join(("agent", *map(str, path))): value for path, value in leaves(agent) if value != {}},
        }
        # MLflow's limits: 100 parameters in a batch, 500 characters in a value
        params = [self._entities.Param(_mlflow_name(key), str(value)[:500]) for key, value in values.items()]
        self._client.log_batch(self.id, params=params[:100])

    def _exists(self, run_id: str) -> bool:
        try:
            self._client.get_run(run_id)
        except Exception:  # it is another server, or the run's data was deleted there
            return False
        return True

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Log the metrics of an iteration at the environment step."""
        now, metric = int(time.time() * 1000), self._entities.Metric
        rows = {**metrics, "iteration": float(iteration)}
        self._client.log_batch(self.id, metrics=[metric(_mlflow_name(key), v, now, step) for key, v in rows.items()])

    def close(self, state: str) -> None:
        """Set the final status of the run in MLflow."""
        states = {"finished": "FINISHED", "stopped": "KILLED"}
        self._client.set_terminated(self.id, states.get(state, "FAILED"))


class Trackio(_LibraryRun):
    """Tracker for trackio: a database in TRACKIO_DIR, else in the run's folder.

    `config` is the resolved configuration, `resume_id` the identifier of the run in the tracker; None: a new run.
    """

    def __init__(self, run: Run, config: Mapping[str, Any], resume_id: str | None) -> None:
        _set_default_variables(
            TRACKIO_DIR=str((run.folder / "trackio").resolve()),
            HF_HUB_DISABLE_TELEMETRY="1",
            GRADIO_ANALYTICS_ENABLED="False",
        )
        if not any(os.environ.get(name) for name in ("TRACKIO_SPACE_ID", "TRACKIO_SERVER_URL")):
            _set_default_variables(HF_HUB_OFFLINE="1")  # else trackio requests the key's owner from the hub
        trackio = importlib.import_module("trackio")
        self.id = resume_id or run.folder.name
        self._run = trackio.init(
            project=re.sub(r"[^\w.-]", "-", run.record["task"]["name"]),
            name=self.id,
            resume="never" if resume_id is None else "allow",
            config={**config, "seed": run.record["seed"]},
            embed=False,
            auto_log_gpu=False,
            auto_log_cpu=False,
        )


class _StoredTracker(FileModel):
    """Entry of a tracker in run.json: identifier of the run in the tracker, and last step that the tracker has."""

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,128}$")]
    step: Annotated[int, Field(ge=0, le=2**53)]


def _stored_tracker(run: Run, name: str) -> _StoredTracker | None:
    """Return the entry of a tracker in run.json, which is untrusted; None if it is missing or not valid."""
    try:
        return _StoredTracker.model_validate((run.record.get("trackers") or {}).get(name))
    except ValidationError:
        return None


def _has_key() -> bool:
    """Return whether the user has an API key of wandb: in the environment, or in the netrc file of `wandb login`."""
    if os.environ.get("WANDB_API_KEY") or os.environ.get("WANDB_IDENTITY_TOKEN_FILE"):
        return True
    host = urlsplit(os.environ.get("WANDB_BASE_URL") or "https://api.wandb.ai").hostname or ""
    files = [os.environ["NETRC"]] if os.environ.get("NETRC") else ["~/.netrc", "~/_netrc"]
    for file in files:
        with contextlib.suppress(OSError, netrc.NetrcParseError, UnicodeDecodeError):
            if netrc.netrc(os.path.expanduser(file)).authenticators(host):
                return True
    return False


def _drop_links(folder: Path) -> None:
    """Remove wandb's links to logs outside of the run: a run must not contain links."""
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
    """Discard what a library prints to stdout in the `with` block: stdout is for the result of the command."""
    with open(os.devnull, "w", encoding="utf-8") as nothing, contextlib.redirect_stdout(nothing):
        yield


def _mlflow_name(name: str) -> str:
    """Return a metric's name with the characters that MLflow does not allow replaced by `_`, cut to 250 characters."""
    return re.sub(r"[^\w\-./: ]", "_", name)[:250]
