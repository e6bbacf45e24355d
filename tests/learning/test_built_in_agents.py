"""What the agents of the built-in tasks learn, in about half of their own budget."""

import pytest
import torch

from rlcli.cli.app import main


@pytest.fixture(autouse=True)
def _threads_as_before():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "agent", "iterations"),
    [("cartpole", "sac", 700), ("cartpole", "td3", 900), ("cartpole-direct", "sac", 500)],
)
def test_an_off_policy_agent_learns_its_task(task, agent, iterations, tmp_path):
    runs = ("--runs-dir", str(tmp_path))
    train = ("train", task, "--agent", agent, "--seed", "1", "--max-iterations", str(iterations), "--logger", "none")
    assert main([*train, "-q", *runs]) == 0
    assert main(["eval", task, "--episodes", "500", "--fail-under", "success=0.9", *runs]) == 0
