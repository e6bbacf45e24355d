"""docs/reference/exit-codes.md: each message is what one sees, with the code of its heading."""

import shlex

import pytest
from support.consoles import commands, difference
from support.fenced import REPOSITORY, blocks

from rlcli.cli.app import main

SIMULATING = (6, 9)
"""Codes of commands that simulate before they end."""


def case(code, command):
    marks = [pytest.mark.slow] if code in SIMULATING else []
    return pytest.param(code, command, id=command.text, marks=marks)


CASES = [
    case(int(block.section.partition(":")[0]), command)
    for block in blocks(REPOSITORY / "docs" / "reference" / "exit-codes.md")
    for command in commands(block.text)
]


def test_every_code_that_a_command_alone_can_end_with_is_shown():
    assert {code for (code, _) in (case.values for case in CASES)} == set(range(2, 11))


@pytest.mark.parametrize(("code", "command"), CASES)
def test_what_one_sees_is_what_the_page_says(code, command, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(command.text.removeprefix("rlcli "))) == code
    printed = capfd.readouterr()
    if code not in SIMULATING:
        assert printed.out == ""
    assert difference(command.printed, printed.out + printed.err) is None
