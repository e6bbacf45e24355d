"""`rlcli runs` and `rlcli watch`: state of trainings from the files of own and untrusted runs."""

import json
import os
import pty
import re
import select
import shlex
import signal
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from rlcli.cli.commands.runs import age_text, size_text
from rlcli.runs.eval_store import write_evaluation
from rlcli.runs.overview import overviews, state_of
from rlcli.runs.run import create_run, open_run
from rlcli.runs.run_lock import is_locked

pytestmark = pytest.mark.usefixtures("empty_folder")

RECORD = {"task": {"name": "arm", "distribution": "arms"}, "agent": "ppo", "seed": 7, "iterations": 40}
SMALL = ("cartpole", "scene.num_envs=8", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")


def row(iteration, **metrics):
    shares = {"physics": 0.5, "task": 0.125, "policy": 0.125, "update": 0.25}
    split = {"Perf/collection_time": 0.75, "Perf/learning_time": 0.25}
    split |= {f"Perf/{part}_share": share for part, share in shares.items()}
    return {"iteration": iteration, "step": 64 * iteration, **split, **metrics}


def write_rows(run, *rows):
    with run.metrics.open("a") as file:
        file.write("".join(json.dumps(one) + "\n" for one in rows))


@pytest.fixture
def made():
    """Return a function that makes a run from metric rows, a final state (None: running) and entries of run.json."""
    locked = []

    def make(name="a", rows=(), state=None, task="arm", checkpoint=True, started="2026-01-01T10:00:00+00:00", **record):
        record = {**RECORD, "task": {**RECORD["task"], "name": task}, **record}
        run = create_run(Path("runs"), task, name, "decimation: 1\n", record)
        write_rows(run, *rows)
        if checkpoint:
            (run.checkpoints / f"{64:012d}").mkdir()
            (run.checkpoints / f"{64:012d}" / "manifest.json").write_text("{}")
        if state is None:
            locked.append(run)
        else:
            run.update(state=state, step=64, iteration=1, started=started)
            run.unlock()
        return run

    yield make
    for run in locked:
        run.unlock()


def listed(cli, *words):
    done = cli("runs", *words, "--json")
    assert done.code == 0
    return done.json["runs"]


def test_run_row_has_progress_and_score(cli, made):
    write = {"Train/mean_reward": 3.25, "Train/success_rate": 0.5}
    made("first", [row(1, **write), row(2)], **{"device": "cuda"})
    (found,) = listed(cli)
    wanted = {
        "task": "arm", "state": "running", "iteration": 2, "iterations": 40, "step": 128, "agent": "ppo", "seed": 7,
        "last": {"return": 3.25, "success": 0.5}, "best": {}, "resumable": False, "reason": None,
    }  # fmt: skip
    assert {key: found[key] for key in wanted} == wanted
    assert found["tags"]["device"] == "cuda"
    assert found["run"].endswith("-first")
    assert found["age_s"] < 60
    files = [file for file in Path(found["run"]).rglob("*") if file.is_file()]
    assert found["size_bytes"] == sum(file.stat().st_size for file in files) > 0
    out = cli("runs").out
    for word in ("STATE", "arm/", "running", "2/40", "3.25", "50.0%", "ppo", "7", "cuda"):
        assert word in out, word


@pytest.mark.parametrize("state", ["finished", "stopped", "diverged", "failed"])
def test_ended_run_has_state_and_reason(cli, made, state):
    made("a", [row(1)], state, reason="the disk is full")
    (found,) = listed(cli)
    assert found["state"] == state
    assert found["reason"] == ("the disk is full" if state in ("diverged", "failed") else None)
    assert found["resumable"]
    assert (": resumable" in cli("runs").out) == (state != "finished")


@pytest.mark.parametrize(("checkpoint", "step", "resumable"), [(True, 64, True), (False, None, True)])
def test_unlocked_running_run_is_interrupted(cli, made, checkpoint, step, resumable):
    run = made("a", [row(1)], "running", checkpoint=checkpoint)
    if step is None:
        record = {key: value for key, value in run.record.items() if key not in ("step", "iteration")}
        (run.folder / "run.json").write_text(json.dumps(record))
    (found,) = listed(cli)
    assert (found["state"], found["resumable"]) == ("interrupted", resumable)


def test_run_that_is_killed_at_once_is_interrupted_at_once(cli, made):
    made("a", [row(1)], "running", started=datetime.now(UTC).isoformat())
    (found,) = listed(cli)
    reason = "the process of the run was killed, or the machine stopped"
    assert (found["state"], found["reason"]) == ("interrupted", reason)


def test_run_that_ends_while_it_is_read_is_not_interrupted(made):
    """The record is read before the lock: a reader may have an old record of a run that is not locked any more."""
    run = made("a", [row(1)])
    read = open_run(run.folder)
    run.update(state="failed", reason="the disk is full")
    run.unlock()
    assert state_of(read) == ("failed", "the disk is full")


@pytest.mark.parametrize("hours", [1, 24 * 365])
def test_clock_that_was_ahead_leaves_no_running_run(cli, made, hours):
    later = datetime.now(UTC) + timedelta(hours=hours)
    made("a", [row(1)], "running", started=later.isoformat(), trained_s=3.0, since=later.isoformat())
    (found,) = listed(cli)
    assert (found["state"], found["resumable"], found["age_s"], found["duration_s"]) == ("interrupted", True, None, 3.0)
    folder = Path("runs/arm/empty")
    folder.mkdir()
    os.utime(folder, (later.timestamp(), later.timestamp()))
    assert {run["run"]: run["state"] for run in listed(cli)}[str(folder)] == "broken"


def test_latest_warns_of_a_start_in_the_future(cli, made):
    made("a", [row(1)], "finished")
    assert "future" not in cli("watch", "latest").err
    made("b", [row(1)], "finished", started=(datetime.now(UTC) + timedelta(hours=1)).isoformat())
    warned = cli("watch", "latest")
    assert warned.code == 0
    assert "started in the future by this machine's clock" in warned.err


def test_run_without_checkpoints_is_not_resumable(cli, made):
    made("a", [row(1)], "running", checkpoint=False)
    assert not listed(cli)[0]["resumable"]


def test_best_score_comes_from_evaluations(cli, made):
    rows = [row(n, **{"Eval/mean_reward": float(n), "Eval/success_rate": n / 10}) for n in (1, 2, 3)]
    made("a", rows, "finished", best=128)
    assert listed(cli)[0]["best"] == {"step": 128, "return": 2.0, "success": 0.2}
    assert "20.0%" in cli("runs").out


def test_saved_evaluation_is_shown(cli, made):
    run = made("a", [row(1)], "finished")
    mean, none = {"mean": 4.5, "std": 0.1, "low": 4.4, "high": 4.6}, {"rate": 0.875, "low": 0.5, "high": 1.0}
    document = {"command": "eval", "episodes": 8, "seed": 1, "return": mean, "length": mean, "success": none}
    document |= {"reward_terms": {}, "terminations": {}, "diverged": 0, "diverged_by": {}}
    write_evaluation(run, f"{64:012d}", document)
    (run.folder / "evaluations" / "000000000128.json").write_text("{")
    assert listed(cli)[0]["evaluation"] == {"step": 64, "episodes": 8, "return": 4.5, "success": 0.875}
    assert "87.5%" in cli("runs").out


def test_runs_of_task_are_newest_first_with_limit(cli, made):
    days = {"old": 1, "new": 3, "middle": 2}
    for name, day in days.items():
        made(name, [], "finished", started=f"2026-01-0{day}T10:00:00+00:00")
    made("other", [], "finished", task="leg")
    assert [found["run"].rpartition("-")[2] for found in listed(cli, "arm")] == ["new", "middle", "old"]
    done = cli("runs", "arm", "--limit", 2)
    assert "-old" not in done.out
    assert "older runs that are not shown: 1" in done.err
    assert cli("runs", "./arm").out == cli("runs", "arms:arm").out == cli("runs", "arm").out


def test_empty_list_has_message(cli, made):
    done = cli("runs")
    assert (done.code, done.out) == (0, "")
    assert "no run in runs" in done.err
    made("a", [], "finished")
    assert "did you mean 'arm'" in cli("runs", "arn").err
    assert listed(cli, "leg") == []


def test_trained_time_excludes_pauses(cli, made):
    day = (datetime.now(UTC) - timedelta(days=1)).isoformat()
    made("a", [row(1)], "finished", trained_s=90.0, started=day)
    made("b", [row(1)], trained_s=90.0, since=(datetime.now(UTC) - timedelta(seconds=10)).isoformat())
    ended, running = sorted(listed(cli), key=lambda found: found["run"])
    assert ended["duration_s"] == 90.0
    assert 99.0 < running["duration_s"] < 160.0
    assert 86400 <= ended["age_s"] < 86500
    assert "1 d" in cli("runs").out


BROKEN = {
    "no run.json": (lambda run: (run / "run.json").unlink(), "has no run.json"),
    "no JSON": (lambda run: (run / "run.json").write_text("{"), "not JSON"),
    "a list": (lambda run: (run / "run.json").write_text("[]"), "not a JSON object"),
    "no task": (lambda run: (run / "run.json").write_text("{}"), "missing key 'task'"),
    "a link out": (lambda run: (run / "config.yaml").replace(run.parent / "c") and (run / "config.yaml").symlink_to(
        run.parent / "c"), "is a link"),
    "a pipe": (lambda run: ((run / "run.json").unlink(), os.mkfifo(run / "run.json")), "not a regular file"),
    "metrics that are a pipe": (lambda run: ((run / "metrics.jsonl").unlink(), os.mkfifo(run / "metrics.jsonl")),
                                "not a regular file"),
    "no config": (lambda run: (run / "config.yaml").unlink(), "no config.yaml"),
    "a state of its own": (lambda run: _edit(run, state="\x1b[31mfine"), "fine"),
}  # fmt: skip


def _edit(run, **entries):
    record = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(record | entries))


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_run_row_has_reason(cli, made, kind):
    spoil, reason = BROKEN[kind]
    run = made("broken", [row(1)], "finished")
    made("good", [row(1)], "finished")
    spoil(run.folder)
    found = {found["run"].rpartition("-")[2]: found for found in listed(cli)}
    assert found["good"]["state"] == "finished"
    assert found["broken"]["state"] == "broken"
    assert reason in found["broken"]["reason"]
    done = cli("runs")
    assert "broken" in done.out
    assert "\x1b" not in done.out


