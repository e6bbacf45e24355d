"""Tests of stopping a training and of its display."""

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
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("empty_folder")]


def wait_for_training(process, seconds=60):
    """Wait until metrics are being written."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and process.poll() is None:
        if any(file.stat().st_size for file in Path("runs").glob("*/*/metrics.jsonl")):
            return
        time.sleep(0.02)
    raise AssertionError(process.communicate()[1])


def test_run_folder_is_written_before_heavy_imports(start):
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


def run_on_terminal(*arguments):
    """Run a command on a terminal; return its output and exit code."""
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


def test_terminal_shows_live_table():
    shown, code = run_on_terminal("train", "cartpole", *LONG, "episode_length_s=0.3", "--max-iterations", 20)
    assert code == 0, shown
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown)
    for word in (
        "iteration 20/20", "10,240 steps", "steps/s", "left", "physics", "task", "policy", "update",
        "reward terms", "alive", "pole_pos", "terminations", "time_out", "cart_out_of_bounds",
        "surrogate", "value", "mean_episode_length", "mean_reward", "learning_rate",
    ):  # fmt: skip
        assert word in text, word
    assert "\x1b[" in shown
    assert shown.count("\x1b[?25l") <= shown.count("\x1b[?25h")  # the cursor is visible again


def test_error_on_terminal_is_one_message():
    shown, code = run_on_terminal("train", "cartpole", "rewards.alive.wieght=2")
    assert code == 3
    assert "did you mean 'weight'" in shown
    assert "Traceback" not in shown


def test_pipe_gets_plain_lines_and_run_on_stdout(start, only_run):
    process = start("train", "cartpole", *LONG, "--max-iterations", 10)
    out, err = process.communicate(timeout=60)
    assert out == f"{only_run()}\n"
    assert "\x1b" not in err
    assert re.search(r"^iteration 10/10  5120 steps  \d+ steps/s.* left$", err, re.MULTILINE)
    assert err.count("iteration ") <= 4
    assert "rlcli play --checkpoint" in err


def test_time_limit_stops_with_a_checkpoint_and_resume_continues(start, only_run):
    process = start("train", "cartpole", *LONG, "--max-iterations", 100_000, "--max-minutes", 0.05, "--json")
    document = json.loads(process.communicate(timeout=60)[0])
    assert (process.returncode, document["state"]) == (0, "stopped")
    record = json.loads((only_run() / "run.json").read_text())
    assert record["state"] == "stopped"
    assert record["iteration"] == document["iteration"] >= 1
    end = document["iteration"] + 1
    process = start("train", "--resume", "latest", "--max-iterations", end, "--max-minutes", 5, "--json")
    document = json.loads(process.communicate(timeout=60)[0])
    assert (document["state"], document["iteration"]) == ("finished", end)


@pytest.mark.parametrize(("at_most", "compares"), [(3.2, False), (1e-9, True)])
def test_end_of_training_names_what_success_counts_and_a_comparison_below_the_bar(start, only_run, at_most, compares):
    words = ["--max-iterations", 2, "episode_length_s=0.1", f"success.pole.at_most={at_most}", "success.pole.hold_s=0"]
    _, err = start("train", "cartpole", *LONG, *words).communicate(timeout=60)
    rate, run = ("0.0%", only_run()) if compares else ("100.0%", only_run())
    counts = f"success {rate} counts the last episodes of the training, with exploration noise"
    assert f"{counts}; without noise: rlcli eval --checkpoint {run}\n" in err
    assert (f"rlcli eval --compare {run} zero\n" in err) is compares


def test_end_of_training_prefers_the_success_of_the_last_evaluation(start, only_run):
    words = ["--max-iterations", 2, "agent.eval_interval=1", "agent.eval_episodes=4"]
    end = ["episode_length_s=0.1", "success.pole.at_most=3.2", "success.pole.hold_s=0"]
    _, err = start("train", "cartpole", *LONG, *words, *end).communicate(timeout=60)
    says = "success 100.0% in the last evaluation, without exploration noise; repeat: rlcli eval --checkpoint"
    assert f"{says} {only_run()}\n" in err
    assert "with exploration noise" not in err


def test_quiet_prints_only_the_result(start, only_run):
    out, err = start("train", "cartpole", *LONG, "-q", "--max-iterations", 2).communicate(timeout=60)
    assert (out, err) == (f"{only_run()}\n", "")


@pytest.mark.parametrize("more", [(), ("rewards.alive.wieght=2",), ("agent.learning_rate=1e30",)])
def test_json_prints_one_document(start, more):
    out, _ = start("train", "cartpole", *LONG, *more, "--max-iterations", 2, "--json").communicate(timeout=60)
    document = json.loads(out)
    assert document["schema"] == 1
    assert ("error" in document) == bool(more)


def test_json_of_stopped_run_has_exit_code(start):
    process = start("train", "cartpole", *LONG, "--max-iterations", 100_000, "--json")
    wait_for_training(process)
    process.send_signal(signal.SIGINT)
    error = json.loads(process.communicate(timeout=60)[0])["error"]
    assert (error["kind"], error["exit_code"]) == ("stopped", 130)
    assert "rlcli train --resume" in error["hint"]
