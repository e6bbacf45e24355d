"""Tests of experiment trackers: they do not stop, change or delay a training, and get no step twice."""

import importlib.util
import json
import random
import shutil
import struct
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

from rlcli.cli.app import main
from rlcli.errors import DependencyError, pip_install
from rlcli.runs.metric_rows import read_rows
from rlcli.training import loggers
from rlcli.training.loggers import LOGGERS, LoggerKind, check_loggers
from rlcli.training.trackers import BackgroundTracker

SMALL = ("cartpole", "--agent", "ppo", "--num-envs", "8", "-q", "sim.engine_threads=1", "agent.torch_threads=1")
NOTEBOOK = '''
"""A tracker that writes into a file of the run."""

import json
import random

import numpy as np
import torch


class Notebook:
    def __init__(self, run, config, resume_id):
        random.random(), torch.rand(3), np.random.rand(3)
        print("Notebook is the best library of its kind")
        self.id = resume_id or f"note-{len(list(run.folder.glob('*.notes')))}"
        self.file = run.folder / f"{self.id}.notes"
        self.note(opened=sorted(config))

    def note(self, **row):
        with self.file.open("a") as file:
            file.write(json.dumps(row) + chr(10))

    def write(self, iteration, step, metrics):
        self.note(iteration=iteration, step=step, **metrics)

    def close(self, state):
        self.note(closed=state)


class Fails(Notebook):
    def write(self, iteration, step, metrics):
        if iteration == 2:
            raise ConnectionError("the server said no")
        super().write(iteration, step, metrics)


class FailsAtTheEnd(Notebook):
    def close(self, state):
        raise ConnectionError("the server said no")


class NeverOpens:
    def __init__(self, run, config, resume_id):
        raise ConnectionError("the server said no")
'''


@pytest.fixture(autouse=True)
def _temporary_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    (tmp_path / "notebook.py").write_text(NOTEBOOK)
    for name in ("Notebook", "Fails", "FailsAtTheEnd", "NeverOpens"):
        monkeypatch.setitem(LOGGERS, name.lower(), LoggerKind("json", f"{tmp_path / 'notebook.py'}:{name}", name))
    yield
    torch.set_num_threads(threads)


def train(name, *words, code=0):
    assert main(["train", *SMALL, "--name", name, *map(str, words)]) == code
    (run,) = Path("runs").glob(f"*/*-{name}")
    return run


def notes(run, name="note-0"):
    return [json.loads(line) for line in (run / f"{name}.notes").read_text().splitlines()]


def weights(run):
    return sorted(run.glob("checkpoints/*/policy.safetensors"))[-1].read_bytes()


def without_times(row):
    return {key: value for key, value in row.items() if not key.startswith("Perf/")}


def test_tracker_gets_metrics_and_configuration(capfd):
    run = train("a", "--max-iterations", "3", "--logger", "notebook")
    opened, *rows, closed = notes(run)
    assert rows == [*read_rows(run / "metrics.jsonl")]
    assert {"agents", "rewards", "scene"} <= set(opened["opened"])
    assert closed == {"closed": "finished"}
    assert "best library" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("logger", ["notebook", "fails", "failsattheend"])
def test_tracker_does_not_change_training(logger, capfd):
    plain = train("plain", "--max-iterations", "3", "--logger", "none")
    tracked = train("tracked", "--max-iterations", "3", "--logger", logger)
    assert weights(plain) == weights(tracked)
    rows = [[without_times(row) for row in read_rows(run / "metrics.jsonl")] for run in (plain, tracked)]
    assert rows[0] == rows[1]
    assert len(rows[0]) == 3


@pytest.mark.parametrize("iterations", [2, 5])
def test_failed_tracker_is_reported_once_and_dropped(iterations, capfd):
    run = train("a", "--max-iterations", iterations, "--logger", "fails", "--logger", "notebook")
    err = capfd.readouterr().err
    assert err.count("the server said no") == 1
    assert "warning: the logger fails" in err
    assert json.loads((run / "run.json").read_text())["state"] == "finished"
    assert len([*read_rows(run / "metrics.jsonl")]) == iterations


def test_tracker_that_fails_at_the_end_is_reported(capfd):
    train("a", "--max-iterations", "1", "--logger", "failsattheend")
    assert "may lack the last iterations: the server said no" in capfd.readouterr().err