STRANGE = {
    "half a line": b'{"iteration": 9, "st',
    "a number too large": b'{"iteration": 1e999, "step": 3}\n',
    "an integer larger than any float": b'{"iteration": 4, "step": 256, "Train/mean_reward": 1' + b"0" * 400 + b"}\n",
    "a list": b"[1, 2]\n",
    "deep": b"[" * 100_000 + b"\n",
    "binary": bytes(range(256)) * 300 + b"\n",
    "one long line": b'{"iteration": 8, "step": 512, "a": "' + b"x" * 3_000_000 + b'"}\n',
}


@pytest.mark.parametrize("kind", STRANGE)
def test_malformed_metrics_are_skipped(cli, made, kind):
    run = made("a", [row(3, **{"Train/mean_reward": 1.5})], "finished")
    with run.metrics.open("ab") as file:
        file.write(STRANGE[kind])
    assert listed(cli)[0]["state"] == "finished"
    assert cli("watch").code == 0


def test_endless_training_is_shown(cli, made):
    made("a", [row(1) | {"Perf/collection_time": 9e299}], "stopped", iterations=10**18, trained_s=1e300)
    done = cli("watch")
    assert (done.code, "? left" in done.err) == (0, True)
    (line,) = [line for line in cli("runs").out.splitlines() if line.startswith("arm/")]
    assert len(line) < 200


