"""Output on a terminal of 40 columns is complete, and output in a pipe is plain text."""

import re

import pytest
from support.pseudo_terminal import run_on_terminal

from rlcli.cli.app import COMMANDS

STYLES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@pytest.fixture
def narrow(here):
    """Return a function that runs a command on a terminal of 40 columns and returns (exit code, lines)."""

    def run(*arguments):
        code, output = run_on_terminal(arguments, here, columns=40)
        return code, STYLES.sub("", output.decode()).replace("\r\n", "\n").split("\n")

    return run


@pytest.mark.slow
def test_tables_fit_forty_columns_without_truncation(narrow, rlcli):
    code, lines = narrow("list-tasks", "cartpole")
    assert code == 0
    assert max(map(len, lines)) <= 40
    assert "…" not in "".join(lines)
    for task in ("cartpole", "cartpole-camera", "cartpole-direct"):
        assert f"TASK {task}" in lines
    piped = rlcli("list-tasks", "cartpole").stdout
    words = set(" ".join(lines).split())
    assert set(piped.split("\n")[1].split()) <= words | {"?"}


@pytest.mark.slow
def test_diff_is_complete_on_forty_columns(narrow, small):
    code, lines = narrow("diff", small(), "sim.dt=0.005", "viewer.width=320")
    assert code == 9
    assert "Traceback" not in "\n".join(lines)
    flat = "".join(lines).replace(" ", "")
    for output in ("sim.dt", "0.005", "override'sim.dt=0.005'", "viewer.width", "differences:physics1,cosmetic1"):
        assert output in flat


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"], ["--version"], ["list-tasks"], ["show", "cartpole"], ["show", "cartpole", "--origin"],
        ["validate", "cartpole"], ["runs"], ["diff", "cartpole", "ant"], ["diff", "cartpole", "nothing"], ["nonsense"],
        ["train", "nothing"], ["watch"], ["report", "latest"], ["import", "oige", "gone.yaml"], ["plot", "latest"],
    ],
)  # fmt: skip
def test_pipe_output_has_no_control_characters(in_process, arguments):
    _, out, err = in_process(*arguments)
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f]", out + err)
    assert "Traceback" not in err
    assert "this is a bug" not in err


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_command_has_common_options_and_complete_summary(in_process, command):
    code, out, _ = in_process(command, "--help")
    assert code == 0
    for option in ("-q, --quiet", "-v, --verbose", "--json", "--debug"):
        assert option in out
    (line,) = [line for line in in_process("--help")[1].splitlines() if line.split()[:1] == [command]]
    assert not line.endswith("...")
