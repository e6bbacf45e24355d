"""A resumed training refuses a budget that its checkpoint has already spent."""

from pathlib import Path

import pytest

from rlcli.cli.app import main


@pytest.mark.parametrize("option", [("--max-iterations", "2"), ("--max-iterations", "1"), ("--max-steps", "1")])
def test_spent_budget_is_refused(option, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["--num-envs", "4", "agent.n_steps=32", "--logger", "none", "-q"]
    assert main(["train", "cartpole", "--max-iterations", "2", *small]) == 0
    run = Path(capsys.readouterr().out.split()[-1])
    config = (run / "config.yaml").read_text()
    assert main(["train", "--resume", str(run), *option, "-q"]) == 2
    assert f"{option[0]} counts from the run's start" in capsys.readouterr().err
    assert (run / "config.yaml").read_text() == config
    assert main(["train", "--resume", str(run), "--max-iterations", "3", "-q"]) == 0
