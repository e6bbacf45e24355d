"""Tests of loggers: one line of valid JSON per iteration, and no step twice after a resume."""

import json
import math
import resource

import pytest

from rlcli.errors import DependencyError, MachineError, UsageError
from rlcli.runs.metric_rows import read_rows
from rlcli.training.loggers import JsonLines, TensorBoard, check_loggers


def steps_of(file):
    return [row["step"] for row in read_rows(file)]


def test_json_lines_writes_each_row_at_once(tmp_path):
    log = JsonLines(tmp_path / "metrics.jsonl")
    log.write(1, 16, {"Loss/value": 0.5})
    assert json.loads((tmp_path / "metrics.jsonl").read_text()) == {"iteration": 1, "step": 16, "Loss/value": 0.5}
    log.close()


def test_json_lines_leaves_out_nan_and_infinity(tmp_path):
    log = JsonLines(tmp_path / "metrics.jsonl")
    log.write(1, 16, {"a": math.nan, "b": math.inf, "c": 1.0})
    log.close()
    assert json.loads((tmp_path / "metrics.jsonl").read_text()) == {"iteration": 1, "step": 16, "c": 1.0}


def test_resume_removes_later_rows_and_incomplete_row(tmp_path):
    file = tmp_path / "metrics.jsonl"
    log = JsonLines(file)
    for iteration in range(1, 5):
        log.write(iteration, 16 * iteration, {})
    log.close()
    with file.open("a") as handle:
        handle.write('{"iteration": 5, "st')
    log = JsonLines(file, resume_after=2)
    log.write(3, 48, {})
    log.close()
    assert steps_of(file) == [16, 32, 48]


@pytest.mark.parametrize(
    "line", [b"[1]", b'{"a": 1}', b'{"iteration": "1", "step": 1}', b"\xff", b"[" * 100_000, b"\0" * 2**21]
)
def test_resume_ends_metrics_at_first_damaged_row(tmp_path, line):
    file = tmp_path / "metrics.jsonl"
    good = b'{"iteration": %d, "step": 16}\n'
    file.write_bytes(good % 1 + line + b"\n" + good % 2)
    JsonLines(file, resume_after=2).close()
    assert file.read_bytes() == good % 1


def test_tensorboard_has_no_step_twice_after_resume(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    board = TensorBoard(tmp_path)
    for step in (16, 32, 48):
        board.write(step // 16, step, {"Loss/value": float(step)})
    board.close()
    board = TensorBoard(tmp_path, resume_after_step=32)
    board.write(3, 48, {"Loss/value": 480.0})
    board.close()
    events = accumulator.EventAccumulator(str(tmp_path))
    events.Reload()
    # files of one second and one process are read in the order of their names, in which 10 comes before 9
    written = sorted(events.Scalars("Loss/value"), key=lambda event: event.wall_time)
    assert [(e.step, e.value) for e in written] == [(16, 16.0), (32, 32.0), (48, 480.0)]


def test_tensorboard_raises_a_disk_error_where_it_writes_and_prints_nothing(tmp_path, capfd):
    board = TensorBoard(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            board.write(1, 16, {f"Loss/{number}": 1.0 for number in range(100)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert capfd.readouterr().err == ""


def test_check_loggers_accepts_installed_names(monkeypatch):
    assert check_loggers(["none"]) == []
    assert check_loggers(["tensorboard"]) == ["tensorboard"]
    with pytest.raises(UsageError, match="no logger 'tensorbord'") as caught:
        check_loggers(["tensorbord"])
    assert "tensorboard" in caught.value.hint
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert check_loggers(None) == []
    with pytest.raises(DependencyError) as missing:
        check_loggers(["tensorboard"])
    assert '"rlcli[tensorboard]"' in missing.value.hint


def test_metrics_file_that_cannot_be_opened_is_a_machine_error(tmp_path):
    with pytest.raises(MachineError, match=r"metrics\.jsonl"):
        JsonLines(tmp_path / "gone" / "metrics.jsonl")
