"""Fixtures of the fault tests."""

from pathlib import Path

import pytest
import torch
from support.child_processes import warm_parent
from support.command_line import cli, coin, empty_folder, start


@pytest.fixture(scope="session")
def child():
    """Return a launcher of commands in processes that are forked from one initialised parent."""
    with warm_parent() as launch:
        yield launch


@pytest.fixture
def nothing_executed(tmp_path, monkeypatch):
    """Run a test in an empty folder on one thread of torch; fail if a `Bomb` was unpickled."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_num_threads(threads)
    assert not Path("executed").exists(), "something was executed"
