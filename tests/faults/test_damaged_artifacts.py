"""Damaged runs, recordings, bundles, studies and sweeps: commands end with a message and change nothing outside."""

import pytest
import torch
from support import artifact_grammar
from support.fault_sizes import amount, seeds


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory):
    return artifact_grammar.make_artifacts(tmp_path_factory.mktemp("good"))


@pytest.mark.slow
@pytest.mark.parametrize("first", seeds(1, 10, 200))
def test_commands_refuse_or_read_damaged_artifacts(first, artifacts, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("RLCLI_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.delenv("RLCLI_RUNS_DIR", raising=False)
    threads, count = torch.get_num_threads(), amount(8, 40)
    bad = artifact_grammar.run_all(first * count, count, artifacts, tmp_path / "cases")
    torch.set_num_threads(threads)
    assert bad == 0, capsys.readouterr().out