def test_tracker_that_cannot_be_opened_is_a_machine_error(capfd):
    run = train("a", "--max-iterations", "3", "--logger", "neveropens", code=10)
    err = capfd.readouterr().err
    assert "the logger neveropens cannot be opened: the server said no" in err
    assert "--logger none" in err
    assert [*read_rows(run / "metrics.jsonl")] == []


def test_resumed_run_continues_its_tracker_without_duplicate_steps(capfd):
    words = ("--logger", "notebook", "agent.save_interval=1")
    run = train("a", "--max-iterations", "4", *words)
    rows = [*read_rows(run / "metrics.jsonl")]
    steps = [row["step"] for row in rows]
    for begin, end in (
        (steps[0], 2),
        (steps[1], 3),
        (steps[0], 6),
    ):  # the second resume ends before the fourth iteration
        assert main(["train", "--resume", f"{run}@step:{begin}", "--max-iterations", str(end), "-q"]) == 0
    written = [row for row in notes(run) if "step" in row]
    assert [row["iteration"] for row in written] == [1, 2, 3, 4, 5, 6]
    assert [row["step"] for row in written] == [row["step"] for row in read_rows(run / "metrics.jsonl")]
    assert [path.name for path in run.glob("*.notes")] == ["note-0.notes"]


@pytest.mark.parametrize(
    "trackers",
    [{"notebook": {"id": "../../x", "step": 0}}, {"notebook": {"id": "note-0", "step": "9"}}, {"notebook": 3}],
)
def test_malformed_tracker_entry_gives_a_new_tracker_run(trackers, capfd):
    run = train("a", "--max-iterations", "1", "--logger", "notebook")
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(record | {"trackers": trackers}))
    assert main(["train", "--resume", str(run), "--max-iterations", "2", "-q"]) == 0
    assert [row["iteration"] for row in notes(run, "note-1") if "step" in row] == [2]


def test_tracker_gets_final_state_of_diverged_run(capfd):
    run = train(
        "a", "--agent", "sb3-ppo", "agent.learning_rate=1e30", "--max-iterations", "3", "--logger", "notebook", code=6
    )
    assert notes(run)[-1] == {"closed": "diverged"}


def test_only_close_waits_for_a_slow_tracker():
    class Slow:
        id = "slow"

        def __init__(self):
            self.may, self.rows = threading.Event(), []

        def write(self, *row):
            self.may.wait()
            self.rows.append(row)

        def close(self, state):
            self.rows.append(state)

    slow = Slow()
    tracker = BackgroundTracker(slow)
    for step in range(3):
        tracker.write(step, step, {"a": 1.0, "b": float("nan")})
    assert slow.rows == []
    threading.Timer(0.1, slow.may.set).start()
    tracker.close("finished")
    assert slow.rows == [(step, step, {"a": 1.0}) for step in range(3)] + ["finished"]


