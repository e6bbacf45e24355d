"""Words of the command line and files behind them that are refused with one message, before any work."""

import os
import threading
import time
from pathlib import Path

import pytest

from rlcli.errors import ConfigError
from rlcli.machine import plain_files
from rlcli.machine.plain_files import read_plain

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("eval", "cartpole", "--record", ""), "--record"),
        (("train", "cartpole", "--config="), "--config"),
        (("train", "cartpole", "--runs-dir", ""), "--runs-dir"),
        (("plot", "latest", "-o", ""), "-o"),
        (("show", ""), "show"),
    ],
)
def test_empty_word_is_refused_with_its_option(cli, words, option):
    done = cli(*words)
    assert (done.code, done.err) == (
        2,
        f"error: there is an empty word after {option}\nhint: write a value there, or leave out the empty word\n",
    )


@pytest.mark.parametrize("option", ["--runs-dir", "--config", "--name", "--resume"])
def test_word_that_is_not_utf8_is_refused(cli, option):
    done = cli("train", "cartpole", option, os.fsdecode(b"\xe9dir"))
    assert done.code == 2
    assert done.err.startswith(r"error: a word of the command line is not UTF-8: '\udce9dir'")
    assert not list(Path().iterdir())


def test_environment_variable_that_is_not_utf8_is_refused(cli, monkeypatch):
    monkeypatch.setenv("RLCLI_RUNS_DIR", os.fsdecode(b"\xe9dir"))
    assert "RLCLI_RUNS_DIR is not UTF-8" in cli("runs").err


def test_long_name_is_refused_with_its_limit(cli):
    done = cli("train", "cartpole", "--name", "n" * 300)
    assert (done.code, "--name has 300 characters; at most 200 are allowed" in done.err) == (2, True), done.err
    assert not Path("runs").exists()


@pytest.mark.parametrize("command", ["train", "show", "validate", "check"])
def test_long_task_is_a_usage_error(cli, command):
    done = cli(command, "n" * 300)
    assert done.code == 2
    assert "is too long: a name in a path has at most 255 bytes" in done.err


def test_long_output_file_has_a_hint(cli):
    done = cli("report", "latest", "-o", "n" * 300 + ".html")
    assert (done.code, "hint: a name in a path has at most 255 bytes: shorten it" in done.err) == (10, True), done.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("eval", "cartpole", "--record-mode", "failed"), "--record-mode needs --record FILE"),
        (("play", "cartpole", "--record-mode", "failed"), "--record-mode needs --record FILE"),
        (("bench", "cartpole", "--overwrite"), "--overwrite needs --save-preset FILE"),
        (("export", "cartpole", "--episodes", "8"), "--episodes needs --verify"),
        (("autopsy", "latest", "--steps", "3"), "--steps needs the number of a recorded episode"),
    ],
)
def test_option_that_needs_another_is_refused_alone(cli, words, message):
    done = cli(*words)
    assert (done.code, message in done.err) == (2, True), done.err


def test_task_that_is_a_pipe_is_named_as_such(cli):
    os.mkfifo("task")
    done = cli("show", "./task")
    assert (done.code, "'task' is a device or pipe" in done.err) == (4, True), done.err


def test_config_file_is_read_up_to_its_limit(cli, monkeypatch):
    monkeypatch.setattr(plain_files, "_PIPE_S", 0.1)
    with open("sparse.yaml", "wb") as file:
        file.truncate(3 * 2**30)
    assert "larger than 262144 bytes" in cli("show", "cartpole", "--config", "sparse.yaml").err
    os.mkfifo("pipe.yaml")
    done = cli("show", "cartpole", "--config", "pipe.yaml")  # nobody writes to it
    assert done.code == 3
    assert "pipe.yaml: the file cannot be read: nothing was written to the pipe in 0.1 s" in done.err
    assert "it is not a regular file" in cli("show", "cartpole", "--config", "/dev/zero").err


def test_pipe_of_a_shell_is_read_until_its_writer_closes_it():
    reader, writer = os.pipe()

    def write():
        for part in (b"sim: ", b"{dt: 0.01}"):
            time.sleep(0.02)
            os.write(writer, part)
        os.close(writer)

    thread = threading.Thread(target=write)
    thread.start()
    assert read_plain(Path(f"/dev/fd/{reader}"), 100, pipe=True) == b"sim: {dt: 0.01}"
    thread.join()
    os.close(reader)


def test_many_unknown_overrides_are_reported_quickly(cli):
    begin = time.process_time()
    done = cli("show", "cartpole", *(f"a{number}.b=1" for number in range(500)))
    assert done.code == ConfigError.exit_code
    assert time.process_time() - begin < 2.0
