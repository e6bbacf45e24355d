"""Installed plugins with hostile metadata, names and specs: every command ends with a message."""

import pytest
from support import plugin_grammar
from support.fault_sizes import amount, seeds


@pytest.fixture(autouse=True)
def _alone(tmp_path, monkeypatch):
    monkeypatch.setenv("RLCLI_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("RLCLI_PLUGINS", raising=False)


@pytest.mark.parametrize("first", seeds(1, 10, 100))
def test_commands_beside_drawn_plugins_end_with_a_message(first, tmp_path, capsys):
    count = amount(40, 100)
    assert plugin_grammar.run_all(first * count, count, tmp_path / "cases") == 0, capsys.readouterr().out