@pytest.mark.parametrize("name", ["tensorboard", "wandb", "mlflow", "trackio"])
def test_missing_logger_error_names_its_extra(name, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(DependencyError) as missing:
        check_loggers([name])
    assert missing.value.hint == pip_install(f"rlcli[{name}]")


def test_check_loggers_removes_duplicates_and_none(monkeypatch):
    monkeypatch.setattr(loggers, "_installed", lambda name: True)
    assert check_loggers(["wandb", "tensorboard", "wandb"]) == ["wandb", "tensorboard"]
    assert check_loggers(["none", "mlflow"]) == ["mlflow"]


WITHOUT_NETWORK = """
import sys

def refuse(event, arguments):
    outside = event == "socket.connect" and not isinstance(arguments[1], (str, bytes)) or event in (
        "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "socket.bind")
    if outside and not (event == "socket.bind" and arguments[1][0] in ("::1", "127.0.0.1")):
        print("NETWORK", event, arguments[1:], file=sys.stderr)
        raise OSError(101, "the network is out of reach")

sys.addaudithook(refuse)
from rlcli.cli.app import main
sys.exit(main(sys.argv[1:]))
"""
TRACKERS = ["wandb", "mlflow", "trackio"]
KEYS = ("WANDB_API_KEY", "WANDB_MODE", "MLFLOW_TRACKING_URI", "TRACKIO_DIR", "TRACKIO_SPACE_ID", "HF_TOKEN", "NETRC")


def train_without_network(tmp_path, *words):
    """Train in a process without network access; if the system can, also in a network namespace without devices."""
    import os

    settings = {name: value for name, value in os.environ.items() if name not in KEYS}
    settings |= {"HOME": str(tmp_path), "OMP_NUM_THREADS": "1"}
    unshare = ["unshare", "-rn"]
    can_unshare = shutil.which("unshare") and subprocess.run([*unshare, "true"], capture_output=True).returncode == 0
    command = [*(unshare if can_unshare else []), sys.executable, "-c", WITHOUT_NETWORK, "train", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, env=settings)
    assert done.returncode == 0, done.stderr
    assert "NETWORK" not in done.stderr
    (run,) = Path("runs").glob("*/*")
    assert done.stdout == f"{run}\n"
    assert not [file for file in run.rglob("*") if file.is_symlink()]
    return run, done.stderr


def test_training_needs_no_network(tmp_path):
    run, _ = train_without_network(tmp_path, *SMALL, "--max-iterations", "2")
    assert len([*read_rows(run / "metrics.jsonl")]) == 2


@pytest.mark.slow
@pytest.mark.parametrize("name", TRACKERS)
def test_library_works_offline_and_continues_after_resume(name, tmp_path):
    if importlib.util.find_spec(name) is None:
        pytest.skip("not installed")
    words = ("--max-iterations", "4", "agent.save_interval=1", "--logger", name)
    run, err = train_without_network(tmp_path, *SMALL, *words)
    assert ("wandb sync" in err) == (name == "wandb")
    step = [*read_rows(run / "metrics.jsonl")][1]["step"]
    train_without_network(tmp_path, "--resume", f"{run}@step:{step}", "--max-iterations", "6", "-q")
    rows = [*read_rows(run / "metrics.jsonl")]
    assert len(rows) == 6
    read = {"wandb": _read_wandb, "mlflow": _read_mlflow, "trackio": _read_trackio}[name]
    assert read(run, "Loss/value") == [(row["step"], pytest.approx(row["Loss/value"])) for row in rows]


def _read_wandb(run, metric):
    """Return (step, value) rows of the offline files, which are LevelDB logs with blocks of 32 KiB."""
    from wandb.proto import wandb_internal_pb2

    rows = []
    for file in sorted(run.glob("wandb/offline-run-*/*.wandb")):
        data, at, record = file.read_bytes(), 7, b""
        while at + 7 <= len(data):
            if 32768 - at % 32768 < 7:
                at += 32768 - at % 32768
            length, kind = struct.unpack_from("<HB", data, at + 4)
            if kind == 0:
                break
            record += data[at + 7 : at + 7 + length]
            at += 7 + length
            if kind in (1, 4):
                entry = wandb_internal_pb2.Record.FromString(record)
                record = b""
                items = {i.nested_key[0] if i.nested_key else i.key: i.value_json for i in entry.history.item}
                if metric in items:
                    rows.append((int(items["_step"]), json.loads(items[metric])))
    return rows


def _read_mlflow(run, metric):
    import os

    os.environ["MLFLOW_ALLOW_FILE_STORE"] = "true"
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    from mlflow import MlflowClient

    client = MlflowClient((run / "mlflow").resolve().as_uri())
    (found,) = client.search_runs([e.experiment_id for e in client.search_experiments()])
    assert found.info.status == "FINISHED"
    assert found.data.params["seed"] == "42"
    assert found.data.params["agent.trainer"] == "ppo"
    return [(entry.step, entry.value) for entry in client.get_metric_history(found.info.run_id, metric)]


def _read_trackio(run, metric):
    import sqlite3

    (file,) = (run / "trackio").glob("*.db")
    with sqlite3.connect(file) as database:
        rows = database.execute("select step, metrics from metrics order by step").fetchall()
    return [(step, json.loads(metrics)[metric]) for step, metrics in rows]


def test_random_numbers_of_tracker_do_not_change_training(capfd):
    random.seed(3)
    before = random.getstate()
    train("a", "--max-iterations", "1", "--logger", "none")
    after = random.random()
    random.setstate(before)
    train("b", "--max-iterations", "1", "--logger", "notebook")
    assert random.random() == after
