"""Fixtures of the fault tests."""

import pytest
from support.child_processes import warm_parent
from support.command_line import cli, coin, empty_folder, start


@pytest.fixture(scope="session")
def child():
    """Return a launcher of commands in processes that are forked from one initialised parent."""
    with warm_parent() as launch:
        yield launch
