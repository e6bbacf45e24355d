"""Hostile text in arguments, options, variables and settings: messages are short, on one line, and without control."""

import pytest
from support import echo_grammar
from support.fault_sizes import amount, seeds


@pytest.fixture(autouse=True)
def _alone(tmp_path, monkeypatch):
    monkeypatch.setenv("RLCLI_STATE_DIR", str(tmp_path / "state"))


@pytest.mark.slow
@pytest.mark.parametrize("first", seeds(1, 10, 100))
def test_messages_repeat_little_of_hostile_text(first, tmp_path, capsys):
    count = amount(30, 60)
    assert echo_grammar.run_all(first * count, count, tmp_path / "cases") == 0, capsys.readouterr().out