def test_untrusted_metric_names_have_no_control_characters(made):
    made("a", [row(1, **{"Train/\x1b]0;owned\x07[red]x": 1.0})], "finished")
    shown, code = on_a_terminal("watch")
    assert code == 0
    assert "\x1b]0;" not in shown
    assert "[red]x" in shown


def test_runs_and_watch_import_nothing_heavy_and_write_nothing(made, environment):
    made("a", [row(1)], "finished")
    before = {path: path.stat().st_mtime_ns for path in Path("runs").rglob("*")}
    for words in (["runs"], ["watch", "latest"], ["watch", "latest", "--json"]):
        program = (
            f"import sys; from rlcli.cli.app import main; code = main({words!r});"
            "print(code, sorted({'torch', 'mujoco', 'numpy'} & set(sys.modules)))"
        )
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "0 []", done.stderr
    assert {path: path.stat().st_mtime_ns for path in Path("runs").rglob("*")} == before


def test_is_locked_does_not_block_writers(made):
    run = open_run(made("a", [], "finished").folder)
    over = threading.Event()

    def look():
        while not over.is_set():
            is_locked(run.folder)

    watchers = [threading.Thread(target=look) for _ in range(2)]
    for watcher in watchers:
        watcher.start()
    try:
        for _ in range(100):
            run.lock()
            run.unlock()
    finally:
        over.set()
        for watcher in watchers:
            watcher.join()


