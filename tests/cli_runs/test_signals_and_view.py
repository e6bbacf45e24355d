"""Stopping a training, and what it shows while it runs."""

import json
import os
import pty
import re
import select
import signal
import sys
import time
from pathlib import Path

import pytest

LONG = ("scene.num_envs=32", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none")
pytestmark = pytest.mark.slow


def wait_for_training(process, seconds=60):
    """Until metrics are being written."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and process.poll() is None:
        if any(file.stat().st_size for file in Path("runs").glob("*/*/metrics.jsonl")):
            return
        time.sleep(0.02)
    raise AssertionError(process.communicate()[1])


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_a_signal_writes_a_checkpoint_and_says_how_to_go_on(cli, start, number, code, only_run):
    process = start("train", "cartpole", *LONG, "--max-iterations", 100_000)
    wait_for_training(process)
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert process.returncode == code, err
    assert out == ""
    assert "Traceback" not in err
    record = json.loads((only_run() / "run.json").read_text())
    assert record["state"] == "stopped"
    assert (only_run() / f"checkpoints/{record['step']:012d}/manifest.json").is_file()
    match = re.search(r"hint: rlcli (train --resume \S+)", err)
    assert match, err
    more = str(record["iteration"] + 2)
    done = cli(*match[1].split(), "--max-iterations", more, "-q", "--json")
    assert done.code == 0, done.err
    assert done.json["iteration"] == int(more)
    rows = [json.loads(line)["step"] for line in (only_run() / "metrics.jsonl").read_text().splitlines()]
    assert rows == [32 * 16 * (i + 1) for i in range(int(more))]


def test_a_second_signal_does_not_wait(start, only_run):
    # one iteration lasts much longer than the test
    slow = ("scene.num_envs=2048", "agent.n_steps=2000", "agent.n_epochs=1000")
    process = start("train", "cartpole", *LONG, *slow)
    deadline = time.monotonic() + 60
    while not list(Path("runs").glob("*/*/checkpoints/*/manifest.json")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.0)
    process.send_signal(signal.SIGTERM)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 75, err
    assert "stopped at once" in err
    assert "Traceback" not in err
    assert sorted(p.name for p in (only_run() / "checkpoints").iterdir()) == ["000000000000", "latest"]


def test_a_signal_before_training_begins_leaves_no_run(start):
    process = start("train", "cartpole", *LONG, "--max-iterations", 3)
    deadline = time.monotonic() + 30
    while not list(Path().glob("runs/*/*/run.json")) and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGTERM)  # torch is being imported
    _, err = process.communicate(timeout=60)
    assert process.returncode == 75, err
    assert not list(Path().glob("runs/*/*"))


def test_configuration_and_checkpoint_0_come_first(start):
    process = start("train", "cartpole", *LONG, "--max-iterations", 100_000)
    deadline = time.monotonic() + 60
    while not list(Path().glob("runs/*/*/run.json")) and time.monotonic() < deadline:
        time.sleep(0.002)
    (run,) = Path().glob("runs/*/*")
    assert (run / "config.yaml").is_file()
    maps = Path(f"/proc/{process.pid}/maps").read_text()
    assert "libtorch" not in maps
    assert "libmujoco" not in maps
    wait_for_training(process)
    assert (run / "checkpoints/000000000000/manifest.json").is_file()


def on_a_terminal(*arguments):
    """What a command writes to a terminal, and its exit code."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(TERM="xterm-256color", COLUMNS="160", LINES="50")
        os.execv(sys.executable, [sys.executable, "-m", "rlcli", *map(str, arguments)])
    import fcntl
    import struct
    import termios

    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 160, 0, 0))
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


def test_a_terminal_shows_the_live_table():
    shown, code = on_a_terminal("train", "cartpole", *LONG, "episode_length_s=0.3", "--max-iterations", 20)
    assert code == 0, shown
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    for word in (
        "iteration 20/20", "10,240 steps", "steps/s", "left", "physics", "task", "policy", "update",
        "reward terms", "alive", "pole_pos", "terminations", "time_out", "cart_out_of_bounds",
        "surrogate", "value", "mean_episode_length", "mean_reward", "learning_rate",
    ):  # fmt: skip
        assert word in text, word
    assert "\x1b[" in shown
    assert shown.count("\x1b[?25l") <= shown.count("\x1b[?25h")  # the cursor is back


def test_a_mistake_on_a_terminal_is_one_message():
    shown, code = on_a_terminal("train", "cartpole", "rewards.alive.wieght=2")
    assert code == 3
    assert "did you mean 'weight'" in shown
    assert "Traceback" not in shown


def test_elsewhere_plain_lines_and_the_run_on_stdout(start, only_run):
    process = start("train", "cartpole", *LONG, "--max-iterations", 10)
    out, err = process.communicate(timeout=60)
    assert out == f"{only_run()}\n"
    assert "\x1b" not in err
    assert re.search(r"^iteration 10/10  5120 steps  \d+ steps/s.* left$", err, re.MULTILINE)
    assert err.count("iteration ") <= 4
    assert "rlcli play --checkpoint" in err


def test_quiet_says_nothing_but_the_result(start, only_run):
    out, err = start("train", "cartpole", *LONG, "-q", "--max-iterations", 2).communicate(timeout=60)
    assert (out, err) == (f"{only_run()}\n", "")


@pytest.mark.parametrize("more", [(), ("rewards.alive.wieght=2",), ("agent.learning_rate=1e30",)])
def test_json_keeps_stdout_to_one_document(start, more):
    out, _ = start("train", "cartpole", *LONG, *more, "--max-iterations", 2, "--json").communicate(timeout=60)
    document = json.loads(out)
    assert document["schema"] == 1
    assert ("error" in document) == bool(more)


def test_json_of_a_stopped_run_names_its_exit_code(start):
    process = start("train", "cartpole", *LONG, "--max-iterations", 100_000, "--json")
    wait_for_training(process)
    process.send_signal(signal.SIGINT)
    error = json.loads(process.communicate(timeout=60)[0])["error"]
    assert (error["kind"], error["exit_code"]) == ("stopped", 130)
    assert "rlcli train --resume" in error["hint"]
