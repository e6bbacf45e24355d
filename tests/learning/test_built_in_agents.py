"""Tests that the off-policy agents of the built-in tasks solve them within their budget."""

import pytest
import torch

from rlcli.cli.app import main


@pytest.fixture(autouse=True)
def _restore_torch_threads():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "agent"), [("cartpole", "sac"), ("cartpole", "td3"), ("cartpole-direct", "sac")])
def test_off_policy_agent_solves_task(task, agent, tmp_path):
    runs = ("--runs-dir", str(tmp_path))
    assert main(["train", task, "--agent", agent, "--seed", "4", "--logger", "none", "-q", *runs]) == 0
    assert main(["eval", task, "--episodes", "1000", "--fail-under", "success=0.97", *runs]) == 0