def test_watch_shows_ended_run(cli, made):
    made("a", [row(n, **{"Train/mean_reward": 2.5, "Train/mean_episode_length": 9}) for n in (1, 2)], "stopped")
    done = cli("watch", "latest")
    assert done.code == 0
    assert re.search(r"^iteration 2/40  128 steps  64 steps/s  return 2.500  length 9", done.err, re.MULTILINE)
    assert "stopped, iteration 2 of 40" in done.out
    assert "rlcli train --resume runs/arm/" in done.err


def test_watch_json_prints_current_state(cli, made):
    made("a", [row(n, **{"Loss/value": 0.5}) for n in (1, 2)])
    found = cli("watch", "--json").json
    assert (found["state"], found["iteration"], found["iterations"]) == ("running", 2, 40)
    assert found["steps_per_s"] == pytest.approx(64)
    assert found["remaining_s"] == pytest.approx(38)
    assert found["metrics"]["Loss/value"] == 0.5


@pytest.mark.parametrize("words", [("watch",), ("watch", "nothing"), ("watch", "--json")])
def test_watch_of_missing_run_is_checkpoint_error(cli, words):
    assert cli(*words).code == 5


def until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_watch_follows_run_to_its_end(start, made):
    run = made("a", [row(1)])
    with Path("err").open("w") as err:
        process = start("watch", run.folder, stderr=err)
        until(lambda: "iteration 1/40" in Path("err").read_text())
        write_rows(run, row(2), row(3, **{"Train/success_rate": 0.75}))
        time.sleep(1.0)  # `watch` prints a line every few seconds
        assert process.poll() is None
        run.update(state="diverged", reason="the learner's loss is not finite", iteration=3, step=192)
        run.unlock()
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "diverged, iteration 3 of 40" in out
    assert "iteration 3/40  192 steps" in Path("err").read_text()
    assert "success 75.0%" in Path("err").read_text()
    assert "the learner's loss is not finite" in Path("err").read_text()


def test_ctrl_c_stops_watch_but_not_the_run(start, made):
    run = made("a", [row(1)])
    with Path("err").open("w") as err:
        process = start("watch", "latest", stderr=err)
        until(lambda: "iteration 1/40" in Path("err").read_text())
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 130
    assert "the training continues" in Path("err").read_text()
    assert is_locked(run.folder)
    assert json.loads((run.folder / "run.json").read_text())["state"] == "running"


def on_a_terminal(*words):
    """Run a command on a terminal; return its output and its exit code."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(TERM="xterm-256color", COLUMNS="160", LINES="50")
        os.execv(sys.executable, [sys.executable, "-m", "rlcli", *map(str, words)])
    shown = b""
    while select.select([terminal], [], [], 60)[0]:
        try:
            chunk = os.read(terminal, 65536)
        except OSError:
            break
        if not chunk:
            break
        shown += chunk
    os.close(terminal)
    return shown.decode(errors="replace"), os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def test_watch_shows_live_table_on_terminal(made):
    metrics = {"Train/mean_reward": 2.5, "Episode_Reward/alive": 1.0, "Episode_Termination/fell": 0.25, "Loss/value": 3}
    made("a", [row(2, **metrics)], "finished")
    shown, code = on_a_terminal("watch", "latest")
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    assert code == 0
    for word in ("iteration 2/40", "128 steps", "physics  50%", "reward terms", "alive", "fell", "25.0%", "learner"):
        assert word in text, word
    assert shown.count("\x1b[?25l") <= shown.count("\x1b[?25h")  # the cursor is visible again


@pytest.mark.parametrize(
    ("value", "words"), [(0.4, "0 s"), (59, "59 s"), (60, "1 min"), (7200, "2 h"), (86400 * 3, "3 d")]
)
def test_age_in_largest_unit(value, words):
    assert age_text(value) == words


@pytest.mark.parametrize(("value", "words"), [(0, "0 B"), (999, "999 B"), (1500, "1.5 kB"), (2.5e12, "2500.0 GB")])
def test_size_with_unit(value, words):
    assert size_text(value) == words


@pytest.mark.slow
def test_training_is_visible_to_other_processes(cli, start):
    words = ("train", *SMALL, "agent.save_interval=1")
    training = start(*words, "--max-iterations", 100_000)
    until(lambda: len(overviews(Path("runs"))) == 1)
    (found,) = overviews(Path("runs"))
    assert found.state == "running"
    watcher = start("watch", found.folder)
    until(lambda: (overviews(Path("runs"))[0].iteration or 0) > 3)
    assert overviews(Path("runs"))[0].iterations == 100_000
    training.kill()
    out, err = watcher.communicate(timeout=60)
    assert watcher.returncode == 0
    assert "interrupted, iteration" in out
    assert "rlcli train --resume" in err
    (found,) = listed(cli)
    assert (found["state"], found["resumable"]) == ("interrupted", True)
    done = cli("train", "--resume", "latest", "--max-iterations", found["iteration"] + 2, "-q")
    assert done.code == 0
    (after,) = listed(cli)
    assert (after["state"], after["iteration"], after["iterations"]) == ("finished", *[found["iteration"] + 2] * 2)
    assert after["duration_s"] > 0


@pytest.mark.slow
def test_diverged_training_has_state_and_reason(cli):
    assert cli("train", *SMALL, "agent.learning_rate=1e30").code == 6
    (found,) = listed(cli)
    assert found["state"] == "diverged"
    assert "not finite" in found["reason"]


def test_run_being_created_is_not_broken(cli):
    folder = Path("runs/arm/2026-01-01_10-00-00")
    (folder / "checkpoints").mkdir(parents=True)
    assert listed(cli)[0]["state"] == "running"
    assert "0/?" in cli("runs").out
    os.utime(folder, (0, 0))
    assert listed(cli)[0]["state"] == "broken"


def test_links_in_a_folder_of_runs_are_not_followed(cli, made, tmp_path):
    made(state="finished")
    elsewhere = tmp_path / "elsewhere"
    Path("runs").rename(elsewhere)
    Path("runs").mkdir()
    Path("runs/root").symlink_to("/")
    Path("runs/arm").symlink_to(elsewhere / "arm")
    Path("runs/own").mkdir()
    Path("runs/own/linked").symlink_to(next((elsewhere / "arm").iterdir()))
    result = cli("runs", "--json")
    assert result.json["runs"] == []
    for link in ("runs/root", "runs/arm", "runs/own/linked"):
        assert result.err.count(f"{link} is a link; rlcli does not search it") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="sizes of files are limited by Linux")
def test_training_that_cannot_write_its_first_checkpoint_has_failed(cli):
    words = ("train", *SMALL, "--max-iterations", 4, "--device", "cpu")
    command = "ulimit -f 8; exec " + shlex.join([sys.executable, "-m", "rlcli", *map(str, words)])
    assert subprocess.run(["bash", "-c", command], capture_output=True).returncode == 10
    (found,) = listed(cli)
    assert (found["state"], found["resumable"]) == ("failed", True)
    assert "File too large" in found["reason"]
    assert cli("train", "--resume", "latest", "--max-iterations", 1, "-q").code == 0
